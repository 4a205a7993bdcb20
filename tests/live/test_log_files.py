"""A session's log: as a table, as KML, and in the debrief page by itself."""

from __future__ import annotations

import csv
from html import escape
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
from team_input import TeamInput

from relpos.cli import fuse, live, replay
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.errors import DataError
from relpos.fusion.estimator import NodeStatus
from relpos.live.log_files import log_row, write_kml
from relpos.live.team_view import LogEntry
from relpos.measurements import Event
from relpos.recording.player import History
from relpos.runs import Description
from relpos.runs.appending import write_rows
from relpos.runs.log import LOG_COLUMNS, read_log

ENTRIES = [
    LogEntry(3.0, 1.7e9, "landmark", "Ben is at landmark <7>", 2),
    LogEntry(9.5, 1.7e9 + 6.5, "board", "all\x00 out", None, "Anna & Co"),
]
NAMES = {"k": "http://www.opengis.net/kml/2.2"}


def test_a_kml_log_has_every_line_with_its_time_and_the_places_that_are_known(
    tmp_path: Path,
) -> None:
    path = tmp_path / "log.kml"
    write_kml(path, "Old mill", ENTRIES, lambda e: (48.5, 11.25) if e.node == 2 else None)
    marks = ElementTree.parse(path).getroot().findall(".//k:Placemark", NAMES)
    first, second = marks
    assert first.findtext("k:name", "", NAMES) == "Ben is at landmark <7>"
    assert first.findtext("k:TimeStamp/k:when", "", NAMES) == "2023-11-14T22:13:20Z"
    assert first.findtext("k:Point/k:coordinates", "", NAMES) == "11.250000000,48.500000000"
    assert second.find("k:Point", NAMES) is None
    assert second.findtext("k:description", "", NAMES) == "board, by Anna & Co"


@pytest.mark.parametrize("suffix", ["csv", "kml"])
def test_the_log_of_a_replay_is_written_by_its_suffix_with_places_by_a_pin(
    tmp_path: Path, suffix: str
) -> None:
    at = SimpleNamespace(node=2, x_m=100.0, y_m=0.0, status=NodeStatus.OK)
    moments = SimpleNamespace(from_s=0.0, estimate_at=lambda _: SimpleNamespace(nodes=[at]))
    path = tmp_path / f"log.{suffix}"
    played = replay.Played([], "mill", ENTRIES, {})
    replay._write(path, played, moments, ["48.0,11.0,90"])  # type: ignore[arg-type]
    if suffix == "csv":
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["kind"] for row in rows] == ["landmark", "board"]
        assert tuple(rows[0]) == LOG_COLUMNS
        return
    place = ElementTree.parse(path).getroot().findtext(".//k:coordinates", "", NAMES)
    longitude, latitude = map(float, place.split(","))
    # x points east: 100 m there are 100 / (111.32 km cos 48 deg) degrees.
    assert latitude == pytest.approx(48.0, abs=1e-5)
    assert longitude == pytest.approx(11.0 + 100.0 / 74625.0, abs=1e-5)


@pytest.mark.parametrize("name", ["=1+1", "+A", "-A", "@A", "'=A", "'A", "Anna"])
def test_a_name_is_no_formula_in_a_spreadsheet_and_read_back_as_it_was(
    tmp_path: Path, name
) -> None:
    entry = LogEntry(-1.5, 1.7e9, "board", f"{name} out", None, name)
    write_rows(tmp_path / "log.csv", LOG_COLUMNS, [log_row(entry)])
    with (tmp_path / "log.csv").open(newline="") as file:
        (cells,) = csv.DictReader(file)
    assert not {cells["by"][0], cells["text"][0]} & set("=+-@")
    assert cells["time_s"] == "-1.50"
    (row,) = read_log(tmp_path)
    assert (row["by"], row["text"]) == (name, f"{name} out")


def test_what_is_true_of_a_simulated_walker_is_no_landmark_in_its_log() -> None:
    marks = [Event(0.0, 1, "episode", "up"), Event(2.0, 1, "landmark", "7")]
    rows = [(mark.time_s, mark) for mark in marks]
    moments = SimpleNamespace(started_unix_s=0.0, from_s=0.0, to_s=3.0, rows=lambda *_: rows)
    history = History()
    history.read(moments, {1: "Ben"}, ())  # type: ignore[arg-type]
    assert [entry.text for entry in history.events] == ["Ben is at landmark 7"]


def test_a_shown_session_on_a_port_ends_with_its_debrief_page_and_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    # Figures take seconds, and have tests of their own.
    monkeypatch.setattr("relpos.evaluation.report._drawn", lambda *_: {})
    out = tmp_path / "out"
    job = fuse.Job("/dev/pts/6", "deadreckoning", {}, 0, out)
    options = live.Options(view=True, view_listen="127.0.0.1:0", open_browser=True, seconds=3.0)
    with EmulatedTeam(TeamConfig("straight", 2, 30.0, 3, beacons=True)) as team:
        job.prepare(team.priors())
        fuse.fuse_live(
            job,
            TeamInput(team),
            options,
            description=Description(name="6"),
            priors=team.priors(),
            as_json=False,
        )
    page = (out / "index.html").read_text("utf-8")
    texts = [row["text"] for row in read_log(out)]
    assert texts
    assert all(escape(text) in page for text in texts)
    assert opened[-1] == (out / "index.html").as_uri()


def test_what_is_no_log_is_refused_in_a_line(tmp_path: Path) -> None:
    assert read_log(tmp_path) == []
    (tmp_path / "log.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="not a log"):
        read_log(tmp_path)
