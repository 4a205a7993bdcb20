"""Gyroscope and accelerometer: their own self-tests, and their samples while the node lies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from relpos.calibration.sensors import SensorCalibration
from relpos.errors import DeviceError
from relpos.link.dialogue import NodeDialogue
from relpos.measurements import RawSample
from relpos.nodes.bringup.bus import IMU_ADDRESS as ADDRESS
from relpos.nodes.bringup.bus import SAMPLE
from relpos.nodes.bringup.bus_access import BusAccess
from relpos.nodes.bringup.finding import ACCELEROMETER, GYROSCOPE, SAMPLES, Finding

GYRO_CONFIG, ACCEL_CONFIG, ON = 0x1B, 0x1C, 0xE0
FORCE_WORDS = tuple(SAMPLE + 2 * axis for axis in range(3))
RATE_WORDS = tuple(SAMPLE + 8 + 2 * axis for axis in range(3))
MPU9150 = 0x68
TOLERANCE_9150 = 0.14
"""Of the change from the factory's value (data sheet of this die)."""
LEAST_GYRO_9250, TOLERANCE_FORCE_9250 = 0.5, 0.5
"""As the maker's driver judges."""
SETTLE_S = 0.3
LATE_S = 0.06
"""A sample is 20 ms apart from the next and delayed by 10 ms."""
LAG_TRIES = 3
LOOKS = 4
RECORD_S = 4.0
NO_REPORT_LOST_S = 0.3
"""They come every 0.2 s."""
RATE_HZ, RATE_TOLERANCE = 50.0, 0.02
"""The chip's clock may be off by 1 %, the board's by 0.5 %."""
STILL_RAD_S, STILL_M_S2 = 0.02, 0.3
"""Standard deviation of a single sample on a table: a tenth of it."""
SOUND_BIAS_DEG_S, FREE_BIAS_DEG_S, KNOWN_BIAS_DEG_S = 20.0, 10.0, 2.0
"""What a data sheet allows; beyond what the firmware does not see that a node lies still (its
``kQuietRate_rad_s`` is 11.5); and what a calibrated sensor's bias moves by with temperature."""
FORCE_TOLERANCE_M_S2 = 1.2
"""Data sheet: 80 mg along x and y, 3 % of scale."""
GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class Recording:
    """What a node that lies still reported, before any calibration; empty where it is silent."""

    samples: Sequence[RawSample]

    @property
    def silent(self) -> bool:
        """Whether the inertial sensor gave nothing."""
        return not any(sample.samples for sample in self.samples)

    def field_ut(self) -> np.ndarray | None:
        """Return the mean magnetic field; None where no reading came."""
        fields = [s.magnetic_field_ut for s in self.samples if s.magnetic_field_ut is not None]
        return np.mean(fields, axis=0) if fields else None

    def field_readings(self) -> int:
        """Return how many readings of the field came.

        One a report; or none and two by turns, where a reading falls together with a report.
        """
        return sum(sample.field_readings for sample in self.samples)


def record(dialogue: NodeDialogue) -> Recording:
    """Take raw samples for some seconds."""
    try:
        return Recording([s for s in dialogue.raw_samples(RECORD_S) if s is not None])
    except DeviceError:  # It has fallen silent, whatever came before.
        return Recording(())


def sample_findings(
    bus: BusAccess, recording: Recording, calibration: SensorCalibration, figures: dict[str, object]
) -> Iterator[Finding]:
    """Rate, noise, bias and gravity."""
    if recording.silent:
        # 0: the firmware is setting it up anew.
        shown = [{bus.word(ADDRESS, word) for _ in range(LOOKS)} - {0, None} for word in RATE_WORDS]
        stuck = all(len(values) <= 1 for values in shown)
        yield Finding(
            SAMPLES,
            False,
            "they never change" if stuck else "none is announced",
            "the sensor is defective" if stuck else "its supply; then the sensor itself",
        )
        return
    heard = [sample for sample in recording.samples if sample.samples]
    # Between reports of which the radio lost none.
    whole = [(a, b) for a, b in pairwise(heard) if b.time_s - a.time_s < NO_REPORT_LOST_S]
    seconds = sum(b.time_s - a.time_s for a, b in whole)
    count = sum(b.samples for _, b in whole)
    rate_hz = count / seconds if seconds > 0 else 0.0
    force = np.array([sample.acceleration_m_s2 for sample in heard], dtype=float)
    turn = np.array([sample.angular_rate_rad_s for sample in heard], dtype=float)
    # A report is the mean of ten samples.
    per_sample = math.sqrt(count / max(len(whole), 1))
    noise_m_s2 = float(force.std(axis=0).max()) * per_sample
    noise_rad_s = float(turn.std(axis=0).max()) * per_sample
    gravity = float(np.linalg.norm(calibration.correct_acceleration(force).mean(axis=0)))
    bias = np.degrees(turn.mean(axis=0) - calibration.gyro_bias_rad_s)
    figures |= {
        "sample_rate_hz": rate_hz,
        "accelerometer_noise_m_s2": noise_m_s2,
        "gyroscope_noise_rad_s": noise_rad_s,
        "gravity_m_s2": gravity,
        "gyroscope_bias_deg_s": [float(value) for value in bias],
    }
    yield Finding(
        SAMPLES,
        abs(rate_hz / RATE_HZ - 1.0) < RATE_TOLERANCE,
        f"{rate_hz:.1f} a second, noise {noise_m_s2:.3f} m/s^2 and "
        f"{math.degrees(noise_rad_s):.2f} deg/s",
        f"{RATE_HZ:g} a second are expected: a loose contact, or a defective sensor",
    )
    if noise_m_s2 > STILL_M_S2 or noise_rad_s > STILL_RAD_S:
        yield Finding(SAMPLES, False, "the node was moved", "let it lie still, and check again")
        return
    yield Finding(
        ACCELEROMETER,
        abs(gravity - GRAVITY_M_S2) < FORCE_TOLERANCE_M_S2,
        f"measures {gravity:.2f} m/s^2 at rest",
        "gravity is 9.8 m/s^2: the sensor is defective",
    )
    calibrated = calibration.gyro_bias_sigma_rad_s > 0.0
    most = float(np.abs(bias).max())
    defective = not calibrated and most >= SOUND_BIAS_DEG_S
    yield Finding(
        GYROSCOPE,
        most < (KNOWN_BIAS_DEG_S if calibrated else FREE_BIAS_DEG_S),
        "turns at rest by " + ", ".join(f"{value:+.1f}" for value in bias) + " deg/s",
        f"over {SOUND_BIAS_DEG_S:g} deg/s: the sensor is defective"
        if defective
        else f"calibrate it{' anew' * calibrated}: relpos node calibrate",
    )


def _factory(bus: BusAccess, identity: int) -> tuple[list[float], list[float]] | None:
    """Return what the factory measured, in counts: force and rate; None where nothing is stored."""
    if identity == MPU9150:
        codes = [bus.byte(ADDRESS, 0x0D + k) or 0 for k in range(4)]
        force = [codes[k] >> 3 & 0x1C | codes[3] >> (4 - 2 * k) & 3 for k in range(3)]
        rate = [code & 0x1F for code in codes[:3]]
        if not all((*force, *rate)):
            return None
        return (
            [4096 * 0.34 * (0.92 / 0.34) ** ((code - 1) / 30.0) for code in force],
            [
                sign * 25.0 * 131.0 * 1.046 ** (code - 1)
                for sign, code in zip((1, -1, 1), rate, strict=True)
            ],
        )
    force = [bus.byte(ADDRESS, 0x0D + k) or 0 for k in range(3)]
    rate = [bus.byte(ADDRESS, k) or 0 for k in range(3)]
    if not all((*force, *rate)):
        return None
    force_counts, rate_counts = ([2620.0 * 1.01 ** (c - 1) for c in k] for k in (force, rate))
    return force_counts, rate_counts


def _read(bus: BusAccess) -> np.ndarray:
    """Force and rate in counts (6); NaN where the chip does not answer."""
    words = [bus.word(ADDRESS, register) for register in (*FORCE_WORDS, *RATE_WORDS)]
    return np.array([math.nan if word is None else float(word) for word in words])


def self_tests(
    dialogue: NodeDialogue, bus: BusAccess, identity: int, figures: dict[str, object]
) -> Iterator[Finding]:
    """Let the chip move its own proof masses. The node has to be restarted afterwards."""
    factory = _factory(bus, identity)
    if factory is None:
        for part in (ACCELEROMETER, GYROSCOPE):
            yield Finding(part, None, "the chip holds no factory values of its self-test: a copy?")
        return
    plain = 0x10 if identity == MPU9150 else 0x00  # 8 g, 2 g
    bus.write(ADDRESS, ACCEL_CONFIG, plain)
    bus.write(ADDRESS, GYRO_CONFIG, 0)
    dialogue.pause(SETTLE_S)
    before = _read(bus)
    bus.write(ADDRESS, ACCEL_CONFIG, plain | ON)
    bus.write(ADDRESS, GYRO_CONFIG, ON)
    dialogue.pause(SETTLE_S)
    moved = _read(bus) - before
    bus.write(ADDRESS, ACCEL_CONFIG, plain)
    ratios = moved / np.array([*factory[0], *factory[1]])
    figures["self_test_over_factory"] = [float(r) if math.isfinite(r) else None for r in ratios]
    if identity == MPU9150:
        good = np.abs(ratios - 1.0) < TOLERANCE_9150
    else:
        good = np.abs(ratios - 1.0) < TOLERANCE_FORCE_9250
        good[3:] = ratios[3:] > LEAST_GYRO_9250
    for part, half in ((ACCELEROMETER, slice(3)), (GYROSCOPE, slice(3, 6))):
        yield Finding(
            part,
            bool(good[half].all()),
            "self-test "
            + ", ".join(f"{100.0 * ratio:.0f}" for ratio in ratios[half])
            + " % of the factory's along x, y, z",
            "let the node lie still and check again; then the sensor is defective",
        )
    late_s = _lag_s(dialogue, bus, factory[1][0])
    figures["samples_late_s"] = late_s
    if late_s > LATE_S:
        yield Finding(
            SAMPLES,
            False,
            f"come {1e3 * late_s:.0f} ms late or more",
            "30 ms at most are usual: the sensor is defective, or not the one that it says",
        )


def _lag_s(dialogue: NodeDialogue, bus: BusAccess, response: float) -> float:
    """For how long after a change of the gyroscope its old rate is certainly still read."""
    lags = []
    for _ in range(LAG_TRIES):
        bus.write(ADDRESS, GYRO_CONFIG, 0)
        dialogue.pause(SETTLE_S)
        before = bus.word(ADDRESS, RATE_WORDS[0])
        begun = bus.write(ADDRESS, GYRO_CONFIG, ON)
        lag_s = 0.0  # where a repeated command makes the first look too late, it says nothing
        while begun is not None and before is not None:
            now = bus.transfer(ADDRESS, RATE_WORDS[0], read=2)
            since_s = now.at_s - begun.at_s
            if since_s > 1.0:
                break
            if not now.answered:
                continue
            value = int.from_bytes(now.data, "big", signed=True)
            if abs(value - before) > 0.5 * abs(response):
                break
            lag_s = since_s
        lags.append(lag_s)
    return max(lags)
