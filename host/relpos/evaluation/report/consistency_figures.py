"""The figures of consistency: reported against real errors, and the status of every node."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from relpos.evaluation.report.content import Content
from relpos.evaluation.report.drawing import Picture, broken_at_gaps, flat_distance, logarithmic
from relpos.evaluation.style import (
    BAD,
    COLOURS,
    DEAD_RECKONING,
    FAIR,
    FUSED,
    GOOD,
    INK,
    TRUTH,
)
from relpos.fusion.estimator import NodeStatus
from relpos.tracks import interpolate, whole_seconds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = npt.NDArray[np.float64]


STATUS_COLOURS: Mapping[str, str] = {
    NodeStatus.OK: GOOD,
    NodeStatus.AMBIGUOUS: FAIR,
    NodeStatus.UNLOCATED: TRUTH,
    NodeStatus.STALE: COLOURS[5],
    NodeStatus.LOST: BAD,
}


STATUS_WORDS: Mapping[str, str] = {
    NodeStatus.OK: "ok",
    NodeStatus.AMBIGUOUS: "ambiguous",
    NodeStatus.UNLOCATED: "not located",
    NodeStatus.STALE: "stale (3 epochs silent)",
    NodeStatus.LOST: "lost (10 epochs silent)",
}


def consistency(content: Content) -> Picture | None:
    """Draw the consistency of the reported uncertainty with the real errors."""
    scored = content.evaluation
    # An error of exactly 0 is a copy of the truth, not an estimate with an uncertainty.
    if scored is None or not (scored.metrics.nees_over_time > 1e-12).any():
        return None
    metrics, chance = scored.metrics, scored.nees_distance
    off = normalised(content)

    def draw(figure: Figure) -> None:
        from scipy.special import erf

        left, right = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
        time_s, nees = metrics.time_s, metrics.nees_over_time
        left.axhspan(
            chance.low, chance.high, color=COLOURS[2], alpha=0.15, linewidth=0,
            label=f"whole run, by chance: {chance.low:.2f} to {chance.high:.2f}",
        )  # fmt: skip
        left.axhline(1.0, color=INK, linewidth=0.9, linestyle=":")
        x, y = broken_at_gaps(time_s, nees)
        left.plot(x, y, color=FUSED, alpha=0.35, linewidth=0.8, label="each second")
        x, y = broken_at_gaps(time_s, _moving_mean(time_s, nees, 30.0))
        left.plot(x, y, color=FUSED, label="mean of 30 s")
        left.axhline(
            chance.mean, color=DEAD_RECKONING, linestyle="--", linewidth=1.2,
            label=f"whole run: {chance.mean:.3g}",
        )  # fmt: skip
        good = nees[nees > 1e-12]
        logarithmic(left, max(float(np.quantile(good, 0.02)), 1e-3))
        left.set_ylim(top=max(2.0 * float(np.quantile(good, 0.99)), 3.0))
        left.set(xlabel="time (s)", ylabel="NEES of the distances (1 is honest)")
        left.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2)
        sigmas = np.linspace(0.0, 3.5, 71)
        expected = erf(sigmas / math.sqrt(2.0))
        found = np.array([(off <= s).mean() for s in sigmas])
        right.plot([0, 1], [0, 1], color=INK, linewidth=0.9, linestyle=":", label="honest")
        right.plot(expected, found, color=FUSED, label=content.result.estimator)
        right.set(xlabel="share that should be inside", ylabel="share that is", xlim=(0, 1))
        right.set(ylim=(0, 1), aspect="equal")
        right.legend(loc="lower right")

    inside = 100.0 * float((off <= 1.96).mean())
    return Picture(
        "consistency",
        "As uncertain as it says",
        "Left: mean squared error of all pairs' distances over the reported variance; the green "
        "band holds an honest estimator's mean over the whole run in 95 of 100 cases. Right: how "
        "many errors lie within the reported uncertainty, against a Gaussian's shares; above the "
        f"line is too modest, below too sure. Within 1.96 sigma: {inside:.0f} %.",
        f"NEES {chance.mean:.3g} over the whole run, {chance.low:.2f} to {chance.high:.2f} by "
        f"chance; {inside:.0f} % of the errors within 1.96 sigma.",
        draw,
        (10.4, 4.0),
    )


def normalised(content: Content) -> Floats:
    """Distance errors over their reported deviations, absolute, all pairs and seconds, (n,)."""
    at_s = whole_seconds(content.truth.values())
    found = [np.empty(0)]
    for pair, track in content.pairs.items():
        good = track.sigma_distance_m > 0.0
        if pair[0] not in content.truth or pair[1] not in content.truth or not good.any():
            continue
        distance = interpolate(track.time_s[good], track.distance_m[good], at_s)
        sigma = interpolate(track.time_s[good], track.sigma_distance_m[good], at_s)
        off = np.abs(distance - flat_distance(content.truth, pair, at_s)) / sigma
        found.append(off[np.isfinite(off)])
    return np.concatenate(found)


def status(content: Content) -> Picture | None:
    """Draw the status of every node, and the number of possible modes."""
    estimates = content.result.estimates
    if not estimates:
        return None
    nodes = [node for node in content.nodes if node in content.guessed]
    pictures = [len({a.alternative for a in e.alternatives}) or 1 for e in estimates]
    likely = [max((a.probability for a in e.alternatives), default=1.0) for e in estimates]
    ambiguous = max(pictures) > 1
    seen: dict[str, float] = {}

    def draw(figure: Figure) -> None:
        from matplotlib.patches import Patch

        heights = [0.28 * max(len(nodes), 2) + 0.5] + [1.5] * ambiguous
        panels = figure.subplots(
            len(heights), 1, squeeze=False, sharex=True, height_ratios=heights
        )[:, 0]
        used: dict[str, str] = {}
        for row, node in enumerate(nodes):
            for state, begin, end in _spans(content, node):
                panels[0].broken_barh(
                    [(begin, end - begin)], (row - 0.38, 0.76), facecolors=STATUS_COLOURS[state],
                    linewidth=0,
                )  # fmt: skip
                used[state] = STATUS_COLOURS[state]
        panels[0].set_yticks(range(len(nodes)), [content.name(node) for node in nodes])
        panels[0].set_ylim(len(nodes) - 0.5, -0.5)
        panels[0].grid(visible=False, axis="y")
        panels[0].legend(
            [Patch(color=colour) for colour in used.values()],
            [STATUS_WORDS[state] for state in used],
            loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, borderaxespad=0.2,
        )  # fmt: skip
        if ambiguous:
            time_s = [e.time_s for e in estimates]
            panels[1].plot(
                time_s, pictures, color=FUSED, drawstyle="steps-post", label="possible modes"
            )
            panels[1].set_ylabel("possible modes")
            panels[1].set_ylim(bottom=0.0)
            beside = panels[1].twinx()
            beside.plot(
                time_s, likely, color=DEAD_RECKONING, linestyle="--", linewidth=1.2,
                drawstyle="steps-post",
            )  # fmt: skip
            beside.set_ylim(0.0, 1.02)
            beside.set_ylabel("probability of the best\n(dashed)")
            beside.grid(visible=False)
            beside.spines["right"].set_visible(True)
        panels[-1].set_xlabel("time (s)")

    for node in nodes:
        for state, begin, end in _spans(content, node):
            seen[state] = seen.get(state, 0.0) + end - begin
    total = sum(seen.values()) or 1.0
    words = ", ".join(
        f"{100.0 * value / total:.1f} % {STATUS_WORDS[state]}" for state, value in seen.items()
    )
    held = content.evaluation.ambiguity if content.evaluation is not None else None
    region = (
        f" While ambiguous the 90 % region held the truth in {100.0 * held.coverage.share:.0f} % "
        f"of {held.looks} looks ({100.0 * held.coverage.low:.0f} to "
        f"{100.0 * held.coverage.high:.0f} %), with {held.area_m2:.0f} m² on average; a blind "
        f"guess has {held.blind_m2:.0f} m²."
        if held is not None
        else ""
    )
    return Picture(
        "status",
        "Status and modes",
        f"Status of every node over time: {words}."
        + (" Below: the number of possible modes of the team." if ambiguous else "")
        + region,
        f"A bar for each node over time, coloured by status: {words}.{region}",
        draw,
        (9.6, 1.3 + 0.28 * max(len(nodes), 2) + (1.8 if ambiguous else 0.0)),
    )


def _spans(content: Content, node: int) -> list[tuple[str, float, float]]:
    """Stretches of one status: what, from, to."""
    spans: list[tuple[str, float, float]] = []
    last_s: float | None = None
    for estimate in content.result.estimates:
        own = next((n for n in estimate.nodes if n.node == node), None)
        if own is None:
            last_s = None
            continue
        state = str(own.status)
        begin = estimate.time_s if last_s is None else last_s
        if last_s is not None and spans and spans[-1][0] == state:
            spans[-1] = (state, spans[-1][1], estimate.time_s)
        else:
            spans.append((state, begin, estimate.time_s))
        last_s = estimate.time_s
    return spans


def _moving_mean(time_s: Floats, values: Floats, window_s: float) -> Floats:
    """Mean of what is finite within half a window to either side."""
    finite = np.isfinite(values)
    total = np.concatenate(([0.0], np.cumsum(np.where(finite, values, 0.0))))
    count = np.concatenate(([0], np.cumsum(finite)))
    first = np.searchsorted(time_s, time_s - 0.5 * window_s, side="left")
    last = np.searchsorted(time_s, time_s + 0.5 * window_s, side="right")
    number = count[last] - count[first]
    means: Floats = np.divide(
        total[last] - total[first], number, out=np.full(time_s.shape, np.nan), where=number > 0
    )
    return means
