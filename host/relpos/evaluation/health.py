"""The health of nodes and links over a run, from their recorded status.

The rules are those of the live table (:mod:`relpos.nodes.health`), applied to every status report
in turn. A run without status reports still shows how regularly each node reported motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from relpos.measurements import Motion, Status
from relpos.nodes.health import SILENT_S, Health
from relpos.nodes.monitor import NodeMonitor

Floats = npt.NDArray[np.float64]

LINK_RECEIVED, LINK_LOST, LINK_RSSI = "link_received", "link_lost", "link_rssi_dbm"
SERIES = ("battery_v", "rssi_dbm", "loss", "ranging")
"""Stored figures of each report: volts, dBm, and fractions of the last half minute."""


@dataclass(frozen=True)
class NodeHealth:
    """One node over a run: a row (T,) a status report, NaN where it did not report.

    ``colour`` holds the worst of :class:`relpos.nodes.health.Health` at each report. ``restarts``
    are (time in s, why). ``silences`` are (from, to) in s without any motion for more than
    ``SILENT_S``.
    """

    node: int
    time_s: Floats
    series: Mapping[str, Floats]
    colour: npt.NDArray[np.int64]
    reasons: Mapping[str, int] = field(default_factory=dict)
    restarts: tuple[tuple[float, str], ...] = ()
    silences: tuple[tuple[float, float], ...] = ()
    motions: int = 0
    received: int = 0
    frames_lost: int = 0

    @property
    def frame_loss(self) -> float:
        """Share of its frames that were lost over the whole run; NaN where it is not known."""
        total = self.received + self.frames_lost
        return self.frames_lost / total if total else math.nan

    @property
    def worst(self) -> Health | None:
        """The worst colour it had; None without a report."""
        return Health(int(self.colour.max())) if self.colour.size else None


def of_run(
    motions: Sequence[Motion], statuses: Sequence[Status], nodes: Sequence[int]
) -> dict[int, NodeHealth]:
    """Go through a run's status reports and motions, node by node."""
    reports: dict[int, dict[float, dict[str, float]]] = {node: {} for node in nodes}
    for status in statuses:
        of_node = reports.setdefault(status.node, {})
        of_node.setdefault(status.time_s, {})[status.name] = status.value
    moved: dict[int, list[float]] = {node: [] for node in nodes}
    for motion in motions:
        moved.setdefault(motion.node, []).append(motion.time_s)
    return {
        node: _node(node, reports.get(node, {}), moved.get(node, []))
        for node in sorted(reports.keys() | moved.keys())
    }


def _node(
    node: int, reports: Mapping[float, Mapping[str, float]], moved: list[float]
) -> NodeHealth:
    view = NodeMonitor(node)
    times, colours = [], []
    series: dict[str, list[float]] = {name: [] for name in SERIES}
    reasons: dict[str, int] = {}
    restarts: list[tuple[float, str]] = []
    for time_s, figures in sorted(reports.items()):
        before = view.status.get("uptime_s")
        uptime_s = figures.get("uptime_s")
        if before is not None and uptime_s is not None and uptime_s < before:
            view.boot += 1
            view.status = {}
        for name, value in figures.items():
            if not name.startswith("link_"):
                view.add_status(time_s, name, value)
        if view.boot > len(restarts):
            restarts.append((time_s, view.reset_cause() or "unknown"))
        if LINK_RECEIVED in figures:
            view.add_link(
                time_s, int(figures[LINK_RECEIVED]), int(figures.get(LINK_LOST, view.frames_lost))
            )
        view.heard_s = time_s
        view.rssi_dbm = figures.get(LINK_RSSI, view.rssi_dbm)
        if not view.status:
            continue
        colour, why = view.health(time_s)
        for words in why:
            kind = _kind(words)
            reasons[kind] = reasons.get(kind, 0) + 1
        times.append(time_s)
        colours.append(int(colour))
        latest = {
            # 0: this board does not measure it.
            "battery_v": view.status.get("battery_v") or None,
            "rssi_dbm": view.rssi_dbm,
            "loss": view.frame_loss(time_s),
            "ranging": view.ranging(time_s)[0],
        }
        for name, now in latest.items():
            series[name].append(math.nan if now is None else float(now))
    gaps = [(a, b) for a, b in pairwise(moved) if b - a > SILENT_S]
    return NodeHealth(
        node,
        np.array(times),
        {name: np.array(values) for name, values in series.items()},
        np.array(colours, dtype=np.int64),
        reasons,
        tuple(restarts),
        tuple(gaps),
        len(moved),
        view.received,
        view.frames_lost,
    )


_SHARES = (
    ("% of rangings succeed", "few rangings succeed"),
    ("% of", "many"),
)


def _kind(words: str) -> str:
    """A reason without its numbers, so that equal ones can be counted."""
    kind = " ".join(w for w in words.split() if not any(c.isdigit() for c in w))
    for share, instead in _SHARES:
        kind = kind.replace(share, instead)
    return kind
