"""``relpos convert``: what other people's tools read, and what comes back from them."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic

from relpos import tracks
from relpos.evaluation import metrics
from relpos.exchange import content
from relpos.fusion.estimator import NodeStatus
from relpos.measurements import Event, Truth
from relpos.recording import MAGIC
from relpos.runs import load_run, read_estimates, save_run, write_estimates
from support.small_team import (
    LANDMARKS,
    NAMES,
    SECONDS,
    CommandResult,
    convert,
    estimates,
    refused,
    run,
    true_pose,
    written,
)

PIN = "48.137,11.575,60,520"
START = "2026-05-04T09:30:00Z"
START_UNIX_S = 1777887000.0


def on_map(x_m: float, y_m: float) -> dict[str, float]:
    """Where the pin puts a place, by geodesics: x points to 60 degrees, y to 330."""
    bearing = 60.0 - math.degrees(math.atan2(y_m, x_m))
    found: dict[str, float] = Geodesic.WGS84.Direct(48.137, 11.575, bearing, math.hypot(x_m, y_m))
    return found


def off_m(latitude_deg: float, longitude_deg: float, x_m: float, y_m: float) -> float:
    there = on_map(x_m, y_m)
    missed = Geodesic.WGS84.Inverse(there["lat2"], there["lon2"], latitude_deg, longitude_deg)
    return float(missed["s12"])


# -- TUM and evo -----------------------------------------------------------------------------------


def test_evo_gets_the_same_aligned_error_of_a_team_as_relpos_evaluate(tmp_path: Path) -> None:
    from evo.core.metrics import PoseRelation
    from evo.core.sync import associate_trajectories
    from evo.core.trajectory import PoseTrajectory3D
    from evo.main_ape import ape
    from evo.tools.file_interface import read_tum_trajectory_file

    # evo aligns in space: on a plane that is what relpos does.
    flat = [replace(e, nodes=tuple(replace(n, z_m=0.0) for n in e.nodes)) for e in estimates()]
    recording = run()
    recording = replace(recording, truth=tuple(replace(t, z_m=0.0) for t in recording.truth))
    save_run(recording, tmp_path / "yard")
    write_estimates(tmp_path / "fused", flat)
    convert(tmp_path / "fused", "--run", tmp_path / "yard", "--to", "tum", "--out", tmp_path / "t")

    pairs = [
        associate_trajectories(
            *(
                read_tum_trajectory_file(str(tmp_path / "t" / f"{kind}_{node}.tum"))
                for kind in ("truth", "estimate")
            ),
            max_diff=0.01,
        )
        for node in NAMES
    ]
    squares = []
    for second in range(1, SECONDS + 1):
        snapshots = []
        for which in (0, 1):
            rows = [
                (pair[which], int(np.argmin(abs(pair[which].timestamps - second))))
                for pair in pairs
            ]
            snapshots.append(
                PoseTrajectory3D(
                    np.array([t.positions_xyz[k] for t, k in rows]),
                    np.array([t.orientations_quat_wxyz[k] for t, k in rows]),
                    np.arange(len(rows), dtype=float),
                )
            )
        result = ape(snapshots[0], snapshots[1], PoseRelation.translation_part, align=True)
        squares.append(result.np_arrays["error_array"] ** 2)
    by_evo_m = math.sqrt(np.mean(squares))

    result = CommandResult(
        "evaluate", tmp_path / "yard", "--estimate", tmp_path / "fused", "--json"
    )
    by_relpos_m = json.loads(str(result.files[0]))["relative_position_rmse_m"]
    assert 0.2 < by_relpos_m < 0.6
    assert by_evo_m == pytest.approx(by_relpos_m, abs=2e-4)


def test_evo_ape_of_one_node_is_its_error(tmp_path: Path) -> None:
    from evo.core.metrics import PoseRelation
    from evo.core.sync import associate_trajectories
    from evo.main_ape import ape
    from evo.tools.file_interface import read_tum_trajectory_file

    yard, fused = written(tmp_path)
    convert(fused, "--run", yard, "--to", "tum", "--out", tmp_path / "t")
    true, estimated = associate_trajectories(
        *(
            read_tum_trajectory_file(str(tmp_path / "t" / f"{kind}_2.tum"))
            for kind in ("truth", "estimate")
        )
    )
    assert estimated.num_poses == SECONDS
    at_s = np.arange(1.0, SECONDS + 1)
    yaw = estimated.get_orientations_euler()[:, 2]
    expected = np.array([true_pose(2, t)[2] for t in at_s])
    assert abs(tracks.wrap_angle(yaw - expected)).max() < 1e-5
    turned = ape(true, estimated, PoseRelation.rotation_angle_deg).stats["max"]
    assert turned == pytest.approx(0.0, abs=1e-3)
    plain = ape(true, estimated, PoseRelation.translation_part).stats["rmse"]
    aligned = ape(true, estimated, PoseRelation.translation_part, align=True).stats["rmse"]
    p, _ = tracks.sample([tracks.estimated_tracks(estimates())[2]], at_s)
    q = np.array([true_pose(2, t)[:2] for t in at_s])
    assert plain == pytest.approx(math.sqrt(((p[:, 0] - q) ** 2).sum(axis=1).mean()), abs=1e-5)
    ours = metrics.aligned_squared_distances(p[:, 0], q)
    assert aligned == pytest.approx(math.sqrt(ours.mean()), abs=1e-3)


def test_tum_comes_back_as_it_went(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    convert(fused, "--run", yard, "--to", "tum", "--out", tmp_path / "t")
    convert(tmp_path / "t", "--to", "run", "--out", tmp_path / "back")
    back, sent = read_estimates(tmp_path / "back"), read_estimates(fused)
    assert [e.time_s for e in back] == [e.time_s for e in sent]
    for ours, theirs in zip(sent, back, strict=True):
        for a, b in zip(ours.nodes, theirs.nodes, strict=True):
            assert (a.node, a.x_m, a.y_m, a.z_m) == (b.node, b.x_m, b.y_m, b.z_m)
            assert a.heading_rad == pytest.approx(b.heading_rad, abs=1e-6)
            assert math.isnan(b.sigma_major_m)
    truth = load_run(tmp_path / "back").truth
    expected = sorted(run().truth, key=lambda t: (t.time_s, t.node))
    assert [(t.time_s, t.node) for t in truth] == [(t.time_s, t.node) for t in expected]
    for was, now in zip(expected, truth, strict=True):
        there, back = ((t.x_m, t.y_m, t.z_m, t.heading_rad) for t in (was, now))
        assert there == pytest.approx(back, abs=1e-6)


def test_another_tools_trajectory_is_scored_as_an_estimate(tmp_path: Path) -> None:
    yard, _ = written(tmp_path)
    (tmp_path / "slam").mkdir()
    for node in NAMES:
        lines = []
        for second in range(1, SECONDS):
            x_m, y_m, heading = true_pose(node, second)
            half = 0.5 * heading
            # A full attitude: pitched by a bit; and Unix times.
            pitch = 0.1
            qw, qx = math.cos(half) * math.cos(pitch), -math.sin(half) * math.sin(pitch)
            qy, qz = math.cos(half) * math.sin(pitch), math.sin(half) * math.cos(pitch)
            lines.append(f"{START_UNIX_S + second} {x_m + 5.0} {y_m} 1.5 {qx} {qy} {qz} {qw}")
        (tmp_path / "slam" / f"kf_{node}.tum").write_text("# kf\n\n" + "\n".join(lines))
    slam = tmp_path / "slam"
    convert(slam, "--as", "estimate", "--start", START, "--to", "run", "--out", tmp_path / "est")
    result = CommandResult("evaluate", yard, "--estimate", tmp_path / "est", "--json")
    assert json.loads(str(result.files[0]))["relative_distance_rmse_m"] < 1e-4
    first = read_estimates(tmp_path / "est")[0]
    assert first.time_s == 1.0
    assert first.nodes[1].heading_rad == pytest.approx(true_pose(2, 1)[2], abs=1e-5)
    # The same as somebody else's truth, laid over the recording.
    one = slam / "kf_2.tum"
    words = ("--as", "truth", "--node", 7, "--start", str(START_UNIX_S), "--run", yard)
    convert(one, *words, "--to", "run", "--out", tmp_path / "with-truth")
    assert "node 7's truth is in kf_1.tum already" in refused(
        slam, *words, "--to", "run", "--out", tmp_path / "twice"
    )
    laid = load_run(tmp_path / "with-truth")
    assert {row.node for row in laid.truth} == {7}
    assert laid.motions == load_run(yard).motions


def test_guesses_are_reported_and_may_be_left_out(tmp_path: Path) -> None:
    lost = {(3, second): NodeStatus.UNLOCATED for second in range(1, 11)}
    write_estimates(tmp_path / "fused", estimates(statuses=lost))
    result = convert(tmp_path / "fused", "--to", "tum", "--out", tmp_path / "all")
    assert any("10 poses are guesses" in line for line in result.remarks)
    result = convert(tmp_path / "fused", "--located", "--to", "tum", "--out", tmp_path / "some")
    assert not result.remarks
    for name, rows in (("all", SECONDS), ("some", SECONDS - 10)):
        header, *lines = (tmp_path / name / "estimate_3.tum").read_text().splitlines()
        assert header.startswith("#")
        assert len(lines) == rows
    words = ("--pin", "48,11,0@3:5", "--to", "geojson", "--out", tmp_path / "map.geojson")
    assert "node 3 was not located at 5 s" in refused(tmp_path / "fused", *words)


def test_a_truth_without_headings_says_so(tmp_path: Path) -> None:
    bare = replace(run(), truth=(Truth(0.0, 1, 1.0, 2.0), Truth(1.0, 1, 1.5, 2.0)))
    save_run(bare, tmp_path / "yard")
    result = convert(tmp_path / "yard", "--to", "tum", "--out", tmp_path / "t")
    assert any("without a heading" in line for line in result.remarks)
    assert result.files == [tmp_path / "t" / "truth_1.tum"]
    path = tmp_path / "map.geojson"
    convert(tmp_path / "yard", "--pin", PIN, "--to", "geojson", "--out", path)
    assert features(path, kind="track")[0]["properties"]["course_deg"] == [None, None]
    convert(tmp_path / "yard", "--to", "csv", "--out", tmp_path / "c")
    ranges = (tmp_path / "c" / "ranges.csv").read_text("utf-8").splitlines()
    assert ranges[0].endswith(",true_distance_m")
    assert ranges[1].endswith(",")  # Of node 2 no truth is known.


def test_a_truth_without_heights_says_so(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    flat = [replace(row, z_m=None if row.node == 2 else row.z_m) for row in run().truth]
    save_run(replace(run(), truth=tuple(flat)), yard)
    result = convert(fused, "--run", yard, "--to", "tum", "--out", tmp_path / "t")
    (line,) = result.remarks
    assert "truth has poses without a height, written as height 0 (node 2)" in line


# -- tables ----------------------------------------------------------------------------------------


def test_pandas_reads_a_table_in_one_line(tmp_path: Path) -> None:
    import pandas

    yard, fused = written(tmp_path)
    words = ("--run", yard, "--start", START, "--to", "csv", "--out", tmp_path / "tables")
    convert(fused, *words)
    frame = pandas.read_csv(tmp_path / "tables" / "estimate.csv")
    assert len(frame) == SECONDS * len(NAMES)
    assert set(frame["node_name"]) == {"Åsa", "Kim", "Li & Söhne", "node 4"}
    assert frame["x_m"].dtype == "float64"
    assert frame["unix_s"].iloc[0] == START_UNIX_S + 1.0
    pairs = pandas.read_csv(tmp_path / "tables" / "pairs.csv")
    kims = pairs[(pairs["node_name"] == "Åsa") & (pairs["peer_name"] == "Kim")]
    true_m = [math.dist(true_pose(1, t)[:2], true_pose(2, t)[:2]) for t in range(1, SECONDS + 1)]
    assert kims["true_distance_m"].to_numpy() == pytest.approx(np.array(true_m), abs=1e-4)
    ranges = pandas.read_csv(tmp_path / "tables" / "ranges.csv")
    assert {"node_name", "peer_name", "true_distance_m", "range_m"} <= set(ranges.columns)
    learned = pandas.read_csv(tmp_path / "tables" / "parameters.csv")
    assert learned["peer_name"].isna().all()
    truth = pandas.read_csv(tmp_path / "tables" / "truth.csv")
    assert len(truth) == (SECONDS + 1) * len(NAMES)


def test_the_tables_are_a_run_and_an_estimate_still(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    convert(fused, "--run", yard, "--to", "csv", "--out", tmp_path / "tables")
    back, was = load_run(tmp_path / "tables"), load_run(yard)
    assert back.measurements == was.measurements
    assert back.truth == was.truth
    assert back.description == was.description
    assert repr(read_estimates(tmp_path / "tables")) == repr(read_estimates(fused))


def test_a_run_comes_back_as_it_went(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    convert(fused, "--run", yard, "--to", "run", "--out", tmp_path / "again")
    assert replace(load_run(tmp_path / "again"), directory=yard) == load_run(yard)
    assert repr(read_estimates(tmp_path / "again")) == repr(read_estimates(fused))


@pytest.mark.parametrize(
    ("name", "table"),
    [
        (
            "imu.csv",
            "time_s,node,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s\n0,1,1,2,3,4,5,6\n",
        ),
        ("landmarks.csv", "id,x_m,y_m\nA,1,2\n"),
    ],
)
def test_a_run_of_one_table_alone_is_a_run(tmp_path: Path, name: str, table: str) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).write_text(table)
    convert(tmp_path / "run", "--to", "run", "--out", tmp_path / "again")
    again = load_run(tmp_path / "again")
    assert again.load_imu() or again.landmarks


def test_the_files_of_a_live_session_are_converted_with_its_recording(tmp_path: Path) -> None:
    write_estimates(tmp_path / "live", estimates())
    save_run(run(truth=False), tmp_path / "live" / "received")
    convert(tmp_path / "live", "--to", "csv", "--out", tmp_path / "tables")
    assert "Kim" in (tmp_path / "tables" / "estimate.csv").read_text("utf-8")
    assert "true_distance_m" not in (tmp_path / "tables" / "pairs.csv").read_text("utf-8")
    convert(tmp_path / "live", "--pin", PIN, "--to", "gpx", "--out", tmp_path / "walk.gpx")
    assert "<name>live</name>" in (tmp_path / "walk.gpx").read_text("utf-8")
    assert load_run(tmp_path / "tables").motions == run().motions


# -- recordings ------------------------------------------------------------------------------------


def test_a_run_and_its_estimate_come_back_from_a_recording(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    path = tmp_path / "walk.mcap"
    words = ("--run", yard, "--start", START, "--to", "mcap", "--out", path)
    assert not convert(fused, *words).remarks
    result = convert(path, "--to", "csv", "--out", tmp_path / "tables")
    assert not result.remarks
    back, was = load_run(tmp_path / "tables"), load_run(yard)
    assert back.measurements == was.measurements
    assert back.truth == was.truth
    assert back.description == was.description
    assert repr(read_estimates(tmp_path / "tables")) == repr(read_estimates(fused))
    first = (tmp_path / "tables" / "estimate.csv").read_text("utf-8").splitlines()[1]
    assert float(first.split(",")[-1]) == START_UNIX_S + 1.0
    # The start is in the recording: a map has its times without an option.
    words = ("--pin", PIN, "--to", "geojson", "--out", tmp_path / "map.geojson")
    convert(path, *words)
    track = features(tmp_path / "map.geojson", kind="track", node=2, of="estimate")[0]
    assert track["properties"]["coordTimes"][0] == "2026-05-04T09:30:01.000Z"


def test_the_status_of_a_pair_comes_back_from_a_recording(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    table = fused / "pairs.csv"
    table.write_text(table.read_text().replace(",ok\n", ",stale\n"))
    convert(fused, "--run", yard, "--to", "mcap", "--out", tmp_path / "walk.mcap")
    convert(tmp_path / "walk.mcap", "--to", "run", "--out", tmp_path / "back")
    statuses = {s for e in read_estimates(tmp_path / "back") for s in e.pair_statuses()}
    assert statuses == {NodeStatus.STALE, NodeStatus.AMBIGUOUS}


def test_a_recording_without_a_start_says_when_its_clock_begins(tmp_path: Path) -> None:
    yard, _ = written(tmp_path)
    result = convert(yard, "--to", "mcap", "--out", tmp_path / "walk")  # known without a suffix
    assert any("begins in 1970" in line for line in result.remarks)
    convert(tmp_path / "walk", "--to", "run", "--out", tmp_path / "back")
    assert load_run(tmp_path / "back").measurements == load_run(yard).measurements


def test_presses_become_the_truth_of_a_recording(tmp_path: Path, pressed: Path) -> None:
    words = ("--start", START, "--to", "mcap", "--out")
    convert(pressed, *words, tmp_path / "walk.mcap")
    marks = ("--landmarks", tmp_path / "surveyed.csv")
    result = convert(tmp_path / "walk.mcap", *marks, *words, tmp_path / "scored.mcap")
    assert any("truth from 3 of 6" in line for line in result.remarks)
    convert(tmp_path / "scored.mcap", "--to", "run", "--out", tmp_path / "back")
    check_truth(tmp_path / "back")


def test_a_recording_that_broke_off_is_read_and_reported(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    path = tmp_path / "walk.mcap"
    convert(fused, "--run", yard, "--start", START, "--to", "mcap", "--out", path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-200])
    result = convert(path, "--to", "run", "--out", tmp_path / "back")
    assert any("was not closed" in line for line in result.remarks)
    (tmp_path / "broken.mcap").write_bytes(b"not at all")
    line = refused(tmp_path / "broken.mcap", "--to", "run", "--out", tmp_path / "no")
    assert "no MCAP file" in line


@pytest.mark.parametrize("content", [b"", MAGIC], ids=["no bytes", "its first bytes alone"])
def test_a_recording_in_which_nothing_is_gives_no_run(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "e.mcap").write_bytes(content)
    out = tmp_path / "out"
    assert "e.mcap: empty" in refused(tmp_path / "e.mcap", "--to", "run", "--out", out)
    assert not out.exists()


def test_a_recording_is_not_left_half_written(tmp_path: Path) -> None:
    yard, _ = written(tmp_path)
    path = tmp_path / "walk.mcap"
    (tmp_path / "walk.mcap.part").write_bytes(b"of a conversion that was killed")
    convert(yard, "--start", START, "--to", "mcap", "--out", path)
    before = path.read_bytes()
    assert "--overwrite" in refused(yard, "--to", "mcap", "--out", path)
    convert(yard, "--start", START, "--to", "mcap", "--out", path, "--overwrite")
    assert len(path.read_bytes()) == len(before)
    assert not list(tmp_path.glob("*.part"))


# -- maps ------------------------------------------------------------------------------------------


class Rfc7946:
    """The RFC's rules, section by section, for what is written here."""

    def __init__(self, document: Any) -> None:
        assert document["type"] == "FeatureCollection"
        assert "crs" not in document  # section 4
        assert isinstance(document["features"], list)
        for feature in document["features"]:
            assert feature["type"] == "Feature"
            assert set(feature) <= {"type", "geometry", "properties", "id", "bbox"}  # 7.1
            assert feature["properties"] is None or isinstance(feature["properties"], dict)
            self.geometry(**feature["geometry"])

    def geometry(self, type: str, coordinates: Any) -> None:  # noqa: A002
        if type == "Point":
            self.position(coordinates)
        elif type == "LineString":  # 3.1.4
            assert len(coordinates) >= 2
            for position in coordinates:
                self.position(position)
        else:
            assert type == "Polygon"
            for ring in coordinates:  # 3.1.6
                assert len(ring) >= 4
                assert ring[0] == ring[-1]
                for position in ring:
                    self.position(position)
                area = sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise(ring))
                assert area > 0.0, "an outer ring is counter-clockwise"

    def position(self, position: Any) -> None:  # 3.1.1, 4
        assert 2 <= len(position) <= 3
        assert all(type(part) in (int, float) for part in position)
        assert -180.0 <= position[0] <= 180.0
        assert -90.0 <= position[1] <= 90.0


def features(path: Path, **wanted: object) -> list[dict[str, Any]]:
    document = json.loads(path.read_text("utf-8"))
    Rfc7946(document)
    return [
        feature
        for feature in document["features"]
        if all(feature["properties"].get(key) == value for key, value in wanted.items())
    ]


@pytest.mark.parametrize("form", ["geojson", "gpx"])
def test_a_map_comes_back_to_the_millimetre(tmp_path: Path, form: str) -> None:
    yard, fused = written(tmp_path)
    save_run(replace(run(), landmarks=LANDMARKS[1:]), yard)
    path = tmp_path / f"map.{form}"
    words = ("--pin", PIN, "--start", START)
    assert not convert(fused, "--run", yard, *words, "--to", form, "--out", path).remarks
    convert(path, *words, "--to", "run", "--out", tmp_path / "back")
    for sent, back in zip(estimates(), read_estimates(tmp_path / "back"), strict=True):
        assert sent.time_s == pytest.approx(back.time_s, abs=1e-3)
        for a, b in zip(sent.nodes, back.nodes, strict=True):
            assert math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) < 1e-3
            assert a.z_m == pytest.approx(b.z_m, abs=1e-3)
    truth = load_run(tmp_path / "back").truth
    assert len(truth) == (SECONDS + 1) * len(NAMES)
    for row in truth:
        x_m, y_m, _ = true_pose(row.node, row.time_s)
        assert math.dist((row.x_m, row.y_m), (x_m, y_m)) < 2e-3
    (mark,) = load_run(tmp_path / "back").landmarks
    assert mark.landmark == "18"
    assert (mark.x_m, mark.y_m, mark.z_m) == pytest.approx((10.0, 4.5, 3.25), abs=1e-3)


def test_geojson_is_what_the_rfc_asks_for(tmp_path: Path) -> None:
    _, fused = written(tmp_path)
    path = tmp_path / "map.geojson"
    convert(fused, "--pin", PIN, "--start", START, "--to", "geojson", "--out", path)
    track = features(path, kind="track", node=2)[0]
    assert track["geometry"]["type"] == "LineString"
    properties = track["properties"]
    assert properties["of"] == "estimate"
    assert properties["coordTimes"][0] == "2026-05-04T09:30:01.000Z"
    lengths = {len(properties[key]) for key in ("time_s", "course_deg", "coordTimes")}
    assert lengths == {len(track["geometry"]["coordinates"])} == {SECONDS}
    for position, estimate, course in zip(
        track["geometry"]["coordinates"], estimates(), properties["course_deg"], strict=True
    ):
        node = estimate.nodes[1]
        assert off_m(position[1], position[0], node.x_m, node.y_m) < 0.01
        assert position[2] == pytest.approx(520.0 + node.z_m)
        expected = 60.0 - math.degrees(node.heading_rad)
        assert math.remainder(course - expected, 360.0) == pytest.approx(0.0, abs=1e-2)
    (last,) = features(path, kind="position", node=2)
    assert last["properties"]["status"] == "ok"
    assert last["properties"]["height_m"] == pytest.approx(estimates()[-1].nodes[1].z_m, abs=1e-3)
    assert features(path, kind="region", node=2)[0]["geometry"]["type"] == "Polygon"


def test_a_height_of_no_stated_deviation_is_not_exact_in_geojson(tmp_path: Path) -> None:
    made = [
        replace(one, nodes=tuple(replace(node, sigma_z_m=0.0) for node in one.nodes))
        for one in estimates()
    ]
    write_estimates(tmp_path / "fused", made)
    path = tmp_path / "map.geojson"
    convert(tmp_path / "fused", "--pin", PIN, "--to", "geojson", "--out", path)
    (last,) = features(path, kind="position", node=2)
    assert last["properties"]["height_m"] == 1.0
    assert last["properties"]["sigma_height_m"] is None


def test_the_region_holds_nineteen_of_twenty(tmp_path: Path) -> None:
    _, fused = written(tmp_path)
    path = tmp_path / "map.geojson"
    convert(fused, "--pin", PIN, "--to", "geojson", "--out", path)
    ring = features(path, kind="region", node=1)[0]["geometry"]["coordinates"][0]
    node = estimates()[-1].nodes[0]
    here = on_map(node.x_m, node.y_m)
    covariance = np.array([[0.25, 0.02], [0.02, 0.09]])
    corners = []
    for lon, lat in ring:
        way = Geodesic.WGS84.Inverse(here["lat2"], here["lon2"], lat, lon)
        angle = math.radians(60.0 - way["azi1"])
        corners.append((way["s12"] * math.cos(angle), way["s12"] * math.sin(angle)))
    squares = [np.array(c) @ np.linalg.solve(covariance, np.array(c)) for c in corners]
    assert squares == pytest.approx([5.991] * len(ring), rel=0.01)


def test_gpx_is_read_back_by_gpxpy(tmp_path: Path) -> None:
    import gpxpy

    yard, _ = written(tmp_path)
    save_run(replace(run(), landmarks=LANDMARKS), yard)
    path = tmp_path / "walk.gpx"
    convert(yard, "--pin", PIN, "--start", START, "--to", "gpx", "--out", path)
    document = gpxpy.parse(path.read_text("utf-8"))
    assert [track.name for track in document.tracks] == ["Åsa", "Kim", "Li & Söhne", "node 4"]
    assert [track.number for track in document.tracks] == [1, 2, 3, 4]
    assert {track.type for track in document.tracks} == {"truth"}
    for second, point in enumerate(document.tracks[2].segments[0].points):
        assert off_m(point.latitude, point.longitude, *true_pose(3, second)[:2]) < 0.01
        assert point.time is not None
        assert point.time.timestamp() == START_UNIX_S + second
        assert point.elevation == pytest.approx(521.5)
    marks = {w.name: w for w in document.waypoints}
    assert set(marks) == {"17", "18"}
    assert off_m(marks["18"].latitude, marks["18"].longitude, 10.0, 4.5) < 0.01
    assert marks["18"].elevation == pytest.approx(523.25)


def test_a_name_with_a_control_character_leaves_gpx_well_formed(tmp_path: Path) -> None:
    import gpxpy

    yard, _ = written(tmp_path)
    save_run(replace(run(), name="yard\a"), yard)
    path = tmp_path / "walk.gpx"
    convert(yard, "--pin", PIN, "--start", START, "--to", "gpx", "--out", path)
    assert gpxpy.parse(path.read_text("utf-8")).name == "yard"


@pytest.mark.parametrize("form", ["geojson", "gpx"])
def test_a_track_has_a_gap_where_a_node_was_not_located(tmp_path: Path, form: str) -> None:
    unsure = {(3, second): NodeStatus.AMBIGUOUS for second in (*range(1, 6), 20, 22)}
    write_estimates(tmp_path / "fused", estimates(statuses=unsure))
    path = tmp_path / f"map.{form}"
    words = ("--pin", PIN, "--start", START)
    convert(tmp_path / "fused", *words, "--to", form, "--out", path)
    convert(path, *words, "--to", "run", "--out", tmp_path / "back")
    found = [e.time_s for e in read_estimates(tmp_path / "back") for n in e.nodes if n.node == 3]
    assert found == [float(s) for s in (*range(6, 20), 21, *range(23, SECONDS + 1))]
    if form == "geojson":
        shapes = [f["geometry"]["type"] for f in features(path, kind="track", node=3)]
        assert shapes == ["LineString", "Point", "LineString"]


@pytest.mark.parametrize(("off_m", "period_s", "pieces"), [(2, 1, 1), (2, 0.25, 1), (6, 1, 3)])
def test_no_line_crosses_the_map_where_somebody_was_located_anew(
    tmp_path: Path, off_m: float, period_s: float, pieces: int
) -> None:
    lost = [
        replace(
            e,
            time_s=e.time_s * period_s,
            nodes=tuple(replace(n, x_m=n.x_m + off_m * (10.0 <= e.time_s < 20.0)) for n in e.nodes),
        )
        for e in estimates()
    ]
    write_estimates(tmp_path / "fused", lost)
    convert(tmp_path / "fused", "--pin", PIN, "--to", "geojson", "--out", tmp_path / "map.geojson")
    assert len(features(tmp_path / "map.geojson", kind="track", node=3)) == pieces


def test_the_page_cuts_a_track_at_the_same_jump() -> None:
    page = Path(content.__file__).parents[1] / "view" / "static" / "js" / "tracks.js"
    figures = dict(re.findall(r"^const (\w+) = ([\d.]+);", page.read_text("utf-8"), re.MULTILINE))
    assert float(figures["MIN_JUMP_M"]) == content.MIN_JUMP_M
    assert float(figures["FASTEST_M_S"]) == content.FASTEST_M_S


@pytest.mark.parametrize(("known", "told"), [(False, None), (True, ())])
def test_truth_in_another_frame_is_left_out_of_the_map(
    tmp_path: Path, known: bool, told: tuple[()] | None
) -> None:
    save_run(replace(run(priors=known), landmarks=LANDMARKS), tmp_path / "yard")
    write_estimates(tmp_path / "fused", estimates(), priors=told)
    words = ("--run", tmp_path / "yard", "--pin", PIN, "--to", "geojson")
    result = convert(tmp_path / "fused", *words, "--out", tmp_path / "map.geojson")
    assert any("the truth is left out" in line for line in result.remarks)
    assert {f["properties"].get("of", "estimate") for f in features(tmp_path / "map.geojson")} == {
        "estimate"
    }
    assert not features(tmp_path / "map.geojson", kind="landmark")


def test_a_track_of_another_tool_may_have_absolute_times(tmp_path: Path) -> None:
    _, fused = written(tmp_path)
    path = tmp_path / "map.geojson"
    convert(fused, "--pin", PIN, "--start", START, "--to", "geojson", "--out", path)
    document = json.loads(path.read_text("utf-8"))
    for feature in document["features"]:
        feature["properties"].pop("time_s", None)
        feature["properties"].pop("of", None)
    path.write_text(json.dumps(document), "utf-8")
    # And a place whose altitude and bearing are not known.
    words = ("--as", "estimate", "--pin", "48.137,11.575", "--to", "run", "--out")
    result = convert(path, *words, tmp_path / "back", "--start", START)
    assert any("east" in line for line in result.remarks)
    assert [e.time_s for e in read_estimates(tmp_path / "back")] == [e.time_s for e in estimates()]
    assert "say when the run's second 0 was" in refused(path, *words, tmp_path / "no")


def test_a_pin_may_lie_where_a_node_was(tmp_path: Path) -> None:
    _, fused = written(tmp_path)
    path = tmp_path / "map.geojson"
    convert(fused, "--pin", "48.137,11.575,60@3:10", "--to", "geojson", "--out", path)
    track = features(path, kind="track", node=3)[0]
    tenth = track["geometry"]["coordinates"][9]
    assert tenth == pytest.approx([11.575, 48.137], abs=1e-8)
    words = ("--pin", "48.137,11.575,60@3", "--to", "geojson", "--out", tmp_path / "first.geojson")
    convert(fused, *words)
    track = features(tmp_path / "first.geojson", kind="track", node=3)[0]
    assert track["geometry"]["coordinates"][0] == pytest.approx([11.575, 48.137], abs=1e-8)
    result = refused(
        fused, "--pin", "48,11,0@9", "--to", "geojson", "--out", tmp_path / "x.geojson"
    )
    assert "node 9 was not located" in result


def test_a_track_of_gnss_becomes_truth(tmp_path: Path) -> None:
    yard, _ = written(tmp_path)
    points = []
    for second in range(30):
        x_m, y_m, _heading = true_pose(2, second)
        there = on_map(x_m, y_m)
        points.append(
            f'<trkpt lat="{there["lat2"]:.9f}" lon="{there["lon2"]:.9f}">'
            f"<ele>520</ele><time>2026-05-04T09:30:{second:02d}Z</time></trkpt>"
        )
    (tmp_path / "watch.gpx").write_text(
        '<?xml version="1.0"?><gpx version="1.1" creator="watch" '
        'xmlns="http://www.topografix.com/GPX/1/1"><trk><name>Evening walk</name><trkseg>'
        + "".join(points)
        + "</trkseg></trk></gpx>"
    )
    convert(yard, "--to", "mcap", "--out", tmp_path / "yard.mcap")
    words = ("--as", "truth", "--node", 2, "--pin", "48.137,11.575,60", "--to", "run")
    words += ("--run", tmp_path / "yard.mcap")
    result = convert(tmp_path / "watch.gpx", *words, "--out", tmp_path / "with-truth")
    assert any("second 0 is 2026-05-04T09:30:00" in line for line in result.remarks)
    truth = load_run(tmp_path / "with-truth").truth
    assert [row.time_s for row in truth] == [float(s) for s in range(30)]
    for row in truth:
        assert math.dist((row.x_m, row.y_m), true_pose(2, row.time_s)[:2]) < 0.01


# -- landmarks -------------------------------------------------------------------------------------

PRESSES = (
    Event(3.0, 1, "landmark", "17"),
    Event(4.5, 1, "landmark", "17"),
    Event(9.0, 1, "landmark", "18"),
    Event(9.5, 2, "landmark", "99"),
    Event(10.0, 8, "landmark", "17"),
    Event(11.0, 1, "landmark", "17"),
    Event(12.0, 2, "footfall", ""),
)


@pytest.fixture
def pressed(tmp_path: Path) -> Path:
    save_run(run(events=PRESSES, truth=False), tmp_path / "pressed")
    (tmp_path / "surveyed.csv").write_text("id,x_m,y_m,z_m\n17,3,-2,\n18,10,4.5,3.25\n")
    return tmp_path / "pressed"


def check_truth(directory: Path) -> None:
    assert load_run(directory).truth == (
        Truth(3.0, 1, 3.0, -2.0),
        Truth(9.0, 1, 10.0, 4.5, None, 3.25),
        Truth(11.0, 1, 3.0, -2.0),
    )


def test_presses_become_truth_and_those_left_out_are_reported(
    tmp_path: Path, pressed: Path
) -> None:
    words = ("--landmarks", tmp_path / "surveyed.csv", "--to", "run", "--out", tmp_path / "out")
    result = convert(pressed, *words)
    check_truth(tmp_path / "out")
    assert (tmp_path / "out" / "truth.csv").exists()
    remarks = "\n".join(result.remarks)
    assert "truth from 3 of 6 landmark presses" in remarks
    assert "1 landmark press left out, of landmarks without a survey: 99 (node 2" in remarks
    assert "within 2 s after the same one: 17 (node 1, at 4.5 s)" in remarks
    assert "by nodes without other data: 17 (node 8, at 10.0 s)" in remarks


def test_a_run_with_landmarks_of_its_own_needs_no_option(tmp_path: Path, pressed: Path) -> None:
    (tmp_path / "surveyed.csv").rename(pressed / "landmarks.csv")
    result = convert(pressed, "--to", "run", "--out", tmp_path / "out")
    check_truth(tmp_path / "out")
    assert len([line for line in result.remarks if "left out" in line]) == 3
    assert load_run(pressed).counters == {
        "landmarks_unknown": 1,
        "landmarks_repeated": 1,
        "landmarks_of_strangers": 1,
    }


@pytest.mark.parametrize("form", ["geojson", "gpx"])
def test_landmarks_may_be_surveyed_on_a_map(tmp_path: Path, pressed: Path, form: str) -> None:
    only_marks = replace(run(truth=False), landmarks=LANDMARKS)
    save_run(only_marks, tmp_path / "marks")
    path = tmp_path / f"marks.{form}"
    convert(tmp_path / "marks", "--pin", PIN, "--to", form, "--out", path)
    words = ("--landmarks", path, "--pin", PIN, "--to", "run", "--out", tmp_path / "out")
    convert(pressed, *words)
    truth = load_run(tmp_path / "out").truth
    assert [(row.time_s, row.node) for row in truth] == [(3.0, 1), (9.0, 1), (11.0, 1)]
    assert (truth[1].x_m, truth[1].y_m) == pytest.approx((10.0, 4.5), abs=1e-3)


def test_a_second_truth_is_not_laid_over_the_first(tmp_path: Path, pressed: Path) -> None:
    save_run(run(events=PRESSES), tmp_path / "both")
    words = ("--landmarks", tmp_path / "surveyed.csv", "--to", "run", "--out", tmp_path / "out")
    assert "has a truth of its own" in refused(tmp_path / "both", *words)
    (tmp_path / "surveyed.csv").write_text("id,x_m,y_m\n55,3,-2\n")
    assert "no press counts: 5 landmark presses left out" in refused(pressed, *words)


# -- what is wrong ---------------------------------------------------------------------------------

GPX, MINE = '<gpx version="1.1">{}</gpx>', ("--as", "truth", "--node", "1")
HERE = '<trkpt lat="48.137" lon="11.575"></trkpt>'
FAR = '<trkpt lat="11.575" lon="48.137"><time>2026-05-04T09:30:00Z</time></trkpt>'
MARK = '<wpt lat="48.137" lon="11.575"><name>{}</name></wpt>'
COLLECTION = '{{"type":"FeatureCollection","features":[{}]}}'
SEVEN = '{"type":"Feature","id":7,"geometry":{"type":"Point","coordinates":[11.575,48.137]}}'


@pytest.mark.parametrize(
    ("name", "content", "words", "complaint"),
    [
        ("a_1.tum", "1 2 3\n", (), "truth or an estimate"),
        ("estimate_1.tum", "1 2 3\n", (), "line 1: 3 values, 8 are wanted"),
        ("estimate_1.tum", "#\n1 2 x 0 0 0 0 1\n", (), "line 2: 'x' is not a number"),
        ("estimate_1.tum", "1 2 nan 0 0 0 0 1\n", (), "'nan' is not a finite number"),
        ("estimate_1.tum", "1 2 3 0 0 0 0 2\n", (), "the quaternion's norm is 2.000"),
        ("estimate_1.tum", "1 2 3 0 0 0 0 1\n1 2 3 0 0 0 0 1\n", (), "two poses at 1 s"),
        ("estimate_1.tum", "1.7e9 2 3 0 0 0 0 1\n", (), "counts from 1970"),
        ("estimate_1.tum", "# nothing\n", (), "no pose in it"),
        ("estimate.tum", "1 2 3 0 0 0 0 1\n", (), "which node's trajectory"),
        ("a.gpx", "<gpx", (), "not GPX"),
        ("a.gpx", GPX.format("<trk></trk>"), (), "track 1: whose track is this"),
        ("a.gpx", GPX.format("<trk><number>1</number></trk>"), (), "truth or an estimate"),
        ("a.gpx", GPX.format(f"<trk><trkseg>{HERE}</trkseg></trk>"), MINE, "a point has no time"),
        ("a.gpx", GPX.format(f"<trk><trkseg>{FAR}</trkseg></trk>"), MINE, "longitude swapped"),
        ("a.gpx", GPX.format(MARK.format("")), (), "waypoint 1: a landmark needs a name"),
        ("a.gpx", GPX.format(2 * MARK.format("A")), (), "landmark 'A' is there twice"),
        ("a.gpx", "<gpx/>", (), "neither tracks nor landmarks"),
        ("a.geojson", "{", (), "line 1: not JSON"),
        ("a.geojson", "[]", (), "neither a FeatureCollection nor a Feature"),
        ("a.txt", "", (), "of what format is it? (--from"),
        ("a.geojson", '{"type":"FeatureCollection","features":[3]}', (), "feature 1: no GeoJSON"),
        ("a.geojson", COLLECTION.format(f"{SEVEN},{SEVEN}"), (), "'7' is there twice"),
        pytest.param("a.geojson", "[" * 100_000, (), "nested too deeply", id="deep"),
        ("a.geojson", '{"type":"Feature","geometry":3}', (), "no GeoJSON geometry"),
        ("a.geojson", '{"type":"Feature","geometry":null}', (), "neither tracks nor landmarks"),
    ],
)
def test_a_wrong_file_is_reported_in_one_line(
    tmp_path: Path, name: str, content: str, words: tuple[str, ...], complaint: str
) -> None:
    (tmp_path / name).write_text(content)
    line = refused(tmp_path / name, *words, "--pin", PIN, "--to", "run", "--out", tmp_path / "out")
    assert complaint in line
    assert name in line
    assert not (tmp_path / "out").exists()


TRACK = '{{"type":"Feature","geometry":{{"type":"{0}","coordinates":{1}}},"properties":{2}}}'


@pytest.mark.parametrize(
    ("shape", "coordinates", "properties", "complaint"),
    [
        ("LineString", "[[11,48],[11,48]]", "{}", "whose track is this"),
        ("Polygon", "[[]]", "{}", "a track is a LineString, not a Polygon"),
        (
            "LineString",
            "[[11.575,48.137],[11.575,48.137]]",
            '{"node":1,"of":"estimate","time_s":[1,1]}',
            "node 1 has two positions at 1 s",
        ),
        ("LineString", "[[11,48],[11,48]]", '{"node":1}', "truth or an estimate"),
        ("LineString", "[[11.5,48],[11,48]]", '{"node":1,"of":"truth"}', "a time for each"),
        (
            "LineString",
            "[[11.575,48.137],[11.575,48.137]]",
            '{"node":1,"of":"truth","time_s":[1]}',
            "a time for each of its 2",
        ),
        (
            "LineString",
            "[[48.1,11.5],[48.1,11.5]]",
            '{"node":1,"of":"truth","time_s":[1,2]}',
            "are latitude and longitude swapped",
        ),
        (
            "LineString",
            "[[11.5,91],[11.5,91]]",
            '{"node":1,"of":"truth","time_s":[1,2]}',
            "[11.5, 91] is no longitude and latitude",
        ),
        (
            "LineString",
            '[["a",11.5],[48.1,11.5]]',
            '{"node":1,"of":"truth","time_s":[1,2]}',
            "is no longitude and latitude",
        ),
        ("Point", "[11.575,48.137]", '{"kind":"landmark"}', "a landmark needs an id"),
        ("Point", "[11.575,48.137]", '{"id":"\\ud800"}', "a landmark needs an id"),
        (
            "Point",
            "[11.575,48.137]",
            f'{{"node":1,"kind":"track","of":"truth","time_s":[{10**400}]}}',
            "a time for each of its 1",
        ),
    ],
)
def test_a_wrong_feature_is_reported_in_one_line(
    tmp_path: Path, shape: str, coordinates: str, properties: str, complaint: str
) -> None:
    (tmp_path / "a.geojson").write_text(TRACK.format(shape, coordinates, properties))
    words = ("--pin", PIN, "--to", "run", "--out", tmp_path / "out")
    assert complaint in refused(tmp_path / "a.geojson", *words)


@pytest.mark.parametrize("course", ["1e999", f"{10**400}", '"north"'])
def test_a_course_that_is_no_number_is_an_unknown_heading(tmp_path: Path, course: str) -> None:
    properties = f'{{"node":1,"kind":"track","of":"truth","time_s":[1],"course_deg":[{course}]}}'
    (tmp_path / "a.geojson").write_text(TRACK.format("Point", "[11.575,48.137]", properties))
    convert(tmp_path / "a.geojson", "--pin", PIN, "--to", "run", "--out", tmp_path / "out")
    assert [row.heading_rad for row in load_run(tmp_path / "out").truth] == [None]


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("truth_1.tum", "5e7 1 0 0 0 0 0 1\n", "time_s 5e+07 is not between -86400 and 604800"),
        ("estimate_1.tum", "0 1 2e8 0 0 0 0 1\n", "y_m 2e+08 is not between"),
        ("truth_99999999999999999999.tum", "0 1 0 0 0 0 0 1\n", "node 1e+20 is not between"),
        (
            "a.gpx",
            '<gpx version="1.1"><trk><number>1</number><type>truth</type><trkseg>'
            '<trkpt lat="nan" lon="11"><time>2026-05-04T09:30:00Z</time></trkpt>'
            "</trkseg></trk></gpx>",
            "x_m nan is not between",
        ),
    ],
)
def test_what_no_run_can_hold_is_refused_instead_of_written(
    tmp_path: Path, name: str, content: str, complaint: str
) -> None:
    (tmp_path / name).write_text(content)
    line = refused(tmp_path / name, "--pin", PIN, "--to", "run", "--out", tmp_path / "out")
    assert complaint in line
    assert name in line
    assert not (tmp_path / "out").exists()


def test_wrong_requests_are_reported_in_one_line(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    out = tmp_path / "out"
    assert "no such file" in refused(tmp_path / "nowhere", "--to", "tum", "--out", out)
    (tmp_path / "empty").mkdir()
    assert "neither a run nor" in refused(tmp_path / "empty", "--to", "tum", "--out", out)
    words = ("--from", "tum", "--to", "run", "--out", out)
    assert "no trajectories" in refused(tmp_path / "empty", *words)
    assert "no such file" in refused(tmp_path / "nowhere", *words)
    (tmp_path / "a.gpx").touch()
    assert "neither a run directory nor" in refused(fused, "--run", tmp_path / "a.gpx", *words)
    assert "SOURCE itself" in refused(yard, "--to", "run", "--out", yard)
    save_run(run(truth=False), tmp_path / "unfused")
    assert "fuse it first" in refused(tmp_path / "unfused", "--to", "tum", "--out", out)
    words = ("--pin", PIN, "--to", "gpx", "--out", tmp_path / "x.gpx")
    assert "fuse it first" in refused(tmp_path / "unfused", *words)
    assert "no zone" in refused(
        fused, "--start", "2026-05-04T09:30:00", "--to", "tum", "--out", out
    )
    assert "is no time" in refused(fused, "--start", "noon", "--to", "tum", "--out", out)
    none = tmp_path / "none.csv"
    none.write_text("id,x_m,y_m\n")
    words = ("--landmarks", none, "--to", "run", "--out", out)
    assert "no landmark in it" in refused(tmp_path / "unfused", *words)
    none.write_text("id,x_m,y_m\n17,0,0\n")
    assert "no landmark was pressed" in refused(tmp_path / "unfused", *words)
    none.write_text("id,x_m,y_m\n17,0,zero\n")
    assert "line 2: column y_m: 'zero'" in refused(tmp_path / "unfused", *words)
    assert CommandResult("convert", fused, "--to", "gpx", "--out", tmp_path / "x.gpx").status == 2
    assert not out.exists()


def test_existing_files_are_not_overwritten_unasked(tmp_path: Path) -> None:
    yard, fused = written(tmp_path)
    out = tmp_path / "t"
    convert(fused, "--run", yard, "--to", "tum", "--out", out)
    assert "--overwrite" in refused(fused, "--to", "tum", "--out", out)
    (out / "estimate_9.tum").write_text("left over")
    (out / "notes.txt").write_text("mine")
    convert(fused, "--to", "tum", "--out", out, "--overwrite")
    assert sorted(path.name for path in out.iterdir()) == [
        *(f"estimate_{node}.tum" for node in NAMES),
        "notes.txt",
    ]
    one = tmp_path / "map.geojson"
    convert(fused, "--pin", PIN, "--to", "geojson", "--out", one)
    assert "--overwrite" in refused(fused, "--pin", PIN, "--to", "geojson", "--out", one)
    assert re.search("one file", refused(fused, "--pin", PIN, "--to", "geojson", "--out", out))
    assert re.search("is a directory", refused(fused, "--to", "tum", "--out", one))
