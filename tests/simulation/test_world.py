"""The world between the walkers: ranges, radio, magnetic field, pressure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relpos.simulation.team import SCENARIOS, make_team
from relpos.simulation.world import MagneticField, RadioChannel, UwbChannel, World


def attempts(channel: UwbChannel, distance_m: float, count: int = 4000) -> list[float]:
    rng = np.random.default_rng(3)
    ranges = (channel.measure_range(rng, distance_m) for _ in range(count))
    return [value for value in ranges if value is not None]


def test_nothing_is_received_past_the_range_limit() -> None:
    assert attempts(UwbChannel(), 15.01) == []
    assert UwbChannel().detection_probability(15.01) == 0.0


@pytest.mark.parametrize("distance_m", [0.0, 4.0, 10.0, 14.9])
def test_detection_falls_with_distance_as_stated(distance_m: float) -> None:
    channel = UwbChannel()
    expected = 0.95 - 0.45 * distance_m / 15.0
    assert channel.detection_probability(distance_m) == pytest.approx(expected)
    # Four standard errors of a proportion.
    tolerance = 4 * np.sqrt(expected * (1 - expected) / 4000)
    assert len(attempts(channel, distance_m)) / 4000 == pytest.approx(expected, abs=tolerance)


def test_the_papers_detection_of_one_half_can_be_asked_for() -> None:
    channel = UwbChannel(detection_near=0.5, detection_far=0.5, noise_sigma_m=1.0)
    assert {channel.detection_probability(d) for d in (0.0, 7.0, 15.0)} == {0.5}


def test_range_noise_has_the_stated_spread_and_no_bias() -> None:
    error = np.array(attempts(UwbChannel(), 6.0)) - 6.0
    assert error.std() == pytest.approx(0.1, rel=0.06)
    assert error.mean() == pytest.approx(0.0, abs=4 * 0.1 / np.sqrt(len(error)))


def test_a_blocked_path_only_lengthens() -> None:
    channel = UwbChannel(nlos_probability=1.0, noise_sigma_m=0.0)
    error = np.array(attempts(channel, 6.0)) - 6.0
    assert 0.5 <= error.min() < 0.55
    assert 1.95 < error.max() <= 2.0


def test_a_range_is_never_negative() -> None:
    assert min(attempts(UwbChannel(noise_sigma_m=1.0), 0.1)) == 0.0


def test_a_failed_attempt_does_not_shift_the_noise_of_the_next() -> None:
    near, far = np.random.default_rng(1), np.random.default_rng(1)
    UwbChannel().measure_range(near, 1.0)
    UwbChannel().measure_range(far, 100.0)
    assert near.random() == far.random()


def test_radio_loses_and_delays_as_stated() -> None:
    radio, rng = RadioChannel(loss_probability=0.1), np.random.default_rng(2)
    delays = [radio.transmit(rng) for _ in range(4000)]
    arrived = np.array([d for d in delays if d is not None])
    assert 1 - len(arrived) / 4000 == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / 4000))
    assert arrived.min() >= radio.delay_min_s
    assert arrived.mean() == pytest.approx(radio.delay_mean_s, rel=0.05)


def test_the_earth_field_points_north_and_down() -> None:
    field = MagneticField().field_ut(np.zeros((1, 3)))[0]
    assert np.linalg.norm(field) == pytest.approx(48.0)
    assert field[0] == pytest.approx(0.0, abs=1e-12)
    assert np.degrees(np.arctan2(-field[2], field[1])) == pytest.approx(66.0)


def test_the_indoor_disturbance_has_its_size_and_obeys_maxwell() -> None:
    magnetic = MagneticField(disturbance_ut=5.0, seed=4)
    rng = np.random.default_rng(0)
    place = np.column_stack([rng.uniform(0, 60, (3000, 2)), np.full(3000, 1.25)])
    earth = MagneticField().field_ut(place)
    extra = magnetic.field_ut(place) - earth
    assert np.sqrt((extra**2).sum(axis=1).mean()) == pytest.approx(5.0, rel=0.15)
    h = 1e-4
    jacobian = np.empty((50, 3, 3))
    for axis in range(3):
        step = np.eye(3)[axis] * h
        difference = magnetic.field_ut(place[:50] + step) - magnetic.field_ut(place[:50] - step)
        jacobian[:, :, axis] = difference / (2 * h)
    assert np.abs(np.trace(jacobian, axis1=1, axis2=2)).max() < 1e-5
    assert np.abs(jacobian - jacobian.transpose(0, 2, 1)).max() < 1e-5
    assert np.abs(jacobian).max() > 0.1


def test_magnetometers_see_the_field_turned_into_their_axes() -> None:
    scenario = SCENARIOS["lab"]
    (walker,), world = make_team(scenario, 1, 40.0, 8)
    assert world.magnetic.disturbance_ut > 0
    back = np.einsum("nij,nj->ni", walker.attitude, walker.magnetic_field_ut)
    np.testing.assert_allclose(back, world.magnetic.field_ut(walker.position_m), atol=0.02)
    calm = replace(scenario, world=World())
    (walker,), _ = make_team(calm, 1, 40.0, 8)
    norm = np.linalg.norm(walker.magnetic_field_ut, axis=1)
    np.testing.assert_allclose(norm, 48.0, atol=1e-9)


def test_pressure_falls_by_twelve_pascal_a_metre() -> None:
    pressure = World().pressure_pa(np.array([0.0, 1.0, 10.0]))
    assert pressure[0] == 101_325.0
    assert pressure[0] - pressure[1] == pytest.approx(12.0, abs=0.1)
    assert pressure[0] - pressure[2] == pytest.approx(120.0, abs=1.0)
