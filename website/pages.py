"""MkDocs hooks: the pages that are not files of docs/, and links that hold on GitHub and here.

README.md is the first page, CHANGELOG.md the last. Each package has a page of its public names,
which mkdocstrings fills; other pages lead there from each name that they mention. A link to
anything else in the repository leads to a page with its text.
"""

from __future__ import annotations

import ast
import posixpath
import re
from functools import cache
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
DOCS, PACKAGE = ROOT / "docs", ROOT / "torchrl_etl"
MOVED = {ROOT / "README.md": "index.md", ROOT / "CHANGELOG.md": "changelog.md"}
LINK = re.compile(r"(?<=\]\()([^)\s#]+)(#[^)\s]*)?(?=\))")
# Code of one name; what may hold such a name and is left alone comes first.
NAME = re.compile(
    r"^```.*?^```|^#.*?$|\[[^\]]*\]\([^)]*\)|(?<!`)`([\w.]+)`(?!`)", re.DOTALL | re.MULTILINE
)
LANGUAGES = {".py": "python", ".yaml": "yaml", ".sh": "bash", ".toml": "toml"}


def on_config(config: Any) -> Any:
    documented.cache_clear()  # `mkdocs serve` builds more than once
    for entry in config.nav:
        if "API reference" in entry:
            entry["API reference"] = ["api/index.md", *(f"api/{name}.md" for name in documented())]
    return config


def on_files(files: Files, config: Any) -> Files:
    def add(uri: str, content: str) -> None:
        files.append(File.generated(config, uri, content=content))

    for path, uri in MOVED.items():
        add(uri, path.read_text(encoding="utf-8"))
    add("stylesheets/site.css", (Path(__file__).parent / "site.css").read_text(encoding="utf-8"))
    add("api/index.md", overview())
    for name, (path, names) in documented().items():
        add(f"api/{name}.md", reference(name, path, names))
    pages = [*MOVED, *DOCS.rglob("*.md")]
    for path in {target for page in pages for target in linked(page)}:
        if uri_of(path).startswith("source/"):
            add(uri_of(path), source(path))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    uri = page.file.src_uri
    origin = {uri: path for path, uri in MOVED.items()}.get(uri, DOCS / uri)

    def relative(found: re.Match) -> str:
        target = (origin.parent / found[1]).resolve()
        if not target.exists() or not target.is_relative_to(ROOT):
            return found[0]
        return posixpath.relpath(uri_of(target), posixpath.dirname(uri)) + (found[2] or "")

    markdown = LINK.sub(relative, markdown)
    return markdown if uri.startswith(("api/", "source/")) else link_names(markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Pictures are fetched when they come near the screen."""
    return html.replace("<img ", '<img loading="lazy" ')


def link_names(markdown: str) -> str:
    """Leads from the public names that a page mentions to the reference."""
    known: dict[str, list[str]] = {}
    for page, (_, names) in documented().items():
        for name in names:
            known[f"{page}.{name}"] = [f"torchrl_etl.{page}.{name}"]
            if "_" in name or not name.islower():  # `embedding` is a key, too
                known.setdefault(name, []).append(f"torchrl_etl.{page}.{name}")

    def linked_name(found: re.Match) -> str:
        places = known.get(found[1] or "", ())
        return f"[{found[0]}][{places[0]}]" if len(places) == 1 else found[0]

    return NAME.sub(linked_name, markdown)


def uri_of(path: Path) -> str:
    """Where a file or folder of the repository is on the site."""
    if path in MOVED:
        return MOVED[path]
    if path.is_file() and path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    return f"source/{path.relative_to(ROOT).as_posix()}.md"


def linked(page: Path) -> list[Path]:
    """What a page links to in this repository, and below a folder its files."""
    found = []
    for target, _ in LINK.findall(page.read_text(encoding="utf-8")):
        path = (page.parent / target).resolve()
        if path.exists() and path.is_relative_to(ROOT):
            found += [path, *(listed(path) if path.is_dir() else ())]
    return found


def listed(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file())


def source(path: Path) -> str:
    """A page with the text of a file, or the files of a folder."""
    head = f"---\nsearch: {{exclude: true}}\n---\n\n# {path.relative_to(ROOT)}\n\n"
    if path.is_dir():
        here = posixpath.dirname(uri_of(path))
        rows = (f"- [{p.name}]({posixpath.relpath(uri_of(p), here)})" for p in listed(path))
        return head + "\n".join(rows) + "\n"
    language = LANGUAGES.get(path.suffix, "text")
    return head + f"``````{language}\n{path.read_text(encoding='utf-8')}\n``````\n"


@cache
def documented() -> dict[str, tuple[Path, list[str]]]:
    """Packages and modules that say what is public, by name, with their file and public names."""
    found = {}
    for path in sorted([*PACKAGE.glob("*.py"), *PACKAGE.rglob("*/__init__.py")]):
        module = path.parent if path.name == "__init__.py" else path.with_suffix("")
        name = ".".join(module.relative_to(PACKAGE).parts)
        names = public_names(path)
        if name and names:
            found[name] = path, names
    return dict(sorted(found.items()))


def public_names(path: Path) -> list[str]:
    """``__all__``, read and not run."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return []


def reference(name: str, path: Path, names: list[str]) -> str:
    members = "".join(f"        - {member}\n" for member in names)
    return f"# {name}\n\n::: torchrl_etl.{name}\n    options:\n      members:\n{members}"


def overview() -> str:
    """All public names, by package."""
    pages = documented()
    short = public_names(PACKAGE / "__init__.py")
    homes = [(page, name) for page, (_, names) in pages.items() for name in names if name in short]
    text = (
        "# API reference\n\nAll public names, by package. What is asked for most is in "
        f"`torchrl_etl`, too:\n\n{links(homes)}\n"
    )
    for page, (path, names) in pages.items():
        summary = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n")
        text += f"\n## [{page}]({page}.md)\n\n{summary[0]}\n\n"
        text += links([(page, name) for name in names]) + "\n"
    return text


def links(names: list[tuple[str, str]]) -> str:
    return " · ".join(f"[`{name}`][torchrl_etl.{page}.{name}]" for page, name in names)
