"""Faults act on a simulated board as on the native one: the flashed firmware under some of each."""

import pytest

from fault_runs import NODE, record
from relpos.emulator.avr.elf import default_build_folder
from relpos.emulator.avr.library import missing_parts
from relpos.protocol import messages as wire

SECONDS = 12.0

pytestmark = pytest.mark.skipif(missing_parts() is not None, reason=str(missing_parts()))


@pytest.fixture(autouse=True)
def _firmware_is_built():
    if not (default_build_folder() / "uno" / "firmware.elf").exists():
        pytest.fail("no firmware for the uno: run `make firmware` first")


def in_soak(*values):
    return pytest.param(*values, marks=pytest.mark.soak)


def walk(*faults):
    return record(faults, seconds=SECONDS, nodes=2, board="uno")


def last_motion(run):
    return run.of(wire.MOTION, NODE)[-1]


def assert_sound(run):
    assert last_motion(run)[0] > SECONDS - 1.6, "no hang"
    assert max(map(abs, run.range_errors_m()), default=0.0) < 0.35
    counters = [f.counter for _, f in run.frames if f.node == NODE]
    assert counters == sorted(set(counters))


@pytest.mark.parametrize(
    ("spec", "cause"),
    [
        ("clock:off:node=2,from=5,to=7", wire.ResetCause.WATCHDOG),
        ("eeprom:cut:node=2,from=1.7,write=3,left=garbage", wire.ResetCause.BROWN_OUT),
        in_soak("node:brownout:node=2,from=6.1", wire.ResetCause.BROWN_OUT),
        in_soak("node:off:node=2,from=5,to=6", wire.ResetCause.POWER_ON),
    ],
)
def test_a_restart_is_reported_with_its_cause_and_the_next_boot_count(spec, cause):
    run = walk(spec)
    assert_sound(run)
    boots = [f.boot for _, f in run.frames if f.node == NODE]
    assert sorted(set(boots)) in ([boots[0], boots[0] + 1], [boots[-1]])
    assert {f.node for _, f in run.frames} == {1, 2}
    assert run.statuses(NODE, "reset_cause")[-1][1] == cause


@pytest.mark.parametrize("spec", ["imu:garbage", in_soak("imu:stuck"), in_soak("bus:stuck")])
def test_nothing_is_integrated_without_true_samples_and_the_gap_is_flagged(spec):
    run = walk(f"{spec}:node=2,from=5,to=9")
    assert_sound(run)
    inside = [f.values for t, f in run.of(wire.MOTION, NODE) if 6.6 <= t < 9.0]
    assert len(inside) >= 2
    assert all(values["quality"] & wire.Quality.IMU_GAP for values in inside)
    assert inside[-1]["path_m"] == inside[0]["path_m"]
    assert any(t > 9.0 for t in run.good_motions(NODE)), "whole motion again within 3 s"


def test_a_timer_that_wraps_and_a_radio_that_loses_half_are_survived():
    run = walk("clock:wrap:node=2,from=6", "radio:loss:rate=0.5,to=10")
    assert_sound(run)
    assert run.counts["lost"] > 5
    assert run.summing_error_m(NODE) < 1e-6
    times = [f.values["time_s"] for _, f in run.of(wire.MOTION, NODE)]
    assert times == sorted(times)
