"""Recordings played into the emulated chip, on the production firmware."""

from dataclasses import replace

import numpy as np
import pytest

from relpos.calibration.steps import posterior_scale
from relpos.emulator.deadreckoning import (
    WearerSettings,
    calibrate,
    play,
    reckon_run,
    surroundings_of,
)
from relpos.errors import DataError
from relpos.runs import Description, Run
from relpos.runs.imu import ImuRecording
from relpos.simulation.team import make_team
from relpos.simulation.walker import RATE_HZ

UPRIGHT = np.eye(3)
SECONDS = 60.0


@pytest.fixture(scope="module")
def walker():
    return make_team("paper", 1, SECONDS, 11)[0][0]


def recorded(walker, times_s, start_s=0.0, turned=UPRIGHT, magnetic=True):
    """The walker's sensors read at ``times_s``, mounted turned, on a clock from ``start_s``."""

    def at(rows):
        columns = [np.interp(times_s, walker.time_s, rows[:, k]) for k in range(3)]
        return np.column_stack(columns) @ turned.T

    field = at(walker.magnetic_field_ut) if magnetic else np.full((len(times_s), 3), np.nan)
    return ImuRecording(
        times_s + start_s, at(walker.specific_force_m_s2), at(walker.angular_rate_rad_s), field
    )


@pytest.fixture(scope="module")
def reference(walker):
    """The walk sampled 100 times a second, played with the default settings."""
    return play(1, recorded(walker, even(100.0)), WearerSettings())


def even(rate_hz, seconds=SECONDS):
    return np.arange(int(seconds * rate_hz) - 1) / rate_hz


def test_a_walk_comes_out_with_about_its_steps_and_its_turns(walker):
    replay = play(1, recorded(walker, even(RATE_HZ)), WearerSettings(walker.person.leg_length_m))
    assert len(replay.steps) == pytest.approx(len(walker.steps.time_s), abs=6)
    assert replay.distance_m == pytest.approx(walker.steps.length_m.sum(), rel=0.25)
    turn = sum(m.dtheta_rad for m in replay.motions)
    assert turn == pytest.approx(walker.heading_rad[-1] - walker.heading_rad[0], abs=0.4)


def test_steps_come_at_their_times_on_the_recordings_clock(walker):
    replay = play(1, recorded(walker, even(100.0), start_s=-3.2), WearerSettings())
    found = np.array([s.time_s for s in replay.steps]) + 3.2
    nearest = np.abs(found[:, None] - walker.steps.time_s).min(axis=1)
    assert np.median(nearest) < 0.25
    assert replay.motions[0].time_s < 0.0
    assert replay.motions[-1].time_s + 3.2 == pytest.approx(SECONDS, abs=2.6)


@pytest.mark.parametrize("rate_hz", [25.0, 52.0, 200.0, 400.0, 1000.0, 2500.0])
def test_the_recordings_rate_does_not_matter(walker, reference, rate_hz):
    assert play(1, recorded(walker, even(rate_hz)), WearerSettings()).distance_m == pytest.approx(
        reference.distance_m, rel=0.06
    )


@pytest.mark.parametrize("rate_hz", [1000.0, 4000.0])
def test_vibration_that_the_chip_filters_does_not_fold_into_the_walk(walker, rate_hz):
    times_s = even(rate_hz, 40.0)
    quiet, shaken = recorded(walker, times_s), recorded(walker, times_s)
    # 201 Hz becomes 1 Hz where it is sampled 200 times a second: 6 m/s2 at the pace of walking. Of
    # that the chip's filter leaves a hundredth, which its own sampling folds all the same.
    shaken.acceleration_m_s2[:] += 6.0 * np.sin(2.0 * np.pi * 201.0 * times_s)[:, None]
    assert play(1, shaken, WearerSettings()).distance_m == pytest.approx(
        play(1, quiet, WearerSettings()).distance_m, rel=0.05
    )


def test_uneven_times_and_repeated_samples_do_not_matter(walker, reference):
    rng = np.random.default_rng(1)
    times_s = even(100.0)
    times_s = times_s + rng.uniform(-0.002, 0.002, len(times_s))
    times_s = np.sort(np.concatenate((times_s, [10.0, 10.0, 20.0, 20.0])))
    assert play(1, recorded(walker, times_s), WearerSettings()).distance_m == pytest.approx(
        reference.distance_m, rel=0.04
    )


def test_any_mounting_gives_the_same_walk(walker, reference):
    upside_down = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    turned = play(1, recorded(walker, even(100.0), turned=upside_down), WearerSettings())
    assert turned.distance_m == pytest.approx(reference.distance_m, rel=0.05)
    assert sum(m.dtheta_rad for m in turned.motions) == pytest.approx(
        sum(m.dtheta_rad for m in reference.motions), abs=0.1
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_random_mounting_gives_nearly_the_same_walk(walker, reference, seed):
    turned, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    turned *= np.linalg.det(turned)
    other = play(1, recorded(walker, even(100.0), turned=turned), WearerSettings())
    assert other.distance_m == pytest.approx(reference.distance_m, rel=0.02)
    assert len(other.steps) == pytest.approx(len(reference.steps), abs=1)


def test_a_sample_beyond_the_chips_range_is_clipped_and_counted(walker):
    recording = recorded(walker, even(100.0, 40.0))
    assert play(1, recording, WearerSettings()).clipped == 0
    recording.acceleration_m_s2[2000:2030, 0] = 200.0  # no range of the chip reaches 20 g
    recording.angular_rate_rad_s[2020:2050, 2] = -50.0
    replay = play(1, recording, WearerSettings())
    assert replay.clipped == 50
    assert np.isfinite(replay.distance_m)


def test_a_recording_without_magnetometer_is_played(walker):
    replay = play(1, recorded(walker, even(100.0), magnetic=False), WearerSettings())
    assert len(replay.steps) > 60


def test_pressure_becomes_heights_and_a_recording_without_has_none(walker, reference):
    times_s = even(100.0)
    # 10 m up from second 20 to second 40: at 98,000 Pa and 15 degrees rho g is 11.62 Pa/m.
    climbed_m = np.interp(times_s, [20.0, 40.0], [0.0, 10.0])
    recording = replace(recorded(walker, times_s, 5.0), pressure_pa=98_000.0 - 11.62 * climbed_m)
    replay = play(3, recording, WearerSettings())
    assert replay.motions[0].dx_m == reference.motions[0].dx_m
    at_s, height_m = np.transpose([(h.time_s - 5.0, h.height_m) for h in replay.heights])
    assert {h.node for h in replay.heights} == {3}
    assert np.abs(height_m[(at_s > 3.0) & (at_s < 20.0)]).max() < 0.1
    assert height_m[at_s > 42.0] == pytest.approx(10.0, abs=0.15)
    assert reference.heights == ()


def test_longer_legs_walk_further_in_the_same_recording(walker):
    recording = recorded(walker, even(100.0))
    short, long = (play(1, recording, WearerSettings(leg)).distance_m for leg in (0.8, 1.0))
    # s = c (l^2 h)^(1/3): as the leg to two thirds, less where the filter disagrees.
    assert 1.08 < long / short < 1.25 ** (2 / 3) + 0.01


def test_the_same_recording_gives_the_same_motion(walker, reference):
    assert play(1, recorded(walker, even(100.0)), WearerSettings()) == reference


def test_a_gap_is_silence_and_not_motion(walker):
    times_s = even(100.0)
    times_s = times_s[(times_s < 30.0) | (times_s > 34.0)]
    recording = recorded(walker, times_s)
    silent = surroundings_of(recording).silent_us
    assert len(silent) == 2  # the gap, and behind the end
    assert silent[0][1] - silent[0][0] == pytest.approx(4.0e6, abs=0.02e6)
    replay = play(1, recording, WearerSettings())
    inside = [s for s in replay.steps if 30.8 < s.time_s < 34.0]
    assert inside == []
    assert len(replay.steps) > 60


def test_a_calibration_walk_sets_the_gain_by_the_weight_of_one_walk(walker):
    recording = recorded(walker, even(100.0))
    before = play(1, recording, WearerSettings(0.9))
    before_m = before.distance_m
    found = calibrate(1, [recording], [1.05 * before_m], 0.9)
    # With the gain that the firmware begins with.
    assert found.measured_m == pytest.approx((before_m,), rel=1e-3)
    assert found.scale == pytest.approx(posterior_scale([1.05], [len(before.steps)]), abs=1e-3)
    after_m = play(1, recording, WearerSettings(0.9, found.gain_permille)).distance_m
    assert after_m / before_m == pytest.approx(found.scale, abs=0.005)
    # Walks that agree are believed more than one of them.
    many = calibrate(1, [recording] * 4, [1.05 * before_m] * 4, 0.9)
    assert found.scale < many.scale < 1.05


class InertialRun(Run):
    """A run whose inertial data are in memory."""

    def load_imu(self):
        return self.recordings


def run_of(recordings, **description):
    run = InertialRun("memory", Description(**description))
    object.__setattr__(run, "recordings", recordings)
    return run


def test_every_node_of_a_run_is_played_under_its_own_name(walker):
    recording = recorded(walker, even(100.0, 30.0))
    played = reckon_run(run_of({3: recording, 300: recording}))
    assert set(played) == {3, 300}
    for node, part in played.items():
        assert {m.node for m in part.output.motions} == {node}
        assert {s.node for s in part.output.steps} == {node}
    assert played[3].output.distance_m == played[300].output.distance_m


def test_the_stature_sets_the_leg_length(walker):
    recording = recorded(walker, even(100.0, 30.0))
    given = reckon_run(run_of({1: recording}), stature_m=1.9)[1]
    own = reckon_run(run_of({1: recording}, stature_m=1.9))[1]
    direct = play(1, recording, WearerSettings(0.53 * 1.9)).steps
    assert given.output.steps == own.output.steps == direct


def test_repeated_times_are_counted(walker):
    times_s = np.sort(np.concatenate((even(100.0, 30.0), [10.0, 20.0])))
    part = reckon_run(run_of({1: recorded(walker, times_s)}))[1]
    assert (part.samples, part.repeated) == (len(times_s), 2)


def test_calibration_needs_a_true_distance_and_the_node(walker):
    recording = recorded(walker, even(100.0, 30.0))
    run = run_of({1: recording})
    with pytest.raises(DataError, match="true_distance_m"):
        reckon_run(run, calibration=[run_of({1: recording})])
    others = run_of({2: recording, 3: recording}, true_distance_m=20.0)
    with pytest.raises(DataError, match="node 1"):
        reckon_run(run, calibration=[others])


def test_a_recording_that_cannot_be_played_is_refused(walker):
    with pytest.raises(DataError, match="fewer than two"):
        surroundings_of(recorded(walker, np.array([1.0])))
    with pytest.raises(DataError, match="that can be played"):
        surroundings_of(recorded(walker, np.array([0.0, 0.01, 1.7e9])))
    with pytest.raises(DataError, match="no inertial data"):
        reckon_run(run_of({}))
    still = recorded(walker, np.linspace(0.0, 4.0, 400))
    with pytest.raises(DataError, match="no step"):
        calibrate(1, [still], [20.0], None)
    with pytest.raises(DataError, match="must be positive"):
        calibrate(1, [still], [0.0], None)
    with pytest.raises(DataError, match=r"memory: node 1: .*LEG_LENGTH"):
        reckon_run(run_of({1: still}, stature_m=0.1))
    with pytest.raises(DataError, match="not as 2000 m"):
        calibrate(1, [recorded(walker, even(100.0, 30.0))], [2000.0], None)
