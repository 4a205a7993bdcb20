"""The hypotheses of a search: parameters, evidence and weights, and what changes them together."""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from relpos.fusion.arrays import Bools, Floats
from relpos.fusion.initial_poses import POSE, pose_columns
from relpos.fusion.initialisation.kernels import PER_NODE, Fits, Problem, fit

_TWO_PI = 2.0 * np.pi

_LEAST_LOG_EVIDENCE = 18.0
"""A hypothesis with so much less than the best one is dropped."""


@dataclass(slots=True)
class Hypotheses:
    """M hypotheses about N nodes; parameters as in :mod:`~relpos.fusion.initialisation.kernels`."""

    nodes: int = 0
    turns: int = 0
    """Turns of each node, K."""
    fits: Fits = field(
        default_factory=lambda: Fits(
            np.zeros((0, 1)), np.zeros(0), np.zeros(0), np.zeros((0, 0, 0))
        )
    )
    weights: Floats = field(default_factory=lambda: np.zeros(0))
    """(M,), as of the last merge."""

    def __len__(self) -> int:
        return len(self.fits.parameters)

    @property
    def by_node(self) -> Floats:
        """The parameters (M, N, 4 + K) of the nodes: a view."""
        return self.fits.parameters[:, :-1].reshape(len(self), self.nodes, PER_NODE + self.turns)

    @property
    def poses(self) -> Floats:
        """Poses (M, N, 3): a copy."""
        return self.by_node[:, :, :POSE].copy()

    def zeros(self, count: int) -> Floats:
        """Return parameters (``count``, D) of hypotheses to be placed."""
        return np.zeros((count, self.nodes * (PER_NODE + self.turns) + 1))

    def fit(self, iterations: int, problem: Problem) -> None:
        """Fit all of them; :meth:`merge` updates their weights."""
        self.fits = fitted(self.fits.parameters, iterations, problem)

    def add(self, fits: Fits) -> None:
        """Add other fits; :meth:`merge` has to follow."""
        self.fits = Fits(*(np.concatenate(both) for both in zip(self.fits, fits, strict=True)))

    def merge(self, most: int) -> None:
        """Keep one of those that have met, drop those without evidence, and weigh the rest."""
        score = log_evidence(self.fits)
        order = np.argsort(-score)
        order = order[score[order] > score[order[0]] - _LEAST_LOG_EVIDENCE]
        size, poses = POSE * self.nodes, self.poses
        kept: list[int] = []
        while order.size and len(kept) < most:
            best = order[0]
            kept.append(best)
            off = poses[order] - poses[best]
            off[:, :, 2] -= _TWO_PI * np.round(off[:, :, 2] / _TWO_PI)
            flat = off.reshape(order.size, size)
            solved = np.linalg.solve(self.fits.covariances[best], flat.T).T
            order = order[(flat * solved).sum(axis=1) > 1.0 + 0.25 * size]
        index = np.array(kept, dtype=np.intp)
        self.fits = Fits(*(each[index] for each in self.fits))
        weights = np.exp(score[index] - score[index[0]])
        self.weights = weights / weights.sum()

    def mirror_image(self, pose: Floats) -> Floats:
        """Return parameters (1, D) of the best one, reflected about the line that ``pose`` faces.

        ``pose`` (3,) is where the line begins, and its direction. Turns' errors begin at 0.
        """
        parameters = self.fits.parameters[:1].copy()
        by_node = parameters[:, :-1].reshape(self.nodes, -1)
        origin, facing = complex(pose[0], pose[1]), cmath.rect(1.0, pose[2])
        off = by_node[:, 0] + 1j * by_node[:, 1] - origin
        image = origin + facing**2 * off.conj()
        by_node[:, 0], by_node[:, 1] = image.real, image.imag
        by_node[:, 2] = 2.0 * pose[2] - by_node[:, 2]
        by_node[:, PER_NODE:] = 0.0
        return parameters

    # -- nodes and turns -----------------------------------------------------------------------

    def add_node(self) -> None:
        """Append a node's parameters, all zero."""
        if len(self):
            old = self.fits.parameters
            block = np.zeros((len(old), PER_NODE + self.turns))
            parameters = np.concatenate([old[:, :-1], block, old[:, -1:]], axis=1)
            self.fits = self.fits._replace(parameters=parameters)
        self.nodes += 1

    def insert_turn(self, node: int, needed: int) -> None:
        """Insert a turn of the node of index ``node`` before its newest one."""
        if needed > self.turns:
            by_node, bias = self.by_node, self.fits.parameters[:, -1]
            self.turns += 1
            if len(self):
                self.fits = self.fits._replace(parameters=self.zeros(len(by_node)))
                self.by_node[:, :, :-1] = by_node
                self.fits.parameters[:, -1] = bias
        if len(self):
            turns = self.by_node[:, node, PER_NODE:]
            turns[:, 1:] = turns[:, :-1].copy()
            turns[:, 0] = 0.0

    def merge_turns(self, node: int, newer: int, last: int) -> None:
        """Add turn ``newer + 1`` to turn ``newer``; ``last`` is the index of the oldest."""
        if len(self):
            turns = self.by_node[:, node, PER_NODE:]
            turns[:, newer] += turns[:, newer + 1]
            turns[:, newer + 1 : last] = turns[:, newer + 2 : last + 1].copy()
            turns[:, last] = 0.0

    def move(self, node: int, dx_m: float, dy_m: float, dtheta_rad: float) -> None:
        """Compose a displacement in the node's own frame."""
        if len(self):
            pose = self.by_node[:, node]
            stretch = np.exp(pose[:, 3])
            cosine, sine = np.cos(pose[:, 2]) * stretch, np.sin(pose[:, 2]) * stretch
            pose[:, 0] += cosine * dx_m - sine * dy_m
            pose[:, 1] += sine * dx_m + cosine * dy_m
            pose[:, 2] += dtheta_rad

    def agreeing(self, nodes: Sequence[int]) -> Bools:
        """Tell which hypotheses (M,) agree with the best one on where ``nodes`` are."""
        poses = self.poses
        off = poses[:, nodes] - poses[0, nodes]
        off[:, :, 2] = 0.0
        columns = pose_columns(nodes)
        spread = self.fits.covariances[0][np.ix_(columns, columns)]
        flat = off.reshape(len(poses), -1)
        agree = (flat * np.linalg.solve(spread, flat.T).T).sum(axis=1) < 9.0 + 2.0 * flat.shape[1]
        agree |= (off[:, :, :2] ** 2).sum(axis=2).max(axis=1) < 0.5
        result: Bools = agree
        return result

    def select(self, which: Bools, nodes: Sequence[int]) -> None:
        """Keep some hypotheses (M,) and some nodes."""
        blocks, bias = self.by_node[which][:, nodes], self.fits.parameters[which, -1:]
        columns = pose_columns(nodes)
        self.fits = Fits(
            np.concatenate([blocks.reshape(len(blocks), -1), bias], axis=1),
            self.fits.costs[which],
            self.fits.log_volumes[which],
            self.fits.covariances[which][:, columns][:, :, columns],
        )
        self.weights = self.weights[which] / self.weights[which].sum()
        self.nodes = len(nodes)


def log_evidence(fits: Fits) -> Floats:
    """Return the log evidence (M,) of the neighbourhoods of fits (Laplace)."""
    return -0.5 * fits.costs + fits.log_volumes


def fitted(parameters: Floats, iterations: int, problem: Problem) -> Fits:
    """Fit parameters (M, D), in place."""
    count, size = len(parameters), problem.cell.size
    fits = Fits(parameters, np.zeros(count), np.zeros(count), np.zeros((count, size, size)))
    fit(fits, iterations, problem)
    return fits
