"""The figures of positions: tracks on a map, a section through the building, height over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from relpos.evaluation.report.content import Content, alignment
from relpos.evaluation.report.drawing import Picture, broken_at_gaps
from relpos.evaluation.style import (
    GREY,
    PAPER,
    TRUTH,
    of_node,
)
from relpos.fusion.estimator import NodeStatus
from relpos.tracks import MAX_GAP_S, Track, Tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = npt.NDArray[np.float64]


def tracks(content: Content) -> Picture | None:
    """Draw the tracks on a map: truth, dead reckoning, fusion."""
    fused = {node: t for node, t in content.guessed.items() if np.isfinite(t.x_m).any()}
    if not fused:
        return None
    located = any(np.isfinite(t.x_m).any() for t in content.fused.values())
    ours = content.fused if located else content.guessed
    shown: list[tuple[str, Tracks]] = [(content.result.estimator, ours)]
    if content.baseline is not None:
        shown.insert(0, ("dead reckoning", content.baseline.tracks))
    true = bool(content.truth)
    moved = {name: _moved(ways, content.truth if true else content.guessed) for name, ways in shown}
    extent = {name: _extent([*moved[name].values(), *_points(content.truth)]) for name, _ in shown}
    # A map that dead reckoning has blown up must not shrink the other to a dot.
    share = max(size for _, size in extent.values()) < 3.0 * min(
        size for _, size in extent.values()
    )
    aspect = float(np.median([ratio for ratio, _ in extent.values()]))
    width_in = min(max(5.0 * aspect, 3.8), 6.4)
    height_in = min(max(width_in / aspect, 2.2), 5.0) + 0.9

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(shown), squeeze=False, sharex=share, sharey=share)[0]
        for axes, (name, _) in zip(panels, shown, strict=True):
            _draw_tracks(axes, content, moved[name], ellipses=name != "dead reckoning")
            axes.set_title(name)
            axes.set_xlabel("x (m)")
        panels[0].set_ylabel("y (m)")
        handles, labels = panels[-1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))

    frame = (
        "Each estimate is moved as a whole (turned and shifted by one rigid motion for the run, "
        "never mirrored) onto the truth, which is the wide grey line."
        if true
        else "No truth: the picture is in the estimate's own frame, and may be turned and shifted "
        "as a whole."
    )
    nodes = ", ".join(content.name(node) for node in content.nodes)
    return Picture(
        "tracks",
        "Tracks",
        f"{frame} Dots mark the end, rings the true end, ellipses two sigmas of it relative to the "
        "frame. "
        + (
            "A node is left out while it was not located."
            if located
            else "No node was located: each track begins at its own origin."
        ),
        f"Map of the ways of {nodes}"
        + (", dead reckoning beside the fusion" if len(shown) > 1 else "")
        + (", on the true ways." if true else "."),
        draw,
        (width_in * len(shown) + 0.4, height_in),
    )


def _draw_tracks(
    axes: Axes, content: Content, moved: Mapping[int, Floats], *, ellipses: bool
) -> None:
    from matplotlib.patches import Ellipse

    for k, node in enumerate(content.nodes):
        colour, line = of_node(k)
        true = content.truth.get(node)
        if true is not None:
            label = "truth" if node == min(content.truth) else None
            x, y = broken_at_gaps(true.time_s, true.x_m, true.y_m)
            axes.plot(
                x, y, color=TRUTH, linewidth=5.0, solid_capstyle="round", zorder=1, label=label
            )
            alone = _alone(true)
            if alone.any():
                axes.plot(
                    true.x_m[alone], true.y_m[alone], "+", color=GREY, markersize=9, zorder=1.2
                )
            axes.plot(
                true.x_m[-1], true.y_m[-1], "o", color=colour, markerfacecolor=PAPER,
                markersize=6, zorder=3,
            )  # fmt: skip
        if node not in moved:
            continue
        x_m, y_m = moved[node].T
        axes.plot(
            x_m, y_m, color=colour, linestyle=line, linewidth=1.1, alpha=0.9,
            label=content.name(node), zorder=2,
        )  # fmt: skip
        there = np.flatnonzero(np.isfinite(x_m))
        if there.size:
            axes.plot(x_m[there[-1]], y_m[there[-1]], "o", color=colour, markersize=6, zorder=4)
    if ellipses and content.result.estimates:
        turn = alignment(content.fused, content.truth) if content.truth else None
        # A wide ellipse must not shrink the tracks.
        limits = axes.get_xlim(), axes.get_ylim()
        for k, node in enumerate(content.nodes):
            last = next((n for n in content.result.estimates[-1].nodes if n.node == node), None)
            if last is None or last.status is NodeStatus.UNLOCATED:
                continue
            at = np.array([[last.x_m, last.y_m]])
            angle = last.sigma_angle_rad
            if turn is not None:
                at, angle = turn(at), angle + turn.angle_rad
            sizes = 4.0 * last.sigma_major_m, 4.0 * last.sigma_minor_m
            if all(map(math.isfinite, (*at[0], *sizes, angle))):
                axes.add_patch(
                    Ellipse(
                        (at[0, 0], at[0, 1]),
                        *sizes,
                        angle=math.degrees(angle),
                        fill=False,
                        edgecolor=of_node(k)[0],
                        linewidth=1.0,
                        zorder=3.5,
                    )
                )
        axes.set(xlim=limits[0], ylim=limits[1])
    axes.set_aspect("equal", adjustable="box")


def heights(content: Content) -> Picture | None:
    """Draw the height of every node, in a building with floors over the start's floor."""
    known = {n: t for n, t in content.guessed.items() if np.isfinite(t.z_m).any()}
    if not known:
        return None
    places = {node: k for k, node in enumerate(content.nodes)}
    floors = bool(content.run.description.floors_m)

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for node, track in known.items():
            colour, line = of_node(places[node])
            there = np.isfinite(track.z_m)
            first_s = track.time_s[there][0]
            true = content.truth.get(node)
            if true is not None and (seen := np.isfinite(true.z_m)).any():
                start_m = np.interp(first_s, true.time_s[seen], true.z_m[seen])
                x, y = broken_at_gaps(true.time_s, true.z_m - (0.0 if floors else start_m))
                axes.plot(
                    x, y, color=TRUTH, linewidth=3.5, zorder=1,
                    label="truth" if node == min(known) else None,
                )  # fmt: skip
            x, y = broken_at_gaps(track.time_s[there], track.z_m[there])
            axes.plot(x, y, color=colour, linestyle=line, linewidth=1.1, label=content.name(node))
        axes.set(xlabel="time (s)", ylabel="height over the start (m)")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))

    return Picture(
        "height",
        "Height",
        f"Estimated height of every node over {'the' if floors else 'its own'} start, from "
        "pressure.",
        f"Height over time of {len(known)} nodes.",
        draw,
        (9.6, 3.2),
    )


STOREYS_M = 2.0
"""A section is drawn where somebody's height changes by more."""


def section(content: Content) -> Picture | None:
    """Draw the building from the side: height over the place along the longer side."""
    seen = {n: t for n, t in content.fused.items() if np.isfinite(t.x_m + t.z_m).any()}
    if not any(np.ptp(t.z_m[np.isfinite(t.z_m)]) > STOREYS_M for t in seen.values()):
        return None
    onto = content.truth or seen
    moving = alignment(seen, onto)
    true = {n: t for n, t in content.truth.items() if np.isfinite(t.z_m).any()}
    points = np.concatenate([p[np.isfinite(p).all(axis=1)] for p in _points(onto)])
    _, axes_m = np.linalg.eigh(np.cov(points.T))
    # From left to right as on the map.
    side = axes_m[:, -1] * (1.0 if axes_m[0, -1] >= 0.0 else -1.0)
    floors_m = content.run.description.floors_m
    places = {node: k for k, node in enumerate(content.nodes)}

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        _draw_floors(axes, floors_m)
        for node, track in true.items():
            along = np.column_stack((track.x_m, track.y_m)) @ side
            x, y = broken_at_gaps(track.time_s, along, track.z_m)
            label = "truth" if node == min(true) else None
            axes.plot(x, y, color=TRUTH, linewidth=4.0, zorder=1, label=label)
        for node, track in seen.items():
            colour, line = of_node(places[node])
            along = moving(np.column_stack((track.x_m, track.y_m))) @ side
            x, y = broken_at_gaps(track.time_s, along, track.z_m)
            axes.plot(
                x, y, color=colour, linestyle=line, linewidth=0.9, alpha=0.8,
                label=content.name(node),
            )  # fmt: skip
            last = np.flatnonzero(np.isfinite(along + track.z_m))
            if last.size:
                axes.plot(along[last[-1]], track.z_m[last[-1]], "o", color=colour, markersize=5)
        axes.set(xlabel="along the longer side (m)", ylabel="height over the start (m)")
        axes.legend(loc="center left", bbox_to_anchor=(1.05, 0.5))

    return Picture(
        "section",
        "Section",
        "From the side: estimated height over the place along the longer side. Dots mark the end"
        + (", grey lines the truth" if true else "")
        + (", dotted ones the floors." if floors_m else "."),
        f"Side view of the ways of {len(seen)} people through the building.",
        draw,
        (9.6, 4.2),
    )


def _draw_floors(axes: Axes, floors_m: Sequence[float]) -> None:
    """Draw the true floors of a simulated building, numbered from the start's."""
    for floor_m in floors_m:
        axes.axhline(floor_m, color=GREY, linewidth=0.7, linestyle=":", zorder=0.5)
        number = list(floors_m).index(floor_m) - list(floors_m).index(0.0)
        axes.annotate(
            f"floor {number}", (1.0, floor_m), xycoords=("axes fraction", "data"),
            xytext=(3, 0), textcoords="offset points", va="center", fontsize=8, color=GREY,
        )  # fmt: skip


def _moved(ways: Tracks, onto: Tracks) -> dict[int, Floats]:
    """Whole tracks (n, 2), gaps as NaN, moved by the one rigid motion that fits best."""
    moving = alignment(ways, onto)
    return {
        node: moving(np.column_stack(broken_at_gaps(track.time_s, track.x_m, track.y_m)))
        for node, track in ways.items()
    }


def _points(ways: Tracks) -> list[Floats]:
    return [np.column_stack((t.x_m, t.y_m)) for t in ways.values()]


def _extent(ways: Sequence[Floats]) -> tuple[float, float]:
    """Width over depth of a map, and its larger side (m)."""
    points = np.concatenate([*ways, np.zeros((0, 2))])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return 1.0, 1.0
    width, depth = np.ptp(points, axis=0) + 1.0
    return float(width / depth), float(max(width, depth))


def _alone(track: Track) -> npt.NDArray[np.bool_]:
    """Return which rows no line joins to another."""
    apart = np.diff(track.time_s, prepend=-math.inf, append=math.inf) > MAX_GAP_S
    result: npt.NDArray[np.bool_] = apart[:-1] & apart[1:]
    return result
