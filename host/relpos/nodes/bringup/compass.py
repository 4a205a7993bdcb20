"""The compass: its own self-test, and the field that it measures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from relpos.calibration.sensors import SensorCalibration
from relpos.nodes.bringup.bus import COMPASS_ADDRESS as ADDRESS
from relpos.nodes.bringup.bus import IMU_ADDRESS, SAMPLE_DIVIDER
from relpos.nodes.bringup.bus_access import BusAccess
from relpos.nodes.bringup.finding import COMPASS, Finding
from relpos.nodes.bringup.inertial import MPU9150, Recording

FIELD, CONTROL, SELF_TEST_CONTROL, ADJUSTMENT = 0x03, 0x0A, 0x0C, 0x10
COIL = 0x40
POWER_DOWN, SELF_TEST, FUSE_ROM = 0x00, 0x08, 0x0F
WIDE = 0x10
LIMITS_8975 = (-1000, -300)
LIMITS_8963 = (-3200, -800)
"""Adjusted counts along z with the coil on; of the AK8963 at 16 bits (the maker's own test, which
asks for next to nothing along x and y, where iron on the node shows, too)."""
TRIES = 10
SLOW_DIVIDER = 99
"""Ten samples a second: the firmware then leaves the compass alone for most of a second."""
EARTH_UT = (22.0, 67.0)
NEAR_IRON_UT = 120.0
"""Without a calibration: what batteries and screws add is still to be taken out."""


def compass_findings(
    recording: Recording, calibration: SensorCalibration, figures: dict[str, object]
) -> Iterator[Finding]:
    """The field's size, and whether the firmware gets it at all."""
    raw = recording.field_ut()
    if raw is None:
        yield Finding(
            COMPASS,
            False,
            "answers, but its measurements are not ready in time, never change or exceed its range",
            "hold the node away from magnets; if that does not help, the sensor is defective",
        )
        return
    share = recording.field_readings() / len(recording.samples)
    field = calibration.field_matrix @ (raw - calibration.field_offset_ut)
    size_ut = float(np.linalg.norm(field))
    figures |= {"field_ut": [float(value) for value in raw], "field_size_ut": size_ut}
    calibrated = bool(np.any(calibration.field_offset_ut))
    low, high = EARTH_UT if calibrated else (0.0, NEAR_IRON_UT)
    yield Finding(
        COMPASS,
        low <= size_ut <= high,
        f"a field of {size_ut:.0f} uT" + ("" if calibrated else " before calibration"),
        "the earth's is 25 to 65 uT: move it away from magnets, speakers, screws and batteries, "
        "then calibrate",
    )
    if share < 0.8:
        yield Finding(
            COMPASS,
            False,
            f"{100.0 * share:.0f} % of the measurements are used",
            "a loose contact, or a defective sensor",
        )


def self_test(bus: BusAccess, identity: int, figures: dict[str, object]) -> Finding:
    """Let the chip's coil make a field. The node has to be restarted afterwards.

    The firmware may measure in between: then it is tried again.
    """
    wide = 0 if identity == MPU9150 else WIDE
    limits = LIMITS_8963 if wide else LIMITS_8975
    bus.write(IMU_ADDRESS, SAMPLE_DIVIDER, SLOW_DIVIDER)
    best: list[float] = []
    for _ in range(TRIES):
        counts = _with_coil(bus, wide)
        if counts is None:
            continue
        best = counts
        if limits[0] <= counts[2] <= limits[1]:
            figures["compass_self_test"] = counts
            return Finding(COMPASS, True, f"self-test moves z by {counts[2]:.0f} counts")
    return Finding(
        COMPASS,
        False,
        "self-test gives " + ", ".join(f"{value:.0f}" for value in best) + " counts"
        if best
        else "its self-test never ends",
        f"{limits[0]} to {limits[1]} along z are expected: the compass is defective, or a "
        "magnet lies beside it",
    )


def _with_coil(bus: BusAccess, wide: int) -> list[float] | None:
    bus.write(ADDRESS, CONTROL, POWER_DOWN)
    bus.write(ADDRESS, CONTROL, FUSE_ROM | wide)
    pairs = [bus.word(ADDRESS, ADJUSTMENT, "little"), bus.word(ADDRESS, ADJUSTMENT + 1, "little")]
    bus.write(ADDRESS, CONTROL, POWER_DOWN)
    bus.write(ADDRESS, SELF_TEST_CONTROL, COIL)
    bus.write(ADDRESS, CONTROL, SELF_TEST | wide)
    words = [bus.word(ADDRESS, FIELD + 2 * axis, "little") for axis in range(3)]
    bus.write(ADDRESS, SELF_TEST_CONTROL, 0)
    if not all(pairs) or None in words:  # no piece has an adjustment of 0
        return None
    first, second = ((pair or 0) & 0xFFFF for pair in pairs)
    adjustments = (first & 0xFF, first >> 8, second >> 8)
    return [
        (word or 0) * (adjustment + 128) / 256.0
        for word, adjustment in zip(words, adjustments, strict=True)
    ]
