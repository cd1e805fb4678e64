"""The site of README, docs/ and the API: built strictly, so that no link, anchor, page or documented argument rots."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

pytest.importorskip("mkdocs", reason="needs the extra `docs`")
pytest.importorskip("mkdocstrings", reason="needs the extra `docs`")

LOADS = re.compile(r'<(?:script|link|img|iframe)[^>]+?(?:src|href)="(?:https?:)?//[^"]*"')


def build(repository: Path, site: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """`make docs` without the set-up, the index for searching, and ruff, which breaks each long signature into lines in
    a process of its own: no matter here.

    Not --quiet: it silences warnings, and with them what --strict counts.
    """
    subprocess.run(["make", "typing"], cwd=repository, check=True)
    program = "import sys; sys.modules['ruff'] = None; from mkdocs.__main__ import cli; cli()"
    command = [sys.executable, "-c", program, "build", "--strict", "--site-dir", str(site), *options]
    environment = {**os.environ, "DOCS_SEARCH": "false", "NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(command, cwd=repository, capture_output=True, text=True, env=environment)


@pytest.fixture(scope="module")
def site(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs") / "site"
    done = build(repository, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_of_docs_is_built_and_reached_from_every_tab(repository: Path, site: Path) -> None:
    pages = {path.relative_to(repository / "docs").with_suffix(".html") for path in (repository / "docs").rglob("*.md")}
    home = (site / "index.html").read_text()
    for page in {*map(str, pages), "index.html", "changelog.html"}:
        assert (site / page).is_file()
    for tab in ("Start", "Tutorials", "How-to", "Reference", "Explanation", "Results"):
        assert tab in home


def test_links_of_the_readme_lead_to_pages_of_the_site(repository: Path, site: Path) -> None:
    home, readme = (site / "index.html").read_text(), (repository / "README.md").read_text()
    linked = re.findall(r"\]\(docs/([a-z/-]+)\.md(#[^)]*)?\)", readme)
    assert linked
    for page, anchor in linked:
        assert f'href="{page}.html{anchor}"' in home
    assert 'href="files/LICENSE"' in home
    assert (site / "files" / "LICENSE").read_text() == (repository / "LICENSE").read_text()


def test_the_api_has_each_package_with_its_public_names(site: Path) -> None:
    for page, names in {
        "playslot_rl": ["playslot_rl.api.PlaySlot.imagine", "playslot_rl.keys"],
        "playslot_rl.envs": ["playslot_rl.envs.pixel_task.PixelTask"],
        "playslot_rl.collectors": ["playslot_rl.collectors.collection"],
        "playslot_rl.recipes": ["playslot_rl.recipes.pipeline.main"],
        "playslot_rl.modules.savi": ["playslot_rl.modules.savi.SAVi.forward"],
    }.items():
        text = (site / "api" / f"{page}.html").read_text()
        assert not [name for name in names if f'id="{name}"' not in text], page


def test_pages_load_nothing_from_another_host(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 50
    assert not [(page.name, found) for page in pages for found in LOADS.findall(page.read_text())]


def test_the_strict_build_fails_where_a_link_is_broken(repository: Path, tmp_path: Path) -> None:
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "index.md").write_text("[gone](nowhere.md), [no such part](index.md#nowhere)\n")
    own = f"INHERIT: {repository / 'mkdocs.yml'}\ndocs_dir: {docs}\nnav: [index.md]\n"
    (tmp_path / "mkdocs.yml").write_text(own + "hooks: []\nplugins: []\nextra_css: []\nextra_javascript: []\n")
    done = build(repository, tmp_path / "site", "--config-file", str(tmp_path / "mkdocs.yml"))
    assert done.returncode != 0
    assert "nowhere.md" in done.stderr
    assert "#nowhere" in done.stderr


def test_the_notebook_is_built_and_stands_in_no_navigation(site: Path) -> None:
    assert (site / "notebook" / "labels.html").is_file()
    assert "notebook/" not in (site / "reference" / "commands.html").read_text()
