"""Colours and lines of figures, distinct for any colour vision, in light and in dark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Distinguishable with any colour vision (Okabe and Ito 2008), darkest first."""

INK, GREY = "#222222", "#8C8C8C"
GRID, TRUTH, PAPER = "#DDDDDD", "#CFCFCF", "#FFFFFF"
MARKERS = ("o", "s", "^", "D", "v", "P")
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (1, 1)))
"""Curves differ in mark and line, too: not by colour alone."""

FUSED, DEAD_RECKONING, MEASURED = COLOURS[0], COLOURS[1], COLOURS[4]

NODE_COLOURS = (*COLOURS[:3], COLOURS[3], COLOURS[4], COLOURS[5], "#111111")
NODE_LINES = DASHES[:4]

GOOD, FAIR, BAD = "#2E9E5B", "#E6B800", "#D7263D"
"""Green, yellow and red of a node's health; their words stand beside them."""

STYLE: dict[Any, Any] = {
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "axes.titlecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "axes.titlesize": 11,
    "svg.fonttype": "none",
    "svg.hashsalt": "relpos",
    "figure.dpi": 100,
}

DARK: Mapping[str, str] = {
    INK: "#E6E6E6",
    GREY: "#A0A6AD",
    GRID: "#343A41",
    TRUTH: "#565D66",
    PAPER: "#14181C",
    COLOURS[0]: "#55AEE6",
    COLOURS[1]: "#F08A4B",
    COLOURS[2]: "#35C99C",
    COLOURS[3]: "#E3A3C7",
    COLOURS[4]: "#F2BC4B",
    COLOURS[5]: "#8FD1F7",
    "#111111": "#F5F5F5",
    GOOD: "#46B877",
    FAIR: "#E9C645",
    BAD: "#F0596B",
}
"""Every colour of a figure -> what takes its place on dark paper."""


def of_node(place: int) -> tuple[str, Any]:
    """Colour and line of the node at a place in the order of the ids."""
    count = len(NODE_COLOURS)
    return NODE_COLOURS[place % count], NODE_LINES[(place // count) % len(NODE_LINES)]
