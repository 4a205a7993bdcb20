"""The observations of nodes, in the form that link, recordings and estimators exchange.

Frames and signs: world x east-like, y north-like, z up, metres, radians counter-clockwise
(REP-103). Times are seconds from the start of the run on one clock. Every class is one row of
the run format's file of the same name, so that a live link, a recording and a simulation agree
and an estimator cannot distinguish them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import get_args


@dataclass(frozen=True, slots=True)
class Motion:
    """Displacement of ``node`` since its previous motion, seen from that previous pose.

    ``dx_m`` is forward and ``dy_m`` left in the node's own heading frame at the previous motion
    (paper sect. IV-B reports the same three numbers); ``dtheta_rad`` is counter-clockwise. The
    sigmas are standard deviations where the source knows them: the squares of ``sigma_x_m`` of
    consecutive motions add up to the variance of the way. What all of a wearer's steps err by
    together, their scale, makes each share in that sum larger than the motion's own error is;
    ``sigma_x_alone_m`` is that, for an estimator that corrects the way as it goes. ``steps`` are
    those that make up the displacement.
    """

    time_s: float
    node: int
    dx_m: float
    dy_m: float
    dtheta_rad: float
    sigma_x_m: float | None = None
    sigma_y_m: float | None = None
    sigma_theta_rad: float | None = None
    gain_version: int | None = None
    moving: bool | None = None
    sigma_x_alone_m: float | None = None
    steps: int | None = None


def at_rest(motion: Motion) -> Motion:
    """Return the motion of a node that cannot move, whatever its dead reckoning makes of noise."""
    return Motion(motion.time_s, motion.node, 0.0, 0.0, 0.0, moving=False, steps=0)


@dataclass(frozen=True, slots=True)
class Range:
    """One UWB two-way-ranging result between ``node`` (the initiator) and ``peer``."""

    time_s: float
    node: int
    peer: int
    range_m: float
    rss_dbm: float | None = None


def nodes_of(ranges: Iterable[Range]) -> set[int]:
    """Return the ids of all that take part in ranges."""
    return {node for measured in ranges for node in (measured.node, measured.peer)}


@dataclass(frozen=True, slots=True)
class Height:
    """Height of ``node`` over its own start, from pressure."""

    time_s: float
    node: int
    height_m: float
    sigma_m: float | None = None


@dataclass(frozen=True, slots=True)
class Heading:
    """An absolute heading of ``node``: magnetic, or a phone's."""

    time_s: float
    node: int
    heading_rad: float
    sigma_rad: float | None = None
    source: str | None = None


@dataclass(frozen=True, slots=True)
class Status:
    """One health figure of ``node``: battery, link, bus errors, resets."""

    time_s: float
    node: int
    name: str
    value: float


@dataclass(frozen=True, slots=True)
class Event:
    """A mark in the recording: landmark press, foot contact, bout."""

    time_s: float
    node: int
    event: str
    value: str = ""


@dataclass(frozen=True, slots=True)
class Step:
    """One step as the node's dead reckoning saw it, at mid-stance."""

    time_s: float
    node: int
    length_m: float


@dataclass(frozen=True, slots=True)
class Truth:
    """Ground truth of ``node``, for evaluation alone: no estimator ever sees one."""

    time_s: float
    node: int
    x_m: float
    y_m: float
    heading_rad: float | None = None
    z_m: float | None = None


WIDEST_START_M, WIDEST_START_RAD = 15.0, 1.8
"""A start that is less well known is searched for, as an unknown one is.

Four people on 30 m x 30 m, all off by their sigma, distance RMSE: 0.6 m from 10 m, 4 to 5 m from
20 m, 0.2 to 1.7 m where all is searched for. Headings cost 0.2 m at most up to 1.4 rad, 2.5 at pi.
"""


@dataclass(frozen=True, slots=True)
class Prior:
    """Pose of ``node`` at the start; a sigma of 0 means exactly known, an infinite one unknown."""

    node: int
    x_m: float
    y_m: float
    heading_rad: float
    sigma_m: float = 0.0
    sigma_rad: float = 0.0

    @property
    def is_known(self) -> bool:
        """Whether a filter can begin from it."""
        return self.sigma_m < WIDEST_START_M and self.sigma_rad < WIDEST_START_RAD


COMMON_M, COMMON_RAD = 0.5, math.radians(10.0)
"""People who start in one place stand half a metre and ten degrees apart (standard deviations)."""


def common_priors(nodes: Iterable[int]) -> tuple[Prior, ...]:
    """Return the priors of nodes that all start in one place, looking the same way."""
    return tuple(Prior(node, 0.0, 0.0, 0.0, COMMON_M, COMMON_RAD) for node in sorted(nodes))


Reading = Height | Heading
"""What a node measures of itself, besides its motion."""

Measurement = Motion | Range | Reading
"""Input of an estimator."""

Observation = Measurement | Status | Event | Step
"""Output of a link, a recording or an emulated team."""

MEASUREMENTS: tuple[type, ...] = get_args(Measurement)
"""At one time they come in this order."""


BOUNDS: Mapping[str, tuple[float, float]] = {
    "time_s": (-86_400.0, 604_800.0),
    "dx_m": (-1e3, 1e3),
    "dy_m": (-1e3, 1e3),
    "dtheta_rad": (-1e3, 1e3),
    "sigma_x_m": (0.0, 2e3),
    "sigma_y_m": (0.0, 2e3),
    "sigma_theta_rad": (0.0, 1e3),
    "sigma_x_alone_m": (0.0, 2e3),
    "steps": (0.0, 65_535.0),
    "range_m": (-1e3, 1e3),
    "rss_dbm": (-1e3, 1e3),
    "height_m": (-1e4, 1e4),
    "sigma_m": (0.0, 1e4),
    "pressure_pa": (0.0, 1e6),
    "heading_rad": (-1e3, 1e3),
    "sigma_rad": (0.0, 1e3),
    "length_m": (-1e2, 1e2),
    "value": (-1e15, 1e15),
    "x_m": (-1e8, 1e8),
    "y_m": (-1e8, 1e8),
    "z_m": (-1e8, 1e8),
    "stature_m": (0.0, 1e1),
    "leg_length_m": (0.0, 1e1),
    "antenna_offset_m": (-1e1, 1e1),
}
"""Least and greatest value of each quantity, by the name of its field or column.

Far beyond what a person can do in a session of a week (motions may span hours without radio,
coordinates may be a country's grid), and small enough that no sum of squares overflows. Readers of
files refuse what is beyond, estimators count it (``beyond_bounds``); docs/run-format.md shows it.
"""


LEAST_SIGMA = 1e-6
"""Least standard deviation (m, rad) of a measurement above 0, which means that it is not stated."""

_bounded_fields: dict[type, tuple[tuple[str, float, float, bool], ...]] = {}


def out_of_bounds(row: Observation | Truth | Prior) -> str | None:
    """Return the first field that is beyond its bounds, or no finite number; None where all fit.

    TypeError where one is no number at all.
    """
    kind = type(row)
    if kind not in _bounded_fields:
        _bounded_fields[kind] = tuple(
            (one.name, *BOUNDS[one.name], one.default is None)
            for one in fields(kind)
            if one.name in BOUNDS and one.type != "str"
        )
    for name, low, high, optional in _bounded_fields[kind]:
        value = getattr(row, name)
        if value is None and optional:
            continue
        if not low <= value <= high or (0.0 < value < LEAST_SIGMA and name.startswith("sigma")):
            return name
    return None


@dataclass(frozen=True, slots=True)
class RawSample:
    """What a node's sensors showed before any calibration, over one report.

    Mean specific force and angular rate (x, y, z) over ``samples`` inertial samples that end at
    ``time_s``, and the newest of ``field_readings`` magnetic fields meanwhile; None where a sensor
    gave nothing.
    """

    time_s: float
    node: int
    samples: int
    acceleration_m_s2: tuple[float, float, float] | None
    angular_rate_rad_s: tuple[float, float, float] | None
    magnetic_field_ut: tuple[float, float, float] | None
    field_readings: int
