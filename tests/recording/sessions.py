"""A small emulated session, and its playback to a sink: for the tests of recordings."""

import errno
import os
from dataclasses import fields, is_dataclass
from functools import cache
from math import isclose

from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.fusion import make
from relpos.link.port import Link
from relpos.measurements import Measurement
from relpos.recording.about import About
from relpos.recording.output import Disk

START_NS = 1_790_000_000_123_456_789


@cache
def serial_bytes(nodes=3, seconds=40.0, seed=2, key=None):
    """What leaves the coordinator's port of an emulated team: (virtual seconds, bytes)."""
    with EmulatedTeam(
        TeamConfig("paper", nodes, seconds, seed, beacons=True, **({"key": key} if key else {}))
    ) as team:
        return tuple((time_us * 1e-6, data) for time_us, data in team.stream())


@cache
def session(nodes=3, seconds=40.0, seed=2):
    """(arrival, bytes, observations, estimates) in the order of a session; starts are unknown."""
    link, estimator = Link(), make("bank")
    steps = []
    for arrival_s, data in serial_bytes(nodes, seconds, seed):
        observations = link.feed(data, arrival_s)
        estimates = [
            estimate
            for o in observations
            if isinstance(o, Measurement)
            for estimate in estimator.process(o)
        ]
        steps.append((arrival_s, data, tuple(observations), tuple(estimates)))
    return tuple(steps)


def about(**changes):
    return About(START_NS, source="/dev/ttyUSB0", **changes)


def play(sink, steps):
    """Play a session to a sink."""
    for arrival_s, data, observations, estimates in steps:
        sink.received(arrival_s, data)
        sink.observed(arrival_s, observations)
        for estimate in estimates:
            sink.estimated(estimate)


class PulledOut(Disk):
    """A disk that fails once: its ``failing``-th confirmation."""

    def __init__(self, failing):
        self.failing = failing
        self.calls = 0

    def sync(self, file):
        self.calls += 1
        if self.calls == self.failing:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


def alike(ours, theirs):
    """Whether two estimates are the same but for the digits that a recording leaves out."""
    if isinstance(ours, float):
        return isclose(ours, theirs, rel_tol=1e-8, abs_tol=1e-12) or ours == theirs
    if isinstance(ours, list | tuple):
        return len(ours) == len(theirs) and all(map(alike, ours, theirs))
    if is_dataclass(ours):
        return all(alike(getattr(ours, f.name), getattr(theirs, f.name)) for f in fields(ours))
    return ours == theirs
