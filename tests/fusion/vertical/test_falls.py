"""A fall is told at once, and no lift, door or flight of stairs is one."""

from __future__ import annotations

import numpy as np
import pytest

from relpos.fusion.vertical.falls import FallDetector
from relpos.measurements import Height

READING_S = 0.1
AT_S, END_S = 20.0, 45.0


def _told(
    way_m: float,
    seconds: float,
    *,
    period_s: float = 1.0,
    steps_s: float = 0.0,
    waits_s: float = 0.0,
) -> int:
    """How many of ten wearers, who walk, wait and go down at ``AT_S``, are told to fall."""
    times_s = np.arange(0.0, END_S, READING_S)
    down_m = way_m * np.clip((times_s - AT_S) / seconds, 0.0, 1.0)
    told = 0
    for seed in range(10):
        noise_m = 0.17 * np.random.default_rng(seed).standard_normal(times_s.size)
        detector, height_m, steps, reported_s = FallDetector(), 0.0, 0.0, 0.0
        fell = False
        for time_s, pressure_m in zip(times_s.tolist(), (noise_m - down_m).tolist(), strict=True):
            # As the node does: a reading counts a quarter.
            height_m += 0.25 * (pressure_m - height_m)
            steps += READING_S * (1.8 if time_s < AT_S - waits_s else steps_s)
            if time_s >= reported_s + period_s - 1e-9:
                reported_s = time_s
                detector.step(int(steps))
                steps -= int(steps)
                fell |= detector.measure(Height(time_s, 1, round(height_m, 2)))
        told += fell
    return told


@pytest.mark.parametrize("period_s", [0.1, 0.3, 0.5, 1.0, 2.0])
def test_a_fall_is_told_however_often_the_node_reports(period_s: float) -> None:
    assert _told(3.0, 2.5, period_s=period_s) >= 8


@pytest.mark.parametrize("way_m", [3.0, 4.0])
def test_who_falls_through_a_floor_is_told_to_fall(way_m: float) -> None:
    assert _told(way_m, 0.22 * way_m) >= 8


@pytest.mark.parametrize(
    ("way_m", "seconds", "steps_s"),
    [(3.5, 10.0, 1.8), (2.1, 0.1, 0.0), (2.1, 0.1, 1.8), (3.0, 0.1, 1.8), (2.1, 10.0, 0.0)],
    ids=["stairs", "door", "door, walking", "gale, walking", "fan"],
)
@pytest.mark.parametrize("period_s", [0.3, 1.0])
def test_stairs_doors_and_fans_are_no_fall(
    way_m: float, seconds: float, steps_s: float, period_s: float
) -> None:
    assert _told(way_m, seconds, steps_s=steps_s, period_s=period_s) == 0


@pytest.mark.parametrize(("way_m", "seconds"), [(7.0, 7.0), (15.0, 6.0), (24.0, 6.0)])
@pytest.mark.parametrize("period_s", [0.3, 1.0])
def test_a_ride_is_no_fall_in_the_fastest_lift_either(
    way_m: float, seconds: float, period_s: float
) -> None:
    assert _told(way_m, seconds, waits_s=4.0, period_s=period_s) == 0
