"""What the site shows beside docs/: README and CHANGELOG as pages, the API page by page, files that pages link to."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT: Final = Path(__file__).resolve().parents[2]
PAGES: Final = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "results/README.md": "results/data.md"}
"""Files of the repository that are pages of the site."""
PACKAGE: Final = "playslot_rl"
MAPPED: Final = ("envs", "collectors", "recipes")
"""Subpackages whose folders are at the top of the repository."""
LINK: Final = re.compile(r"(?<=\]\()([^)#\s:]+)(?=[)#])")
STYLE: Final = f"{PACKAGE}/visualization/style.css"
MERMAID: Final = "elements/mermaid/dist"


def packages() -> dict[str, list[str]]:
    """Public modules by package, both by their full names."""
    found: dict[str, list[str]] = {}
    trees = [(ROOT / PACKAGE, PACKAGE), *((ROOT / name, f"{PACKAGE}.{name}") for name in MAPPED)]
    for folder, name in trees:
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            if any(part.startswith("_") and part != "__init__" for part in parts) or "conf" in parts:
                continue
            package = ".".join((name, *parts[:-1]))
            found.setdefault(package, [])
            if parts[-1] != "__init__":
                found[package].append(f"{package}.{parts[-1]}")
    return dict(sorted(found.items()))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The API's pages into the navigation, under Reference."""
    reference = next(entry["Reference"] for entry in config.nav or [] if "Reference" in entry)
    reference.append({"API": [{name: f"api/{name}.md"} for name in packages()]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Pages and scripts that are not in docs/."""
    for source, uri in PAGES.items():
        files.append(File.generated(config, uri, content=(ROOT / source).read_text()))
    for package, modules in packages().items():
        # The names of the package itself are those of the module `api`.
        own = "\n    options:\n      members: false" if package == PACKAGE else ""
        blocks = [f"::: {package}{own}", *(f"::: {module}\n    options:\n      heading_level: 2" for module in modules)]
        files.append(File.generated(config, f"api/{package}.md", content="\n\n".join(blocks) + "\n"))
    files.append(File.generated(config, "assets/style.css", abs_src_path=str(ROOT / STYLE)))
    nicegui = find_spec("nicegui")  # of the extra `play`: its wheel holds the program that draws the diagrams
    if nicegui is not None and nicegui.origin is not None:
        for path in sorted((Path(nicegui.origin).parent / MERMAID).glob("*.js")):
            files.append(File.generated(config, f"assets/mermaid/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links as GitHub follows them become links of the site; a file outside docs/ is published with it."""
    source = next((name for name, uri in PAGES.items() if uri == page.file.src_uri), f"docs/{page.file.src_uri}")
    folder, depth = (ROOT / source).parent, page.file.src_uri.count("/")

    def replace(match: re.Match[str]) -> str:
        target = (folder / match[1]).resolve()
        if not target.is_relative_to(ROOT) or not target.is_file():
            return match[0]  # the strict build names it
        path = target.relative_to(ROOT).as_posix()
        if path in PAGES:
            uri = PAGES[path]
        elif path.startswith("docs/"):
            uri = path.removeprefix("docs/")
        elif path.endswith(".md"):
            raise PluginError(f"{source}: got a link to {path}, expected a page: add it to PAGES of hooks.py")
        else:
            uri = f"files/{path}"
            if files.get_file_from_path(uri) is None:
                files.append(File.generated(config, uri, abs_src_path=str(target)))
        return "../" * depth + uri

    return LINK.sub(replace, markdown)
