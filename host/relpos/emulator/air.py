"""Virtual time, and the two airs that boards share in it: UWB between tags, radio between XBees."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from relpos.simulation.world import FloatArray, World

from .pozyx import (
    ERROR_RESPONSE_TIMEOUT_1,
    ERROR_RESPONSE_TIMEOUT_2,
    Pozyx,
    RangeResult,
)
from .xbee import BROADCAST, DELIVERED, NO_ACKNOWLEDGEMENT, Transmission, XbeeModule

Action = Callable[[int], int | None]
"""(time) -> when it is to be called again, or None."""

STEP_US = 20_000
"""How far a team's clock advances between two looks at its serial port."""

NO_ACKNOWLEDGEMENT_US = 40_000
"""Until an XBee gives up: four attempts of 802.15.4 with carrier sensing (assumed)."""


class VirtualClock:
    """Actions in the order of their due times; those due at once in the order they were asked."""

    def __init__(self) -> None:
        self.now_us = 0
        self._heap: list[tuple[int, int, Action]] = []
        self._asked = 0

    def at(self, time_us: int, action: Action) -> None:
        """Call ``action(time)`` at ``time_us``, or now where that is past."""
        self._asked += 1
        if time_us < self.now_us:
            time_us = self.now_us
        heapq.heappush(self._heap, (time_us, self._asked, action))

    def run(self, until_us: int) -> None:
        """Carry out everything due by ``until_us``; then that is the time."""
        heap = self._heap
        while heap and heap[0][0] <= until_us:
            time_us, _, action = heap[0]
            self.now_us = time_us
            again_us = action(time_us)
            # What it has asked for stands behind it: it is still the first.
            if again_us is None:
                heapq.heappop(heap)
            else:
                self._asked += 1
                heapq.heapreplace(heap, (again_us, self._asked, action))
        self.now_us = max(self.now_us, until_us)


EXCHANGE_US = 20_000
"""From the call of an exchange to its end. Assumed, not measured.

At 110 kbit/s, a PRF of 64 MHz and a preamble of 1024 symbols of 1.018 us, a frame of 20 bytes takes
3.0 ms on the air: preamble 1.04 ms, start delimiter 0.07 ms, header 0.17 ms (21 bits of 8.2 us),
data 1.7 ms (160 bits and 48 of its Reed-Solomon code; IEEE 802.15.4a). Four such frames (poll,
answer, final, report) are 12 ms, and three replies of one to two milliseconds and the
microcontrollers' work come on top. pypozyx first allowed 25 ms for all of it."""
FAILED_US = 30_000
"""Until the initiator gives up on an answer: pypozyx's 25 ms and some margin."""


class Outcome(StrEnum):
    """What became of an exchange, as :attr:`UwbAir.counts` names it."""

    RANGED = "ranges"
    UNDETECTED = "undetected"
    COLLIDED = "collisions"
    ABSENT = "absent"


@dataclass(frozen=True, slots=True)
class ExchangeRecord:
    """One exchange that is over."""

    begin_us: int
    end_us: int
    initiator: int
    destination: int
    outcome: Outcome


@dataclass(slots=True)
class _Exchange:
    end_us: int
    ends: tuple[Pozyx | None, Pozyx | None]
    collided: bool = False


class UwbAir:
    """Ranging between tags at their true positions.

    With ``collisions`` two exchanges that overlap in time, with a tag of the one in reach of a tag
    of the other, both fail: a preamble hides other frames, and no tag is in two exchanges at once.
    Harder than the air is: a strong frame may survive a weak one, and an initiator that waits in
    vain disturbs no other.

    ``counts``: attempts, ranges, undetected, collisions, absent; an undetected exchange that also
    collides is counted in both.
    """

    def __init__(
        self,
        clock: VirtualClock,
        world: World,
        position_m: Callable[[Pozyx, int], FloatArray],
        rng: np.random.Generator,
        collisions: bool = True,
    ) -> None:
        self._collisions = collisions
        self.tags: list[Pozyx] = []
        self.counts: Counter[str] = Counter()
        self._clock = clock
        self._world = world
        self._position_m = position_m
        self._rng = rng
        self._under_way: list[_Exchange] = []
        self.on_end: Callable[[ExchangeRecord], None] | None = None
        """Called with each exchange when it is over: for measurements and tests."""
        self.spoil: Callable[[Pozyx, float | None, int], tuple[float | None, bool]] = (
            lambda _initiator, measured_m, _end_us: (measured_m, False)
        )
        """Fault: (initiator, what would be measured in metres, end of the exchange) -> what is
        measured instead, and whether an exchange of foreign tags spoils it."""

    def begin_exchange(self, initiator: Pozyx, destination: int, time_us: int) -> None:
        """See :class:`relpos.emulator.pozyx.UwbMedium`."""
        self.counts["attempts"] += 1
        responder = self._find(initiator, destination, time_us)
        initiator_id = initiator.network_id
        # Drawn at once, so that the order of draws is that of the attempts.
        measured = None
        if responder is None:
            self.counts["absent"] += 1
        else:
            measured = self._world.measure_range(
                self._rng, *(self._position_m(tag, time_us) for tag in (initiator, responder))
            )
            if measured is None:
                self.counts["undetected"] += 1
            else:
                delays_m = initiator.antenna_delay_m + responder.antenna_delay_m
                measured = max(measured + delays_m, 0.0)
        measured, spoilt = self.spoil(initiator, measured, time_us + EXCHANGE_US)
        duration_us = FAILED_US if measured is None else EXCHANGE_US
        exchange = _Exchange(time_us + duration_us, (initiator, responder), spoilt)
        self._under_way = [e for e in self._under_way if e.end_us > time_us]
        if self._collisions:
            for other in self._under_way:
                if self._in_reach(exchange, other, time_us):
                    other.collided = exchange.collided = True
        self._under_way.append(exchange)

        def end(now_us: int) -> None:
            result, error = None, ERROR_RESPONSE_TIMEOUT_1
            outcome = Outcome.UNDETECTED if responder is not None else Outcome.ABSENT
            if exchange.collided:
                outcome = Outcome.COLLIDED
                self.counts[outcome] += 1
                error = ERROR_RESPONSE_TIMEOUT_2
            elif measured is not None and responder is not None:
                outcome = Outcome.RANGED
                self.counts[outcome] += 1
                result = RangeResult(round(measured * 1000.0), _uwb_rss_dbm(measured))
                responder.finish_ranging(initiator.network_id, result, 0, now_us, started=False)
            initiator.finish_ranging(destination, result, error, now_us, started=True)
            if self.on_end is not None:
                self.on_end(ExchangeRecord(time_us, now_us, initiator_id, destination, outcome))

        self._clock.at(exchange.end_us, end)

    def _find(self, initiator: Pozyx, destination: int, time_us: int) -> Pozyx | None:
        for tag in self.tags:
            if (
                tag is not initiator
                and tag.network_id == destination
                and tag.awake(time_us)
                and tag.uwb_settings == initiator.uwb_settings
            ):
                return tag
        return None

    def _distance_m(self, a: Pozyx, b: Pozyx, time_us: int) -> float:
        return math.dist(self._position_m(a, time_us), self._position_m(b, time_us))

    def _in_reach(self, one: _Exchange, other: _Exchange, time_us: int) -> bool:
        reach_m = self._world.uwb.max_range_m
        return any(
            a is b or self._distance_m(a, b, time_us) <= reach_m
            for a in one.ends
            if a is not None
            for b in other.ends
            if b is not None
        )


def _uwb_rss_dbm(distance_m: float) -> int:
    """Free space from -79 dBm at 1 m, what Pozyx tags show; no weaker than the receiver's floor."""
    return max(round(-79.0 - 20.0 * math.log10(max(distance_m, 0.3))), -105)


class RadioAir:
    """802.15.4 between the modules: the world's loss and delay, in order from each sender.

    A broadcast leaves once: all that receive it receive it at the same moment.
    """

    def __init__(
        self,
        clock: VirtualClock,
        world: World,
        distance_m: Callable[[XbeeModule, XbeeModule, int], float],
        rng: np.random.Generator,
    ) -> None:
        self.modules: list[XbeeModule] = []
        self.counts: Counter[str] = Counter()
        self._clock = clock
        self._world = world
        self._distance_m = distance_m
        self._rng = rng
        self._last_us: dict[int, int] = {}
        self.spoil: Callable[[XbeeModule, XbeeModule, bytes, int], list[tuple[int, bytes]]] = (
            lambda _sender, _receiver, data, arrival_us: [(arrival_us, data)]
        )
        """Fault: (sender, receiver, data, arrival) -> (arrival, data) of what comes instead;
        nothing: lost."""

    def send(self, sent: Transmission) -> None:
        """See :class:`relpos.emulator.xbee.Air`."""
        self.counts["sent"] += 1
        broadcast = sent.destination == BROADCAST and not sent.long
        others = [m for m in self.modules if m is not sent.sender]
        if broadcast:
            receivers = others
        elif sent.long:
            receivers = [m for m in others if m.serial_number == sent.destination]
        else:
            receivers = [m for m in others if m.address == sent.destination]
        received = False
        done_us = sent.time_us
        common_s: float | None = None
        for receiver in receivers:
            delay_s = self._world.radio.transmit(self._rng)
            if delay_s is None:
                self.counts["lost"] += 1
                continue
            if broadcast:
                common_s = delay_s = delay_s if common_s is None else common_s
            arrival_us = max(
                sent.time_us + round(delay_s * 1e6),
                self._last_us.get(sent.sender.serial_number, 0) + 1,
            )
            arrivals = self.spoil(sent.sender, receiver, sent.data, arrival_us)
            if not arrivals:
                self.counts["lost"] += 1
                continue
            received = True
            done_us = max(done_us, arrival_us)
            for at_us, came in arrivals:
                self._clock.at(at_us, self._arrival(sent.sender, receiver, came, broadcast))
        if broadcast or received:
            status = DELIVERED
        else:
            status = NO_ACKNOWLEDGEMENT
            done_us = max(sent.time_us + NO_ACKNOWLEDGEMENT_US, done_us)
        self._last_us[sent.sender.serial_number] = done_us
        self._clock.at(done_us, lambda now_us: sent.report(now_us, status))

    def _arrival(
        self, sender: XbeeModule, receiver: XbeeModule, data: bytes, broadcast: bool
    ) -> Action:
        def arrive(now_us: int) -> None:
            distance_m = self._distance_m(sender, receiver, now_us)
            rssi_dbm = max(round(-40.0 - 20.0 * math.log10(max(distance_m, 1.0))), -92)
            receiver.deliver(sender, rssi_dbm, data, broadcast, now_us)

        return arrive
