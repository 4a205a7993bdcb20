"""The flashed firmware on simulated boards, in a team: who it says it is, and what it reckons."""

import shutil

import pytest

from relpos.emulator.avr.elf import default_build_folder
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import xbee
from relpos.protocol import framing
from relpos.protocol import messages as wire

SECONDS = 20.0

pytestmark = pytest.mark.skipif(
    shutil.which("avr-gcc") is None, reason="the AVR toolchain is not installed"
)


def motions(board):
    parser = xbee.Parser()
    latest = {}
    with EmulatedTeam(TeamConfig("paper", 2, SECONDS, 4, board)) as team:
        for _, data in team.stream():
            for packet in parser.feed(data):
                if isinstance(packet, xbee.Receive16):
                    frame = framing.decode(packet.data)
                    if frame.message is wire.MOTION:
                        latest.setdefault(frame.node, []).append(dict(frame.values))
    return latest


def test_a_team_of_unos_reports_what_the_same_team_of_native_boards_does():
    if not (default_build_folder() / "uno" / "firmware.elf").exists():
        pytest.fail("no firmware for the uno: run `make firmware` first")
    native, uno = motions("native"), motions("uno")
    assert set(uno) == {1, 2}
    for node in uno:
        ours, theirs = native[node][-1], uno[node][-1]
        assert theirs["steps"] == pytest.approx(ours["steps"], abs=1)
        assert theirs["path_m"] == pytest.approx(ours["path_m"], abs=0.7)
        assert theirs["heading_rad"] == pytest.approx(ours["heading_rad"], abs=0.05)
    assert uno[1][-1]["path_m"] > 5.0
