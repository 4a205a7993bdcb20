"""What a joint filter needs to know about finding initial poses.

A filter hands everything about nodes that it has not located to an :class:`Initialiser`, and adds
a node once the initialiser has found it. The filters know this protocol only;
:mod:`relpos.fusion.initialisation` implements it, and :mod:`relpos.fusion.switching` joins them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from relpos.errors import RelposError
from relpos.fusion.arrays import Bools, Floats, Indices
from relpos.fusion.estimator import NodeEstimate, NodeStatus, Presence, unlocated
from relpos.fusion.modes import belief_of
from relpos.fusion.timeline import Advance
from relpos.measurements import Prior, Range

POSE = 3
"""Numbers of a pose: x, y (m), heading (rad)."""

HEADING_RESOLVED_RAD = 0.35
"""A heading below this standard deviation is known: joint filters are near enough to linear."""


@dataclass(frozen=True, slots=True)
class PoseMixture:
    """Weighted hypotheses about the poses of ``nodes`` (N of them).

    Weights (K,), poses (K, N, 3) in m and rad, covariances (K, 3 N, 3 N).
    """

    nodes: tuple[int, ...]
    weights: Floats
    poses: Floats
    covariances: Floats
    scales: Floats
    """True over reported path length (N,), of the best hypothesis."""
    best: int = 0
    """The hypothesis with the most weight near it."""

    def of(self, index: int) -> tuple[Floats, Floats]:
        """Return the poses (K, 3) of ``nodes[index]``, and their covariances (K, 3, 3)."""
        own = slice(POSE * index, POSE * (index + 1))
        return self.poses[:, index], self.covariances[:, own, own]

    def part(self, nodes: Sequence[int], which: Indices | Bools | None = None) -> PoseMixture:
        """Return what the hypotheses ``which``, or all, say of some nodes (indices)."""
        some = slice(None) if which is None else which
        weights, columns = self.weights[some], pose_columns(nodes)
        return PoseMixture(
            tuple(self.nodes[i] for i in nodes),
            weights if which is None else weights / weights.sum(),
            self.poses[some][:, nodes],
            self.covariances[some][:, columns][:, :, columns],
            self.scales[nodes],
        )

    def place_covariances(self) -> Floats:
        """Return the covariances of the nodes' places (K, N, 2, 2)."""
        return np.stack([self.of(i)[1][:, :2, :2] for i in range(len(self.nodes))], axis=1)

    def moments(self, index: int) -> tuple[Floats, Floats]:
        """Return mean (3,) and covariance (3, 3) of the pose of ``nodes[index]``."""
        poses, covariances = self.of(index)
        off = poses - poses[self.best]
        off[:, 2] = np.remainder(off[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        mean = self.weights @ off
        off -= mean
        covariance = np.einsum("k,kab->ab", self.weights, covariances)
        covariance += np.einsum("k,ka,kb->ab", self.weights, off, off)
        return poses[self.best] + mean, covariance

    def heading_sigma_rad(self, index: int) -> float:
        """Return the standard deviation of the heading of ``nodes[index]``."""
        return belief_of(self.weights, *self.of(index)).sigma_heading_rad


def pose_columns(nodes: Sequence[int]) -> Indices:
    """Return the columns of a covariance of poses that belong to ``nodes`` (indices)."""
    columns: Indices = np.array(nodes, dtype=np.intp)[:, None] * POSE + np.arange(POSE)
    return columns.ravel()


class Initialiser(Protocol):
    """Finds the poses of nodes that are not located, from their motion and ranges."""

    counters: Counter[str]
    resolved: set[int]
    """Sought nodes whose pose is unambiguous; they are returned together with others."""

    def __contains__(self, node: int) -> bool:
        """Whether the node is sought."""

    def add(self, node: int, prior: Prior | None = None) -> None:
        """Seek a node; of its pose nothing is known, or what ``prior`` has a finite sigma of."""

    def advance(self, step: Advance, *, faulty: bool = False) -> None:
        """Move a sought node; of a ``faulty`` displacement only the turn is used."""

    def update(
        self,
        time_s: float,
        ranges: Sequence[Range],
        located: Mapping[int, tuple[float, float, float]],
        heights: Mapping[int, float],
    ) -> None:
        """Use the ranges of an instant, after the advances up to it.

        ``located``: node -> x, y (m), variance (m^2) of the nodes that are not sought;
        ``heights``: node -> m.
        """

    def find(self, time_s: float) -> PoseMixture | None:
        """Search at the end of an epoch; return the poses found, which are sought no more."""

    def cost_s(self) -> float:
        """Return about how many seconds of a processor ``find`` takes."""

    @property
    def mixture(self) -> PoseMixture | None:
        """Hypotheses about the sought nodes that are tied to a known one; None without any."""


def by_node(priors: Iterable[Prior]) -> list[Prior]:
    """Return priors in the order of their nodes; RelposError where one has two."""
    ordered = sorted(priors, key=lambda p: p.node)
    for one, other in pairwise(ordered):
        if one.node == other.node:
            raise RelposError(f"node {one.node} has two initial poses")
    return ordered


def sought_node(initialiser: Initialiser, node: int, presence: Presence) -> NodeEstimate:
    """Return what the initialiser knows of a node that it seeks."""
    mixture = initialiser.mixture
    if mixture is None or node not in mixture.nodes:
        return unlocated(node, presence.vertical)
    n = mixture.nodes.index(node)
    belief = belief_of(mixture.weights, *mixture.of(n), mixture.best)
    status = presence.status
    if status is NodeStatus.OK and node not in initialiser.resolved:
        status = NodeStatus.AMBIGUOUS
    spread = belief.covariance_m2
    return NodeEstimate(
        node, belief.x_m, belief.y_m, belief.heading_rad, float(spread[0, 0]),
        float(spread[1, 1]), float(spread[0, 1]), belief.sigma_heading_rad, status,
        *presence.vertical,
    )  # fmt: skip
