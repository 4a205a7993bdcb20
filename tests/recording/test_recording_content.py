"""What is in a recording: for relpos, and for a reader that knows nothing of relpos."""

import dataclasses
import json
import math
import re
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from sessions import START_NS, about, alike, play, serial_bytes, session

from relpos.errors import DataError
from relpos.link import xbee
from relpos.link.port import Link
from relpos.live.team_view import Level, Notice, TeamView
from relpos.measurements import Event, Heading, Motion, Range, Truth
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.protocol.messages import DEFAULT_KEY, PROTOCOL_VERSION
from relpos.recording import is_recording, make_recorder, open_recording, save_recording
from relpos.recording.moments import Moments
from relpos.recording.replay import Replay
from relpos.recording.schemas import all_topics
from relpos.runs import Description, NodeInfo, Run, load_run, save_run
from relpos.runs.landmarks import Landmark
from relpos.sources import load


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A session with a press, a phone's heading, names and a notice in the middle."""
    path = tmp_path_factory.mktemp("content") / "walk.mcap"
    names = {1: "Ada Lovelace"}
    recorder = make_recorder(
        path,
        about(
            settings={"outliers": "0.03"},
            seed=7,
            initial="common",
            newest_counters={1: 5},
            description=Description(nodes={2: NodeInfo(name="Grace", height_m=1.1)}),
        ),
    )
    steps = session()
    middle = len(steps) // 2
    play(recorder, steps[:middle])
    at_s = steps[middle][0]
    recorder.observed(at_s, [Event(at_s - 3.25, 2, "landmark", "17")])
    recorder.observed(at_s, [Heading(at_s - 0.5, 2, 1.5, 0.3, "phone")])
    recorder.named(names)
    recorder.updated(
        TeamView(1, at_s, 0.0, notices=(Notice("port", Level.ALARM, "the port vanished", at_s),))
    )
    play(recorder, steps[middle:])
    recorder.close()
    assert recorder.trouble() is None
    return path


def messages(path, **options):
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=(DecoderFactory(), Json()))
        return [
            (m.channel.topic, m.schema, m.message, m.decoded_message)
            for m in reader.iter_decoded_messages(**options)
        ]


class Json:
    """The library's JSON decoder is as simple."""

    def decoder_for(self, message_encoding, schema):
        return json.loads if message_encoding == "json" else None


def test_foxglove_s_reader_decodes_every_topic(recorded):
    found = messages(recorded)
    topics = {topic for topic, *_ in found}
    # Whether steps are reported, something is learned or ambiguous is the walk's affair.
    may = {"/truth", "/landmark", "/gap", "/step", "/parameters", "/alternatives"}
    assert topics >= {topic.name for topic in all_topics()} - may
    for topic, schema, message, decoded in found:
        if message is not None and schema.encoding == "jsonschema":
            conforms(decoded, json.loads(schema.data), topic)


def conforms(value, schema, where):
    """What our schemas use of JSON Schema."""
    kinds = {"number": (int, float), "integer": int, "string": str, "boolean": bool,
             "array": list, "object": dict}  # fmt: skip
    assert isinstance(value, kinds[schema["type"]]), where
    if schema["type"] == "object":
        assert set(schema["required"]) <= set(value) <= set(schema["properties"]), where
        for name, inner in value.items():
            conforms(inner, schema["properties"][name], f"{where}.{name}")
    if schema["type"] == "array":
        for inner in value:
            conforms(inner, schema["items"], where)


def test_the_team_is_drawn_where_it_was_estimated(recorded):
    last = [e for *_, estimates in session() for e in estimates][-1]
    update = [d for topic, _, _, d in messages(recorded) if topic == "/team"][-1]
    frames = [d for topic, _, _, d in messages(recorded) if topic == "/tf"][-1]
    drawn = {entity.id: entity for entity in update.entities}
    assert {f"node {n.node}" for n in last.nodes} <= drawn.keys()
    assert drawn["node 1"].texts[0].text.startswith("Ada Lovelace")
    assert drawn["node 2"].texts[0].text.startswith("Grace")
    for node in last.nodes:
        ellipse = drawn[f"node {node.node}"].cylinders[0]
        assert ellipse.pose.position.x == pytest.approx(node.x_m, abs=0.01)
        # Half the long axis of the ellipse that holds 90 %: 2.146 sigmas.
        assert ellipse.size.x / 2 == pytest.approx(2.146 * node.sigma_major_m, abs=0.01)
        (frame,) = (t for t in frames.transforms if t.child_frame_id == f"node {node.node}")
        assert frame.translation.y == pytest.approx(node.y_m, abs=0.01)
        heading = 2 * math.atan2(frame.rotation.z, frame.rotation.w)
        assert math.remainder(heading - node.heading_rad, 2 * math.pi) == pytest.approx(0, abs=1e-9)


def test_messages_have_their_arrival_time_and_their_measurement_time(recorded):
    found = messages(recorded)
    assert {topic for topic, *_ in found} >= {"/serial", "/event"}
    for topic, _, message, decoded in found:
        if topic == "/serial":
            assert message.log_time == START_NS + round(decoded["arrival_s"] * 1e9)
        if topic == "/event":
            assert message.publish_time == START_NS + round(decoded["time_s"] * 1e9)
            assert message.log_time - message.publish_time == pytest.approx(3.25e9, abs=2)


def test_notices_are_in_the_log(recorded):
    lines = [d.message for topic, _, _, d in messages(recorded) if topic == "/log"]
    assert "the port vanished" in lines


def test_received_bytes_and_measurements_come_back_exactly_and_in_order(recorded):
    recording = open_recording(recorded)
    steps = session()
    middle = len(steps) // 2
    decoded = [[o for step in part for o in step[2]] for part in (steps[:middle], steps[middle:])]
    at_s = steps[middle][0]
    phone = [Event(at_s - 3.25, 2, "landmark", "17"), Heading(at_s - 0.5, 2, 1.5, 0.3, "phone")]
    assert list(recording.observations()) == [*decoded[0], *phone, *decoded[1]]
    assert Replay(recording, None).observations() == (*decoded[0], *phone, *decoded[1])
    given = [e for *_, estimates in steps for e in estimates]
    assert alike(list(recording.estimates()), given)
    assert recording.closed
    assert recording.remarks == ()


def test_the_bytes_through_the_link_give_the_same_once_more(recorded):
    recording = open_recording(recorded)
    # Counters up to 5 of node 1 had been seen before; this session does not know.
    recording.about = dataclasses.replace(recording.about, newest_counters={})
    again = Replay(recording, DEFAULT_KEY)
    assert again.observations() == tuple(recording.observations())
    assert again.counters()["received"] > 100


def test_a_recording_describes_the_session_without_the_key(recorded):
    about = open_recording(recorded).about
    assert (about.started_unix_ns, about.seed, about.initial) == (START_NS, 7, "common")
    assert about.settings == {"outliers": "0.03"}
    assert about.newest_counters == {1: 5}
    assert about.protocol == PROTOCOL_VERSION
    nodes = about.description.nodes
    assert {node: info.name for node, info in nodes.items()} == {1: "Ada Lovelace", 2: "Grace"}
    assert nodes[2].height_m == 1.1
    assert DEFAULT_KEY not in recorded.read_bytes()
    assert DEFAULT_KEY.hex().encode() not in recorded.read_bytes()


def test_a_recording_is_a_run_like_the_directory_of_the_same_session(recorded, tmp_path):
    run = load(recorded)
    save_run(run, tmp_path / "run")
    directory = load_run(tmp_path / "run")
    assert is_recording(recorded)
    assert run.motions
    for name in ("measurements", "events", "statuses", "steps", "truth", "description"):
        ours, theirs = getattr(run, name), getattr(directory, name)
        if name == "description":
            theirs = dataclasses.replace(theirs, name=ours.name)
        assert ours == theirs, name


def test_a_run_with_truth_becomes_a_recording_and_a_run_again(tmp_path):
    run = Run(
        "corridor",
        Description(name="corridor", heading_known=True),
        measurements=(Motion(1.0, 1, 0.5, 0.0, 0.1, gain_version=3, moving=True),),
        landmarks=(Landmark("17", 1.0, 2.0),),
        truth=(Truth(0.0, 1, 0.0, 0.0, 0.5), Truth(1.0, 1, 0.5, 0.0)),
    )
    assert save_recording(tmp_path / "a.mcap", run, started_unix_ns=START_NS) == []
    again = load(tmp_path / "a.mcap")
    assert dataclasses.replace(again, directory=None) == run
    assert open_recording(tmp_path / "a.mcap").started_unix_ns == START_NS
    with pytest.raises(DataError, match="exists already"):
        save_recording(tmp_path / "a.mcap", run)


def test_a_recording_is_not_overwritten(recorded):
    before = recorded.read_bytes()
    with pytest.raises(DataError, match="exists already: a recording is not overwritten"):
        make_recorder(recorded, about())
    assert recorded.read_bytes() == before


def test_a_file_that_is_no_recording_is_one_clear_line(tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(b"time_s,node\n0.1,3\n")
    with pytest.raises(DataError, match=r"x\.mcap: no MCAP file$"):
        open_recording(path)
    path.unlink()
    with pytest.raises(DataError, match="no such run directory"):
        load(path)


def test_the_decoded_measurements_are_used_without_the_key_with_a_remark(tmp_path):
    key = bytes(range(16))
    path = tmp_path / "secret.mcap"
    recorder = make_recorder(path, about(own_key=True))
    link = Link(key=key)
    for arrival_s, data in serial_bytes(2, 15.0, 1, key):
        recorder.received(arrival_s, data)
        recorder.observed(arrival_s, link.feed(data, arrival_s))
    recorder.close()
    recording = open_recording(path)
    without, with_key = Replay(recording, None), Replay(recording, key)
    assert "key of its own (--key-file)" in without.remarks[0]
    assert with_key.remarks == ()
    assert with_key.observations() == without.observations() != ()
    with pytest.raises(DataError, match="recorded under another key"):
        Replay(recording, DEFAULT_KEY).observations()
    assert key not in path.read_bytes()


def test_the_lines_of_python_in_the_page_read_it(recorded, tmp_path, monkeypatch, capsys):
    page = Path(__file__).parents[2] / "docs" / "recording.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    (tmp_path / "walk.mcap").write_bytes(recorded.read_bytes())
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(page), "exec"), {})
    output = capsys.readouterr().out
    ranges = [o for *_, found, _ in session() for o in found if isinstance(o, Range)]
    assert "mean" in output
    assert str(min((o.node, o.peer) for o in ranges)[0]) in output


def test_of_a_session_that_went_on_what_was_decoded_counts_and_no_way_before_it(tmp_path):
    """Its bytes have totals since the nodes' start, of which the session before knew most."""
    values = dict.fromkeys(wire.MOTION.field, 0) | {"time_s": 300.0, "x_m": 50.25}
    frame = framing.encode(wire.MOTION, 1, 0, 9, values)
    recorder = make_recorder(tmp_path / "later.mcap", about(resumed=True))
    recorder.received(300.0, xbee.encode(xbee.Receive16(1, -40, frame)))
    motion = Motion(300.0, 1, 0.25, 0.0, 0.0)
    recorder.observed(300.0, [motion])
    recorder.close()
    replay = Replay(open_recording(tmp_path / "later.mcap"), DEFAULT_KEY)
    assert replay.observations() == (motion,)
    assert "went on from one before" in replay.remarks[0]


def test_a_session_of_more_than_a_week_is_read_up_to_there_and_says_so(tmp_path):
    path = tmp_path / "week.mcap"
    recorder = make_recorder(path, about())
    week_s = 604_800.0
    for at_s in (1.0, week_s - 1.0, week_s + 1.0, week_s + 86_400.0):
        recorder.received(at_s, b"bytes")
        recorder.observed(at_s, [Motion(at_s, 1, 0.5, 0.0, 0.0)])
    # A node's clock may be a moment ahead of what arrived.
    recorder.observed(week_s - 0.1, [Event(week_s + 0.1, 1, "landmark", "17")])
    recorder.close()
    recording = open_recording(path)
    assert [m.time_s for m in recording.run.measurements] == [1.0, week_s - 1.0]
    assert [at_s for at_s, _ in recording.inputs()] == [1.0, week_s - 1.0]
    assert [at_s for at_s, _ in recording.observations_by_arrival()] == [1.0, week_s - 1.0]
    (remark,) = recording.remarks
    assert "lasted 8.0 days" in remark
    moments = Moments([path])
    assert moments.to_s == week_s
    assert [row.time_s for _, row in moments.rows(0.0, 2 * week_s, Motion)] == [1.0, week_s - 1.0]


def test_a_time_beyond_the_week_within_a_shorter_session_is_damage(tmp_path):
    path = tmp_path / "odd.mcap"
    recorder = make_recorder(path, about())
    recorder.observed(1.0, [Motion(700_000.0, 1, 0.5, 0.0, 0.0)])
    recorder.close()
    with pytest.raises(DataError, match="not what it should be"):
        _ = open_recording(path).run
