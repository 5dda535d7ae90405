"""Two metrics of the code: the longest call chain to an equation, and settings checked twice.

    python studies/code_metrics.py CHECKOUT chain env=overactuated experiment=smoke run_dir=FOLDER
    python studies/code_metrics.py CHECKOUT checks

A chain consists of the package's functions from the run down to a function of ``functional/`` that
a loss calls. Suspended generators, in which a run pauses for an update, count too. Checks are
compared by name: settings checked in ``training/config.py``, and arguments checked in other files.
Coincidental matches count, so the second number is an upper bound.
"""

from __future__ import annotations

import argparse
import ast
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType, GeneratorType

CENTRAL = "training/config.py"
TABLES = ("_RULES", "_CHOICES")


def longest_chain(package: Path, recipe: Path, overrides: list[str]) -> list[str]:
    longest: list[str] = []

    def name(code: CodeType) -> str:
        return f"{Path(code.co_filename).relative_to(package)} {code.co_qualname}"

    def waiting(frame: FrameType) -> Iterator[CodeType]:
        """Suspended generators in a frame's local variables, each followed by its sub-generator."""
        for value in frame.f_locals.values():
            while isinstance(value, GeneratorType) and value.gi_frame is not None:
                yield value.gi_code
                value = value.gi_yieldfrom

    def look(frame: FrameType | None, event: str, _: object) -> None:
        nonlocal longest
        if event != "call" or not Path(frame.f_code.co_filename).is_relative_to(equations):
            return
        frames: list[FrameType] = []
        while frame is not None:
            frames.insert(0, frame)
            frame = frame.f_back
        codes = [code for each in frames for code in (each.f_code, *waiting(each))]
        chain = [name(code) for code in codes if code.co_filename.startswith(f"{package}/")]
        if any(link.startswith("objectives/") for link in chain) and len(chain) > len(longest):
            longest = chain

    equations = package / "functional"
    sys.argv = [str(recipe), *overrides]
    sys.setprofile(look)
    try:
        runpy.run_path(str(recipe), run_name="__main__")
    finally:
        sys.setprofile(None)
    return longest


def checked_centrally(tree: ast.AST) -> set[str]:
    """Names of settings in tables of rules, in loops and in calls of checks."""
    where: list[ast.expr] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(getattr(target, "id", None) in TABLES for target in targets):
                where += node.value.keys if isinstance(node.value, ast.Dict) else [node.value]
        elif isinstance(node, ast.For):
            where.append(node.iter)
        elif isinstance(node, ast.Call) and called(node) == "of":
            where += node.args
        elif isinstance(node, ast.Call) and called(node).startswith("check_"):
            where += node.args[:1]
    parts = (part for each in where if each is not None for part in ast.walk(each))
    texts = (str(part.value) for part in parts if isinstance(part, ast.Constant))
    return {text.rpartition(".")[2] for text in texts if re.fullmatch(r"[a-z_.]*[a-z_]", text)}


def checked(tree: ast.AST) -> set[str]:
    """Names in calls of checks and in conditions that raise."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and called(node).startswith("check_"):
            found |= {keyword.arg for keyword in node.keywords if keyword.arg}
            found |= {str(each.value) for each in node.args if isinstance(each, ast.Constant)}
        elif isinstance(node, ast.If) and any(isinstance(each, ast.Raise) for each in node.body):
            found |= {each.id for each in ast.walk(node.test) if isinstance(each, ast.Name)}
            found |= {each.attr for each in ast.walk(node.test) if isinstance(each, ast.Attribute)}
    return found


def called(node: ast.Call) -> str:
    return getattr(node.func, "id", getattr(node.func, "attr", ""))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkout", type=Path, help="folder that holds torchrl_etl")
    parser.add_argument("metric", choices=("chain", "checks"))
    parser.add_argument("overrides", nargs="*", help="settings of recipes/etl_sac.py, for chain")
    arguments = parser.parse_args()
    checkout = arguments.checkout.resolve()
    package = checkout / "torchrl_etl"
    if arguments.metric == "chain":
        sys.path.insert(0, str(checkout))
        recipe = checkout / "recipes" / "etl_sac.py"
        chain = longest_chain(package, recipe, arguments.overrides)
        print(*chain, f"{len(chain)} functions", sep="\n")
        return
    central = package / CENTRAL
    settings = checked_centrally(ast.parse(central.read_text("utf-8")))
    others = (file for file in package.rglob("*.py") if file != central)
    elsewhere = set().union(*(checked(ast.parse(file.read_text("utf-8"))) for file in others))
    print(*sorted(settings & elsewhere), sep="\n")
    print(f"{len(settings)} settings, {len(settings & elsewhere)} of these names elsewhere too")


if __name__ == "__main__":
    main()
