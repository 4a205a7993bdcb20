"""Whether left and right of a team may be exchanged."""

from __future__ import annotations

import cmath
from collections.abc import Mapping, Set
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.timeline import Advance

BENT_M = 0.7
"""A way so far from a straight one has no mirror image with the same ranges.

Until somebody has gone such a way, noise alone chooses between left and right where a heading was
unknown. Vague starts (5 m, 1 rad) of teams drawn at random, 60 s: of 39 that were all ``ok`` one
was mirrored for 11 s; with this none of 31 for more than 3 s (docs/notebook/starts.md).
"""

APART_M = 0.3
"""Places of a way that are remembered are so far apart."""

PLACED = 3
"""So many nodes that are known place all others, on the right side."""


@dataclass(slots=True)
class Way:
    """What a node has gone, in the frame of its beginning."""

    places_m: list[complex] = field(default_factory=lambda: [0j])
    now_m: complex = 0j
    facing: complex = 1.0 + 0j

    def move(self, step: Advance) -> None:
        """Add a piece of motion."""
        self.now_m += self.facing * complex(step.dx_m, step.dy_m)
        self.facing *= cmath.rect(1.0, step.dtheta_rad)
        if abs(self.now_m - self.places_m[-1]) > APART_M:
            self.places_m.append(self.now_m)

    def bend_m(self) -> float:
        """Return how far it has been from a straight one: half of its width."""
        places = np.array(self.places_m)
        far = places[np.argmax(np.abs(places))]
        if far == 0.0:
            return 0.0
        return 0.5 * float(np.ptp((places * far.conjugate() / abs(far)).imag))


@dataclass(slots=True)
class Handedness:
    """Remembers whose heading or side was open, until a way beside it has bent.

    A team that goes straight on has the same distances as its mirror image, so that what they say
    of unknown headings, or of who has left a line, may be said of the image. The first bent way of
    those whose distance is known tells them apart; who turns on the spot tells nothing.
    """

    _open: set[int] = field(default_factory=set)
    _ways: dict[int, Way] = field(default_factory=dict)
    """Node -> its way since nothing has been open."""

    def move(self, step: Advance) -> None:
        """Add a piece of a node's reported motion."""
        if self._open:
            self._ways.setdefault(step.node, Way()).move(step)

    def unsure(self, unknown: Set[int], near: Mapping[int, Set[int]]) -> set[int]:
        """Return who may be its mirror image.

        ``unknown`` are those whose heading or side is open now, ``near`` each node's peers whose
        distance to it is known.
        """
        self._open |= unknown
        if unknown:
            self._ways.clear()
        bent = {node for node, way in self._ways.items() if way.bend_m() > BENT_M}
        self._open -= bent | {n for n in self._open if bent & near.get(n, set())}
        if not self._open:
            self._ways.clear()
        placing = near.keys() - self._open
        return {n for n in self._open if len(placing & near.get(n, set())) < PLACED} | unknown
