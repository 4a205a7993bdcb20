"""A recorded session once more: through the command line, from a port to the same estimates."""

import contextlib
import json
import os
import pty
import signal
import subprocess
import sys
import time
import tty

import pytest
from sessions import serial_bytes

from relpos.link.xbee import virtual_time
from relpos.protocol.messages import DEFAULT_KEY
from relpos.recording import open_recording
from relpos.recording.replay import Replay
from relpos.recording.topics import Serial
from relpos.sources import load
from support.command import relpos

PATIENCE_S = 200.0


def bytes_recorded(path):
    inputs = open_recording(path).inputs()
    return sum(len(entered.data) for _, entered in inputs if isinstance(entered, Serial))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A session of four nodes at a pseudo-terminal, as the user records it; where, and its output.

    The bytes come as fast as they are taken; frames of virtual time say when they arrived.
    """
    folder = tmp_path_factory.mktemp("replay")
    path, out = folder / "walk.mcap", folder / "live"
    stream = [virtual_time(round(s * 1e6)) + data for s, data in serial_bytes(4, 45.0, 4)]
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    command = ["fuse", os.ttyname(theirs), "--record", path, "--out", out, "--no-teach"]
    command += ["--seed", 3, "--initial", "common", "--set", "outliers=0.02"]
    fusing = subprocess.Popen(
        [sys.executable, "-m", "relpos.cli.main", *map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests run in the background SIGINT is ignored, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        until_s = time.monotonic() + PATIENCE_S
        while not path.exists():
            assert fusing.poll() is None, fusing.communicate()
            assert time.monotonic() < until_s
            time.sleep(0.05)
        os.set_blocking(ours, False)
        for data in stream:
            while data:
                with contextlib.suppress(BlockingIOError):
                    os.read(ours, 4096)  # The beacons: somebody has to take them.
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(ours, data) :]
        while bytes_recorded(path) < sum(map(len, stream)):
            assert time.monotonic() < until_s
            time.sleep(0.1)
        fusing.send_signal(signal.SIGINT)
        _, stderr = fusing.communicate(timeout=PATIENCE_S)
        assert fusing.returncode == 0, stderr
    finally:
        fusing.kill()
        os.close(ours)
        os.close(theirs)
    return path, out


def test_a_replay_gives_the_same_estimates_to_the_last_byte(recorded, tmp_path):
    path, live = recorded
    done = relpos("fuse", path, "--out", tmp_path, "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["seed"] == 3
    assert summary["estimates"] > 30
    assert summary["counters"]["received"] > 200
    tables = {file.name for file in tmp_path.glob("*.csv")}
    assert {file.name for file in live.glob("*.csv")} == tables | {"log.csv"}
    assert tables >= {"estimate.csv", "pairs.csv", "parameters.csv"}
    for name in tables:
        ours, theirs = ((place / name).read_text().splitlines() for place in (tmp_path, live))
        differ = [pair for pair in zip(ours, theirs, strict=False) if pair[0] != pair[1]]
        assert not differ, f"{name}: {len(differ)} lines differ, first {differ[0]}"
        assert len(ours) == len(theirs), name


def test_decoding_the_recorded_bytes_gives_the_recorded_measurements(recorded):
    """A team with a key of its own has the first without the key at hand."""
    recording = open_recording(recorded[0])
    decoded = Replay(recording, None).observations()
    assert decoded == Replay(recording, DEFAULT_KEY).observations()
    assert len(decoded) > 1000


def test_the_command_line_overrules_the_recorded_settings(recorded, tmp_path):
    path, _ = recorded
    done = relpos("fuse", path, "--estimator", "deadreckoning", "--seed", 9, "--out", tmp_path,
                  "--json")  # fmt: skip
    summary = json.loads(done.stdout)
    assert (summary["estimator"], summary["seed"]) == ("deadreckoning", 9)


def test_the_received_run_and_the_recording_are_the_same_run(recorded):
    path, live = recorded
    ours, theirs = load(path), load(live / "received")
    assert ours.measurements == theirs.measurements
    assert ours.statuses == theirs.statuses
    assert ours.steps == theirs.steps
