"""How a reported displacement moves a pose: the paper's eqs. (2) to (4).

The paper writes, for each user,

    x     <- x + dx + dx N(0, sigma_d^2)                                        (2)
    y     <- y + dy + dy N(0, sigma_d^2)                                        (3)
    theta <- theta + dtheta + dtheta N(0, sigma_theta^2)                        (4)

Taken literally in the global frame, theta does nothing. It has to be read as a displacement in
the *body* frame that is turned by the particle's own theta: (dx, dy) is noised first, then
rotated, and theta is updated last, because a motion is given in the heading frame of its
beginning.

The noise is proportional to the displacement, so a standing node gets none, and a straight walk
none in heading. What a real sensor adds on top is set by the two floors, which grow with the
square root of time and are zero by default, and by the standard deviations that a report brings
with it (``motion.csv``); the larger variance counts.

A chord that the timeline has cut carries its share f of the report: with the standard deviation
divided by sqrt(f) the pieces' variances add up to the whole report's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from relpos.fusion.timeline import Advance

SCALE_WALK = 2e-5
"""Random walk of a step scale's logarithm, 1 per second of moving: 11 % in ten minutes.

Teams that begin to crawl need it; constant scales do not suffer (docs/notebook/bank.md)."""

SCALES_TELL = 5.0
"""A range tells of its users' common step scale where the square of its slope in that is so many
times the variance of its prediction.

Where they walk side by side, a common scale changes their ranges by the noise of headings alone,
and shorter steps always explain that noise better: the scale shrank for as long as they did so
(docs/notebook/bank.md)."""


def velocity_m_s(step: Advance) -> tuple[float, float]:
    """Return the velocity, forward and left at its end, of a displacement given at its begin."""
    turn_rad, duration_s = step.dtheta_rad, step.duration_s
    if duration_s <= 0.0:
        return 0.0, 0.0
    c, s = math.cos(turn_rad) / duration_s, math.sin(turn_rad) / duration_s
    return c * step.dx_m + s * step.dy_m, c * step.dy_m - s * step.dx_m


def reported_sigmas(step: Advance) -> tuple[float, float, float]:
    """Return a piece's reported deviations of forward (m), left (m), turn (rad); NaN where none.

    Ranges correct the path as it goes: a common scale error does not build up, so that the
    motion's error alone counts where it is reported. Who moves without any error does not know it:
    zeros stand for that elsewhere.
    """
    along = step.sigma_x_m if step.sigma_x_alone_m is None else step.sigma_x_alone_m
    moved = step.dx_m != 0.0 or step.dy_m != 0.0
    if moved and not (along or step.sigma_y_m or step.sigma_theta_rad):
        return math.nan, math.nan, math.nan
    return (
        math.nan if along is None else along,
        math.nan if step.sigma_y_m is None else step.sigma_y_m,
        math.nan if step.sigma_theta_rad is None else step.sigma_theta_rad,
    )


def known_sigmas(step: Advance) -> tuple[float, float, float]:
    """As :func:`reported_sigmas`, 0 where none is reported."""
    along, left, turn = (0.0 if math.isnan(s) else s for s in reported_sigmas(step))
    return along, left, turn


WALK_M_S, WALK_S = 1.0, 4.0
"""Speed of a person of whom no motion is reported, and how long it keeps its direction."""

RANGES_SHARE = 0.2
"""Weight of a report in the usual number of ranges within one."""


def is_long(duration_s: float, fraction: float) -> bool:
    """Whether a report takes longer than people walk straight; its ``fraction`` took so long."""
    return duration_s > WALK_S * fraction


@dataclass(slots=True)
class WithinReport:
    """How far a node may be from where an even walk within its report has it.

    Who sets off or stops between two reports walks only a part of the time. With the report's
    speed v, that of the one before and the usual one, the most that it can be off is

        a = T min(v (1 - v / max(before, usual)), |v - before|),

    nothing where the walk is even, and 4 f (1 - f) of it after a share f of the report. At its end
    the node is where it says, so that this is an error of the ranges in between, and all of them
    have it in common: of n each counts as if its variance were n times it. With a range every
    0.1 s a pair nothing else errs as much (``mission-dense``).
    """

    variance_m2: float = 0.0
    """Along any one direction."""
    long: bool = False
    """Of the report (:func:`is_long`)."""
    _done: float = 0.0
    _before_m_s: float = 0.0
    _ranges: int = 0
    _usual_ranges: float = 1.0

    def move(self, length_m: float, duration_s: float, fraction: float, usual_m_s: float) -> None:
        """Add a piece of a report, ``fraction`` of it."""
        if duration_s <= 0.0 or fraction <= 0.0:
            return
        speed = length_m / duration_s
        self.long = is_long(duration_s, fraction)
        self._done += fraction
        if self._done > 1.0 - 1e-6:
            self._usual_ranges += RANGES_SHARE * (self._ranges - self._usual_ranges)
            self._before_m_s, self._done, self._ranges, self.variance_m2 = speed, 0.0, 0, 0.0
            return
        slack = max(1.0 - speed / max(self._before_m_s, usual_m_s, 1e-9), 0.0)
        most_m = duration_s / fraction * min(speed * slack, abs(speed - self._before_m_s))
        self.variance_m2 = 0.5 * (4.0 * self._done * (1.0 - self._done) * most_m) ** 2

    @property
    def ended(self) -> bool:
        """Whether it is where a report ends."""
        return self._done == 0.0

    def range_variance_m2(self) -> float:
        """Add a range; return the variance by which it counts as less exact."""
        self._ranges += 1
        return max(self._usual_ranges, 1.0) * self.variance_m2


def unseen_variance(duration_s: float) -> float:
    """Return the variance (m^2, both axes) of the way that a person walks unseen.

    The velocity is an Ornstein-Uhlenbeck process: the deviation grows as the person walks at
    first, and as the square root of time later.
    """
    kept_s = WALK_S * (1.0 - math.exp(-duration_s / WALK_S))
    return 2.0 * WALK_M_S**2 * WALK_S * (duration_s - kept_s)


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """Parameters of the motion model.

    ``sigma_d`` and ``sigma_theta`` are relative (paper: 0.2 and 0.1); the floors are in
    m/sqrt(s) and rad/sqrt(s).
    """

    sigma_d: float = 0.2
    sigma_theta: float = 0.1
    floor_d_m: float = 0.0
    floor_theta_rad: float = 0.0

    def sigmas(self, step: Advance) -> tuple[float, float, float]:
        """Standard deviations of forward (m), left (m) and turn (rad) for one piece."""
        share = max(step.fraction, 1e-9) ** 0.5
        along, left, turn = known_sigmas(step)
        root_s = step.duration_s**0.5
        relative_d, relative_theta = self.sigma_d / share, self.sigma_theta / share
        floor_d, floor_theta = self.floor_d_m * root_s, self.floor_theta_rad * root_s
        return (
            max(abs(step.dx_m) * relative_d, floor_d, along),
            max(abs(step.dy_m) * relative_d, floor_d, left),
            max(abs(step.dtheta_rad) * relative_theta, floor_theta, turn),
        )
