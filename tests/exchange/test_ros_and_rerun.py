"""ROS 2 bags and Rerun recordings, as readers of their own makers find them."""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from relpos.exchange.content import Content
from relpos.exchange.rrd import write_rrd
from relpos.fusion.estimator import NodeStatus
from relpos.measurements import Range, Truth
from relpos.runs import Run, load_run, read_estimates, save_run, write_estimates
from support.small_team import convert, estimates, refused, run, written

START = "2026-05-04T09:30:00Z"
START_UNIX_S = 1777887000.0


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    run, estimate = written(tmp_path_factory.mktemp("team"))
    lost = {(3, second): NodeStatus.AMBIGUOUS for second in range(1, 6)}
    write_estimates(estimate, estimates(statuses=lost))
    return run, estimate


@pytest.fixture(scope="module")
def bag(team: tuple[Path, Path]) -> Path:
    run, estimate = team
    out = estimate.parent / "bag"
    options = ("--run", run, "--start", START, "--to", "rosbag2", "--out", out)
    convert(estimate, *options)
    return out


def located(estimate: Path) -> dict[tuple[int, float], Any]:
    good = (NodeStatus.OK, NodeStatus.STALE, NodeStatus.LOST)
    return {
        (n.node, e.time_s): n for e in read_estimates(estimate) for n in e.nodes if n.status in good
    }


def test_rosbags_reads_the_bag_and_finds_the_poses_with_their_covariances(
    team: tuple[Path, Path], bag: Path
) -> None:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    expected = located(team[1])
    found = {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        topics = {c.topic for c in reader.connections}
        for connection, stamp_ns, data in reader.messages():
            if not connection.topic.endswith("/pose"):
                continue
            message = reader.deserialize(data, connection.msgtype)
            assert message.header.frame_id == "map"
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
            node = int(connection.topic.split("_")[1].split("/")[0])
            found[node, round(stamp_ns * 1e-9 - START_UNIX_S, 3)] = message.pose
    assert found.keys() == {(node, round(at_s, 3)) for node, at_s in expected}
    for (node, at_s), n in expected.items():
        pose = found[node, round(at_s, 3)]
        place, turn = pose.pose.position, pose.pose.orientation
        assert (place.x, place.y, place.z) == pytest.approx((n.x_m, n.y_m, n.z_m))
        assert math.remainder(
            2 * math.atan2(turn.z, turn.w) - n.heading_rad, math.tau
        ) == pytest.approx(0.0, abs=1e-9)
        covariance = pose.covariance.reshape(6, 6)
        assert covariance[0, 0] == pytest.approx(n.variance_x_m2)
        assert covariance[0, 1] == covariance[1, 0] == pytest.approx(n.covariance_xy_m2)
        assert covariance[2, 2] == pytest.approx(n.sigma_z_m**2)
        assert covariance[5, 5] == pytest.approx(n.sigma_heading_rad**2)
    assert {"/tf", "/relpos/node_1/odometry", "/relpos/node_1/truth"} <= topics


def test_the_mcap_support_of_ros_reads_ranges_odometry_and_transforms(
    team: tuple[Path, Path], bag: Path
) -> None:
    mcap_ros2 = pytest.importorskip("mcap_ros2.reader")
    run = load_run(team[0])
    ranges: list[tuple[float, int, int, float]] = []
    last: dict[int, Any] = {}
    truth = {}
    frames = set()
    for item in mcap_ros2.read_ros2_messages(str(next(bag.glob("*.mcap")))):
        message, words = item.ros_msg, item.channel.topic.split("/")
        at_s = round(item.log_time_ns * 1e-9 - START_UNIX_S, 3)
        if words[-1].startswith("range_to"):
            node, peer = int(words[2].split("_")[1]), int(words[3].split("_")[2])
            ranges.append((at_s, node, peer, round(message.range, 3)))
        elif words[-1] == "truth":
            truth[at_s, int(words[2].split("_")[1])] = message.pose
        elif words[-1] == "odometry":
            last[int(words[2].split("_")[1])] = message
        elif words[-1] == "tf":
            frames |= {(t.header.frame_id, t.child_frame_id) for t in message.transforms}
    expected = [(round(r.time_s, 3), r.node, r.peer, round(r.range_m, 3)) for r in run.ranges]
    assert sorted(ranges) == sorted(expected)
    assert ("map", "node_1") in frames
    for t in run.truth:
        place, turn = truth[t.time_s, t.node].position, truth[t.time_s, t.node].orientation
        yaw_rad = 2 * math.atan2(turn.z, turn.w)
        told = (place.x, place.y, place.z, math.remainder(yaw_rad, math.tau))
        assert told == pytest.approx((t.x_m, t.y_m, t.z_m, t.heading_rad))
    # Displacements one after the other, with complex numbers.
    at: dict[int, complex] = defaultdict(complex)
    heading: dict[int, float] = defaultdict(float)
    for m in run.motions:
        at[m.node] += complex(m.dx_m, m.dy_m) * complex(
            math.cos(heading[m.node]), math.sin(heading[m.node])
        )
        heading[m.node] += m.dtheta_rad
    assert last.keys() == at.keys()
    for node, message in last.items():
        place = message.pose.pose.position
        assert complex(place.x, place.y) == pytest.approx(at[node])
        assert message.child_frame_id == f"node_{node}"
        twist = message.twist.twist
        assert (twist.linear.x, twist.angular.z) == pytest.approx((0.9, 0.1))


def test_a_failed_range_is_infinite_in_a_bag_as_rep_117_has_it(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    failed = Range(2.5, 2, 3, 0.0)
    yard = run()
    flat = (Truth(0.0, 1, 1.0, 2.0),)
    yard = replace(yard, measurements=(*yard.measurements, failed), truth=flat)
    save_run(yard, tmp_path / "yard")
    convert(tmp_path / "yard", "--to", "rosbag2", "--out", tmp_path / "bag")
    with AnyReader(
        [tmp_path / "bag"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)
    ) as reader:
        told = {
            c.topic: reader.deserialize(data, c.msgtype).range
            for c, _, data in reader.messages()
            if "/range_to_" in c.topic
        }
    assert told["/relpos/node_2/range_to_3"] == math.inf
    assert math.isfinite(told["/relpos/node_1/range_to_2"])


def test_a_failed_range_is_a_gap_in_rerun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = MagicMock()  # The library itself needs 600 MB.
    monkeypatch.setitem(sys.modules, "rerun", library)
    measured = (Range(2.5, 2, 3, 0.0), Range(3.5, 2, 3, 4.0))
    write_rrd(tmp_path / "team.rrd", Content(Run("yard", measurements=measured)))
    (told,) = library.Scalars.columns.call_args_list
    assert told.kwargs["scalars"] == pytest.approx([math.nan, 4.0], nan_ok=True)


@pytest.mark.soak  # it needs 600 MB, which `make soak` installs
def test_rerun_reads_what_was_written_for_it(team: tuple[Path, Path], tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun", reason="make soak installs it")
    run, estimate = team
    out = tmp_path / "team.rrd"
    convert(estimate, "--run", run, "--to", "rrd", "--out", out)
    rows: dict[str, int] = defaultdict(int)
    places = {}
    for chunk in rerun.chunk.RrdReader(out).stream().to_chunks():
        rows[chunk.entity_path] += chunk.num_rows
        if chunk.entity_path == "/world/node_1":
            batch = chunk.to_record_batch()
            names = batch.schema.names
            at = batch.column(names.index("run")).to_pylist()
            name = next(name for name in names if name.endswith("positions"))
            for time, point in zip(at, batch.column(name).to_pylist(), strict=True):
                places[round(time.total_seconds(), 3)] = tuple(point[0])
    expected = located(estimate)
    mine = {round(at_s, 3): n for (node, at_s), n in expected.items() if node == 1}
    assert places.keys() == mine.keys()
    for at_s, n in mine.items():
        assert places[at_s][:2] == pytest.approx((n.x_m, n.y_m), abs=1e-4)
    assert rows["/world/node_1/ellipse"] == len(mine)
    assert rows["/world/truth/node_1"] > 0
    first = load_run(run).ranges[0]
    assert rows[f"/range/{first.node}_{first.peer}"] > 0


def test_a_format_for_others_alone_is_not_read(bag: Path, tmp_path: Path) -> None:
    words = refused(bag, "--from", "rosbag2", "--to", "csv", "--out", tmp_path / "x")
    assert "is written, not read" in words


def test_a_second_bag_replaces_the_first_when_asked(team: tuple[Path, Path], bag: Path) -> None:
    run, estimate = team
    options = (estimate, "--run", run, "--to", "rosbag2", "--out", bag)
    assert "--overwrite" in refused(*options)
    convert(*options, "--start", START, "--overwrite")


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_without_rosbags_the_install_line_is_told_and_an_old_bag_stays(
    team: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    convert(team[0], "--to", "rosbag2", "--out", old)
    before = files_of(old)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    for out in (new, old):
        words = refused(team[0], "--to", "rosbag2", "--out", out, "--overwrite")
        assert "rosbags (extra 'ros') is not installed: " in words
        assert "install" in words.split("installed: ")[1]
    assert not new.exists()
    assert files_of(old) == before


def test_a_bag_of_nothing_is_refused_in_one_line_and_leaves_no_folder(tmp_path: Path) -> None:
    save_run(replace(run(truth=False), measurements=()), tmp_path / "empty")
    words = refused(tmp_path / "empty", "--to", "rosbag2", "--out", tmp_path / "bag")
    assert "neither measurements nor estimates nor truth" in words
    assert not (tmp_path / "bag").exists()
