"""How much a reader must hold in mind at once: files, functions, signatures."""

import ast
import tomllib
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from rooms import PACKAGE

LONGEST_FILE = 600
LONGEST_FUNCTION = 90
MOST_PARAMETERS = 8

EXCEPTIONS = tomllib.loads((Path(__file__).parent / "exceptions.toml").read_text())
FILES = {file.relative_to(PACKAGE).as_posix(): file for file in sorted(PACKAGE.rglob("*.py"))}


def functions(file: Path) -> list[tuple[str, int, int]]:
    """Name, lines and parameters (without self and cls) of every function of a file."""
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            a = node.args
            named = [p.arg for p in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
            count = len(named) - (named[:1] in (["self"], ["cls"]))
            count += (a.vararg is not None) + (a.kwarg is not None)
            found.append((node.name, (node.end_lineno or 0) - node.lineno + 1, count))
    return found


@cache
def too_much() -> dict[str, set[str]]:
    found: dict[str, set[str]] = {"files": set(), "functions": set(), "signatures": set()}
    for name, file in FILES.items():
        if len(file.read_text().splitlines()) > LONGEST_FILE:
            found["files"].add(name)
        for function, lines, parameters in functions(file):
            if lines > LONGEST_FUNCTION:
                found["functions"].add(f"{name}:{function}")
            if parameters > MOST_PARAMETERS:
                found["signatures"].add(f"{name}:{function}")
    return found


@pytest.mark.parametrize("what", ["files", "functions", "signatures"])
def test_nothing_is_longer_than_a_reader_can_hold_but_what_is_listed_with_a_reason(what):
    assert too_much()[what] == set(EXCEPTIONS[what])
    assert all(len(reason.split()) > 2 for reason in EXCEPTIONS[what].values())


def test_every_test_file_has_a_name_of_its_own():
    # pytest imports them by their names alone: of two that are alike one is not collected.
    names = Counter(path.name for path in Path(__file__).parents[1].rglob("test_*.py"))
    assert not [name for name, times in names.items() if times > 1]
