"""Frames of all nodes to observations: running totals to motion, node clocks to host time.

Sans I/O: bytes and their arrival times go in, observations come out. A frame is verified completely
(magic, version, length, CRC, tag, layout, ranges, counter) before anything is changed by it.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from relpos.link.authentication import CounterWindow, Verdict
from relpos.link.clock import NodeClock
from relpos.measurements import (
    Heading,
    Height,
    Motion,
    Observation,
    Range,
    RawSample,
    Status,
    Step,
    out_of_bounds,
)
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.said import Said

MAGNETIC_SIGMA_RAD = math.radians(25.0)
"""Indoor magnetic heading, one sample (the dead-reckoning filter weighs it alike)."""
UNSEEN_SPEED_M_S = 1.5
UNSEEN_TURN_RAD_S_SQRT = 0.5
"""Possible motion of a wearer while the node restarts: brisk walking (Bohannon 1997: 1.3 to
1.5 m/s), and turning as a random walk that loses the heading after some ten seconds."""
UNSEEN_S = 600.0
"""After a longer silence nobody is further away and still in reach of the radio."""
MAX_KEPT = 10_000
"""Answers and raw samples stored until they are fetched: half an hour of one node's samples."""
FOREIGN_BEFORE_REMARK = 5
"""Frames under another key before a remark; one or two may be damage."""
REPLAYS_BEFORE_CHALLENGE = 5
"""One or two such frames may be an echo; more may mean that the node has lost its counter."""
CHALLENGE_S = 5.0
"""Between two challenges of one node, which answers within a second."""


DOWN = (wire.COMMAND, wire.BEACON, wire.NEW_KEY)
"""Messages that only a host sends."""


@dataclass
class NodeTrack:
    """State of one node between two frames."""

    boot: int
    clock: NodeClock = field(default_factory=NodeClock)
    window: CounterWindow = field(default_factory=CounterWindow)
    totals: Mapping[str, Any] | None = None
    motion_s: float | None = None
    arrival_s: float = 0.0
    rssi_dbm: int | None = None
    without_beacon_s: float | None = None
    """When its newest status arrived, if that says that it takes no beacon."""
    unseen_s: float = 0.0
    height_m: float = 0.0
    """Newest height over the node's first; a restarted node begins at 0 again."""
    restart_height_m: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """A node's answer to a command."""

    node: int
    token: int
    command: int
    result: wire.CommandResult
    value: int


@dataclass(frozen=True, slots=True)
class Challenge:
    """Token and value of a PING that only a node can answer that holds the key now."""

    node: int
    token: int
    value: int


class Decoder:
    """Frames in, observations out; one instance for the whole team.

    A node whose counters do not fit has to answer a PING, which ``challenges`` asks the host to
    send: the answer sets the counter.

    ``remarks`` collects messages for the user, once each, such as nodes of another version.
    ``acknowledged`` and ``raw_samples`` hold the newest answers and raw samples.
    ``counts`` holds every rejected frame by its reason, ``nodes`` each node's own counts:
    ``received``, ``lost``, ``duplicate``, ``replayed``, ``late_motion``, ``restarts``.

    ``keys`` are teams' keys: a frame is accepted whose tag fits its node's key under one of them
    (two while a node's key changes), or one of ``extra_keys`` of that node.
    ``newest_counters``: of each node, from an earlier session; frames up to it are rejected.
    ``range_offsets_m`` holds each node's range offset from its status; ranges come out with both
    ends' offsets subtracted.
    """

    def __init__(
        self,
        keys: Sequence[bytes] = (wire.DEFAULT_KEY,),
        newest_counters: Mapping[int, int] | None = None,
    ) -> None:
        self.keys = tuple(keys)
        self.extra_keys: dict[int, tuple[bytes, ...]] = {}
        self.refused_counters: dict[int, int] = {}
        """Newest counters that nodes took, where they refused a later command's."""
        self._forged: Counter[int] = Counter()
        self.range_offsets_m: dict[int, float] = {}
        self._newest_counters = dict(newest_counters or {})
        self._misfits: Counter[int] = Counter()
        self._challenged: dict[int, tuple[float, Challenge | None]] = {}
        """When each node was challenged last, and what it has not answered yet."""
        self.challenges: deque[Challenge] = deque(maxlen=MAX_KEPT)
        self.brought_back: set[int] = set()
        """Nodes whose counters an answer has set, maybe below earlier ones."""
        self.nodes: dict[int, NodeTrack] = {}
        self.counts: Counter[str] = Counter()
        self.foreign_versions: dict[int, int] = {}
        self.remarks: list[str] = []
        self.acknowledged: deque[Acknowledged] = deque(maxlen=MAX_KEPT)
        self.raw_samples: deque[RawSample] = deque(maxlen=MAX_KEPT)

    def feed(self, data: bytes, arrival_s: float, rssi_dbm: int | None = None) -> list[Observation]:
        """Return the observations of one frame that arrived at ``arrival_s`` of the host clock."""
        try:
            frame = self._open(data)
        except framing.ForeignVersionError as error:
            self.counts["ForeignVersionError"] += 1
            if error.node is not None and error.node not in self.foreign_versions:
                self.foreign_versions[error.node] = error.version
                self.remarks.append(
                    Said(
                        "version",
                        "node {node} speaks protocol version {version}, this host speaks {own}: "
                        "flash the firmware that belongs to this version",
                        node=str(error.node),
                        version=error.version,
                        own=wire.PROTOCOL_VERSION,
                    )
                )
            return []
        except framing.FrameError as error:
            self.counts[type(error).__name__] += 1
            if isinstance(error, framing.FrameTagError):
                self._note_forged(data[3])
            return []
        if frame.node in (wire.COORDINATOR, wire.BROADCAST) or frame.message in DOWN:
            self.counts["not_from_a_node"] += 1
            return []
        track = self._track(frame, arrival_s)
        if track is None:
            return []
        observations: list[Observation] = []
        if rssi_dbm is not None:
            track.rssi_dbm = rssi_dbm
        track.arrival_s = arrival_s
        values = frame.values
        if frame.message is wire.ACKNOWLEDGEMENT:
            if values["result"] == wire.CommandResult.COUNTER_REFUSED:
                self.refused_counters[frame.node] = values["value"] % (1 << 32)
            self.acknowledged.append(
                Acknowledged(
                    frame.node,
                    values["token"],
                    values["command"],
                    wire.CommandResult(values["result"]),
                    values["value"],
                )
            )
            return observations
        track.clock.observe(values["time_s"], arrival_s)
        if frame.message is wire.MOTION:
            observations += self._motion(frame.node, track, values)
        elif frame.message is wire.RANGES:
            observations += self._ranges(frame.node, track, values)
        elif frame.message is wire.STATUS:
            time_s = track.clock.to_host_s(values["time_s"])
            self.range_offsets_m[frame.node] = values["range_offset_m"]
            track.without_beacon_s = None if values["health"] & wire.Health.BEACON else arrival_s
            observations += [
                Status(time_s, frame.node, name, float(value))
                for name, value in values.items()
                if name != "time_s"
            ]
            observations += self._link_status(frame.node, track, time_s)
        elif frame.message is wire.SAMPLES:
            self.raw_samples.append(self._raw(frame.node, track, values))
        elif frame.message is wire.STEPS:
            observations += [
                Step(
                    track.clock.to_host_s(values["time_s"] - entry["age_s"]),
                    frame.node,
                    entry["length_m"],
                )
                for entry in values["steps"]
            ]
        # What no reader of files takes would make the whole recording unreadable. A session that
        # lasts for more than a week keeps its alarms.
        good = [o for o in observations if out_of_bounds(o) in (None, "time_s")]
        if len(good) < len(observations):
            track.counts["beyond_bounds"] += len(observations) - len(good)
        return good

    def _raw(self, node: int, track: NodeTrack, values: Mapping[str, Any]) -> RawSample:
        count = values["samples"]

        def vector(name: str, unit: str, factor: float) -> tuple[float, float, float]:
            x, y, z = (values[f"{name}_{axis}_{unit}"] * factor for axis in "xyz")
            return x, y, z

        return RawSample(
            track.clock.to_host_s(values["time_s"]),
            node,
            count,
            vector("acceleration", "m_s2", 1.0 / count) if count else None,
            vector("angular_rate", "rad_s", 1.0 / count) if count else None,
            vector("field", "ut", 1.0) if values["field_readings"] else None,
            values["field_readings"],
        )

    def _open(self, data: bytes) -> framing.Frame:
        node = data[3] if len(data) > 3 else wire.BROADCAST
        keys = [framing.node_key(key, node) for key in self.keys] + [*self.extra_keys.get(node, ())]
        for key in keys[:-1]:
            try:
                return framing.decode(data, key)
            except framing.FrameTagError:
                continue
        return framing.decode(data, keys[-1])

    def _note_forged(self, node: int) -> None:
        """Count a frame in a node's name under another key; remark on several."""
        heard = node in self.nodes
        self._forged[node if heard else wire.BROADCAST] += 1
        if self._forged[node if heard else wire.BROADCAST] != FOREIGN_BEFORE_REMARK:
            return
        self.remarks.append(
            Said(
                "forged",
                "node {node}: frames in its name under another key are rejected: somebody else "
                "sends them, such as a stolen node",
                node=str(node),
            )
            if heard
            else Said(
                "other-key",
                "frames under another key are rejected: give the team's key with --key-file, "
                "or they are another team's",
            )
        )

    def _ranges(self, node: int, track: NodeTrack, values: Mapping[str, Any]) -> list[Observation]:
        """Return ranges with both ends' offsets, from their antenna delays, subtracted."""
        ranges: list[Observation] = []
        for entry in values["ranges"]:
            if entry["peer"] == node:
                track.counts["ranges_to_itself"] += 1
                continue
            offset_m = sum(self.range_offsets_m.get(end, 0.0) for end in (node, entry["peer"]))
            range_m = entry["range_m"] - offset_m
            if range_m <= 0.0:
                track.counts["range_below_its_offset"] += 1
                continue
            time_s = track.clock.to_host_s(values["time_s"] - entry["age_s"])
            ranges.append(Range(time_s, node, entry["peer"], range_m, float(entry["rss_dbm"])))
        return ranges

    def expect_from_start(self) -> None:
        """Forget earlier sessions' counters: what is read next is of before they were stored."""
        self._newest_counters.clear()

    def expect_after(self, counters: Mapping[int, int]) -> None:
        """Reject frames up to these counters from now on, as from an earlier session."""
        for node, newest in counters.items():
            track = self.nodes.get(node)
            if track is None:
                self._newest_counters[node] = newest
            elif track.window.newest < newest:
                track.window = CounterWindow.after(newest)

    def _track(self, frame: framing.Frame, arrival_s: float) -> NodeTrack | None:
        """Return the node's track and store the counter if the frame is new; else None."""
        track = self.nodes.get(frame.node)
        if track is None:
            track = NodeTrack(frame.boot)
            if frame.node in self._newest_counters:
                track.window = CounterWindow.after(self._newest_counters[frame.node])
        window = track.window
        verdict = window.check(frame.counter)
        if verdict in (Verdict.DUPLICATE, Verdict.REPLAYED, Verdict.JUMPED):
            if not self._answers_challenge(frame):
                self._reject(frame, track, verdict, arrival_s)
                return None
            self.brought_back.add(frame.node)
            self.remarks.append(
                Said(
                    "counter-back",
                    "node {node}: its frame counter had changed; it has answered and is heard "
                    "again. If its memory was erased, give the team a new key: old frames fit "
                    "again",
                    node=str(frame.node),
                )
            )
            # What came under the other counter may have been forged: begin anew, as at a restart.
            window, verdict = CounterWindow.after(frame.counter - 1), Verdict.NEW
            track = self._restarted(track, frame, window, arrival_s)
        if frame.boot != track.boot and verdict is Verdict.LATE:
            track.counts["stale_boot"] += 1
            return None
        if frame.boot != track.boot:
            track = self._restarted(track, frame, window, arrival_s)
            track.counts["restarts"] += 1
        elif verdict is Verdict.LATE:
            track.counts["lost"] -= 1
            track.counts["reordered"] += 1
        elif frame.node in self.nodes:
            track.counts["lost"] += frame.counter - window.newest - 1
        self.nodes[frame.node] = track
        window.add(frame.counter)
        self._misfits[frame.node] = 0
        track.counts["received"] += 1
        return track

    @staticmethod
    def _restarted(
        track: NodeTrack, frame: framing.Frame, window: CounterWindow, arrival_s: float
    ) -> NodeTrack:
        """Return a track whose totals, clock and height begin anew; counts and pose go on.

        The height goes on from the last one: the wearer does not fly while the node restarts.
        """
        silence_s = min(arrival_s - track.arrival_s, UNSEEN_S)
        return NodeTrack(
            frame.boot,
            window=window,
            counts=track.counts,
            motion_s=track.motion_s,
            unseen_s=silence_s if track.totals is not None else 0.0,
            height_m=track.height_m,
            restart_height_m=track.height_m,
        )

    def _reject(
        self, frame: framing.Frame, track: NodeTrack, verdict: Verdict, arrival_s: float
    ) -> None:
        node = frame.node
        track.counts[verdict.value] += 1
        # For a node not heard since the start, a "duplicate" is from an earlier session.
        if verdict is Verdict.DUPLICATE and node in self.nodes:
            return
        self._misfits[node] += 1
        challenged_s, _ = self._challenged.get(node, (-math.inf, None))
        if self._misfits[node] < REPLAYS_BEFORE_CHALLENGE or arrival_s - challenged_s < CHALLENGE_S:
            return
        if node not in self._challenged:
            self.remarks.append(
                Said(
                    "counter-off",
                    "node {node}: frame counters that do not follow its last: old frames are sent "
                    "again, or its memory was erased; asked it for an answer, which brings it back",
                    node=str(node),
                )
            )
        # Keyed, and of a time that nobody can set: an old answer fits no new challenge. A replay
        # of the session makes the same one.
        said = struct.pack("<BId", node, frame.counter, arrival_s)
        digest = hashlib.blake2b(said, key=self.keys[0], digest_size=6).digest()
        challenge = Challenge(node, *struct.unpack("<Hi", digest))
        self._challenged[node] = arrival_s, challenge
        self.challenges.append(challenge)

    def _answers_challenge(self, frame: framing.Frame) -> bool:
        """Return whether a frame is a node's answer to its challenge, which then is over."""
        asked_s, challenge = self._challenged.get(frame.node, (0.0, None))
        if challenge is None or frame.message is not wire.ACKNOWLEDGEMENT:
            return False
        values = frame.values
        answer = Challenge(frame.node, values["token"], values["value"])
        if values["command"] != wire.CommandCode.PING or answer != challenge:
            return False
        self._challenged[frame.node] = asked_s, None
        return True

    def _motion(self, node: int, track: NodeTrack, values: Mapping[str, Any]) -> list[Observation]:
        fields = wire.MOTION.field
        older = track.totals or dict.fromkeys(fields, 0)

        def total(name: str) -> float:
            return fields[name].difference(values[name], older[name])

        if track.totals is not None and total("time_s") <= 0.0:
            track.counts["late_motion"] += 1
            return []
        time_s = track.clock.to_host_s(values["time_s"])
        if track.motion_s is not None and time_s <= track.motion_s:
            # Two reports whose clock estimates cross: keep the order, half a millisecond apart.
            track.counts["clock_step"] += 1
            time_s = track.motion_s + 0.0005
        unseen_s = track.unseen_s
        heading_rad = float(older["heading_rad"])
        cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
        dx_m, dy_m = total("x_m"), total("y_m")
        quality = wire.Quality(values["quality"])
        # Its totals stand still while the inertial sensor is silent: they tell no motion, and come,
        # with the variance of the gap, once it is back.
        silent = bool(quality & wire.Quality.IMU_GAP) and (
            values["state"] == wire.MotionState.STARTING
        )
        along_m2 = max(total("variance_along_m2"), 0.0) + (UNSEEN_SPEED_M_S * unseen_s) ** 2
        scale_m = total("scale_error_m")
        motion = Motion(
            time_s,
            node,
            cosine * dx_m + sine * dy_m,
            cosine * dy_m - sine * dx_m,
            total("heading_rad"),
            math.sqrt(along_m2 + max(scale_m * (scale_m + 2.0 * older["scale_error_m"]), 0.0)),
            math.sqrt(max(total("variance_across_m2"), 0.0) + (UNSEEN_SPEED_M_S * unseen_s) ** 2),
            math.sqrt(
                max(total("variance_heading_rad2"), 0.0) + UNSEEN_TURN_RAD_S_SQRT**2 * unseen_s
            ),
            values["gain_version"],
            values["state"] == wire.MotionState.MOVING,
            math.sqrt(along_m2 + scale_m**2),
            round(total("steps")),
        )
        observations: list[Observation] = []
        if not silent:
            observations.append(motion)
            track.totals, track.unseen_s = dict(values), 0.0
        if quality & wire.Quality.HEIGHT_VALID:
            track.height_m = track.restart_height_m + values["height_m"]
            observations.append(Height(time_s, node, track.height_m))
        if quality & wire.Quality.MAGNETOMETER_VALID:
            observations.append(
                Heading(
                    time_s,
                    node,
                    # A node counts from north, everything else from x, which is east.
                    math.remainder(values["magnetic_heading_rad"] + 0.5 * math.pi, math.tau),
                    MAGNETIC_SIGMA_RAD,
                    "magnetic",
                )
            )
        track.motion_s = time_s
        return observations

    def _link_status(self, node: int, track: NodeTrack, time_s: float) -> list[Observation]:
        values: dict[str, float] = {f"link_{name}": n for name, n in track.counts.items()}
        values["link_clock_drift"] = track.clock.drift
        if track.rssi_dbm is not None:
            values["link_rssi_dbm"] = track.rssi_dbm
        return [Status(time_s, node, name, float(value)) for name, value in values.items()]
