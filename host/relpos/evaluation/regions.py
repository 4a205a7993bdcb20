"""Coverage and size of the regions of an ambiguous estimate's alternatives.

The 90 % region of a node is the smallest that holds 90 % of what the alternatives say of it
(:class:`Region`). Honest alternatives hold the truth in nine epochs of
ten; what they are worth is their area beside a blind guess's: 90 % of the disc round a neighbour
whose radius is the longest range that was measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from relpos.evaluation.consistency import Coverage, coverage
from relpos.fusion.estimator import Alternative, Estimate, NodeStatus, Shape
from relpos.measurements import Range
from relpos.tracks import UNMOVED, Alignment, Track, sample

Floats = npt.NDArray[np.float64]

SHARE = 0.9
DRAWS = 1500
"""Random points a region is made of: its area to 4 %."""

_LEAST_SIGMA_M = 0.01
"""An ellipse's axis or a ring's width below this would make densities of points that no
measurement can distinguish differ."""


@dataclass(frozen=True, slots=True)
class Look:
    """One node's region at one epoch while it is ambiguous."""

    time_s: float
    node: int
    holds: bool
    area_m2: float
    ring: bool


@dataclass(frozen=True, slots=True)
class Ambiguity:
    """All looks of a run: how often the region held the truth, mean areas (m^2)."""

    coverage: Coverage
    looks: int
    area_m2: float
    blind_m2: float
    rings: float


def into_frame_of(estimates: Iterable[Estimate], truth: Mapping[int, Track]) -> Alignment | None:
    """Motion of the truth into the frame of an estimate without priors.

    That is the first located node's true pose at the start. None where no node was located or that
    pose is not known.
    """
    for estimate in estimates:
        for node in estimate.nodes:
            if node.status is NodeStatus.OK:
                track = truth.get(node.node)
                begin_s = 0.0 if track is None else np.min(track.time_s, initial=math.inf)
                if track is None or begin_s > estimate.time_s:
                    return None
                position_m, [[heading]] = sample([track], np.array([max(begin_s, 0.0)]))
                if not math.isfinite(heading):
                    return None
                return Alignment(
                    math.cos(heading), -math.sin(heading), position_m[0, 0], np.zeros(2)
                )
    return None


def look(estimate: Estimate, truth: Mapping[int, Track], moving: Alignment) -> list[Look]:
    """Hold the alternatives of every ambiguous node against where it truly is.

    ``moving`` takes the truth into the estimate's frame.
    """
    looks = []
    for node in estimate.nodes:
        own = [a for a in estimate.alternatives if a.node == node.node]
        track = truth.get(node.node)
        if node.status is not NodeStatus.AMBIGUOUS or not own or track is None:
            continue
        there_m = sample([track], np.array([estimate.time_s]))[0][0]
        if not np.isfinite(there_m).all():
            continue
        region = Region.of(own, SHARE, DRAWS)
        holds = region.contains(*moving(there_m)[0])
        looks.append(
            Look(estimate.time_s, node.node, holds, region.area_m2, own[0].shape is Shape.RING)
        )
    return looks


def blind_area_m2(ranges: Iterable[Range]) -> float:
    """Area of a blind guess's 90 % region; 0 where nothing was measured."""
    longest_m = max((measured.range_m for measured in ranges), default=0.0)
    return SHARE * math.pi * longest_m**2


def summarise(
    estimates: Sequence[Estimate],
    truth: Mapping[int, Track],
    ranges: Iterable[Range],
    *,
    starts_known: bool,
) -> Ambiguity | None:
    """Evaluate every epoch; None where nothing was ambiguous or the frame is not known."""
    moving = UNMOVED if starts_known else into_frame_of(estimates, truth)
    if moving is None:
        return None
    looks = [one for estimate in estimates for one in look(estimate, truth, moving)]
    if not looks:
        return None
    nodes = sorted({one.node for one in looks})
    held = [np.array([one.holds for one in looks if one.node == node]) for node in nodes]
    return Ambiguity(
        coverage(held),
        len(looks),
        float(np.mean([one.area_m2 for one in looks])),
        blind_area_m2(ranges),
        float(np.mean([one.ring for one in looks])),
    )


@dataclass(frozen=True, slots=True)
class Region:
    """The smallest region that holds ``probability`` of a mixture of ellipses and rings.

    ``rows`` (A, 7): probability, x, y, major, minor, angle, 1 for a ring. ``level`` is the
    density (1/m^2) at its border, ``area_m2`` its area.
    """

    rows: Floats
    level: float
    area_m2: float

    @staticmethod
    def of(
        alternatives: Iterable[Alternative], probability: float = 0.9, draws: int = 4000
    ) -> Region:
        """Build the region of one node's alternatives of one time.

        The level is a quantile of the density at points of the mixture itself; the area is the
        mean of 1/density over those that lie inside. Both from ``draws`` fixed random points:
        an area to about 2 %.
        """
        rows = np.array(
            [
                (
                    a.probability, a.x_m, a.y_m, max(a.sigma_major_m, _LEAST_SIGMA_M),
                    max(a.sigma_minor_m, _LEAST_SIGMA_M), a.sigma_angle_rad,
                    float(a.shape is Shape.RING),
                )
                for a in alternatives
            ]
        )  # fmt: skip
        rng = np.random.default_rng(0)
        share_of = rows[:, 0] / rows[:, 0].sum()
        one = rng.choice(len(rows), size=draws, p=share_of)
        normal = rng.standard_normal((draws, 2))
        turn = math.tau * rng.random(draws)
        _, x, y, major, minor, angle, ring = rows[one].T
        c, s = np.cos(angle), np.sin(angle)
        along, across = major * normal[:, 0], minor * normal[:, 1]
        distance = major + minor * normal[:, 0]
        is_ring = ring > 0.0
        points = np.column_stack(
            (
                x + np.where(is_ring, distance * np.cos(turn), c * along - s * across),
                y + np.where(is_ring, distance * np.sin(turn), s * along + c * across),
            )
        )
        density = _density(rows, points)
        level = float(np.quantile(density, 1.0 - probability))
        inside = density >= level
        return Region(rows, level, float((inside / density).mean()))

    def contains(self, x_m: float, y_m: float) -> bool:
        """Return whether a place lies inside."""
        return bool(_density(self.rows, np.array([[x_m, y_m]]))[0] >= self.level)


def _density(rows: Floats, points: Floats) -> Floats:
    """Density (1/m^2) of a mixture (A, 7) at points (P, 2)."""
    total = np.zeros(len(points))
    for probability, x, y, major, minor, angle, ring in rows:
        dx, dy = points[:, 0] - x, points[:, 1] - y
        if ring > 0.0:
            # Normal across, even round; the circumference of each distance keeps it a density.
            distance = np.hypot(dx, dy)
            scaled = (distance - major) / minor
            total += (
                probability * np.exp(-0.5 * scaled * scaled)
                / (math.sqrt(math.tau) * minor * math.tau * np.maximum(distance, minor))
            )  # fmt: skip
        else:
            c, s = math.cos(angle), math.sin(angle)
            along, across = (c * dx + s * dy) / major, (c * dy - s * dx) / minor
            total += (
                probability * np.exp(-0.5 * (along * along + across * across))
                / (math.tau * major * minor)
            )  # fmt: skip
    return total
