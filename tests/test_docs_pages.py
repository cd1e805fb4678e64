"""docs/ is short enough to be read, and the pages, keys, modules and files that it names are there."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from playslot_rl.config import ExperimentConfig, key_help

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
NOTEBOOK = sorted((DOCS / "notebook").glob("*.md"))
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page not in NOTEBOOK]
KEYS = DOCS / "reference" / "keys.md"
LIMITS = {"README.md": 1_200, "docs": 20_600, "notebook": 12_000, "keys": 6_500}
"""Words, at most. The page of keys is made, looked up and grows with the methods: it has a limit of its own."""
SOURCES = ("playslot_rl", "recipes", "envs", "collectors", "tests", "lerobot_policy_playslot", "docs", "results")
SUFFIXES = {".py", ".md", ".yaml", ".toml", ".json"}
RESULTS = {".json", ".jsonl", ".md", ".html", ".lock", ".safetensors"}
"""Of files that commands write; some begin as a group of keys does."""


def words(page: Path) -> int:
    """Whatever has a letter or a digit, code and tables included; the generator's marks are not read by anybody."""
    text = re.sub(r"<!--.*?-->", "", page.read_text(), flags=re.DOTALL)
    return sum(any(sign.isalnum() for sign in word) for word in text.split())


def named(page: Path) -> Iterator[str]:
    """What stands between backticks in the prose of a page."""
    prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    yield from re.findall(r"`([^`\n]+)`", prose)


def keys() -> set[str]:
    """Every key of the config, and every group."""
    found = set()

    def walk(cls: type, group: str) -> None:
        for name, hint in key_help.fields_of(cls).items():
            found.add(group + name)
            if dataclasses.is_dataclass(hint):
                walk(hint, f"{group}{name}.")

    walk(ExperimentConfig, "")
    return found


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    spec = spec_from_file_location("keys", DOCS / "_site" / "keys.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("name", "pages"),
    [
        ("README.md", [ROOT / "README.md"]),
        ("docs", [page for page in PAGES if page != KEYS]),
        ("notebook", NOTEBOOK),
        ("keys", [KEYS]),
    ],
)
def test_a_reader_finishes(name: str, pages: list[Path]) -> None:
    assert pages
    assert sum(map(words, pages)) <= LIMITS[name]


def test_the_page_of_keys_is_as_new_as_the_config(generator: ModuleType) -> None:
    """After a change of a field: `.venv/bin/python docs/_site/keys.py`."""
    assert generator.PAGE.read_text() == generator.page()


def test_every_key_is_explained(generator: ModuleType) -> None:
    silent = [f"{cls.__name__}.{name}" for cls in generator.sections() for name in generator.own(cls)]
    silent = [name for name in silent if not explanation(generator, name)]
    assert silent == []


def explanation(generator: ModuleType, name: str) -> str:
    cls = next(cls for cls in generator.sections() if cls.__name__ == name.split(".")[0])
    return str(key_help.meaning(cls, name.split(".")[1]))


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: page.name)
def test_keys_modules_and_files_that_a_page_names_are_there(page: Path) -> None:
    known = keys()
    groups = {key.split(".")[0] for key in known if "." in key}
    missing = []
    for text in named(page):
        for key in re.findall(r"(?<![\w./-])([a-z_]+(?:\.[a-z_]+)+)(?==|$| )", text):
            if key.split(".")[0] in groups and key not in known and Path(key).suffix not in RESULTS:
                missing.append(key)
        if re.fullmatch(r"playslot_rl(\.\w+)+", text) and not there(text):
            missing.append(text)
        # Capitals stand for a reader's own names: RUN, ENV.
        if re.fullmatch(r"[a-z_-]+(/[a-z0-9_.-]+)*/[a-z0-9_.-]+\.(py|yaml|md|ipynb)", text) and not exists(text):
            missing.append(text)
    assert missing == []


def there(name: str) -> bool:
    """Whether a dotted name leads to a module, or to something in one."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            spec = find_spec(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        if spec is not None:
            source = Path(spec.origin or "").read_text() if spec.origin else ""
            return length == len(parts) or re.search(rf"\b{parts[length]}\b", source) is not None
    return False


def exists(name: str) -> bool:
    """Whether a path as a page writes it is in the repository, or in the package."""
    return any((folder / name).exists() for folder in (ROOT, ROOT / "playslot_rl"))


def test_every_mention_of_a_page_is_of_one_that_exists() -> None:
    files = [path for name in SOURCES for path in (ROOT / name).rglob("*") if path.suffix in SUFFIXES]
    files += [ROOT / name for name in ("README.md", "CHANGELOG.md", "Makefile", "mkdocs.yml", "pyproject.toml")]
    gone = {
        f"{path.relative_to(ROOT)}: {mention}"
        for path in files
        for mention in re.findall(r"\bdocs/[\w/-]+\.md\b", path.read_text())
        if not (ROOT / mention).is_file()
    }
    assert gone == set()


def test_every_picture_is_shown() -> None:
    text = "".join(page.read_text() for page in [ROOT / "README.md", *PAGES, *NOTEBOOK])
    assert [path.name for path in sorted((DOCS / "images").iterdir()) if path.name not in text] == []
