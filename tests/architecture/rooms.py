"""The rooms of the package, their imports, and the table of those that are allowed."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import grimp
import scipy

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "host" / "relpos"
PAGE = ROOT / "docs" / "architecture.md"

Edges = dict[str, set[str]]


@cache
def graph() -> grimp.ImportGraph:
    """Every import of the package, also those inside functions and for type checkers."""
    return grimp.build_graph("relpos", include_external_packages=True, cache_dir=None)


def modules() -> list[str]:
    return sorted(m for m in graph().modules if m == "relpos" or m.startswith("relpos."))


@cache
def file_of(module: str) -> Path:
    path = PACKAGE.joinpath(*module.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def room_of(module: str) -> str:
    """The room that a module stands in: its folder, or the file itself.

    The files in ``fusion`` and its ``models`` are the common ground of the estimators; what joins
    them (``fusion/__init__.py``, ``switching.py``) is a room above them.
    """
    parts = module.split(".")[1:]
    if not parts:
        return "relpos"
    if parts[0] != "fusion":
        return parts[0]
    if parts == ["fusion"] or parts[1] in JOINS:
        return "fusion: registry"
    if (PACKAGE / "fusion" / parts[1]).is_dir() and parts[1] != "models":
        return f"fusion.{parts[1]}"
    return "fusion: common ground"


JOINS = ("switching",)


def imports_between_rooms() -> Edges:
    """Room -> the other rooms that it imports."""
    edges: Edges = {room_of(m): set() for m in modules()}
    for module in modules():
        for imported in graph().find_modules_directly_imported_by(module):
            if imported.split(".")[0] == "relpos" and room_of(imported) != room_of(module):
                edges[room_of(module)].add(room_of(imported))
    return edges


def allowed() -> Edges:
    """Room -> rooms that it may import, as the table in docs/architecture.md says."""
    rows = re.findall(r"^\| `([^`]+)` \| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    return {room: set(re.findall(r"`([^`]+)`", words)) for room, words in rows}


def circles() -> list[list[str]]:
    """Groups of modules that import each other around a circle."""
    ours = set(modules())
    return circles_of({m: graph().find_modules_directly_imported_by(m) & ours for m in ours})


def circles_of(edges: Edges) -> list[list[str]]:
    """Groups of nodes of a directed graph each of which can be reached from the others."""
    names = sorted(edges)
    index = {name: k for k, name in enumerate(names)}
    matrix = scipy.sparse.lil_array((len(names), len(names)), dtype=bool)
    for name, others in edges.items():
        for other in others:
            matrix[index[name], index[other]] = True
    count, labels = scipy.sparse.csgraph.connected_components(matrix, connection="strong")
    groups = [[n for n in names if labels[index[n]] == k] for k in range(count)]
    return [group for group in groups if len(group) > 1]
