"""Commands from the host to emulated nodes whose radio is not as it should be."""

from contextlib import contextmanager
from dataclasses import replace

from relpos.emulator.pty import PseudoTerminal
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import xbee
from relpos.link.dialogue import NodeDialogue
from relpos.link.port import Link
from relpos.protocol import messages as wire
from relpos.simulation.team import SCENARIOS


@contextmanager
def team_at_port(nodes=1, seed=1, scenario="straight", key=wire.DEFAULT_KEY):
    """A team and the port behind which it is, at eight times real time."""
    with (
        EmulatedTeam(TeamConfig(scenario, nodes, 900.0, seed, key=key)) as team,
        PseudoTerminal(team, speed=8.0) as terminal,
        terminal.open_port() as port,
    ):
        terminal.start()
        yield team, port


def test_a_node_whose_radio_has_another_address_is_reached():
    with team_at_port() as (team, port):
        wrong = xbee.AtCommand(0, b"MY", b"\x00\x77")
        team.nodes[1].radio.from_serial(0, xbee.encode(wrong))
        dialogue = NodeDialogue(port, 1, clock=port.virtual_time_s)
        assert dialogue.demand(wire.CommandCode.SET_LEG_LENGTH_MM, 901) == 901
        assert dialogue.setting(wire.CommandCode.SET_LEG_LENGTH_MM) == 901


def test_commands_are_done_once_though_two_in_five_frames_are_lost():
    straight = SCENARIOS["straight"]
    lossy = replace(straight.world, radio=replace(straight.world.radio, loss_probability=0.4))
    old = bytes(range(1, 17))
    with team_at_port(seed=4, scenario=replace(straight, world=lossy), key=old) as (team, port):
        dialogue = NodeDialogue(port, 1, Link(key=old), clock=port.virtual_time_s)
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
