"""The coordinator's beacon: the team's nodes in the order of their slots, and the time.

Pure: the time is an argument, in seconds of any clock that does not go back. docs/ranging.md
describes what the nodes do with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from relpos.errors import DataError
from relpos.protocol import messages as wire
from relpos.said import Said

if TYPE_CHECKING:
    from relpos.link.port import Link

MAX_NODES = 20
"""Slots of a beacon: as many as fit into a frame with its authentication."""
BEACON_PERIOD_S = 1.0
"""A node keeps its slot for 5 s without a beacon. Where half of them are lost, five in a row are
lost once a minute (2^6 - 2 beacons on average), and the slot is back two seconds later."""
SUPERFRAME_MS = 2000
"""The ranging period of the paper; each node has one window in it."""
FORGET_S = 30.0
"""Silence after which a node loses its slot. It sends a motion a second: also
where half of the frames are lost, 30 in a row are lost once in 2^31 s."""
PATIENCE_S = 10.0
"""With beacons that a node could have taken, before it is asked; its status comes as often."""


class BeaconSchedule:
    """Which beacon is due when.

    ``nodes`` are always in the team; others while they were received within the last
    :data:`FORGET_S`. Nodes keep their order; new ones follow, sorted.
    DataError where ``nodes`` are not different ids from 1 to 254, at most :data:`MAX_NODES`.
    """

    def __init__(self, nodes: Iterable[int] = ()) -> None:
        given = list(nodes)
        if len(set(given)) != len(given) or not all(
            wire.COORDINATOR < node < wire.BROADCAST for node in given
        ):
            raise DataError(f"a team's nodes are different ids from 1 to 254, not {given}")
        if len(given) > MAX_NODES:
            raise DataError(f"a team has at most {MAX_NODES} nodes, not {len(given)}")
        self._given = frozenset(given)
        self._order = sorted(given)
        self._heard_s: dict[int, float] = {}
        self._due_s: float | None = None
        self.left_out: tuple[int, ...] = ()
        """Nodes received without a free slot: they range without one and disturb the others."""

    def heard(self, node: int, time_s: float) -> None:
        """Note a frame of ``node``."""
        self._heard_s[node] = time_s

    def team(self, now_s: float) -> tuple[int, ...]:
        """Return the ids in the order of their slots."""
        present = {n for n, heard_s in self._heard_s.items() if now_s - heard_s <= FORGET_S}
        present |= self._given
        self._order = [node for node in self._order if node in present]
        newcomers = sorted(present.difference(self._order))
        room = MAX_NODES - len(self._order)
        self._order += newcomers[:room]
        self.left_out = tuple(newcomers[room:])
        return tuple(self._order)

    def values(self, now_s: float) -> dict[str, Any]:
        """Return the fields of a beacon that leaves at ``now_s``."""
        superframe, phase_ms = divmod(round(now_s * 1000.0), SUPERFRAME_MS)
        return {
            "phase_s": phase_ms * 1e-3,
            "period_s": SUPERFRAME_MS * 1e-3,
            "round": superframe % 256,
            "nodes": [{"node": node} for node in self.team(now_s)],
        }

    def due(self, now_s: float) -> Mapping[str, Any] | None:
        """Return the beacon that is due now, or None; None, too, while the team is empty.

        Missed beacons are not sent later.
        """
        if self._due_s is None:
            self._due_s = now_s
        if now_s < self._due_s or not self.team(now_s):
            return None
        self._due_s += BEACON_PERIOD_S
        if self._due_s <= now_s:
            self._due_s = now_s + BEACON_PERIOD_S
        return self.values(now_s)


class HostBeacons:
    """Sends beacons to the nodes that ``link`` hears, unless an emulated team sends its own.

    Such a team marks virtual time, which a host cannot follow. A node without a free slot gets a
    remark in the decoder, once. Nodes whose frame counters do not fit get the decoder's challenges,
    those that take no beacon a PING: a host whose clock was ahead may have made ours look old, and
    any command ends that.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self.schedule = BeaconSchedule()
        self._remarked: set[int] = set()
        self._asked_s: dict[int, float] = {}

    def due(self, now_s: float) -> bytes:
        """Return bytes for the coordinator's port, empty where nothing is due.

        ``now_s`` is on the clock of the link's arrival times.
        """
        return self._link.challenges() + self._beacon(now_s)

    def _beacon(self, now_s: float) -> bytes:
        if self._link.virtual_s is not None:
            return b""
        for node, track in self._link.decoder.nodes.items():
            self.schedule.heard(node, track.arrival_s)
        values = self.schedule.due(now_s)
        if values is None:
            return b""
        new = set(self.schedule.left_out) - self._remarked
        if new:
            self._remarked |= new
            self._link.decoder.remarks.append(
                Said(
                    "no-slot",
                    "node {nodes}: no slot left, a team has {most}; it disturbs the others: "
                    "switch it off",
                    nodes=", ".join(map(str, sorted(new))),
                    most=MAX_NODES,
                )
            )
        return self._link.frame(wire.BEACON, wire.BROADCAST, values) + self._pings(now_s)

    def _pings(self, now_s: float) -> bytes:
        data = b""
        for node, track in self._link.decoder.nodes.items():
            asked_s = self._asked_s.setdefault(node, now_s)
            if track.without_beacon_s is not None and track.without_beacon_s > asked_s + PATIENCE_S:
                self._asked_s[node] = now_s
                data += self._link.command(node, wire.CommandCode.PING, 0)[1]
        return data
