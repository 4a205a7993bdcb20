"""New hypotheses for the fits: nodes placed afresh on the circles of ranges to placed ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relpos.fusion.arrays import Floats, Indices
from relpos.fusion.initial_poses import POSE
from relpos.fusion.initialisation.kernels import PER_NODE, Problem

_TWO_PI = 2.0 * math.pi

_CHOICES = 24
"""A node is placed at so many random places, of which one that fits its ranges is taken."""

_MOST_RANGES = 16
"""So many ranges are looked at when a node is placed."""

_PRECISE_HEADING = 1.0
"""From this precision (1/rad^2) on a heading is known."""


@dataclass(frozen=True, slots=True)
class Proposals:
    """Draws parameters (M, D) for a problem; nodes are given by their indices."""

    rng: np.random.Generator
    problem: Problem
    active: Sequence[int]
    frame: int | None
    """The node whose initial pose is the frame."""
    moved: Sequence[int]
    """Nodes that have moved since they were added."""

    def place_all(self, parameters: Floats) -> Floats:
        """Place every active node, in place, on the circles of those placed before it."""
        placed = set()
        for i in self.active:
            if self._has_place(i):
                self._draw_prior(parameters, i)
                placed.add(i)
        waiting = [i for i in self.active if i not in placed]
        self.rng.shuffle(waiting)
        self.place_new(parameters, waiting, placed)
        return parameters

    def place_new(self, parameters: Floats, waiting: list[int], placed: set[int]) -> None:
        """Place the ``waiting`` nodes, in place, each once a range ties it to a placed one."""
        while waiting:
            for i in waiting:
                if self._has_place(i):
                    self._draw_prior(parameters, i)
                elif not self._place(parameters, i, placed):
                    continue
                placed.add(i)
                waiting.remove(i)
                break
            else:
                break

    def movable(self) -> list[int]:
        """Return the nodes whose poses are not given by priors."""
        return [i for i in self.active if not self.problem.priors.precision[i, ::2].all()]

    def vary(self, base: Floats) -> Floats:
        """Return hypotheses like ``base`` but for one node or the whole direction, and new ones."""
        movable, free = self.movable(), self._is_free_to_turn()
        if len(movable) == 1 and not free:
            others = set(range(len(self.problem.priors.at))) - {movable[0]}
            self._place(base, movable[0], others)
            return base
        whole = len(base) // 3
        parts = [self.place_all(np.zeros_like(base[:whole]))] if whole else []
        rest = base[whole:]
        if free:
            half = len(rest) // 2
            parts.append(self._turned(rest[:half]))
            rest = rest[half:]
        for k, i in enumerate(self.rng.permutation(movable)[:3]):
            part = rest[k::3].copy()
            if part.shape[0] and self._place(part, int(i), set(self.active) - {int(i)}):
                parts.append(part)
        return np.concatenate(parts) if parts else base[:0]

    def _has_place(self, i: int) -> bool:
        return bool(self.problem.priors.precision[i, :2].any())

    def _is_free_to_turn(self) -> bool:
        """Whether only chance can have chosen the directions: no heading, no fixed place."""
        if (self.problem.ranges.ends < 0).any():
            return False
        known = self.problem.priors.precision[:, 2] > _PRECISE_HEADING
        return not known[list(self.moved)].any()

    def _turned(self, parameters: Floats) -> Floats:
        """Turn hypotheses about the frame's node, or the middle of what is known of places."""
        known = [i for i in self.active if self._has_place(i)]
        pivot = np.mean([self.problem.priors.mean[i, :2] for i in known], axis=0)
        turned = parameters.copy()
        blocks = turned[:, :-1].reshape(len(turned), len(self.problem.priors.at), -1)
        angle = _TWO_PI * self.rng.random(len(turned))
        moved = [i for i in range(blocks.shape[1]) if i != self.frame]
        place = blocks[:, moved, 0] + 1j * blocks[:, moved, 1] - complex(*pivot)
        place = complex(*pivot) + place * np.exp(1j * angle)[:, None]
        blocks[:, moved, 0], blocks[:, moved, 1] = place.real, place.imag
        blocks[:, moved, 2] += angle[:, None]
        return turned

    def _own(self, parameters: Floats, i: int) -> Floats:
        """Return node i's parameters (M, 4 + K): a view."""
        each = PER_NODE + self.problem.tracks.knots.shape[0] - 1
        return parameters[:, i * each : (i + 1) * each]

    def _draw_prior(self, parameters: Floats, i: int) -> None:
        """Draw node i's pose from its prior, in place."""
        count, pose = len(parameters), self._own(parameters, i)
        mean, precision = self.problem.priors.mean[i], self.problem.priors.precision[i]
        heading = _TWO_PI * self.rng.random(count)
        if precision[2] > 0.0:
            heading = mean[2] + self.rng.standard_normal(count) / math.sqrt(precision[2])
        then = self.problem.tracks.poses[self.problem.priors.at[i], i]
        heading -= then[2]
        x = mean[0] + self.rng.standard_normal(count) / math.sqrt(precision[0])
        y = mean[1] + self.rng.standard_normal(count) / math.sqrt(precision[1])
        c, s = np.cos(heading), np.sin(heading)
        pose[:, 0] = x - (c * then[0] - s * then[1])
        pose[:, 1] = y - (s * then[0] + c * then[1])
        pose[:, 2] = heading

    def _place(self, parameters: Floats, i: int, placed: set[int]) -> bool:
        """Place node i of every hypothesis on a circle of a placed one; False if there is none."""
        ranges = self.problem.ranges
        own, end = self._ranges_to(i, placed)
        if own.size == 0:
            return False
        anchor = self._anchors(parameters, own, end)
        count = len(parameters)
        chosen = self.rng.integers(own.size, size=(count, _CHOICES))
        x, y, heading = self._draw_poses(i, own, anchor, chosen)
        track = self.problem.tracks.poses[ranges.at[own], i]
        c, s = np.cos(heading)[:, :, None], np.sin(heading)[:, :, None]
        px = x[:, :, None] + c * track[:, 0] - s * track[:, 1]
        py = y[:, :, None] + s * track[:, 0] + c * track[:, 1]
        distance = np.sqrt(
            (px - anchor[:, None, :, 0]) ** 2
            + (py - anchor[:, None, :, 1]) ** 2
            + ranges.height2_m2[own]
        )
        # Wide: a place is to be near, the fit does the rest.
        scaled = (ranges.range_m[own] - distance) / (0.5 + np.sqrt(ranges.variance_m2[own]))
        score = -np.log1p(0.5 * scaled * scaled).sum(axis=2)
        best = (score + self.rng.gumbel(size=score.shape)).argmax(axis=1)
        pick, pose = np.arange(count), self._own(parameters, i)
        pose[:] = 0.0
        pose[:, 0], pose[:, 1], pose[:, 2] = x[pick, best], y[pick, best], heading[pick, best]
        return True

    def _ranges_to(self, i: int, placed: set[int]) -> tuple[Indices, Indices]:
        """Return some ranges between node i and placed ones, with the latter's ends."""
        first, second = self.problem.ranges.ends.T
        anchors = np.array(sorted(placed | {-1}), dtype=np.intp)
        own = np.flatnonzero(
            ((first == i) & np.isin(second, anchors)) | ((second == i) & np.isin(first, anchors))
        )
        if own.size > _MOST_RANGES:
            own = own[np.linspace(0, own.size - 1, _MOST_RANGES).astype(np.intp)]
        return own, np.where(first[own] == i, 1, 0)

    def _anchors(self, parameters: Floats, own: Indices, end: Indices) -> Floats:
        """Return the places (M, R, 2) of those ends of the ranges ``own`` (R,)."""
        ranges, tracks = self.problem.ranges, self.problem.tracks
        anchor = np.empty((len(parameters), own.size, 2))
        for e, (r, side) in enumerate(zip(own, end, strict=True)):
            j = int(ranges.ends[r, side])
            if j < 0:
                anchor[:, e] = ranges.places[r, side]
            else:
                pose, seen = self._own(parameters, j)[:, :POSE], tracks.poses[ranges.at[r], j]
                c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
                anchor[:, e, 0] = pose[:, 0] + c * seen[0] - s * seen[1]
                anchor[:, e, 1] = pose[:, 1] + s * seen[0] + c * seen[1]
        return anchor

    def _draw_poses(
        self, i: int, own: Indices, anchor: Floats, chosen: Indices
    ) -> tuple[Floats, Floats, Floats]:
        """Draw present poses of node i, x, y, heading of the shape of ``chosen``.

        They are drawn from the prior of the place, else on the circle of the ``chosen`` range.
        """
        priors, tracks, shape = self.problem.priors, self.problem.tracks, chosen.shape
        bearing = _TWO_PI * self.rng.random(shape)
        heading = _TWO_PI * self.rng.random(shape)
        mean, precision, then = priors.mean[i], priors.precision[i], tracks.poses[priors.at[i], i]
        if precision[2] > 0.0:
            heading = mean[2] - then[2]
            heading = heading + self.rng.standard_normal(shape) / math.sqrt(precision[2])
        if precision[0] > 0.0:
            x = mean[0] + self.rng.standard_normal(shape) / math.sqrt(precision[0])
            y = mean[1] + self.rng.standard_normal(shape) / math.sqrt(precision[1])
            then_x, then_y = then[0], then[1]
        else:
            rows, radius = np.arange(shape[0])[:, None], self.problem.ranges.range_m[own][chosen]
            x = anchor[rows, chosen, 0] + radius * np.cos(bearing)
            y = anchor[rows, chosen, 1] + radius * np.sin(bearing)
            track = tracks.poses[self.problem.ranges.at[own], i]
            then_x, then_y = track[chosen, 0], track[chosen, 1]
        c, s = np.cos(heading), np.sin(heading)
        return x - (c * then_x - s * then_y), y - (s * then_x + c * then_y), heading
