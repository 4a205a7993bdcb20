"""The world that walkers share: UWB ranging, radio, magnetic field and air pressure.

Walls are not in it: whether two tags hear each other depends on their distance and on slabs.
Nothing here is read by an estimator, and nothing here knows firmware or chips.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from relpos.simulation.storeys import SLAB_EXCESS_M, Building

FloatArray = NDArray[np.float64]

GRAVITY_M_S2 = 9.80665
"""Standard gravity; the walkers' specific force at rest has this magnitude."""


@dataclass(frozen=True, slots=True)
class UwbChannel:
    """Two-way ranging between two tags.

    Sources: the paper simulates ranges under 15 m with sigma 1 m and detection 0.5, and reports
    (fig. "Detected probability at different distances") that close pairs, too, sometimes miss
    each other; its curve is not printed as numbers, so detection falls here in a straight line
    from ``detection_near`` at 0 m to ``detection_far`` at the range limit. The 0.1 m noise is
    what UWB tags show in line of sight (0.09 to 0.22 m in the recordings); bodies in the way
    delay the first path by 0.5 to 2 m, which ``nlos_probability`` switches on.
    """

    max_range_m: float = 15.0
    detection_near: float = 0.95
    detection_far: float = 0.5
    noise_sigma_m: float = 0.1
    nlos_probability: float = 0.0
    nlos_bias_m: tuple[float, float] = (0.5, 2.0)

    def detection_probability(self, distance_m: float) -> float:
        """Probability that one attempt at ``distance_m`` gives a range; 0 past the limit."""
        if not 0.0 <= distance_m <= self.max_range_m:
            return 0.0
        fall = self.detection_near - self.detection_far
        return self.detection_near - fall * distance_m / self.max_range_m

    def measure_range(
        self, rng: np.random.Generator, distance_m: float, loss_db: float = 0.0
    ) -> float | None:
        """One attempt over the true ``distance_m``: the range in metres, or None if not received.

        ``loss_db`` is what stands in between: the reach shrinks by 20 dB a decade.

        A range is never negative: what noise pushes below zero a tag reports as zero distance.
        Every attempt draws the same count of numbers from ``rng``, received or not, so that one
        pair's fate does not change the noise of the next.
        """
        detected, normal, blocked, excess = (
            rng.random(),
            rng.standard_normal(),
            rng.random(),
            rng.random(),
        )
        if detected >= self.detection_probability(distance_m * 10.0 ** (loss_db / 20.0)):
            return None
        measured = distance_m + self.noise_sigma_m * normal
        if blocked < self.nlos_probability:
            low, high = self.nlos_bias_m
            measured += low + (high - low) * excess
        return float(max(measured, 0.0))


@dataclass(frozen=True, slots=True)
class RadioChannel:
    """The telemetry radio: a frame is lost, or arrives late by a gamma-distributed delay.

    ``delay_min_s`` is the time of flight of a full frame through serial port and 250 kbit/s
    radio; what comes on top is carrier sensing and retries (an assumption, not measured).
    """

    loss_probability: float = 0.02
    delay_min_s: float = 0.008
    delay_mean_s: float = 0.015
    delay_shape: float = 2.0

    def transmit(self, rng: np.random.Generator) -> float | None:
        """Delay of one frame in seconds, or None where the frame is lost."""
        lost, late = rng.random(), rng.standard_gamma(self.delay_shape)
        if lost < self.loss_probability:
            return None
        extra = self.delay_mean_s - self.delay_min_s
        return float(self.delay_min_s + extra * late / self.delay_shape)


@dataclass(frozen=True, slots=True)
class MagneticField:
    """The earth's field, with an indoor disturbance that varies smoothly in space.

    The disturbance is minus the gradient of a harmonic potential, a sum of waves that decay with
    height over steel in the floor, so it is free of curl and divergence as a field in air must
    be. ``disturbance_ut`` is the root mean square of its vector length at ``reference_height_m``.
    """

    strength_ut: float = 48.0
    inclination_rad: float = math.radians(66.0)
    north_rad: float = math.pi / 2
    """Direction of magnetic north in the world frame, counter-clockwise from x."""
    disturbance_ut: float = 0.0
    wavelengths_m: tuple[float, float] = (3.0, 12.0)
    modes: int = 16
    reference_height_m: float = 1.25
    seed: int = 0

    def field_ut(self, position_m: FloatArray) -> FloatArray:
        """Field in world axes, microtesla, shape (n, 3), at ``position_m`` of shape (n, 3)."""
        horizontal = self.strength_ut * math.cos(self.inclination_rad)
        earth = np.array(
            [
                horizontal * math.cos(self.north_rad),
                horizontal * math.sin(self.north_rad),
                -self.strength_ut * math.sin(self.inclination_rad),
            ]
        )
        out = np.broadcast_to(earth, position_m.shape).copy()
        if self.disturbance_ut <= 0.0:
            return out
        rng = np.random.default_rng([self.seed, 0x3A6])
        shortest, longest = self.wavelengths_m
        k = 2 * np.pi / np.exp(rng.uniform(math.log(shortest), math.log(longest), self.modes))
        direction = rng.uniform(0, 2 * np.pi, self.modes)
        phase = rng.uniform(0, 2 * np.pi, self.modes)
        # |B| of one wave is amplitude at all phases: (cos, cos) horizontally, sin vertically.
        amplitude = self.disturbance_ut / math.sqrt(self.modes)
        for i in range(self.modes):
            cx, cy = math.cos(direction[i]), math.sin(direction[i])
            angle = k[i] * (cx * position_m[:, 0] + cy * position_m[:, 1]) + phase[i]
            decay = amplitude * np.exp(-k[i] * (position_m[:, 2] - self.reference_height_m))
            along = decay * np.sin(angle)
            out[:, 0] += cx * along
            out[:, 1] += cy * along
            out[:, 2] += decay * np.cos(angle)
        return out


@dataclass(frozen=True, slots=True)
class World:
    """Everything outside the walkers. Floor plane z = 0, world x along the first leg."""

    size_m: tuple[float, float] = (20.0, 10.0)
    uwb: UwbChannel = field(default_factory=UwbChannel)
    radio: RadioChannel = field(default_factory=RadioChannel)
    magnetic: MagneticField = field(default_factory=MagneticField)
    floor_pressure_pa: float = 101_325.0
    building: Building | None = None

    def measure_range(
        self, rng: np.random.Generator, first_m: FloatArray, second_m: FloatArray
    ) -> float | None:
        """Range between tags at two places (3,); see `UwbChannel.measure_range`."""
        distance_m = math.dist(first_m, second_m)
        if self.building is None:
            return self.uwb.measure_range(rng, distance_m)
        slabs = self.building.slabs_between(first_m, second_m)
        measured = self.uwb.measure_range(rng, distance_m, slabs * self.building.slab_db)
        return None if measured is None else measured + slabs * sum(SLAB_EXCESS_M) / 2.0

    def pressure_pa(self, height_m: FloatArray) -> FloatArray:
        """Air pressure at a height over the floor: the standard atmosphere's lapse."""
        return np.asarray(
            self.floor_pressure_pa * (1.0 - 2.25577e-5 * height_m) ** 5.25588, dtype=np.float64
        )
