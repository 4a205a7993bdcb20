"""The torso dead reckoning from outside: physics, robustness, honesty, and real walks."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy

from relpos.simulation.team import make_team

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("replay", ROOT / "bench" / "inertial" / "replay.py")
replay = importlib.util.module_from_spec(_spec)
sys.modules["replay"] = replay
_spec.loader.exec_module(replay)

RATE_HZ = 50
BIAS_RAD_S = np.radians(1.0)
BAD_INPUT = 1 << 6  # quality flag


def recorded(walker, seed=0, begin_s=0.0, bias_rad_s=BIAS_RAD_S):
    """What a sensor on this walker gives at 50 Hz: low-passed, with noise and a gyro bias."""
    rng = np.random.default_rng(seed)
    imu = np.hstack([walker.specific_force_m_s2, walker.angular_rate_rad_s])
    slow = scipy.signal.butter(2, 0.2, output="sos")
    imu = scipy.signal.sosfiltfilt(slow, imu, axis=0)[int(begin_s * 200) :: 4]
    imu[:, :3] += 0.03 * rng.standard_normal((len(imu), 3))
    imu[:, 3:] += np.radians(0.05) * rng.standard_normal((len(imu), 3))
    imu[:, 3:] += bias_rad_s * rng.standard_normal(3)
    return imu


@pytest.fixture(scope="module")
def team():
    return make_team("paper", 6, 180.0, 11)[0]


def turned(imu, rotation):
    return np.hstack([imu[:, :3] @ rotation.T, imu[:, 3:] @ rotation.T])


def random_rotation(rng):
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


# --- the filter against independent derivations --------------------------------------------------


def move(error, rotation, impulse_m_s, dt_s):
    """The nominal motion over a span, from a state that is off by ``error`` (12,).

    Error state: attitude (navigation), gyro bias, velocity, position. The position moves half
    before and half after the velocity's change, as docs/deadreckoning.md says.
    """
    attitude, bias, velocity, position = error.reshape(4, 3)
    attitude = attitude - rotation @ bias * dt_s
    position = position + 0.5 * dt_s * velocity
    velocity = velocity + np.cross(attitude, impulse_m_s)
    return np.concatenate([attitude, bias, velocity, position + 0.5 * dt_s * velocity])


def jacobian(function):
    step = 1e-4
    return np.stack([function(step * e) - function(-step * e) for e in np.eye(12)], 1) / (2 * step)


@pytest.mark.parametrize("seed", range(5))
def test_the_covariance_is_predicted_as_f_p_f_plus_q(seed):
    rng = np.random.default_rng(seed)
    sizes = np.repeat([0.05, 0.01, 0.3, 0.1], 3)
    root = rng.standard_normal((12, 12)) * sizes[:, None]
    covariance = root @ root.T
    rotation, dt_s = random_rotation(rng), 0.1
    impulse = np.array([0.2, -0.1, 0.98]) + 0.2 * rng.standard_normal(3)
    transition = jacobian(lambda e: move(e, rotation, impulse, dt_s))
    # Attitude and bias noise enter before the velocity's change, velocity noise after it: the first
    # passes through the motion with no time for the bias, the second through half the position.
    degree = np.pi / 180
    first = np.repeat([(0.15 * degree) ** 2, (0.004 * degree) ** 2, 0, 0], 3) * dt_s
    second = np.repeat([0, 0, 0.25**2, 0], 3) * dt_s
    motion = jacobian(lambda e: move(e, np.zeros((3, 3)), impulse, dt_s))
    half = jacobian(lambda e: move(e, np.zeros((3, 3)), np.zeros(3), 0.5 * dt_s))
    noise = motion @ np.diag(first) @ motion.T + half @ np.diag(second) @ half.T
    none = replay.predict(np.zeros((12, 12)), rotation, impulse, dt_s)
    scale = np.sqrt(np.outer(np.diag(noise), np.diag(noise)))
    assert np.max(np.abs(none - noise) / scale) < 1e-5
    expected = transition @ covariance @ transition.T + noise
    got = replay.predict(covariance, rotation, impulse, dt_s)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.max(np.abs(got - expected) / scale) < 1e-5


@pytest.mark.parametrize("magnetic", [False, True])
def test_the_covariance_stays_positive_definite_over_twenty_minutes(team, magnetic):
    imu = np.tile(recorded(team[0]), (7, 1))
    field = np.tile(team[0].magnetic_field_ut[::4], (7, 1)) if magnetic else None
    # Looked at after ever longer walks, at every phase of the step.
    for count in np.linspace(500, len(imu), 30).astype(int):
        result = replay.reckon(imu[:count], None if field is None else field[:count])
        sigma = np.sqrt(np.diag(result.covariance))
        live = sigma > 0  # the position is known exactly just after a step
        assert np.sum(live) >= 9
        correlation = (result.covariance[live][:, live] / sigma[live]).T / sigma[live]
        assert np.linalg.eigvalsh(correlation)[0] > 1e-4, count
        assert result.counters["covariance_repairs"] == 0


@pytest.mark.parametrize("walker", range(4))
def test_two_hours_without_a_compass_end_as_they_began(team, walker):
    lap = recorded(team[walker], walker)
    path_m = replay.reckon(np.tile(lap, (40, 1))).rows["path_m"][len(lap) - 1 :: len(lap)]
    laps_m = np.diff(path_m)
    assert laps_m[-10:].mean() == pytest.approx(laps_m[:3].mean(), rel=0.08)


# --- what a wearer relies on ------------------------------------------------------------------


def test_standing_does_not_walk():
    rng = np.random.default_rng(3)
    imu = np.tile([9.80665, 0, 0, 0, 0, 0.0], (120 * RATE_HZ, 1))
    imu += rng.standard_normal(imu.shape) * ([0.05] * 3 + [0.003] * 3)
    result = replay.reckon(imu)
    assert result.distance_m == 0.0
    assert abs(result.turn_rad) < np.radians(2.0)


def standing(seconds, rate_rad_s):
    """Force and rate (n, 6) of a sensor at rest but for the yaw rate given (n,) or as a number."""
    rng = np.random.default_rng(5)
    imu = np.tile([9.80665, 0, 0, 0, 0, 0.0], (int(seconds * RATE_HZ), 1))
    imu += rng.standard_normal(imu.shape) * ([0.02] * 3 + [0.001] * 3)
    imu[:, 3] += rate_rad_s
    return imu


def test_a_bias_on_the_table_is_learned_within_ten_seconds():
    bias = replay.reckon(standing(10.1, np.radians(2.0))).bias_rad_s
    assert np.degrees(bias[0]) == pytest.approx(2.0, abs=0.1)


def test_standing_on_learns_the_bias_better():
    # A sway of a degree with a period of 7 s; a jolt ends the start after three seconds.
    time_s = np.arange(62 * RATE_HZ) / RATE_HZ
    sway_rad_s = np.radians(1.0) * 2 * np.pi / 7 * np.cos(2 * np.pi * time_s / 7 + 0.5)
    imu = standing(62, np.radians(1.0) + sway_rad_s)
    imu[150:155, 1] += 3.0
    off = [
        abs(np.degrees(replay.reckon(imu[: seconds * RATE_HZ]).bias_rad_s[0]) - 1.0)
        for seconds in (4, 61)
    ]
    assert off[0] > 0.2
    assert off[1] < 0.12


def test_standing_finds_a_bias_that_the_filter_held_to_be_impossible(team):
    # Switched on while walking, and off by four times what is expected: 240 degrees a minute.
    walk = recorded(team[0], begin_s=20.0, bias_rad_s=0.0)[: 30 * RATE_HZ]
    up = walk[:, :3].mean(axis=0)
    up /= np.linalg.norm(up)
    still = np.zeros((300 * RATE_HZ, 6))
    still[:, :3] = 9.80665 * up
    imu = np.vstack([walk, still])
    imu[:, 3:] += np.radians(4.0) * up
    imu += np.random.default_rng(1).standard_normal(imu.shape) * ([0.02] * 3 + [0.001] * 3)
    assert np.degrees(replay.reckon(imu).bias_rad_s @ up) > 3.0


def test_getting_ready_is_not_taken_for_bias():
    # Four degrees to one side within three seconds, at an uneven rate, as people do who have just
    # pressed the button: walk_chest had turned the whole walk by that much a minute.
    time_s = np.arange(4 * RATE_HZ) / RATE_HZ
    bias = replay.reckon(standing(4, np.radians(1.3 + 4.0 * np.sin(2 * np.pi * time_s)))).bias_rad_s
    assert np.abs(np.degrees(bias[0])) < 0.65


def test_distance_is_right_within_the_gain_of_a_person(team):
    errors = [
        replay.reckon(recorded(w, w.node), leg_length_m=w.person.leg_length_m).distance_m
        / w.steps.length_m.sum()
        - 1.0
        for w in team
    ]
    # The simulator's people differ in how far they go for how much they rise.
    assert np.all(np.abs(errors) < 0.25)
    assert abs(np.mean(errors)) < 0.15


def test_switched_on_while_walking_it_finds_its_way(team):
    begin_s = 90.0
    for walker in team[:3]:
        steps = walker.steps
        walked = steps.length_m[steps.time_s > begin_s].sum()
        imu = recorded(walker, walker.node, begin_s)
        result = replay.reckon(imu, leg_length_m=walker.person.leg_length_m)
        assert result.distance_m == pytest.approx(walked, rel=0.25)


@pytest.mark.parametrize("seed", range(4))
def test_the_mounting_does_not_matter(team, seed):
    rotation = random_rotation(np.random.default_rng(seed))
    imu = recorded(team[1], bias_rad_s=0.0)
    straight, other = replay.reckon(imu), replay.reckon(turned(imu, rotation))
    assert other.distance_m == pytest.approx(straight.distance_m, rel=0.01)
    assert other.turn_rad == pytest.approx(straight.turn_rad, abs=np.radians(1.0))


def heading_errors(team, magnetic):
    late, squares = [], []
    for w in team:
        field = w.magnetic_field_ut[::4] if magnetic else None
        imu = recorded(w, w.node)
        result = replay.reckon(imu, field, leg_length_m=w.person.leg_length_m)
        true = np.unwrap(w.heading_rad[::4])
        error = np.unwrap(result.rows["heading_rad"]) - (true - true[:100].mean())
        late.append(error[-250:].mean())
        squares.append(late[-1] ** 2 / result.rows["variance_heading_rad2"][-1])
    return np.degrees(np.abs(late)), np.mean(squares)


def test_heading_drifts_no_faster_than_the_standing_start_explains(team):
    late_deg, nees = heading_errors(team, magnetic=False)
    # 5 s of sway at the start leave a bias of some 0.2 deg/s; believing to observe heading from
    # the steps made it 18 deg a minute, at a NEES of 74. Half a degree a minute would be better
    # than standing and straight walking allow: look why.
    assert 3 * 0.5 < np.median(late_deg) < 3 * 6.0
    assert 0.1 < nees < 2.0


def test_the_magnetometer_holds_the_heading(team):
    late_deg, nees = heading_errors(team, magnetic=True)
    assert np.median(late_deg) < 3.0
    # 12 degrees a reading is for fields indoors; the simulated one is undisturbed, so the filter
    # claims more than it errs by.
    assert nees < 1.0


def test_the_heading_grows_uncertain_while_the_field_is_rejected(team):
    walker = team[2]
    imu, field = recorded(walker, walker.node), walker.magnetic_field_ut[::4]
    disturbed = field.copy()
    disturbed[60 * RATE_HZ :] *= (
        1.0 + 0.4 * np.sign(np.sin(np.arange(len(field))[60 * RATE_HZ :]))[:, None]
    )
    held, lost = replay.reckon(imu, field), replay.reckon(imu, disturbed)
    assert held.counters["rejected_magnetic"] < 10 < lost.counters["rejected_magnetic"]
    heading = (2, 2)  # attitude about the vertical
    assert lost.covariance[heading] > 1.5 * held.covariance[heading]
    grown = [r.rows["variance_heading_rad2"][-1] for r in (held, lost)]
    assert grown[1] > grown[0]


def test_a_refused_sample_is_counted_and_changes_nothing(team):
    imu = recorded(team[0])[: 60 * RATE_HZ]
    span = 1.0 / RATE_HZ
    bad = [(0, np.nan, span), (4, np.inf, span), (2, -np.inf, span)]
    bad += [(0, 9.8, dt) for dt in (0.0, -0.02, 0.21, np.nan)]
    spoilt, spans = imu, np.full(len(imu), span)
    for i, (column, value, dt) in enumerate(bad):
        at = 400 + 371 * i
        sample = imu[at].copy()
        sample[column] = value
        spoilt, spans = np.insert(spoilt, at, sample, axis=0), np.insert(spans, at, dt)
    result, clean = replay.reckon(spoilt, dt_s=spans), replay.reckon(imu)
    assert clean.counters["refused_samples"] == 0
    assert result.counters["refused_samples"] == len(bad)
    assert np.array_equal(result.covariance, clean.covariance)
    assert np.array_equal(result.bias_rad_s, clean.bias_rad_s)
    for name in ("x_m", "y_m", "heading_rad", "path_m", "steps", "variance_along_m2"):
        assert result.rows[name][-1] == clean.rows[name][-1], name
    assert np.any(result.rows["flags"] & BAD_INPUT)
    assert not np.any(clean.rows["flags"] & BAD_INPUT)


@pytest.mark.parametrize(("column", "value", "flag"), [(0, 39.2, 1 << 0), (5, -17.45, 1 << 1)])
def test_saturation_is_flagged_for_two_seconds_and_survived(team, column, value, flag):
    imu = recorded(team[0])[: 120 * RATE_HZ]
    clean = replay.reckon(imu)
    imu[3000:3005, column] = value
    result = replay.reckon(imu)
    assert result.counters["saturated_samples"] == 5
    assert clean.counters["saturated_samples"] == 0
    flagged = np.flatnonzero(result.rows["flags"] & flag)
    assert flagged[0] == 3000
    assert flagged[-1] == pytest.approx(3004 + 2 * RATE_HZ, abs=2)
    assert not np.any(clean.rows["flags"] & 3)
    assert result.distance_m == pytest.approx(clean.distance_m, rel=0.1)


def rotation_about(axis, angle_rad):
    """Rotation (3, 3) about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(3)
    out[i, i] = out[j, j] = np.cos(angle_rad)
    out[i, j], out[j, i] = -np.sin(angle_rad), np.sin(angle_rad)
    return out


def turned_on_the_body(imu, axis, angle_rad, begin_s, end_s=None, within_s=1.0):
    """The sensor turns by ``angle_rad`` about its own axis, and back at ``end_s`` where given."""
    out = imu.copy()
    time_s = np.arange(len(imu)) / RATE_HZ
    angle = angle_rad * np.clip((time_s - begin_s) / within_s, 0.0, 1.0)
    if end_s is not None:
        angle -= angle_rad * np.clip((time_s - end_s) / within_s, 0.0, 1.0)
    for k, (a, rate) in enumerate(zip(angle, np.gradient(angle) * RATE_HZ, strict=True)):
        back = rotation_about(axis, a).T
        out[k, :3], out[k, 3:] = back @ imu[k, :3], back @ imu[k, 3:]
        out[k, 3 + axis] += rate
    return out


@pytest.mark.parametrize("angle_deg", [-90, 70, 150])
def test_a_sensor_turned_on_the_body_walks_on_the_wearers_way(team, angle_deg):
    walker = team[0]
    imu = recorded(walker, bias_rad_s=0.0)
    moved = turned_on_the_body(imu, 0, np.radians(angle_deg), 60.0)  # x is up
    clean, result = replay.reckon(imu), replay.reckon(moved)
    assert clean.counters["turned_sensors"] == 0
    assert result.counters["turned_sensors"] >= 1
    off = result.rows["heading_rad"][-1] - clean.rows["heading_rad"][-1]
    assert abs(np.degrees((off + np.pi) % (2 * np.pi) - np.pi)) < 25.0
    assert result.distance_m == pytest.approx(clean.distance_m, rel=0.1)


def test_bending_over_keeps_the_heading(team):
    # The sensor's axes are x up, y left, z backward: bent by 95 degrees about the left axis for ten
    # seconds while walking on, as in crawling or under a pipe.
    walker = team[1]
    imu = recorded(walker, bias_rad_s=0.0)
    bent = turned_on_the_body(imu, 1, np.radians(95), 80.0, 90.0)
    clean, result = replay.reckon(imu), replay.reckon(bent)
    off = np.unwrap(result.rows["heading_rad"] - clean.rows["heading_rad"])
    assert abs(np.degrees(off[-1] - off[79 * RATE_HZ])) < 15.0
    assert result.distance_m == pytest.approx(clean.distance_m, rel=0.1)
