"""Torso kinematics: from a plan of steps to the sensor's path, attitude, forces and rates.

The sensor's path and the torso's attitude are built as smooth signals of time, band-limited to
some 40 Hz, and differentiated spectrally, so that velocity, specific force and angular rate are
the exact derivatives of the very path that is handed out as truth.

Built up as: way along the route from the steps; vertical excursion of the leg's inverted
pendulum (h = l - sqrt(l^2 - (s / 2k)^2), Zijlstra and Hof 1997) whose upward push is spread over
double support; fore-aft speed highest in double support; lateral sway and torso roll and yaw
once a stride, pitch once a step; a damped shock after each heel strike; quiet-standing sway of
the body as an inverted pendulum about the ankles, and breathing, at all times. The figures are
compared with real recordings in docs/gait.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.interpolate import CubicSpline

from relpos.simulation.walker import RATE_HZ, Person, Plan, Route, StepTruth, WalkerTruth
from relpos.simulation.world import GRAVITY_M_S2, FloatArray, World

PAD_S = 3.0
"""Motion made beyond both ends, where the spectral window fades it out."""

_PASS_HZ, _STOP_HZ = 28.0, 45.0
"""The torso has next to nothing above 25 Hz in the recordings; the fade is smooth."""

# Shocks after heel strike: a Gaussian push on a damped resonance. Each: peak of the push in m/s2
# (rotations: rad/s2) at 1.2 m/s, the power with which it grows over speed, resonance in Hz,
# damping ratio. Chosen by a random search over the harmonics of walk_chest (means of its 7 walks
# at 1.58 and 13 at 1.74 steps/s, docs/gait.md), powers held to 2.5 so that they carry to other
# speeds. Rotations are of the sensor on the moving chest, not of the whole trunk: the fore-aft
# shock would be three times as large otherwise.
_SHOCK_UP = (3.4, 1.0, 4.6, 0.2)
_SHOCK_FORE = (-7.7, 2.5, 4.5, 0.6)
_SHOCK_SIDE = (2.6, 2.5, 2.3, 0.27)
_SHOCK_PITCH = (44.0, 1.6, 5.6, 0.47)
_SHOCK_YAW = (5.6, 2.3, 2.8, 0.2)
_SHOCK_ROLL = (3.5, 1.6, 2.5, 0.3)
_PUSH_S = 0.025
"""Standard deviation in time of the push: heel pad, leg and spine let nothing faster through."""

_STRIKE_PHASE = 1.05
"""Where in the step the push peaks: just past the middle of double support; chosen likewise."""


class Spectral:
    """Low-pass and derivatives of signals on the padded time grid.

    The signal, less its end-to-end trend, is faded out inside the pads, which makes it periodic
    without touching what lies between them.
    """

    def __init__(self, count: int, pad: int) -> None:
        ramp = np.linspace(0.0, 1.0, pad)
        smooth = ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
        self._window = np.ones(count)
        self._window[:pad] = smooth
        self._window[-pad:] = smooth[::-1]
        self._count = count
        self._ramp = np.arange(count) / (count - 1.0)
        self._frequency = np.asarray(fft.rfftfreq(count, 1.0 / RATE_HZ), dtype=np.float64)
        fade = np.clip((self._frequency - _PASS_HZ) / (_STOP_HZ - _PASS_HZ), 0.0, 1.0)
        self._band = 0.5 * (1.0 + np.cos(np.pi * fade))

    def derivatives(
        self, signal: FloatArray, order: int, smooth_s: float | None = None
    ) -> list[FloatArray]:
        """Give the low-passed ``signal`` (n,) and its first ``order`` derivatives.

        The low-pass is the common band, or a Gaussian of ``smooth_s`` seconds.
        """
        rise = signal[-1] - signal[0]
        trend = signal[0] + rise * self._ramp
        spectrum = fft.rfft((signal - trend) * self._window)
        if smooth_s is None:
            spectrum = spectrum * self._band
        else:
            spectrum = spectrum * np.exp(-0.5 * (2 * np.pi * self._frequency * smooth_s) ** 2)
        out = []
        for k in range(order + 1):
            value = np.asarray(fft.irfft(spectrum, self._count), dtype=np.float64)
            if k == 0:
                value += trend
            elif k == 1:
                value += rise * RATE_HZ / (self._count - 1.0)
            out.append(value)
            spectrum = spectrum * (2j * np.pi * self._frequency)
        return out

    def transmitted(self, signal: FloatArray, resonance_hz: float, damping: float) -> FloatArray:
        """Motion (n,) of a mass carried on spring and damper by a base that moves as ``signal``."""
        rise = signal[-1] - signal[0]
        trend = signal[0] + rise * self._ramp
        omega, own = 2 * np.pi * self._frequency, 2 * np.pi * resonance_hz
        carried = own**2 + 2j * damping * own * omega
        spectrum = fft.rfft((signal - trend) * self._window) * (carried / (carried - omega**2))
        return np.asarray(trend + fft.irfft(spectrum, self._count), dtype=np.float64)

    def shocks(
        self,
        place: FloatArray,
        size: FloatArray,
        resonance_hz: float,
        damping: float,
        push_s: float = _PUSH_S,
    ) -> FloatArray:
        """Displacement (n,) of a damped resonance pushed at sample positions ``place`` (k,).

        ``size`` (k,) is the peak of the acceleration that each push of standard deviation
        ``push_s`` in time would give the free mass.
        """
        train = np.zeros(self._count)
        inside = (place >= 0) & (place < self._count - 1)
        low = place[inside].astype(np.int64)
        share = place[inside] - low
        weight = size[inside] * (push_s * math.sqrt(2 * np.pi) * RATE_HZ)
        np.add.at(train, low, weight * (1.0 - share))
        np.add.at(train, low + 1, weight * share)
        omega, own = 2 * np.pi * self._frequency, 2 * np.pi * resonance_hz
        response = np.exp(-0.5 * (omega * push_s) ** 2) / (
            own**2 - omega**2 + 2j * damping * own * omega
        )
        return np.asarray(fft.irfft(fft.rfft(train) * response, self._count), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Grid:
    """The time grid of a whole simulation, with its pads; shared by all walkers."""

    time_s: FloatArray
    pad: int
    count: int
    """Samples between the pads: what is handed out."""
    spectral: Spectral

    @property
    def inner(self) -> slice:
        """The samples between the pads."""
        return slice(self.pad, self.pad + self.count)


def make_grid(seconds: float) -> Grid:
    """Grid for ``seconds`` from time zero."""
    count = math.floor(seconds * RATE_HZ + 1e-9) + 1
    pad = round(PAD_S * RATE_HZ)
    total = fft.next_fast_len(count + 2 * pad, real=True)
    return Grid((np.arange(total) - pad) / RATE_HZ, pad, count, Spectral(total, pad))


def slow_noise(
    rng: np.random.Generator, time_s: FloatArray, sd: float, correlation_s: float
) -> FloatArray:
    """Smooth stationary noise with standard deviation ``sd``, (n,).

    Two cascaded first-order low-passes of ``correlation_s`` over white knots, then a spline.
    """
    knot_s = correlation_s / 4.0
    first = time_s[0] - 4 * knot_s
    count = math.ceil((time_s[-1] - first) / knot_s) + 6
    warm = 40
    decay = math.exp(-knot_s / correlation_s)
    value, slow, knots = 0.0, 0.0, np.empty(count)
    white = rng.standard_normal(count + warm)
    for i, w in enumerate(white):
        value = decay * value + (1 - decay) * w
        slow = decay * slow + (1 - decay) * value
        if i >= warm:
            knots[i - warm] = slow
    # Variance of the cascade driven by unit white noise.
    gain = (1 - decay) ** 4 * (1 + decay**2) / (1 - decay**2) ** 3
    spline = CubicSpline(first + knot_s * np.arange(count), knots * (sd / math.sqrt(gain)))
    return np.asarray(spline(time_s), dtype=np.float64)


def pendulum_rise_m(length_m: FloatArray, leg_m: float, gain: float) -> FloatArray:
    """Height that a leg's pendulum rises in a step of ``length_m``, for the person's gain."""
    half = np.minimum(length_m / (2.0 * gain), 0.6 * leg_m)
    return np.asarray(leg_m - np.sqrt(leg_m**2 - half**2), dtype=np.float64)


def vertical_shape(phase: FloatArray, support: FloatArray) -> FloatArray:
    """Height over one step, 0 at double support and 1 at mid-stance.

    The upward acceleration is a raised-cosine push of ``support`` of the step's duration around
    double support over a constant fall (the vault over the stance leg); its Fourier series,
    twice integrated, is cut after four terms.
    """
    turn = np.exp(2j * np.pi * phase)
    power = np.ones_like(turn)
    top = np.zeros_like(phase)
    out = np.zeros_like(phase)
    for n in range(1, 5):
        power = power * turn
        nd = n * support
        coefficient = np.sinc(nd) / (1.0 - nd**2) / n**2
        out -= coefficient * power.real
        if n % 2:
            top += 2.0 * coefficient
    at_support = np.zeros_like(phase)
    for n in range(1, 5):
        nd = n * support
        at_support -= np.sinc(nd) / (1.0 - nd**2) / n**2
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


def mounting(person: Person) -> FloatArray:
    """Sensor axes to body axes (3, 3): x up, y left, z backward, turned by the mounting error."""
    ideal = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    roll, pitch, yaw = (np.array([a]) for a in person.mount_rad)
    return np.asarray(rotation(roll, pitch, yaw)[0] @ ideal, dtype=np.float64)


def walk(
    rng: np.random.Generator,
    node: int,
    person: Person,
    route: Route,
    plan: Plan,
    grid: Grid,
    world: World,
    start_heading_rad: float | None,
) -> WalkerTruth:
    """Synthesise the truth of one walker. ``start_heading_rad`` is None for along the first leg."""
    t, spectral = grid.time_s, grid.spectral
    way, speed = spectral.derivatives(
        np.interp(t, plan.knot_time_s, plan.knot_way_m), 1, smooth_s=0.18
    )
    phase, cadence = spectral.derivatives(
        np.interp(t, plan.knot_time_s, plan.knot_phase), 1, smooth_s=0.18
    )
    speed = np.maximum(speed, 0.0)
    cadence = np.maximum(cadence, 0.0)
    # Local step length; the constant lets it end at zero where the person stands.
    length = speed / (cadence**4 + 0.5**4) ** 0.25
    going = np.tanh(speed / 0.25)

    # Route, with a slow wander to the side: nobody walks on a drawn line.
    span = max(float(way[-1]), 1.0) + 4.0
    side_s = np.arange(-2.0, span + 2.0, 0.25)
    aside = slow_noise(rng, side_s, 0.06, 3.0) * (1.0 - np.exp(-((np.maximum(side_s, 0) / 3) ** 2)))
    aside_spline = CubicSpline(side_s, aside)
    centre, bearing = route.at(way)
    offset = np.asarray(aside_spline(way), dtype=np.float64)
    slope = np.asarray(aside_spline(way, 1), dtype=np.float64)
    course = bearing + np.arctan(slope)

    # Torso attitude. It turns into a bend a little ahead of the feet, and looks about.
    lead = rng.uniform(0.05, 0.2)
    ahead = route.at(way + lead * speed)[1]
    stride = np.pi * phase
    tone = np.minimum(speed / 1.2, 1.6) ** 0.7
    shift = rng.normal(0.0, 0.3, 3)
    yaw = ahead + np.arctan(slope) + slow_noise(rng, t, math.radians(1.2), 2.5)
    yaw += person.yaw_rad * tone * np.cos(stride + shift[0])
    # Roll and pitch partly undo at the chest what the pelvis does: phases that bring the lateral
    # and fore-aft fundamentals from the pelvis' size down to the chest's.
    roll = -person.roll_rad * tone * np.sin(stride + 1.9 + shift[1])
    pitch = person.pitch_rad * tone * np.sin(2 * stride + 2.1 + shift[2])
    pitch += person.lean_rad * going
    if start_heading_rad is not None:
        since = np.clip((t - (plan.walk_start_s - 2.5)) / 2.0, 0.0, 1.0)
        turned = since**3 * (10 - 15 * since + 6 * since**2)
        yaw += (start_heading_rad - bearing[0]) * (1.0 - turned)

    # Quiet standing: sway about the ankles, 4 mm rms fore-aft at the chest, and breathing.
    sway_fore = slow_noise(rng, t, 0.004 * person.sway_scale, 0.7)
    sway_side = slow_noise(rng, t, 0.0025 * person.sway_scale, 0.7)
    breath = np.sin(2 * np.pi * (0.25 * t + 0.3 * slow_noise(rng, t, 1.0, 6.0)) + rng.uniform(0, 6))
    pitch += sway_fore / person.sensor_height_m + math.radians(0.2) * breath
    roll -= sway_side / person.sensor_height_m

    # Where the pelvis-borne trunk goes within the step.
    strength = (
        np.interp(
            phase, np.arange(len(plan.step_strength)) + 0.5, plan.step_strength, left=1.0, right=1.0
        )
        if len(plan.step_strength)
        else np.ones_like(t)
    )
    rise = pendulum_rise_m(length, person.leg_length_m, person.pendulum_gain) * strength
    support = 0.72 - 0.10 * np.clip((1.2 - speed) / 0.7, 0.0, 1.0)
    up = rise * (vertical_shape(phase, support) - 1.0)
    fore = 0.10 * speed / (2 * np.pi * np.maximum(cadence, 0.4)) * np.sin(2 * stride) * going
    lateral = person.lateral_scale * np.maximum(0.038 - 0.014 * speed, 0.015) * going
    side = lateral * np.sin(stride)

    # What heel strikes shake.
    whole = np.arange(len(plan.step_strength))
    strike_s = np.interp(whole + _STRIKE_PHASE, plan.knot_phase[1:], plan.knot_time_s[1:])
    # Strikes are not as punctual as the vault: 12 ms, and 20 % in size.
    strike_s = strike_s + 0.012 * rng.standard_normal(len(whole))
    pace = np.interp(strike_s, t, speed) / 1.2
    spread = np.exp(0.2 * rng.standard_normal((6, len(whole))))
    foot = np.where(whole % 2 == 0, 1.0, -1.0)

    def shock(kind: tuple[float, float, float, float], row: int, sign: FloatArray) -> FloatArray:
        size, power, resonance, damping = kind
        size_k = size * person.impact_scale * pace**power * spread[row] * sign
        return spectral.shocks((strike_s - t[0]) * RATE_HZ, size_k, resonance, damping)

    both = np.ones(len(whole))
    up += shock(_SHOCK_UP, 0, both)
    fore += shock(_SHOCK_FORE, 1, both)
    side += shock(_SHOCK_SIDE, 2, foot)
    wobble_pitch = shock(_SHOCK_PITCH, 3, both)
    wobble_yaw = shock(_SHOCK_YAW, 4, foot)
    wobble_roll = shock(_SHOCK_ROLL, 5, foot)

    # The sensor: on the chest, 0.35 m above and 0.1 m before the trunk's turning point.
    trunk = rotation(roll, pitch, yaw)
    yaw, yaw_rate = spectral.derivatives(yaw + wobble_yaw, 1)
    pitch, pitch_rate = spectral.derivatives(pitch + wobble_pitch, 1)
    roll, roll_rate = spectral.derivatives(roll + wobble_roll, 1)
    body = rotation(roll, pitch, yaw)
    arm = np.array([0.10, 0.0, 0.20 * person.stature_m])
    cos, sin = np.cos(course), np.sin(course)
    fore += sway_fore + 0.0015 * breath
    side += sway_side + offset
    # The wander is measured across the route, the rest along and across the course.
    position = np.empty((len(t), 3))
    across = side - offset
    position[:, 0] = centre[:, 0] - offset * np.sin(bearing) + fore * cos - across * sin
    position[:, 1] = centre[:, 1] + offset * np.cos(bearing) + fore * sin + across * cos
    position[:, 2] = person.sensor_height_m - arm[2] + up
    position += trunk @ arm
    velocity, acceleration = np.empty_like(position), np.empty_like(position)
    for axis in range(3):
        position[:, axis], velocity[:, axis], acceleration[:, axis] = spectral.derivatives(
            position[:, axis], 2
        )

    inner = grid.inner
    body, position, velocity = body[inner], position[inner], velocity[inner]
    force = acceleration[inner] + np.array([0.0, 0.0, GRAVITY_M_S2])
    rate = np.empty_like(force)
    r, p = roll[inner], pitch[inner]
    dr, dp, dy = roll_rate[inner], pitch_rate[inner], yaw_rate[inner]
    rate[:, 0] = dr - dy * np.sin(p)
    rate[:, 1] = dp * np.cos(r) + dy * np.cos(p) * np.sin(r)
    rate[:, 2] = -dp * np.sin(r) + dy * np.cos(p) * np.cos(r)
    mount = mounting(person)
    attitude = body @ mount
    magnetic = np.einsum("nji,nj->ni", attitude, _field(world, position))
    return WalkerTruth(
        node=node,
        person=person,
        time_s=t[inner] + 0.0,
        position_m=position,
        velocity_m_s=velocity,
        heading_rad=yaw[inner],
        attitude=attitude,
        specific_force_m_s2=np.einsum("nji,nj->ni", attitude, force),
        angular_rate_rad_s=rate @ mount,
        magnetic_field_ut=magnetic,
        pressure_pa=world.pressure_pa(position[:, 2]),
        steps=_steps(t, phase, way, grid),
        walk_start_s=plan.walk_start_s,
    )


def _field(world: World, position_m: FloatArray) -> FloatArray:
    """Sample the magnetic field along a path at 20 Hz, then spline: it varies over metres."""
    if world.magnetic.disturbance_ut <= 0.0 or len(position_m) < 100:
        return world.magnetic.field_ut(position_m)
    index = np.arange(0, len(position_m) + 9, 10)
    index[-1] = len(position_m) - 1
    index = np.unique(np.minimum(index, len(position_m) - 1))
    spline = CubicSpline(index, world.magnetic.field_ut(position_m[index]))
    return np.asarray(spline(np.arange(len(position_m))), dtype=np.float64)


def _steps(t: FloatArray, phase: FloatArray, way: FloatArray, grid: Grid) -> StepTruth:
    """Mid-stance where the phase passes half a step, and the way between."""
    increasing = np.maximum.accumulate(phase)
    last = math.floor(increasing[-1] - 0.5 + 1e-9)
    middle = np.arange(max(last + 1, 0)) + 0.5
    # First sample at or past the phase, refined linearly.
    at = np.clip(np.searchsorted(increasing, middle), 1, len(t) - 1)
    rise = np.maximum(increasing[at] - increasing[at - 1], 1e-12)
    time_s = t[at] - (increasing[at] - middle) / rise / RATE_HZ
    length = np.diff(np.interp(time_s, t, way), prepend=way[0])
    keep = (time_s >= 0.0) & (time_s <= t[grid.inner][-1])
    return StepTruth(time_s[keep], length[keep])
