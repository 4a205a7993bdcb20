"""The rule of a node's health, and the figures it is computed from."""

import pytest

from relpos.link.port import Link
from relpos.measurements import Status
from relpos.nodes.health import Health, HealthInputs, assess
from relpos.nodes.monitor import TeamMonitor, WindowedCount
from relpos.protocol import messages as wire

WELL = HealthInputs(
    silent_s=0.8,
    frame_loss=0.02,
    rssi_dbm=-70.0,
    battery_v=5.02,
    ranging=0.7,
    exchanges=60,
    neighbours=5,
    team=6,
    imu=True,
    magnetometer=True,
    pozyx=True,
    pressure=True,
    beacon=True,
    uptime_s=1000.0,
    free_stack_bytes=300,
)


def but(**changes):
    return HealthInputs(**(vars_of(WELL) | changes))


def vars_of(figures):
    return {name: getattr(figures, name) for name in figures.__dataclass_fields__}


def test_a_node_with_everything_is_green_and_says_nothing():
    assert assess(WELL) == (Health.GREEN, [])


@pytest.mark.parametrize(
    ("changes", "health", "words"),
    [
        ({"silent_s": 5.1}, Health.RED, "silent for 5 s"),
        ({"imu": False}, Health.RED, "inertial sensor"),
        ({"frame_loss": 0.6}, Health.RED, "60 % of frames"),
        ({"frame_loss": 0.11}, Health.YELLOW, "11 % of frames"),
        ({"battery_v": 4.1}, Health.RED, "4.10 V"),
        ({"battery_v": 4.4}, Health.YELLOW, "4.40 V"),
        ({"magnetometer": False}, Health.YELLOW, "magnetometer missing"),
        ({"pozyx": False}, Health.YELLOW, "Pozyx missing"),
        ({"pressure": False}, Health.YELLOW, "pressure"),
        ({"beacon": False}, Health.YELLOW, "beacon"),
        ({"ranging": 0.15}, Health.YELLOW, "15 % of rangings"),
        ({"neighbours": 0}, Health.YELLOW, "no peer in range"),
        ({"rssi_dbm": -89.0}, Health.YELLOW, "-89 dBm"),
        ({"unwanted_start": "watchdog", "uptime_s": 12.0}, Health.YELLOW, "watchdog"),
        ({"missed_ticks": 3}, Health.YELLOW, "3 ticks"),
        ({"refused_frames": 2}, Health.YELLOW, "2 forged"),
        ({"damaged_bytes": 3}, Health.YELLOW, "3 bytes damaged"),
        ({"lost_bytes": 4}, Health.YELLOW, "4 received bytes lost"),
        ({"free_stack_bytes": 40}, Health.YELLOW, "40 bytes of stack"),
        ({"status": False}, Health.YELLOW, "no status"),
    ],
)
def test_each_trouble_has_its_colour_and_its_words(changes, health, words):
    colour, reasons = assess(but(**changes))
    assert colour is health
    assert len(reasons) == 1
    assert words in reasons[0]


@pytest.mark.parametrize(
    "changes",
    [
        {"battery_v": 0.0},  # this board does not measure it
        {"ranging": 0.0, "exchanges": 11},  # too few to say
        {"unwanted_start": "watchdog", "uptime_s": 90.0},  # long ago
        {"neighbours": 0, "team": 1},  # alone
        {"ranging": None, "neighbours": None, "beacon": None, "imu": None},  # not reported
    ],
)
def test_a_node_without_trouble_stays_green(changes):
    assert assess(but(**changes))[0] is Health.GREEN


def test_a_node_whose_parts_have_not_answered_yet_is_starting_and_lacks_none_of_them():
    nothing = dict.fromkeys(("imu", "magnetometer", "pozyx", "pressure", "beacon"), False)
    assert assess(but(**nothing, uptime_s=1.0)) == (Health.YELLOW, ["starting"])
    assert len(assess(but(**nothing, uptime_s=11.0))[1]) == 5


def test_the_worst_comes_first():
    colour, reasons = assess(but(silent_s=9.0, pozyx=False))
    assert colour is Health.RED
    assert reasons[0].startswith("silent")
    assert len(reasons) == 2


def test_counts_wrap_begin_anew_with_a_boot_and_leave_the_window():
    counter = WindowedCount(1 << 16)
    counter.update(0.0, 3, 65530)  # what was before the watch began is not counted
    counter.update(10.0, 3, 4)
    assert counter.within(10.0) == 10
    counter.update(20.0, 4, 7)  # another boot: all seven are new
    assert counter.within(20.0) == 17
    assert counter.within(45.0) == 7
    short = WindowedCount(1 << 8)
    short.update(0.0, 3, 250)
    short.update(10.0, 3, 4)
    assert short.within(10.0) == 10


def test_a_view_has_loss_silence_and_ranging_of_the_last_half_minute():
    link, view = Link(), TeamMonitor()

    def hear(time_s, received, lost, successes, failures):
        track = link.decoder.nodes.setdefault(5, _track())
        track.counts.update({"received": received, "lost": lost})
        track.rssi_dbm = -71
        statuses = {"ranging_successes": successes, "ranging_failures": failures, "battery_v": 4.9}
        view.update(
            time_s,
            link.decoder,
            [Status(time_s, 5, name, float(value)) for name, value in statuses.items()],
        )

    hear(0.0, 1, 0, 100, 100)
    hear(10.0, 9, 1, 109, 101)
    row = view.rows(12.0)[0]
    assert row["loss"] == pytest.approx(0.1)
    assert row["seen_s"] == 2.0
    assert (row["ranging"], row["exchanges"]) == (0.9, 10)
    assert row["rssi_dbm"] == -71
    assert row["health"] == "green"
    assert view.rows(60.0)[0]["health"] == "red"


def _track():
    from relpos.link.decoder import NodeTrack

    return NodeTrack(boot=1)


def test_the_unwanted_starts_are_those_of_the_wire():
    from relpos.nodes.monitor import UNWANTED

    assert set(UNWANTED) == {
        wire.ResetCause.BROWN_OUT,
        wire.ResetCause.WATCHDOG,
        wire.ResetCause.UNKNOWN,
    }


def test_a_restart_whose_cause_the_boot_loader_hides_is_reported_and_a_first_start_is_not():
    from relpos.nodes.monitor import NodeMonitor

    view = NodeMonitor(3, boot=7)
    for name, value in (("reset_cause", 0.0), ("uptime_s", 5.0)):
        view.add_status(10.0, name, value)
    view.add_link(10.0, 1, 0)
    assert not [words for words in view.health(10.0)[1] if "restarted" in words]
    view.restarted = True
    assert "restarted (brown-out or button)" in view.health(10.0)[1]


@pytest.mark.parametrize("value", [6.0, 255.0, -1.0, float("nan")])
def test_a_recorded_cause_of_a_restart_that_nobody_knows_is_unknown(value):
    view = TeamMonitor()
    view.update_without_link(1.0, [Status(1.0, 5, "reset_cause", value)])
    (row,) = view.rows(3.0)
    assert row["reset_cause"] == "unknown"
    assert row["seen_s"] == 2.0


@pytest.mark.parametrize(
    ("grown", "words"),
    [
        ({"ranging_successes": 1, "ranging_failures": 19}, "5 % of rangings succeed"),
        ({"missed_ticks": 3}, "3 ticks missed"),
        ({"refused_frames": 2}, "2 forged or repeated frames rejected"),
        ({"damaged_bytes": 5}, "5 bytes damaged on the way from the XBee"),
        ({"lost_bytes": 4}, "4 received bytes lost"),
        ({"neighbours": 0, "team": 3}, "no peer in range"),
        ({"free_stack_bytes": 40}, "40 bytes of stack left"),
        ({"battery_v": 4.2}, "supply 4.20 V"),
        ({"uptime_s": 20.0, "reset_cause": wire.ResetCause.WATCHDOG}, "restarted (watchdog)"),
        ({"uptime_s": 2.0, "health": 0}, "starting"),
        ({"health": 0}, "inertial sensor missing"),
    ],
)
def test_what_a_node_reports_becomes_a_reason(grown, words):
    view = TeamMonitor()
    for time_s, factor in ((1.0, 0.0), (2.0, 1.0)):
        statuses = {"uptime_s": 1000.0} | {name: factor * value for name, value in grown.items()}
        view.update_without_link(
            time_s, [Status(time_s, 5, name, value) for name, value in statuses.items()]
        )
    assert view.rows(2.0)[0]["reasons"][0] == words
