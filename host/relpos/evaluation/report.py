"""Pictures of how well a team was located, and one page that holds them all.

``write_report`` leaves ``tracks.png``, ``error.png``, ``distances.png`` and a self-contained
``index.html`` in a folder. Colours are Okabe and Ito's, which colour-blind people can tell apart
(https://jfly.uni-koeln.de/color/).
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from relpos.evaluation.metrics import (
    MAX_GAP_S,
    Alignment,
    Floats,
    Metrics,
    Pair,
    Pairs,
    PairTrack,
    Tracks,
    align,
    sample,
    whole_seconds,
)
from relpos.measurements import Range

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NODE_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
NODE_LINES = ("-", "--", "-.", ":")
TRUTH_COLOUR = "#cfcfcf"
FUSED_COLOUR = "#0072B2"
DEAD_RECKONING_COLOUR = "#D55E00"

MAX_DISTANCE_PANELS = 15
"""All pairs of six nodes; more would be too small to read."""


@dataclass(frozen=True)
class Content:
    """What a report is about. ``dead_reckoning`` and its score may be missing."""

    title: str
    subtitle: str
    truth: Tracks
    fused: Tracks
    metrics: Metrics
    dead_reckoning: Tracks = field(default_factory=dict)
    baseline: Metrics | None = None
    pairs: Pairs = field(default_factory=dict)
    ranges: Sequence[Range] = ()


def write_report(directory: Path | str, content: Content) -> Path:
    """Draw the pictures and write the page; return the page's path."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    pictures = {
        "tracks.png": (draw_tracks(content), _TRACKS_CAPTION),
        "error.png": (draw_error(content), _ERROR_CAPTION),
        "distances.png": (draw_distances(content), _distances_caption(content)),
    }
    sections: list[str] = []
    for name, (figure, caption) in pictures.items():
        path = directory / name
        # Without a date in it the same report is the same file.
        figure.savefig(path, dpi=130, bbox_inches="tight", metadata={"Software": None})
        embedded = base64.b64encode(path.read_bytes()).decode("ascii")
        sections.append(
            f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{embedded}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )
    page = directory / "index.html"
    page.write_text(_page(content, sections), encoding="utf-8")
    return page


def draw_tracks(content: Content) -> Figure:
    """Draw who walked where: truth against dead reckoning and against the fusion."""
    shown = [("fused", content.fused)]
    if content.dead_reckoning:
        shown.insert(0, ("dead reckoning", content.dead_reckoning))
    moved = {name: _onto_truth(tracks, content.truth) for name, tracks in shown}
    everywhere = [np.column_stack((t.x_m, t.y_m)) for t in content.truth.values()]
    everywhere += [points_m for tracks in moved.values() for points_m in tracks.values()]
    width_m, depth_m = np.ptp(_finite_rows(np.concatenate(everywhere)), axis=0) + 1.0
    height_in = 5.0
    width_in = min(max(height_in * width_m / depth_m, 3.6), 8.0)
    figure = _figure(width_in * len(shown) + 0.6, height_in + 0.9)
    panels = figure.subplots(1, len(shown), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (name, tracks) in zip(panels, moved.items(), strict=True):
        for k, node in enumerate(sorted(content.truth)):
            colour, line = _style(k)
            true = content.truth[node]
            axes.plot(
                *_broken_at_gaps(true.time_s, true.x_m, true.y_m),
                color=TRUTH_COLOUR,
                linewidth=5.0,
                solid_capstyle="round",
                zorder=1,
                label="truth" if k == 0 else None,
            )
            if node not in tracks:
                continue
            x_m, y_m = tracks[node].T
            axes.plot(
                x_m,
                y_m,
                color=colour,
                linestyle=line,
                linewidth=1.1,
                alpha=0.85,
                label=f"node {node}",
                zorder=2,
            )
            there = np.isfinite(x_m)
            if there.any():
                axes.plot(x_m[there][-1], y_m[there][-1], "o", color=colour, markersize=6, zorder=4)
                end_x, end_y = float(true.x_m[-1]), float(true.y_m[-1])
                axes.plot(
                    end_x, end_y, "o", color=colour, markerfacecolor="white", markersize=6, zorder=3
                )
        axes.set_aspect("equal", adjustable="box")
        axes.set_title(name)
        axes.set_xlabel("x (m)")
    panels[0].set_ylabel("y (m)")
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7))
    return figure


def draw_error(content: Content) -> Figure:
    """Draw the error of the team's distances, and of its shape, over time."""
    shape_known = bool(np.isfinite(content.metrics.position_rmse_over_time_m).any())
    figure = _figure(9.0, 5.6 if shape_known else 3.4)
    panels = figure.subplots(2 if shape_known else 1, 1, squeeze=False, sharex=True)[:, 0]
    scored: list[tuple[str, Metrics, str, str]] = [("fused", content.metrics, FUSED_COLOUR, "-")]
    if content.baseline is not None:
        scored.insert(0, ("dead reckoning", content.baseline, DEAD_RECKONING_COLOUR, "--"))
    for name, metrics, colour, line in scored:
        series = [
            (metrics.distance_rmse_over_time_m, metrics.relative_distance_rmse_m),
            (metrics.position_rmse_over_time_m, metrics.relative_position_rmse_m),
        ]
        for axes, (over_time_m, whole_m) in zip(panels, series, strict=False):
            axes.plot(
                *_broken_at_gaps(metrics.time_s, over_time_m),
                color=colour,
                linestyle=line,
                linewidth=1.5,
                label=f"{name}: {whole_m:.2f} m over the whole run",
            )
    for axes, words in zip(
        panels, ("relative distance,\nRMS over pairs (m)", "aligned position,\nRMS over nodes (m)"),
        strict=False,
    ):  # fmt: skip
        axes.set_ylabel(words)
        axes.set_ylim(bottom=0.0)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2)
    panels[-1].set_xlabel("time (s)")
    return figure


def draw_distances(content: Content) -> Figure:
    """Draw the distance of every pair: true, estimated with one sigma, and measured."""
    pairs = content.metrics.pair_ids[:MAX_DISTANCE_PANELS]
    columns = min(3, max(1, len(pairs)))
    rows = max(1, math.ceil(len(pairs) / columns))
    figure = _figure(max(7.0, 4.2 * columns), 0.8 + 2.1 * rows + (1.2 if rows == 1 else 0.0))
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for k, axes in enumerate(panels.flat):
        if k >= len(pairs):
            axes.set_visible(False)
            continue
        _draw_pair(axes, content, pairs[k], k)
        if k + columns >= len(pairs):
            axes.set_xlabel("time (s)")
            axes.xaxis.set_tick_params(labelbottom=True)
        if k % columns == 0:
            axes.set_ylabel("distance (m)")
    if pairs:
        panels.flat[0].set_ylim(bottom=0.0, top=_distance_limit(content))
        handles, labels = panels.flat[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _draw_pair(axes: Axes, content: Content, pair: Pair, place: int) -> None:
    metrics = content.metrics
    measured = [
        (r.time_s, r.range_m)
        for r in content.ranges
        if r.range_m > 0.0 and pair in ((r.node, r.peer), (r.peer, r.node))
    ]
    # An empty plot keeps the entry in the legend where the first pair was never measured.
    times, values = zip(*measured, strict=True) if measured else ((), ())
    axes.plot(times, values, ".", color="#E69F00", markersize=3.5, label="measured", zorder=1)
    axes.plot(
        *_broken_at_gaps(metrics.time_s, metrics.pair_true_distance_m[:, place]),
        color="black",
        linewidth=1.6,
        label="true",
        zorder=2,
    )
    track = content.pairs.get(pair) or content.pairs.get((pair[1], pair[0]))
    if track is not None:
        axes.fill_between(
            *_band(track), color=FUSED_COLOUR, alpha=0.2, linewidth=0, label="estimate ± 1 sigma"
        )
    axes.plot(
        *_broken_at_gaps(metrics.time_s, metrics.pair_distance_m[:, place]),
        color=FUSED_COLOUR,
        linewidth=1.3,
        label="estimated",
        zorder=3,
    )
    figures = metrics.pairs[pair]
    axes.set_title(f"{pair[0]} - {pair[1]}: RMSE {figures.distance_rmse_m:.2f} m", fontsize=10)


def _distance_limit(content: Content) -> float:
    """Return a top of the axis that shows the distances; a wild range may lie outside."""
    metrics = content.metrics
    shown = np.concatenate((metrics.pair_true_distance_m.ravel(), metrics.pair_distance_m.ravel()))
    shown = shown[np.isfinite(shown)]
    return float(shown.max()) * 1.15 + 0.5 if shown.size else 1.0


def _band(track: PairTrack) -> tuple[Floats, Floats, Floats]:
    low = np.maximum(track.distance_m - track.sigma_distance_m, 0.0)
    return track.time_s, low, track.distance_m + track.sigma_distance_m


def _finite_rows(points_m: Floats) -> Floats:
    finite = points_m[np.isfinite(points_m).all(axis=1)]
    return finite if len(finite) else np.zeros((1, 2))


def _onto_truth(tracks: Tracks, truth: Tracks) -> dict[int, Floats]:
    """Whole tracks (n, 2), gaps as NaN, moved by the one rigid motion that fits the truth best."""
    moving = _alignment(tracks, truth)
    result: dict[int, Floats] = {}
    for node, track in tracks.items():
        x_m, y_m = _broken_at_gaps(track.time_s, track.x_m, track.y_m)
        result[node] = moving(np.column_stack((x_m, y_m)))
    return result


def _alignment(tracks: Tracks, truth: Tracks) -> Alignment:
    nodes = sorted(set(tracks) & set(truth))
    at_s = whole_seconds([truth[node] for node in nodes])
    p, _ = sample([tracks[node] for node in nodes], at_s)
    q, _ = sample([truth[node] for node in nodes], at_s)
    p, q = p.reshape(-1, 2), q.reshape(-1, 2)
    both = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
    if not both.any():
        return Alignment(1.0, 0.0, np.zeros(2), np.zeros(2))
    return align(p[both], q[both])


def _broken_at_gaps(time_s: Floats, *values: Floats) -> tuple[Floats, ...]:
    """Insert NaN where rows are too far apart to be joined by a line.

    Returns the time and the one signal, or only the signals where there are two of them (a
    track's x and y).
    """
    order = np.argsort(time_s, kind="stable")
    after = np.flatnonzero(np.diff(time_s[order]) > MAX_GAP_S + 1e-6) + 1
    broken = tuple(np.insert(v[order].astype(float), after, np.nan) for v in (time_s, *values))
    return broken if len(values) == 1 else broken[1:]


def _style(place: int) -> tuple[str, str]:
    count = len(NODE_COLOURS)
    return NODE_COLOURS[place % count], NODE_LINES[(place // count) % len(NODE_LINES)]


def _figure(width_in: float, height_in: float) -> Figure:
    # The Figure class alone, without pyplot: no display, no global state.
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams.update(
        {
            "font.size": 10,
            "axes.grid": True,
            "grid.alpha": 0.25,
            "axes.axisbelow": True,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "legend.frameon": False,
        }
    )
    return Figure(figsize=(width_in, height_in), layout="constrained")


_TRACKS_CAPTION = (
    "Tracks. Wide grey: truth. Filled dot: estimated position at the end, open dot: the true one. "
    "Each estimate is moved as a whole (turned and shifted, never mirrored) onto the truth. "
    "A node is left out while it was not located."
)
_ERROR_CAPTION = "Error over time, fused against dead reckoning."


def _distances_caption(content: Content) -> str:
    more = len(content.metrics.pair_ids) - MAX_DISTANCE_PANELS
    rest = f" The other {more} pairs are in the table only." if more > 0 else ""
    return f"Distance of every pair: true, estimated with one standard deviation, measured.{rest}"


def _page(content: Content, sections: Sequence[str]) -> str:
    metrics, baseline = content.metrics, content.baseline
    head = "<tr><th></th><th>fused</th>"
    head += "<th>dead reckoning</th></tr>" if baseline else "</tr>"
    rows = [head]
    for words, name, unit in (
        ("relative distance RMSE", "relative_distance_rmse_m", " m"),
        ("aligned position RMSE", "relative_position_rmse_m", " m"),
        ("body-frame RMSE", "body_frame_rmse_m", " m"),
        ("NEES of the distance (1 is honest)", "nees_distance", ""),
    ):
        row = f"<tr><th>{words}</th><td>{_number(getattr(metrics, name), unit)}</td>"
        if baseline:
            row += f"<td>{_number(getattr(baseline, name), unit)}</td>"
        rows.append(row + "</tr>")
    pair_rows = [
        "<tr><th>pair</th><th>RMSE</th><th>mean error</th><th>largest error</th>"
        "<th>body frame</th><th>NEES</th>"
        + ("<th>dead reckoning RMSE</th></tr>" if baseline else "</tr>")
    ]
    for pair, figures in metrics.pairs.items():
        row = (
            f"<tr><th>{pair[0]} - {pair[1]}</th>"
            f"<td>{_number(figures.distance_rmse_m, ' m')}</td>"
            f"<td>{_number(figures.distance_error_mean_m, ' m')}</td>"
            f"<td>{_number(figures.distance_error_max_m, ' m')}</td>"
            f"<td>{_number(figures.body_frame_rmse_m, ' m')}</td>"
            f"<td>{_number(figures.nees_distance, '')}</td>"
        )
        if baseline:
            row += f"<td>{_number(_pair_rmse(baseline.pairs, pair), ' m')}</td>"
        pair_rows.append(row + "</tr>")
    return _PAGE.format(
        title=html.escape(content.title),
        subtitle=html.escape(content.subtitle),
        epochs=metrics.epochs,
        team="\n".join(rows),
        pairs="\n".join(pair_rows),
        pictures="\n".join(sections),
    )


def _pair_rmse(pairs: Mapping[Pair, Any], pair: Pair) -> float:
    return pairs[pair].distance_rmse_m if pair in pairs else math.nan


def _number(value: float, unit: str) -> str:
    return f"{value:.2f}{unit}" if math.isfinite(value) else "-"


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title} - relpos</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2rem auto;
  padding: 0 1rem; color: #222; }}
table {{ border-collapse: collapse; margin: 1rem 0; }}
th, td {{ padding: 0.25rem 0.9rem; text-align: right; border-bottom: 1px solid #ddd; }}
th:first-child {{ text-align: left; }}
figure {{ margin: 2rem 0; }}
img {{ width: 100%; height: auto; }}
figcaption {{ color: #555; }}
</style>
</head>
<body>
<h1>{title}</h1>
<p>{subtitle}; {epochs} whole seconds scored.</p>
<table>
{team}
</table>
{pictures}
<h2>Pairs</h2>
<table>
{pairs}
</table>
</body>
</html>
"""
