"""A sink that sends every member to TAK clients as Cursor-on-Target, through pytak.

It works in a thread of its own with an event loop; the session only stores the newest view here.
A slow network gets fewer positions, never old ones.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import platform
import threading
import time
import uuid
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any
from urllib.parse import urlparse

from relpos.errors import DataError
from relpos.extras import missing_extra
from relpos.fusion.estimator import Estimate
from relpos.geodesy import MapFrame, Pin, place
from relpos.live.cot_events import Events, Moved, is_located, serialized
from relpos.live.sinks import Sink
from relpos.live.team_view import Alert, Person, TeamView
from relpos.said import Said

EVERY_S = 1.0
"""Each member is sent at most this often."""
LOST_EVERY_S = 10.0
"""A lost member: often enough for a client that has just joined."""
LAST_KNOWN_EVERY_S = 60.0
ALARM_EVERY_S = 10.0
END_EVERY_S = 10.0
ENDS = 3
"""So often an end is told: nobody repeats a lost datagram."""
TICK_S = 0.2
CONNECT_WITHIN_S = 10.0
SEND_WITHIN_S = 5.0
RETRY_FIRST_S = 1.0
RETRY_LAST_S = 15.0
SETTLED_S = 1.5
"""A UDP port without a listener shows only after something was sent there."""

SCHEMES = ("udp", "udp+broadcast", "tcp", "tls", "ssl")


def check_url(url: str) -> str:
    """Return the URL in pytak's send-only form; DataError where it is invalid.

    Plain ``udp`` would also listen at the same address, and fail where another program does.
    """
    try:
        parsed = urlparse(url)
        host, port = parsed.hostname, parsed.port
    except ValueError as error:
        raise DataError(f"--cot {url}: {error}") from None
    scheme = parsed.scheme.lower().removesuffix("+wo")
    if scheme not in SCHEMES:
        raise DataError(f"--cot {url}: begins with none of {', '.join(f'{s}://' for s in SCHEMES)}")
    if not host or not port:
        raise DataError(f"--cot {url}: host and port are missing, as in {scheme}://HOST:PORT")
    return f"{scheme}+wo://{parsed.netloc.rpartition('@')[2]}"


def default_prefix() -> str:
    """Return a uid prefix that is the same in every session of this computer, and only here."""
    hardware = uuid.getnode()
    # A random number in place of a hardware address has this bit set, and changes.
    name = platform.node() if hardware & (1 << 40) else f"{hardware:012x}"
    return f"relpos-{uuid.uuid5(uuid.NAMESPACE_OID, name).hex[:8]}"


class _Lasting:
    """What is told of members while it lasts, each ``every_s``, and its end a few times."""

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._told: dict[int, tuple[float, int]] = {}
        """When it was told last, and how often its end was."""

    def lasts(self, node: int) -> bool:
        """Return whether it was told, and its end was not."""
        return node in self._told and not self._told[node][1]

    def due(self, node: int, now_s: float, *, lasts: bool) -> bool | None:
        """Return whether what is to be told now is its end; None where nothing is."""
        told_s, ends = self._told.get(node, (-math.inf, 0))
        if lasts and (ends or now_s - told_s >= self._every_s):
            self._told[node] = now_s, 0
            return False
        if lasts or node not in self._told or ends >= ENDS:
            return None
        if ends and now_s - told_s < END_EVERY_S:
            return None
        self._told[node] = now_s, ends + 1
        return True

    def again(self) -> None:
        """Tell everything once more."""
        self._told = {node: (-math.inf, min(ends, 1)) for node, (_, ends) in self._told.items()}


class Schedule:
    """Decides which events are due; its only state is what was sent before."""

    def __init__(self, events: Events) -> None:
        self._events = events
        self._sent_s: dict[int, float] = {}
        self._alarms = _Lasting(ALARM_EVERY_S)
        self._markers = _Lasting(LAST_KNOWN_EVERY_S)
        self._moved: dict[int, Moved] = {}
        self._seen_seq: dict[int, int] = {}

    def again(self) -> None:
        """Tell alarms, markers and their ends once more: a broken connection may have lost them."""
        self._alarms.again()
        self._markers.again()

    def due(
        self,
        view: TeamView,
        frame: MapFrame,
        now_s: float,
        sigma_z_m: Mapping[int, float],
    ) -> Iterator[ET.Element]:
        """Yield the events due at ``now_s``: at most one a second of each member."""
        for person in view.people:
            marker = self._marker(person, view, frame, now_s)
            if marker is not None:
                yield marker
            if now_s - self._sent_s.get(person.node, -EVERY_S) < EVERY_S:
                continue
            event = self._event(person, view, frame, now_s, sigma_z_m.get(person.node))
            if event is not None:
                self._sent_s[person.node] = now_s
                yield event

    def _marker(
        self, person: Person, view: TeamView, frame: MapFrame, now_s: float
    ) -> ET.Element | None:
        """Return the marker of a lost member's place where it is due, or its deletion."""
        if person.status == "lost" and (person.seen_s is None or not is_located(person)):
            return None
        over = self._markers.due(person.node, now_s, lasts=person.status == "lost")
        return None if over is None else self._events.last_known(person, view, frame, over=over)

    def _event(
        self,
        person: Person,
        view: TeamView,
        frame: MapFrame,
        now_s: float,
        sigma_z_m: float | None,
    ) -> ET.Element | None:
        node = person.node
        # A member who lay still and then falls silent has not got up.
        lies = person.alert in (Alert.STILL_ALARM, Alert.FALL, Alert.MAYDAY) or (
            self._alarms.lasts(node) and person.alert is Alert.LOST
        )
        over = self._alarms.due(node, now_s, lasts=lies)
        if over is not None:
            return self._events.emergency(person, view, frame, sigma_z_m=sigma_z_m, over=over)
        if self._seen_seq.get(node) == view.seq:
            return None
        if person.status == "lost" and now_s - self._sent_s.get(node, -1e9) < LOST_EVERY_S:
            return None
        event = self._events.member(
            person, view, frame, sigma_z_m=sigma_z_m, before=self._moved.get(node)
        )
        if event is not None:
            self._seen_seq[node] = view.seq
            if person.motion_s is not None and person.x_m is not None and person.y_m is not None:
                self._moved[node] = Moved(person.motion_s, person.x_m, person.y_m)
        return event


class PinnedFrame:
    """The map frame of a running session; pins on nodes wait until these are located."""

    def __init__(self, pins: Sequence[Pin]) -> None:
        if not pins:
            raise DataError("--cot needs --pin LAT,LON,BEARING to place the team on the map")
        self._pins = pins
        self._pinned_xy: dict[int, tuple[float, float]] = {}
        self.frame: MapFrame | None = None
        self.remarks: tuple[str, ...] = ()
        self.trouble: str | None = None
        if all(pin.node is None for pin in pins):
            self._place()

    def update(self, view: TeamView) -> MapFrame | None:
        """Return the frame once every pin's position is known."""
        if self.frame is not None or self.trouble is not None:
            return self.frame
        people = {p.node: p for p in view.people if p.status == "ok"}
        for k, pin in enumerate(self._pins):
            person = people.get(pin.node) if pin.node is not None else None
            if (
                k not in self._pinned_xy
                and person is not None
                and person.x_m is not None
                and person.y_m is not None
                and (pin.time_s is None or view.time_s >= pin.time_s)
            ):
                self._pinned_xy[k] = person.x_m, person.y_m
        if all(pin.node is None or k in self._pinned_xy for k, pin in enumerate(self._pins)):
            self._place()
        return self.frame

    def waits_for(self) -> str | None:
        """Return which pinned nodes are not located yet; None where the frame is known."""
        if self.trouble is not None or self.frame is not None:
            return self.trouble
        waiting = [
            str(pin.node)
            for k, pin in enumerate(self._pins)
            if pin.node is not None and k not in self._pinned_xy
        ]
        return Said(
            "no-map",
            "no map yet: the pinned node {nodes} is not located",
            nodes=", ".join(waiting),
        )

    def _place(self) -> None:
        pins = [
            replace(pin, place_m=self._pinned_xy.get(k, pin.place_m), node=None, time_s=None)
            for k, pin in enumerate(self._pins)
        ]
        try:
            placing = place(pins, lambda node, time_s: None)
        except DataError as error:
            if not self._pinned_xy:
                raise
            self.trouble = str(error)
            return
        self.frame, self.remarks = placing.frame, placing.remarks


class CotSender(Sink):
    """Sends views as Cursor-on-Target to a TAK server, a multicast group or one screen."""

    def __init__(self, url: str, pins: Sequence[Pin], *, exercise: bool = False) -> None:
        """Begin to connect; DataError or RelposError where that can never succeed."""
        self._shown = url
        self._url = check_url(url)
        self._map = PinnedFrame(pins)
        try:
            with warnings.catch_warnings():
                # pytak warns of a package that only enrolment with a TAK server needs.
                warnings.simplefilter("ignore")
                import pytak  # noqa: F401
        except ImportError:
            raise missing_extra("pytak", "exchange") from None
        # Its loggers write to stderr; trouble() reports errors instead.
        for name in ("pytak.classes", "pytak.client_functions", "pytak"):
            logging.getLogger(name).disabled = True
        self._schedule = Schedule(Events(default_prefix(), exercise))
        self._view: TeamView | None = None
        self._sigma_z_m: dict[int, float] = {}
        self._trouble: str | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cot", daemon=True)
        self._thread.start()

    def estimated(self, estimate: Estimate) -> None:
        """Store the uncertainty of heights, which views do not have."""
        for node in estimate.nodes:
            self._sigma_z_m[node.node] = node.sigma_z_m

    def updated(self, view: TeamView) -> None:
        """Store the newest view for the sender."""
        self._view = view

    def trouble(self) -> str | None:
        """Return why nothing is sent; None when all is well."""
        problem = self._trouble or self._map.waits_for()
        return Said("cot", "Cursor-on-Target: {problem}", problem=problem) if problem else None

    def close(self) -> None:
        """Close the connection."""
        self._stop.set()
        self._thread.join(SEND_WITHIN_S)

    def _run(self) -> None:
        try:
            asyncio.run(self._work())
        except Exception as error:  # the session goes on and shows the trouble
            self._trouble = Said(
                "cot-ended", "{url}: ended: {reason}", url=self._shown, reason=_reason(error)
            )

    async def _work(self) -> None:
        wait_s = RETRY_FIRST_S
        while not self._stop.is_set():
            began_s = time.monotonic()
            try:
                await self._connected()
            except Exception as error:
                # pytak's own exceptions have no common base.
                self._trouble = Said(
                    "cot-again",
                    "{url}: {reason}; trying again",
                    url=self._shown,
                    reason=_reason(error),
                )
            if time.monotonic() - began_s > RETRY_LAST_S:
                wait_s = RETRY_FIRST_S
            until_s = time.monotonic() + wait_s
            while not self._stop.is_set() and time.monotonic() < until_s:
                await asyncio.sleep(TICK_S)
            wait_s = min(2.0 * wait_s, RETRY_LAST_S)

    async def _connected(self) -> None:
        """Send until the connection breaks (raises) or the sink is closed."""
        import pytak

        tls = {key: value for key, value in os.environ.items() if key.startswith("PYTAK_")}
        config: Any = {**tls, "COT_URL": self._url}
        reader, writer = await asyncio.wait_for(pytak.protocol_factory(config), CONNECT_WITHIN_S)
        worker = pytak.TXWorker(asyncio.Queue(), config, writer)
        self._schedule.again()
        drained = asyncio.create_task(_drain(reader)) if reader is not None else None
        began_s = time.monotonic()
        settled_s = 0.0 if drained is not None else SETTLED_S
        try:
            while not self._stop.is_set():
                if drained is not None and drained.done():
                    raise ConnectionError("the server has closed the connection")
                for data in self._due():
                    await asyncio.wait_for(worker.send_data(data), SEND_WITHIN_S)
                if time.monotonic() - began_s >= settled_s:
                    self._trouble = None
                await asyncio.sleep(TICK_S)
        finally:
            if drained is not None:
                drained.cancel()
            writer.close()

    def _due(self) -> list[bytes]:
        view = self._view
        if view is None:
            return []
        frame = self._map.update(view)
        if frame is None:
            return []
        now_s = time.monotonic()
        return [
            serialized(event) for event in self._schedule.due(view, frame, now_s, self._sigma_z_m)
        ]


async def _drain(reader: Any) -> None:
    """Discard what the server sends, so that it goes on receiving; return when it has gone."""
    try:
        while await reader.read(65536):
            pass
    except OSError:
        return


def _reason(error: BaseException) -> str:
    if isinstance(error, TimeoutError):
        return "no answer"
    if isinstance(error, OSError) and error.errno is not None and error.errno > 0:
        # asyncio's own message repeats the address and omits the reason.
        return os.strerror(error.errno)
    return " ".join(str(error).split()) or type(error).__name__
