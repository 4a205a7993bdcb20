"""The torso dead reckoning on real walks: what it reaches must not get lost.

Every bound is the figure reached, with room for noise; ``bench/inertial/evaluate.py`` prints them.
The walks were all looked at during development: these are guards, no test of generality.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "bench" / "inertial"))

import evaluate  # noqa: E402
import replay  # noqa: E402
import walks  # noqa: E402

import recordings  # noqa: E402


def needs(data_set):
    return pytest.mark.skipif(
        not (replay.DATA / data_set).is_dir(),
        reason=f"no recordings: {data_set} is not in ../shared/data (or RELPOS_DATA)",
    )


# --- the measure itself --------------------------------------------------------------------------


def walk_with(contacts_s, end_s=20.0, begin_s=1.0):
    events = [(begin_s, "trial_start", ""), (end_s, "trial_end", "")]
    events += [(t, "foot_contact", "left") for t in contacts_s]
    return replay.Recording(
        "1-1", np.arange(0.0, 30.0, 0.02), np.zeros((1500, 6)), np.zeros((1500, 3)), {}, events
    )


def test_a_constant_offset_costs_no_step_but_a_missing_and_an_extra_one_count():
    contacts = np.arange(1.5, 19.5, 0.6)
    walk = walk_with(contacts)
    score = replay.score_steps(walk, contacts + 0.44)
    assert (score.contacts, score.found, score.extra) == (30, 30, 0)
    steps = np.sort(np.append(np.delete(contacts, 12) + 0.2, 5.25))
    score = replay.score_steps(walk, steps)
    assert (score.found, score.extra) == (29, 1)
    # Steps before and after the trial do not count.
    score = replay.score_steps(walk, np.concatenate(([0.1], contacts, [21.0, 22.0])))
    assert (score.found, score.extra) == (30, 0)


def test_a_step_pairs_with_one_contact_only():
    assert replay.pairs_within(np.array([1.0]), np.array([0.8, 1.1]), 0.3) == 1
    assert replay.pairs_within(np.array([0.9, 1.0]), np.array([0.8, 1.1]), 0.3) == 2
    # Greedy by the nearest would take (1.0, 1.1) and leave 0.9 with nothing.
    assert replay.pairs_within(np.array([1.0, 1.35]), np.array([0.75, 1.1]), 0.3) == 2
    walk = walk_with([2.0, 2.5, 3.0], end_s=3.0)
    assert replay.score_steps(walk, np.array([2.0, 2.05, 2.5, 3.0])).extra == 1


def test_contacts_behind_the_recordings_end_are_not_asked_for():
    contacts = np.arange(25.0, 35.0, 0.5)
    walk = walk_with(contacts, end_s=34.5, begin_s=24.0)
    assert replay.score_steps(walk, contacts[contacts < 30.0]).contacts == 10


def test_distance_between_steps_is_walked_evenly_and_a_pause_stands_still():
    steps_s, lengths_m = np.array([1.0, 1.5, 5.0]), np.array([0.6, 0.7, 0.8])
    at = np.array([0.0, 0.4, 0.7, 1.0, 1.25, 1.5, 4.0, 4.7, 5.0, 9.0])
    expected = [0.0, 0.0, 0.3, 0.6, 0.95, 1.3, 1.3, 1.7, 2.1, 2.1]
    assert replay.walked_m(steps_s, lengths_m, at) == pytest.approx(expected)


def test_alignment_spends_the_first_leg_and_nothing_else():
    places = np.array([5 + 5j, 9 + 5j, 9 + 8j, 2 + 8j])
    turned = (places - places[0]) * np.exp(2.1j) + 40j
    assert recordings.aligned(turned, places) == pytest.approx(places)
    figures = evaluate.waypoint_figures([(turned, places)])
    assert figures["median_percent"] == pytest.approx(0.0, abs=1e-9)
    # A scale error is not aligned away: 10 % too long is 10 % of the way from the start.
    long = evaluate.waypoint_figures([(1.1 * turned, places)])
    ends = np.abs(places - places[0])[2:] * 0.1 / 14.0
    assert long["median_percent"] == pytest.approx(100.0 * np.median(ends))


# --- the walks -----------------------------------------------------------------------------------


MOST_PERCENT = {  # mean absolute, from the stature alone, constants fitted without the set
    "5m back, elderly": 14.0,
    "5m back, young": 8.0,
    "author back": 5.0,
    "daily lowerback, under 0.6 m/s (slow)": 25.0,
    "lowerback 20m": 6.0,
    "mocap virtual": 7.0,
    "phone strides": 7.0,
    "stairs mocap virtual": 30.0,
    "treadmill stroke lumbar": 15.5,
    "treadmill stroke lumbar, under 0.6 m/s (slow)": 35.0,
}


@pytest.fixture(scope="module")
def found():
    return walks.find(replay.DATA)


@pytest.fixture(scope="module")
def rows(found):
    # The page's own grid is five times as large.
    fit = walks.Fit(found, {name: values[::2] for name, values in walks.CONSTANTS.items()})
    biases_rad_s = walks.chip_biases_rad_s(replay.DATA)
    return {g: evaluate.judge(g, w, fit, biases_rad_s) for g, w in walks.groups_of(found)}


@needs("walk_lowerback_20m")
def test_people_who_were_left_out_walk_as_far_as_they_walked(rows):
    for group, most in MOST_PERCENT.items():
        assert rows[group].mean_abs < most, group
        # Shuffled steps are a third too long; the node says that it does not know them.
        assert rows[group].flagged >= (90.0 if "slow" in group else 0.0), group


@needs("walk_lowerback_20m")
def test_steps_are_found_one_to_one(rows):
    for group in ("lowerback 20m", "treadmill stroke lumbar"):
        assert rows[group].steps_found > 97.0
        assert rows[group].steps_extra < 3.0


@needs("walk_lowerback_20m")
def test_one_calibration_walk_brings_a_person_to_scale(rows):
    assert rows["lowerback 20m"].calibrated < 5.5
    assert rows["treadmill stroke lumbar"].calibrated < 14.0


@needs("walk_lowerback_20m")
def test_a_u_turn_is_half_a_turn(rows):
    assert rows["lowerback 20m"].turn_deg < 2.5


@needs("walk_lowerback_20m")
def test_no_set_errs_by_more_than_the_node_says(rows):
    for group in MOST_PERCENT:
        assert rows[group].nees < 2.0, group
    most_cautious = ("mocap virtual", "author back", "daily lowerback, under 0.6 m/s (slow)")
    for group in MOST_PERCENT:
        assert rows[group].nees > (0.2 if group in most_cautious else 0.45), group
    for row in rows.values():
        assert row.turn_nees is None or 0.5 < row.turn_nees < 2.0, row.group


@needs("walk_treadmill_stroke_lumbar")
def test_who_limps_is_flagged_and_left_out_walks_shorter(rows, found):
    # The firmware's own constants: of all but the person, not of all but the set.
    assert rows["treadmill stroke lumbar"].person_left_out < 13.5
    limping = [w for w in found if w.person == "pp07"]
    flags = np.concatenate([w.reckon().rows["flags"][1500:] for w in limping])
    assert np.mean(flags & walks.IRREGULAR > 0) > 0.9


@needs("walk_lowerback_20m")
def test_a_person_who_is_left_out_changes_no_constant(found):
    found = [walk for walk in found if walk.data_set == "walk_lowerback_20m"]
    grid = {name: values[:1] for name, values in walks.CONSTANTS.items()}
    chosen = walks.Fit(found, grid).without(lambda walk: walk.person == "1")
    others = [walk for walk in found if walk.person != "1"]
    assert walks.Fit(others, grid).without(lambda walk: False) == chosen


@needs("walk_chest")
def test_the_same_corridor_is_as_long_both_ways():
    figures = evaluate.chest()
    assert abs(figures["corridor_ratio_percent"]) < 0.9
    for way in ("there", "back"):
        assert 164 <= figures[f"corridor_{way}_steps"] <= 169
    assert figures["K_calibration_worst_from_mean_percent"] < 2.0
    for walk in range(1, 6):
        assert 27 <= figures[f"K_calibration_{walk}_steps"] <= 29
    assert figures["L__staticTestmagnet2_m"] == 0.0


@needs("walk_handheld_waypoints")
def test_a_handheld_phone_leads_from_waypoint_to_waypoint(found):
    figures = evaluate.waypoints([w for w in found if w.data_set == "walk_handheld_waypoints"])
    assert figures["plain"]["walks"] == 70
    assert figures["plain"]["median_percent"] < 8.5
    assert figures["magnetometer"]["median_percent"] < 8.5


@needs("walk_handheld_waypoints")
def test_no_step_has_a_negative_length():
    # Where people stand and turn, a step may end behind where it began: reported as unsigned
    # millimetres, -0.2 m had become 65.3 m.
    for name in ("031", "058", "070", "072"):
        walk = replay.load(replay.DATA / "walk_handheld_waypoints" / name)
        rows = replay.reckon(walk.imu, walk.field_ut).rows
        assert rows["last_step_length_m"].min() >= 0.0
        assert np.diff(rows["path_m"]).min() >= 0.0
