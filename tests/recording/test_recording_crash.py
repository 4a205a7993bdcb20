"""A recorder that is killed, a disk that is full, slow or gone: what is left, and the notices."""

import errno
import json
import os
import pickle
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from sessions import START_NS, PulledOut, about, alike, play, session

from relpos.recording import make_recorder, open_recording, save_recording
from relpos.recording.container import Walk
from relpos.recording.moments import Moments
from relpos.recording.output import Disk
from relpos.recording.recorder import Bounds, Recorder
from relpos.recording.topics import Serial
from support.small_disk import small_disk

PATIENCE_S = 120.0
A_SECOND = 50
"""Reads of the port, one each 20 ms."""


def wait_for(condition):
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until_s, "waited in vain"
        time.sleep(0.02)


def serials(path):
    return [entered for _, entered in open_recording(path).inputs() if isinstance(entered, Serial)]


# --- kill -9 -------------------------------------------------------------------------------------


def kill_recorders(tmp_path, kills, seed):
    """For each kill, the reads of the port that had been handed over and are not in the recording.

    Fifty of them are a second of the session, also where a busy computer lets it run too rarely.
    """
    steps = tmp_path / "steps.pickle"
    steps.write_bytes(pickle.dumps(session()))
    script = Path(__file__).with_name("kill_recorders.py")
    arguments = [str(steps), str(tmp_path), str(kills), str(seed)]
    done = subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lost = []
    for line in done.stdout.splitlines():
        end = json.loads(line)
        path = Path(end["path"])
        if not end["number"]:
            continue  # Killed before anything had been received.
        found = serials(path)
        numbers = [struct.unpack_from("<Q", serial.data)[0] for serial in found]
        assert numbers == list(range(1, len(found) + 1)), f"{path}: a hole, or another order"
        lost.append(end["number"] - len(found))
        recording = open_recording(path)
        assert not recording.closed
        assert "was not closed" in recording.remarks[0]
        assert len(recording.run.measurements) >= len(found) // 4
        readable_by_others_once_repaired(path, tmp_path / "repaired.mcap", len(found))
    return lost


def readable_by_others_once_repaired(path, repaired, count):
    """By mcap's own readers; from the start up to the cut even as it is."""
    streamed = 0
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                streamed += type(record).__name__ == "Message" and record.channel_id == 1
        except Exception:
            pass  # A cut file shows as any error at the cut.
    assert streamed == count
    recording = open_recording(path)
    repaired.unlink(missing_ok=True)
    save_recording(repaired, recording.run, source=recording)
    with repaired.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages("/serial")) == count
        assert reader.get_summary().statistics.channel_message_counts.get(1, 0) == count
    whole = open_recording(repaired)
    assert whole.closed
    assert whole.remarks == ()
    assert whole.run.measurements == recording.run.measurements


def test_a_killed_recorder_leaves_all_but_the_last_second(tmp_path):
    assert max(kill_recorders(tmp_path, 5, 1)) <= A_SECOND


@pytest.mark.soak
def test_two_hundred_killed_recorders_leave_all_but_the_last_second(tmp_path):
    lost = kill_recorders(tmp_path, 200, 2)
    lost_s = sorted(count / A_SECOND for count in lost)
    most = ", ".join(f"{s:.2f}" for s in lost_s[-8:])
    print(
        f"{len(lost)} recordings; seconds lost, mean {sum(lost_s) / len(lost_s):.2f}, most {most}"
    )
    assert len(lost) > 100
    assert max(lost) <= A_SECOND


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    path = tmp_path_factory.mktemp("crash") / "closed.mcap"
    recorder = make_recorder(path, about())
    play(recorder, session())
    recorder.close()
    return path


def test_a_recording_cut_anywhere_is_read_up_to_there(closed, tmp_path):
    data = closed.read_bytes()
    path = tmp_path / "cut.mcap"
    before = -1
    for size in sorted({0, 1, 7, 8, 9, 20, *range(100, len(data), len(data) // 60)}):
        path.write_bytes(data[:size])
        recording = open_recording(path)
        count = len(serials(path))
        assert count >= before, "more of the file, less in it"
        before = count
        assert len(recording.remarks) == 1
        assert "\n" not in recording.remarks[0]
        assert "was not closed" in recording.remarks[0]
        assert len(recording.run.measurements) <= len(open_recording(closed).run.measurements)
    assert before > 0


def test_zeros_behind_the_end_as_after_a_power_failure_are_no_data(closed, tmp_path):
    path = tmp_path / "zeros.mcap"
    half = closed.read_bytes()[: closed.stat().st_size // 2]
    path.write_bytes(half)
    count = len(serials(path))
    path.write_bytes(half + bytes(4096))
    assert len(serials(path)) == count
    assert "was not closed" in open_recording(path).remarks[0]


def test_a_damaged_block_is_left_out_and_reported(tmp_path):
    path = tmp_path / "damaged.mcap"
    recorder = make_recorder(path, about())
    steps = session()
    for part in (steps[: len(steps) // 2], steps[len(steps) // 2 :]):
        play(recorder, part)
        size = path.stat().st_size
        wait_for(lambda size=size: path.stat().st_size > size)
    recorder.close()
    whole = len(serials(path))
    data = bytearray(path.read_bytes())
    data[len(data) // 4] ^= 0xFF
    path.write_bytes(data)
    recording = open_recording(path)
    assert 0 < len(serials(path)) < whole
    assert recording.remarks == (f"{path}: 1 damaged blocks are left out",)


@pytest.mark.parametrize(
    ("place", "damage"),
    [
        (0, bytes(4096)),
        (0, bytes(13_000)),
        (100, b"\xff" * 40),
        (b"started_unix_ns", b"\xff" * 15),
        (b"settings", b"\xff" * 8),
        (b"/serial", b"\xff" * 7),
        (b"/motion", b"/nation"),
        # A channel's number: one that is nobody's, and the next one's.
        (b"\6\0\6\0\7\0\0\0/status", b"\x77"),
        (b"\2\0\2\0\7\0\0\0/motion", b"\3"),
    ],
)
def test_a_damaged_beginning_costs_nothing_behind_it_and_is_told(tmp_path, place, damage):
    path = tmp_path / "damaged.mcap"
    recorder = make_recorder(path, about())
    play(recorder, session())
    recorder.close()
    whole = open_recording(path).run.measurements
    inputs = list(open_recording(path).inputs())
    data = bytearray(path.read_bytes())
    at = place if isinstance(place, int) else data.index(place)
    data[at : at + len(damage)] = damage
    path.write_bytes(data)
    recording = open_recording(path)
    assert recording.run.measurements == whole
    assert list(recording.inputs()) == inputs
    assert recording.started_unix_ns == pytest.approx(START_NS, abs=2)
    assert "its beginning is damaged" in recording.remarks[0]
    anew = tmp_path / "anew.mcap"
    save_recording(anew, recording.run, source=recording)
    assert open_recording(anew).remarks == ()
    assert open_recording(anew).run.measurements == whole
    assert Moments([anew]).estimate_at(30.0) is not None


def in_blocks(recorder, path, count):
    """Record reads of the port, numbered from 0, ten to a block."""
    for block in range(count):
        size = path.stat().st_size
        for number in range(10 * block, 10 * block + 10):
            recorder.received(0.02 * number, b"%d" % number)
        wait_for(lambda size=size: path.stat().st_size > size)


def numbers(path):
    return [int(serial.data) for serial in serials(path)]


def offsets_of_chunks(path):
    with path.open("rb") as file:
        return [piece.offset for piece in Walk(file) if piece.opcode == Opcode.CHUNK]


@pytest.mark.parametrize("at", [0, 3, 8], ids=["opcode", "length", "length's last byte"])
def test_a_damaged_head_costs_its_block_and_nothing_behind_it(tmp_path, at):
    path = tmp_path / "damaged.mcap"
    recorder = make_recorder(path, about())
    in_blocks(recorder, path, 4)
    recorder.close()
    data = bytearray(path.read_bytes())
    data[offsets_of_chunks(path)[1] + at] ^= 0x40
    path.write_bytes(data)
    assert numbers(path) == [*range(10), *range(20, 40)]
    recording = open_recording(path)
    assert recording.remarks == (f"{path}: 1 damaged blocks are left out",)
    whole = tmp_path / "whole.mcap"
    (remark,) = save_recording(whole, recording.run, source=recording)
    assert "could not be read" in remark
    assert numbers(whole) == numbers(path)
    with whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages("/serial")) == 30


# --- the disk ------------------------------------------------------------------------------------


class FullDisk(Disk):
    """Takes so many bytes and no more until there is ``room``."""

    def __init__(self, room, error=errno.ENOSPC):
        self.room = room
        self.error = error
        self.handles = set()

    def write(self, file, data):
        self.handles.add(file)
        size = min(len(data), self.room)
        if not size:
            raise OSError(self.error, os.strerror(self.error))
        self.room -= size
        return super().write(file, data[:size])


def test_recording_goes_on_after_a_full_disk_without_losing_anything(tmp_path):
    path = tmp_path / "full.mcap"
    disk = FullDisk(60_000)
    recorder = Recorder(path, about(), disk=disk)
    steps = session()
    play(recorder, steps)
    wait_for(lambda: recorder.trouble() is not None)
    assert recorder.trouble().startswith("disk full: the recording ")
    assert "nothing is lost yet" in recorder.trouble()
    # What is on the disk now is what a power failure would leave: readable.
    assert 0 <= len(serials(path)) < len(steps)
    disk.room = 1 << 30
    wait_for(lambda: recorder.trouble() is None)
    recorder.close()
    assert recorder.trouble() is None
    recording = open_recording(path)
    assert recording.remarks == ()
    assert [s.arrival_s for s in serials(path)] == [arrival_s for arrival_s, *_ in steps]
    assert list(recording.observations()) == [o for step in steps for o in step[2]]
    assert alike(list(recording.estimates()), [e for step in steps for e in step[3]])
    log = [e.data for e in recording.entries({"/log"})]
    assert any(b"the disk takes the recording again" in line for line in log)


def test_a_disk_full_for_too_long_loses_estimates_first_and_says_what(tmp_path):
    path = tmp_path / "long.mcap"
    disk = FullDisk(30_000)
    steps = session()
    inputs = sum(200 + len(s[1]) + 300 * len(s[2]) for s in steps)
    recorder = Recorder(path, about(), disk=disk, bounds=Bounds(inputs + 10_000, 10_000))
    disk.room = 0
    recorder.log("info", "the disk is full from now on")
    wait_for(lambda: recorder.trouble() is not None)
    play(recorder, steps)
    lost_inputs, lost_estimates = recorder.lost
    assert lost_inputs == 0
    assert lost_estimates == sum(len(step[3]) for step in steps)
    wait_for(lambda: f"{lost_estimates} estimates are lost" in recorder.trouble())
    disk.room = 1 << 30
    wait_for(lambda: recorder.trouble() is None)
    recorder.close()
    recording = open_recording(path)
    assert list(recording.observations()) == [o for step in steps for o in step[2]]
    (remark,) = recording.remarks
    assert f"0 reads of the port, {lost_estimates} estimates" in remark
    assert recording.run.counters["recording_gaps"] == 1


def test_a_session_that_ends_with_a_full_disk_ends_soon_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("relpos.recording.recorder.CLOSE_WITHIN_S", 1.0)
    path = tmp_path / "end.mcap"
    disk = FullDisk(60_000)
    recorder = Recorder(path, about(), disk=disk)
    play(recorder, session())
    wait_for(lambda: recorder.trouble() is not None)
    recorder.close()
    assert recorder.trouble().startswith("disk full")
    assert "the end of the session is not recorded" in recorder.trouble()
    open_recording(path)


def test_a_file_that_may_not_grow_is_followed_by_another_part(tmp_path):
    path = tmp_path / "fat.mcap"

    class Limited(Disk):
        """A file system whose files end at a size, as FAT32's at 4 GB."""

        def write(self, file, data):
            left = 80_000 - os.fstat(file).st_size
            if left <= 0:
                raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
            return super().write(file, data[:left])

    recorder = Recorder(path, about(), disk=Limited())
    steps = session()
    for k in range(0, len(steps), len(steps) // 6):
        play(recorder, steps[k : k + len(steps) // 6])
        size = sum(file.stat().st_size for file in tmp_path.iterdir())
        wait_for(lambda n=size: sum(file.stat().st_size for file in tmp_path.iterdir()) > n)
    recorder.close()
    parts = {file.name for file in tmp_path.iterdir()}
    assert {"fat.mcap", "fat.part2.mcap"} <= parts
    assert len(parts) < 8, "most of a part is what was there before"
    recording = open_recording(path)
    assert [s.arrival_s for s in serials(path)] == [arrival_s for arrival_s, *_ in steps]
    assert list(recording.observations()) == [o for step in steps for o in step[2]]
    assert recorder.trouble() is None
    assert recording.remarks == ()
    save_recording(tmp_path / "one.mcap", recording.run, source=recording)
    assert len(serials(tmp_path / "one.mcap")) == len(steps)


def test_what_a_part_repeats_of_the_one_before_is_once_in_the_joined_recording(
    tmp_path, monkeypatch
):
    path, disk, cut = tmp_path / "pulled.mcap", PulledOut(3), os.ftruncate

    def ftruncate(file, size):
        if not (tmp_path / "pulled.part2.mcap").exists():
            cut(file, size)

    monkeypatch.setattr(os, "ftruncate", ftruncate)
    recorder = Recorder(path, about(), disk=disk)
    in_blocks(recorder, path, 2)
    recorder.received(1.0, b"20")
    wait_for(lambda: disk.calls > 3)
    recorder.close()
    recording = open_recording(path)
    assert len(recording.files) == 2
    assert numbers(path) == list(range(21))
    save_recording(tmp_path / "one.mcap", recording.run, source=recording)
    assert numbers(tmp_path / "one.mcap") == list(range(21))


def test_a_notice_that_is_no_text_does_not_end_the_recording(tmp_path):
    path = tmp_path / "name.mcap"
    recorder = make_recorder(path, about())
    recorder.received(0.0, b"0")
    recorder.log("warning", "ca\udce9.csv: disk full")  # A file's name that is not UTF-8.
    recorder.received(0.1, b"1")
    recorder.close()
    assert recorder.trouble() is None
    assert numbers(path) == [0, 1]
    assert any(b"disk full" in entry.data for entry in open_recording(path).entries({"/log"}))


def test_a_disk_that_confirms_nothing_blocks_no_writer_and_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr("relpos.recording.recorder.LATE_S", 0.3)
    held = threading.Event()

    class Slow(Disk):
        calls = 0

        def sync(self, file):
            self.calls += 1
            if self.calls > 1:  # The first is the beginning's.
                held.wait(PATIENCE_S)

    path = tmp_path / "slow.mcap"
    recorder = Recorder(path, about(), disk=Slow())
    steps = session()
    half = len(steps) // 2
    play(recorder, steps[:half])
    wait_for(lambda: len(serials(path)) == half)
    # A process that is killed now loses nothing, whatever the disk does.
    play(recorder, steps[half:])
    wait_for(lambda: len(serials(path)) == len(steps))
    wait_for(lambda: recorder.log("info", "still there") or recorder.trouble() is not None)
    assert "a power failure now would lose as much" in recorder.trouble()
    held.set()
    wait_for(lambda: recorder.log("info", "and now") or recorder.trouble() is None)
    recorder.close()
    assert open_recording(path).closed


def test_a_block_that_the_disk_did_not_confirm_is_written_again(tmp_path):
    class Forgetful(Disk):
        calls = 0

        def sync(self, file):
            self.calls += 1
            if self.calls == 2:
                # As a kernel does that could not write its cache: it forgets it, and says so once.
                os.ftruncate(file, os.fstat(file).st_size - 1000)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "forgetful.mcap"
    recorder = Recorder(path, about(), disk=Forgetful())
    steps = session()
    play(recorder, steps)
    wait_for(lambda: recorder.log("info", "on") or path.stat().st_size > 100_000)
    recorder.close()
    assert [s.arrival_s for s in serials(path)] == [arrival_s for arrival_s, *_ in steps]
    assert open_recording(path).closed


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")
def test_recording_goes_on_after_a_real_full_disk(tmp_path):
    with small_disk(tmp_path / "disk", 1) as disk:
        if not disk.is_mount():
            pytest.skip("no mounting here")
        ballast = disk / "ballast"
        ballast.write_bytes(bytes(900_000))
        path = disk / "walk.mcap"
        recorder = make_recorder(path, about())
        steps = session()
        play(recorder, steps)
        wait_for(lambda: recorder.trouble() is not None)
        assert recorder.trouble().startswith("disk full")
        open_recording(path)
        ballast.unlink()
        wait_for(lambda: recorder.trouble() is None)
        recorder.close()
        assert [s.arrival_s for s in serials(path)] == [arrival_s for arrival_s, *_ in steps]
        assert open_recording(path).closed
