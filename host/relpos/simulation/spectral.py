"""Band-limited signals on the time grid of a simulation, and their exact derivatives."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy import fft  # scipy's differs in the last digits from 1.17 to 1.18: no walk is the same

from relpos.simulation.walker import RATE_HZ
from relpos.simulation.world import FloatArray

PAD_S = 3.0
"""Motion made beyond both ends, where the spectral window fades it out."""

_PASS_HZ, _STOP_HZ = 28.0, 45.0
"""The torso has next to nothing above 25 Hz in the recordings; the fade is smooth."""

_PUSH_S = 0.025
"""Standard deviation in time of the push: heel pad, leg and spine pass nothing faster."""


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
        fraction = place[inside] - low
        weight = size[inside] * (push_s * math.sqrt(2 * np.pi) * RATE_HZ)
        np.add.at(train, low, weight * (1.0 - fraction))
        np.add.at(train, low + 1, weight * fraction)
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
    total = scipy.fft.next_fast_len(count + 2 * pad, real=True)
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
    spline = scipy.interpolate.CubicSpline(
        first + knot_s * np.arange(count), knots * (sd / math.sqrt(gain))
    )
    return np.asarray(spline(time_s), dtype=np.float64)
