"""What node and host must do about every fault of the vocabulary, seen at the host's end.

A team of three native boards walks with a fault of node 2 from 25 to 45 s and without it; the
record of either is what the host took (bench/fault_runs.py). Bounds are what the fault
physically allows: a report comes every second, a round of ranges every two, a person walks 0.9 m/s.
"""

import functools
import math

import pytest

import fault_runs
from fault_runs import BEGIN_S, END_S, NODE, SECONDS
from relpos.emulator.faults import FAULTS
from relpos.protocol import messages as wire

SPECS = {spec: fault for fault, spec in fault_runs.specs()}
NOISE_M = 0.35
"""Of a range: 0.1 m of sensor noise over some 200 ranges, and what people walk in the 20 ms that a
frame needs to the host."""
WHOLE_M = 0.003
"""Totals are reported in whole millimetres."""


@functools.cache
def outcome(spec):
    return fault_runs.compare(spec)


def of(*names, soak=(), but=None):
    """Every SPEC of the faults of those names, without those that end in ``but``.

    The first one of each of ``names``; its other kinds, and the faults ``soak``, in soak.
    """
    chosen, seen = [], set()
    for spec, fault in SPECS.items():
        if fault.name in (*names, *soak) and (but is None or not spec.endswith(but)):
            long = fault in seen or fault.name in soak
            chosen.append(pytest.param(spec, marks=pytest.mark.soak if long else ()))
            seen.add(fault)
    assert {fault.name for fault in seen} == {*names, *soak}
    COVERED.update(names, soak)
    return pytest.mark.parametrize("spec", chosen)


COVERED = set()


def in_soak(*values):
    return pytest.param(*values, marks=pytest.mark.soak)


def motions_between(run, begin_s, end_s, node=NODE):
    return [f for t, f in run.of(wire.MOTION, node) if begin_s <= t < end_s]


def heading_apart_rad(result):
    """Difference of the final headings reported with the fault and without, in radians."""
    ours, theirs = (r.of(wire.MOTION, NODE)[-1][1].values for r in (result.run, result.clean))
    return abs(ours["heading_rad"] - theirs["heading_rad"])


def assert_motion_is_untouched(result, node=NODE):
    """Every total that arrived is the one without the fault, and the host has summed it up."""
    theirs = {round(f.values["time_s"], 1): f for _, f in result.clean.of(wire.MOTION, node)}
    compared = 0
    for _, frame in result.run.of(wire.MOTION, node):
        other = theirs.get(round(frame.values["time_s"], 1))
        if other is not None and other.values["time_s"] == frame.values["time_s"]:
            assert frame.values["path_m"] == pytest.approx(other.values["path_m"], abs=WHOLE_M)
            assert frame.values["x_m"] == pytest.approx(other.values["x_m"], abs=3 * WHOLE_M)
            compared += 1
    assert compared > 20
    assert result.run.of(wire.MOTION, node)[-1][0] > SECONDS - 3.0
    assert result.run.summing_error_m(node) < 1e-6
    assert result.run.of(wire.MOTION, node)[-1][1].values["path_m"] > 20.0


def assert_every_range_is_true(result):
    errors = result.run.range_errors_m()
    assert len(errors) > 100
    assert max(map(abs, errors)) < NOISE_M


def assert_nothing_came_twice(result):
    ranges = [(r.node, r.peer, round(r.time_s, 3)) for _, r in result.run.ranges()]
    assert len(ranges) == len(set(ranges))
    times = [m.time_s for _, m in result.run.motions(NODE)]
    assert times == sorted(set(times))


def assert_times_are_true(result, within_s=0.1):
    """Every motion is dated by when it was, however late it came: a frame needs 20 ms at least."""
    errors = result.run.date_errors_s(NODE)
    assert len(errors) > 20
    assert max(map(abs, errors)) < within_s


def assert_others_do_not_care(result):
    for node in result.run.walkers:
        if node != NODE:
            assert_motion_is_untouched(result, node)


# --- inertial chip -------------------------------------------------------------------


@of("imu:stuck", "bus:stuck", soak=("imu:off", "imu:garbage"), but="line=sda")
def test_nothing_is_integrated_without_true_samples_and_the_gap_is_flagged(spec):
    result = outcome(spec)
    # The first sample after the last one used is late by more than half a second from then on.
    inside = motions_between(result.run, BEGIN_S + 2.0, END_S)
    assert len(inside) >= 16, "reports go on"
    assert all(f.values["quality"] & wire.Quality.IMU_GAP for f in inside)
    first, last = inside[0].values, inside[-1].values
    assert abs(last["path_m"] - first["path_m"]) <= WHOLE_M
    assert abs(last["heading_rad"] - first["heading_rad"]) < 0.002
    # What went unseen is charged: the way truly walked is no surprise to who believes the sigma.
    after = motions_between(result.run, END_S + 3.0, SECONDS)[0].values
    sigma_m = math.sqrt(after["variance_along_m2"] - first["variance_along_m2"])
    assert sigma_m > result.run.path_length_m(NODE, BEGIN_S, END_S) / 3.0
    assert result.run.flagged(NODE, wire.Quality.FILTER_RESET) > 0
    assert result.recovery_s <= 3.0
    assert not result.run.counts.get("restarts"), "no reset"
    assert_every_range_is_true(result)
    assert_others_do_not_care(result)


@of("bus:nack", soak=("imu:slow", "imu:intermittent"))
def test_missing_samples_are_counted_and_the_rest_is_integrated(spec):
    result = outcome(spec)
    assert result.run.grown(NODE, "missed_ticks") > 100
    assert result.run.flagged(NODE, wire.Quality.IMU_GAP) >= 18
    assert result.run.flagged(NODE, wire.Quality.FILTER_RESET) == result.clean.flagged(
        NODE, wire.Quality.FILTER_RESET
    )
    # No more is lost than the share of the time that is missing.
    share = result.run.grown(NODE, "missed_ticks") / (50.0 * (END_S - BEGIN_S))
    assert share < 0.6
    assert abs(result.lost_m) < share * result.run.path_length_m(NODE, BEGIN_S, END_S)
    assert heading_apart_rad(result) < math.radians(15.0)
    assert result.recovery_s <= (4.5 if "ranges" in result.disturbed else 2.0)
    if not spec.startswith("imu:slow"):
        assert result.run.grown(NODE, "bus_errors") > 100
    assert_every_range_is_true(result)


@of("imu:wrong")
def test_a_bias_that_jumps_turns_the_walk_less_than_it_would_unlearned(spec):
    result = outcome(spec)
    assert result.disturbed == []
    assert heading_apart_rad(result) < math.radians(1.0) * (END_S - BEGIN_S)
    assert abs(result.lost_m) < 1.5
    assert_every_range_is_true(result)


@of("imu:delayed")
def test_late_samples_lose_no_motion(spec):
    result = outcome(spec)
    assert result.disturbed == []
    assert abs(result.lost_m) < 0.3
    assert heading_apart_rad(result) < math.radians(5.0)


@of("imu:brownout")
def test_a_chip_that_fell_asleep_is_set_up_anew_at_once(spec):
    result = outcome(spec)
    # 120 ms until the silence is noticed, 200 ms for the set-up that the data sheet asks for.
    assert 10 <= result.run.grown(NODE, "missed_ticks") <= 25
    assert result.run.flagged(NODE, wire.Quality.IMU_GAP) == 1
    assert result.recovery_s <= 1.5
    assert abs(result.lost_m) < 1.5
    assert_every_range_is_true(result)
    assert_others_do_not_care(result)


# --- magnetometer --------------------------------------------------------------------


@of("magnetometer:wrong",
    soak=("magnetometer:off", "magnetometer:stuck", "magnetometer:garbage", "magnetometer:slow"),
)  # fmt: skip
def test_no_heading_is_reported_without_a_true_field_and_the_gyroscope_goes_on(spec):
    result = outcome(spec)
    inside = [h for t, h in result.run.headings(NODE) if BEGIN_S + 3.0 <= t < END_S]
    # A tick that is left out for a step gives a slow conversion the time it needs: a true reading.
    assert len(inside) <= (2 if "slow" in spec else 0)
    assert len([h for t, h in result.clean.headings(NODE) if BEGIN_S + 3.0 <= t < END_S]) > 12
    assert abs(result.lost_m) < 0.3
    assert heading_apart_rad(result) < math.radians(10.0)
    assert result.disturbed == ["headings"]
    assert result.recovery_s <= 2.5
    if "wrong" in spec:
        assert result.run.flagged(NODE, wire.Quality.MAGNETOMETER_DISTURBED) > 15
    assert_every_range_is_true(result)


@of("magnetometer:intermittent")
def test_headings_from_a_loose_magnetometer_are_true(spec):
    result = outcome(spec)
    theirs = {round(h.time_s): h.heading_rad for _, h in result.clean.headings(NODE)}
    ours = [h for _, h in result.run.headings(NODE) if round(h.time_s) in theirs]
    assert len(ours) > 20
    for heading in ours:
        apart = heading.heading_rad - theirs[round(heading.time_s)]
        assert abs(math.remainder(apart, 2.0 * math.pi)) < math.radians(30.0)
    assert abs(result.lost_m) < 0.3


# --- Pozyx and ultra-wideband --------------------------------------------------------


@of("pozyx:garbage",
    soak=("pozyx:off", "pozyx:stuck", "pozyx:slow", "pozyx:delayed", "pozyx:intermittent",
          "pozyx:inverted"),
)  # fmt: skip
def test_a_pozyx_that_fails_or_lies_gives_no_wrong_range_and_touches_no_motion(spec):
    result = outcome(spec)
    assert_every_range_is_true(result)
    assert_motion_is_untouched(result)
    assert_others_do_not_care(result)
    failures = result.run.grown(NODE, "ranging_failures") + result.run.grown(NODE, "bus_errors")
    before = result.clean.grown(NODE, "ranging_failures") + result.clean.grown(NODE, "bus_errors")
    unwell = wire.Health.POZYX in result.run.unwell(NODE, BEGIN_S + 1.0, END_S)
    assert unwell or failures >= before + 3
    assert result.recovery_s <= 4.5


@of("pozyx:brownout")
def test_a_pozyx_that_restarts_ranges_again(spec):
    result = outcome(spec)
    assert_every_range_is_true(result)
    assert_motion_is_untouched(result)
    again = [t for t, _ in result.run.ranges(NODE) if t > BEGIN_S]
    assert again[0] - BEGIN_S < 15.0
    assert len([t for t in again if t > BEGIN_S + 15.0]) > 20


@of("pozyx:wrong", soak=("uwb:wrong",))
def test_ranges_that_are_wrong_at_the_source_touch_nothing_else(spec):
    result = outcome(spec)
    assert_motion_is_untouched(result)
    assert result.disturbed == []
    for arrival_s, r in result.run.ranges():
        error_m = r.range_m - result.run.true_distance_m(r.node, r.peer, r.time_s)
        concerned = BEGIN_S - 2.0 < r.time_s < END_S + 2.0
        if spec.startswith("pozyx"):
            concerned &= r.node == NODE
        assert abs(error_m) < NOISE_M or (concerned and -NOISE_M < error_m < 3.0 + NOISE_M), (
            arrival_s
        )


@of("uwb:loss", soak=("uwb:collisions",))
def test_exchanges_that_fail_are_counted_and_the_others_are_true(spec):
    result = outcome(spec)
    assert_every_range_is_true(result)
    assert_motion_is_untouched(result)
    assert result.run.grown(NODE, "ranging_failures") > result.clean.grown(NODE, "ranging_failures")
    inside = [r for t, r in result.run.ranges() if BEGIN_S + 3.0 < t < END_S]
    assert len(inside) > 10, "ranges go on"
    assert result.recovery_s <= 4.5


# --- radio ---------------------------------------------------------------------------


@of("xbee:off", "xbee:stuck", "radio:bitflip", "radio:replay", "radio:reorder", "radio:foreign",
    soak=("xbee:garbage", "xbee:wrong", "xbee:slow", "xbee:delayed", "xbee:intermittent",
          "xbee:bitflip", "xbee:truncate", "xbee:duplicate", "xbee:brownout", "radio:loss",
          "radio:truncate", "radio:duplicate", "radio:delayed"),
)  # fmt: skip
def test_no_fault_of_the_radio_loses_motion_or_lets_anything_in_twice(spec):
    result = outcome(spec)
    assert_motion_is_untouched(result)
    assert_others_do_not_care(result)
    assert abs(result.lost_m) < WHOLE_M
    assert result.restarts == 0
    assert_every_range_is_true(result)
    assert_nothing_came_twice(result)
    assert_times_are_true(result)
    assert result.recovery_s <= 4.5


@pytest.mark.parametrize(
    ("name", "least_counts"),
    [
        ("radio:bitflip", {"FrameCrcError": 5}),
        ("radio:replay", {"duplicate": 5}),
        ("radio:reorder", {"reordered": 3, "late_motion": 1}),
        ("xbee:off", {"lost": 15}),
        in_soak("radio:truncate", {"FrameLengthError": 1, "FrameCrcError": 1}),
        in_soak("radio:duplicate", {"duplicate": 5}),
        in_soak("radio:loss", {"lost": 8}),
        in_soak("xbee:delayed", {"reordered": 3}),
    ],
)
def test_the_host_counts_what_it_refuses_or_misses(name, least_counts):
    counts = outcome(next(spec for spec, fault in SPECS.items() if fault.name == name)).run.counts
    for reason, least in least_counts.items():
        assert counts[reason] >= least


@pytest.mark.parametrize("name", ["xbee:stuck", in_soak("xbee:wrong"), in_soak("xbee:slow")])
def test_a_radio_whose_status_is_missing_or_wrong_slows_no_report_down(name):
    result = outcome(next(spec for spec, fault in SPECS.items() if fault.name == name))
    assert len(motions_between(result.run, BEGIN_S, END_S)) >= 18
    assert result.run.grown(NODE, "radio_failures") >= 15


def test_a_stranger_without_the_key_is_refused_by_host_and_nodes():
    result = outcome(fault_runs.example(_fault("radio:foreign"), key="wrong"))
    assert result.run.counts["FrameTagError"] >= 80
    for node in result.run.walkers:
        assert result.run.grown(node, "refused_frames") >= 40
    assert {f.node for _, f in result.run.frames} == set(result.run.walkers)


def test_with_all_that_a_stolen_node_holds_nobody_speaks_for_or_commands_another():
    result = outcome(fault_runs.example(_fault("radio:foreign"), key="stolen"))
    assert {f.node for _, f in result.run.frames} == set(result.run.walkers)
    assert result.run.counts["FrameTagError"] >= 60
    assert result.restarts == 0, "a command was obeyed"
    assert_motion_is_untouched(result)
    assert_every_range_is_true(result)
    for node in set(result.run.walkers) - {max(result.run.walkers)}:
        assert result.run.grown(node, "refused_frames") >= 30
        at_s = [t for t, r in result.run.ranges() if r.node == node and BEGIN_S < t < END_S]
        assert len(at_s) >= 10, "ranging goes on without the true beacons"


def _fault(name):
    return next(fault for fault in FAULTS if fault.name == name)


# --- host ----------------------------------------------------------------------------


@of("host:gone", soak=("host:delayed",))
def test_a_host_that_was_away_has_all_motion_with_the_first_report(spec):
    result = outcome(spec)
    assert_motion_is_untouched(result)
    assert_others_do_not_care(result)
    assert abs(result.lost_m) < WHOLE_M
    assert_every_range_is_true(result)
    assert_nothing_came_twice(result)
    assert_times_are_true(result, within_s=0.2)
    assert result.recovery_s <= 2.5
    if "gone" in spec:
        successes = result.run.statuses(NODE, "ranging_successes")
        before = max(value for t, value in successes if t < BEGIN_S)
        after = min(value for t, value in successes if t > END_S)
        assert after > before + 5, "ranging went on meanwhile"


# --- clock, bus, supply, memory ------------------------------------------------------


@of("clock:wrong")
def test_a_clock_that_is_off_by_half_a_percent_is_followed(spec):
    result = outcome(spec)
    drift = [v for _, v in result.run.statuses(NODE, "link_clock_drift")]
    assert drift[-1] == pytest.approx(-0.005, abs=0.0007)
    assert_every_range_is_true(result)
    assert abs(result.lost_m) < 0.05 * result.run.path_length_m(NODE, 0.0, SECONDS)


@of("clock:wrap")
def test_a_timer_that_wraps_is_not_to_be_seen(spec):
    result = outcome(spec)
    assert [f for _, f in result.run.frames] == [f for _, f in result.clean.frames]


@of("clock:intermittent")
def test_a_clock_that_halts_for_moments_hangs_nothing_and_loses_no_more_than_that(spec):
    result = outcome(spec)
    assert result.restarts == 0
    assert len(motions_between(result.run, BEGIN_S, END_S)) >= 17
    # 60 ms of every second: the totals, and the node's time, fall short of as much.
    assert abs(result.lost_m) < 2 * 0.06 * result.run.path_length_m(NODE, BEGIN_S, END_S)
    assert_others_do_not_care(result)


@of("node:brownout", soak=("clock:off", "node:off"))
def test_a_restart_is_reported_loses_the_unreported_second_and_widens_the_first_motion(spec):
    result = outcome(spec)
    fault = SPECS[spec]
    cause = {
        "clock:off": wire.ResetCause.WATCHDOG,
        "node:off": wire.ResetCause.POWER_ON,
        "node:brownout": wire.ResetCause.BROWN_OUT,
    }[fault.name]
    assert result.restarts == 1
    boots = [f.boot for _, f in result.run.of(wire.MOTION, NODE)]
    assert sorted(set(boots)) == [boots[0], boots[0] + 1]
    assert result.run.statuses(NODE, "reset_cause")[-1][1] == cause
    away_s = 0.0 if fault.momentary else END_S - BEGIN_S
    # A report a second and its way to the host; start-up of processor and chips.
    assert result.lost_s <= away_s + 1.0 + 0.3
    assert result.lost_m <= result.run.path_length_m(NODE, BEGIN_S - 1.2, BEGIN_S + away_s + 0.5)
    first = next(
        m for (_, m), (t, f) in zip(
            result.run.motions(NODE), result.run.of(wire.MOTION, NODE), strict=True
        ) if f.boot == boots[-1]
    )  # fmt: skip
    assert first.sigma_x_m > result.lost_m / 2.0
    assert first.sigma_y_m > result.lost_m / 2.0
    assert result.recovery_s <= 4.0
    counters = [f.counter for _, f in result.run.frames if f.node == NODE]
    assert counters == sorted(set(counters))
    assert_every_range_is_true(result)
    assert_others_do_not_care(result)


@of("eeprom:cut")
def test_a_cut_while_settings_are_written_leaves_the_old_ones_or_the_new(spec):
    result = outcome(spec)
    assert result.restarts >= 1
    assert {f.node for _, f in result.run.frames} == set(result.run.walkers), "its number stays"
    counters = [f.counter for _, f in result.run.frames if f.node == NODE]
    assert counters == sorted(set(counters))
    assert len(result.run.good_motions(NODE)) > SECONDS - 12.0  # ten of them standing still
    assert_every_range_is_true(result)


def test_a_bus_that_nine_clocks_free_costs_one_transaction():
    result = outcome(fault_runs.example(_fault("bus:stuck"), line="sda"))
    assert result.run.grown(NODE, "bus_errors") == result.clean.grown(NODE, "bus_errors") + 1
    assert result.disturbed == []
    assert abs(result.lost_m) < 0.02
    assert_every_range_is_true(result)


# --- the vocabulary ------------------------------------------------------------------


def test_every_fault_of_the_vocabulary_has_a_test_here():
    assert {fault.name for fault in FAULTS} == COVERED
