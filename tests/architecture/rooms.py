"""The rooms of the package, their imports, and the table of those that are allowed."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import grimp

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
    """The room a module stands in: its folder; of ``fusion``, the inner folder or the ground.

    Files directly in ``relpos`` are rooms of their own. ``fusion/__init__.py`` and ``switching.py``
    stand above the rooms of ``fusion``: they join them.
    """
    parts = module.split(".")[1:]
    if not parts:
        return "relpos"
    if parts[0] != "fusion":
        return parts[0]
    if parts == ["fusion"] or parts[1] in ABOVE:
        return "fusion (registry)"
    folder = (PACKAGE / "fusion" / parts[1]).is_dir()
    return f"fusion.{parts[1]}" if folder else "fusion (ground)"


ABOVE = ("switching",)


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
    edges = {
        m: [i for i in graph().find_modules_directly_imported_by(m) if i in set(modules())]
        for m in modules()
    }
    return [group for group in _strongly_connected(edges) if len(group) > 1]


def _strongly_connected(edges: dict[str, list[str]]) -> list[list[str]]:
    """Kosaraju's algorithm."""

    def visit(start: str, of: dict[str, list[str]], seen: set[str]) -> list[str]:
        order, stack = [], [(start, iter(of[start]))]
        seen.add(start)
        while stack:
            node, rest = stack[-1]
            following = next((n for n in rest if n not in seen), None)
            if following is None:
                stack.pop()
                order.append(node)
            else:
                seen.add(following)
                stack.append((following, iter(of[following])))
        return order

    seen: set[str] = set()
    order = [n for start in edges if start not in seen for n in visit(start, edges, seen)]
    back: dict[str, list[str]] = {m: [] for m in edges}
    for module, imported in edges.items():
        for i in imported:
            back[i].append(module)
    seen = set()
    return [sorted(visit(m, back, seen)) for m in reversed(order) if m not in seen]
