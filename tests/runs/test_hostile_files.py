"""Somebody else's file: whatever is in it, a line says what is wrong, soon and in little memory."""

import gzip
import io
import json
import os
import subprocess
import sys
import zlib

import pytest

from relpos.errors import DataError
from relpos.runs import load_run, read_estimates

MOTION = "time_s,node,dx_m,dy_m,dtheta_rad\n"
RANGES = "time_s,node,peer,range_m\n"

MOST_S = 10.0
MOST_MB = 512

LOADER = """
import json, resource, sys, time
import relpos.sources
from relpos.errors import RelposError
import relpos.recording.reader  # what is loaded later is no file's memory

def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

for path in sys.argv[1:]:
    before_mb, begun_s, words = peak_mb(), time.monotonic(), None
    try:
        relpos.sources.load(path)
    except RelposError as error:
        words = str(error)
    print(json.dumps([words, time.monotonic() - begun_s, peak_mb() - before_mb]))
"""


def run_with(name, content):
    def write(folder):
        if isinstance(content, bytes):
            (folder / name).write_bytes(content)
        else:
            (folder / name).write_text(content)
        return folder

    return write


def motion(*cells):
    return run_with("motion.csv", MOTION + ",".join(cells) + "\n")


def long_line(folder):
    with (folder / "motion.csv").open("wb") as file:
        file.truncate(2 << 30)
    return folder


def link_to_zero(folder):
    (folder / "motion.csv").symlink_to("/dev/zero")
    return folder


def pipe(folder):
    os.mkfifo(folder / "run.toml")
    return folder


def milliseconds(folder):
    rows = "".join(f"{1000 * k},1,0.7,0,0\n" for k in range(600))
    return motion_rows(folder, rows)


def motion_rows(folder, rows):
    (folder / "motion.csv").write_text(MOTION + rows)
    return folder


def gzip_bomb(folder):
    with gzip.open(folder / "motion.csv.gz", "wb", compresslevel=1) as file:
        for _ in range(600):
            file.write(b"\n" * (1 << 20))
    return folder


def recording(*records):
    def write(folder):
        from mcap.data_stream import RecordBuilder
        from mcap.records import Channel, Header, Schema

        from relpos.recording.container import MAGIC

        builder = RecordBuilder()
        builder.write(MAGIC)
        Header("", "somebody").write(builder)
        Schema(1, b"", "", "").write(builder)
        Channel(1, "/motion", "json", {}, 1).write(builder)
        for record in records:
            record().write(builder)
        path = folder / "some.mcap"
        path.write_bytes(builder.end() + MAGIC)
        return path

    return write


def bomb(unpacked_bytes, said_bytes, compression="zstd"):
    def chunk():
        import zstandard
        from mcap.records import Chunk

        out = io.BytesIO()
        with zstandard.ZstdCompressor().stream_writer(out, closefd=False) as stream:
            for _ in range(unpacked_bytes >> 20):
                stream.write(bytes(1 << 20))
        return Chunk(compression, out.getvalue(), 2, 1, 0, said_bytes)

    return chunk


def message(document):
    def chunk():
        from mcap.data_stream import RecordBuilder
        from mcap.records import Chunk, Message

        builder = RecordBuilder()
        Message(1, 1, document, 1, 0).write(builder)
        raw = builder.end()
        return Chunk("", raw, 2, 1, zlib.crc32(raw), len(raw))

    return chunk


ROW = {"time_s": 1.0, "node": 1, "dx_m": 0.0, "dy_m": 0.0, "dtheta_rad": 0.0}

HOSTILE = {
    "a late time": (motion("1e12", "1", "0", "0", "0"), "time_s: '1e12' is not between"),
    "no time": (motion("1e308", "1", "0", "0", "0"), "time_s: '1e308' is not between"),
    "a way": (motion("1", "1", "1e300", "0", "0"), "dx_m: '1e300' is not between"),
    "a range": (run_with("ranges.csv", RANGES + "1,1,2,1e308\n"), "range_m: '1e308'"),
    "milliseconds": (milliseconds, "look like milliseconds"),
    "lists": (run_with("run.toml", "a = " + "[" * 5000), "nested too deeply"),
    "keys": (run_with("run.toml", "a." * 300_000 + "b = 1"), "nested too deeply"),
    "digits": (run_with("run.toml", "stature_m = " + "9" * 5000), "not TOML"),
    "a large number": (run_with("run.toml", "stature_m = 1" + "0" * 400), "not a finite number"),
    "a giant": (run_with("run.toml", "stature_m = 1e300"), "not between 0 and 10"),
    "a long description": (run_with("run.toml", "#" * (1 << 22)), "more than 1024 kB"),
    "a line of 2 GB": (long_line, "line 1: longer than 64 MB"),
    "/dev/zero": (link_to_zero, "not a regular file"),
    "a pipe": (pipe, "not a regular file"),
    "a gzip bomb": (gzip_bomb, "more than"),
    "a bomb that says so": (recording(bomb(256 << 20, 256 << 20)), None),
    "a bomb that says less": (recording(bomb(256 << 20, 1000)), None),
    "many bombs": (recording(*[bomb(32 << 20, 32 << 20)] * 40), None),
    "a message of a late time": (
        recording(message(json.dumps(ROW | {"time_s": 1e12}).encode())),
        "time_s is 1e+12",
    ),
    "a message of lists": (recording(message(b"[" * 100_000)), "not what it should be"),
    "a message of digits": (
        recording(message(json.dumps(ROW | {"dx_m": 10**400}).encode())),
        "not what it should be",
    ),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """What loading each said, the seconds and the megabytes that it took, in one process."""
    pytest.importorskip("resource", reason="the peak of memory is POSIX's")
    paths = []
    for write, _ in HOSTILE.values():
        paths.append(str(write(tmp_path_factory.mktemp("run"))))
    done = subprocess.run(
        [sys.executable, "-c", LOADER, *paths],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return dict(zip(HOSTILE, map(json.loads, done.stdout.splitlines()), strict=True))


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_line_soon_and_in_little_memory(outcomes, name):
    words, took_s, more_mb = outcomes[name]
    expected = HOSTILE[name][1]
    if expected is None:
        assert words is None, "what is damaged in a recording is left out, and counted"
    else:
        assert expected in words
        assert "\n" not in words
        assert len(words) < 400
    assert took_s < MOST_S
    assert more_mb < MOST_MB


@pytest.mark.parametrize("column", ["x_m", "sigma_major_m", "sigma_heading_rad", "time_s"])
def test_an_estimate_of_absurd_figures_is_one_line(tmp_path, column):
    row = {"time_s": "1", "node": "1", "x_m": "0", "y_m": "0", "sigma_major_m": "1"}
    row |= {"sigma_minor_m": "1", "sigma_angle_rad": "0", "sigma_heading_rad": "1", column: "1e300"}
    (tmp_path / "estimate.csv").write_text(",".join(row) + "\n" + ",".join(row.values()) + "\n")
    with pytest.raises(DataError, match=f"line 2: column {column}: '1e300' is "):
        read_estimates(tmp_path)


@pytest.mark.parametrize("name", ["run.toml", "height.csv", "truth.csv.gz"])
def test_a_link_to_where_nothing_is_is_no_missing_table(tmp_path, name):
    (tmp_path / "motion.csv").write_text(MOTION + "1,1,0.7,0,0\n")
    (tmp_path / name).symlink_to(tmp_path / "taken out" / name)
    with pytest.raises(DataError, match=f"{name}: cannot be read"):
        load_run(tmp_path)
