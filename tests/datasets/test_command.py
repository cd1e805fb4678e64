"""`playslot dataset`: help that explains, exit codes, errors of one line; and looking at data sets."""

from __future__ import annotations

import json
import pkgutil
import shutil
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import CAMERA, ROWS, edit_json, frames_of, keep_rows

from playslot_rl import cli
from playslot_rl.data.contents import read_contents
from playslot_rl.data.places import Problems
from playslot_rl.datasets.split import split
from playslot_rl.datasets.viz import _clips, episode_frames, spread
from playslot_rl.errors import ConfigError
from playslot_rl.recipes import dataset as command
from playslot_rl.recipes.actions import make_parser

pytestmark = pytest.mark.slow  # together they take a minute; make test-all runs them

ACTIONS = ["info", "verify", "repair", "merge", "split", "viz", "push", "pull"]


def test_the_actions_are_the_promised_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(command.ACTIONS) == ACTIONS
    for action in command.ACTIONS.values():
        assert callable(pkgutil.resolve_name(action.does))
    for arguments in (["--help"], ["dataset", "--help"]):
        with pytest.raises(SystemExit) as ended:
            cli.main(arguments)
        assert ended.value.code == 0
        assert "dataset" in capsys.readouterr().out


@pytest.mark.parametrize("action", ACTIONS)
def test_help_explains_with_examples_that_are_accepted(action: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["dataset", action, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: playslot dataset {action} ")
    for example in command.ACTIONS[action].examples:
        assert example in text
        assert make_parser("dataset")[1].parse_args(example.split()[2:]).action == action


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["verfy", "x"],
        ["verify"],
        ["split", "a", "--out", "b", "--fractions", "train"],
        ["split", "a", "--out", "b", "--fractions", "train=0.5,train=0.5"],
        ["viz", "a", "--out", "b.html", "--rerun"],
        ["merge", "a", "b"],
    ],
)
def test_bad_usage_is_one_line_and_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["dataset", *arguments])
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "--help" in err


def test_verify_says_0_or_1_and_prints_one_object(
    images: Path, broken: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["dataset", "verify", str(images)]) == 0
    assert "sound, 3 episodes, 15 frames, fingerprint" in capsys.readouterr().out
    assert cli.main(["dataset", "verify", str(images), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["ok"], printed["errors"], printed["episodes"], printed["frames"]) == (True, [], 3, 15)
    keep_rows(broken, ROWS, 9)
    assert cli.main(["dataset", "verify", str(broken), "--json"]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert not printed["ok"]
    assert printed["errors"]
    assert cli.main(["dataset", "verify", str(broken)]) == 1
    assert "damaged (" in capsys.readouterr().out


def test_errors_are_one_line_with_the_action(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing = str(tmp_path / "nothing")
    for arguments in (["info", missing], ["repair", missing], ["merge", missing, "x", "--out", f"{missing}2"]):
        assert cli.main(["dataset", *arguments]) == 1
        err = capsys.readouterr().err
        assert err.startswith(f"playslot dataset {arguments[0]}: error: ")
        assert err.count("\n") == 1
        assert "got no such folder, expected" in err


def test_an_interrupt_says_that_nothing_was_changed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from playslot_rl.datasets import verify

    def interrupt(root: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(verify, "verify", interrupt)
    assert cli.main(["dataset", "verify", "x"]) == 130
    assert "no data set was changed" in capsys.readouterr().err


def test_merge_split_and_repair_from_the_command_line(
    images: Path, broken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, parts = tmp_path / "all", tmp_path / "parts"
    assert cli.main(["dataset", "merge", str(images), str(broken), "--out", str(whole)]) == 0
    assert cli.main(["dataset", "split", str(whole), "--out", str(parts), "--fractions", "train=0.5,val=0.5"]) == 0
    keep_rows(broken, ROWS, 13)
    capsys.readouterr()
    assert cli.main(["dataset", "repair", str(broken)]) == 0
    out = capsys.readouterr().out
    assert "lost: episode 2 (5 rows): got 5 rows, expected 7" in out
    assert "2 of 3 episodes restored" in out


def test_push_and_pull_hand_their_arguments_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    got: list[dict[str, object]] = []

    def spy(**options: object) -> Any:
        got.append(options)
        return types.SimpleNamespace(lines=lambda: ["done"])

    for name in ("push", "pull"):
        module = types.ModuleType(f"playslot_rl.hub.{name}")
        setattr(module, name, spy)
        monkeypatch.setitem(sys.modules, module.__name__, module)
    assert cli.main(["dataset", "push", "d", "me/x", "--private", "--branch", "b"]) == 0
    assert cli.main(["dataset", "pull", "me/x", "d", "--revision", "r"]) == 0
    assert got == [
        {"root": Path("d"), "repo_id": "me/x", "private": True, "branch": "b", "tag": None},
        {"repo_id": "me/x", "root": Path("d"), "revision": "r"},
    ]
    assert capsys.readouterr().out == "done\ndone\n"


def test_the_commands_for_local_data_sets_load_neither_torch_nor_lerobot(images: Path) -> None:
    code = (
        "import sys; from playslot_rl import cli; code = cli.main(['dataset', 'verify', sys.argv[1]]);"
        "print([m for m in ('torch', 'lerobot', 'mujoco') if m in sys.modules], code)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(images)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[] 0"


def test_info_summarises(images: Path, ours: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dataset", "info", str(images), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["episodes"], printed["frames"], printed["lengths"]) == (3, 15, [3, 5.0, 7])
    assert (printed["tasks"], printed["success_rate"], printed["seeds"]) == ({"push": 3}, None, None)
    assert printed["features"] == {CAMERA: "image 32x32x3", "action": "float32 2"}
    assert cli.main(["dataset", "info", str(ours)]) == 0
    out = capsys.readouterr().out
    assert "success   0.0 % of the episodes" in out
    assert "seeds     0 to 1" in out
    assert "made by   policy random, task button_press" in out


def test_the_page_is_one_file_outside_the_data_set(images: Path, ours: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    assert cli.main(["dataset", "viz", str(ours), "--out", str(page), "--episodes", "2"]) == 0
    text = page.read_text()
    assert text.count("<h2>Episode ") == 2
    assert "seed 1" in text
    assert "no success" in text
    assert text.count("data:image/png;base64,") == 2 * (3 + 2)  # animation, its still and strip; curves, light and dark
    assert "http" not in text.replace("http://www.w3.org", "")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_the_page_goes_beside_the_data_set_and_never_into_it(broken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dataset", "viz", str(broken), "--episodes", "1"]) == 0
    assert broken.with_name("broken.html").is_file()
    assert cli.main(["dataset", "viz", str(broken), "--out", str(broken / "page.html")]) == 1
    assert "expected a file outside: a push would upload it" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(["dataset", "viz", str(broken), "--episodes", "0"])
    assert "--episodes: got '0', expected a whole number from 1" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["images", "video"])
def test_the_frames_shown_are_the_episodes(kind: str, request: pytest.FixtureRequest) -> None:
    root: Path = request.getfixturevalue(kind)
    contents = read_contents(root, Problems())
    shown = np.concatenate([episode_frames(contents, CAMERA, number) for number in range(3)])
    assert np.array_equal(shown, np.rint(frames_of(root) * 255).transpose(0, 2, 3, 1))
    step = shown.shape[1] // 4
    thin = np.concatenate([clip.frames[CAMERA] for clip in _clips(contents, [0, 1, 2], 4)])
    assert np.array_equal(thin, shown[:, ::step, ::step])
    assert spread(3, 9) == [0, 1, 2]
    assert spread(100, 3) == [0, 50, 99]


def test_rerun_is_asked_for_where_it_is_missing(
    images: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert cli.main(["dataset", "viz", str(images), "--rerun"]) == 1
    assert "run `pip install rerun-sdk`" in capsys.readouterr().err


def test_rerun_gets_every_frame(
    images: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logged: list[str] = []
    viewer = types.ModuleType("rerun")
    for name, function in {
        "init": lambda name, spawn: None,
        "set_time": lambda *_, **__: None,
        "log": lambda path, _: logged.append(path),
        "Image": lambda image: image,
        "Scalars": lambda values: values,
    }.items():
        setattr(viewer, name, function)
    monkeypatch.setitem(sys.modules, "rerun", viewer)
    assert cli.main(["dataset", "viz", str(images), "--rerun", "--episodes", "2"]) == 0
    assert logged.count(f"episode_0/{CAMERA}") == 5
    assert logged.count("episode_2/action") == 7


def test_a_damaged_data_set_is_not_shown(broken: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit_json(broken, "meta/info.json", lambda info: info.update(total_frames=3))
    assert cli.main(["dataset", "viz", str(broken)]) == 1
    assert "run `playslot dataset repair` on it first" in capsys.readouterr().err
    assert not broken.with_name("broken.html").exists()
    shutil.rmtree(broken)


@pytest.mark.parametrize(
    "options",
    [
        ["--seed", "-1"],
        ["--seed", "nan"],
        ["--seed", "1_000"],
        ["--seed", "1e3"],
        ["--seed", "9" * 23],
        ["--seed", "9" * 5000],
        ["--fractions", "a=nan"],
        ["--fractions", "a=inf,b=0.5"],
        ["--fractions", "a=-0.5,b=1.5"],
        ["--fractions", "a=1e308"],
    ],
    ids=lambda options: " ".join(options)[:40],
)
def test_numbers_of_options_have_bounds(
    images: Path, tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    more = [] if "--fractions" in options else ["--fractions", "a=0.5,b=0.5"]
    with pytest.raises(SystemExit) as ended:
        cli.main(["dataset", "split", str(images), "--out", str(tmp_path / "parts"), *more, *options])
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"argument {options[0]}: got " in err
    assert len(err) < 300
    assert list(tmp_path.iterdir()) == []


def test_a_split_has_a_seed_of_its_own(images: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="seed: got -1, expected a whole number from 0"):
        split(images, tmp_path / "parts", {"a": 0.5, "b": 0.5}, seed=-1)
