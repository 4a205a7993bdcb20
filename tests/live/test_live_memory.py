"""A long session needs no more memory than a short one."""

import gc
import itertools
import json
import math
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from team_input import run_through

from relpos import fusion
from relpos.live.composer import Composer
from relpos.live.files import FileSink
from relpos.live.fusion_thread import FusionThread
from relpos.live.inputs import PacedInput, Received
from relpos.live.session import LiveSession
from relpos.live.sinks import Sink
from relpos.live.tracks import MAX_POINTS, Tracks
from relpos.measurements import Motion, Prior, Range, Status
from relpos.runs import Description

NODES = 6
BENCH = Path(__file__).parents[2] / "bench"


def team(seconds):
    """What six nodes report, walking in circles."""
    for t in range(1, seconds):
        for node in range(1, NODES + 1):
            at_s = t + 0.01 * node
            yield Motion(at_s, node, 1.0, 0.0, 0.1, 0.1, 0.1, 0.02, 0, True, 0.1)
            yield Range(at_s, node, node % NODES + 1, 3.0 + math.sin(t))
            if t % 10 == 0:
                yield Status(at_s, node, "battery_v", 4.8)


class Scale(Sink):
    """Weighs everything that Python holds, in the middle and at the end."""

    def __init__(self, *at_s):
        self._at_s = list(at_s)
        self.bytes = []

    def updated(self, view):
        if self._at_s and view.time_s >= self._at_s[0]:
            self._at_s.pop(0)
            gc.collect()
            self.bytes.append(tracemalloc.get_traced_memory()[0])


@pytest.mark.soak
def test_twice_the_session_is_not_more_memory(tmp_path, monkeypatch):
    # What waits a second for the disk is more here, where a second holds minutes.
    monkeypatch.setattr("relpos.runs.appending.WRITE_EVERY_S", 0.0)
    scale = Scale(400.0, 800.0)
    items = (Received(o.time_s, b"", (o,)) for o in team(810))
    source = PacedInput("synthetic", items, speed=0.0)
    priors = [Prior(node, float(node), 0.0, 0.0) for node in range(1, NODES + 1)]
    fusing = FusionThread(lambda p: fusion.make("deadreckoning", p), priors)
    files = FileSink(tmp_path, Description())
    # What the fusion is behind waits in memory, by design: here it is waited for.
    original = source.read

    def read(timeout_s):
        while source.now_s() - max(fusing.newest_s, 0.0) > 5.0 and fusing.failure is None:
            fusing.join(0.001)
        return original(timeout_s)

    source.read = read
    tracemalloc.start()
    try:
        outcome = run_through(LiveSession(source, fusing, Composer(), [files, scale]))
    finally:
        tracemalloc.stop()
    assert outcome.failure is None
    assert outcome.estimates > 700
    half, whole = scale.bytes
    # Keeping what came in between, of its observations alone, would be a megabyte.
    assert whole < 1.05 * half + 100_000, f"{half} bytes after half the session, {whole} at its end"


def test_tracks_of_hours_stay_small_and_evenly_spaced():
    tracks = Tracks()
    for k in range(40_000):
        tracks.add(1, 0.5 * k, 0.01 * k, 1.0)
    points = tracks.of(1)
    assert len(points) <= MAX_POINTS
    assert points[0][0] == 0.0
    assert points[-1][0] > 19_900.0
    gaps = [b[0] - a[0] for a, b in itertools.pairwise(points)]
    assert max(gaps) <= 2.0 * min(gaps)
    again = Tracks.from_message(json.loads(tracks.to_json()))
    assert again.of(1) == points
    assert not again.add(1, points[-1][0] + 0.5 * min(gaps), 0.0, 0.0), "as coarse as before"


@pytest.mark.soak
def test_two_hours_of_twenty_nodes_leave_memory_and_delay_as_they_were(tmp_path):
    process = subprocess.run(
        [sys.executable, str(BENCH / "live_soak.py"), "--hours", "2", "--nodes", "20",
         "--speed", "3", "--look-s", "20", "--out", str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    print(process.stdout[-2000:])
    assert process.returncode == 0, process.stdout[-2000:] + process.stderr[-2000:]
