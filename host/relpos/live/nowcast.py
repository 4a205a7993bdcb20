"""Each node's pose now: its newest fused estimate, and the motions that this does not contain yet.

A fused estimate is a second or two old, because it waits for every node; a motion is known as
soon as its packet arrives. The nowcast composes the motions since onto the estimate. It splits the
motion in which the estimate lies as the estimator does (:mod:`relpos.fusion.timeline`), scales
lengths by the learned ``step_scale``, and adds each motion's covariance. Nothing is extrapolated.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace

from relpos.fusion.estimator import ANY_ANGLE_RAD, Estimate, NodeEstimate, PairEstimate
from relpos.fusion.models.motion import MotionNoise
from relpos.fusion.timeline import Advance, Displacement
from relpos.measurements import Motion

MAX_CHORDS = 7200
"""Stored for a node without an estimate: two hours of motion."""


@dataclass(frozen=True, slots=True)
class _Chord:
    """A motion, the time at which it begins, and its number in the order of the fusion's input."""

    begin_s: float
    motion: Motion
    number: int

    def after(self, time_s: float, *, known: bool) -> tuple[Displacement, float]:
        """Return the part after ``time_s`` and its fraction of the chord; all where not ``known``.

        An estimate contains no part of a motion that had not reached the estimator.
        """
        motion = self.motion
        full = Displacement(motion.dx_m, motion.dy_m, motion.dtheta_rad)
        if not known or time_s <= self.begin_s:
            return full, 1.0
        fraction = (motion.time_s - time_s) / (motion.time_s - self.begin_s)
        return full.split(1.0 - fraction)[1], fraction


@dataclass(slots=True)
class _Pose:
    """A pose and its covariance, x, y, heading: the upper triangle of a symmetric 3 x 3 matrix."""

    x_m: float
    y_m: float
    heading_rad: float
    xx: float
    yy: float
    tt: float
    xy: float = 0.0
    xt: float = 0.0
    yt: float = 0.0

    def move(self, moved: Displacement, sigmas: tuple[float, float, float]) -> None:
        """Compose a displacement with its own independent deviations."""
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        dx_m = c * moved.dx_m - s * moved.dy_m
        dy_m = s * moved.dx_m + c * moved.dy_m
        # P <- F P F' + R Q R', F the identity but for the heading's lever (-dy, dx).
        self.xx += -2.0 * dy_m * self.xt + dy_m * dy_m * self.tt
        self.yy += 2.0 * dx_m * self.yt + dx_m * dx_m * self.tt
        self.xy += dx_m * self.xt - dy_m * self.yt - dx_m * dy_m * self.tt
        self.xt -= dy_m * self.tt
        self.yt += dx_m * self.tt
        along, left, turn = (sigma * sigma for sigma in sigmas)
        self.xx += c * c * along + s * s * left
        self.yy += s * s * along + c * c * left
        self.xy += c * s * (along - left)
        self.tt += turn
        self.x_m += dx_m
        self.y_m += dy_m
        self.heading_rad += moved.dtheta_rad


@dataclass(slots=True)
class _Track:
    """One node's motions since its newest estimate, and the pose that they lead to."""

    reported_s: float
    chords: deque[_Chord] = field(default_factory=lambda: deque(maxlen=MAX_CHORDS))
    fused: NodeEstimate | None = None
    pose: _Pose | None = None
    step_scale: float = 1.0
    version: int = 0


class Nowcast:
    """Composes motions, in the order of the fusion's input, onto the newest estimates.

    A node's first motion counts from the start of the session, as for the estimator.
    """

    def __init__(self) -> None:
        self._tracks: dict[int, _Track] = {}
        self._noise = MotionNoise()
        self.estimate: Estimate | None = None
        """The newest fused estimate."""

    def add_motion(self, motion: Motion, number: int) -> None:
        """Add a motion, the ``number``-th observation submitted to the fusion."""
        track = self._tracks.get(motion.node)
        if track is None:
            track = self._tracks[motion.node] = _Track(min(0.0, motion.time_s))
        chord = _Chord(track.reported_s, motion, number)
        track.reported_s = max(track.reported_s, motion.time_s)
        track.chords.append(chord)
        track.version += 1
        if track.pose is not None:
            self._compose(track, track.pose, chord, -math.inf, known=False)

    def add_estimate(self, estimate: Estimate, processed: int) -> None:
        """Add an estimate that was emitted after ``processed`` observations."""
        self.estimate = estimate
        scales = {p.node: p.value for p in estimate.parameters if p.name == "step_scale"}
        for node in estimate.nodes:
            track = self._tracks.get(node.node)
            if track is None:
                track = self._tracks[node.node] = _Track(0.0)
            track.fused = node
            track.step_scale = scales.get(node.node, 1.0)
            track.version += 1
            chords = track.chords
            while chords and chords[0].number <= processed:
                if chords[0].motion.time_s > estimate.time_s:
                    break
                chords.popleft()
            track.pose = _Pose(
                node.x_m,
                node.y_m,
                node.heading_rad,
                node.variance_x_m2,
                node.variance_y_m2,
                node.sigma_heading_rad**2,
                node.covariance_xy_m2,
            )
            for chord in chords:
                known = chord.number <= processed
                self._compose(track, track.pose, chord, estimate.time_s, known=known)

    def _compose(
        self, track: _Track, pose: _Pose, chord: _Chord, since_s: float, *, known: bool
    ) -> None:
        moved, fraction = chord.after(since_s, known=known)
        sigmas = self._sigmas(chord, moved, fraction)
        scale = track.step_scale
        pose.move(Displacement(scale * moved.dx_m, scale * moved.dy_m, moved.dtheta_rad), sigmas)

    def _sigmas(
        self, chord: _Chord, moved: Displacement, fraction: float
    ) -> tuple[float, float, float]:
        """Return standard deviations of a part: the node's own, else those of the paper's model."""
        motion, root = chord.motion, math.sqrt(fraction)
        along = motion.sigma_x_m if motion.sigma_x_alone_m is None else motion.sigma_x_alone_m
        reported = (along, motion.sigma_y_m, motion.sigma_theta_rad)
        duration_s = fraction * (motion.time_s - chord.begin_s)
        piece = (motion.time_s, motion.node, duration_s)
        modelled = self._noise.sigmas(
            Advance(*piece, moved.dx_m, moved.dy_m, moved.dtheta_rad, fraction)
        )
        x, y, turn = (
            model if sigma is None else sigma * root
            for sigma, model in zip(reported, modelled, strict=True)
        )
        return x, y, turn

    def version(self, node: int) -> int:
        """Return a number that changes with every motion and estimate of the node."""
        track = self._tracks.get(node)
        return 0 if track is None else track.version

    def newest_s(self, node: int) -> float | None:
        """Return the time up to which the pose contains motion; None before the first report."""
        track = self._tracks.get(node)
        if track is None:
            return None
        return track.chords[-1].motion.time_s if track.chords else track.reported_s

    def node(self, node: int) -> NodeEstimate | None:
        """Return the node of the newest estimate that has it, moved on to now."""
        track = self._tracks.get(node)
        if track is None or track.fused is None or track.pose is None:
            return None
        pose = track.pose
        return replace(
            track.fused,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=math.remainder(pose.heading_rad, 2.0 * math.pi),
            variance_x_m2=pose.xx,
            variance_y_m2=pose.yy,
            covariance_xy_m2=pose.xy,
            sigma_heading_rad=min(math.sqrt(pose.tt), ANY_ANGLE_RAD),
        )

    def pair(self, fused: PairEstimate) -> PairEstimate:
        """Return a pair of the newest estimate, moved on to now.

        The estimator's cross-covariance of the two stays in force; their motions since then are
        independent and add to it.
        """
        one, other = self._tracks[fused.node], self._tracks[fused.peer]
        a, b = one.pose, other.pose
        if a is None or b is None or one.fused is None or other.fused is None:
            return fused
        dx_m, dy_m = b.x_m - a.x_m, b.y_m - a.y_m
        distance_m = math.hypot(dx_m, dy_m)
        xx = a.xx + b.xx - one.fused.variance_x_m2 - other.fused.variance_x_m2
        yy = a.yy + b.yy - one.fused.variance_y_m2 - other.fused.variance_y_m2
        xy = a.xy + b.xy - one.fused.covariance_xy_m2 - other.fused.covariance_xy_m2
        c, s = (dx_m / distance_m, dy_m / distance_m) if distance_m > 0.0 else (1.0, 0.0)
        along = c * c * xx + 2.0 * c * s * xy + s * s * yy
        across = s * s * xx - 2.0 * c * s * xy + c * c * yy
        across_m2 = (fused.sigma_bearing_rad * fused.distance_m) ** 2 + max(across, 0.0)
        if distance_m > 0.0 and fused.sigma_bearing_rad < ANY_ANGLE_RAD:
            sigma_bearing = min(math.sqrt(across_m2) / distance_m, ANY_ANGLE_RAD)
        else:
            sigma_bearing = ANY_ANGLE_RAD
        return PairEstimate(
            fused.node,
            fused.peer,
            distance_m,
            math.sqrt(fused.sigma_distance_m**2 + max(along, 0.0)),
            math.atan2(dy_m, dx_m),
            sigma_bearing,
        )
