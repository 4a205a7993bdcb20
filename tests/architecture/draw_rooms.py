"""Draws the rooms and their imports: python tests/architecture/draw_rooms.py, or make docs.

A room stands above every room that it imports. Arrows that follow from others are left out: where
a room imports another both directly and by way of a third, only the latter is drawn. Rooms that
hardly do anything by themselves (``EVERYWHERE``) are left out, too.
"""

from __future__ import annotations

from rooms import ROOT, Edges, imports_between_rooms

PICTURE = ROOT / "docs" / "images" / "rooms.svg"
BOX, GAP_X, GAP_Y, MARGIN = (146, 34), 34, 46, 20
EVERYWHERE = {"errors", "extras", "files", "paths", "version"}


def floors(edges: Edges) -> list[list[str]]:
    """Rooms by floor: 0 holds those that import none, the next those that import floor 0, ..."""
    floor: dict[str, int] = {}

    def of(room: str) -> int:
        if room not in floor:
            floor[room] = 1 + max((of(other) for other in edges[room]), default=-1)
        return floor[room]

    top = max(map(of, edges))
    return [sorted(room for room in edges if floor[room] == k) for k in range(top + 1)]


def reduced(edges: Edges) -> Edges:
    """Leave out each import that another path implies."""

    def reach(room: str) -> set[str]:
        return edges[room].union(*(reach(other) for other in edges[room]))

    return {
        room: {o for o in others if not any(o in reach(p) for p in others if p != o)}
        for room, others in edges.items()
    }


def svg(edges: Edges) -> str:
    """The picture as text."""
    rows = floors(edges)
    wide, high = BOX
    widest = max(map(len, rows))
    width = 2 * MARGIN + widest * wide + (widest - 1) * GAP_X
    height = 2 * MARGIN + len(rows) * high + (len(rows) - 1) * GAP_Y
    corner: dict[str, tuple[float, float]] = {}
    arrows = reduced(edges)
    for k, row in reversed(list(enumerate(rows))):
        # Each room as near as possible below those that import it: fewer arrows cross.
        def above(room: str) -> float:
            importers = [corner[r][0] for r in corner if room in arrows[r]]
            return sum(importers) / len(importers) if importers else 0.0

        left = (width - len(row) * wide - (len(row) - 1) * GAP_X) / 2
        y = height - MARGIN - high - k * (high + GAP_Y)
        for n, room in enumerate(sorted(row, key=above)):
            corner[room] = (left + n * (wide + GAP_X), y)
    lines = []
    for room in sorted(arrows):
        for other in sorted(arrows[room]):
            (x, y), (to_x, to_y) = corner[room], corner[other]
            lines.append(
                f'<path d="M{x + wide / 2:.0f} {y + high:.0f} C{x + wide / 2:.0f} '
                f"{y + high + GAP_Y * 0.7:.0f} {to_x + wide / 2:.0f} {to_y - GAP_Y * 0.7:.0f} "
                f'{to_x + wide / 2:.0f} {to_y - 2:.0f}"/>'
            )
    boxes = [
        f'<rect x="{x:.0f}" y="{y:.0f}" width="{wide}" height="{high}" rx="5"/>'
        f'<text x="{x + wide / 2:.0f}" y="{y + high / 2 + 4:.0f}">{room}</text>'
        for room, (x, y) in sorted(corner.items())
    ]
    style = (
        "path{fill:none;stroke:#7a8794;stroke-width:1.1;marker-end:url(#a)}"
        "rect{fill:#f4f7fa;stroke:#33475b}"
        "text{font:11px sans-serif;fill:#12202e;text-anchor:middle}"
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
            '<title>Rooms of the package; an arrow leads to what a room imports</title>',
            '<defs><marker id="a" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
            'markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" '
            'style="fill:#7a8794;stroke:none"/></marker></defs>',
            f"<style>{style}</style>",
            '<rect width="100%" height="100%" style="fill:#fff;stroke:none"/>',
            *lines,
            *boxes,
            "</svg>",
            "",
        ]
    )  # fmt: skip


def picture() -> str:
    """The picture of today's imports."""
    edges = imports_between_rooms()
    return svg({r: others - EVERYWHERE for r, others in edges.items() if r not in EVERYWHERE})


if __name__ == "__main__":
    PICTURE.write_text(picture())
    print(f"wrote {PICTURE.relative_to(ROOT)}")
