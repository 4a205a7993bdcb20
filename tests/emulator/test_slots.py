"""Ranging in the coordinator's slots, and without, on the production firmware of whole teams."""

from __future__ import annotations

import importlib.util
import itertools
import sys
from pathlib import Path

import pytest

from relpos.emulator.air import Outcome
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link.port import Link
from relpos.measurements import Status
from relpos.protocol import messages as wire

_spec = importlib.util.spec_from_file_location(
    "slots", Path(__file__).parents[2] / "bench" / "ranging" / "slots.py"
)
assert _spec is not None
assert _spec.loader is not None
slots = importlib.util.module_from_spec(_spec)
sys.modules["slots"] = slots
_spec.loader.exec_module(slots)

SECONDS = 20.0


@pytest.fixture(scope="module")
def twenty():
    """Everybody in reach of everybody, every exchange detected: only collisions spoil one."""
    return slots.measure(20, slotted=True, seconds=SECONDS, detection=1.0)


@pytest.fixture(scope="module")
def twenty_unslotted():
    return slots.measure(20, slotted=False, seconds=SECONDS, detection=1.0)


@pytest.fixture(scope="module")
def seven():
    return slots.measure(7, slotted=True, seconds=SECONDS, detection=1.0)


# --- the measure itself -----------------------------------------------------------------------


def test_the_longest_gap_of_a_pair_counts_both_directions_and_both_edges():
    ranges = [(12.0, (1, 2)), (15.0, (2, 1)), (11.0, (1, 3)), (5.0, (2, 3))]
    gaps = slots.longest_gaps(ranges, [(1, 2), (1, 3), (2, 3)], 10.0, 20.0)
    assert gaps == [5.0, 9.0, 10.0]


# --- twenty -----------------------------------------------------------------------------------


def test_nine_exchanges_in_ten_of_twenty_slotted_nodes_succeed(twenty):
    assert twenty.absent == twenty.undetected == 0
    assert twenty.exchanges >= 20 * SECONDS / 2.0, "less than one a node and round"
    assert twenty.ranged >= 0.9 * twenty.exchanges


@pytest.mark.soak
def test_slots_are_clearly_better_than_none(twenty, twenty_unslotted):
    assert twenty.free_of_collision >= twenty_unslotted.free_of_collision + 0.1
    assert twenty.ranged > 1.2 * twenty_unslotted.ranged
    assert twenty.longest_gap_s < twenty_unslotted.longest_gap_s


def test_every_pair_of_twenty_is_ranged_at_least_every_ten_seconds(twenty):
    assert twenty.longest_gap_s <= 10.0


def test_twenty_share_the_air_fairly(twenty):
    assert twenty.fewest_ranges >= 0.8 * twenty.most_ranges


@pytest.mark.soak
def test_no_node_of_twenty_is_shut_out_without_slots(twenty_unslotted):
    assert twenty_unslotted.fewest_ranges > 0
    assert twenty_unslotted.fewest_ranges >= 0.2 * twenty_unslotted.most_ranges


@pytest.mark.soak
def test_ranges_keep_flowing_where_the_radio_loses_half_of_the_beacons():
    lossy = slots.measure(20, slotted=True, loss=0.5, seconds=SECONDS, detection=1.0)
    assert lossy.free_of_collision >= 0.9
    assert lossy.fewest_ranges >= 0.7 * lossy.most_ranges
    # Half of the frames that carry ranges are lost, the others arrive.
    assert lossy.host_ranges >= 0.35 * lossy.ranged


# --- seven ------------------------------------------------------------------------------------


def test_seven_range_all_their_neighbours_every_two_seconds(seven):
    assert seven.ranged >= 0.97 * seven.exchanges
    # A node's clock and the room within its window move the moment by some milliseconds.
    assert seven.longest_gap_s <= 2.2


def test_seven_share_the_air_fairly(seven):
    assert seven.fewest_ranges >= 0.9 * seven.most_ranges


# --- beacons come and go ----------------------------------------------------------------------


def test_a_node_without_beacons_says_so_and_ranges_on():
    link, statuses = Link(), []
    with EmulatedTeam(TeamConfig("paper", 3, 60.0, 2, beacons=True)) as team:
        records = []
        team.uwb.on_end = records.append
        for until_us in (25_000_000, 60_000_000):
            for time_us, data in team.run(until_us):
                statuses += [o for o in link.feed(data, time_us * 1e-6) if isinstance(o, Status)]
            team.coordinator.from_serial = lambda *_: None  # no beacon from now on
    teams = {t.time_s: t.value for t in statuses if t.name == "team"}
    health = {t.time_s: int(t.value) for t in statuses if t.name == "health"}
    assert {value for s, value in teams.items() if 8.0 < s < 25.0} == {3.0}
    assert {value for s, value in teams.items() if s > 32.0} == {0.0}
    assert all(h & wire.Health.BEACON for s, h in health.items() if 8.0 < s < 25.0)
    assert not any(h & wire.Health.BEACON for s, h in health.items() if s > 32.0)
    late = [r for r in records if r.begin_us > 32_000_000 and r.outcome is Outcome.RANGED]
    assert {r.initiator for r in late} == {1, 2, 3}


def test_exchanges_stay_within_their_window_of_the_superframe():
    """By the coordinator's clock, which the nodes know to some milliseconds from the beacons."""
    with EmulatedTeam(TeamConfig("paper", 6, 30.0, 4, beacons=True)) as team:
        records = []
        team.uwb.on_end = records.append
        for _ in team.stream():
            pass
    kept = [r for r in records if r.begin_us > 10_000_000]
    assert len(kept) > 100
    # In the order of the superframe's phases, each node has one run of them.
    for _, round_of in itertools.groupby(kept, lambda r: r.begin_us // 2_000_000):
        initiators = [r.initiator for r in round_of]
        runs = [node for node, _ in itertools.groupby(initiators)]
        assert len(runs) <= len(set(runs)) + 1  # the first may have begun in the round before


def test_the_same_seed_gives_the_same_bytes_in_slots_too():
    def output():
        with EmulatedTeam(TeamConfig("paper", 5, 12.0, 3, beacons=True)) as team:
            return list(team.stream())

    assert output() == output()


def test_the_table_has_a_row_a_run(seven):
    lines = slots.table([seven]).splitlines()
    assert len(lines) == 3
    assert len({line.count("|") for line in lines}) == 1
