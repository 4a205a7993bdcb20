"""Torso kinematics: from a plan of steps to the sensor's path, attitude, forces and rates.

The sensor's path and the torso's attitude are built as smooth signals of time, band-limited to
some 40 Hz, and differentiated spectrally, so that velocity, specific force and angular rate are
the exact derivatives of the very path that is handed out as truth.

Built up as: path along the route from the steps; vertical excursion of the leg's inverted
pendulum (h = l - sqrt(l^2 - (s / 2k)^2), Zijlstra and Hof 1997) whose upward push is spread over
double support; fore-aft speed highest in double support; lateral sway and torso roll and yaw
once a stride, pitch once a step; a damped shock after each heel strike; quiet-standing sway of
the body as an inverted pendulum about the ankles, and breathing, at all times. The figures are
compared with real recordings in docs/gait.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from relpos.simulation.spectral import Grid, slow_noise
from relpos.simulation.torso import (
    Sway,
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
from relpos.simulation.walker import Person, Plan, Route, WalkerTruth
from relpos.simulation.world import GRAVITY_M_S2, FloatArray, World


def pendulum_rise_m(length_m: FloatArray, leg_m: float, gain: float) -> FloatArray:
    """Height that a leg's pendulum rises in a step of ``length_m``, for the person's gain."""
    half = np.minimum(length_m / (2.0 * gain), 0.6 * leg_m)
    return np.asarray(leg_m - np.sqrt(leg_m**2 - half**2), dtype=np.float64)


def mounting(person: Person) -> FloatArray:
    """Sensor axes to body axes (3, 3): x up, y left, z backward, turned by the mounting error."""
    ideal = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    roll, pitch, yaw = (np.array([a]) for a in person.mount_rad)
    return np.asarray(rotation(roll, pitch, yaw)[0] @ ideal, dtype=np.float64)


class _Progress(NamedTuple):
    """How far along the route and the stride, (n,) each."""

    path_m: FloatArray
    speed_m_s: FloatArray
    phase: FloatArray
    cadence_hz: FloatArray
    going: FloatArray
    """0 standing, 1 walking."""

    @property
    def stride(self) -> FloatArray:
        """Phase of the stride in radians."""
        return np.asarray(np.pi * self.phase)


def _progress(plan: Plan, grid: Grid) -> _Progress:
    t, spectral = grid.time_s, grid.spectral
    path, speed = spectral.derivatives(
        np.interp(t, plan.knot_time_s, plan.knot_path_m), 1, smooth_s=0.18
    )
    phase, cadence = spectral.derivatives(
        np.interp(t, plan.knot_time_s, plan.knot_phase), 1, smooth_s=0.18
    )
    speed = np.maximum(speed, 0.0)
    return _Progress(path, speed, phase, np.maximum(cadence, 0.0), np.tanh(speed / 0.25))


class _Track(NamedTuple):
    """The route (n, 2), its bearing, and the walker's wander beside it, (n,) each."""

    centre_m: FloatArray
    bearing_rad: FloatArray
    aside_m: FloatArray
    slope_rad: FloatArray


def _track(rng: np.random.Generator, route: Route, path_m: FloatArray) -> _Track:
    """Where on the floor: a slow wander to the side, as people do not walk on a drawn line."""
    span = max(float(path_m[-1]), 1.0) + 4.0
    side_s = np.arange(-2.0, span + 2.0, 0.25)
    aside = slow_noise(rng, side_s, 0.06, 3.0) * (1.0 - np.exp(-((np.maximum(side_s, 0) / 3) ** 2)))
    spline = scipy.interpolate.CubicSpline(side_s, aside)
    centre, bearing = route.at(path_m)
    slope = np.asarray(spline(path_m, 1), dtype=np.float64)
    return _Track(centre, bearing, np.asarray(spline(path_m), dtype=np.float64), np.arctan(slope))


def _angles(
    rng: np.random.Generator,
    person: Person,
    route: Route,
    progress: _Progress,
    track: _Track,
    t: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roll, pitch and yaw of the torso: it turns into a bend a little ahead of the feet."""
    lead = rng.uniform(0.05, 0.2)
    ahead = route.at(progress.path_m + lead * progress.speed_m_s)[1]
    stride = progress.stride
    tone = np.minimum(progress.speed_m_s / 1.2, 1.6) ** 0.7
    shift = rng.normal(0.0, 0.3, 3)
    yaw = ahead + track.slope_rad + slow_noise(rng, t, math.radians(1.2), 2.5)
    yaw += person.yaw_rad * tone * np.cos(stride + shift[0])
    # Roll and pitch partly undo at the chest what the pelvis does: phases that bring the lateral
    # and fore-aft fundamentals from the pelvis' size down to the chest's.
    roll = -person.roll_rad * tone * np.sin(stride + 1.9 + shift[1])
    pitch = person.pitch_rad * tone * np.sin(2 * stride + 2.1 + shift[2])
    pitch += person.lean_rad * progress.going
    return roll, pitch, yaw


def _pelvis(person: Person, plan: Plan, progress: _Progress) -> tuple[FloatArray, ...]:
    """Where the pelvis-borne trunk moves within the step: up, fore and side."""
    phase, cadence, speed = progress.phase, progress.cadence_hz, progress.speed_m_s
    going, stride = progress.going, progress.stride
    # Local step length; the constant lets it end at zero where the person stands.
    length = speed / (cadence**4 + 0.5**4) ** 0.25
    strength = (
        np.interp(
            phase, np.arange(len(plan.step_strength)) + 0.5, plan.step_strength, left=1.0, right=1.0
        )
        if len(plan.step_strength)
        else np.ones_like(phase)
    )
    rise = pendulum_rise_m(length, person.leg_length_m, person.pendulum_gain) * strength
    support = 0.72 - 0.10 * np.clip((1.2 - speed) / 0.7, 0.0, 1.0)
    up = rise * (vertical_shape(phase, support) - 1.0)
    fore = 0.10 * speed / (2 * np.pi * np.maximum(cadence, 0.4)) * np.sin(2 * stride) * going
    lateral = person.lateral_scale * np.maximum(0.038 - 0.014 * speed, 0.015) * going
    return up, fore, lateral * np.sin(stride)


def _sensor_path(
    person: Person,
    track: _Track,
    trunk: FloatArray,
    moved: tuple[FloatArray, ...],
    sway: Sway,
) -> FloatArray:
    """Path (n, 3) of the sensor on the chest, .2 of the stature above the trunk's turning point.

    It is 0.1 m before it. The wander is measured across the route, the rest along and across the
    course.
    """
    up, fore, side = moved
    lever_arm = np.array([0.10, 0.0, 0.20 * person.stature_m])
    course = track.bearing_rad + track.slope_rad
    cos, sin = np.cos(course), np.sin(course)
    aside, bearing = track.aside_m, track.bearing_rad
    fore = fore + (sway.fore_m + 0.0015 * sway.breath)
    across = side + (sway.side_m + aside) - aside
    position = np.empty((len(up), 3))
    position[:, 0] = track.centre_m[:, 0] - aside * np.sin(bearing) + fore * cos - across * sin
    position[:, 1] = track.centre_m[:, 1] + aside * np.cos(bearing) + fore * sin + across * cos
    position[:, 2] = person.sensor_height_m - lever_arm[2] + up
    position += trunk @ lever_arm
    return position


def walk(
    rng: np.random.Generator,
    node: int,
    person: Person,
    route: Route,
    plan: Plan,
    grid: Grid,
    world: World,
) -> WalkerTruth:
    """Synthesise the truth of one walker, who stands facing along the first leg."""
    t, spectral = grid.time_s, grid.spectral
    progress = _progress(plan, grid)
    track = _track(rng, route, progress.path_m)
    roll, pitch, yaw = _angles(rng, person, route, progress, track, t)
    sway = quiet_sway(rng, t, person.sway_scale)
    sway.tilt(roll, pitch, person.sensor_height_m)

    strikes = draw_strikes(rng, plan.knot_phase[1:], plan.knot_time_s[1:], len(plan.step_strength))
    pace = np.interp(strikes.time_s, t, progress.speed_m_s) / 1.2
    shocks = heel_shocks(spectral, t[0], strikes, pace, person.impact_scale)
    moved = tuple(
        part + shock
        for part, shock in zip(_pelvis(person, plan, progress), shocks[:3], strict=True)
    )
    torso = shaken_attitude(spectral, roll, pitch, yaw, shocks[3:])
    position = _sensor_path(person, track, torso.trunk, moved, sway)
    if plan.flights:
        ground_m = np.interp(t, plan.knot_time_s, plan.knot_ground_m)
        position[:, 2] += spectral.derivatives(ground_m, 1, smooth_s=0.18)[0]
    velocity, acceleration = differentiate(spectral, position)

    inner = grid.inner
    position = position[inner]
    force = acceleration[inner] + np.array([0.0, 0.0, GRAVITY_M_S2])
    mount = mounting(person)
    attitude = torso.body[inner] @ mount
    return WalkerTruth(
        node=node,
        person=person,
        time_s=t[inner] + 0.0,
        position_m=position,
        velocity_m_s=velocity[inner],
        heading_rad=torso.yaw_rad[inner],
        attitude=attitude,
        specific_force_m_s2=np.einsum("nji,nj->ni", attitude, force),
        angular_rate_rad_s=torso.rate_rad_s[inner] @ mount,
        magnetic_field_ut=np.einsum("nji,nj->ni", attitude, field_along(world, position)),
        pressure_pa=world.pressure_pa(position[:, 2]),
        steps=true_steps(t, progress.phase, progress.path_m, grid),
        walk_start_s=plan.walk_start_s,
        flights=plan.flights,
    )
