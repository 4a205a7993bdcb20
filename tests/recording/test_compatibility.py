"""What earlier versions sent and recorded: named where it is not understood, never misread.

The frames are golden ones of wire versions 1 and 2. ``tests/golden/VERSION.mcap.xz`` was recorded
by that version, two emulated nodes for a dozen seconds; the digests are those of the files that it
wrote beside it. A release adds its own.
"""

import hashlib
import lzma
from pathlib import Path

import pytest

from relpos.link.decoder import Decoder
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.recording import open_recording
from relpos.recording.replay import Replay
from relpos.runs import save_run
from support.command import relpos

GOLDEN = Path(__file__).parents[1] / "golden"
OLD_FRAMES = {
    1: {
        6: "b501010603ffff74cc0500c7cfffff591b0000d134fbffeabb0400d20187d6120020a1070087d6120039"
        "300000bffe49850207416996",
        2: "b5010202010301a00f00000501411f00b178000003010000805a000104400d037f3c000205000001ffff"
        "ff03fee20400a6000000064c",
        4: "b5010304093412f45d26050001008051010003800e0200caa841013d220100ea00050006000700f648",
        255: "b50110ff000c00010204ffffffff762a",
    },
    2: {
        6: "b502010603ffffffff74cc0500c7cfffff591b0000d134fbffeabb0400d20187d6120020a1070087d612"
        "0039300000bffe4985020741e49535db8567274d41d1",
        2: "b50202020103010000a00f00000501411f00b178000003010000805a000104400d037f3c000205000001"
        "ffffff03fee20400a6000000e1b56b28d3d182ad8e07",
        4: "b50203040934120000f45d26050001008051010003800e0200caa841013d220100ea00050006000700ff"
        "ffb5ff05061f2df5bffef658d320b987",
        255: "b50210ff000c000000010204ffffffff3445e35f970e5b9f1872",
    },
}
RECORDED = {
    "0.2.0": {
        "heading.csv": "c4eeac46fde1f8e60dc55f2140b4f5cc3bdf0e7fd0aee361963aebad06423bb3",
        "height.csv": "a72c699192f933a269674650045cc872d84e233a169e41189094bfe20cd466a3",
        "motion.csv": "7bf0308176e2ef76d989eed00ece82f5cab9beb9aad87e7ba64ec926f4596a45",
        "ranges.csv": "789e2de9098cce813ce41be8094c0ee217bf70bb27ef19eaab28f8fb48a98d8e",
        "status.csv": "abe17bb2026d3566eaa68a1d432e0a2990f5cdcfc2428f9552335c91a3e1768a",
    }
}
LATER_COLUMNS = {"motion.csv": 1}
"""Columns at the end that no recorded version wrote."""


@pytest.mark.parametrize("version", OLD_FRAMES)
def test_a_node_of_an_earlier_wire_version_is_named_and_changes_nothing(version):
    decoder = Decoder()
    for node, frame in OLD_FRAMES[version].items():
        for _ in range(3):
            assert decoder.feed(bytes.fromhex(frame), 1.0, -50) == []
        assert decoder.remarks[-1].startswith(f"node {node} speaks protocol version {version}, ")
    assert len(decoder.remarks) == len(OLD_FRAMES[version])
    assert decoder.nodes == {}
    assert decoder.counts == {"ForeignVersionError": 3 * len(OLD_FRAMES[version])}


def test_a_host_of_an_earlier_version_finds_what_it_needs_to_name_this_one():
    """Versions 1 and 2 look at the magic, then at the version, and take the fourth byte's node."""
    for node in (1, 77, 254):
        frame = framing.encode(
            wire.MOTION, node, 0, 1 << 31, dict.fromkeys(wire.MOTION.field, 0), bytes(range(16))
        )
        assert (frame[0], frame[1], frame[3]) == (0xB5, wire.PROTOCOL_VERSION, node)
        assert wire.PROTOCOL_VERSION not in OLD_FRAMES


@pytest.fixture(params=RECORDED)
def recorded(request, tmp_path):
    path = tmp_path / f"{request.param}.mcap"
    path.write_bytes(lzma.decompress((GOLDEN / f"{request.param}.mcap.xz").read_bytes()))
    return request.param, path


def test_a_recording_of_an_earlier_version_gives_the_measurements_of_then_to_the_byte(
    recorded, tmp_path
):
    version, path = recorded
    replay = Replay(open_recording(path), wire.DEFAULT_KEY)
    (remark,) = replay.remarks
    assert f"recorded by relpos {version} under protocol version 2" in remark
    save_run(replay.recording.run_of(replay.observations()), tmp_path / "run")
    for name, digest in RECORDED[version].items():
        rows = (tmp_path / "run" / name).read_bytes().splitlines()
        later = LATER_COLUMNS.get(name, 0)
        then = [row.rsplit(b",", later)[0] if later else row for row in rows]
        assert hashlib.sha256(b"".join(row + b"\n" for row in then)).hexdigest() == digest, name


def test_a_recording_of_an_earlier_version_is_fused(recorded, tmp_path):
    version, path = recorded
    done = relpos("fuse", path, "--initial", "common", "--no-report", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert f"recorded by relpos {version}" in done.stderr
    assert len((tmp_path / "out" / "estimate.csv").read_text().splitlines()) > 20
