"""The figures of the nodes: learned parameters, links and health."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from relpos.evaluation.health import SERIES
from relpos.evaluation.report.content import Content
from relpos.evaluation.report.drawing import Picture
from relpos.evaluation.style import (
    BAD,
    FAIR,
    GOOD,
    INK,
    of_node,
)
from relpos.nodes.health import (
    BATTERY_YELLOW_V,
    LOSS_YELLOW,
    RANGING_YELLOW,
    RSSI_YELLOW_DBM,
    Health,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MOST_BANDS = 6
"""Bands of more nodes than this would only cover each other."""


TEAM_WIDE = (
    "detection_range_m", "body_shadow_m", "range_growth_m", "range_scale", "range_lateness_s",
)  # fmt: skip
"""Parameters of the whole team, though they are reported for each node."""

NOT_LEARNED = "range_scale"
"""It is 1 all the time, and has a deviation alone."""


_PARAMETER_WORDS: Mapping[str, tuple[str, float]] = {
    "step_scale": ("step scale\n(true over reported)", 1.0),
    "heading_drift_rad_s": ("heading drift (deg/s)", math.degrees(1.0)),
    "detection_range_m": ("detection range (m)", 1.0),
    "body_shadow_m": ("body shadow (m)", 1.0),
    "range_growth_m": ("growth of ranges (m)", 1.0),
    "range_lateness_s": ("ranges dated late (s)", 1.0),
    "clock_offset_s": ("clock ahead (s)", 1.0),
    "antenna_delay_m": ("antenna delay (m)", 1.0),
}


def parameters(content: Content) -> Picture | None:
    """Draw the learned parameters over time, range biases apart."""
    rows: dict[str, dict[int, list[tuple[float, float, float]]]] = {}
    for p in content.result.parameters:
        if p.peer is None and p.name != NOT_LEARNED:
            of_name = rows.setdefault(p.name, {})
            of_name.setdefault(p.node, []).append((p.time_s, p.value, p.sigma))
    if not rows:
        return None
    for name in rows:
        if name in TEAM_WIDE:
            rows[name] = dict([next(iter(rows[name].items()))])
    places = {node: k for k, node in enumerate(content.nodes)}

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(rows), 1, squeeze=False, sharex=True)[:, 0]
        for axes, (name, nodes) in zip(panels, rows.items(), strict=True):
            label, factor = _PARAMETER_WORDS.get(name, (name, 1.0))
            for node, values in nodes.items():
                time_s, value, sigma = np.array(values).T
                team = name in TEAM_WIDE
                colour, line = (INK, "-") if team else of_node(places.get(node, 0))
                if len(nodes) <= MOST_BANDS:
                    axes.fill_between(
                        time_s, factor * (value - sigma), factor * (value + sigma), step="post",
                        color=colour, alpha=0.1, linewidth=0,
                    )  # fmt: skip
                axes.plot(
                    time_s, factor * value, color=colour, linestyle=line, drawstyle="steps-post",
                    linewidth=1.3, label=None if team else content.name(node),
                )  # fmt: skip
            middle = np.concatenate([factor * np.array(v)[:, 1] for v in nodes.values()])
            low, high = np.quantile(middle, [0.01, 0.99])
            room = 0.5 * (high - low) + 0.05 * max(abs(low), abs(high), 1e-3)
            axes.set_ylim(low - room, high + room)
            axes.set_ylabel(label)
        longest = max(panels, key=lambda a: len(a.get_legend_handles_labels()[1]))
        handles, labels = longest.get_legend_handles_labels()
        if labels:
            figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
        panels[-1].set_xlabel("time (s)")

    return Picture(
        "parameters",
        "What was learned",
        "Constants that the estimator learned as it went, with one standard deviation.",
        "Learned " + ", ".join(name.replace("_", " ") for name in rows) + " over time.",
        draw,
        (9.6, 0.9 + 1.9 * len(rows)),
    )


_HEALTH_WORDS: Mapping[str, tuple[str, float | None]] = {
    "battery_v": ("supply (V)", BATTERY_YELLOW_V),
    "rssi_dbm": ("radio (dBm)", RSSI_YELLOW_DBM),
    "loss": ("frames lost, of 30 s", LOSS_YELLOW),
    "ranging": ("rangings that\nsucceed, of 30 s", RANGING_YELLOW),
}


def health(content: Content) -> Picture | None:
    """Draw the health of nodes and links."""
    nodes = content.health
    shown = [
        name
        for name in SERIES
        if any(np.isfinite(one.series[name]).any() for one in nodes.values())
    ]
    reported = any(one.time_s.size for one in nodes.values())
    silent = any(one.silences for one in nodes.values())
    if not reported and not silent:
        return None
    places = {node: k for k, node in enumerate(content.nodes)}
    last_s = max(
        [m.time_s for m in content.run.measurements[-1:]]
        + [float(one.time_s[-1]) for one in nodes.values() if one.time_s.size],
        default=0.0,
    )

    def draw(figure: Figure) -> None:
        heights = [0.28 * max(len(nodes), 2) + 0.4] + [1.3] * len(shown)
        panels = figure.subplots(
            len(heights), 1, squeeze=False, sharex=True, height_ratios=heights
        )[:, 0]
        _draw_colours(panels[0], content, last_s)
        for axes, name in zip(panels[1:], shown, strict=True):
            label, limit = _HEALTH_WORDS[name]
            for node, one in nodes.items():
                colour, line = of_node(places.get(node, 0))
                axes.plot(
                    one.time_s, one.series[name], color=colour, linestyle=line, marker=".",
                    markersize=3, linewidth=1.1, label=content.name(node),
                )  # fmt: skip
            if limit is not None:
                low, high = axes.get_ylim()
                if low <= limit <= high:
                    axes.axhline(limit, color=BAD, linewidth=0.9, linestyle=":")
            if name in ("loss", "ranging"):
                axes.set_ylim(0.0, min(1.02, max(axes.get_ylim()[1], 0.1)))
            axes.set_ylabel(label)
        if shown:
            handles, labels = panels[1].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
        panels[-1].set_xlabel("time (s)")

    restarts = sum(len(one.restarts) for one in nodes.values())
    silences = sum(len(one.silences) for one in nodes.values())
    return Picture(
        "health",
        "Links and nodes",
        "Top: each node's colour, by the rules of the live table, from its status reports; ▲ a "
        "restart, hatched: no motion heard for more than 5 s. Dotted: where it becomes yellow. "
        f"{restarts} restart{'s' * (restarts != 1)}, {silences} silence{'s' * (silences != 1)}.",
        f"Health of {len(nodes)} nodes over time: {restarts} restarts, {silences} silences.",
        draw,
        (9.6, 1.2 + 0.28 * max(len(nodes), 2) + 1.45 * len(shown)),
    )


def _draw_colours(axes: Axes, content: Content, last_s: float) -> None:
    from matplotlib.patches import Patch

    words = {Health.GREEN: ("well", GOOD), Health.YELLOW: ("less than it should have", FAIR),
             Health.RED: ("not usable, or about to fall silent", BAD)}  # fmt: skip
    used: dict[Health, None] = {}
    for row, one in enumerate(content.health.values()):
        ends = np.append(one.time_s, last_s)[1:]
        for begin, end, colour in zip(one.time_s, ends, one.colour, strict=True):
            # One report a ten seconds: after a longer silence nothing is known of it.
            end = min(end, begin + 15.0)
            axes.broken_barh(
                [(begin, end - begin)], (row - 0.36, 0.72), facecolors=words[Health(colour)][1],
                linewidth=0,
            )  # fmt: skip
            used[Health(colour)] = None
        for begin, end in one.silences:
            axes.broken_barh(
                [(begin, end - begin)], (row - 0.36, 0.72), facecolors="none", edgecolor=INK,
                hatch="////", linewidth=0.6,
            )  # fmt: skip
        if one.restarts:
            axes.plot(
                [t for t, _ in one.restarts], [row] * len(one.restarts), "^", color=INK,
                markersize=6, zorder=4,
            )  # fmt: skip
    names = [content.name(node) for node in content.health]
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    if used:
        axes.legend(
            [Patch(color=words[one][1]) for one in sorted(used)],
            [words[one][0] for one in sorted(used)],
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, borderaxespad=0.2,
        )  # fmt: skip
