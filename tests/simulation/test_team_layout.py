"""Teams laid out from recorded walks: truth, reports and ranges belong together."""

import cmath
import math

import numpy as np
import pytest

from relpos.errors import DataError
from relpos.measurements import Event, Motion, Truth
from relpos.runs import Description, Run
from relpos.simulation import recorded_team
from relpos.simulation.recorded_team import TeamSettings, Wearer, make_team, true_tracks


def exact_motions(track, phase_s=0.3):
    """What a node without errors reports once a second on a track."""
    times = np.arange(track.time_s[0] + phase_s, track.time_s[-1], 1.0)
    places, headings = track.at(times)
    moved = np.diff(places) * np.exp(-1j * headings[:-1])
    return [
        Motion(float(t), 1, float(m.real), float(m.imag), float(h))
        for t, m, h in zip(times[1:], moved, np.diff(headings), strict=True)
    ]


@pytest.fixture
def there_and_back():
    marks = [(5.0, "trial_start"), (17.0, "uturn_start"), (19.0, "uturn_end"), (33.0, "trial_end")]
    events = [Event(t, 1, name, "") for t, name in marks]
    events += [Event(float(t), 1, "foot_contact", "left") for t in np.arange(5.6, 33.0, 0.6)]
    return Run("walk", Description(true_distance_m=20.0), events=tuple(events))


def exact_wearer(run):
    tracks = true_tracks(run)
    return Wearer([m for track in tracks for m in exact_motions(track)], tracks)


def test_there_and_back_are_two_straight_tracks_and_the_turn_is_none(there_and_back):
    there, back = true_tracks(there_and_back)
    assert there.time_s[[0, -1]] == pytest.approx([5.0, 17.0])
    # the last second and a half may turn round again
    assert back.time_s[[0, -1]] == pytest.approx([19.0, 31.5])
    assert there.place_m[[0, -1]] == pytest.approx([0.0, 10.0])
    assert back.place_m[0] == 0.0
    assert 8.5 < back.place_m[-1].real < 9.5
    assert not np.r_[there.heading_rad, back.heading_rad].any()


def test_the_body_is_halfway_over_the_first_step_when_its_foot_comes_down(there_and_back):
    (there, _), steps = true_tracks(there_and_back), np.arange(5.6, 16.0, 0.6)
    lengths = np.abs(np.diff(there.at(np.r_[5.0, steps])[0]))
    assert lengths[1:] == pytest.approx(np.full(len(lengths) - 1, lengths[1]))
    assert lengths[0] == pytest.approx(0.5 * lengths[1])


def test_a_recording_without_a_track_is_refused_with_what_it_needs():
    with pytest.raises(DataError, match=r"truth\.csv"):
        true_tracks(Run("walk"))


def test_surveyed_points_are_joined_straight_and_faced():
    points = [(0.0, 0.0, 0.0), (4.0, 4.0, 0.0), (8.0, 4.0, 4.0), (9.0, 4.0, 4.0)]
    (track,) = true_tracks(Run("walk", truth=tuple(Truth(t, 1, x, y) for t, x, y in points)))
    places, headings = track.at(np.array([2.0, 6.0, 8.5]))
    assert places == pytest.approx([2.0, 4.0 + 2.0j, 4.0 + 4.0j])
    assert headings == pytest.approx([0.0, math.pi / 2, math.pi / 2])


def test_exact_reports_lead_along_the_truth(there_and_back, monkeypatch):
    monkeypatch.setattr(recorded_team, "TURN_SIGMA_RAD", 0.0)
    wearers = [exact_wearer(there_and_back) for _ in range(3)]
    run = make_team(wearers, TeamSettings(seconds=40.0), 4, "test")
    for prior in run.description.priors:
        place, heading = complex(prior.x_m, prior.y_m), prior.heading_rad
        truth = {t.time_s: t for t in run.truth if t.node == prior.node}
        times = np.array(sorted(truth))
        own = [m for m in run.motions if m.node == prior.node]
        assert len(own) > 20
        for motion in own:
            place += complex(motion.dx_m, motion.dy_m) * cmath.rect(1.0, heading)
            heading += motion.dtheta_rad
            x = np.interp(motion.time_s, times, [truth[t].x_m for t in times])
            y = np.interp(motion.time_s, times, [truth[t].y_m for t in times])
            assert abs(place - complex(x, y)) < 0.45  # truth is given at whole seconds


def test_wearers_walk_and_report_until_the_end_of_the_run(there_and_back):
    wearers = [exact_wearer(there_and_back) for _ in range(2)]
    run = make_team(wearers, TeamSettings(seconds=120.0), 4, "test")
    for node in (1, 2):
        times = [m.time_s for m in run.motions if m.node == node]
        assert max(np.diff([0.0, *times, 120.0])) < 4.0
        places = [(t.x_m, t.y_m) for t in run.truth if t.node == node]
        assert max(np.hypot(*(np.array(places)[10:] - np.array(places)[:-10]).T)[-20:]) > 2.0


def test_ranges_are_those_of_the_truth_and_walls_lose_and_lengthen_them(there_and_back):
    wearers = [exact_wearer(there_and_back) for _ in range(4)]
    errors, counts = [], []
    for walls in (0, 1):
        run = make_team(wearers, TeamSettings(seconds=300.0, area_m=30.0, walls=walls), 2, "test")
        at = {(t.time_s, t.node): complex(t.x_m, t.y_m) for t in run.truth}
        found = []
        for measured in run.ranges:
            whole = float(round(measured.time_s))
            if abs(measured.time_s - whole) < 0.05 and (whole, measured.node) in at:
                true_m = abs(at[whole, measured.node] - at[whole, measured.peer])
                found.append(measured.range_m - true_m)
        errors.append(np.array(found))
        counts.append(len(run.ranges))
    assert abs(np.median(errors[0])) < 0.2
    assert np.quantile(errors[1], 0.9) > np.quantile(errors[0], 0.9) + 0.2
    assert counts[1] < 0.9 * counts[0]
    again = make_team(wearers, TeamSettings(seconds=300.0, area_m=30.0, walls=1), 2, "test")
    assert again.measurements == run.measurements
