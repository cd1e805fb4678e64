"""The command line: help that explains, errors of one line, exit codes, nothing hidden by a traceback."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest

from playslot_rl import __version__, cli
from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError, DataError, OutputError

COMMANDS = [
    "collect",
    "convert",
    "train-slots",
    "train-dynamics",
    "train-policy",
    "train-baseline",
    "evaluate",
    "inspect",
    "plan",
    "export",
    "play",
    "pipeline",
    "adopt",
    "compare",
    "compare-video",
    "demo",
    "bench",
    "models",
    "doctor",
]
KEYS = {
    "collect": "preset= policy= episodes= seed= workers= out= collect.noise= env. collector. render.",
    "convert": "env= episodes= out= data.root= data.camera= env.image_size= collect.storage=",
    "train-slots": "env= preset= seed= out= device= threads= data.root= data. model.savi. slots. logging.",
    "train-dynamics": "run= seed= out= data.root= model.inverse_dynamics. model.predictor. dynamics.",
    "train-policy": "run= demos= data.demos= model.policy. model.action_decoder. behaviour.",
    "train-baseline": "method= run= demos= env= preset= data.root= baselines.lapo. baselines.sold. behaviour.",
    "evaluate": "run= episodes= seed= protocol= device= env. render. evaluation.",
    "inspect": "run= episodes= seed= out= data.",
    "plan": "run= episodes= seed= out= planner= proposal= goals= plan.",
    "export": "run= out= export.",
    "play": "run= port= seed= out= play. data.",
    "pipeline": "env= preset= episodes= seed= workers= out= data.root= collect. slots. behaviour. evaluation.",
    "adopt": "minutes= seed= out= data.root= data. adopt. slots. dynamics.",
    "compare": "run= seed= out= methods= demos= labels= seeds= processes= hydra.launcher= compare. baselines.lapo.",
    "compare-video": "run= seed= methods= seeds= vary= values= objects= hydra.launcher= compare_video. metrics.",
    "demo": "episodes= seed= out= collect. behaviour.",
    "bench": "preset= device= threads=",
    "models": "run=",
    "doctor": "device= out= data.cache=",
}
"""Keys and groups of which the help of each command has a line."""

Recipe = Callable[..., None]


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, Recipe], None]:
    """Put a function in the place of a recipe."""

    def replace(name: str, main: Recipe) -> None:
        module = types.ModuleType(f"playslot_rl.recipes.{name}")
        module.main = main  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)

    monkeypatch.delenv("PLAYSLOT_DEBUG", raising=False)
    return replace


def raising(error: BaseException) -> Recipe:
    def main(config: ExperimentConfig) -> None:
        raise error

    return main


def test_the_commands_are_the_promised_ones() -> None:
    assert list(cli.COMMANDS) == COMMANDS
    assert list(cli.GROUPS) == ["dataset", "cache"]


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_with_examples_and_the_commands_own_keys(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = help_of(command, capsys)
    assert f"playslot {command}" in text
    assert "examples:" in text
    shown = text.split("\nkeys:\n", 1)[1]
    for key in KEYS[command].split():
        assert re.search(rf"[ \n]{re.escape(key)}", shown), key
    keys = {found[1] for line in shown.splitlines() if (found := re.match(r"  ([a-z][a-z_.]*)[=.]", line))}
    foreign = {"protocol": ("evaluate", "pipeline"), "policy": ("collect",), "minutes": ("adopt",), "port": ("play",)}
    foreign |= {"method": ("train-baseline", "evaluate"), "export": ("export",), "plan": ("plan",), "adopt": ("adopt",)}
    assert not [key for key, of in foreign.items() if key in keys and command not in of]


def test_every_key_is_in_the_help_of_a_command() -> None:
    from playslot_rl.config.plain import flatten, to_dict

    listed = {key for command in cli.COMMANDS.values() for key in command.reads.split()}
    keys = flatten(to_dict(ExperimentConfig()))
    assert [key for key in keys if not any(f"{key}.".startswith(f"{of}.") for of in listed)] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_lists_the_keys_of_its_examples(command: str) -> None:
    from playslot_rl.config.compose import COMPARISONS, NAMES

    short = {*COMPARISONS.get(command, ()), *NAMES.get(command, ())}
    for example in cli.COMMANDS[command].examples:
        for key in re.findall(r" ([a-z_.]+)=", example):
            own = key in short or key.startswith("hydra.")
            assert own or any(f"{key}.".startswith(f"{of}.") for of in cli.COMMANDS[command].reads.split()), key


def test_the_words_of_a_key_are_those_of_its_field(capsys: pytest.CaptureFixture[str]) -> None:
    text = " ".join(help_of("adopt", capsys).split())
    assert "minutes=60.0 of wall-clock time that `adopt` may take" in text
    assert "slots. steps batch_size optim.{lr,warmup_steps,schedule,grad_clip,accumulate,ema} precision" in text
    assert "policy=random|expert" in " ".join(help_of("collect", capsys).split())


@pytest.mark.parametrize(
    ("arguments", "near"),
    [
        (["train-polcy"], "train-policy"),
        (["colect", "seed=1"], "collect"),
        (["dataset", "splt"], "split"),
        (["cache", "lst"], "list"),
        (["datset"], "dataset"),
    ],
)
def test_a_slip_in_a_name_gets_the_nearest(arguments: list[str], near: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"; did you mean {near}?" in err


@pytest.mark.parametrize(
    ("run", "near"),
    [("pretraind", "pretrained"), ("pretraind/block_push", "pretrained/block_push"), ("runs/mien", "runs/mine")],
)
@pytest.mark.parametrize("command", ["evaluate", "train-policy", "play"])
def test_a_slip_in_a_runs_name_gets_the_nearest(
    command: str,
    run: str,
    near: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "config.json").write_text("{}")
    assert cli.main([command, f"run={run}"]) == 2
    err = capsys.readouterr().err
    assert f"; did you mean run={near}?" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", COMMANDS)
def test_every_example_in_the_help_is_accepted(command: str, recipe: Callable[[str, Recipe], None]) -> None:
    from playslot_rl.config.compose import compose

    for example in cli.COMMANDS[command].examples:
        words = example.split()
        assert words[:2] == ["playslot", command]
        typed = [word for word in words[2:] if "=" in word]
        # Examples name runs that are not here: compose them as a command that reads no run, or leave the run out.
        own_keys = command.startswith("compare") or command == "plan"
        typed = [word for word in typed if command != "plan" or not word.startswith("run=runs/")]
        assert compose(typed, command if own_keys else "collect")


def test_help_names_every_command_and_is_quick_to_load() -> None:
    code = "import sys; from playslot_rl import cli\ntry: cli.main(['--help'])\nfinally: print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(f"  {command} " in done.stdout for command in COMMANDS)
    assert done.stdout.strip().endswith("False")


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.strip() == f"playslot {__version__}"


def test_no_command_prints_the_help_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "commands:" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["colect"], ["seed=1"], ["collect", "--fast"], ["bench", "--json"]])
def test_bad_usage_is_one_line_and_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "--help" in err


@pytest.mark.parametrize("argument", ["preset=smol", "env=kitchen", "sed=1", "fast", "seed=x"])
def test_a_bad_argument_is_one_line_and_code_2(argument: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["pipeline", argument]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.startswith("playslot pipeline: error: ")
    assert err.count("\n") == 1
    assert "expected" in err


def test_a_command_calls_its_recipe_with_the_config(recipe: Callable[[str, Recipe], None]) -> None:
    got: list[ExperimentConfig] = []
    recipe("train_slots", got.append)
    assert cli.main(["train-slots", "preset=smoke", "seed=4"]) == 0
    assert (got[0].preset, got[0].seed) == ("smoke", 4)


@pytest.mark.parametrize("arguments", [["seed=4", "--json", "f.json"], ["--json", "f.json", "seed=4"]])
def test_bench_hands_its_file_on(arguments: list[str], recipe: Callable[[str, Recipe], None]) -> None:
    got: list[tuple[int, Path | None]] = []
    recipe("bench", lambda config, json_path: got.append((config.seed, json_path)))
    assert cli.main(["bench", *arguments, "preset=smoke"]) == 0
    assert cli.main(["bench"]) == 0
    assert got == [(4, Path("f.json")), (0, None)]


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (DataError("data.root=x: got no data set, expected one: collect it"), 1, "got no data set, expected one"),
        (ConfigError("several\nlines"), 1, "several lines"),
        (OutputError("out=x holds something else"), 1, "out=x holds something else"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "a/b"), 1, "got a full disk for a/b, expected free space"),
        (RuntimeError("zip writer: No space left on device"), 1, "got a full disk, expected free space"),
        (PermissionError(errno.EACCES, "Permission denied", "a/b"), 1, "got no permission for a/b, expected it"),
        (ZeroDivisionError("division by zero"), 1, "ZeroDivisionError: division by zero .*PLAYSLOT_DEBUG=1"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_an_error_is_one_line_and_an_exit_code(
    error: BaseException,
    code: int,
    text: str,
    recipe: Callable[[str, Recipe], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    import re

    recipe("demo", raising(error))
    assert cli.main(["demo", "preset=smoke"]) == code
    err = capsys.readouterr().err
    assert re.search(text, err)
    assert err.count("\n") == 1


def test_what_the_library_says_itself_is_expected(
    recipe: Callable[[str, Recipe], None], capsys: pytest.CaptureFixture[str]
) -> None:
    """Errors in its own words, of whichever class; what others raise in the same words is not."""
    from playslot_rl.config.plain import check

    recipe("demo", lambda config: check(False, "clip", 3, "more frames"))
    assert cli.main(["demo"]) == 1
    assert capsys.readouterr().err == "playslot demo: error: clip: got 3, expected more frames\n"
    recipe("demo", raising(ValueError("clip: got 3, expected more frames")))
    assert cli.main(["demo"]) == 1
    assert "(unexpected; PLAYSLOT_DEBUG=1 shows where)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes.")]
)
def test_too_little_memory_is_one_line(
    error: Exception, recipe: Callable[[str, Recipe], None], capsys: pytest.CaptureFixture[str]
) -> None:
    recipe("demo", raising(error))
    assert cli.main(["demo"]) == 1
    err = capsys.readouterr().err
    assert "got too little memory" in err
    assert "expected enough for these sizes: choose smaller ones" in err
    assert "unexpected" not in err


def test_a_wrapped_full_disk_is_still_a_full_disk(
    recipe: Callable[[str, Recipe], None], capsys: pytest.CaptureFixture[str]
) -> None:
    wrapped = RuntimeError("cannot write")
    wrapped.__cause__ = OSError(errno.ENOSPC, "full")
    recipe("demo", raising(wrapped))
    assert cli.main(["demo"]) == 1
    assert "full disk" in capsys.readouterr().err


def test_debugging_shows_the_traceback(recipe: Callable[[str, Recipe], None], monkeypatch: pytest.MonkeyPatch) -> None:
    recipe("demo", raising(DataError("broken")))
    monkeypatch.setenv("PLAYSLOT_DEBUG", "1")
    with pytest.raises(DataError, match="broken"):
        cli.main(["demo"])
    with pytest.raises(ConfigError, match="unknown preset"):
        cli.main(["demo", "preset=smol"])


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("arguments", [["train-slots", "--help"], ["models"]])
def test_who_reads_no_further_gets_no_complaint(arguments: list[str], unbuffered: str) -> None:
    command = subprocess.Popen(
        [sys.executable, "-m", "playslot_rl", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
    )  # fmt: skip
    assert command.stdout is not None
    command.stdout.close()
    assert command.communicate()[1] == ""
    assert command.returncode in (0, cli.CLOSED)


def test_the_broken_pipe_of_a_worker_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> int:
        raise BrokenPipeError("worker 1 is gone")

    assert cli._guarded("collect", fail) == 1
    assert "worker 1 is gone" in capsys.readouterr().err


def test_the_installed_command_works_from_another_folder(tmp_path: Path) -> None:
    command = Path(sys.executable).parent / "playslot"
    done = subprocess.run([command, "evaluate", "run=nothing"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert "run=nothing: got no nothing/config.json" in done.stderr
    assert not list(tmp_path.iterdir())


def test_every_command_stands_in_the_table_of_the_recipes_page(repository: Path) -> None:
    page = (repository / "docs" / "reference" / "commands.md").read_text()
    table = page.split("|---|---|---|", 1)[1].split("\n\n", 1)[0]
    assert set(re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE)) == {*cli.COMMANDS, *cli.GROUPS}
