"""Inputs of a session: a serial port, or a recording in its place.

Only the session's receive thread reads an input. Everything that it returns carries its
``arrival_s``; a recording replays it in the same order and the same portions.
"""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from relpos.errors import DataError, DeviceError, words_of
from relpos.link import port as serial_port
from relpos.link.beacon import HostBeacons
from relpos.link.led_orders import LedOrders
from relpos.link.port import READ_BYTES, Link
from relpos.link.step_scale import StepScaleSender
from relpos.live.clock import SessionClock
from relpos.measurements import MEASUREMENTS, Event, Observation, Status, Step
from relpos.said import Said

if TYPE_CHECKING:
    import serial

    from relpos.fusion.estimator import Estimate
    from relpos.link.authentication import SeenCounters
    from relpos.runs import Run

REOPEN_S = 1.0


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes that arrived together, and the observations in them; a recorded run has no bytes.

    ``again``: read from the recording of a session before, which has recorded it already.
    """

    arrival_s: float
    data: bytes
    observations: Sequence[Observation]
    again: bool = False


class Input:
    """Base class of sources, whose methods do what suits a recording: it sends nothing."""

    name: str
    is_now = False
    """Whether the team is live, so that presses and headings of phones belong to it."""
    recorded_unix_s: float | None = None
    """Unix time of a recording's second 0; None where it does not say, and of what is live."""
    link: Link | None = None
    """The link, its counts and clocks; None where only observations were recorded."""

    def read(self, timeout_s: float) -> Received | None:
        """Return what arrives in time, else None; DeviceError where the port fails."""
        raise NotImplementedError

    def now_s(self) -> float:
        """Return the session's time: the arrival clock's, or an emulated team's own."""
        raise NotImplementedError

    def learn(self, estimate: Estimate) -> None:
        """Pass on what the newest estimate has learned of the wearers' steps."""

    def call_out(self, nodes: Iterable[int]) -> None:
        """Show these nodes' wearers that they are to leave, and nobody else."""

    def called_out(self) -> list[int]:
        """Return the nodes that have confirmed it since the last call."""
        return []

    def remarks(self) -> list[str]:
        """Return new messages for the user, each once."""
        if self.link is None:
            return []
        new = list(self.link.decoder.remarks)
        self.link.decoder.remarks.clear()
        return new

    def trouble(self) -> str | None:
        """Return why nothing can arrive at present; None where it can."""
        return None

    def over(self) -> bool:
        """Return whether the input has ended; a silent port may speak again."""
        return False

    def counters(self) -> Mapping[str, float]:
        """Return counts of errors on the way, by name."""
        return {} if self.link is None else self.link.summary()

    def close(self) -> None:
        """Close the input."""


class PortInput(Input):
    """A live team behind a serial port; sends it beacons.

    What came before (``earlier``) is read first. With ``teach`` the nodes get the step scales that
    the estimator learns. With ``reopen`` a port that vanishes is tried again each second; otherwise
    it is a DeviceError, as is a port that cannot be opened at first.
    """

    is_now = True
    link: Link

    def __init__(
        self,
        port: str,
        link: Link,
        seen: SeenCounters | None = None,
        *,
        clock: SessionClock | None = None,
        teach: bool = True,
        reopen: bool = False,
        earlier: Iterable[Received] = (),
    ) -> None:
        self._earlier: Iterator[Received] | None = iter(earlier)
        self._earlier_s: float | None = None
        self.name = port
        self.link = link
        self.clock = clock or SessionClock()
        self._seen = seen
        self._reopen = reopen
        self._scales = StepScaleSender(link) if teach else None
        self._leds = LedOrders(link)
        self._beacons = HostBeacons(link)
        self._remarked = 0
        self._device: serial.Serial | None = serial_port.open_port(port)
        self._waits_on = _descriptor(self._device)
        self._terminal = serial_port.incarnation(port)
        self._trouble: str | None = None
        self._try_at_s = 0.0

    def read(self, timeout_s: float) -> Received | None:
        """Send what is due to the nodes, then wait for bytes."""
        if self._earlier is not None:
            received = next(self._earlier, None)
            self._earlier_s = None if received is None else received.arrival_s
            if received is not None:
                return received
            self._earlier = None
        if self._device is None and not self._open_again():
            time.sleep(min(timeout_s, REOPEN_S))
            return None
        try:
            self._send_due()
            data = self._bytes(timeout_s)
        except DeviceError as error:
            self._lose(error)
            return None
        if not data:
            return None
        arrival_s = self.clock()
        came = Received(arrival_s, data, self.link.feed(data, arrival_s))
        self._save_counters()
        return came

    def _save_counters(self, *, at_once: bool = False) -> None:
        """Store the newest frame counters; a full disk is a remark, and tried again."""
        if self._seen is None:
            return
        try:
            self._seen.save(
                self.link.newest_counters(),
                time.monotonic(),
                at_once=at_once,
                lowered=self.link.decoder.brought_back,
            )
        except DataError as error:
            if str(error) not in self.link.decoder.remarks:
                self.link.decoder.remarks.append(str(error))

    def now_s(self) -> float:
        """Return the clock's time, or that of an emulated team which marks its own."""
        virtual_s = self.link.virtual_s
        if virtual_s is not None:
            return virtual_s
        return self.clock() if self._earlier_s is None else self._earlier_s

    def learn(self, estimate: Estimate) -> None:
        """Begin to send newly learned step scales to the nodes."""
        if self._scales is not None:
            for p in estimate.parameters:
                if p.name == "step_scale":
                    self._scales.learn(p.node, p.value, p.sigma, p.time_s)

    def call_out(self, nodes: Iterable[int]) -> None:
        """Light these nodes' LEDs."""
        self._leds.call_out(nodes)

    def called_out(self) -> list[int]:
        """Return the nodes whose LEDs have been lit since the last call."""
        return self._leds.lit()

    def remarks(self) -> list[str]:
        """Return new remarks of the decoder and of the step scales."""
        if self._scales is not None:
            self.link.decoder.remarks += self._scales.remarks
            self._scales.remarks.clear()
        new = self.link.decoder.remarks[self._remarked :]
        self._remarked += len(new)
        return new

    def trouble(self) -> str | None:
        """Return why the port is not open."""
        return self._trouble

    def counters(self) -> Mapping[str, float]:
        """Return the counts of the whole link so far."""
        sent = {"step_scales_sent": self._scales.sent} if self._scales else {}
        return {**self.link.summary(), **sent}

    def close(self) -> None:
        """Close the port and store the newest frame counters."""
        if self._device is not None:
            self._device.close()
            self._device = None
        self._save_counters(at_once=True)

    def _bytes(self, timeout_s: float) -> bytes:
        """Return bytes that are there, or arrive within the time."""
        device = self._device
        assert device is not None
        try:
            waiting = device.in_waiting
            if not waiting and self._waits_on is not None:
                # pyserial's own timeout is a setting of the port; it waits for all bytes asked for.
                if not select.select([self._waits_on], [], [], max(timeout_s, 0.0))[0]:
                    return b""
                waiting = device.in_waiting
            data: bytes = device.read(max(1, min(waiting, READ_BYTES)))
        except (OSError, TypeError, ValueError) as error:
            # pyserial's exceptions are OSErrors; TypeError: closed under a waiting read.
            raise serial_port.vanished(device, error) from error
        return data

    def _send_due(self) -> None:
        assert self._device is not None
        # An emulated team in virtual time sends beacons of its own.
        now_s = self.clock()
        serial_port.send(self._device, self._beacons.due(now_s))
        answers = self.link.decoder.acknowledged
        while answers:
            answer = answers.popleft()
            self._leds.handle(answer)
            if self._scales is not None:
                self._scales.handle(answer)
        serial_port.send(self._device, self._leds.due(now_s))
        if self._scales is not None:
            serial_port.send(self._device, self._scales.due(now_s))

    def _lose(self, error: DeviceError) -> None:
        if not self._reopen:
            raise error
        self._trouble = words_of(error)
        if self._device is not None:
            self._device.close()
            self._device = None
        self._try_at_s = time.monotonic() + REOPEN_S

    def _open_again(self) -> bool:
        if time.monotonic() < self._try_at_s:
            return False
        try:
            terminal = serial_port.incarnation(self.name)
            if terminal is not None and terminal == self._terminal:
                raise DeviceError(
                    Said(
                        "terminal-gone",
                        "{port}: the port vanished: a pseudo-terminal does not come back; start "
                        "anew at the one that relpos emulate prints now",
                        port=self.name,
                    )
                )
            self._device = serial_port.open_port(self.name)
            self._terminal = terminal
        except DeviceError as error:
            self._trouble = words_of(error)
            self._try_at_s = time.monotonic() + REOPEN_S
            return False
        self._waits_on = _descriptor(self._device)
        self._trouble = None
        return True


def _descriptor(device: serial.Serial) -> int | None:
    """Return the descriptor to wait on; None for ports that are not files of the system."""
    if sys.platform == "win32":
        return None
    try:
        return int(device.fileno())
    except (AttributeError, OSError, TypeError, ValueError):
        return None


class PacedInput(Input):
    """A recording played at the pace of its arrival times.

    ``items`` are in the order of arrival. ``speed`` 2 is twice as fast, 0 as fast as it is read.
    """

    def __init__(
        self,
        name: str,
        items: Iterable[Received],
        *,
        speed: float = 1.0,
        link: Link | None = None,
        recorded_unix_s: float | None = None,
    ) -> None:
        self.name = name
        self.recorded_unix_s = recorded_unix_s
        self.link = link
        self._items = iter(items)
        self._speed = speed
        self._next: Received | None = next(self._items, None)
        self._first_s = 0.0 if self._next is None else self._next.arrival_s
        self._started_s: float | None = None
        self._now_s = self._first_s

    def read(self, timeout_s: float) -> Received | None:
        """Return what is due by now, one portion at a time."""
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
            self._started_s = time.monotonic()
        return (time.monotonic() - self._started_s) * self._speed

    def now_s(self) -> float:
        """Return the recording's time."""
        return self._now_s

    def over(self) -> bool:
        """Return whether all of it has been read."""
        return self._next is None


def run_items(run: Run) -> list[Received]:
    """Return a run's observations, each arriving at the time of its measurement."""
    observations: list[Observation] = [*run.measurements, *run.events, *run.statuses, *run.steps]
    order = (Status, *MEASUREMENTS, Step, Event)
    observations.sort(key=lambda o: (o.time_s, order.index(type(o))))
    return [Received(o.time_s, b"", (o,)) for o in observations]
