"""The node measures its own supply and reports it in its status, on every board."""

import pytest

from relpos.emulator.avr.library import missing_parts
from relpos.emulator.node import BoardKind
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link.port import Link
from relpos.measurements import Status

NEEDS = missing_parts()
BOARDS = [
    pytest.param(
        board,
        marks=[
            pytest.mark.skipif(
                board is not BoardKind.NATIVE and NEEDS is not None, reason=str(NEEDS)
            ),
            *([pytest.mark.soak] if board is BoardKind.MEGA else []),
        ],
    )
    for board in BoardKind
]


def reported_v(team, link, until_us):
    """The newest voltage that node 1 reports until then."""
    voltage_v = None
    for time_us, data in team.run(until_us):
        for observation in link.feed(data, time_us * 1e-6):
            if isinstance(observation, Status) and observation.name == "battery_v":
                voltage_v = observation.value
    return voltage_v


@pytest.mark.parametrize("board", BOARDS)
def test_a_sagging_supply_is_reported_by_the_status(board):
    with EmulatedTeam(TeamConfig("straight", 1, 40.0, seed=1, board=board)) as team:
        link = Link()
        # One count of the 10-bit converter is 22 mV at 5 V, 16 mV at 4.3 V.
        assert reported_v(team, link, 5_000_000) == pytest.approx(5.0, abs=0.03)
        team.nodes[1].engine.set_supply(4300)
        # A status reports the measurement that the previous one started.
        assert reported_v(team, link, 36_000_000) == pytest.approx(4.3, abs=0.03)
