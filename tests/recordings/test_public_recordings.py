"""Public recordings: small copies of the sources' files, as the converters meet them."""

import errno
import json
import socket
import threading
import zipfile

import numpy as np
import pytest

from relpos.errors import DataError
from relpos.recordings import catalog, download, handheld, lowerback
from relpos.recordings.tables import Archive, ConvertedRun
from relpos.runs import load_run
from support.command import relpos

TRIAL = {
    "Height": 175.0,
    "TrialBoundaries": [1, 8],
    "UTurnBoundaries": [4, 5],
    "LeftFootEvents": [[2, 3], [6, 9]],  # the second contact is behind the trial
    "RightFootEvents": [[1, 2]],
}


@pytest.fixture
def lowerback_source(tmp_path):
    folder = tmp_path / "source" / "GaitData"
    folder.mkdir(parents=True)
    (folder / "1-1.json").write_text(json.dumps(TRIAL))
    rows = ["Acquisition frequency: 100 Hz", "PacketCounter\tAcc_X"]
    rows += [f"{k}\t9.81\t0.1\t0.2\t0.01\t0.02\t0.03\t-0.5\t0.2\t1" for k in range(10)]
    (folder / "1-1_lb.txt").write_text("\n".join(rows) + "\n")
    return tmp_path / "source"


@pytest.fixture
def no_checksum(monkeypatch):
    """The sources without the checksum of the whole set."""
    plain = [s.__class__(**{**vars(s), "sha256": ""}) for s in catalog.SOURCES]
    monkeypatch.setattr(download, "SOURCES", plain)


def test_a_lower_back_trial_becomes_a_run(lowerback_source, no_checksum, tmp_path):
    out = tmp_path / "out"
    arguments = ("recordings", "get", "walk_lowerback_20m", "--out", out)
    done = relpos(*arguments, "--mirror", lowerback_source)
    assert done.exit_code == 0, done.output
    assert "AGPL-3.0" in done.output
    run = load_run(out / "1-1")
    assert (run.description.stature_m, run.description.true_distance_m) == (1.75, 20.0)
    (imu,) = run.load_imu().values()
    assert imu.time_s == pytest.approx(np.arange(10) / 100.0)
    assert imu.magnetic_field_ut[0] == pytest.approx([-22.5, 9.0, 45.0])
    contacts = [(e.time_s, e.value) for e in run.events if e.event == "foot_contact"]
    assert contacts == [(0.02, "right"), (0.03, "left")]


def test_a_phones_path_keeps_its_samples_and_waypoints(tmp_path):
    path = tmp_path / handheld.FOLDER
    path.mkdir(parents=True)
    lines = ["#\tstartTime:1000", "990\tTYPE_WAYPOINT\t1.5\t2.5", "1200\tTYPE_WAYPOINT\t3\t4"]
    for k in range(5):
        for kind, value in zip(handheld.KINDS, (9.81, 0.1, 30.0), strict=True):
            lines.append(f"{1000 + 20 * k}\t{kind}\t{value}\t0\t0\t3")
    (path / "abc.txt").write_text("\n".join(lines))
    (path / "no-points.txt").write_text("990\tTYPE_WAYPOINT\t1.5\t2.5\n")
    (run,) = handheld.convert(Archive(tmp_path))
    assert run.name == "abc"
    assert list(run.truth) == ["-0.0100,1,1.5,2.5,", "0.2000,1,3,4,"]
    assert run.imu[1] == "0.0200,1,9.81,0,0,0.1,0,0,30,0,0"


def test_a_zip_is_read_without_its_top_folder(lowerback_source, tmp_path):
    packed = tmp_path / "source.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for file in (lowerback_source / "GaitData").iterdir():
            archive.write(file, f"ipol_dataset_1-b9f4bbb/GaitData/{file.name}")
    plain = list(lowerback.convert(Archive(lowerback_source)))
    assert list(lowerback.convert(Archive(packed))) == plain


def test_a_source_that_changed_gives_one_clear_line_and_writes_nothing(lowerback_source, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(DataError, match="the source has changed"):
        download.get("walk_lowerback_20m", out, lowerback_source)  # not the 110 trials
    (lowerback_source / "GaitData" / "1-1_lb.txt").unlink()
    with pytest.raises(DataError, match=r"no GaitData/1-1_lb\.txt: the source has changed"):
        download.get("walk_lowerback_20m", out, lowerback_source)
    (lowerback_source / "broken.zip").write_text("no zip")
    with pytest.raises(DataError, match="the source has changed"):
        download.get("walk_lowerback_20m", out, lowerback_source / "broken.zip")
    assert not out.exists()


def zipped(folder, path, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for file in folder.rglob("*.*"):
            archive.write(file, f"top/{file.relative_to(folder)}")
    return path.read_bytes()


@pytest.mark.parametrize("at", [0.02, 0.3, 0.6])
def test_a_damaged_zip_gives_one_clear_line(lowerback_source, no_checksum, tmp_path, at):
    whole = bytearray(zipped(lowerback_source, tmp_path / "source.zip"))
    begin = int(at * len(whole))
    whole[begin : begin + 40] = bytes(range(60, 100))
    (tmp_path / "source.zip").write_bytes(whole)
    with pytest.raises(DataError, match="walk_lowerback_20m: "):
        download.get("walk_lowerback_20m", tmp_path / "out", tmp_path / "source.zip")
    assert not (tmp_path / "out").exists()


def test_a_download_that_breaks_off_is_no_changed_source(lowerback_source, monkeypatch, tmp_path):
    whole = zipped(lowerback_source, tmp_path / "source.zip")
    head = b"HTTP/1.0 200 OK\r\nContent-Length: %d\r\n\r\n" % len(whole)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            line, _ = server.accept()
            with line:
                line.recv(4096)
                line.sendall(head + whole[:-100])

        threading.Thread(target=answer, daemon=True).start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}/source.zip"
        monkeypatch.setattr(catalog.Source, "address", address)
        with pytest.raises(DataError, match=r"source\.zip: broke off 100 bytes before its end"):
            download.get("walk_lowerback_20m", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("names", [["...txt"], ["twice.txt", "twice.csv"]])
def test_a_name_in_a_source_leads_to_no_other_folder_and_no_run_over_another(names, tmp_path):
    lines = ["990\tTYPE_WAYPOINT\t1.5\t2.5", "1200\tTYPE_WAYPOINT\t3\t4"]
    lines += [f"{1000 + k}\t{kind}\t1\t0\t0\t3" for k in range(5) for kind in handheld.KINDS]
    with zipfile.ZipFile(tmp_path / "source.zip", "w") as archive:
        for name in names:
            archive.writestr(f"top/{handheld.FOLDER}{name}", "\n".join(lines))
    out = tmp_path / "sub" / "out"
    with pytest.raises(DataError, match="runs with one name, or with none"):
        download.get("walk_handheld_waypoints", out, tmp_path / "source.zip")
    assert [file.name for file in tmp_path.iterdir()] == ["source.zip"]


def test_on_a_full_disk_the_folder_is_named_and_no_part_of_a_set_is_left(
    lowerback_source, no_checksum, monkeypatch, tmp_path
):
    for ending in (".json", "_lb.txt"):
        text = (lowerback_source / "GaitData" / f"1-1{ending}").read_text()
        (lowerback_source / "GaitData" / f"2-1{ending}").write_text(text)
    write = ConvertedRun.write

    def full(run, folder):
        write(run, folder)
        if run.name == "2-1":
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(ConvertedRun, "write", full)
    with pytest.raises(DataError, match="out: No space left on device"):
        download.get("walk_lowerback_20m", tmp_path / "out", lowerback_source)
    assert not (tmp_path / "out").exists()


def test_a_source_that_moved_gives_one_clear_line(monkeypatch, tmp_path):
    moved = [s.__class__(**{**vars(s), "repository": "127.0.0.1:9"}) for s in catalog.SOURCES]
    monkeypatch.setattr(download, "SOURCES", moved)
    with pytest.raises(DataError, match=r"127\.0\.0\.1:9.*efused"):
        download.get("walk_lowerback_20m", tmp_path / "out")
    with pytest.raises(DataError, match="recordings list"):
        download.get("walk_on_the_moon", tmp_path / "out")


def test_every_set_is_listed_with_licence_and_source():
    done = relpos("recordings", "list", "--json")
    listed = json.loads(done.output)
    assert len(listed) == len(catalog.SOURCES)
    for entry in listed.values():
        assert entry["licence"]
        assert entry["address"].startswith("https://")
    shown = relpos("recordings", "list").output
    assert all(name in shown for name in listed)
