"""Whether left and right of a team may be exchanged."""

from __future__ import annotations

from collections.abc import Collection, Set
from dataclasses import dataclass, field

TURNED_RAD = 0.8
"""A turn that shows: its mirror image is as far off to the other side."""

PLACED = 3
"""So many nodes that are known place all others, on the right side."""


@dataclass(slots=True)
class Handedness:
    """Remembers whose heading was unknown, until somebody has turned.

    A team that goes straight on has the same distances as its mirror image, so that what they say
    of unknown headings may be said of the image. The first turn tells them apart.
    """

    _open: set[int] = field(default_factory=set)
    _turned_rad: dict[int, float] = field(default_factory=dict)
    """Node -> how far it has turned since all headings are known."""

    def turn(self, node: int, turn_rad: float) -> None:
        """Add a node's reported turn."""
        if self._open:
            self._turned_rad[node] = self._turned_rad.get(node, 0.0) + turn_rad

    def unsure(self, unknown: Set[int], nodes: Collection[int]) -> set[int]:
        """Return who may be its mirror image, of ``nodes`` with ``unknown`` headings among them."""
        self._open |= unknown
        if unknown:
            self._turned_rad.clear()
        elif any(abs(turned) > TURNED_RAD for turned in self._turned_rad.values()):
            self._open.clear()
        return self._open | unknown if len(nodes) - len(self._open) < PLACED else set(unknown)
