"""The numbers of a report as HTML tables, each value with its digits for machines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape

import numpy as np
import numpy.typing as npt

from relpos.evaluation import ranging
from relpos.evaluation.finite import median
from relpos.evaluation.iso18305 import Accuracy, Frame, Magnitudes
from relpos.evaluation.metrics import PairMetrics
from relpos.evaluation.report.consistency_figures import STATUS_WORDS
from relpos.evaluation.report.content import Content
from relpos.evaluation.report.node_figures import TEAM_WIDE
from relpos.evaluation.summary import figure
from relpos.nodes.health import Health

FRAME_WORDS: Mapping[Frame, str] = {
    Frame.AS_GIVEN: "as given",
    Frame.PER_RUN: "one motion for the run",
    Frame.PER_EPOCH: "one motion a second",
}

LONG = 30
"""Tables of more rows than this are folded."""


HUGE = 1e7
"""Figures from here on say only that something is far off: two digits of them are enough."""


@dataclass(frozen=True)
class Table:
    """One table: what it is of, the heads of its columns, and rows whose first cell is a head."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def html(self) -> str:
        """Return the table as HTML, in a region of its own that scrolls if it is too wide."""
        head = "".join(f'<th scope="col">{escape(c)}</th>' for c in self.columns)
        body = "\n".join(
            f'<tr><th scope="row">{first}</th>{"".join(map(_cell, rest))}</tr>'
            for first, *rest in self.rows
        )
        words = escape(self.caption)
        made = (
            f'<div class="wide" role="region" tabindex="0" aria-label="{words}"><table>'
            f"<caption>{words}</caption><thead><tr>{head}</tr></thead>"
            f"<tbody>\n{body}\n</tbody></table></div>"
        )
        if self.note:
            made += f'\n<p class="note">{escape(self.note)}</p>'
        if len(self.rows) > LONG:
            made = f"<details><summary>{words} ({len(self.rows)} rows)</summary>{made}</details>"
        return made


def _cell(content: str) -> str:
    return f"<td{' class=words' if len(content) > 24 and '<' not in content else ''}>{content}</td>"


def value(number: float | None, unit: str = "", digits: int = 2, *, sign: bool = False) -> str:
    """Return a number with its unit as HTML, all digits in the attribute."""
    if number is None or not math.isfinite(number):
        return '<span aria-label="not known">-</span>'
    words = f"{number:+.{digits}f}" if sign else f"{number:.{digits}f}"
    if abs(number) >= HUGE:
        words = f"{number:.2g}"
    return f'<data value="{figure(number)!r}">{words}</data>{" " + unit if unit else ""}'


def _share(number: float) -> str:
    if not math.isfinite(number):
        return value(None)
    return f'<data value="{figure(number)!r}">{100.0 * number:.1f}</data> %'


def main_figures(content: Content) -> Table | None:
    """Return the table of the run format's metrics, dead reckoning and the bound."""
    if content.evaluation is None:
        return None
    metrics = content.evaluation.metrics
    baseline = content.baseline.metrics if content.baseline is not None else None
    totals = content.bound.totals() if content.bound is not None else None
    smoothed = content.result.smoothed
    least: dict[str, float] = {}
    if totals is not None:
        names = ("relative_distance_rmse_m", "relative_position_rmse_m")
        least = dict(zip(names, totals.of(smoothed=smoothed), strict=True))
    columns = ["", content.result.estimator]
    columns += ["dead reckoning"] * (baseline is not None)
    columns += [f"bound ({'smoothing' if smoothed else 'filtering'})"] * (totals is not None)
    rows = []
    for words, name, unit in (
        ("relative distance RMSE", "relative_distance_rmse_m", "m"),
        ("aligned position RMSE", "relative_position_rmse_m", "m"),
        ("body-frame RMSE", "body_frame_rmse_m", "m"),
        ("NEES of the distances", "nees_distance", ""),
    ):
        row = [words, value(getattr(metrics, name), unit)]
        if baseline is not None:
            row.append(value(getattr(baseline, name), unit))
        if totals is not None:
            row.append(value(least.get(name), unit))
        rows.append(row)
    return Table(
        "Whole run",
        columns,
        rows,
        f"Over {metrics.epochs} whole seconds. Relative distance: all pairs. Aligned position: the "
        "picture's shape, after the best shift and rotation of each second. Body frame: where each "
        "peer is as seen from each node's own heading. NEES: 1 is honest, above too sure.",
    )


def consistency(content: Content) -> Table | None:
    """Return the table of every NEES with its interval."""
    scored = content.evaluation
    if scored is None:
        return None
    rows = []
    for words, nees in (
        ("distances of all pairs", scored.nees_distance),
        ("positions", scored.nees_position),
        ("headings", scored.nees_heading),
    ):
        if nees is not None and math.isfinite(nees.mean):
            verdict = "honest" if nees.honest else ("too sure" if nees.mean > 1 else "too modest")
            rows.append(
                [
                    words, value(nees.mean), value(nees.low), value(nees.high),
                    value(nees.effective, "", 0), verdict,
                ]
            )  # fmt: skip
    if not rows:
        return None
    left_out = scored.metrics.nees_left_out
    return Table(
        "Normalised squared errors (NEES)",
        ["of", "mean", "by chance from", "to", "independent", "verdict"],
        rows,
        "Between the two limits lies an honest estimator's mean in 95 of 100 cases, at as many "
        "independent errors as the run is worth. Positions and headings are compared as they are, "
        "where the run gave the starts."
        + (f" {left_out} rows with a reported sigma of 0 are left out." * bool(left_out)),
    )


def iso(content: Content) -> Table | None:
    """Return the table of ISO/IEC 18305, a column for each alignment."""
    if content.evaluation is None or not content.evaluation.iso.known:
        return None
    assessed = content.evaluation.iso
    kinds = assessed.frames.values()
    rows = [
        ["test points", *(value(a.horizontal.count, "", 0) for a in kinds)],
        ["mean error vector", *map(_vector, kinds)],
        ["absolute mean", *(value(a.absolute_mean_m, "m") for a in kinds)],
        ["variance x, y, z", *map(_variances, kinds)],
        ["covariance xy", *(value(float(a.covariance_m2[0, 1]), "m²", 3) for a in kinds)],
    ]
    for words, name, letter in (
        ("horizontal", "horizontal", "CE"),
        ("vertical", "vertical", "VE"),
        ("spherical", "spherical", "SE"),
    ):
        if not any(getattr(a, name).count for a in kinds):
            continue
        for what, part, unit in (
            (f"mean {words} error", "mean_m", "m"),
            (f"RMS {words} error", "rms_m", "m"),
            (f"variance of the {words} error", "variance_m2", "m²"),
            (f"{letter}50", "e50_m", "m"),
            (f"{letter}95", "e95_m", "m"),
        ):
            digits = 3 if unit == "m²" else 2
            rows.append(
                [what, *(value(getattr(getattr(a, name), part), unit, digits) for a in kinds)]
            )
    relative, headline = assessed.relative, assessed.headline
    words = FRAME_WORDS[headline] if headline is not None else ""
    note = (
        "Errors are estimate less truth at every whole second of every node. A relative picture "
        "has no frame of its own; columns differ in how it was laid on the truth before: as given "
        "(only where the run states the starts in the truth's frame), by one rigid motion of the "
        "plane, SE(2), for the whole run and all nodes, or by one each second over the nodes known "
        "then. CE50 and CE95 are the least radii that hold half and 95 % of the horizontal errors "
        "that occurred, VE of the vertical ones, SE of those in space. Heights are over each "
        f"node's own start. Relative accuracy ({words}): the vectors between two nodes are off by "
        f"{relative.mean_m:.2f} m on average, {relative.rms_m:.2f} m RMS, {relative.e95_m:.2f} m "
        f"at 95 %. Coverage: a node was located at {100.0 * assessed.coverage:.1f} % of its test "
        "points. Zone detection needs a map and is left out."
    )
    if not any(a.vertical.count for a in kinds):
        note += " No height is known in both estimate and truth: no vertical or spherical error."
    return Table(
        "Metrics of ISO/IEC 18305:2016",
        ["", *(FRAME_WORDS[frame] for frame in assessed.frames)],
        rows,
        note,
    )


def _vector(accuracy: Accuracy) -> str:
    parts = [value(float(v), "", 2, sign=True) for v in accuracy.mean_error_m if math.isfinite(v)]
    return ", ".join(parts) + " m"


def _variances(accuracy: Accuracy) -> str:
    parts = [float(accuracy.covariance_m2[k, k]) for k in range(3)]
    return ", ".join(value(v, "", 3) for v in parts if math.isfinite(v)) + " m²"


def vertical(content: Content) -> Table | None:
    """Heights, floors and stairs against the truth."""
    found = None if content.evaluation is None else content.evaluation.vertical
    if found is None:
        return None
    rows = [(escape(name), escape(words)) for name, words in found.lines()]
    return Table("Heights, floors and stairs", ("figure", "value"), rows)


def latency(content: Content) -> Table | None:
    """Return the table of the delay of estimates."""
    seen = content.result.latency
    if seen is None:
        return None
    return Table(
        "Latency",
        ["", "median", "95 %", "longest"],
        [
            [
                "waiting for later measurements",
                value(seen.wait_median_s, "s"),
                value(seen.wait_p95_s, "s"),
                value(seen.wait_max_s, "s"),
            ],
            ["computing, each measurement", value(1e3 * seen.computing_s, "ms", 3), "", ""],
        ],
        "In the run's own time: how much later than the time it is for an estimate came out, "
        "which a live session bridges by composing newer motion onto it. Transmission is not in "
        "it. Computing: mean wall time on the computer that made this page.",
    )


def nodes(content: Content) -> Table | None:
    """Return the table of each node's errors."""
    if content.evaluation is None or not content.evaluation.iso.nodes:
        return None
    assessed = content.evaluation.iso
    vertical = any(one.vertical.count for one in assessed.nodes.values())
    rows = []
    for node, one in assessed.nodes.items():
        flat = one.horizontal
        row = [escape(content.name(node)), *_figures(flat)]
        if vertical:
            row += [value(one.vertical.rms_m, "m"), value(one.vertical.e95_m, "m")]
        rows.append(row)
    assert assessed.headline is not None
    return Table(
        f"Each node ({FRAME_WORDS[assessed.headline]})",
        ["node", "mean", "RMS", "CE50", "CE95", "largest"]
        + (["vertical RMS", "VE95"] if vertical else []),
        rows,
    )


def _figures(kind: Magnitudes) -> list[str]:
    return [value(v, "m") for v in (kind.mean_m, kind.rms_m, kind.e50_m, kind.e95_m, kind.max_m)]


def pairs(content: Content) -> Table | None:
    """Return the table of each pair's errors."""
    scored = content.evaluation
    if scored is None or not scored.metrics.pairs:
        return None
    baseline = content.baseline.metrics if content.baseline is not None else None
    rows = []
    for pair, one in scored.metrics.pairs.items():
        row = [
            f"{pair[0]} - {pair[1]}",
            value(one.distance_rmse_m, "m"),
            value(one.distance_error_mean_m, "m", sign=True),
            value(one.distance_error_max_m, "m"),
            value(one.body_frame_rmse_m, "m"),
            value(one.nees_distance),
        ]
        if baseline is not None:
            row.append(value(_rmse(baseline.pairs.get(pair)), "m"))
        rows.append(row)
    return Table(
        "Each pair",
        ["pair", "RMSE", "mean error", "largest error", "body frame", "NEES"]
        + ["dead reckoning RMSE"] * (baseline is not None),
        rows,
    )


def _rmse(pair: PairMetrics | None) -> float:
    return math.nan if pair is None else pair.distance_rmse_m


def ranges(content: Content) -> Table | None:
    """Return the table of each pair's ranges and learned bias."""
    if not content.ranges:
        return None
    learned = {
        (min(node, peer), max(node, peer)): p
        for (name, node, peer), p in content.learned().items()
        if name == "range_bias_m" and peer is not None and (p.value or p.sigma)
    }
    true, failed = bool(content.truth), any(one.failed for one in content.ranges)
    rows = []
    for one in content.ranges:
        row = [f"{one.pair[0]} - {one.pair[1]}", value(one.range_m.size, "", 0)]
        if failed:
            row.append(value(one.failed, "", 0))
        row += [
            value(median(one.residual_m), "m", sign=True),
            value(ranging.spread(one.residual_m), "m"),
        ]
        if true:
            row += [
                value(median(one.error_m), "m", sign=True),
                value(ranging.spread(one.error_m), "m"),
            ]
        if learned:
            p = learned.get(one.pair)
            row += [
                value(None if p is None else p.value, "m", sign=True),
                value(None if p is None else p.sigma, "m"),
            ]
        rows.append(row)
    return Table(
        "Ranges of each pair",
        ["pair", "ranges"]
        + ["failed"] * failed
        + ["median residual", "spread"]
        + (["median error", "spread of errors"] if true else [])
        + (["learned bias", "sigma"] if learned else []),
        rows,
        "Residual: range less estimated distance"
        + (", error: range less true distance" * true)
        + ". Spread: standard deviation from the median absolute deviation, which outliers do not "
        "move.",
    )


_UNITS: Mapping[str, tuple[str, str, float, int]] = {
    "step_scale": ("step scale", "", 1.0, 3),
    "heading_drift_rad_s": ("heading drift", "°/min", 60.0 * math.degrees(1.0), 2),
    "detection_range_m": ("detection range", "m", 1.0, 1),
    "body_shadow_m": ("body shadow", "m", 1.0, 2),
    "range_growth_m": ("growth of ranges", "m", 1.0, 2),
    "range_scale": ("scale of ranges", "", 1.0, 3),
    "range_lateness_s": ("ranges dated late", "s", 1.0, 2),
    "clock_offset_s": ("clock ahead", "s", 1.0, 2),
    "antenna_delay_m": ("antenna delay", "m", 1.0, 2),
}


def learned(content: Content) -> Table | None:
    """Return the table of the last learned parameters, range biases apart."""
    rows, listed = [], set[str]()
    for (name, node, peer), p in content.learned().items():
        if peer is not None or (name in TEAM_WIDE and name in listed):
            continue
        listed.add(name)
        words, unit, factor, digits = _UNITS.get(name, (name, "", 1.0, 4))
        rows.append(
            [
                escape(f"{words}, {content.name(node)}" if name not in TEAM_WIDE else words),
                value(factor * p.value, unit, digits),
                value(factor * p.sigma, unit, digits),
            ]
        )
    return Table("Learned, at the end", ["", "value", "sigma"], rows) if rows else None


def health(content: Content) -> Table | None:
    """Return the table of the health of each node and its link."""
    if not any(one.time_s.size or one.motions for one in content.health.values()):
        return None
    has_status = any(one.time_s.size for one in content.health.values())
    rows = []
    for node, one in content.health.items():
        row = [
            escape(content.name(node)),
            value(one.motions, "", 0),
            value(len(one.silences), "", 0),
        ]
        if has_status:
            total = one.colour.size
            row += [
                value(_least(one.series["battery_v"]), "V"),
                value(median(one.series["rssi_dbm"]), "dBm", 0),
                _share(one.frame_loss),
                _share(median(one.series["ranging"])),
                value(len(one.restarts), "", 0),
                *(
                    _share(float((one.colour == int(c)).sum() / total) if total else math.nan)
                    for c in Health
                ),
            ]
        rows.append(row)
    heads = ["node", "motions", "silences"]
    if has_status:
        heads += ["lowest supply", "radio", "frames lost", "ranging", "restarts"]
        heads += ["green", "yellow", "red"]
    return Table(
        "Links and nodes",
        heads,
        rows,
        "Silences: longer than 5 s without a motion heard. Radio and ranging: medians over the "
        "node's reports, of the signal and of the share of its exchanges that succeed. Colours: "
        "share of its reports, by the rules of the live table."
        if has_status
        else "Silences: longer than 5 s without a motion heard. This run carries no status reports "
        "(status.csv).",
    )


def reasons(content: Content) -> Table | None:
    """Return the table of the reasons for yellow and red."""
    rows = [
        [
            escape(content.name(node)),
            escape("; ".join(f"{why} ({n})" for why, n in most_first(one.reasons))),
        ]
        for node, one in content.health.items()
        if one.reasons
    ]
    return Table("Why not green (reports)", ["node", "reasons"], rows) if rows else None


def log(content: Content) -> Table | None:
    """Return what happened, by time."""
    rows = [
        [clock_of(row["unix_s"]), escape(row["kind"]), escape(row["text"]), escape(row["by"])]
        for row in content.log
    ]
    return Table("What happened", ["time", "kind", "what", "by"], rows) if rows else None


def clock_of(unix_s: str) -> str:
    """Return the time of day, here, of a Unix time."""
    try:
        return f"{datetime.fromtimestamp(float(unix_s)).astimezone():%H:%M:%S}"
    except (ValueError, OverflowError, OSError):
        return ""


def most_first(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """Sort counted words by how often they were."""
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def _least(values: npt.NDArray[np.float64]) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.min()) if finite.size else math.nan


def located(content: Content) -> Table | None:
    """Return the table of the poses at the end."""
    if not content.result.estimates:
        return None
    last = content.result.estimates[-1]
    rows = [
        [
            escape(content.name(node.node)),
            STATUS_WORDS[str(node.status)],
            value(node.x_m, "m"),
            value(node.y_m, "m"),
            value(node.sigma_major_m, "m"),
            value(math.degrees(node.heading_rad) % 360.0, "°", 0),
            value(math.degrees(node.sigma_heading_rad), "°", 0),
        ]
        for node in last.nodes
    ]
    return Table(
        f"At the end ({last.time_s:.1f} s)",
        ["node", "status", "x", "y", "sigma (long axis)", "heading", "sigma of the heading"],
        rows,
        "In the estimate's frame: x east-like, y north-like, headings counter-clockwise from x.",
    )


def counters(content: Content) -> Table | None:
    """Return the table of counts: dropped, rejected, clamped, reset."""
    noted = {**content.run.counters, **content.result.counters}
    rows = [
        [escape(name.replace("_", " ")), value(float(count), "", 0)]
        for name, count in sorted(noted.items())
        if count
    ]
    return Table("Counted on the way", ["what", "how often"], rows) if rows else None
