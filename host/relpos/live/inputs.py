"""Where a session's bytes and observations come from: a serial port, or a recording in its place.

An input is read by the session's receive thread alone. All that it gives is stamped with its
``arrival_s``; in this order, and in these portions, it can be replayed.
"""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from relpos.errors import DeviceError
from relpos.link import port as serial_port
from relpos.link.beacon import HostBeacons
from relpos.link.port import READ_BYTES, Link
from relpos.link.step_scale import StepScaleSender
from relpos.live.clock import SessionClock
from relpos.measurements import Event, Heading, Height, Motion, Observation, Range, Status, Step

if TYPE_CHECKING:
    import serial

    from relpos.fusion.estimator import Estimate
    from relpos.link.authentication import SeenCounters
    from relpos.runs import Run

REOPEN_S = 1.0


@dataclass(frozen=True, slots=True)
class Received:
    """What arrived together: the bytes, where it was bytes, and what they mean."""

    arrival_s: float
    data: bytes
    observations: Sequence[Observation]


class Input(Protocol):
    """See the module's text."""

    name: str
    is_now: bool
    """Whether it happens now, so that what phones tell belongs to it."""

    @property
    def link(self) -> Link | None:
        """Counts, clocks and radio figures of the nodes; None where only observations were kept."""

    def read(self, timeout_s: float) -> Received | None:
        """What has arrived; None where nothing does in time. DeviceError where it ended so."""

    def now_s(self) -> float:
        """The session's time: the arrival clock's, or an emulated team's own."""

    def learn(self, estimate: Estimate) -> None:
        """Take what the newest estimate has learned of the wearers' steps."""

    def remarks(self) -> list[str]:
        """What the user should be told, each once."""

    def trouble(self) -> str | None:
        """Why nothing can arrive at present; None where it can."""

    def over(self) -> bool:
        """Whether nothing more will come."""

    def counters(self) -> Mapping[str, float]:
        """Counts of what went wrong on the way, by name."""

    def close(self) -> None:
        """End it."""


class PortInput:
    """A live team behind a serial port, which is sent beacons.

    What an estimator learns of the wearers' steps goes back to the nodes, unless ``teach`` is off.
    A port that vanishes is opened again each second where ``reopen``, else it is a DeviceError, as
    is one that cannot be opened at first.
    """

    is_now = True

    def __init__(
        self,
        port: str,
        link: Link,
        seen: SeenCounters | None = None,
        *,
        clock: SessionClock | None = None,
        teach: bool = True,
        reopen: bool = False,
    ) -> None:
        self.name = port
        self._link: Link = link
        self.clock = clock or SessionClock()
        self._seen = seen
        self._reopen = reopen
        self._scales = StepScaleSender(link) if teach else None
        self._beacons = HostBeacons(link)
        self._told = 0
        self._device: serial.Serial | None = serial_port.open_port(port)
        self._waits_on = _descriptor(self._device)
        self._gone: str | None = None
        self._try_at_s = 0.0

    @property
    def link(self) -> Link | None:
        """The link that everything goes through."""
        return self._link

    def read(self, timeout_s: float) -> Received | None:
        """Wait for bytes; in between tell the nodes what is due to them."""
        if self._device is None and not self._open_again():
            time.sleep(min(timeout_s, REOPEN_S))
            return None
        try:
            self._talk()
            data = self._bytes(timeout_s)
        except DeviceError as error:
            self._lose(error)
            return None
        if not data:
            return None
        arrival_s = self.clock()
        received = Received(arrival_s, data, self._link.feed(data, arrival_s))
        if self._seen is not None:
            self._seen.save(self._link.newest_counters(), time.monotonic())
        return received

    def now_s(self) -> float:
        """The clock, unless an emulated team marks its own time."""
        virtual_s = self._link.virtual_s
        return self.clock() if virtual_s is None else virtual_s

    def learn(self, estimate: Estimate) -> None:
        """Tell the nodes what the newest estimate has learned of their wearers' steps."""
        if self._scales is not None:
            for p in estimate.parameters:
                if p.name == "step_scale":
                    self._scales.learn(p.node, p.value, p.sigma, p.time_s)

    def remarks(self) -> list[str]:
        """Of the link and of the dialogues about step lengths."""
        if self._scales is not None:
            self._link.decoder.remarks += self._scales.remarks
            self._scales.remarks.clear()
        new = self._link.decoder.remarks[self._told :]
        self._told += len(new)
        return new

    def trouble(self) -> str | None:
        """Why the port is not open."""
        return self._gone

    def over(self) -> bool:
        """Never: a port that is silent may speak again."""
        return False

    def counters(self) -> Mapping[str, float]:
        """Counts of the whole link so far."""
        sent = {"step_scales_sent": self._scales.sent} if self._scales else {}
        return {**self._link.summary(), **sent}

    def close(self) -> None:
        """Close the port and keep which frames have been seen."""
        if self._device is not None:
            self._device.close()
            self._device = None
        if self._seen is not None:
            self._seen.save(self._link.newest_counters(), time.monotonic(), at_once=True)

    def _bytes(self, timeout_s: float) -> bytes:
        """What is there, or comes within the time."""
        device = self._device
        assert device is not None
        try:
            waiting = device.in_waiting
            if not waiting and self._waits_on is not None:
                # pyserial's own wait is a setting of the port, and ends with the first byte.
                if not select.select([self._waits_on], [], [], max(timeout_s, 0.0))[0]:
                    return b""
                waiting = device.in_waiting
            data: bytes = device.read(max(1, min(waiting, READ_BYTES)))
        except (OSError, TypeError, ValueError) as error:
            # pyserial's exceptions are OSErrors; TypeError: closed under a waiting read.
            raise serial_port.vanished(device, error) from error
        return data

    def _talk(self) -> None:
        assert self._device is not None
        # An emulated team's virtual time is not for beacons: it sends its own.
        now_s = self.clock()
        serial_port.send(self._device, self._beacons.due(now_s))
        if self._scales is None:
            return
        answers = self._link.decoder.acknowledged
        while answers:
            self._scales.take(answers.popleft())
        serial_port.send(self._device, self._scales.due(now_s))

    def _lose(self, error: DeviceError) -> None:
        if not self._reopen:
            raise error
        self._gone = str(error)
        if self._device is not None:
            self._device.close()
            self._device = None
        self._try_at_s = time.monotonic() + REOPEN_S

    def _open_again(self) -> bool:
        if time.monotonic() < self._try_at_s:
            return False
        try:
            self._device = serial_port.open_port(self.name)
        except DeviceError as error:
            self._gone = str(error)
            self._try_at_s = time.monotonic() + REOPEN_S
            return False
        self._waits_on = _descriptor(self._device)
        self._gone = None
        return True


def _descriptor(device: serial.Serial) -> int | None:
    """What can be waited on; None of ports that are none of the operating system's files."""
    if sys.platform == "win32":
        return None
    try:
        return int(device.fileno())
    except (AttributeError, OSError, TypeError, ValueError):
        return None


class PacedInput:
    """A recording as if it happened now: what arrived at ``arrival_s`` comes at that time again.

    ``items`` are in the order of arrival. ``speed`` 2 is twice as fast, 0 as fast as it is taken.
    """

    is_now = False

    def __init__(
        self,
        name: str,
        items: Iterable[Received],
        *,
        speed: float = 1.0,
        link: Link | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = name
        self.link = link
        self._items = iter(items)
        self._speed = speed
        self._clock = clock
        self._next: Received | None = next(self._items, None)
        self._first_s = 0.0 if self._next is None else self._next.arrival_s
        self._started_s: float | None = None
        self._now_s = self._first_s

    def read(self, timeout_s: float) -> Received | None:
        """What is due by now, one portion at a time."""
        due_s = self._first_s + self._elapsed_s()
        if self._next is None:
            time.sleep(timeout_s)
            return None
        if self._speed and self._next.arrival_s > due_s:
            left_s = (self._next.arrival_s - due_s) / self._speed
            time.sleep(min(left_s, timeout_s))
            if left_s > timeout_s:
                self._now_s = max(self._now_s, self._first_s + self._elapsed_s())
                return None
        received, self._next = self._next, next(self._items, None)
        self._now_s = max(self._now_s, received.arrival_s)
        return received

    def _elapsed_s(self) -> float:
        if self._started_s is None:
            self._started_s = self._clock()
        return (self._clock() - self._started_s) * self._speed

    def now_s(self) -> float:
        """The recording's time."""
        return self._now_s

    def learn(self, estimate: Estimate) -> None:
        """Nobody is there to be taught."""

    def remarks(self) -> list[str]:
        """Of the link, where bytes were recorded."""
        if self.link is None:
            return []
        new = list(self.link.decoder.remarks)
        self.link.decoder.remarks.clear()
        return new

    def trouble(self) -> str | None:
        """None: a recording is there."""
        return None

    def over(self) -> bool:
        """Whether all of it has been read."""
        return self._next is None

    def counters(self) -> Mapping[str, float]:
        """Of the link, where bytes were recorded."""
        return {} if self.link is None else self.link.summary()

    def close(self) -> None:
        """Nothing to end."""


def run_items(run: Run) -> list[Received]:
    """A run directory's observations, as if each had arrived when it was measured."""
    observations: list[Observation] = [*run.measurements, *run.events, *run.statuses, *run.steps]
    order = (Status, Motion, Range, Height, Heading, Step, Event)
    observations.sort(key=lambda o: (o.time_s, order.index(type(o))))
    return [Received(o.time_s, b"", (o,)) for o in observations]
