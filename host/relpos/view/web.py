"""The live page, as the session sees it: a sink that feeds a serving process, and its visitors.

The serving process cannot hold up the session: what it does not take at once waits here, of the
views the newest alone. Where it dies, it is started again behind the same listener.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import socket
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from relpos.errors import interrupts_kept
from relpos.fusion.estimator import NodeStatus
from relpos.live.board import Board
from relpos.live.requests import Request
from relpos.live.sinks import Sink
from relpos.live.team_view import MAX_LOG, Hello, LogEntry, TeamView, to_json
from relpos.live.tracks import Tracks
from relpos.said import Said
from relpos.view.access import Access, check_libraries
from relpos.view.process import serve

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

    from relpos.fusion.estimator import Estimate

RESTART_AFTER_S = 1.0
MAX_WAITING_BYTES = 1 << 24
"""A serving process that leaves so much unread is stuck, and started again."""
SHOWN_STATUSES = (NodeStatus.OK, NodeStatus.STALE)
"""Only what is believed leaves a track."""


class WebView(Sink):
    """Serves the session's pages at ``access`` from the listening socket ``listener``.

    RelposError where the libraries for it are not installed.
    """

    def __init__(self, listener: socket.socket, access: Access, hello: Hello) -> None:
        check_libraries()
        self.access = access
        self.hello = hello
        self.restarts = 0
        self._door = listener
        self._tracks = Tracks()
        self._names: dict[int, str] = {}
        self._kept = {"board": to_json(Board().to_message())}
        """The newest message of each of these kinds."""
        self._devices: list[dict[str, Any]] = []
        self._log: deque[dict[str, Any]] = deque(maxlen=MAX_LOG)
        self._newest: bytes | None = None
        self._out: deque[bytes] = deque()
        self._out_bytes = 0
        self._in = b""
        self._process: SpawnProcess | None = None
        self._channel: socket.socket | None = None
        self._started_s = 0.0
        self._start()

    # -- as a sink --------------------------------------------------------------------------------

    def estimated(self, estimate: Estimate) -> None:
        """Lengthen the tracks."""
        points = {
            str(n.node): (round(estimate.time_s, 2), round(n.x_m, 2), round(n.y_m, 2))
            for n in estimate.nodes
            if n.status in SHOWN_STATUSES
            and self._tracks.add(n.node, estimate.time_s, n.x_m, n.y_m)
        }
        if points:
            self._say(to_json({"type": "points", "points": points}))

    def updated(self, view: TeamView) -> None:
        """Send it on, or keep it until the one before has left."""
        self._newest = view.to_json().encode() + b"\n"
        self._work()

    def logged(self, entry: LogEntry) -> None:
        """Send it to the pages, which show the log."""
        self._log.append(asdict(entry))
        self._say(to_json({"type": "log", "entries": [self._log[-1]]}))

    def admitted(self, event: dict[str, Any]) -> None:
        """Tell the server of a device that was let in or shut out."""
        self._devices.append(event)
        self._say(to_json({"type": "device", "event": event}))

    def boarded(self, board: dict[str, Any]) -> None:
        """Send the board to the pages."""
        self._keep("board", to_json(board))

    def timed(self, timeline: dict[str, Any]) -> None:
        """Send the time line to the pages."""
        self._keep("timeline", to_json(timeline))

    def smoothed(self, tracks: Tracks) -> None:
        """Send the smoothed tracks to the pages."""
        self._keep("smoothed", tracks.to_json("smoothed"))

    def _keep(self, kind: str, line: str) -> None:
        self._kept[kind] = line
        self._say(line)

    def resumed(self, tracks: Tracks) -> None:
        """Go on with the tracks of the sessions before."""
        self._tracks = tracks
        self._say(tracks.to_json())

    def trouble(self) -> str | None:
        """Return that the server was restarted, for half a minute."""
        if self.restarts and time.monotonic() - self._started_s < 30.0:
            return Said("page-failed", "the page's server failed and was restarted")
        return None

    def close(self) -> None:
        """Let browsers know that it is over."""
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.setblocking(True)
            channel.settimeout(1.0)
            with contextlib.suppress(OSError):
                channel.sendall(b"".join(self._out) + (self._newest or b""))
            channel.close()
        if self._process is not None:
            self._process.join(3.0)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
        self._door.close()

    # -- requests ---------------------------------------------------------------------------------

    def requests(self) -> Sequence[Request]:
        """What browsers and phones have asked for since the last call."""
        self._work()
        *lines, self._in = self._in.split(b"\n")
        asks = []
        for line in lines:
            request = json.loads(line)
            asks.append(Request(request["id"], request["kind"], request["unix_s"], request["body"]))
        return asks

    def respond(self, request: Request, reply: dict[str, Any], status: int = 200) -> None:
        """Answer one of them."""
        self._say(to_json({"type": "answer", "id": request.id, "reply": reply, "status": status}))

    def named(self, names: dict[int, str]) -> None:
        """Send the names that phones have given to nodes."""
        self._names = dict(names)
        self._say(_names_message(self._names))

    # -- the serving process ----------------------------------------------------------------------

    def _start(self) -> None:
        if self._channel is not None:
            self._channel.close()
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self._started_s = time.monotonic()
        self._process = multiprocessing.get_context("spawn").Process(
            target=serve,
            args=(self._door, theirs, self.access),
            name="relpos view",
            daemon=True,
        )
        with interrupts_kept():
            self._process.start()
        theirs.close()
        self._channel = ours
        self._in = b""
        self._out.clear()
        self._out_bytes = 0
        log = to_json({"type": "log", "entries": list(self._log)})
        for line in (
            self.hello.to_json(),
            self._tracks.to_json(),
            _names_message(self._names),
            log,
            *self._kept.values(),
            *(to_json({"type": "device", "event": event}) for event in self._devices),
        ):
            self._say(line)

    def _say(self, line: str) -> None:
        data = line.encode() + b"\n"
        self._out.append(data)
        self._out_bytes += len(data)
        self._work()

    def _work(self) -> None:
        """Move what can be moved without waiting; start anew what has died."""
        if self._channel is None:
            return
        try:
            self._send()
            self._receive()
            stuck = self._out_bytes > MAX_WAITING_BYTES
        except OSError:
            stuck = True
        if stuck and time.monotonic() > self._started_s + RESTART_AFTER_S:
            if self._process is not None:
                self._process.kill()
                self._process.join()
            self.restarts += 1
            self._start()

    def _send(self) -> None:
        assert self._channel is not None
        while self._out or self._newest is not None:
            if not self._out and self._newest is not None:
                self._out.append(self._newest)
                self._out_bytes += len(self._newest)
                self._newest = None
            data = self._out.popleft()
            try:
                sent = self._channel.send(data)
            except BlockingIOError:
                sent = 0
            self._out_bytes -= sent
            if sent < len(data):
                self._out.appendleft(data[sent:])
                return

    def _receive(self) -> None:
        assert self._channel is not None
        while True:
            try:
                data = self._channel.recv(65536)
            except BlockingIOError:
                return
            if not data:
                raise ConnectionResetError
            self._in += data


def _names_message(names: dict[int, str]) -> str:
    return to_json({"type": "names", "names": {str(node): name for node, name in names.items()}})
