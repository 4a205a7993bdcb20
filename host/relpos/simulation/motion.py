"""The torso's motion of an itinerary: any posture, any activity, a sensor anywhere on the trunk.

Like `gait.walk`, path and attitude are band-limited signals that are differentiated spectrally,
so forces and rates are the exact derivatives of the path that is handed out. What differs: the
excursion comes with every step instead of from a pendulum, the body may turn, climb, lie and go
in a direction it does not face, and the sensor is carried by soft tissue and may slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from relpos.simulation import gait
from relpos.simulation.activities import ACTIVITIES, HIP_OF_STATURE, STEP_FIELDS, Itinerary
from relpos.simulation.gait import Grid, rotation, slow_noise, vertical_shape
from relpos.simulation.walker import RATE_HZ, StepTruth, WalkerTruth
from relpos.simulation.wearer import Wearer
from relpos.simulation.world import GRAVITY_M_S2, FloatArray, World

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
    has it), ``path_m`` (n,) the way that the body has moved, whatever its direction; falls are
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
        """Way moved from the first to the last sample."""
        return float(self.path_m[-1] - self.path_m[0])

    def since(self, begin_s: float) -> WearerTruth:
        """Give the same wearer, switched on at ``begin_s``: times count from there."""
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


def bearing_rad(way_m: FloatArray, bends: list[tuple[float, float, float]]) -> FloatArray:
    """Direction of the way (n,): in each bend the curvature is a raised cosine."""
    out = np.zeros_like(way_m)
    for begin, length, angle in bends:
        u = np.clip((way_m - begin) / length, 0.0, 1.0)
        out += angle * (u - np.sin(2 * np.pi * u) / (2 * np.pi))
    return out


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
    t, spectral = grid.time_s, grid.spectral

    def smooth(values: list[float], width_s: float = 0.18) -> tuple[FloatArray, FloatArray]:
        raw = np.interp(t, plan.knot_time_s, values)
        value, slope = spectral.derivatives(raw, 1, smooth_s=width_s)
        return value, slope

    stepped, _ = smooth(plan.knot_way_m)
    phase, cadence = smooth(plan.knot_phase)
    turned, _ = smooth(plan.knot_turn_rad, 0.22)
    ground, _ = smooth(plan.knot_ground_m)
    cadence = np.maximum(cadence, 0.0)
    going = np.tanh(cadence / 0.4)
    way = stepped + plan.slide.at(t)
    table = np.array(plan.steps).reshape(-1, len(STEP_FIELDS))
    column = {name: table[:, k] for k, name in enumerate(STEP_FIELDS)}

    def per_step(name: str) -> FloatArray:
        if not len(table):
            return np.zeros_like(t)
        centre = np.arange(len(table)) + 0.5
        return np.asarray(np.interp(phase, centre, column[name]))

    # Where the body goes, and where it faces. Nobody walks on a drawn line: 6 cm over 3 m.
    span = max(float(way[-1]), 1.0) + 4.0
    side_s = np.arange(-2.0, span + 2.0, 0.25)
    aside = CubicSpline(side_s, slow_noise(rng, side_s, 0.06, 3.0))
    slope = np.arctan(np.asarray(aside(way, 1), dtype=np.float64))
    facing = start_heading_rad + turned + plan.twist.at(t)
    facing = facing + bearing_rad(stepped, plan.bends) + slope
    course = facing + plan.offset.at(t)
    speed = np.gradient(way, 1.0 / RATE_HZ)
    east, north = speed * np.cos(course), speed * np.sin(course)
    centre = np.zeros((len(t), 2))
    centre[1:, 0] = np.cumsum(0.5 * (east[1:] + east[:-1])) / RATE_HZ
    centre[1:, 1] = np.cumsum(0.5 * (north[1:] + north[:-1])) / RATE_HZ
    centre -= centre[grid.pad]

    # Trunk: turns into a bend a little ahead of the feet, oscillates with the stride, looks about.
    pace = np.clip(per_step("pace"), 0.0, 1.6)
    tone = going * pace**0.7 * per_step("trunk")
    stride = np.pi * phase
    shift = rng.normal(0.0, (0.4, 0.4, 0.25, 0.4))
    shift[2] += wearer.pitch_phase_rad
    lead = rng.uniform(0.0, 0.25)
    yaw = np.interp(t + lead, t, facing) + slow_noise(rng, t, math.radians(1.5), 2.5)
    low = 1.5 if wearer.place == "lower_back" else 1.0  # the pelvis turns more than the chest
    yaw += low * wearer.yaw_rad * tone * np.cos(stride + shift[0])
    roll = -wearer.roll_rad * tone * np.sin(stride + 1.9 + shift[1])
    roll += 0.3 * wearer.limp * going * np.cos(stride + shift[1])
    pitch = wearer.pitch_rad * tone * np.sin(2 * stride + 2.1 + shift[2])
    pitch += wearer.lean_rad * going + slow_noise(rng, t, math.radians(1.0), 1.5)
    pitch += plan.pitch.at(t)
    roll += plan.roll.at(t)

    # Quiet standing: sway about the ankles, 4 mm rms fore-aft at the chest, and breathing.
    height = wearer.sensor_height_m
    sway_fore = slow_noise(rng, t, 0.004 * wearer.sway_scale, 0.7)
    sway_side = slow_noise(rng, t, 0.0025 * wearer.sway_scale, 0.7)
    breath = np.sin(2 * np.pi * (0.25 * t + 0.3 * slow_noise(rng, t, 1.0, 6.0)) + rng.uniform(0, 6))
    pitch += sway_fore / height + math.radians(0.2) * breath
    roll -= sway_side / height

    # The hips within a step.
    pace_m_s = 1.2 * pace
    support = 0.72 - 0.10 * np.clip((1.2 - pace_m_s) / 0.7, 0.0, 1.0)
    up = per_step("rise_m") * going * (vertical_shape(phase, support) - 1.0)
    length = per_step("length_m")
    fore = per_step("surge") * length / (2 * np.pi) * np.sin(2 * stride + shift[3]) * going
    lateral = wearer.lateral_scale * np.maximum(0.038 - 0.014 * pace_m_s, 0.015)
    side = lateral * per_step("sway") * going * np.sin(stride)

    # What heel strikes and falls shake.
    shocks = _shocks(rng, wearer, plan, column, t, spectral)
    up += shocks[0]
    fore += shocks[1] + sway_fore + 0.0015 * breath
    side += shocks[2] + sway_side
    for blow in plan.impacts:
        place = np.array([(blow.time_s - t[0]) * RATE_HZ])
        for axis, size in ((0, blow.up_m_s2), (1, blow.level_m_s2)):
            shake = spectral.shocks(place, np.array([size]), blow.resonance_hz, 0.35)
            if axis == 0:
                up += shake
            else:
                fore += shake

    trunk = rotation(roll, pitch, yaw)
    yaw, yaw_rate = spectral.derivatives(yaw + shocks[4], 1)
    pitch, pitch_rate = spectral.derivatives(pitch + shocks[3], 1)
    roll, roll_rate = spectral.derivatives(roll + shocks[5], 1)
    body = rotation(roll, pitch, yaw)
    rate = _rates(roll, pitch, roll_rate, pitch_rate, yaw_rate)

    # The sensor: an arm from the hips' middle along the trunk, its wobble on soft tissue.
    arm = np.tile(np.array(wearer.arm_m), (len(t), 1))
    for slip in plan.slips:
        u = np.clip((t - slip.begin_s) / slip.last_s, 0.0, 1.0)
        arm += (u**3 * (10 - 15 * u + 6 * u**2))[:, None] * slip.shift_m
    position = np.empty((len(t), 3))
    cos_c, sin_c = np.cos(course), np.sin(course)
    cos_f, sin_f = np.cos(facing), np.sin(facing)
    position[:, 0] = centre[:, 0] + fore * cos_c - side * sin_f
    position[:, 1] = centre[:, 1] + fore * sin_c + side * cos_f
    position[:, 2] = HIP_OF_STATURE * wearer.stature_m + ground + up - plan.drop.at(t)
    position += np.einsum("nij,nj->ni", trunk, arm)
    lag = np.zeros_like(position)
    if wearer.tissue_hz > 0.0:
        for axis in range(3):
            carried = spectral.transmitted(
                position[:, axis], wearer.tissue_hz, wearer.tissue_damping
            )
            lag[:, axis] = carried - position[:, axis]
            position[:, axis] = carried
    velocity, acceleration = np.empty_like(position), np.empty_like(position)
    for axis in range(3):
        position[:, axis], velocity[:, axis], acceleration[:, axis] = spectral.derivatives(
            position[:, axis], 2
        )

    # How the sensor turns on the body: tipped by its lag, wandering in its strap, slipping.
    local = np.einsum("nji,nj->ni", trunk, lag)
    tip = wearer.tissue_tilt_rad_m
    loose = [slow_noise(rng, t, wearer.loose_rad, 4.0) for _ in range(3)]
    tilt_roll, tilt_roll_rate = spectral.derivatives(loose[0] - tip * local[:, 2] * 0.7, 1)
    tilt_pitch, tilt_pitch_rate = spectral.derivatives(loose[1] + tip * local[:, 2], 1)
    tilt_yaw, tilt_yaw_rate = spectral.derivatives(loose[2] + tip * local[:, 1], 1)
    attitude, turn_rate = _turned(
        body,
        rate,
        rotation(tilt_roll, tilt_pitch, tilt_yaw),
        _rates(tilt_roll, tilt_pitch, tilt_roll_rate, tilt_pitch_rate, tilt_yaw_rate),
    )
    for slip in plan.slips:
        raw = np.clip((t - slip.begin_s) / slip.last_s, 0.0, 1.0)
        raw = slip.angle_rad * raw**3 * (10 - 15 * raw + 6 * raw**2)
        angle, angle_rate = spectral.derivatives(raw, 1)
        attitude, turn_rate = _turned(
            attitude, turn_rate, _about(slip.axis, angle), angle_rate[:, None] * slip.axis
        )
    mount = wearer.axes_matrix

    inner = grid.inner
    position, velocity = position[inner], velocity[inner]
    attitude = attitude[inner] @ mount
    force = acceleration[inner] + np.array([0.0, 0.0, GRAVITY_M_S2])
    field = gait._field(world, position)
    if carried_ut is not None:
        field = field + body[inner] @ carried_ut
    time_s = t[inner] + 0.0
    base = gait._steps(t, phase, stepped, grid)
    activity = _labels(time_s, plan.intervals)
    at = np.clip(np.searchsorted(time_s, base.time_s), 0, len(time_s) - 1)
    walking = [begin for begin, _, kind in plan.intervals if kind != "stand"]
    return WearerTruth(
        node=node,
        person=wearer,
        time_s=time_s,
        position_m=position,
        velocity_m_s=velocity,
        heading_rad=yaw[inner],
        attitude=attitude,
        specific_force_m_s2=np.einsum("nji,nj->ni", attitude, force),
        angular_rate_rad_s=turn_rate[inner] @ mount,
        magnetic_field_ut=np.einsum("nji,nj->ni", attitude, field),
        pressure_pa=world.pressure_pa(position[:, 2]),
        steps=LabelledSteps(base.time_s, base.length_m, activity[at], (course - facing)[inner][at]),
        walk_start_s=walking[0] if walking else float(time_s[-1]),
        wearer=wearer,
        facing_rad=facing[inner],
        path_m=way[inner] - way[grid.pad],
        activity=activity,
        intervals=tuple(plan.intervals),
    )


def _shocks(
    rng: np.random.Generator,
    wearer: Wearer,
    plan: Itinerary,
    column: dict[str, FloatArray],
    t: FloatArray,
    spectral: gait.Spectral,
) -> list[FloatArray]:
    """Displacements up, fore, side and rotations pitch, yaw, roll after each foot strike."""
    count = len(plan.steps)
    kinds = (
        gait._SHOCK_UP,
        gait._SHOCK_FORE,
        gait._SHOCK_SIDE,
        gait._SHOCK_PITCH,
        gait._SHOCK_YAW,
        gait._SHOCK_ROLL,
    )
    if not count:
        return [np.zeros_like(t) for _ in kinds]
    whole = np.arange(count)
    phases = np.array(plan.knot_phase[1:])
    times = np.array(plan.knot_time_s[1:])
    strike_s = np.interp(whole + gait._STRIKE_PHASE, phases, times)
    strike_s = strike_s + 0.012 * wearer.irregularity * rng.standard_normal(count)
    spread = np.exp(0.2 * wearer.irregularity * rng.standard_normal((6, count)))
    foot = np.where(whole % 2 == 0, 1.0, -1.0)
    scale = _PLACE_SHOCKS[wearer.place]
    # The recordings fix the powers between 0.9 and 1.2 m/s only; held beyond 1.6 m/s.
    pace = np.clip(column["pace"], 0.0, 1.35)
    out = []
    for row, (size, power, resonance, damping) in enumerate(kinds):
        sign = np.ones(count) if row in (0, 1, 3) else foot
        size_k = size * scale[row] * wearer.impact_scale * column["shock"] * pace**power
        size_k = size_k * spread[row] * sign
        out.append(spectral.shocks((strike_s - t[0]) * RATE_HZ, size_k, resonance, damping))
    # The jolt of the heel itself, 20 ms before the slower shock.
    size_k = wearer.jolt_m_s2 * column["shock"] * pace**1.5 * spread[0] ** 2
    place = (strike_s - 0.02 - t[0]) * RATE_HZ
    jolt = spectral.shocks(place, size_k, wearer.jolt_hz, 0.5, 0.008)
    out[0] = out[0] + jolt
    out[1] = out[1] - 0.5 * jolt
    return out


def _rates(
    roll: FloatArray,
    pitch: FloatArray,
    roll_rate: FloatArray,
    pitch_rate: FloatArray,
    yaw_rate: FloatArray,
) -> FloatArray:
    """Angular rate (n, 3) in the turned axes, of Rz(yaw) Ry(pitch) Rx(roll)."""
    return np.column_stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll),
            -pitch_rate * np.sin(roll) + yaw_rate * np.cos(pitch) * np.cos(roll),
        ]
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
