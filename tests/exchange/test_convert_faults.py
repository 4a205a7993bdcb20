"""``relpos convert`` where the request, the output folder or the disk is not as it should be."""

from __future__ import annotations

from pathlib import Path

import pytest

from relpos.errors import DataError
from relpos.exchange import tables
from relpos.exchange.content import Content
from relpos.exchange.times import LATEST_UNIX_S, unix_of
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
