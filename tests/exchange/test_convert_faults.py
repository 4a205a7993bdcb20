"""``relpos convert`` where the request, the output folder or the disk is not as it should be."""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from relpos.errors import DataError, words_of
from relpos.evaluation import report
from relpos.exchange import tables
from relpos.exchange.content import Content
from relpos.exchange.times import LATEST_UNIX_S, unix_of
from relpos.files import write_output
from relpos.live.log_files import log_row, write_kml
from relpos.live.team_view import LogEntry
from relpos.runs.appending import write_rows
from relpos.runs.log import LOG_COLUMNS
from support.small_team import convert, refused, run, written

PIN = "48.137,11.575,60,520"
START = "2026-05-04T09:30:00Z"


@pytest.mark.parametrize("form", ["gpx", "geojson", "mcap", "rosbag2", "csv"])
@pytest.mark.parametrize(
    ("start", "words"),
    [
        ("1777887000000", "looks like milliseconds; Unix time is in seconds: write 1777887000.000"),
        ("1777887000000000000", "looks like nanoseconds"),
        ("-5", "is not between 1970-01-01"),
        ("1e300", "is not between 1970-01-01"),
        ("1969-12-31T23:59:59Z", "is not between 1970-01-01"),
        ("2040-01-01T00:00:00Z", "is not between 1970-01-01"),
    ],
)
def test_an_impossible_start_is_refused_in_one_line_and_nothing_is_written(
    tmp_path: Path, form: str, start: str, words: str
) -> None:
    yard, _ = written(tmp_path)
    out = tmp_path / f"out.{form}"
    line = refused(yard, "--pin", PIN, "--start", start, "--to", form, "--out", out)
    assert line.startswith("relpos: --start: ")
    assert words in line
    assert not out.exists()


def test_the_first_and_the_last_possible_start_are_taken_by_every_format(tmp_path: Path) -> None:
    yard, _ = written(tmp_path)
    for start in (0.0, LATEST_UNIX_S):
        for form in ("gpx", "geojson", "mcap", "rosbag2", "csv"):
            out = tmp_path / f"{start}.{form}"
            convert(yard, "--pin", PIN, "--start", start, "--to", form, "--out", out)
    convert(tmp_path / "0.0.mcap", "--to", "run", "--out", tmp_path / "back")
    with pytest.raises(DataError):
        unix_of(str(LATEST_UNIX_S + 1.0), "--start")


def test_a_start_that_a_gpx_file_has_by_mistake_is_refused_and_may_be_replaced(
    tmp_path: Path,
) -> None:
    source = tmp_path / "watch.gpx"
    source.write_text(
        '<?xml version="1.0"?><gpx version="1.1" creator="watch" '
        'xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
        '<trkpt lat="48.137" lon="11.575"><time>1930-05-04T09:30:00Z</time></trkpt>'
        '<trkpt lat="48.137" lon="11.575"><time>1930-05-04T09:30:01Z</time></trkpt>'
        "</trkseg></trk></gpx>"
    )
    out = tmp_path / "walk.mcap"
    options = ("--as", "truth", "--node", 2, "--pin", PIN, "--to", "mcap", "--out", out)
    line = refused(source, *options)
    assert "--start" in line
    assert "'1930-05-04T09:30:00.000Z' is not between 1970-01-01" in line
    assert not out.exists()


@pytest.mark.parametrize(
    "theirs",
    [
        b'who,what\n1,2,3\n"a"\n',
        b"node,time_s\nL\xfctzow,1\n",
        b"time_s,node,note\n1.0,2,mine\n",
        b"",
    ],
    ids=["ragged", "latin-1", "as-ours", "empty"],
)
def test_csv_files_of_others_in_the_output_folder_are_left_as_they_are(
    tmp_path: Path, theirs: bytes
) -> None:
    yard, fused = written(tmp_path)
    out = tmp_path / "out"
    convert(fused, "--run", yard, "--to", "csv", "--out", out)
    expected = {path.name: path.read_bytes() for path in out.iterdir()}
    (out / "zz_notes.csv").write_bytes(theirs)
    for options in ((), ("--start", START), ()):
        words = ("--run", yard, "--to", "csv", "--out", out, *options, "--overwrite")
        result = convert(fused, *words)
        assert (out / "zz_notes.csv").read_bytes() == theirs
        assert out / "zz_notes.csv" not in result.files
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.name != "zz_notes.csv"} == expected


def test_a_table_to_which_no_column_is_added_keeps_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "temperature.csv"
    path.write_text("time_s,celsius\n1.0,20.5\n2.0,21\n")
    tables._extend(path, Content(run()), {})
    assert path.read_text() == "time_s,celsius\n1.0,20.5\n2.0,21\n"


@pytest.mark.parametrize(
    ("form", "old", "theirs"),
    [
        ("tum", "estimate_9.tum", ["mocap.tum", "truth_vicon.tum", "notes.txt"]),
        ("rosbag2", "old name.mcap", ["walk.mcap", "notes.txt"]),
    ],
)
def test_overwriting_removes_the_old_files_of_the_format_and_none_of_others(
    tmp_path: Path, form: str, old: str, theirs: list[str]
) -> None:
    yard, _ = written(tmp_path)
    out = tmp_path / "old name"
    convert(yard, "--to", form, "--out", out)
    out = out.rename(tmp_path / "new name")
    for name in theirs:
        (out / name).write_text("mine")
    if form == "tum":
        (out / old).write_text("of a node that was there")
    result = convert(yard, "--to", form, "--out", out, "--overwrite")
    assert not (out / old).exists()
    assert [(out / name).read_text() for name in theirs] == ["mine"] * len(theirs)
    assert {path.name for path in out.iterdir()} == {*theirs, *(p.name for p in result.files)}


# -- full disks ------------------------------------------------------------------------------------


@contextmanager
def no_room_for(most_bytes: int) -> Iterator[None]:
    """No file may become longer: the system refuses the write, as that of a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def tree(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(
    ("form", "name"),
    [
        ("gpx", ""),
        ("geojson", ""),
        ("tum", "truth_1.tum"),
        ("csv", "motion.csv"),
        ("run", "motion.csv"),
        ("rosbag2", ""),
    ],
)
def test_on_a_full_disk_the_file_is_named_the_old_one_stays_and_no_stub_is_left(
    tmp_path: Path, form: str, name: str
) -> None:
    yard, _ = written(tmp_path)
    options = (yard, "--pin", PIN, "--to", form, "--out")
    old, new = tmp_path / f"old.{form}", tmp_path / f"new.{form}"
    convert(*options, old)
    before = tree(tmp_path)
    for out in (old, new):
        with no_room_for(1000):
            words = refused(*options, out, "--overwrite", "--start", START)
        assert words.removeprefix("relpos: ").startswith(f"{out / name}: ")
        assert words.endswith("File too large")
        assert tree(tmp_path) == before
        convert(*options, out, *["--overwrite"] * (out == old))
        before = tree(tmp_path)


@pytest.mark.parametrize("form", ["gpx", "geojson"])
def test_a_link_in_the_place_of_a_map_is_followed(tmp_path: Path, form: str) -> None:
    yard, _ = written(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    real, link = tmp_path / "elsewhere" / "real", tmp_path / f"link.{form}"
    real.write_text("old")
    link.symlink_to(real)
    convert(yard, "--pin", PIN, "--to", form, "--out", link, "--overwrite")
    assert link.is_symlink()
    assert len(real.read_bytes()) > 1000
    assert [path.name for path in real.parent.iterdir()] == ["real"]


def test_what_is_no_file_is_written_into_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_output(pipe, "a log")
        write_rows(pipe, ["time_s"], [[1.0]])
        assert os.read(reader, 100) == b"a logtime_s\n1.0\n"
    finally:
        os.close(reader)
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


@pytest.mark.parametrize("what", ["kml", "csv", "html"])
def test_a_log_or_report_on_a_full_disk_is_named_and_the_old_one_stays(
    tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"old.{what}"
    entry = LogEntry(3.0, 1.7e9, "landmark", "Ben is at a landmark " * 200, 2)
    path.write_text("old")
    monkeypatch.setattr(report, "_drawn", lambda *_: {})
    monkeypatch.setattr(report, "page", lambda *_: "page" * 1000)
    write = {
        "kml": lambda: write_kml(path, "mill", [entry]),
        "csv": lambda: write_rows(path, LOG_COLUMNS, [log_row(entry)]),
        "html": lambda: report.write(None, path),  # type: ignore[arg-type]
    }[what]
    with no_room_for(1000), pytest.raises(OSError, match="File too large") as caught:
        write()
    assert words_of(caught.value) == f"{path}: File too large"
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    write()
    assert len(path.read_bytes()) > 1000
