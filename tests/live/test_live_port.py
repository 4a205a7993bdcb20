"""A session at a real serial line: a pseudo-terminal that is pulled out and put back."""

import itertools
import os
import pty
import select
import tty
from pathlib import Path

import pytest
from team_input import make_session

from relpos import fusion
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DeviceError
from relpos.fusion.estimator import Estimate, Parameter
from relpos.link import xbee
from relpos.link.port import Link
from relpos.live import inputs
from relpos.live.inputs import PortInput
from relpos.measurements import Motion
from relpos.protocol import framing
from relpos.protocol import messages as wire
from support.command import relpos
from support.waiting import until


class Socket:
    """Where the coordinator is plugged in: a name that leads to a terminal, or to none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._ours = self._theirs = -1

    def plug(self) -> None:
        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        self.path.symlink_to(os.ttyname(self._theirs))

    def pull(self) -> None:
        self.path.unlink()
        self.end()

    def end(self) -> None:
        """As a program that is killed: the name stays."""
        os.close(self._ours)
        os.close(self._theirs)

    def write(self, data: bytes) -> None:
        os.write(self._ours, data)

    def frames(self, count: int) -> list[xbee.ApiFrame]:
        parser, found = xbee.Parser(), []
        while len(found) < count and select.select([self._ours], [], [], 5.0)[0]:
            found += parser.feed(os.read(self._ours, 4096))
        return found


@pytest.fixture
def socket(tmp_path):
    socket = Socket(tmp_path / "ttyUSB0")
    socket.plug()
    yield socket
    if socket.path.exists():
        socket.pull()


@pytest.fixture(scope="module")
def stream():
    """Eight seconds of two nodes, each piece marked with its virtual time."""
    with EmulatedTeam(TeamConfig("straight", 2, 20.0, 3, beacons=True)) as team:
        marks = [xbee.virtual_time(time_us) + data for time_us, data in team.stream()]
        yield marks, team.priors()


def deadreckoning(priors):
    return fusion.make("deadreckoning", priors)


def motions_of(pieces):
    link = Link()
    return [o for p in pieces for o in link.feed(p, 0.0) if isinstance(o, Motion)]


def test_a_port_that_is_pulled_out_is_reported_and_read_again_once_it_is_back(socket, stream):
    pieces, priors = stream
    half = len(pieces) // 2
    source = PortInput(str(socket.path), Link(), teach=False, reopen=True)
    session, album = make_session(source, deadreckoning, priors=priors, lasts=True)
    socket.write(b"".join(pieces[:half]))
    wanted = len(motions_of(pieces)) - 2
    first = len(motions_of(pieces[:half]))

    def motions():
        return sum(isinstance(o, Motion) for _, o in album.observations)

    def port_notices():
        return [n for n in album.views[-1].notices if n.id == "port"] if album.views else []

    stages = iter(("read", "gone", "back"))
    stage = next(stages)
    looks = itertools.count()
    original = source.read

    def read(timeout_s):
        """Let things happen while the session looks."""
        nonlocal stage
        assert next(looks) < 20_000
        received = original(timeout_s)
        if stage == "read" and motions() >= first:
            socket.pull()
            stage = next(stages)
        elif stage == "gone" and port_notices():
            assert port_notices()[0].level == "alarm"
            assert "vanished" in port_notices()[0].text or "cannot open" in port_notices()[0].text
            socket.plug()
            stage = next(stages)
        elif stage == "back" and source.trouble() is None and motions() == first:
            socket.write(b"".join(pieces[half:]))
            stage = "written"
        elif stage == "written" and motions() >= wanted and not port_notices():
            session.stop()
        return received

    source.read = read
    for _ in session.run():
        pass
    outcome = session.finish()
    assert outcome.failure is None
    assert motions() >= wanted
    assert not port_notices()


@pytest.mark.parametrize("by_link", [True, False])
def test_the_next_terminal_with_the_same_number_is_not_taken_for_the_port(
    socket, by_link, monkeypatch
):
    monkeypatch.setattr(inputs, "REOPEN_S", 0.0)
    terminal = socket.path.readlink()
    name = str(socket.path if by_link else terminal)
    source = PortInput(name, Link(), teach=False, reopen=True)
    socket.end()
    source.read(0.0)
    kept = []
    while not terminal.exists():  # the lowest free number: ours, or that of a test beside this one
        kept += pty.openpty()
    source.read(0.0)
    assert "does not come back" in source.trouble()
    socket.path.unlink()
    socket.plug()
    source.read(0.0)
    assert (source.trouble() is None) == by_link, "a new link leads to the successor"
    source.close()
    for end in kept:
        os.close(end)


def test_a_port_that_is_not_to_be_opened_again_ends_the_session(socket, stream):
    pieces, priors = stream
    source = PortInput(str(socket.path), Link(), teach=False)
    session, album = make_session(source, deadreckoning, priors=priors)
    socket.write(b"".join(pieces))
    for k, _ in enumerate(session.run()):
        if k == 20:
            socket.pull()
    outcome = session.finish()
    assert isinstance(outcome.failure, DeviceError)
    assert "vanished" in str(outcome.failure)
    assert outcome.received > 20
    assert album.closed


def test_a_missing_port_is_reported_before_anything_begins(tmp_path):
    with pytest.raises(DeviceError, match="no such device"):
        PortInput(str(tmp_path / "ttyUSB9"), Link(), reopen=True)


def test_a_port_by_its_url_is_read_like_a_device(stream):
    pieces, _ = stream
    # Its queue holds 4096 bytes.
    some = pieces[: len(pieces) // 8]
    assert sum(map(len, some)) < 4000
    source = PortInput("loop://", Link(), teach=False)
    source._device.write(b"".join(some))
    got = []
    for _ in range(200):
        received = source.read(0.01)
        got += [] if received is None else received.observations
        if not source._device.in_waiting:
            break
    assert sum(isinstance(o, Motion) for o in got) == len(motions_of(some)) > 0
    assert source.trouble() is None
    assert source.read(0.01) is None, "silence is no fault"
    source.close()


def test_bytes_that_arrive_together_are_received_together(socket, stream):
    pieces, _ = stream
    source = PortInput(str(socket.path), Link(), teach=False)
    socket.write(b"".join(pieces[:5]))
    received = source.read(1.0)
    source.close()
    assert received.data == b"".join(pieces[:5]), "not a byte first, and the rest later"


def test_orders_and_learned_steps_go_out_of_the_port_and_answers_come_back(socket):
    source = PortInput(str(socket.path), Link())
    source.call_out([1])
    source.learn(Estimate(0.0, (), (), (), (Parameter(0.0, 1, None, "step_scale", 1.1, 0.01),)))
    source.read(0.0)
    sent = [framing.decode(frame.data, wire.DEFAULT_KEY).values for frame in socket.frames(2)]
    codes = [wire.CommandCode.SET_LED, wire.CommandCode.SET_STEP_GAIN_PERMILLE]
    assert [command["command"] for command in sent] == codes
    values = {**sent[0], "result": wire.CommandResult.DONE}
    answer = framing.encode(wire.ACKNOWLEDGEMENT, 1, 0, 0, values)
    socket.write(xbee.encode(xbee.Receive16(1, -40, answer)))
    until(lambda: source.read(0.1) and source.link.decoder.acknowledged, "the answer")
    source.read(0.0)
    assert (source.called_out(), source.called_out()) == ([1], [])
    source.close()


def test_a_setting_that_does_not_fit_is_reported_before_the_port_is_opened(socket):
    result = relpos("fuse", socket.path, "--view", "--no-open", "--set", "bogus=1")
    assert result.exit_code == 1
    assert "no setting 'bogus'" in result.stderr
    assert "page" not in result.stderr
