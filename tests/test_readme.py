"""The commands of the README and of docs/: every one is read, the cheap ones run."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from playslot_rl import cli
from playslot_rl.config.compose import compose
from playslot_rl.recipes.actions import make_parser

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def commands(page: Path) -> list[str]:
    """Command lines of the ```bash blocks of a page, in order, continued lines joined, comments left out."""
    blocks = re.findall(r"^```bash\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [line for line in (shlex.join(shlex.split(line, comments=True)) for line in lines) if line]


def results() -> list[tuple[str, str]]:
    """Commands that made the numbers in results/*.json."""
    lots = []
    for path in sorted((ROOT / "results").glob("*.json")):
        tables = json.loads(path.read_text())["tables"].values()
        lots += [(path.name, lot["command"] or []) for table in tables for lot in table["made"]]
    joined = [(name, line) for name, lines in lots for line in "\n".join(lines).replace("\\\n", " ").splitlines()]
    return sorted({(name, shlex.join(shlex.split(line, comments=True))) for name, line in joined})


EVERY = [(page.name, command) for page in PAGES for command in commands(page)] + results()


def test_the_first_commands_of_the_readme_are_demo_and_test() -> None:
    assert commands(ROOT / "README.md")[:2] == ["make demo", "make test"]


def test_the_readme_is_short_and_begins_with_a_picture_and_a_quick_start() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.split()) <= 1200
    picture, start = text.index("](docs/images/imagined.webp)"), text.index("```python")
    assert picture < start < text.index("```bash")
    assert text[:start].count("\n") < 25


def test_the_readme_names_every_command_of_the_pipeline() -> None:
    text = "\n".join(commands(ROOT / "README.md"))
    for name in ("collect", "train-slots", "train-dynamics", "train-policy", "evaluate"):
        assert f"playslot {name} " in text


@pytest.mark.parametrize(("page", "command"), EVERY, ids=[f"{page}: {command}" for page, command in EVERY])
def test_a_documented_command_is_accepted(page: str, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "my_experts", SimpleNamespace(reach=print))  # the user's own
    words = [word for word in shlex.split(command) if not re.fullmatch(r"[A-Z_]+=\S*", word)]
    program, rest = Path(words[0]).name, words[1:]
    if program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert set(rest) <= set(targets), f"{page}: no such make target"
    elif rest == ["--help"]:
        assert program == "playslot"
    elif program == "playslot":
        name = rest[0]
        if name in cli.GROUPS:
            assert make_parser(name)[1].parse_args(rest[1:])
            return
        assert name in cli.COMMANDS, f"{page}: no such command"
        typed = [word for word in rest[1:] if not word.startswith("--") and "=" in word]
        assert len(typed) == len([word for word in rest[1:] if "=" in word])
        if name != "bench":
            assert len(typed) == len(rest[1:]) - ("--help" in rest), f"{page}: not key=value"
        # A page names runs that are not here: composed as by a command that reads no run, or without the run.
        own_keys = name.startswith("compare") or name == "plan"
        reads = name == "plan" or "env=video" in typed
        typed = [word for word in typed if not reads or not word.startswith("run=runs/")]
        assert compose(typed, name if own_keys else "collect")
    else:
        assert program in {"cd", "cp", "docker", "git", "hf", "lerobot-eval", "python", "pip", "tensorboard"}, (
            f"{page}: unknown program"
        )


def test_the_cheap_commands_run() -> None:
    """`playslot doctor`, too: in tests/test_doctor.py."""
    assert any(command.endswith("playslot doctor") for _, command in EVERY)
    cheap = {command for _, command in EVERY if re.search(r"^(?!docker).*(--help|make help)$", command)}
    assert any(command.startswith("playslot ") for command in cheap)
    for command in sorted({re.sub(r"^\.venv/bin/", "", command) for command in cheap}):
        program, *rest = shlex.split(command)
        full = str(Path(sys.executable).parent / program) if program == "playslot" else program
        done = subprocess.run([full, *rest], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_number_is_still_to_be_filled_in(page: Path) -> None:
    assert re.findall(r"@@\w*@@", page.read_text()) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)", page.read_text())
    local = [target for target in targets if "://" not in target and not target.startswith("mailto:")]
    assert [target for target in local if not (page.parent / target).exists()] == []
