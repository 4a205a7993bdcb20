"""Foxglove's viewer at a running session: the part of its protocol that it speaks first."""

import base64
import json
import struct
import time

import pytest
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from sessions import START_NS, about, play, session
from websockets.sync.client import connect

from relpos.cli.live import with_default_address
from relpos.errors import DataError, DeviceError
from relpos.live.team_view import Level, Notice, TeamView
from relpos.recording import serve_foxglove
from relpos.recording.schemas import all_topics

PATIENCE_S = 200.0


class Viewer:
    """Subscribes to everything that is advertised, and decodes what comes."""

    def __init__(self, socket):
        self.socket = socket
        self.channels = {}
        self.messages = []
        self.topics = set()
        """Of the messages; to look through all of them after each takes seconds."""

    def update_without_link(self):
        """Take in one message of the server's; False where none comes soon."""
        try:
            data = self.socket.recv(timeout=0.2)
        except TimeoutError:
            return False
        if isinstance(data, str):
            document = json.loads(data)
            if document["op"] == "advertise":
                self.subscribe(document["channels"])
        elif data[0] == 1:
            number, time_ns = struct.unpack_from("<IQ", data, 1)
            self.messages.append((self.channels[number], time_ns, data[13:]))
            self.topics.add(self.channels[number]["topic"])
        return True

    def subscribe(self, channels):
        self.channels |= {channel["id"]: channel for channel in channels}
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def decoded(self, topic):
        for channel, time_ns, data in self.messages:
            if channel["topic"] == topic:
                yield time_ns, decode(channel, data)

    def until(self, condition):
        until_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < until_s, "waited in vain"
            self.update_without_link()


def decode(channel, data):
    if channel["encoding"] == "json":
        return json.loads(data)
    # As Foxglove does: by the schema that the server has sent.
    schema = Schema(1, base64.b64decode(channel["schema"]), "protobuf", channel["schemaName"])
    return DecoderFactory().decoder_for("protobuf", schema)(data)


@pytest.fixture
def server():
    made = serve_foxglove("127.0.0.1:0", about())
    yield made
    made.close()


@pytest.fixture
def viewer(server):
    with connect(
        server.address, subprotocols=["foxglove.sdk.v1"], max_size=None, ping_interval=None
    ) as socket:
        yield Viewer(socket)


def test_a_viewer_sees_the_session_under_the_topics_of_a_recording(server, viewer):
    viewer.until(lambda: len(viewer.channels) == len(all_topics()))
    assert {c["topic"] for c in viewer.channels.values()} == {t.name for t in all_topics()}
    steps = session()[-60:]
    assert any(step[3] for step in steps), "no estimate"
    server.named({1: "Ada"})

    def shown():
        # A subscription takes a moment to count: what a viewer is shown goes on and on.
        play(server, steps)
        return "/team" in viewer.topics

    viewer.until(shown)
    server.updated(TeamView(1, 0.0, 0.0, notices=(Notice("n", Level.ALARM, "gone", 0.0),)))
    viewer.until(lambda: viewer.topics >= {"/serial", "/motion", "/estimate", "/tf", "/log"})
    drawn = {e.id: e for _, update in viewer.decoded("/team") for e in update.entities}
    assert drawn["node 1"].texts[0].text.startswith("Ada")
    assert any(line.message == "gone" for _, line in viewer.decoded("/log"))
    time_ns, serial = next(iter(viewer.decoded("/serial")))
    assert time_ns == START_NS + round(serial["arrival_s"] * 1e9)
    assert server.trouble() is None


def test_it_serves_without_anybody_looking(server):
    play(server, session())
    assert server.trouble() is None


def test_a_taken_port_is_one_clear_line(server):
    address = server.address.removeprefix("ws://")
    with pytest.raises(DeviceError, match="cannot serve Foxglove there") as error:
        serve_foxglove(address, about())
    assert "\n" not in str(error.value)
    with pytest.raises(DataError, match="not HOST:PORT"):
        serve_foxglove("nowhere", about())


@pytest.mark.parametrize(
    ("given", "full"),
    [
        (["P", "--foxglove"], ["P", "--foxglove", "127.0.0.1:8765"]),
        (["--foxglove", "P"], ["--foxglove", "127.0.0.1:8765", "P"]),
        (["P", "--foxglove", "0.0.0.0:1"], ["P", "--foxglove", "0.0.0.0:1"]),
        (["P", "--foxglove", "--json"], ["P", "--foxglove", "127.0.0.1:8765", "--json"]),
        (["--foxglove", "socket://h:5"], ["--foxglove", "127.0.0.1:8765", "socket://h:5"]),
    ],
)
def test_the_address_may_be_left_out(given, full):
    assert with_default_address(given) == full
