"""Whether left and right of a team may be exchanged."""

from __future__ import annotations

import cmath
import math
from collections import defaultdict, deque
from collections.abc import Mapping, Set
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.timeline import Advance

BENT_M = 0.7
"""A way so far from a straight one has no mirror image with the same ranges.

Until somebody has gone such a way, noise alone chooses between left and right where a heading was
unknown (docs/notebook/starts.md)."""

APART_M, REMEMBERED_M = 0.3, 10.0
"""Places of a way that are remembered are so far apart, and at most so far away.

The noise of headings bends a long way, too: of 2 degrees in a second, one way of 20 m in a hundred
by 0.66 m, of 10 m by 0.22 m.
"""

ASIDE_M, BETWEEN_M = 0.7, 1.4
"""Three are in a line while their triangle is lower; it has two sides, so far apart.

Who may have gone so far aside while in a line, by the deviation of its heading, leaves it to either
side. With half of it 2 to 4 % fewer of three people are ``ok`` (docs/notebook/missions.md)."""

PLACED = 3
"""So many nodes that are known place all others, on the right side."""

TURN, LATER = 3, 5
"""A turn is what a node reports in so many epochs; it is looked at so many epochs later, when the
ranges have put it right if they had to."""

CLEAR = 0.3
"""Sine of the least turn that is looked at: neither a small one nor one by half a circle tells."""

CONTRADICTED, AGREED, LEAST_TURNS = 0.5, 0.8, 0.5
"""A team is mirrored where less than the first share of its turns is seen, once enough are
remembered; it is believed again when the second share is. As it is, at least 0.84 were seen; while
mirrored, 0.4 after twelve seconds and down to -0.6 (docs/notebook/missions.md)."""

FADE = 0.95
"""Share of what is remembered of turns that is left after an epoch."""


@dataclass(slots=True)
class TurnAgreement:
    """Compares how nodes turn by the estimate with how they reported to turn.

    Every turn of a team that has become its mirror image is estimated as reported at first, and
    put right by the next ranges: in the end the node has turned the other way.
    """

    _reported_rad: defaultdict[int, float] = field(default_factory=lambda: defaultdict(float))
    _past: dict[int, deque[tuple[float, float]]] = field(default_factory=dict)
    """Node -> its reported and its estimated heading at the last epochs."""
    _seen: float = 0.0
    _turned: float = 0.0
    doubted: bool = False
    """Since turns were seen as those of the mirror image, they have not been seen as reported."""

    def move(self, step: Advance) -> None:
        """Add a piece of a node's reported motion."""
        self._reported_rad[step.node] += step.dtheta_rad

    def close_epoch(self, heading_rad: Mapping[int, float]) -> bool:
        """Return whether turns are seen as those of the mirror image.

        ``heading_rad`` are the headings now, of all nodes whose heading is not open.
        """
        self._seen *= FADE
        self._turned *= FADE
        self._past = {node: past for node, past in self._past.items() if node in heading_rad}
        for node, now_rad in heading_rad.items():
            reported_rad = self._reported_rad[node]
            past = self._past.setdefault(node, deque(maxlen=TURN + LATER + 1))
            past.append((reported_rad, now_rad))
            if len(past) <= TURN + LATER:
                continue
            (begun_rad, before_rad), (ended_rad, _) = past[0], past[TURN]
            turn = math.sin(ended_rad - begun_rad)
            if abs(turn) > CLEAR:
                since_rad = reported_rad - ended_rad
                self._seen += turn * math.sin(now_rad - before_rad - since_rad) / TURN
                self._turned += turn**2 / TURN
        if self._turned < LEAST_TURNS:
            return False
        self.doubted &= self._seen < AGREED * self._turned
        if self._seen > CONTRADICTED * self._turned:
            return False
        self._seen = self._turned = 0.0
        self.doubted = True
        return True


@dataclass(slots=True)
class Way:
    """What a node has gone lately, in the frame of its beginning."""

    places_m: deque[complex] = field(default_factory=lambda: deque([0j]))
    now_m: complex = 0j
    facing: complex = 1.0 + 0j

    def move(self, step: Advance) -> None:
        """Add a piece of motion."""
        self.now_m += self.facing * complex(step.dx_m, step.dy_m)
        self.facing *= cmath.rect(1.0, step.dtheta_rad)
        if abs(self.now_m - self.places_m[-1]) > APART_M:
            self.places_m.append(self.now_m)
        while abs(self.now_m - self.places_m[0]) > REMEMBERED_M:
            self.places_m.popleft()

    def bend_m(self) -> float:
        """Return how far it has been from a straight one: half of its width."""
        places = np.array(self.places_m) - self.places_m[0]
        far = places[np.argmax(np.abs(places))]
        if far == 0.0:
            return 0.0
        return 0.5 * float(np.ptp((places * far.conjugate() / abs(far)).imag))


@dataclass(slots=True)
class Handedness:
    """Remembers whose heading or side was open, until a way beside it has bent.

    A team that goes straight on has the same distances as its mirror image, so that what they say
    of unknown headings, or of who has left a line, may be said of the image. The first bent way of
    those whose distance is known tells them apart; who turns on the spot tells nothing. Hypotheses
    alone do not tell who may have left a line to either side: noise may have chosen one before the
    sides are apart.
    """

    _open: set[int] = field(default_factory=set)
    _ways: dict[int, Way] = field(default_factory=dict)
    """Node -> its way since nothing has been open."""
    _aside_m: dict[int, float] = field(default_factory=dict)
    """Node that is in a line -> how far aside it may have gone since, by its heading's error."""
    _gone_m: defaultdict[int, float] = field(default_factory=lambda: defaultdict(float))
    """Node -> path in this epoch."""

    def move(self, step: Advance) -> None:
        """Add a piece of a node's reported motion."""
        self._gone_m[step.node] += math.hypot(step.dx_m, step.dy_m)
        if self._open or self._aside_m:
            self._ways.setdefault(step.node, Way()).move(step)

    def _leave_line(self, in_line: Mapping[int, float]) -> set[int]:
        """Return who leaves a line to a side that its heading does not tell.

        ``in_line`` are those in a line now, and the deviations of their headings (rad).
        """
        left = {n for n, m in self._aside_m.items() if n not in in_line and m > BETWEEN_M}
        self._aside_m = {
            node: self._aside_m.get(node, 0.0) + sigma_rad * self._gone_m[node]
            for node, sigma_rad in in_line.items()
        }
        self._gone_m.clear()
        return left

    def unsure(
        self, unknown: Set[int], near: Mapping[int, Set[int]], in_line: Mapping[int, float]
    ) -> set[int]:
        """Return who may be its mirror image.

        ``unknown`` are those whose heading or side is open now, ``near`` each node's peers whose
        distance to it is known; of those ``in_line`` with two others the standard deviations of
        their headings (rad).
        """
        unknown = unknown | self._leave_line(in_line)
        self._open |= unknown
        if unknown:
            self._ways.clear()
        bent = {node for node, way in self._ways.items() if way.bend_m() > BENT_M}
        told = bent | {n for n, peers in near.items() if bent & peers}
        self._open -= told
        for node in told & self._aside_m.keys():
            self._aside_m[node] = 0.0
        if not self._open and not self._aside_m:
            self._ways.clear()
        placing = near.keys() - self._open
        return {n for n in self._open if len(placing & near.get(n, set())) < PLACED} | unknown
