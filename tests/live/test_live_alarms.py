"""When somebody's alarm sounds, and when it must not."""

import math

import pytest

from relpos.live.alarms import LOST_S, Alarms, KnownAlert, moved
from relpos.live.composer import Composer
from relpos.live.team_view import Alert
from relpos.measurements import Motion
from relpos.simulation.building import simulate_building


def still(time_s, node=1):
    """As a node at rest reports it."""
    return Motion(time_s, node, 0.002, -0.001, 0.003, 0.02, 0.02, 0.04, 0, False, 0.02)


def walk(time_s, node=1):
    return Motion(time_s, node, 1.2, 0.1, 0.05, 0.1, 0.1, 0.04, 0, True, 0.1)


def bend(time_s, node=1):
    """The body moves without a step: only the node's own uncertainty shows it."""
    return Motion(time_s, node, 0.0, 0.0, 0.02, 0.2, 0.2, 0.04, 0, False, 0.2)


class WatchedWearer:
    """Reports every second and looks twenty times in between."""

    def __init__(self):
        self.alarms = Alarms()
        self.time_s = 0.0
        self.changes = []

    def report(self, make, seconds):
        for _ in range(seconds):
            self.pass_time(1.0)
            if make is not None:
                self.alarms.mark_heard(1)
                self.alarms.add_motion(make(self.time_s))
                self.look(0.0)

    def pass_time(self, seconds, *, listening=True):
        for _ in range(round(seconds * 20)):
            self.look(0.05, listening=listening)

    def look(self, passed_s, *, listening=True):
        self.time_s += passed_s
        self.alarms.tick(self.time_s, listening=listening)
        alert = self.alarms.condition(1).alert
        if not self.changes or self.changes[-1][1] != alert:
            self.changes.append((self.time_s, alert))

    def at(self, alert):
        """When it was first raised."""
        return next(time_s for time_s, a in self.changes if a is alert)

    @property
    def alerts(self):
        return [alert for _, alert in self.changes]


@pytest.fixture
def watching():
    watching = WatchedWearer()
    watching.report(walk, 10)
    return watching


def test_a_person_who_stops_raises_a_warning_after_20_s_and_an_alarm_after_30(watching):
    watching.report(still, 40)
    assert watching.alerts == [None, Alert.STILL_WARNING, Alert.STILL_ALARM]
    assert watching.at(Alert.STILL_WARNING) == pytest.approx(10.0 + 20.0, abs=0.2)
    assert watching.at(Alert.STILL_ALARM) == pytest.approx(10.0 + 30.0, abs=0.2)


@pytest.mark.parametrize("move", [walk, bend, lambda t: Motion(t, 1, 0.0, 0.0, 0.4, moving=False)])
def test_any_movement_ends_the_warning(watching, move):
    watching.report(still, 25)
    watching.report(move, 1)
    assert watching.alerts == [None, Alert.STILL_WARNING, None]
    assert watching.alarms.condition(1).still_s == 0.0


def test_a_twitch_does_not_end_the_alarm_but_getting_up_does(watching):
    watching.report(still, 35)
    watching.report(bend, 1)
    assert watching.alarms.condition(1).still_s > 30.0, "the count goes on, too"
    watching.report(still, 3)
    assert watching.alarms.condition(1).alert is Alert.STILL_ALARM
    watching.report(bend, 4)
    assert watching.alarms.condition(1).alert is None
    assert watching.alarms.condition(1).still_s == 0.0


def test_a_person_working_on_the_spot_raises_no_alarm(watching):
    for _ in range(20):
        watching.report(still, 5)
        watching.report(bend, 1)
    assert watching.alerts == [None]


def test_silence_is_reported_as_lost_and_ends_with_the_first_frame(watching):
    watching.report(None, 15)
    assert watching.at(Alert.LOST) == pytest.approx(10.0 + LOST_S, abs=0.2)
    watching.report(walk, 1)
    assert watching.alarms.condition(1).alert is None


def test_no_node_is_lost_while_the_port_is_closed(watching):
    watching.pass_time(60.0, listening=False)
    assert watching.alerts == [None]
    watching.pass_time(LOST_S + 1.0)
    assert watching.alarms.condition(1).alert is Alert.LOST, "now it is"


def test_a_computer_that_slept_raises_no_alarm_out_of_the_gap(watching):
    watching.report(still, 5)
    watching.look(60.0)
    assert watching.alarms.condition(1).alert is None
    # The first report covers the gap, in which anything may have happened.
    watching.report(still, 19)
    assert watching.alarms.condition(1).alert is None
    watching.report(still, 3)
    assert watching.alarms.condition(1).alert is Alert.STILL_WARNING


def test_an_alarm_goes_on_through_a_gap(watching):
    watching.report(still, 35)
    watching.look(60.0)
    watching.report(still, 1)
    assert watching.alarms.condition(1).alert is Alert.STILL_ALARM


def test_a_few_lost_reports_do_not_hide_a_motionless_person(watching):
    for _ in range(8):
        watching.report(still, 1)
        watching.report(None, 3)
    assert watching.alarms.condition(1).alert is Alert.STILL_ALARM


def test_acknowledging_silences_this_alert_and_no_other(watching):
    assert not watching.alarms.acknowledge(1), "there is nothing to acknowledge"
    watching.report(still, 22)
    assert watching.alarms.acknowledge(1)
    assert watching.alarms.condition(1).acknowledged
    watching.report(still, 10)
    assert watching.alarms.condition(1).alert is Alert.STILL_ALARM
    assert not watching.alarms.condition(1).acknowledged


def test_a_mayday_is_heard_although_the_person_was_shelved_and_is_not_shelved_again(watching):
    watching.report(still, 22)
    assert watching.alarms.shelve(1, 600.0)
    watching.alarms.mayday = {1}
    watching.report(still, 1)
    condition = watching.alarms.condition(1)
    assert (condition.alert, condition.shelved_s) == (Alert.MAYDAY, 0.0)
    assert not watching.alarms.shelve(1, 600.0)


def test_a_motionless_alarm_stays_when_the_radio_falls_silent(watching):
    watching.report(still, 35)
    watching.report(None, 30)
    assert watching.alarms.condition(1).alert is Alert.STILL_ALARM


@pytest.mark.parametrize(
    ("alert", "raised_s"), [(Alert.STILL_ALARM, 100.0), (Alert.STILL_WARNING, 115.0)]
)
def test_stillness_of_a_session_before_goes_on_with_who_has_seen_it(alert, raised_s):
    alarms = Alarms()
    alarms.remember(1, 122.0, 123.0, KnownAlert(alert, raised_s, seen=True, by="Chief"))
    alarms.tick(123.0, listening=True)
    alarms.add_motion(still(124.0))
    alarms.tick(123.0, listening=True)
    condition = alarms.condition(1)
    assert (condition.alert, condition.acknowledged_by, alarms.changes) == (alert, "Chief", [])
    assert condition.still_s == pytest.approx(54.0 if alert is Alert.STILL_ALARM else 29.0)


def test_a_first_report_is_no_movement_of_now():
    watching = WatchedWearer()
    watching.report(lambda t: Motion(t, 1, 5.0, 3.0, 2.0, moving=False), 1)
    watching.report(still, 21)
    assert watching.alarms.condition(1).alert is Alert.STILL_WARNING


def test_motion_without_the_nodes_flag_is_decided_by_displacement():
    assert moved(Motion(1.0, 1, 0.5, 0.0, 0.0))
    assert moved(Motion(1.0, 1, 0.0, 0.0, math.radians(30.0)))
    assert not moved(Motion(1.0, 1, 0.01, 0.0, 0.0, 0.3, 0.3, 0.1))
    assert not moved(still(1.0), 60.0)


def test_a_fall_down_stairs_sounds_within_three_seconds_until_somebody_walks_again():
    run = simulate_building("building-fall", 205, {"seconds": 120.0, "fall_s": 10.0})
    falls_s = next(e.time_s for e in run.events if e.value == "falling")
    ends_s = next(e.time_s for e in run.events if e.value == "lying")
    composer = Composer()
    raised = {}
    for m in run.measurements:
        if m.time_s > ends_s + 20.0:
            break
        composer.add_observations(m.time_s, [m], None)
        composer.alarms.tick(m.time_s, listening=True)
        for node, _, alert in composer.alarms.changes:
            raised.setdefault((node, alert), m.time_s)
        composer.alarms.changes.clear()
    assert list(raised) == [(2, Alert.FALL)]
    assert falls_s < raised[2, Alert.FALL] <= ends_s + 3.0
    for k in range(1, 4):
        assert composer.alarms.condition(2).alert is Alert.FALL
        composer.add_observations(ends_s + 20.0 + k, [walk(ends_s + 20.0 + k, node=2)], None)
        composer.alarms.tick(ends_s + 20.0 + k, listening=True)
    assert composer.alarms.condition(2).alert is None


def test_a_node_at_the_command_post_is_not_motionless():
    node = WatchedWearer()
    node.alarms.posts = frozenset({1})
    node.report(lambda time_s: Motion(time_s, 1, 0.0, 0.0, 0.0, moving=False), 120)
    assert [alert for _, alert in node.changes if alert is not None] == []
