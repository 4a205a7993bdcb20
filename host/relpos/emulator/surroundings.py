"""What surrounds an emulated board, and how imperfectly its chips measure it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from relpos.simulation.walker import RATE_HZ, WalkerTruth

FloatArray = NDArray[np.float64]

STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class Surroundings:
    """Physical quantities at the board, in the axes of accelerometer and gyroscope, noise-free.

    Uniform samples from virtual time 0 on: ``specific_force_m_s2``, ``angular_rate_rad_s`` and
    ``magnetic_field_ut`` are (n, 3), ``pressure_pa`` is (n,). Before and behind the samples the
    first and the last hold. ``silent_us`` are sorted, disjoint (begin, end) spans in which the
    inertial chip yields no new sample: the gaps of a recording that is played.
    """

    rate_hz: float
    specific_force_m_s2: FloatArray
    angular_rate_rad_s: FloatArray
    magnetic_field_ut: FloatArray
    pressure_pa: FloatArray
    temperature_c: float = 31.0
    silent_us: tuple[tuple[int, int], ...] = ()
    inertial: FloatArray = field(init=False, repr=False)
    """(n, 6): specific force and angular rate side by side."""

    def __post_init__(self) -> None:
        both = np.concatenate((self.specific_force_m_s2, self.angular_rate_rad_s), axis=1)
        object.__setattr__(self, "inertial", np.ascontiguousarray(both, dtype=np.float64))

    @classmethod
    def of(cls, walker: WalkerTruth) -> Surroundings:
        """What surrounds the board that a walker wears."""
        return cls(
            RATE_HZ,
            walker.specific_force_m_s2,
            walker.angular_rate_rad_s,
            walker.magnetic_field_ut,
            walker.pressure_pa,
        )

    def magnetic_field_at(self, time_us: float) -> FloatArray:
        """Field (3,) in microtesla, linear between samples."""
        return _linear(self.magnetic_field_ut, time_us * 1e-6 * self.rate_hz)

    def pressure_at(self, time_us: float) -> float:
        """Air pressure in pascal, linear between samples."""
        return float(_linear(self.pressure_pa, time_us * 1e-6 * self.rate_hz))

    def inertial_at(self, time_s: FloatArray) -> FloatArray:
        """Specific force and angular rate (m, 6) at ``time_s`` (m,), cubic between samples.

        Four-point Lagrange: at 200 Hz within 0.1 % up to 20 Hz, where linear loses 3 %.
        """
        rows = self.inertial
        position = np.clip(time_s * self.rate_hz, 0.0, len(rows) - 1.0)
        below = np.minimum(position.astype(np.int64), max(len(rows) - 2, 0))
        f = (position - below)[:, None]
        weights = (
            -f * (f - 1.0) * (f - 2.0) / 6.0,
            (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0,
            -(f + 1.0) * f * (f - 2.0) / 2.0,
            (f + 1.0) * f * (f - 1.0) / 6.0,
        )
        result = np.zeros((len(f), 6))
        for offset, weight in enumerate(weights, -1):
            result += rows.take(below + offset, axis=0, mode="clip") * weight
        return result


def _linear(rows: FloatArray, position: float) -> FloatArray:
    place = min(max(position, 0.0), len(rows) - 1.0)
    below = min(int(place), max(len(rows) - 2, 0))
    fraction = place - below
    above = rows[min(below + 1, len(rows) - 1)]
    return np.asarray((1.0 - fraction) * rows[below] + fraction * above)


@dataclass(frozen=True)
class InertialErrors:
    """How one MPU-9150 differs from truth; ``measured = gain @ true + bias + noise``.

    ``accelerometer_gain`` and ``gyroscope_gain`` are (3, 3): scale on the diagonal, cross-axis
    sensitivity beside it. Densities are one-sided white noise before the DLPF. The gyroscope's
    bias also walks. ``sample_clock_ppm`` is how much faster than nominal the chip samples.
    """

    accelerometer_gain: FloatArray = field(default_factory=lambda: np.eye(3))
    accelerometer_bias_m_s2: FloatArray = field(default_factory=lambda: np.zeros(3))
    accelerometer_noise_m_s2_rthz: float = 0.0
    gyroscope_gain: FloatArray = field(default_factory=lambda: np.eye(3))
    gyroscope_bias_rad_s: FloatArray = field(default_factory=lambda: np.zeros(3))
    gyroscope_noise_rad_s_rthz: float = 0.0
    gyroscope_walk_rad_s_rts: float = 0.0
    sample_clock_ppm: float = 0.0
    seed: int = 0


@dataclass(frozen=True)
class MagneticErrors:
    """How one AK8975 differs from truth; ``measured = soft_iron @ true + bias + noise``, own axes.

    ``adjustment`` are the factory's ASA bytes, ``bias_ut`` is hard iron, ``soft_iron`` (3, 3) the
    iron on the node that the field itself magnetises, with scale and alignment of the sensor.
    ``noise_ut`` is the standard deviation of one reading.
    """

    adjustment: tuple[int, int, int] = (128, 128, 128)
    bias_ut: FloatArray = field(default_factory=lambda: np.zeros(3))
    soft_iron: FloatArray = field(default_factory=lambda: np.eye(3))
    noise_ut: float = 0.0
    seed: int = 0


def draw_inertial_errors(rng: np.random.Generator) -> InertialErrors:
    """One chip from the tray.

    Typical spread, from the MPU-6050/9150 data sheets as remembered and to be checked on
    hardware: accelerometer bias sd 20 mg (specified +-80 mg), scale sd 1 % (specified +-3 %),
    cross axis sd 0.5 % (2 %), noise 400 ug/rtHz; gyroscope bias sd 2 deg/s (20 deg/s), scale sd
    1 % (3 %), noise 0.005 deg/s/rtHz, walk 0.002 deg/s/rts; sample clock from the gyroscope's
    PLL sd 0.3 %, never past the specified 1 %.
    """
    degree = np.pi / 180.0

    def gain() -> FloatArray:
        off = 0.005 * rng.standard_normal((3, 3))
        np.fill_diagonal(off, 1.0 + 0.01 * rng.standard_normal(3))
        return off

    return InertialErrors(
        accelerometer_gain=gain(),
        accelerometer_bias_m_s2=0.02 * STANDARD_GRAVITY_M_S2 * rng.standard_normal(3),
        accelerometer_noise_m_s2_rthz=400e-6 * STANDARD_GRAVITY_M_S2,
        gyroscope_gain=gain(),
        gyroscope_bias_rad_s=2.0 * degree * rng.standard_normal(3),
        gyroscope_noise_rad_s_rthz=0.005 * degree,
        gyroscope_walk_rad_s_rts=0.002 * degree,
        sample_clock_ppm=float(np.clip(3000.0 * rng.standard_normal(), -10_000.0, 10_000.0)),
        seed=int(rng.integers(1 << 62)),
    )


def draw_magnetic_errors(rng: np.random.Generator) -> MagneticErrors:
    """One chip from the tray: ASA within 128 +- 3 sd of 15, hard iron sd 3 uT, noise 0.3 uT."""
    adjustment = np.clip(np.rint(128.0 + 15.0 * rng.standard_normal(3)), 83, 173).astype(int)
    return MagneticErrors(
        adjustment=(int(adjustment[0]), int(adjustment[1]), int(adjustment[2])),
        bias_ut=3.0 * rng.standard_normal(3),
        noise_ut=0.3,
        seed=int(rng.integers(1 << 62)),
    )
