"""The torso's motion of an itinerary: any posture, any activity, a sensor anywhere on the trunk.

Like `gait.walk`, path and attitude are band-limited signals that are differentiated spectrally,
so forces and rates are the exact derivatives of the path that is handed out. What differs: the
excursion comes with every step instead of from a pendulum, the body may turn, climb, lie and go
in a direction it does not face, and the sensor is carried by soft tissue and may slip.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from relpos.simulation.spectral import Grid, slow_noise
from relpos.simulation.torso import (
    Attitude,
    angular_rates,
    differentiate,
    draw_strikes,
    field_along,
    heel_shocks,
    quiet_sway,
    rotation,
    shaken_attitude,
    true_steps,
    vertical_shape,
)
from relpos.simulation.walker import RATE_HZ, StepTruth, WalkerTruth
from relpos.simulation.world import GRAVITY_M_S2, FloatArray, World
from wearers.activities import ACTIVITIES, HIP_OF_STATURE, STEP_FIELDS, Itinerary
from wearers.wearer import Wearer

_PLACE_SHOCKS = {
    "chest": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    "upper_back": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    "side": (0.8, 0.9, 1.0, 1.0, 1.2, 2.0),
    "lower_back": (0.65, 0.9, 1.0, 1.0, 1.5, 3.0),
}
"""Shocks up, fore, side, pitch, yaw, roll against the chest's, by where the sensor sits. The lower
back's by hand on the harmonics of walk_lowerback_20m; the side lies between (open)."""


@dataclass(frozen=True, slots=True)
class LabelledSteps(StepTruth):
    """Steps with the index into `ACTIVITIES` (k,) and the direction from the facing (k,)."""

    activity: np.ndarray[tuple[int], np.dtype[np.int8]]
    direction_rad: FloatArray


@dataclass(frozen=True, slots=True)
class WearerTruth(WalkerTruth):
    """`WalkerTruth` of any activity, with what is known about it.

    ``facing_rad`` (n,) is where the body faces without the trunk's oscillation (``heading_rad``
    has it), ``path_m`` (n,) how far the body has moved, in whatever direction; falls are
    in it but are no steps. ``activity`` (n,) are indices into `ACTIVITIES`, -1 after the last;
    ``intervals`` the same as (begin, end, label). ``angular_rate`` and ``specific_force`` are
    those of the sensor, wherever it sits and however it wobbles.
    """

    wearer: Wearer
    steps: LabelledSteps
    facing_rad: FloatArray
    path_m: FloatArray
    activity: np.ndarray[tuple[int], np.dtype[np.int8]]
    intervals: tuple[tuple[float, float, str], ...]

    @property
    def distance_m(self) -> float:
        """Path length from the first to the last sample."""
        return float(self.path_m[-1] - self.path_m[0])

    def since(self, begin_s: float) -> WearerTruth:
        """The same wearer, switched on at ``begin_s``: times count from there."""
        first = round(begin_s * RATE_HZ)
        begin_s = first / RATE_HZ
        keep = self.steps.time_s >= begin_s
        # The first step counts from where the person was when the sensor came on.
        length = self.steps.length_m[keep].copy()
        steps = LabelledSteps(
            self.steps.time_s[keep] - begin_s,
            length,
            self.steps.activity[keep],
            self.steps.direction_rad[keep],
        )
        if len(length):
            at = np.interp(steps.time_s[0], self.time_s[first:] - begin_s, self.path_m[first:])
            length[0] = min(length[0], float(at - self.path_m[first]))
        cut = slice(first, None)
        return replace(
            self,
            time_s=self.time_s[: len(self.time_s) - first],
            position_m=self.position_m[cut],
            velocity_m_s=self.velocity_m_s[cut],
            heading_rad=self.heading_rad[cut],
            attitude=self.attitude[cut],
            specific_force_m_s2=self.specific_force_m_s2[cut],
            angular_rate_rad_s=self.angular_rate_rad_s[cut],
            magnetic_field_ut=self.magnetic_field_ut[cut],
            pressure_pa=self.pressure_pa[cut],
            steps=steps,
            walk_start_s=max(self.walk_start_s - begin_s, 0.0),
            facing_rad=self.facing_rad[cut],
            path_m=self.path_m[cut] - self.path_m[first],
            activity=self.activity[cut],
            intervals=tuple(
                (max(a - begin_s, 0.0), b - begin_s, k) for a, b, k in self.intervals if b > begin_s
            ),
        )


def bearing_rad(path_m: FloatArray, bends: list[tuple[float, float, float]]) -> FloatArray:
    """Direction of the path (n,): in each bend the curvature is a raised cosine."""
    out = np.zeros_like(path_m)
    for begin, length, angle in bends:
        u = np.clip((path_m - begin) / length, 0.0, 1.0)
        out += angle * (u - np.sin(2 * np.pi * u) / (2 * np.pi))
    return out


class _Progress(NamedTuple):
    """What the feet do, (n,) each; ``shape`` interpolates the columns of `STEP_FIELDS`."""

    stepped_m: FloatArray
    phase: FloatArray
    turned_rad: FloatArray
    ground_m: FloatArray
    going: FloatArray
    """0 standing, 1 walking."""
    shape: Callable[[str], FloatArray]

    @property
    def stride(self) -> FloatArray:
        """Phase of the stride in radians."""
        return np.asarray(np.pi * self.phase)

    @property
    def pace(self) -> FloatArray:
        """Speed over 1.2 m/s, within the range that the recordings support."""
        return np.clip(self.shape("pace"), 0.0, 1.6)


def _progress(plan: Itinerary, steps: Mapping[str, FloatArray], grid: Grid) -> _Progress:
    def smooth(values: list[float], width_s: float = 0.18) -> tuple[FloatArray, FloatArray]:
        raw = np.interp(grid.time_s, plan.knot_time_s, values)
        value, slope = grid.spectral.derivatives(raw, 1, smooth_s=width_s)
        return value, slope

    phase, cadence = smooth(plan.knot_phase)

    def shape(name: str) -> FloatArray:
        if not plan.steps:
            return np.zeros_like(phase)
        return np.asarray(np.interp(phase, np.arange(len(plan.steps)) + 0.5, steps[name]))

    return _Progress(
        smooth(plan.knot_path_m)[0],
        phase,
        smooth(plan.knot_turn_rad, 0.22)[0],
        smooth(plan.knot_ground_m)[0],
        np.tanh(np.maximum(cadence, 0.0) / 0.4),
        shape,
    )


class _Track(NamedTuple):
    """Where the body is on the floor (n, 2), where it faces and moves, and how far it has moved."""

    centre_m: FloatArray
    facing_rad: FloatArray
    course_rad: FloatArray
    path_m: FloatArray


def _track(
    rng: np.random.Generator,
    plan: Itinerary,
    progress: _Progress,
    grid: Grid,
    start_heading_rad: float,
) -> _Track:
    """Return the track with lateral wander: 6 cm aside over 3 m."""
    t = grid.time_s
    path = progress.stepped_m + plan.slide.at(t)
    span = max(float(path[-1]), 1.0) + 4.0
    side_s = np.arange(-2.0, span + 2.0, 0.25)
    aside = scipy.interpolate.CubicSpline(side_s, slow_noise(rng, side_s, 0.06, 3.0))
    slope = np.arctan(np.asarray(aside(path, 1), dtype=np.float64))
    facing = start_heading_rad + progress.turned_rad + plan.twist.at(t)
    facing = facing + bearing_rad(progress.stepped_m, plan.bends) + slope
    course = facing + plan.offset.at(t)
    speed = np.gradient(path, 1.0 / RATE_HZ)
    east, north = speed * np.cos(course), speed * np.sin(course)
    centre = np.zeros((len(t), 2))
    centre[1:, 0] = np.cumsum(0.5 * (east[1:] + east[:-1])) / RATE_HZ
    centre[1:, 1] = np.cumsum(0.5 * (north[1:] + north[:-1])) / RATE_HZ
    centre -= centre[grid.pad]
    return _Track(centre, facing, course, path)


def _angles(
    rng: np.random.Generator,
    wearer: Wearer,
    plan: Itinerary,
    progress: _Progress,
    facing_rad: FloatArray,
    t: FloatArray,
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], float]:
    """Roll, pitch and yaw of the trunk (n,), and the phase of the fore-aft fluctuation.

    It turns into a bend a little ahead of the feet, oscillates with the stride, looks about.
    """
    tone = progress.going * progress.pace**0.7 * progress.shape("trunk")
    stride = progress.stride
    shift = rng.normal(0.0, (0.4, 0.4, 0.25, 0.4))
    shift[2] += wearer.pitch_phase_rad
    lead = rng.uniform(0.0, 0.25)
    yaw = np.interp(t + lead, t, facing_rad) + slow_noise(rng, t, math.radians(1.5), 2.5)
    low = 1.5 if wearer.place == "lower_back" else 1.0  # the pelvis turns more than the chest
    yaw += low * wearer.yaw_rad * tone * np.cos(stride + shift[0])
    roll = -wearer.roll_rad * tone * np.sin(stride + 1.9 + shift[1])
    roll += 0.3 * wearer.limp * progress.going * np.cos(stride + shift[1])
    pitch = wearer.pitch_rad * tone * np.sin(2 * stride + 2.1 + shift[2])
    pitch += wearer.lean_rad * progress.going + slow_noise(rng, t, math.radians(1.0), 1.5)
    pitch += plan.pitch.at(t)
    roll += plan.roll.at(t)
    return (roll, pitch, yaw), float(shift[3])


def _hips(wearer: Wearer, progress: _Progress, surge_phase_rad: float) -> list[FloatArray]:
    """Where the hips move within a step: up, fore and side (n,)."""
    going, stride = progress.going, progress.stride
    pace_m_s = 1.2 * progress.pace
    support = 0.72 - 0.10 * np.clip((1.2 - pace_m_s) / 0.7, 0.0, 1.0)
    up = progress.shape("excursion_m") * going * (vertical_shape(progress.phase, support) - 1.0)
    length = progress.shape("length_m")
    surge = progress.shape("surge") * length / (2 * np.pi)
    fore = surge * np.sin(2 * stride + surge_phase_rad) * going
    lateral = wearer.lateral_scale * np.maximum(0.038 - 0.014 * pace_m_s, 0.015)
    return [up, fore, lateral * progress.shape("sway") * going * np.sin(stride)]


def _shocks(
    rng: np.random.Generator,
    wearer: Wearer,
    plan: Itinerary,
    steps: Mapping[str, FloatArray],
    grid: Grid,
) -> list[FloatArray]:
    """Displacements up, fore, side and rotations pitch, yaw, roll after each foot strike."""
    count = len(plan.steps)
    if not count:
        return [np.zeros_like(grid.time_s) for _ in range(6)]
    phases, times = np.array(plan.knot_phase[1:]), np.array(plan.knot_time_s[1:])
    strikes = draw_strikes(rng, phases, times, count, wearer.irregularity)
    # The recordings fix the powers between 0.9 and 1.2 m/s only; held beyond 1.6 m/s.
    pace = np.clip(steps["pace"], 0.0, 1.35)
    begin_s = grid.time_s[0]
    out = heel_shocks(
        grid.spectral, begin_s, strikes, pace, wearer.impact_scale, steps["shock"],
        _PLACE_SHOCKS[wearer.place],
    )  # fmt: skip
    # The jolt of the heel itself, 20 ms before the slower shock.
    size = wearer.jolt_m_s2 * steps["shock"] * pace**1.5 * strikes.spread[0] ** 2
    at = (strikes.time_s - 0.02 - begin_s) * RATE_HZ
    jolt = grid.spectral.shocks(at, size, wearer.jolt_hz, 0.5, 0.008)
    out[0] = out[0] + jolt
    out[1] = out[1] - 0.5 * jolt
    return out


def _torso_path(
    wearer: Wearer,
    plan: Itinerary,
    progress: _Progress,
    track: _Track,
    moved: Sequence[FloatArray],
    grid: Grid,
) -> FloatArray:
    """Path (n, 3) of the hips' middle: ``moved`` up, fore and side, and what falls do to it."""
    up, fore, side = moved
    for blow in plan.impacts:
        at = np.array([(blow.time_s - grid.time_s[0]) * RATE_HZ])
        for part, size in ((up, blow.up_m_s2), (fore, blow.level_m_s2)):
            part += grid.spectral.shocks(at, np.array([size]), blow.resonance_hz, 0.35)
    position = np.empty((len(up), 3))
    course, facing = track.course_rad, track.facing_rad
    position[:, 0] = track.centre_m[:, 0] + fore * np.cos(course) - side * np.sin(facing)
    position[:, 1] = track.centre_m[:, 1] + fore * np.sin(course) + side * np.cos(facing)
    position[:, 2] = (
        HIP_OF_STATURE * wearer.stature_m + progress.ground_m + up - plan.drop.at(grid.time_s)
    )
    return position


def _carried(
    wearer: Wearer, plan: Itinerary, hips_m: FloatArray, trunk: FloatArray, grid: Grid
) -> tuple[FloatArray, FloatArray]:
    """Path (n, 3) of the sensor on its lever arm, and how far soft tissue lets it lag (n, 3)."""
    position = hips_m
    lever_arm = np.tile(np.array(wearer.arm_m), (len(position), 1))
    for slip in plan.slips:
        u = np.clip((grid.time_s - slip.begin_s) / slip.last_s, 0.0, 1.0)
        lever_arm += (u**3 * (10 - 15 * u + 6 * u**2))[:, None] * slip.shift_m
    position += np.einsum("nij,nj->ni", trunk, lever_arm)
    lag = np.zeros_like(position)
    if wearer.tissue_hz > 0.0:
        for axis in range(3):
            carried = grid.spectral.transmitted(
                position[:, axis], wearer.tissue_hz, wearer.tissue_damping
            )
            lag[:, axis] = carried - position[:, axis]
            position[:, axis] = carried
    return position, lag


def _mounted(
    rng: np.random.Generator,
    wearer: Wearer,
    plan: Itinerary,
    torso: Attitude,
    lag_m: FloatArray,
    grid: Grid,
) -> tuple[FloatArray, FloatArray]:
    """The sensor's attitude and rate: tipped by its lag, wandering in its strap, slipping."""
    t, spectral = grid.time_s, grid.spectral
    local = np.einsum("nji,nj->ni", torso.trunk, lag_m)
    tip = wearer.tissue_tilt_rad_m
    loose = [slow_noise(rng, t, wearer.loose_rad, 4.0) for _ in range(3)]
    roll, roll_rate = spectral.derivatives(loose[0] - tip * local[:, 2] * 0.7, 1)
    pitch, pitch_rate = spectral.derivatives(loose[1] + tip * local[:, 2], 1)
    yaw, yaw_rate = spectral.derivatives(loose[2] + tip * local[:, 1], 1)
    attitude, rate = _turned(
        torso.body,
        torso.rate_rad_s,
        rotation(roll, pitch, yaw),
        angular_rates(roll, pitch, roll_rate, pitch_rate, yaw_rate),
    )
    for slip in plan.slips:
        u = np.clip((t - slip.begin_s) / slip.last_s, 0.0, 1.0)
        angle = slip.angle_rad * u**3 * (10 - 15 * u + 6 * u**2)
        angle, angle_rate = spectral.derivatives(angle, 1)
        attitude, rate = _turned(
            attitude, rate, _about(slip.axis, angle), angle_rate[:, None] * slip.axis
        )
    return attitude, rate


def move(
    rng: np.random.Generator,
    node: int,
    wearer: Wearer,
    plan: Itinerary,
    grid: Grid,
    world: World,
    start_heading_rad: float = 0.0,
    carried_ut: FloatArray | None = None,
) -> WearerTruth:
    """Synthesise the truth of one wearer; ``carried_ut`` (3,) is a field fixed to the body."""
    t = grid.time_s
    table = np.array(plan.steps).reshape(-1, len(STEP_FIELDS))
    steps = {name: table[:, k] for k, name in enumerate(STEP_FIELDS)}
    progress = _progress(plan, steps, grid)
    track = _track(rng, plan, progress, grid, start_heading_rad)
    (roll, pitch, yaw), surge_phase = _angles(rng, wearer, plan, progress, track.facing_rad, t)
    sway = quiet_sway(rng, t, wearer.sway_scale)
    sway.tilt(roll, pitch, wearer.sensor_height_m)
    moved = _hips(wearer, progress, surge_phase)
    shocks = _shocks(rng, wearer, plan, steps, grid)
    moved[0] += shocks[0]
    moved[1] += shocks[1] + sway.fore_m + 0.0015 * sway.breath
    moved[2] += shocks[2] + sway.side_m
    torso = shaken_attitude(grid.spectral, roll, pitch, yaw, shocks[3:])
    hips = _torso_path(wearer, plan, progress, track, moved, grid)
    position, lag = _carried(wearer, plan, hips, torso.trunk, grid)
    velocity, acceleration = differentiate(grid.spectral, position)
    attitude, rate = _mounted(rng, wearer, plan, torso, lag, grid)

    inner, mount = grid.inner, wearer.axes_matrix
    position, attitude = position[inner], attitude[inner] @ mount
    force = acceleration[inner] + np.array([0.0, 0.0, GRAVITY_M_S2])
    field = field_along(world, position)
    if carried_ut is not None:
        field = field + torso.body[inner] @ carried_ut
    time_s = t[inner] + 0.0
    base = true_steps(t, progress.phase, progress.stepped_m, grid)
    activity = _labels(time_s, plan.intervals)
    at = np.clip(np.searchsorted(time_s, base.time_s), 0, len(time_s) - 1)
    direction = (track.course_rad - track.facing_rad)[inner][at]
    walking = [begin for begin, _, kind in plan.intervals if kind != "stand"]
    return WearerTruth(
        node=node,
        person=wearer,
        time_s=time_s,
        position_m=position,
        velocity_m_s=velocity[inner],
        heading_rad=torso.yaw_rad[inner],
        attitude=attitude,
        specific_force_m_s2=np.einsum("nji,nj->ni", attitude, force),
        angular_rate_rad_s=rate[inner] @ mount,
        magnetic_field_ut=np.einsum("nji,nj->ni", attitude, field),
        pressure_pa=world.pressure_pa(position[:, 2]),
        steps=LabelledSteps(base.time_s, base.length_m, activity[at], direction),
        walk_start_s=walking[0] if walking else float(time_s[-1]),
        wearer=wearer,
        facing_rad=track.facing_rad[inner],
        path_m=track.path_m[inner] - track.path_m[grid.pad],
        activity=activity,
        intervals=tuple(plan.intervals),
    )


def _turned(
    outer: FloatArray, outer_rate: FloatArray, inner: FloatArray, inner_rate: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Attitude ``outer @ inner`` and its rate in the inner's axes, both rates in their own."""
    return outer @ inner, np.einsum("nji,nj->ni", inner, outer_rate) + inner_rate


def _about(axis: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) about a unit axis: Rodrigues."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sin, cos = np.sin(angle_rad)[:, None, None], np.cos(angle_rad)[:, None, None]
    return np.asarray(np.eye(3) + sin * cross + (1.0 - cos) * (cross @ cross), dtype=np.float64)


def _labels(
    time_s: FloatArray, intervals: list[tuple[float, float, str]]
) -> np.ndarray[tuple[int], np.dtype[np.int8]]:
    out = np.full(len(time_s), -1, dtype=np.int8)
    for begin, end, kind in intervals:
        out[(time_s >= begin) & (time_s < end)] = ACTIVITIES.index(kind)
    return out
