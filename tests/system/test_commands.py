"""Commands from the host to emulated nodes whose radio is not as it should be."""

from contextlib import contextmanager
from dataclasses import replace

import pytest

from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import dialogue as dialogues
from relpos.link import xbee
from relpos.link.dialogue import NodeDialogue
from relpos.link.port import Link
from relpos.protocol import messages as wire
from relpos.simulation.team import SCENARIOS
from support.emulated_line import EmulatedLine

START_UNIX_S = 1_800_000_000.0


@contextmanager
def dialogue_in_its_own_time(monkeypatch, seed=1, scenario="straight", key=wire.DEFAULT_KEY):
    """A team and a dialogue with its node: the same frames are lost on every machine."""
    with EmulatedTeam(TeamConfig(scenario, 1, 120.0, seed, key=key)) as team:
        line = EmulatedLine(team)
        line.clock_of(monkeypatch, dialogues)

        def clock():
            return START_UNIX_S + team.time_us * 1e-6

        yield team, NodeDialogue(line, 1, Link(key=key, clock=clock), clock=clock)


def test_a_node_whose_radio_has_another_address_is_reached(monkeypatch):
    with dialogue_in_its_own_time(monkeypatch) as (team, dialogue):
        wrong = xbee.AtCommand(0, b"MY", b"\x00\x77")
        team.nodes[1].radio.from_serial(0, xbee.encode(wrong))
        assert dialogue.demand(wire.CommandCode.SET_LEG_LENGTH_MM, 901) == 901
        assert dialogue.setting(wire.CommandCode.SET_LEG_LENGTH_MM) == 901


# In each, an answer is lost whose command would do harm if it were done again.
@pytest.mark.parametrize("seed", [1, 4, 6])
def test_commands_are_done_once_though_two_in_five_frames_are_lost(monkeypatch, seed):
    straight = SCENARIOS["straight"]
    lossy = replace(straight.world, radio=replace(straight.world.radio, loss_probability=0.4))
    scenario, old = replace(straight, world=lossy), bytes(range(1, 17))
    with dialogue_in_its_own_time(monkeypatch, seed, scenario, old) as (team, dialogue):
        before = gain_version(dialogue)
        for gain in (1900, 2000, 2100):
            assert dialogue.demand(wire.CommandCode.SET_STEP_GAIN_PERMILLE, gain) == gain
        assert (gain_version(dialogue) - before) % 256 == 3
        boot = dialogue.boot()
        dialogue.restart()
        assert dialogue.boot() == (boot + 1) % 256
        assert team.nodes[1].engine.resets == 1
        key = bytes(range(16))
        assert dialogue.set_key(key)
        assert dialogue.setting(wire.CommandCode.SET_STEP_GAIN_PERMILLE) == 2100
        assert not dialogue.set_key(key)
        # Another number has another key: it is given first, then the number.
        dialogue.set_node_id(9)
        assert dialogue.setting(wire.CommandCode.SET_STEP_GAIN_PERMILLE) == 2100
    assert team.radio.counts["lost"] > 5


def gain_version(dialogue):
    """Of a report that comes from now on."""
    newest = dialogue.totals()
    while dialogue.totals() in (None, newest):
        dialogue.listen()
    return dialogue.totals()["gain_version"]
