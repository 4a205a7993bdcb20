"""What a session leaves on disk, also while the disk is full."""

import errno
import io
import resource
import shutil
from pathlib import Path

import pytest

from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, Parameter
from relpos.live.files import FileSink
from relpos.measurements import Event, Heading, Height, Motion, Range, Status, Step
from relpos.runs import Description, load_run, read_estimates, write_estimates
from relpos.runs.appending import AppendedTable, write_rows
from relpos.runs.description import read_description, write_description

OBSERVATIONS = [
    Motion(1.0, 1, 0.5, 0.0, 0.1, 0.1, 0.1, 0.1, 2, True, 0.05),
    Range(1.6, 1, 2, 3.25, -80.0),
    Height(1.0, 1, 0.5),
    # Reported two seconds after it was measured, as ranges are.
    Range(0.4, 2, 1, 3.5, None),
    Heading(1.5, 2, 0.7, 0.2, "phone"),
    Status(1.2, 1, "battery_v", 4.9),
    Event(1.1, 2, "landmark", "17"),
    Step(1.3, 1, 0.7),
]


def an_estimate(time_s, scale=1.0):
    node = NodeEstimate(1, time_s, 0.0, 0.1, 0.1, 0.1, 0.0, 0.1, NodeStatus.OK)
    parameters = (Parameter(time_s, 1, None, "step_scale", scale, 0.1),)
    return Estimate(time_s, (node,), (), (), parameters)


def test_received_measurements_load_as_a_run_in_the_order_of_time(tmp_path):
    files = FileSink(tmp_path, Description(name="walk"))
    files.observed(2.0, OBSERVATIONS)
    files.estimated(an_estimate(1.0))
    files.named({2: "Kim"})
    files.close()
    run = load_run(tmp_path / "received")
    assert run.name == "walk"
    assert run.nodes[2].name == "Kim"
    assert [o.time_s for o in run.ranges] == [0.4, 1.6]
    kept = [*run.measurements, *run.events, *run.statuses, *run.steps]
    assert sorted(map(repr, kept)) == sorted(map(repr, OBSERVATIONS))


def test_files_of_an_earlier_session_are_not_taken_for_this_ones(tmp_path):
    for session in range(2):
        files = FileSink(tmp_path, Description(name="walk"))
        files.observed(2.0, OBSERVATIONS if session == 0 else OBSERVATIONS[:1])
        files.close()
    run = load_run(tmp_path / "received")
    assert not run.ranges
    assert not run.events
    assert not (tmp_path / "steps.csv").exists()


def test_appended_estimates_are_those_that_are_written_at_once(tmp_path):
    estimates = [an_estimate(float(t), 1.0 + (t > 3)) for t in range(6)]
    files = FileSink(tmp_path / "a", Description(), keep_received=False)
    for estimate in estimates:
        files.estimated(estimate)
    files.close()
    write_estimates(tmp_path / "b", estimates)
    for path in (tmp_path / "b").iterdir():
        assert (tmp_path / "a" / path.name).read_bytes() == path.read_bytes()
    assert len(read_estimates(tmp_path / "a")) == 6
    assert (tmp_path / "a" / "parameters.csv").read_text().count("step_scale") == 2


class FullDisk(io.FileIO):
    """A file on a disk that takes ``room`` bytes in all."""

    room = 0

    def write(self, data) -> int:
        part = bytes(data)[: FullDisk.room]
        if not part:
            raise OSError(errno.ENOSPC, "No space left on device", str(self.name))
        FullDisk.room -= len(part)
        return super().write(part)


@pytest.fixture
def table(tmp_path, monkeypatch):
    """One on a disk with room for its header and a few rows."""
    monkeypatch.setattr(Path, "open", lambda path, mode, **_: FullDisk(path, mode))
    FullDisk.room = 42
    return AppendedTable(tmp_path / "table.csv", ["time_s", "node"], wanted=False)


def test_a_cell_that_is_no_text_ends_no_table(tmp_path):
    made = AppendedTable(tmp_path / "log.csv", ["text"])
    made.add([["ca\udce9.csv: disk full"], ["more"]])
    made.close()
    assert made.path.read_text() == "text\nca?.csv: disk full\nmore\n"


def test_a_table_that_a_full_disk_does_not_take_is_named():
    with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
        write_rows(Path("/dev/full"), ["time_s"], [[1.0]])


def test_a_full_disk_is_reported_and_nothing_is_missing_once_there_is_room(table):
    for k in range(50):
        table.add([(k, 1)])
        table.flush()
    assert table.error is not None
    assert table.error.strerror == "No space left on device"
    FullDisk.room = 10_000
    table.add([(50, 1)])
    table.flush()
    assert table.error is None
    table.close()
    expected = "time_s,node\n" + "".join(f"{k},1\n" for k in range(51))
    assert table.path.read_bytes().decode() == expected


def test_a_disk_that_stays_full_is_an_error_at_the_end(table):
    table.add((k, 1) for k in range(50))
    with pytest.raises(OSError, match="No space left"):
        table.close()


@pytest.mark.parametrize("room", range(0, 60, 3))
def test_a_table_on_a_full_disk_has_whole_lines_or_is_not_there(table, room):
    FullDisk.room = room
    for k in range(50):
        table.add([(k, 1)])
        table.flush()
    lines = table.path.read_bytes().split(b"\n") if table.path.exists() else [b"time_s,node", b""]
    assert lines == [b"time_s,node", *(b"%d,1" % k for k in range(len(lines) - 2)), b""]


def test_rows_beyond_the_buffer_are_counted(table, monkeypatch):
    monkeypatch.setattr("relpos.runs.appending.MOST_WAITING_BYTES", 100)
    for k in range(100):
        table.add([(k, 1)])
        table.flush()
    assert table.lost_rows > 50


def test_a_description_that_cannot_be_written_leaves_the_one_before(tmp_path):
    path = tmp_path / "run.toml"
    write_description(path, Description(name="walk"))
    with pytest.raises(UnicodeEncodeError):
        write_description(path, Description(name="\ud800"))
    assert read_description(path).name == "walk"

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        with pytest.raises(OSError, match=r"too large: .*run\.toml"):
            write_description(path, Description(name="another"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert read_description(path).name == "walk"
    assert [file.name for file in tmp_path.iterdir()] == ["run.toml"]


def test_a_name_for_a_folder_that_has_vanished_is_told_and_written_once_it_is_back(tmp_path):
    files = FileSink(tmp_path, Description(name="walk"))
    shutil.rmtree(tmp_path / "received")
    files.named({2: "Kim"})
    assert "run.toml" in files.trouble()
    files.estimated(an_estimate(1.0))
    (tmp_path / "received").mkdir()
    files.named({2: "Kim", 3: "Robin"})
    assert files.trouble() is None
    files.close()
    assert load_run(tmp_path / "received").description.nodes[3].name == "Robin"
    assert read_estimates(tmp_path)


def test_rows_of_a_file_that_was_deleted_are_told(tmp_path):
    files = FileSink(tmp_path, Description(name="walk"))
    files.observed(2.0, OBSERVATIONS)
    files.observed(10.0, [Motion(10.0, 1, 0.5, 0.0, 0.1)])
    shutil.rmtree(tmp_path / "received")
    files.observed(20.0, [Motion(20.0, 1, 0.5, 0.0, 0.1)])
    with pytest.raises(FileNotFoundError, match="was deleted"):
        files.close()
    assert "was deleted" in files.trouble()


def test_a_kill_loses_a_quarter_of_a_second_of_the_plain_files(tmp_path, monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    files = FileSink(tmp_path, Description(name="walk"))
    press = Event(3.0, 1, "landmark", "17")
    for k in range(1, 100):
        now_s[0] = 0.05 * k
        time_s = now_s[0]
        if k % 20 == 0:
            files.observed(time_s, [Motion(time_s, 1, 0.5, 0.0, 0.1)])
            files.observed(time_s, [Range(time_s - 0.9, 1, 2, 3.0)])
            files.estimated(an_estimate(time_s))
        if k == 60:
            files.observed(time_s, [press])
        files.trouble()
        if time_s > 1.25:
            # What a kill at this moment would leave.
            run, written_s = load_run(tmp_path / "received"), (k - 5) // 20
            assert run.motions[-1].time_s >= written_s
            assert "unsorted_rows" not in run.counters
            assert read_estimates(tmp_path)[-1].time_s >= written_s
            assert time_s < 3.25 or run.events == (press,)
    files.close()
