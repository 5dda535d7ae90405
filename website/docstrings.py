"""A Griffe extension: docstrings as they are written here, in Markdown.

They follow TorchRL's: Google's sections, the roles of reStructuredText, and three sections of
this project, ``Equation:``, ``Keys:`` and ``Deviates:``. A role becomes a link where what it names
has a place in the reference, and code elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from textwrap import dedent, indent
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod|attr):`(?:[^`<]*<)?(~?)([\w.]+)>?`")
MATH = re.compile(r":math:`([^`]+)`")
MATH_BLOCK = re.compile(r"^( *)\.\. math::(.*\n(?:(?:\1 +\S.*)?\n?)*)", re.MULTILINE)
# To the end of its paragraph, and what is indented below.
SECTION = re.compile(
    r"^( *)(Equation|Keys|Deviates):((?: .*)?(?:\n *\S.*)*(?:\n+\1 +\S.*)*)", re.MULTILINE
)
LIST = re.compile(r"(^(?!- ).*\S)\n(- )", re.MULTILINE)
CODE = re.compile(r"(``.*?``|`[^`]+`)")

# Where a name is shown, and what it names.
Places = dict[str, tuple[str, griffe.Object]]


class Docstrings(griffe.Extension):
    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        things = [*documented(pkg)]
        show_exports(pkg)
        shown = shown_names(pkg)
        for thing in things:
            thing.docstring.value = in_markdown(thing.docstring.value, thing, shown)


def documented(scope: griffe.Object) -> Iterator[griffe.Object]:
    """Everything below ``scope`` that has a docstring, itself included."""
    if scope.docstring:
        yield scope
    for member in scope.members.values():
        if not member.is_alias:
            yield from documented(member)


def packages(pkg: griffe.Module) -> list[griffe.Module]:
    """What has a page of its own: packages and the modules beside them, see ``pages.py``."""
    return [m for m in modules(pkg) if m.exports and (m.is_init_module or m.parent is pkg)]


def show_exports(pkg: griffe.Module) -> None:
    """Lets a function win over the file of the same name that it is imported from."""
    exports = [
        (package, str(name), package.members[str(name)])
        for package in packages(pkg)
        for name in package.exports
    ]
    for _, _, member in exports:
        if member.is_alias:
            _ = member.final_target  # found now, while every file is still in its place
    for package, name, member in exports:
        if not member.is_alias and member.is_module:
            package.members[name] = griffe.Alias(name, member.members[name], parent=package)


def shown_names(pkg: griffe.Module) -> Places:
    """Where each public object is shown, and the object, by every name that it goes by."""
    shown: Places = {}
    for package in packages(pkg):
        if package is pkg:
            continue  # its names are shown in the packages that they come from
        for name in package.exports:
            member = package.members[str(name)]
            final = member.final_target if member.is_alias else member
            for known in (member.path, final.path):
                shown.setdefault(known, (member.path, final))
    return shown


def modules(module: griffe.Module) -> Iterator[griffe.Module]:
    yield module
    for member in module.members.values():
        if not member.is_alias and member.is_module:
            yield from modules(member)


def in_markdown(text: str, thing: griffe.Object, shown: Places) -> str:
    text = MATH_BLOCK.sub(math_fence, text)
    text = SECTION.sub(section, text)
    text = re.sub(r"^( *Keyword Args:)$", r"\1 Keyword arguments:", text, flags=re.MULTILINE)
    text = MATH.sub(lambda found: "`#!math " + " ".join(found[1].split()) + "`", text)
    text = ROLE.sub(lambda found: link(found[2], bool(found[1]), thing, shown), text)
    return "".join(map(without_emphasis, text.splitlines(keepends=True)))


def without_emphasis(line: str) -> str:
    """Shapes such as [*, n] are no emphasis; code stays as it is."""
    if line.lstrip().startswith((">>>", "...")):
        return line
    parts = CODE.split(line)
    parts[::2] = [part.replace("[*", r"[\*") for part in parts[::2]]
    return "".join(parts)


def math_fence(found: re.Match) -> str:
    lines = "\n".join(line.strip() for line in found[2].strip().splitlines())
    return indent(f"\n```math\n{lines}\n```\n\n", found[1])


def section(found: re.Match) -> str:
    """A section of this project as paragraphs or a box of its own."""
    margin, name, body = found.groups()
    first, _, rest = body.partition("\n")
    text = LIST.sub(r"\1\n\n\2", f"{first}\n{dedent(rest)}".strip())
    if name == "Deviates":
        text = indent(text[:1].upper() + text[1:], " " * 4)
        return indent(f'!!! deviates "Deviates from the paper"\n{text}', margin)
    return indent(f"**{name}:**" + ("\n\n" if text.startswith("- ") else " ") + text, margin)


def link(target: str, brief: bool, thing: griffe.Object, shown: Places) -> str:
    text = f"`{target.rpartition('.')[2] if brief else target}`"
    scope = thing
    while scope is not None:
        where = place(f"{scope.path}.{target}", shown)
        if where:
            return f"[{text}][{where}]"
        scope = scope.parent
    where = place(target, shown)
    return f"[{text}][{where}]" if where else text


def place(path: str, shown: Places) -> str | None:
    """Where ``path`` is shown; a method that is not, at its class."""
    if path in shown:
        return shown[path][0]
    owner, _, name = path.rpartition(".")
    if owner not in shown:
        return None
    where, final = shown[owner]
    if name not in final.all_members if final.is_class else name not in final.members:
        return None
    member = final.members.get(name)
    return f"{where}.{name}" if member is not None and member.docstring else where
