"""What a fault does to a team, measured from outside: at the coordinator's port, against truth.

A team walks with a fault and without it, in conditions so good (every exchange within reach
succeeds, no frame is lost) that what is missing is the fault's. Everything is read from frames that
the host accepts; nothing is asked of the firmware.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise

import numpy as np

from relpos.emulator.faults import FAULTS, Fault, FaultSpec, parse_fault
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link import xbee
from relpos.link.port import Link
from relpos.measurements import Heading, Motion, Observation, Range, Status
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.protocol.schema import Message
from relpos.simulation.team import SCENARIOS
from relpos.simulation.walker import WalkerTruth
from relpos.simulation.world import RadioChannel, UwbChannel

NODES = 3
NODE = 2
"""The node that faults of one node affect."""
TEAM_KEY = bytes(range(16))
SECONDS = 65.0
BEGIN_S = 25.0
END_S = 45.0
SEED = 1

GOOD_CONDITIONS = replace(
    SCENARIOS["paper"],
    spacing_m=3.0,
    world=replace(
        SCENARIOS["paper"].world,
        uwb=UwbChannel(max_range_m=30.0, detection_near=1.0, detection_far=1.0),
        radio=RadioChannel(loss_probability=0.0),
    ),
)
"""People close behind each other, all in reach of all."""

BAD_MOTION = wire.Quality.IMU_GAP | wire.Quality.FILTER_RESET


@dataclass
class Record:
    """What arrived at the host in a run, by arrival; ``end_s`` is when the run ended."""

    faults: tuple[str, ...]
    walkers: Mapping[int, WalkerTruth]
    power_on_s: Mapping[int, float]
    clock_rates: Mapping[int, float]
    frames: list[tuple[float, framing.Frame]] = field(default_factory=list)
    observations: list[tuple[float, Observation]] = field(default_factory=list)
    counts: dict[str, float] = field(default_factory=dict)
    dated: list[tuple[int, float, float]] = field(default_factory=list)
    """(node, its own time, the host's time) of every motion that was taken."""

    def of(self, message: Message, node: int) -> list[tuple[float, framing.Frame]]:
        """A node's frames of one kind that were taken, with their arrivals."""
        return [(t, f) for t, f in self.frames if f.node == node and f.message is message]

    def motions(self, node: int) -> list[tuple[float, Motion]]:
        """A node's motion as the host uses it."""
        return [(t, o) for t, o in self.observations if isinstance(o, Motion) and o.node == node]

    def ranges(self, node: int | None = None) -> list[tuple[float, Range]]:
        """Ranges that ``node`` began, or all."""
        return [
            (t, o) for t, o in self.observations if isinstance(o, Range) and node in (None, o.node)
        ]

    def headings(self, node: int) -> list[tuple[float, Heading]]:
        """A node's magnetic headings."""
        return [(t, o) for t, o in self.observations if isinstance(o, Heading) and o.node == node]

    def statuses(self, node: int, name: str) -> list[tuple[float, float]]:
        """One figure of a node's health over time."""
        return [
            (t, o.value)
            for t, o in self.observations
            if isinstance(o, Status) and o.node == node and o.name == name
        ]

    def grown(self, node: int, name: str) -> float:
        """How far a node's counter grew over the run, restarts included."""
        total, last = 0.0, 0.0
        for _, value in self.statuses(node, name):
            total += value - last if value >= last else value
            last = value
        return total

    def good_motions(self, node: int) -> list[float]:
        """Arrivals of reports of whole motion: neither a gap nor a start in them."""
        return [
            t
            for t, frame in self.of(wire.MOTION, node)
            if not frame.values["quality"] & BAD_MOTION
            and frame.values["state"] != wire.MotionState.STARTING
        ]

    def unwell(self, node: int, begin_s: float, end_s: float) -> wire.Health:
        """Union of a node's health flags of fault between the two times."""
        missing = wire.Health(0)
        for t, value in self.statuses(node, "health"):
            if begin_s <= t < end_s:
                missing |= ~wire.Health(int(value))
        return missing

    def flagged(self, node: int, quality: wire.Quality) -> int:
        """How many motion reports carry that flag."""
        return sum(bool(f.values["quality"] & quality) for _, f in self.of(wire.MOTION, node))

    def true_distance_m(self, one: int, other: int, time_s: float) -> float:
        """Between two tags at a time."""
        a, b = (self.walkers[n].position_at(time_s) for n in (one, other))
        return math.dist(a, b)

    def date_errors_s(self, node: int) -> list[float]:
        """The host's time of each motion less the true one, by the clock of a node's first boot."""
        return [
            time_s - self.power_on_s[node] - node_s / self.clock_rates[node]
            for number, node_s, time_s in self.dated
            if number == node
        ]

    def range_errors_m(self) -> list[float]:
        """Every range, of any node, minus the true distance at its time."""
        return [
            r.range_m - self.true_distance_m(r.node, r.peer, r.time_s)
            for _, r in self.ranges()
            if r.node in self.walkers and r.peer in self.walkers
        ]

    def path_length_m(self, node: int, begin_s: float, end_s: float) -> float:
        """True length of the path walked in between."""
        walker = self.walkers[node]
        inside = (walker.time_s >= begin_s) & (walker.time_s <= end_s)
        steps = np.diff(walker.position_m[inside, :2], axis=0)
        # The sensor sways some centimetres aside at every step: the way is that of its mean.
        width = 200
        if len(steps) < 2 * width:
            return float(np.hypot(*steps.sum(axis=0))) if len(steps) else 0.0
        kernel = np.ones(width) / width
        smooth = np.column_stack([np.convolve(steps[:, k], kernel, "same") for k in (0, 1)])
        return float(np.hypot(smooth[:, 0], smooth[:, 1]).sum())

    def sum_of_motions(self, node: int) -> tuple[float, float, float]:
        """Where the host believes the node to be after all its motions: x, y, heading."""
        x = y = heading = 0.0
        for _, m in self.motions(node):
            x += math.cos(heading) * m.dx_m - math.sin(heading) * m.dy_m
            y += math.sin(heading) * m.dx_m + math.cos(heading) * m.dy_m
            heading += m.dtheta_rad
        return x, y, heading

    def summing_error_m(self, node: int) -> float:
        """Distance between what the host has summed and the node's own total; one boot."""
        newest = max((f for _, f in self.of(wire.MOTION, node)), key=lambda f: f.counter)
        x, y, _ = self.sum_of_motions(node)
        return math.hypot(x - newest.values["x_m"], y - newest.values["y_m"])


class _Tap:
    """Frames that a link's decoder takes, by looking at what it has counted as received."""

    def __init__(self, key: bytes) -> None:
        self.link = Link(key=key)
        self._key = key
        self._parser = xbee.Parser()

    def feed(
        self, data: bytes, arrival_s: float
    ) -> Iterator[tuple[list[Observation], framing.Frame | None]]:
        for packet in self._parser.feed(data):
            taken = self._received()
            observations = self.link.feed(xbee.encode(packet), arrival_s)
            frame = None
            if self._received() > taken and isinstance(packet, xbee.Receive16 | xbee.Receive64):
                key = framing.node_key(self._key, packet.data[3])
                frame = framing.decode(packet.data, key)
            yield observations, frame

    def _received(self) -> int:
        return sum(track.counts["received"] for track in self.link.decoder.nodes.values())


def record(
    faults: Sequence[str | FaultSpec],
    *,
    seconds: float = SECONDS,
    nodes: int = NODES,
    board: str = "native",
) -> Record:
    """Let a team walk with those faults; the same arguments give the same record."""
    key = TEAM_KEY if any("key=stolen" in str(fault) for fault in faults) else wire.DEFAULT_KEY
    config = TeamConfig(
        GOOD_CONDITIONS, nodes, seconds, SEED, board, faults=faults, beacons=True, key=key
    )
    with EmulatedTeam(config) as team:
        tap = _Tap(team.key)
        errors = {number: node.errors for number, node in team.nodes.items()}
        kept = Record(
            tuple(str(f) for f in faults),
            team.walkers,
            {number: e.power_on_us * 1e-6 for number, e in errors.items()},
            {number: 1.0 + e.clock.drift_ppm * 1e-6 for number, e in errors.items()},
        )
        for time_us, data in team.stream():
            arrival_s = time_us * 1e-6
            for observations, frame in tap.feed(data, arrival_s):
                kept.observations += [(arrival_s, o) for o in observations]
                if frame is not None:
                    kept.frames.append((arrival_s, frame))
                    kept.dated += [
                        (o.node, frame.values["time_s"], o.time_s)
                        for o in observations
                        if isinstance(o, Motion)
                    ]
        kept.counts = tap.link.summary()
    return kept


@cache
def undisturbed() -> Record:
    """The same team without any fault."""
    return record(())


def example(fault: Fault, **values: str) -> str:
    """A SPEC of that fault for the node and the time of the comparison."""
    times = {"node": str(NODE), "from": f"{BEGIN_S:g}", "to": f"{END_S:g}"}
    if fault.target == "eeprom":
        times["from"] = "1.6"  # while the node is set up
    given = {k: v for k, v in times.items() if k in fault.key_names()} | values
    pairs = ",".join(f"{name}={value}" for name, value in given.items())
    return fault.name + (f":{pairs}" if pairs else "")


@dataclass(frozen=True)
class Outcome:
    """A fault's run beside the undisturbed one."""

    spec: str
    run: Record
    clean: Record
    begin_s: float
    end_s: float

    def _disturbed(self, name: str) -> bool:
        window = (self.begin_s, self.end_s + 2.0)
        ours, theirs = (_within(_arrivals(r, name), *window) for r in (self.run, self.clean))
        return len(ours) < 0.85 * len(theirs)

    @property
    def disturbed(self) -> list[str]:
        """What the host lacked meanwhile: motion, ranges, headings."""
        return [name for name in ("motion", "ranges", "headings") if self._disturbed(name)]

    @property
    def recovery_s(self) -> float | None:
        """From the fault's end to the first whole report of all that was disturbed; None: never."""
        latest = 0.0
        for name in self.disturbed:
            after = [t for t in _arrivals(self.run, name) if t >= self.end_s]
            if not after:
                return None
            latest = max(latest, after[0] - self.end_s)
        return latest

    @property
    def restarts(self) -> int:
        """Boots that the host saw begin."""
        return round(self.run.counts.get("restarts", 0.0))

    @property
    def lost_s(self) -> float:
        """Of a restart: from the last total that arrived to the new ones' beginning."""
        return sum((end - begin for begin, end in self._gaps()), 0.0)

    def _gaps(self) -> list[tuple[float, float]]:
        gaps = []
        frames = self.run.of(wire.MOTION, NODE)
        for (t0, f0), (t1, f1) in pairwise(frames):
            if f1.boot != f0.boot:
                gaps.append((t0, t1 - f1.values["time_s"]))
        return gaps

    @property
    def lost_m(self) -> float:
        """Motion that the host never got, in metres of path.

        Without restart: how much less path the node has reported by the end than undisturbed.
        With one: the true path from the last total that arrived to the first of the new ones.
        """
        gaps = self._gaps()
        if gaps:
            return sum(self.run.path_length_m(NODE, begin, end) for begin, end in gaps)
        ours = {round(f.values["time_s"], 1): f for _, f in self.run.of(wire.MOTION, NODE)}
        theirs = {round(f.values["time_s"], 1): f for _, f in self.clean.of(wire.MOTION, NODE)}
        common = max(ours.keys() & theirs.keys(), default=None)
        if common is None:
            return math.nan
        less: float = theirs[common].values["path_m"] - ours[common].values["path_m"]
        return less

    @property
    def worst_range_error_m(self) -> float:
        """Largest error of a range that the host got."""
        return max(map(abs, self.run.range_errors_m()), default=0.0)

    def seen(self) -> list[str]:
        """Signs of the fault: counters that grew, flags, restarts."""
        words = []
        for name in ("bus_errors", "missed_ticks", "ranging_failures", "radio_failures",
                     "bad_frames", "refused_frames"):  # fmt: skip
            more = self.run.grown(NODE, name) - self.clean.grown(NODE, name)
            if more > 0.5:
                words.append(f"{name} +{more:.0f}")
        window = (self.begin_s + 1.0, max(self.end_s, self.begin_s + 10.0))
        gone = self.run.unwell(NODE, *window) & ~self.clean.unwell(NODE, *window)
        words += [f"no {flag.name}" for flag in wire.Health if flag in gone]
        for flag in (
            wire.Quality.IMU_GAP,
            wire.Quality.FILTER_RESET,
            wire.Quality.MAGNETOMETER_DISTURBED,
            wire.Quality.SATURATED,
        ):
            count = self.run.flagged(NODE, flag) - self.clean.flagged(NODE, flag)
            if count > 0:
                words.append(f"{flag.name} in {count} reports")
        fewer = len(self.clean.headings(NODE)) - len(self.run.headings(NODE))
        if fewer > 2 and "motion" not in self.disturbed:
            words.append(f"{fewer} headings fewer")
        for name, value in sorted(self.run.counts.items()):
            if name in ("received", "frames"):
                continue
            more = value - self.clean.counts.get(name, 0.0)
            if more > 0.5:
                words.append(f"host: {name} {more:.0f}")
        return words


def _arrivals(run: Record, name: str) -> list[float]:
    if name == "motion":
        return run.good_motions(NODE)
    if name == "ranges":
        return [t for t, _ in run.ranges(NODE)]
    return [t for t, _ in run.headings(NODE)]


def _within(times: list[float], begin: float, end: float) -> list[float]:
    return times[bisect.bisect_left(times, begin) : bisect.bisect_left(times, end)]


def compare(spec: str) -> Outcome:
    """Run one SPEC beside the undisturbed team."""
    parsed = parse_fault(spec)
    begin_s = 0.0 if parsed.fault.whole_run else parsed.from_s
    end_s = SECONDS if math.isinf(parsed.to_s) else parsed.to_s
    if parsed.fault.momentary:
        end_s = begin_s
    return Outcome(spec, record((spec,)), undisturbed(), begin_s, end_s)


def specs() -> list[tuple[Fault, str]]:
    """One SPEC of every fault, and of those with kinds that differ one of each kind."""
    rows = []
    for fault in FAULTS:
        kinds = [key for key in fault.keys if key.choices]
        if not kinds:
            rows.append((fault, example(fault)))
        for key in kinds:
            rows += [(fault, example(fault, **{key.name: choice})) for choice in key.choices]
    return rows
