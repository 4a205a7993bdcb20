"""Commands from the host to emulated nodes whose radio is not as it should be."""

from contextlib import contextmanager

from relpos.emulator.pty import PseudoTerminal
from relpos.emulator.team import EmulatedTeam
from relpos.link import xbee
from relpos.link.session import Session
from relpos.protocol import messages as wire


@contextmanager
def team_at_port(nodes=1, seed=1):
    """A team and the port behind which it is, at eight times real time."""
    with (
        EmulatedTeam("straight", nodes, 900.0, seed) as team,
        PseudoTerminal(team, speed=8.0) as terminal,
        terminal.open_port() as port,
    ):
        terminal.start()
        yield team, port


def test_a_node_whose_radio_has_another_address_is_reached():
    with team_at_port() as (team, port):
        wrong = xbee.AtCommand(0, b"MY", b"\x00\x77")
        team.nodes[1].radio.from_serial(0, xbee.encode(wrong))
        session = Session(port, 1, clock=port.virtual_time_s)
        assert session.demand(wire.CommandCode.SET_LEG_LENGTH_MM, 901) == 901
        assert session.setting(wire.CommandCode.SET_LEG_LENGTH_MM) == 901
