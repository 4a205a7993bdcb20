"""How a large team's covariance is stored: strips of nodes, and blocks of adjacent strips.

The area is divided into parallel strips. A buffer holds, strip after strip, block (k, k) of strip
k and then, strip after strip, block (k, k + 1) between it and the following one, each in columns
(Fortran's order) over the states x of all its nodes, then y, heading, drift and scale.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from relpos.fusion.arrays import Floats, Indices

COVARIANCE, INFORMATION = 5, 2
"""States of a node in the blocks: a covariance has all, information positions alone."""


class Blocks(NamedTuple):
    """Where the blocks (k, k) and (k, k + 1) begin in a buffer of ``total`` numbers."""

    diagonal: Indices
    following: Indices
    total: int


class StripLayout(NamedTuple):
    """Which node is in which strip, and where its states are."""

    members: Indices
    """Nodes, strip by strip (N,)."""
    first: Indices
    """Where the nodes of each strip begin in ``members``."""
    sizes: Indices
    """Nodes of each strip."""
    strip: Indices
    """Strip of each node (N,)."""
    slot: Indices
    """Place of each node in its strip (N,)."""
    covariance: Blocks
    information: Blocks

    def nodes_of(self, strip: int) -> Indices:
        """Return the nodes of a strip in the order of its rows."""
        return self.members[self.first[strip] : self.first[strip + 1]]

    def states(self) -> list[Indices]:
        """Return, for each strip, the rows of its block in a covariance kept node by node."""
        return [
            (COVARIANCE * self.nodes_of(k) + np.arange(COVARIANCE)[:, None]).reshape(-1)
            for k in range(len(self.sizes))
        ]

    def views(self, buffer: Floats, each: int) -> tuple[list[Floats], list[Floats]]:
        """Return the diagonal and the following blocks of a buffer as matrices."""
        blocks = self.covariance if each == COVARIANCE else self.information
        rows = (each * self.sizes).tolist()
        shapes = ((blocks.diagonal, rows), (blocks.following, rows[1:]))
        diagonal, following = (
            [
                buffer[start : start + m * p].reshape((m, p), order="F")
                for start, m, p in zip(starts.tolist(), rows, columns, strict=False)
            ]
            for starts, columns in shapes
        )
        return diagonal, following


def lay_out(strip: Indices) -> StripLayout:
    """Lay out nodes by their strips (N,), numbered 0, 1, ... without a gap."""
    members = np.argsort(strip, kind="stable")
    sizes = np.bincount(strip)
    first = np.concatenate([[0], np.cumsum(sizes)])
    slot = np.empty_like(strip)
    slot[members] = np.arange(strip.size) - np.repeat(first[:-1], sizes)
    blocks = []
    for each in (COVARIANCE, INFORMATION):
        entries = np.append((each * sizes) ** 2, each * each * sizes[:-1] * sizes[1:])
        start = np.concatenate([[0], np.cumsum(entries)])
        blocks.append(Blocks(start[: sizes.size], start[sizes.size : -1], int(start[-1])))
    return StripLayout(members, first, sizes, strip, slot, *blocks)
