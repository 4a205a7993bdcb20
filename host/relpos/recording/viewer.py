"""A running session in Foxglove's own viewer: the topics of a recording, over its WebSocket."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from threading import Event, Thread

from relpos.errors import DataError, DeviceError
from relpos.live.addresses import parse_listen
from relpos.recording.about import About
from relpos.recording.encoder import Encoder, Item, ItemSink
from relpos.recording.schemas import all_topics
from relpos.said import Said

TICK_S = 0.05
MOST_WAITING = 2000
"""Items; beyond it the oldest go. A viewer shows what is now."""


class FoxgloveServer(ItemSink):
    """A sink of the live session that Foxglove connects to. DeviceError where it cannot listen."""

    def __init__(self, listen: str, about: About) -> None:
        import foxglove

        super().__init__()
        host, port = parse_listen(listen, "--foxglove")
        if port is None:
            raise DataError(f"--foxglove {listen}: not HOST:PORT")
        self._encoder = Encoder(about.started_unix_ns, about.description.names)
        self._context = foxglove.Context()
        self._channels = {
            topic.name: foxglove.Channel(
                topic.name,
                message_encoding=topic.encoding,
                schema=foxglove.Schema(
                    name=topic.schema_name, encoding=topic.schema_encoding, data=topic.schema
                ),
                context=self._context,
            )
            for topic in all_topics()
        }
        try:
            self._server = foxglove.start_server(
                name=f"relpos {about.source}",
                host=host,
                port=port,
                context=self._context,
                session_id=str(about.started_unix_ns),
            )
        except Exception as error:
            raise DeviceError(f"{host}:{port}: cannot serve Foxglove there: {error}") from None
        self.address = f"ws://{host}:{self._server.port}"
        self._queue: deque[tuple[float, Item]] = deque(maxlen=MOST_WAITING)
        self._stop = Event()
        self._thread = Thread(target=self._run, name="foxglove", daemon=True)
        self._thread.start()

    def named(self, names: Mapping[int, str]) -> None:
        """Use the names of the wearers from now on."""
        self._encoder.rename(names)

    def _put(self, at_s: float, item: Item) -> None:
        self._queue.append((at_s, item))

    def close(self) -> None:
        """Send what waits and stop listening."""
        self._stop.set()
        self._thread.join()
        self._server.stop()

    def _run(self) -> None:
        stopping = False
        while not stopping:
            stopping = self._stop.wait(TICK_S)
            try:
                while self._queue:
                    self._send(*self._queue.popleft())
            except Exception as error:
                # A fault of ours must neither end the session nor go unseen.
                self._trouble = Said(
                    "foxglove", "Foxglove is not served any more: {error}", error=repr(error)
                )
                return

    def _send(self, at_s: float, item: Item) -> None:
        for message in self._encoder.messages(at_s, item):
            self._channels[message.topic].log(message.data, log_time=message.log_ns)
