"""Calibration: ellipsoids, biases and gains that are known, found again or refused."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy

from relpos.calibration import guide, inertial, magnetometer, picture, steps
from relpos.calibration.sensors import SensorCalibration, checksum
from relpos.errors import DataError
from relpos.measurements import RawSample

EARTH_UT = np.array([0.0, 20.0, -43.6])  # 48 uT, dipping by 65 degrees
GRAVITY = np.array([0.0, 0.0, 9.80665])


def attitudes_of(count, seed):
    return scipy.spatial.transform.Rotation.random(count, random_state=seed).inv()


def turned(count, seed, noise_ut=0.3, offset=(40.0, -25.0, 10.0), spread=0.1):
    """Readings (n, 3), up (n, 3) and the truth of a node that is turned in all directions."""
    rng = np.random.default_rng(seed)
    attitudes = attitudes_of(count, seed)
    iron = np.eye(3) + spread * rng.standard_normal((3, 3))
    field = attitudes.apply(EARTH_UT) @ iron.T + offset
    return field + noise_ut * rng.standard_normal((count, 3)), attitudes.apply(GRAVITY), iron


@pytest.mark.parametrize("seed", range(6))
def test_the_ellipsoid_is_found_and_turned_into_gravitys_axes(seed):
    field, up, iron = turned(400, seed)
    fit = magnetometer.fit(field, up)
    assert np.allclose(fit.offset_ut, (40.0, -25.0, 10.0), atol=0.5)
    assert fit.residual < 0.01 < fit.residual_before
    # What is corrected is the field's direction, not only its strength: up to 1 degree.
    scale = np.linalg.det(iron) ** (1 / 3)
    clean = attitudes_of(400, seed).apply(EARTH_UT) * scale
    angle = np.arccos(
        np.sum(fit.correct(field) * clean, axis=1)
        / np.linalg.norm(fit.correct(field), axis=1)
        / np.linalg.norm(clean, axis=1)
    )
    assert np.degrees(np.sqrt(np.mean(angle**2))) < 1.0


def test_a_few_readings_beside_steel_do_not_bend_the_ellipsoid():
    field, up, _ = turned(400, 3)
    field[::40] += [15.0, 0.0, 0.0]
    fit = magnetometer.fit(field, up)
    assert np.allclose(fit.offset_ut, (40.0, -25.0, 10.0), atol=1.5)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f, u: (f[:40], u[:40]), "too few"),
        (lambda f, u: (np.tile(f[:1], (100, 1)), u[:100]), "do not change"),
        (lambda f, u: (f[f[:, 2] > f[:, 2].mean() + 15.0], None), "directions|uncertain|ellipsoid"),
        (lambda f, u: (f + np.linspace(0, 60, len(f))[:, None], u), "ellipsoid|uniform"),
        (lambda f, u: (4.0 * f, u), "Earth"),
        (lambda f, u: (f * [1.0, 1.0, 4.0], u), "times as long as wide"),
        (lambda f, u: tuple(x[u[:, 2] > 2.0] for x in (f, u)), "% of the directions were"),
        (lambda f, u: turned(60, 0, noise_ut=1.5)[:2], "uncertain by 2.2 %"),
    ],
)
def test_readings_that_do_not_determine_it_are_refused_with_what_to_do(spoil, words):
    field, up, _ = turned(400, 1)
    with pytest.raises(DataError, match=words):
        magnetometer.fit(*spoil(field, up))


def test_one_axis_alone_is_no_calibration():
    angle = np.linspace(0, 20 * np.pi, 400)
    field = np.column_stack((20 * np.cos(angle) + 30, 20 * np.sin(angle), 40 + 0 * angle))
    field += 0.3 * np.random.default_rng(0).standard_normal(field.shape)
    with pytest.raises(DataError):
        magnetometer.fit(field)


def samples_of(kind):
    """Raw samples, five a second, of what a guided calibration asks for, in the order given."""
    rng = np.random.default_rng(7)
    bias, gyro = np.array([0.3, -0.2, 0.1]), np.radians([1.0, -2.0, 0.5])
    out, time_s = [], 0.0
    rotation = scipy.spatial.transform.Rotation

    def add(attitude, rate):
        nonlocal time_s
        time_s += 0.2
        force = attitude.inv().apply(GRAVITY) * 1.01 + bias + 0.003 * rng.standard_normal(3)
        field = attitude.inv().apply(EARTH_UT) + (30.0, 5.0, -12.0) + 0.3 * rng.standard_normal(3)
        shown = rate + gyro + 0.0003 * rng.standard_normal(3)
        out.append(RawSample(time_s, 1, 10, tuple(force), tuple(shown), tuple(field), 1))

    sides = [(0, 0, 0), (np.pi, 0, 0), (1.57, 0, 0), (-1.57, 0, 0), (0, 1.57, 0), (0, -1.57, 0)]
    for part in kind:
        if part == "still":
            for _ in range(50):
                add(rotation.identity(), np.zeros(3))
        elif part == "sides":
            for side in sides:
                add(rotation.from_rotvec(np.array(side) / 2), np.array([2.0, 0, 0]))
                for _ in range(15):
                    add(rotation.from_rotvec(side), np.zeros(3))
        else:
            for k in range(400):
                add(rotation.random(random_state=k), np.array([0.0, 1.5, -1.0 + 0.01 * (k % 7)]))
    return out, bias, gyro


@pytest.mark.parametrize("order", [("still", "sides", "turn"), ("turn", "sides", "still")])
def test_the_order_of_a_calibration_does_not_matter(order):
    samples, bias, gyro = samples_of(order)
    assert guide.progress(samples).done(with_magnetometer=True)
    result = guide.solve(samples)
    assert np.allclose(result.calibration.gyro_bias_rad_s, gyro, atol=np.radians(0.02))
    assert np.allclose(result.calibration.acceleration_bias_m_s2, bias, atol=0.02)
    force = np.array([sample.acceleration_m_s2 for sample in samples])
    corrected = np.linalg.norm(result.calibration.correct_acceleration(force), axis=1)
    assert np.allclose(corrected, GRAVITY[2], atol=0.03)
    fit = result.accelerometer
    assert fit.residual_m_s2 < 0.005
    assert 0.2 < fit.residual_before_m_s2 < 0.4
    assert np.allclose(result.calibration.field_offset_ut, (30.0, 5.0, -12.0), atol=0.5)
    assert 0.0 < np.degrees(result.calibration.gyro_bias_sigma_rad_s) < 0.2


def test_calibration_needs_rest_and_the_accelerometer_needs_sides():
    turned = samples_of(("turn",))[0]
    seen = guide.progress(turned)
    assert (seen.attitudes, seen.still_s) == (0, 0.0)
    with pytest.raises(DataError, match="never lay still"):
        guide.solve(turned)
    result = guide.solve(samples_of(("still", "turn"))[0])
    assert result.accelerometer is None
    assert "1 attitudes at rest do not determine the accelerometer" in result.remarks[0]
    assert not guide.progress(samples_of(("still", "turn"))[0]).done(with_magnetometer=True)


def test_four_sides_give_the_bias_of_the_accelerometer_alone():
    samples, bias, _ = samples_of(("still", "sides"))
    assert guide.progress(samples).done(with_magnetometer=False)
    assert not guide.progress(samples).done(with_magnetometer=True)
    force, rate = (
        np.array([getattr(s, name) for s in samples])
        for name in ("acceleration_m_s2", "angular_rate_rad_s")
    )
    sides = inertial.poses(force, rate, np.full(len(samples), 0.2))
    fit = inertial.fit_accelerometer([sides[k] for k in (0, 1, 2, 4)])
    assert fit.partial
    assert np.array_equal(fit.scale, np.zeros(3))
    assert np.allclose(fit.bias_m_s2, bias, atol=0.15)  # with 1 % of scale in it
    assert not inertial.fit_accelerometer(sides).partial


def test_what_was_not_measured_stays_as_it_was_calibrated():
    calibrated = guide.solve(samples_of(("still", "sides", "turn"))[0]).calibration
    samples = [replace(s, magnetic_field_ut=None) for s in samples_of(("still",))[0]]
    assert guide.progress(samples).readings == 0
    result = guide.solve(samples, calibrated, with_magnetometer=False)
    assert result.accelerometer is None
    for name in ("acceleration_bias_m_s2", "acceleration_scale", "field_offset_ut", "field_matrix"):
        assert np.array_equal(getattr(result.calibration, name), getattr(calibrated, name))


def test_a_node_that_is_held_is_not_lying_still():
    time_s = np.arange(50) * 0.2
    swaying = np.radians(2.0) * np.sin(time_s)[:, None] * np.ones(3)
    with pytest.raises(DataError, match="moved"):
        inertial.fit_gyro(swaying, np.full(50, 0.2))


@pytest.mark.parametrize(("reports", "period_s"), [(14, 0.2), (4, 1.0)])
def test_a_short_rest_gives_no_bias_of_the_gyroscope(reports, period_s):
    with pytest.raises(DataError, match="at rest are too short for the gyroscope"):
        inertial.fit_gyro(np.zeros((reports, 3)), np.full(reports, period_s))


@pytest.mark.parametrize("scale", [float("nan"), float("inf"), 0.0, -1.0])
def test_a_step_scale_that_is_no_positive_number_gives_no_gain(scale):
    with pytest.raises(DataError, match="is not a positive number"):
        steps.scaled_gain_permille(2140, scale)


def test_the_picture_shows_before_and_after(tmp_path):
    field, up, _ = turned(300, 2)
    picture.draw(magnetometer.fit(field, up), field, tmp_path / "deep" / "one.png")
    assert (tmp_path / "deep" / "one.png").read_bytes().startswith(b"\x89PNG")


def test_a_calibration_survives_the_transfer_to_the_node():
    samples, _, _ = samples_of(("still", "sides", "turn"))
    calibration = guide.solve(samples).calibration
    words = calibration.to_words()
    again = SensorCalibration.from_words(words)
    assert again.to_words() == words
    assert checksum(words) != checksum([*words[:-1], words[-1] + 1])
    assert np.allclose(again.field_matrix, calibration.field_matrix, atol=1e-4)
    assert SensorCalibration().to_words() == [0] * len(words)


def test_a_calibration_that_no_node_can_hold_is_refused():
    with pytest.raises(DataError, match="does not fit"):
        SensorCalibration(field_offset_ut=np.array([1e5, 0.0, 0.0])).to_words()


# --- steps ---------------------------------------------------------------------------------------


def test_the_weight_of_one_walk_falls_with_its_deviation():
    asked = np.array([1.02, 1.05, 1.10, 1.20, 1.40])
    shares = [np.log(steps.posterior_scale([a], [35])) / np.log(a) for a in asked]
    assert all(a > b for a, b in itertools.pairwise(shares))
    assert 0.75 < shares[0] < 0.85
    assert shares[-1] < 0.25
    assert steps.posterior_scale([1.0], [35]) == 1.0


def test_a_walk_of_a_hundred_steps_weighs_more_than_one_of_seven():
    few, many = (steps.posterior_scale([1.1], [count]) for count in (7, 110))
    assert 1.01 < few < 1.06 < many < 1.1


def test_walks_that_agree_have_a_large_weight():
    one = steps.posterior_scale([1.15], [35])
    three = steps.posterior_scale([1.15, 1.14, 1.16], [35, 35, 35])
    assert 1.05 < one < 1.12 < three < 1.15
    # One walk that was not of the stated distance is an outlier.
    assert steps.posterior_scale([1.04, 1.05, 1.60], [35] * 3) == steps.posterior_scale(
        [1.04, 1.05, 1.055], [35] * 3
    )


@pytest.mark.parametrize("scales", [[], [0.0], [-1.0], [float("nan")]])
def test_a_scale_that_is_none_is_refused(scales):
    with pytest.raises(DataError):
        steps.posterior_scale(scales, [35] * len(scales))


def test_people_scatter_about_the_population_whatever_the_node_was_set_to():
    fresh = steps.fit_walk(steps.POPULATION_GAIN_PERMILLE, 40, 30.0, 31.0)
    # A node that was already set 10 % too long reports the same walk 10 % longer.
    again = steps.fit_walk(round(1.1 * steps.POPULATION_GAIN_PERMILLE), 40, 33.0, 31.0)
    assert again.gain_permille == pytest.approx(fresh.gain_permille, abs=2)


def test_a_walk_that_does_not_match_the_stated_distance_is_refused():
    with pytest.raises(DataError, match="too far apart"):
        steps.fit_walk(2130, 40, 30.0, 60.0)
    with pytest.raises(DataError, match="steps"):
        steps.fit_walk(2130, 3, 2.0, 20.0)
    with pytest.raises(DataError, match="a calibration walk of nan m"):
        steps.fit_walk(2130, 40, 30.0, float("nan"))


def test_an_accelerometer_that_is_stuck_at_zero_shows_no_attitude():
    rate = np.zeros((60, 3))
    rate[28:32, 0] = 2.0
    assert inertial.still_stretches(np.zeros((60, 3)), rate, np.full(60, 0.2))
    assert inertial.poses(np.zeros((60, 3)), rate, np.full(60, 0.2)) == []


@pytest.mark.parametrize("apart", [0.0, 0.05])
def test_a_node_that_lay_on_its_corners_alone_has_no_scale(apart):
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners += apart * np.random.default_rng(0).standard_normal((8, 3))
    forces = GRAVITY[2] * corners / np.linalg.norm(corners, axis=1)[:, None]
    with pytest.raises(DataError, match="too similar"):
        inertial.fit_accelerometer([inertial.Pose(force, 3.0) for force in forces])


def test_a_side_that_is_laid_down_again_is_one_attitude_the_longer_time():
    forces = GRAVITY[2] * np.eye(3)[[0, 1, 0, 1]]
    forces[2:] += [0.0, 0.0, 0.5]  # three degrees beside
    laid = np.repeat(forces, [20, 30, 30, 20], axis=0)
    shown = inertial.poses(laid, np.zeros((100, 3)), np.full(100, 0.2))
    assert [pose.duration_s for pose in shown] == pytest.approx([5.6, 5.6])
    assert [pose.force_m_s2[2] for pose in shown] == pytest.approx([0.5, 0.0])


def test_a_steady_turn_and_a_short_stop_are_no_attitudes_at_rest():
    turned = np.repeat(GRAVITY[2] * np.array([*np.eye(3), [0.0, 0.0, -1.0]]), 20, axis=0)[:66]
    rate = np.zeros((66, 3))
    rate[20:40, 1] = 0.5
    shown = inertial.poses(turned, rate, np.full(66, 0.2))  # the last for less than a second
    assert [int(np.argmax(pose.force_m_s2)) for pose in shown] == [0, 2]
