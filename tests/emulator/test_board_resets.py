"""Boards restarted at any moment for every cause, their EEPROM cut, their clocks at the wrap."""

from itertools import pairwise

import pytest

from relpos.emulator.avr.elf import default_build_folder
from relpos.emulator.avr.library import missing_parts
from relpos.emulator.engine import NodeClockError
from relpos.emulator.node import BoardKind, NodeErrors
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import xbee
from relpos.protocol import framing
from relpos.protocol import messages as wire

NEEDS = missing_parts()
needs_avr = pytest.mark.skipif(NEEDS is not None, reason=str(NEEDS))
BOARDS = [
    BoardKind.NATIVE,
    pytest.param(BoardKind.UNO, marks=needs_avr),
    pytest.param(BoardKind.MEGA, marks=[needs_avr, pytest.mark.soak]),
]

UNO_IN_SOAK = pytest.param(BoardKind.UNO, marks=[needs_avr, pytest.mark.soak])


@pytest.fixture(autouse=True)
def _firmware_is_built():
    if NEEDS is None and not (default_build_folder() / "uno" / "firmware.elf").exists():
        pytest.fail("no firmware for the boards: run `make firmware` first")


class Listener:
    """The frames of one node, without a radio that loses any."""

    def __init__(self, team):
        self.team = team
        self.parser = xbee.Parser()
        self.frames = []
        self.node = team.nodes[1]
        pass_on = self.node.engine.on_transmit
        self.node.engine.on_transmit = lambda at_us, data: (
            self._hear(data, at_us),
            pass_on(at_us, data),
        )

    def _hear(self, data, at_us):
        for request in self.parser.feed(data):
            if isinstance(request, xbee.Transmit16):
                self.frames.append((framing.decode(request.data), at_us * 1e-6))

    def until(self, time_us):
        """The frames up to then since the last call."""
        return [frame for frame, _ in self.timed(time_us)]

    def timed(self, time_us):
        """The same, each with when it left, in seconds."""
        self.team.run(time_us)
        frames, self.frames = self.frames, []
        return frames


def straight(board, seconds, **errors):
    return EmulatedTeam(TeamConfig(
        "straight", 1, seconds, seed=3, board=board, configured=False,
        node_errors=lambda _seed, _node: NodeErrors(**errors),
    ))  # fmt: skip


@pytest.mark.parametrize("board", [BoardKind.NATIVE, UNO_IN_SOAK])
def test_a_node_reports_the_cause_of_a_restart_and_counts_it(board):
    reported = []
    causes = ("POWER_ON", "BROWN_OUT", "WATCHDOG", "EXTERNAL")
    with straight(board, 60.0) as team:
        listener = Listener(team)
        at_us = 0
        for k, cause in enumerate(causes):
            if k:
                # At no moment of the loop in particular.
                listener.node.restart(at_us, wire.ResetCause[cause])
            at_us += 12_000_000 + 7_919 * k
            frames = listener.until(at_us)
            (status, *_) = [f for f in frames if f.message is wire.STATUS]
            reported.append((wire.ResetCause(status.values["reset_cause"]).name, status.boot))
    first_boot = reported[0][1]
    assert reported == [(cause, first_boot + k) for k, cause in enumerate(causes)]


@pytest.mark.parametrize("board", BOARDS)
def test_nothing_is_executed_or_received_in_the_start_up_after_a_reset(board):
    with straight(board, 20.0) as team:
        listener = Listener(team)
        listener.until(10_000_000)
        listener.node.restart(10_000_000, wire.ResetCause.EXTERNAL)
        transactions = listener.node.bus.transactions
        assert not listener.node.engine.executes(10_000_000)
        team.run(10_060_000)
        assert listener.node.bus.transactions == transactions
        team.run(10_200_000)
        assert listener.node.engine.executes(10_200_000)
        assert listener.node.bus.transactions > transactions


def settings_after_a_cut(board, cut_after_us):
    """Leg length in force after a brown-out so long after the command to change it arrived."""
    with straight(board, 20.0) as team:
        node = team.nodes[1]
        listener = Listener(team)
        listener.until(2_000_000)
        node.command(team.coordinator, wire.CommandCode.SET_LEG_LENGTH_MM, 777, 1, 2_000_000)
        team.run(2_000_000 + cut_after_us)
        node.restart(2_000_000 + cut_after_us, wire.ResetCause.BROWN_OUT)
        team.run(4_000_000)
        listener.frames.clear()
        # The answer to a command that is out of range has the value in force.
        code = wire.CommandCode.SET_LEG_LENGTH_MM
        node.command(team.coordinator, code, 1, 0x4000, 4_000_000)
        (answer,) = [f for f in listener.until(6_000_000) if f.message is wire.ACKNOWLEDGEMENT]
        assert answer.values["result"] == wire.CommandResult.OUT_OF_RANGE
        return answer.values["value"]


@pytest.mark.parametrize("board", [BOARDS[0], BOARDS[1]])
def test_a_power_cut_while_settings_are_stored_leaves_the_old_or_the_new_ones(board):
    # Two copies of a record of 65 bytes at 3.4 ms each: half a second.
    step_us = 46_700 if board is BoardKind.NATIVE else 139_700
    outcomes = [settings_after_a_cut(board, us) for us in range(20_000, 700_000, step_us)]
    assert set(outcomes) == {930, 777}
    assert outcomes == sorted(outcomes, reverse=True)  # once stored, it stays


def test_a_byte_of_the_native_eeprom_takes_its_time_and_is_erased_by_a_cut():
    with straight("native", 10.0) as team:
        node = team.nodes[1]
        stored = []
        plain = node.engine.store
        node.engine.store = lambda at, value: (
            stored.append((team.clock.now_us, at)),
            plain(at, value),
        )
        node.command(team.coordinator, wire.CommandCode.SET_LEG_LENGTH_MM, 777, 1, 2_000_000)
        team.run(4_000_000)
        times = [time_us for time_us, _ in stored]
        assert min(b - a for a, b in pairwise(times)) >= 3_400
        node.command(team.coordinator, wire.CommandCode.SET_LEG_LENGTH_MM, 888, 2, 4_000_000)
        count = len(stored)
        time_us = 4_000_000
        while len(stored) < count + 3:
            time_us += 1_000
            team.run(time_us)
        _, at = stored[-1]
        before = bytes(node.eeprom)
        node.restart(time_us, wire.ResetCause.POWER_ON)
        assert node.eeprom[at] == 0xFF
        changed = [k for k, byte in enumerate(before) if node.eeprom[k] not in (byte,)]
        assert [k for k in changed if k != 2] in ([at], [])  # 2: the count of starts


def motion_of(board, offset_us):
    with straight(board, 22.0, clock=NodeClockError(offset_us=offset_us)) as team:
        frames = Listener(team).until(22_000_000)
        return [f.values for f in frames if f.message is wire.MOTION]


def test_the_wrap_of_the_native_clock_changes_not_a_digit():
    assert motion_of("native", 2**32 - 15_000_000) == motion_of("native", 0)


@pytest.mark.parametrize("board", BOARDS[1:])
def test_the_wrap_of_a_boards_clock_loses_no_motion(board):
    wrapped, plain = motion_of(board, 2**32 - 15_000_000), motion_of(board, 0)
    assert len(wrapped) == len(plain)
    for ours, theirs in zip(wrapped, plain, strict=True):
        assert ours["time_s"] == pytest.approx(theirs["time_s"], abs=0.02)
        assert ours["path_m"] == pytest.approx(theirs["path_m"], abs=0.02)
        assert ours["heading_rad"] == pytest.approx(theirs["heading_rad"], abs=0.01)
    assert wrapped[-1]["path_m"] > 10.0


@pytest.mark.parametrize("board", BOARDS)
def test_times_follow_a_clock_that_changes_its_rate(board):
    with straight(board, 30.0) as team:
        listener = Listener(team)
        rates = []
        for drift_ppm in (0.0, 20_000.0):
            listener.node.engine.set_drift(team.clock.now_us, drift_ppm)
            reported = [
                (frame.values["time_s"], left_s)
                for frame, left_s in listener.timed(team.clock.now_us + 12_000_000)
                if frame.message is wire.MOTION
            ]
            rates.append((reported[-1][0] - reported[0][0]) / (reported[-1][1] - reported[0][1]))
        # A report leaves within 40 ms of its time.
        assert rates == pytest.approx([1.0, 1.02], abs=0.004)
        assert 0.0 < reported[0][0] - 12.0 < 1.1  # no jump in between
