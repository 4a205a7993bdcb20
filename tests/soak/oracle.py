"""What must hold at every moment of a session, whatever goes wrong around it."""

from __future__ import annotations

import json
import math
import struct
from collections import Counter, defaultdict

from relpos.errors import RelposError
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.link.decoder import Decoder
from relpos.live.sinks import Sink
from relpos.live.team_view import to_json
from relpos.measurements import Height, Motion, out_of_bounds


class ViolationError(AssertionError):
    """A promise was broken."""


def require(holds: bool, promise: str, detail: object = "") -> None:
    """Raise ViolationError unless the promise holds."""
    if not holds:
        raise ViolationError(f"{promise}: {detail}" if detail != "" else promise)


class Air:
    """Every frame that a node has sent, as its module passed it on."""

    def __init__(self, team) -> None:
        self.genuine: set[bytes] = set()
        self.accepted: set[bytes] = set()
        """By any session so far that remembers what the ones before it had."""
        nodes = {id(node.radio) for node in team.nodes.values()}
        plain = team.radio.send

        def send(sent) -> None:
            if id(sent.sender) in nodes:
                self.genuine.add(bytes(sent.data))
            plain(sent)

        team.radio.send = send


class CheckedDecoder(Decoder):
    """A decoder whose every frame is checked against what was sent."""

    def __init__(self, air: Air, keys, newest_counters) -> None:
        super().__init__(keys, newest_counters)
        self._air = air
        self._counters: dict[tuple[int, int, int], list[int]] = defaultdict(list)
        self._lives: Counter[int] = Counter()
        self._pose: dict[int, tuple[float, float, float]] = {}
        self._fed = 0

    def feed(self, data, arrival_s, rssi_dbm=None):
        self._fed += 1
        before = {n: (t, t.counts["received"], t.motion_s) for n, t in self.nodes.items()}
        observations = super().feed(data, arrival_s, rssi_dbm)
        taken = [
            n for n, t in self.nodes.items() if t.counts["received"] > before.get(n, (0, 0))[1]
        ]
        if not taken:
            require(not observations, "a refused frame gives no measurement", observations)
            return observations
        (node,) = taken
        require(data in self._air.genuine, "a frame that no node has sent is accepted", data.hex())
        require(data not in self._air.accepted, "a frame is accepted twice", data.hex())
        self._air.accepted.add(data)
        track = self.nodes[node]
        if node in before and before[node][0] is not track:  # began anew: restart, or brought back
            self._lives[node] += 1
            self._pose.pop(node, None)
        counter = int.from_bytes(data[5:9], "little")
        self._counters[node, self._lives[node], track.boot].append(counter)
        for o in observations:
            require(o.node == node, "a frame speaks for its own node alone", o)
            require(out_of_bounds(o) is None, "a measurement is within its bounds", o)
            if isinstance(o, Motion):
                self._check_motion(node, data, o, before.get(node, (0, 0, None))[2])
            if isinstance(o, Height):
                require(math.isfinite(o.height_m), "a height is a number", o)
        return observations

    def _check_motion(self, node, data, motion, before_s) -> None:
        """Displacements add up to the node's own totals; times never go back."""
        require(before_s is None or motion.time_s > before_s, "motion goes on in time", motion)
        x_m, y_m, heading_rad = self._pose.get(node, (0.0, 0.0, 0.0))
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        pose = (
            x_m + c * motion.dx_m - s * motion.dy_m,
            y_m + s * motion.dx_m + c * motion.dy_m,
            heading_rad + motion.dtheta_rad,
        )
        self._pose[node] = pose
        x_mm, y_mm, heading = struct.unpack_from("<3i", data, 13)  # as docs/protocol.md has them
        totals = (x_mm * 1e-3, y_mm * 1e-3, heading * 1e-4)
        off = max(abs(a - b) for a, b in zip(pose, totals, strict=True))
        require(off < 1e-6, "motion adds up to the node's totals", (node, pose, totals))

    def check_counts(self) -> None:
        """Every frame is received, refused or lost, and counted as that once."""
        received = sum(t.counts["received"] for t in self.nodes.values())
        refused = sum(self.counts.values())
        refused += sum(
            t.counts[name]
            for t in self.nodes.values()
            for name in ("duplicate", "replayed", "jumped", "stale_boot")
        )
        unheard = self._fed - received - refused
        # A node that has not been heard yet has no track that could count.
        require(unheard >= 0, "no frame is counted twice", unheard)
        for node, track in self.nodes.items():
            lives = [c for key, c in self._counters.items() if key[0] == node]
            require(sum(map(len, lives)) == track.counts["received"], "what is received is counted")
            lost = sum(max(c) - c[0] + 1 - len(c) for c in lives)
            require(track.counts["lost"] == lost, "sent = received + lost", (node, lost))


class Watch(Sink):
    """Checks every estimate and view of a session, and asks for what guests ask.

    A session goes on without a sink that fails: ``broken`` keeps what this one found.
    """

    def __init__(self, ask, nodes) -> None:
        self._ask = ask
        self._nodes = set(nodes)
        self._newest_s = -math.inf
        self.estimates = self.views = 0
        self.broken: list[Exception] = []

    def requests(self):
        return self._ask()

    def respond(self, request, reply, status=200) -> None:
        self._checking(self._respond, request, reply, status)

    def estimated(self, estimate: Estimate) -> None:
        self._checking(self._estimated, estimate)

    def updated(self, view) -> None:
        self._checking(self._updated, view)

    def _checking(self, check, *arguments) -> None:
        try:
            check(*arguments)
        except Exception as error:
            self.broken.append(error)

    def _respond(self, request, reply, status) -> None:
        require(status < 500, "a guest's request fails nothing", (request.kind, reply))
        json.loads(to_json(reply))

    def _estimated(self, estimate: Estimate) -> None:
        self.estimates += 1
        require(estimate.time_s > self._newest_s, "estimates go on in time", estimate.time_s)
        self._newest_s = estimate.time_s
        for node in estimate.nodes:
            require(node.node in self._nodes, "nobody is added to the team", node)
            check_node(node)
        for pair in estimate.pairs:
            numbers = (pair.distance_m, pair.sigma_distance_m, pair.bearing_rad)
            require(all(map(math.isfinite, numbers)), "a pair's numbers are numbers", pair)
            require(min(numbers[:2]) >= 0.0, "distances and sigmas are not negative", pair)

    def _updated(self, view) -> None:
        self.views += 1
        text = view.to_json()
        require("NaN" not in text and "Infinity" not in text, "a view holds numbers", text[:200])
        for person in view.people:
            shown = person.x_m is not None
            dated = person.motion_s is not None or person.seen_s is not None
            require(dated or not shown or person.status != "ok", "no state without its age", person)


def check_node(node) -> None:
    """A node's covariance is positive, and everything a number."""
    xx, yy, xy = node.variance_x_m2, node.variance_y_m2, node.covariance_xy_m2
    numbers = (node.x_m, node.y_m, node.heading_rad)
    if node.status is not NodeStatus.UNLOCATED:  # of which a covariance may be infinite
        numbers = (*numbers, xx, yy, xy, node.sigma_heading_rad)
    require(all(map(math.isfinite, numbers)), "an estimate is made of numbers", node)
    if node.status is NodeStatus.UNLOCATED:
        return
    require(xx > 0.0 and yy > 0.0 and node.sigma_heading_rad >= 0.0, "variances > 0", node)
    require(xx * yy - xy * xy >= -1e-9 * xx * yy, "covariances are positive definite", node)


FAILURES = ("frames_failed", "views_failed", "updates_failed", "requests_failed")


def check_outcome(outcome, said) -> None:
    """Nothing failed behind the session's back."""
    told = outcome.failure is None or isinstance(outcome.failure, RelposError)
    require(told, "no session ends with a traceback", repr(outcome.failure))
    for name in FAILURES:
        require(not outcome.counters.get(name), "nothing fails and is survived", (name, said[-3:]))
