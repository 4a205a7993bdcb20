"""What every simulated torso does, whatever moves it: turning, swaying, shaking; and its sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from relpos.simulation.spectral import Grid, Spectral, slow_noise
from relpos.simulation.walker import RATE_HZ, StepTruth
from relpos.simulation.world import FloatArray, World

_SHOCKS = (
    (3.4, 1.0, 4.6, 0.2),
    (-7.7, 2.5, 4.5, 0.6),
    (2.6, 2.5, 2.3, 0.27),
    (44.0, 1.6, 5.6, 0.47),
    (5.6, 2.3, 2.8, 0.2),
    (3.5, 1.6, 2.5, 0.3),
)
"""Shocks after heel strike, up, fore, side, pitch, yaw, roll: a Gaussian push on a damped
resonance. Each: peak of the push in m/s2 (rotations: rad/s2) at 1.2 m/s, the power with which it
grows over speed, resonance in Hz, damping ratio. Chosen by a random search over the harmonics of
walk_chest (means of its 7 walks at 1.58 and 13 at 1.74 steps/s, docs/gait.md), powers held to 2.5
so that they carry to other speeds. Rotations are of the sensor on the moving chest, not of the
whole trunk: the fore-aft shock would be three times as large otherwise."""
_SAME_FOR_BOTH_FEET = (0, 1, 3)

_STRIKE_PHASE = 1.05
"""Where in the step the push peaks: just past the middle of double support; chosen likewise."""


def vertical_shape(phase: FloatArray, support: FloatArray) -> FloatArray:
    """Height over one step, 0 at double support and 1 at mid-stance.

    The upward acceleration is a raised-cosine push of ``support`` of the step's duration around
    double support over a constant fall (the vault over the stance leg); its Fourier series,
    twice integrated, is cut after four terms.
    """
    turn = np.exp(2j * np.pi * phase)
    power = np.ones_like(turn)
    top, out, at_support = np.zeros((3, *phase.shape))
    for n in range(1, 5):
        power = power * turn
        nd = n * support
        coefficient = np.sinc(nd) / (1.0 - nd**2) / n**2
        out -= coefficient * power.real
        at_support -= coefficient
        if n % 2:
            top += 2.0 * coefficient
    return np.asarray((out - at_support) / top, dtype=np.float64)


def rotation(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Rz(yaw) Ry(pitch) Rx(roll), body (forward, left, up) to world, shape (n, 3, 3)."""
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    out = np.empty((len(roll), 3, 3))
    out[:, 0, 0] = cy * cp
    out[:, 0, 1] = cy * sp * sr - sy * cr
    out[:, 0, 2] = cy * sp * cr + sy * sr
    out[:, 1, 0] = sy * cp
    out[:, 1, 1] = sy * sp * sr + cy * cr
    out[:, 1, 2] = sy * sp * cr - cy * sr
    out[:, 2, 0] = -sp
    out[:, 2, 1] = cp * sr
    out[:, 2, 2] = cp * cr
    return out


def angular_rates(
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


@dataclass(frozen=True, slots=True)
class Attitude:
    """Torso to world (n, 3, 3): ``trunk`` as it swings, ``body`` as the shocks shake it too.

    ``yaw_rad`` (n,) and ``rate_rad_s`` (n, 3), in the body's axes, are the shaken body's.
    """

    trunk: FloatArray
    body: FloatArray
    yaw_rad: FloatArray
    rate_rad_s: FloatArray


def shaken_attitude(
    spectral: Spectral,
    roll: FloatArray,
    pitch: FloatArray,
    yaw: FloatArray,
    wobbles: Sequence[FloatArray],
) -> Attitude:
    """Attitude of a trunk at these angles (n,); ``wobbles`` are added to pitch, yaw and roll."""
    trunk = rotation(roll, pitch, yaw)
    yaw, yaw_rate = spectral.derivatives(yaw + wobbles[1], 1)
    pitch, pitch_rate = spectral.derivatives(pitch + wobbles[0], 1)
    roll, roll_rate = spectral.derivatives(roll + wobbles[2], 1)
    rate = angular_rates(roll, pitch, roll_rate, pitch_rate, yaw_rate)
    return Attitude(trunk, rotation(roll, pitch, yaw), yaw, rate)


@dataclass(frozen=True, slots=True)
class Sway:
    """Quiet standing: sway about the ankles, 4 mm rms fore-aft at the chest, and breathing."""

    fore_m: FloatArray
    side_m: FloatArray
    breath: FloatArray

    def tilt(self, roll: FloatArray, pitch: FloatArray, height_m: float) -> None:
        """Add to a torso's angles what the sway of a sensor at that height means."""
        pitch += self.fore_m / height_m + math.radians(0.2) * self.breath
        roll -= self.side_m / height_m


def quiet_sway(rng: np.random.Generator, t: FloatArray, scale: float) -> Sway:
    """Draw a person's sway at times ``t`` (n,)."""
    fore = slow_noise(rng, t, 0.004 * scale, 0.7)
    side = slow_noise(rng, t, 0.0025 * scale, 0.7)
    breath = np.sin(2 * np.pi * (0.25 * t + 0.3 * slow_noise(rng, t, 1.0, 6.0)) + rng.uniform(0, 6))
    return Sway(fore, side, np.asarray(breath))


@dataclass(frozen=True, slots=True)
class Strikes:
    """Foot strikes: times (k,), and random factors (6, k) on the sizes of their shocks."""

    time_s: FloatArray
    spread: FloatArray


def draw_strikes(
    rng: np.random.Generator,
    knot_phase: FloatArray,
    knot_time_s: FloatArray,
    count: int,
    irregularity: float = 1.0,
) -> Strikes:
    """Strikes are not as punctual as the vault: 12 ms, and 20 % in size."""
    strike_s = np.interp(np.arange(count) + _STRIKE_PHASE, knot_phase, knot_time_s)
    strike_s = strike_s + 0.012 * irregularity * rng.standard_normal(count)
    return Strikes(strike_s, np.exp(0.2 * irregularity * rng.standard_normal((6, count))))


def heel_shocks(
    spectral: Spectral,
    begin_s: float,
    strikes: Strikes,
    pace: FloatArray,
    impact_scale: float,
    step_scale: float | FloatArray = 1.0,
    scales: Sequence[float] = (1.0,) * 6,
) -> list[FloatArray]:
    """Displacements up, fore, side and rotations pitch, yaw, roll (n,) after the strikes.

    ``pace`` (k,) is the speed over 1.2 m/s; ``step_scale`` (k,) is a factor on the
    steps, ``scales`` on each of the six. The grid begins at ``begin_s``.
    """
    foot = np.where(np.arange(len(pace)) % 2 == 0, 1.0, -1.0)
    out = []
    for row, (push, power, resonance, damping) in enumerate(_SHOCKS):
        sign = 1.0 if row in _SAME_FOR_BOTH_FEET else foot
        size = push * scales[row] * impact_scale * step_scale * pace**power
        size = size * strikes.spread[row] * sign
        at = (strikes.time_s - begin_s) * RATE_HZ
        out.append(spectral.shocks(at, size, resonance, damping))
    return out


def differentiate(spectral: Spectral, position_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocity and acceleration (n, 3) of a path (n, 3), which is low-passed in place."""
    velocity, acceleration = np.empty_like(position_m), np.empty_like(position_m)
    for axis in range(3):
        position_m[:, axis], velocity[:, axis], acceleration[:, axis] = spectral.derivatives(
            position_m[:, axis], 2
        )
    return velocity, acceleration


def field_along(world: World, position_m: FloatArray) -> FloatArray:
    """Sample the magnetic field along a path at 20 Hz, then spline: it varies over metres."""
    if world.magnetic.disturbance_ut <= 0.0 or len(position_m) < 100:
        return world.magnetic.field_ut(position_m)
    index = np.arange(0, len(position_m) + 9, 10)
    index[-1] = len(position_m) - 1
    index = np.unique(np.minimum(index, len(position_m) - 1))
    spline = scipy.interpolate.CubicSpline(index, world.magnetic.field_ut(position_m[index]))
    return np.asarray(spline(np.arange(len(position_m))), dtype=np.float64)


def true_steps(t: FloatArray, phase: FloatArray, path_m: FloatArray, grid: Grid) -> StepTruth:
    """Mid-stance where the phase passes half a step, and the path between."""
    increasing = np.maximum.accumulate(phase)
    last = math.floor(increasing[-1] - 0.5 + 1e-9)
    middle = np.arange(max(last + 1, 0)) + 0.5
    # First sample at or past the phase, refined linearly.
    at = np.clip(np.searchsorted(increasing, middle), 1, len(t) - 1)
    slope = np.maximum(increasing[at] - increasing[at - 1], 1e-12)
    time_s = t[at] - (increasing[at] - middle) / slope / RATE_HZ
    length = np.diff(np.interp(time_s, t, path_m), prepend=path_m[0])
    keep = (time_s >= 0.0) & (time_s <= t[grid.inner][-1])
    return StepTruth(time_s[keep], length[keep])
