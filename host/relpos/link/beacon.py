"""The coordinator's beacon: who is in the team, in which order of slots, and what time it is.

Pure: the time is an argument, in seconds of any clock that does not go back. What the nodes make
of it: docs/ranging.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from relpos.errors import DataError
from relpos.protocol import messages as wire

if TYPE_CHECKING:
    from relpos.link.port import Link

MOST_NODES = 20
"""Slots of a beacon: what fits into a frame beside its authentication."""
BEACON_PERIOD_S = 1.0
"""A node keeps its slot for 5 s without a beacon. Where half of them are lost, five in a row are
lost once a minute (2^6 - 2 beacons on average), and the slot is back two seconds later."""
SUPERFRAME_S = 2.0
"""The ranging period of the paper: everybody has a window in each."""
FORGET_S = 30.0
"""A node that was not heard for so long gives its slot back. It sends a motion a second: also
where half of the frames are lost, 30 in a row are lost once in 2^31 s."""


class BeaconSchedule:
    """Which beacon is due when.

    ``nodes`` are in the team whether they are heard or not; others as long as they were heard
    within the last :data:`FORGET_S`. Who is in it keeps the order; newcomers follow, sorted.
    DataError where ``nodes`` are not different ids from 1 to 254, at most :data:`MOST_NODES`.
    """

    def __init__(self, nodes: Iterable[int] = (), *, superframe_s: float = SUPERFRAME_S) -> None:
        given = list(nodes)
        if len(set(given)) != len(given) or not all(
            wire.COORDINATOR < node < wire.BROADCAST for node in given
        ):
            raise DataError(f"a team's nodes are different ids from 1 to 254, not {given}")
        if len(given) > MOST_NODES:
            raise DataError(f"a team has at most {MOST_NODES} nodes, not {len(given)}")
        self._given = frozenset(given)
        self._order = sorted(given)
        self._heard_s: dict[int, float] = {}
        self._superframe_ms = round(superframe_s * 1000.0)
        self._due_s: float | None = None
        self.left_out: tuple[int, ...] = ()
        """Heard, but there was no slot left: they range without, and disturb the others."""

    def heard(self, node: int, time_s: float) -> None:
        """Note a frame of ``node``."""
        self._heard_s[node] = max(time_s, self._heard_s.get(node, time_s))

    def team(self, now_s: float) -> tuple[int, ...]:
        """The ids in the order of their slots."""
        present = {n for n, heard_s in self._heard_s.items() if now_s - heard_s <= FORGET_S}
        present |= self._given
        self._order = [node for node in self._order if node in present]
        newcomers = sorted(present.difference(self._order))
        room = MOST_NODES - len(self._order)
        self._order += newcomers[:room]
        self.left_out = tuple(newcomers[room:])
        return tuple(self._order)

    def values(self, now_s: float) -> dict[str, Any]:
        """A beacon that leaves at ``now_s``, as the wire's message."""
        superframe, phase_ms = divmod(round(now_s * 1000.0), self._superframe_ms)
        return {
            "phase_s": phase_ms * 1e-3,
            "period_s": self._superframe_ms * 1e-3,
            "round": superframe % 256,
            "nodes": [{"node": node} for node in self.team(now_s)],
        }

    def due(self, now_s: float) -> Mapping[str, Any] | None:
        """The beacon that has to leave now, or None; None, too, while there is nobody to tell.

        Beacons that were missed are not made up for.
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
    """Beacons of a host: to the nodes that ``link`` hears, unless an emulated team sends its own.

    Such a team marks virtual time, which a host cannot follow. Whom there is no slot for is told
    in the decoder's remarks, once.
    """

    def __init__(self, link: Link, schedule: BeaconSchedule | None = None) -> None:
        self._link = link
        self.schedule = schedule or BeaconSchedule()
        self._told: set[int] = set()

    def due(self, now_s: float) -> bytes:
        """Bytes for the coordinator's port now; none where no beacon is due.

        ``now_s`` is on the clock of the arrival times that the link was fed with.
        """
        if self._link.virtual_s is not None:
            return b""
        for node, track in self._link.decoder.nodes.items():
            if track.heard:
                self.schedule.heard(node, track.arrival_s)
        values = self.schedule.due(now_s)
        if values is None:
            return b""
        new = set(self.schedule.left_out) - self._told
        if new:
            self._told |= new
            self._link.decoder.remarks.append(
                f"node {', '.join(map(str, sorted(new)))}: heard, but a team has slots for "
                f"{MOST_NODES}: without one it disturbs the others; switch it off"
            )
        return self._link.frame(wire.BEACON, wire.BROADCAST, values)
