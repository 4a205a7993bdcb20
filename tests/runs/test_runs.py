"""Run directories: everything the run format promises about what comes in and goes out."""

from __future__ import annotations

import gzip
import math
import re
from dataclasses import MISSING, fields, replace
from itertools import count
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import relpos
from relpos.errors import DataError
from relpos.fusion.estimator import (
    Alternative,
    Estimate,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    Shape,
)
from relpos.live.inputs import run_items
from relpos.measurements import (
    BOUNDS,
    Event,
    Heading,
    Height,
    Motion,
    Observation,
    Prior,
    Range,
    Step,
)
from relpos.recording import topics
from relpos.runs import (
    InitialPose,
    Run,
    load_run,
    read_estimates,
    save_run,
    write_estimates,
)
from relpos.runs.run import assemble
from relpos.tracks import estimated_pairs
from shared_data import DATA

MOTION = "time_s,node,dx_m,dy_m,dtheta_rad\n1,1,0.5,0,0\n1,2,0.4,0.1,-0.2\n"
RANGES = "time_s,node,peer,range_m\n0.5,1,2,3.25\n"
IMU_HEADER = "time_s,node,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s,mx_ut,my_ut,mz_ut\n"


def write(directory: Path, **files: str) -> Path:
    """Files by name, ``motion_csv`` for motion.csv."""
    for name, text in files.items():
        (directory / name.replace("_", ".", 1)).write_text(text, encoding="utf-8")
    return directory


def fault(directory: Path) -> str:
    with pytest.raises(DataError) as caught:
        load_run(directory)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def example_of(kind: type) -> Observation:
    """Return an observation of node 1 at second 1, of any kind."""
    whole = count(1)
    hints = get_type_hints(kind)
    values = {float: lambda: 1.0, int: lambda: next(whole), str: lambda: "some"}
    return kind(**{f.name: values[hints[f.name]]() for f in fields(kind) if f.default is MISSING})


@pytest.mark.parametrize("kind", get_args(Observation))
def test_every_kind_of_observation_is_saved_loaded_played_recorded_and_fused(
    kind: type, tmp_path: Path
) -> None:
    row = example_of(kind)
    run = relpos.simulate("paper-p1", 1, seconds=3)
    observed = assemble("one", run.description, [*run.measurements, row])
    save_run(observed, tmp_path)
    loaded = load_run(tmp_path)
    played = [one for item in run_items(loaded) for one in item.observations]
    assert row in played
    assert kind in topics.ROWS
    numbers = {name for name, of in get_type_hints(kind).items() if of in (float, float | None)}
    assert numbers <= BOUNDS.keys()
    for name in ("bank", "particle", "deadreckoning"):
        assert relpos.fuse(loaded, name).estimates
    assert relpos.fuse(loaded, smooth=True).estimates


def test_rows_become_measurements_in_time_order(tmp_path: Path) -> None:
    run = load_run(write(tmp_path, motion_csv=MOTION, ranges_csv=RANGES))
    assert run.measurements == (
        Range(0.5, 1, 2, 3.25),
        Motion(1.0, 1, 0.5, 0.0, 0.0),
        Motion(1.0, 2, 0.4, 0.1, -0.2),
    )
    assert run.node_ids == (1, 2)


def test_a_missing_file_means_none_of_that_data(tmp_path: Path) -> None:
    run = load_run(tmp_path)
    assert run.measurements == ()
    assert run.priors == ()
    assert run.load_imu() == {}
    assert run.name == tmp_path.name


def test_unknown_columns_and_files_are_ignored(tmp_path: Path) -> None:
    text = "note,range_m,peer,node,time_s\nlift,2.5,2,1,0\n"
    write(tmp_path, ranges_csv=text, other_csv="nonsense")
    assert load_run(tmp_path).ranges == (Range(0.0, 1, 2, 2.5),)


def test_optional_cells_may_be_empty(tmp_path: Path) -> None:
    header = "time_s,node,dx_m,dy_m,dtheta_rad,sigma_x_m,sigma_y_m,gain_version,moving\n"
    write(tmp_path, motion_csv=header + "1,1,0,0,0,,0.1,,1\n2,1,0,0,0,0.2,,3,\n")
    assert load_run(tmp_path).motions == (
        Motion(1.0, 1, 0, 0, 0, None, 0.1, None, None, moving=True),
        Motion(2.0, 1, 0, 0, 0, 0.2, None, None, gain_version=3),
    )
    write(tmp_path, events_csv="time_s,node,event,value\n1,1,landmark,\n")
    assert load_run(tmp_path).events == (Event(1.0, 1, "landmark", ""),)


@pytest.mark.parametrize(("every_s", "dx_m"), [(1, 0.004), (3, 2.0)])
def test_neither_a_long_rest_nor_sparse_rows_look_like_milliseconds(
    tmp_path: Path, every_s: int, dx_m: float
) -> None:
    rows = "".join(f"{every_s * n},1,{dx_m},0,0\n" for n in range(3000))
    write(tmp_path, motion_csv="time_s,node,dx_m,dy_m,dtheta_rad\n" + rows)
    assert len(load_run(tmp_path).motions) == 3000


def test_unsorted_rows_are_sorted_and_equal_times_keep_their_order(tmp_path: Path) -> None:
    text = "time_s,node,peer,range_m\n2.1,1,2,1\n1,1,2,2\n1,1,2,3\n-0.5,1,2,4\n"
    run = load_run(write(tmp_path, ranges_csv=text))
    assert [r.range_m for r in run.ranges] == [4.0, 2.0, 3.0, 1.0]
    assert run.counters["unsorted_rows"] == 3


def test_rows_a_little_out_of_order_as_sessions_write_them_are_not_counted(tmp_path: Path) -> None:
    text = "time_s,node,peer,range_m\n2,1,2,1\n1.2,1,2,2\n1.1,1,2,3\n"
    assert "unsorted_rows" not in load_run(write(tmp_path, ranges_csv=text)).counters


def test_a_gzipped_file_is_read_like_a_plain_one(tmp_path: Path) -> None:
    (tmp_path / "motion.csv.gz").write_bytes(gzip.compress(MOTION.encode()))
    assert len(load_run(tmp_path).motions) == 2


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path: Path) -> None:
    (tmp_path / "motion.csv").write_bytes(
        b"\xef\xbb\xbf" + MOTION.replace("\n", "\r\n").encode() + b"\r\n"
    )
    assert len(load_run(tmp_path).motions) == 2


def test_a_range_of_zero_is_kept_as_the_failure_it_marks(tmp_path: Path) -> None:
    run = load_run(write(tmp_path, ranges_csv="time_s,node,peer,range_m\n0,1,2,0\n1,1,2,4\n"))
    assert [r.range_m for r in run.ranges] == [0.0, 4.0]
    assert run.counters["ranges_failed"] == 1


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("1,1,abc,0,0", "line 3: column dx_m: 'abc' is not a number"),
        ("1,1,nan,0,0", "line 3: column dx_m: 'nan' is not a finite number"),
        ("1,1,0,inf,0", "line 3: column dy_m: 'inf' is not a finite number"),
        ("1,1,0,0,1e999", "line 3: column dtheta_rad"),
        ("1,1,1_0,0,0", "line 3: column dx_m"),
        ("1,1,0", "line 3: column dy_m is empty"),
        ("1,1,0,,0", "line 3: column dy_m is empty"),
        ("1,1.5,0,0,0", "line 3: column node: '1.5' is not a whole number"),
        ("1,-1,0,0,0", "line 3: column node: '-1' is no node id"),
        ("1,9007199254740993,0,0,0", "'9007199254740993' is greater than 9007199254740991"),
        ("1,1,0,0,0,7", "line 3: 6 cells for 5 columns"),
        ('1,1,0,0,"0', "line 3: not CSV"),
    ],
)
def test_a_malformed_row_names_file_line_and_column(
    tmp_path: Path, row: str, complaint: str
) -> None:
    header = "time_s,node,dx_m,dy_m,dtheta_rad\n0,1,0,0,0\n"
    message = fault(write(tmp_path, motion_csv=header + row + "\n"))
    assert "motion.csv" in message
    assert complaint in message


@pytest.mark.parametrize(
    "row", ["1", "1,1,0", "1,1,0,0,1e", "1,1,0,0,-", '1,1,0,"', '1,1,0,0,"0', "1,1,0,0,0"]
)
def test_a_last_row_that_a_kill_cut_off_is_left_out_told_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, row: str
) -> None:
    whole = "time_s,node,dx_m,dy_m,dtheta_rad,sigma_x_m\n0,1,0,0,0,1\n"
    run = load_run(write(tmp_path, motion_csv=whole + row))
    assert len(run.motions) == run.counters["rows_cut_off"] == 1
    assert "motion.csv: line 3 was cut off" in caplog.text


def test_a_kill_in_the_middle_of_a_character_loses_that_row_alone(tmp_path: Path) -> None:
    text = 'time_s,node,event,value\n0,1,landmark,"é, 1"\n1,1,landmark,"é'.encode()
    (tmp_path / "events.csv").write_bytes(text[:-1])
    run = load_run(tmp_path)
    assert [e.value for e in run.events] == ["é, 1"]
    assert run.counters["rows_cut_off"] == 1


@pytest.mark.parametrize("row", ["1,1,0,0,0", "1,1,0,0,0,", '1,1,0,0,"0"', ",,,", " "])
def test_a_last_row_that_merely_has_no_line_end_is_as_any_other(tmp_path: Path, row: str) -> None:
    text = "time_s,node,dx_m,dy_m,dtheta_rad,sigma_x_m\n0,1,0,0,0\n"
    run = load_run(write(tmp_path, motion_csv=text + row))
    assert len(run.motions) == 1 + row.startswith("1")
    assert not run.counters


def test_a_wrong_cell_before_the_end_of_a_row_is_not_cut_off(tmp_path: Path) -> None:
    text = "time_s,node,dx_m,dy_m,dtheta_rad\n0,1,0,0,0\n1,1,abc,0,0"
    assert "line 3: column dx_m: 'abc' is not a number" in fault(write(tmp_path, motion_csv=text))
    quoted = text.replace("abc", '0,"a"b')
    assert "line 3: not CSV" in fault(write(tmp_path, motion_csv=quoted))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "not even a header"),
        ("time_s,node,dx_m,dy_m\n", "column dtheta_rad is missing"),
        ("time_s;node;dx_m;dy_m;dtheta_rad\n", "separated by ','"),
        ("time_s,node,node,dx_m,dy_m,dtheta_rad\n", "column node is there twice"),
    ],
)
def test_a_wrong_header_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    assert complaint in fault(write(tmp_path, motion_csv=text))


def test_a_node_that_ranges_to_itself_is_refused(tmp_path: Path) -> None:
    text = "time_s,node,peer,range_m\n0,3,3,1\n"
    assert "line 2: column peer: node 3 ranges to itself" in fault(write(tmp_path, ranges_csv=text))


def test_a_truncated_or_damaged_gzip_file_is_one_line(tmp_path: Path) -> None:
    whole = gzip.compress(MOTION.encode() * 50)
    for data in (whole[: len(whole) // 2], whole[:3], b"no gzip", whole[:-4] + b"abcd"):
        (tmp_path / "motion.csv.gz").write_bytes(data)
        assert "motion.csv.gz: the gzip file is truncated or damaged" in fault(tmp_path)


def test_binary_garbage_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "motion.csv").write_bytes(bytes(range(256)) * 10)
    assert "motion.csv: line 2: not UTF-8 text" in fault(tmp_path)


def test_the_same_table_twice_is_refused(tmp_path: Path) -> None:
    write(tmp_path, motion_csv=MOTION)
    (tmp_path / "motion.csv.gz").write_bytes(gzip.compress(MOTION.encode()))
    assert "which one counts" in fault(tmp_path)


@given(data=st.binary(max_size=200))
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_only_documented_errors_leave_the_reader(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "motion.csv").write_bytes(MOTION.encode() + data)
    (tmp_path / "imu.csv").write_bytes(IMU_HEADER.encode() + data)
    (tmp_path / "run.toml").write_bytes(data)
    for read in (lambda: load_run(tmp_path), lambda: load_run_imu(tmp_path)):
        try:
            read()
        except DataError as error:
            assert "\n" not in str(error).strip()  # noqa: PT017


def load_run_imu(directory: Path) -> object:
    (directory / "run.toml").unlink(missing_ok=True)
    (directory / "motion.csv").unlink(missing_ok=True)
    return load_run(directory).load_imu()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("name = ", "not TOML"),
        ('initial_pose = "somewhere"', 'key initial_pose: "somewhere" is none of'),
        ("heading_known = 1", "key heading_known: 1 is neither true nor false"),
        ("name = 5", "key name: 5 is not text"),
        ("[initial.1]\nx_m = 1.0\ny_m = 2.0", "key initial.1.heading_rad is missing"),
        ("[initial.a]\nx_m = 1.0", "table initial.a: 'a' is no node id"),
        ('[nodes.1]\nstature_m = "tall"', "key nodes.1.stature_m: 'tall' is not a number"),
        ("[nodes.1]\nantenna_offset_m = [1.0]", "is not [forward, left]"),
        ("[nodes.1]\nantenna_offset_m = 5", "is not [forward, left]"),
        ('[nodes."²"]\nname = "n"', "is no node id"),
        ("[building]\nfloors_m = [3.0, 6.0]", "does not go from the lowest floor over"),
        ("[initial.1]\nx_m = nan\ny_m = 2\nheading_rad = 0", "is not a finite number"),
    ],
)
def test_a_wrong_description_names_file_and_key(tmp_path: Path, text: str, complaint: str) -> None:
    message = fault(write(tmp_path, run_toml=text))
    assert "run.toml" in message
    assert complaint in message


def test_every_key_of_the_description_is_read(tmp_path: Path) -> None:
    text = """
name = "n"
source = "s"
heading_known = true
mount = "chest"
stature_m = 1.8
leg_length_m = 0.95
sensor_height_m = 1
true_distance_m = 20.0
true_turn_deg = 180.0
something_else = [1, 2]
[initial.2]
x_m = 1
y_m = 2
heading_rad = 0.5
sigma_m = 0.1
sigma_rad = 0.2
[nodes.2]
name = "Ann"
stature_m = 1.7
leg_length_m = 0.9
height_m = 1.2
antenna_offset_m = [0.1, -0.2]
"""
    run = load_run(write(tmp_path, run_toml=text))
    assert run.priors == (Prior(2, 1.0, 2.0, 0.5, 0.1, 0.2),)
    assert run.heading_known
    assert run.nodes[2].antenna_offset_m == (0.1, -0.2)
    assert run.nodes[2].leg_length_m == 0.9
    assert run.description.leg_length_m == 0.95
    assert run.description.sensor_height_m == 1.0
    assert run.description.true_turn_deg == 180.0
    assert (run.description.mount, run.description.source) == ("chest", "s")


def test_a_common_start_puts_every_node_on_one_place(tmp_path: Path) -> None:
    write(tmp_path, run_toml='initial_pose = "common"', ranges_csv=RANGES)
    first, second = load_run(tmp_path).priors
    assert second == replace(first, node=2)
    assert (first.node, first.x_m, first.y_m, first.heading_rad) == (1, 0.0, 0.0, 0.0)
    # People who start in one place do not stand in each other.
    assert 0.3 <= first.sigma_m <= 0.7
    assert 5.0 <= math.degrees(first.sigma_rad) <= 15.0


def test_a_start_from_truth_takes_the_first_pose_alone(tmp_path: Path) -> None:
    truth = "time_s,node,x_m,y_m,heading_rad\n1,1,9,9,9\n0,1,1,2,0.5\n0,2,3,4,\n"
    write(tmp_path, run_toml='initial_pose = "from truth"', motion_csv=MOTION, truth_csv=truth)
    first, second = load_run(tmp_path).priors
    assert first == Prior(1, 1.0, 2.0, 0.5, 0.0, 0.0)
    assert (second.x_m, second.y_m, second.sigma_m) == (3.0, 4.0, 0.0)
    assert second.sigma_rad >= 3.0


def test_a_first_true_pose_long_after_the_start_is_no_prior(tmp_path: Path) -> None:
    write(tmp_path, motion_csv=MOTION, truth_csv="time_s,node,x_m,y_m\n60,1,1,2\n0,2,1,2\n")
    assert [p.node for p in load_run(tmp_path).priors_for(InitialPose.FROM_TRUTH)] == [2]


def test_a_start_from_truth_without_truth_is_refused(tmp_path: Path) -> None:
    write(tmp_path, run_toml='initial_pose = "from truth"', motion_csv=MOTION)
    with pytest.raises(DataError, match="there is none"):
        _ = load_run(tmp_path).priors


def test_the_start_is_unknown_by_default(tmp_path: Path) -> None:
    truth = "time_s,node,x_m,y_m\n0,1,1,2\n"
    assert load_run(write(tmp_path, motion_csv=MOTION, truth_csv=truth)).priors == ()


def test_landmark_presses_make_the_truth(tmp_path: Path) -> None:
    write(
        tmp_path,
        landmarks_csv="id,x_m,y_m,z_m\nA,1,2,3\n7,4,5,\n",
        events_csv="time_s,node,event,value\n9,1,landmark,7\n3,1,landmark,A\n"
        "5,1,landmark,nowhere\n6,1,mark,A\n10,1,landmark,7\n20,1,landmark,7\n",
    )
    run = load_run(tmp_path)
    assert [(t.time_s, t.x_m, t.y_m, t.z_m) for t in run.truth] == [
        (3.0, 1.0, 2.0, 3.0),
        (9.0, 4.0, 5.0, None),
        (20.0, 4.0, 5.0, None),
    ]
    assert (run.counters["landmarks_unknown"], run.counters["landmarks_repeated"]) == (1, 1)


def test_inertial_data_are_sorted_and_split_by_node(tmp_path: Path) -> None:
    rows = "0.02,1,1,2,3,4,5,6,7,8,9\n0.01,2,0,0,0,0,0,0,0,0,0\n0.00,1,9,8,7,6,5,4,3,2,1\n"
    imu = load_run(write(tmp_path, imu_csv=IMU_HEADER + rows)).load_imu()
    assert sorted(imu) == [1, 2]
    assert imu[1].time_s.tolist() == [0.0, 0.02]
    assert imu[1].acceleration_m_s2[1].tolist() == [1.0, 2.0, 3.0]
    assert imu[1].magnetic_field_ut[0].tolist() == [3.0, 2.0, 1.0]


@pytest.mark.parametrize(
    ("time_s", "pressure_pa", "told"),
    [
        ("0.02", "99999999999", "column pressure_pa: '99999999999' is not between 0 and 1e+06"),
        ("0.02", "-1", "column pressure_pa: '-1' is negative"),
        ("1e9", "101325", "column time_s: '1e9' is not between"),
    ],
)
def test_an_inertial_recording_is_refused_beyond_its_bounds(
    tmp_path: Path, time_s: str, pressure_pa: str, told: str
) -> None:
    header = IMU_HEADER.rstrip("\n") + ",pressure_pa\n"
    good = "0.00,1,1,2,3,4,5,6,7,8,9,101325\n"
    text = header + good + f"{time_s},1,1,2,3,4,5,6,7,8,9,{pressure_pa}\n"
    with pytest.raises(DataError, match=r"imu.csv: line 3: " + re.escape(told)):
        load_run(write(tmp_path, imu_csv=text)).load_imu()


def test_a_slow_or_absent_magnetometer_leaves_gaps(tmp_path: Path) -> None:
    imu = load_run(write(tmp_path, imu_csv=IMU_HEADER + "0,1,1,2,3,4,5,6,,,\n")).load_imu()
    assert np.isnan(imu[1].magnetic_field_ut).all()
    header = IMU_HEADER.replace(",mx_ut,my_ut,mz_ut", "")
    imu = load_run(write(tmp_path, imu_csv=header + "0,1,1,2,3,4,5,6\n")).load_imu()
    assert imu[1].angular_rate_rad_s[0].tolist() == [4.0, 5.0, 6.0]
    assert np.isnan(imu[1].magnetic_field_ut).all()


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("0.5,1,x,2,3,4,5,6,7,8,9", "line 1002: column ax_m_s2: 'x' is not a number"),
        ("0.5,1,1,2,nan,4,5,6,7,8,9", "line 1002: column az_m_s2: 'nan'"),
        ("0.5,1.5,1,2,3,4,5,6,7,8,9", "line 1002: column node"),
        ("0.5,1,1,2,3,4,5", "line 1002: column gz_rad_s is empty"),
        ("0.5,1,1,2,3,4,5,6,7,8,9,10", "line 1002: 12 cells for 11 columns"),
    ],
)
def test_a_fault_deep_in_inertial_data_is_named(tmp_path: Path, row: str, complaint: str) -> None:
    good = "".join(f"{k * 0.01:.2f},1,1,2,3,4,5,6,7,8,9\n" for k in range(1000))
    run = load_run(write(tmp_path, imu_csv=IMU_HEADER + good + row + "\n"))
    with pytest.raises(DataError) as caught:
        run.load_imu()
    assert complaint in str(caught.value)


def test_a_saved_run_reads_back_the_same(tmp_path: Path) -> None:
    source = tmp_path / "a"
    source.mkdir()
    write(
        source,
        run_toml='name = "a \\"b\\""\nheading_known = true\ninitial_pose = "common"\n'
        "[initial.1]\nx_m = 1\ny_m = 0.1\nheading_rad = 2\n"
        "[nodes.1]\nantenna_offset_m = [0.1, 0.2]\n",
        motion_csv=MOTION,
        ranges_csv="time_s,node,peer,range_m,rss_dbm\n0.1,1,2,0,\n0.30000000000000004,1,2,3,-80\n",
        height_csv="time_s,node,height_m\n0,1,0.5\n",
        heading_csv="time_s,node,heading_rad,sigma_rad,source\n0,1,0.5,0.1,magnetic\n",
        events_csv="time_s,node,event,value\n0,1,bout_start,2.5\n",
        status_csv="time_s,node,name,value\n0,1,battery_v,3.7\n",
        steps_csv="time_s,node,length_m\n0.4,1,0.7\n",
        landmarks_csv="id,x_m,y_m\nA,1,2\n",
        truth_csv="time_s,node,x_m,y_m,heading_rad\n0,1,1,2,\n",
        imu_csv=IMU_HEADER + "0,1,1,2,3,4,5,6,,,\n0.01,1,1,2,3,4,5,6,7,8,9\n",
    )
    before = load_run(source)
    save_run(before, tmp_path / "b")
    after = load_run(tmp_path / "b")
    for name in (
        "name", "description", "measurements", "events", "statuses", "steps", "landmarks",
        "truth", "priors", "counters",
    ):  # fmt: skip
        assert getattr(after, name) == getattr(before, name), name
    assert any(isinstance(m, Height) for m in after.measurements)
    assert any(isinstance(m, Heading) for m in after.measurements)
    np.testing.assert_array_equal(
        after.load_imu()[1].magnetic_field_ut, before.load_imu()[1].magnetic_field_ut
    )


def test_a_saved_run_leaves_nothing_of_the_run_that_was_there(tmp_path: Path) -> None:
    write(tmp_path, motion_csv=MOTION, landmarks_csv="id,x_m,y_m\nA,1,2\n", imu_csv=IMU_HEADER)
    save_run(Run("empty"), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["run.toml"]


def test_the_airs_pressure_is_saved(tmp_path: Path) -> None:
    header = IMU_HEADER.rstrip("\n") + ",pressure_pa\n"
    rows = "0,1,1,2,3,4,5,6,,,,101325.25\n0.01,1,1,2,3,4,5,6,,,,\n0,2,1,2,3,4,5,6,,,,\n"
    before = load_run(write(tmp_path, imu_csv=header + rows))
    save_run(before, tmp_path / "b")
    after = load_run(tmp_path / "b").load_imu()
    np.testing.assert_array_equal(after[1].pressure_pa, [101325.25, np.nan])
    assert after[2].pressure_pa is None


def an_estimate() -> Estimate:
    node = NodeEstimate(
        1, 1.0, 2.0, 0.5, 0.09, 0.04, 0.02, 0.1, NodeStatus.AMBIGUOUS, z_m=0.3, sigma_z_m=0.2
    )
    other = NodeEstimate(2, 4.0, 6.0, -0.5, 0.01, 0.02, -0.005, 0.2, NodeStatus.OK)
    return Estimate(1.5, (node, other), (PairEstimate(1, 2, 5.0, 0.3, 0.9, 0.05),))


def test_estimates_read_back_as_they_were_written(tmp_path: Path) -> None:
    estimate = an_estimate()
    write_estimates(tmp_path, [estimate])
    (back,) = read_estimates(tmp_path)
    assert back.time_s == 1.5
    assert back.pairs == (replace(estimate.pairs[0], status=NodeStatus.AMBIGUOUS),)
    for was, now in zip(estimate.nodes, back.nodes, strict=True):
        assert now.status is was.status
        for name in (
            "x_m", "y_m", "z_m", "heading_rad", "variance_x_m2", "variance_y_m2",
            "covariance_xy_m2", "sigma_heading_rad", "sigma_z_m",
        ):  # fmt: skip
            assert getattr(now, name) == pytest.approx(getattr(was, name), abs=1e-5), name


def test_alternatives_read_back_as_they_were_written(tmp_path: Path) -> None:
    ellipse = Alternative(1.5, 0, 0.75, 1, 1.0, 2.0, 0.5, 0.3, 0.2, 0.1)
    ring = Alternative(1.5, 1, 0.25, 2, 0.0, 0.0, 0.0, 4.0, 0.3, 0.0, Shape.RING)
    write_estimates(tmp_path, [replace(an_estimate(), alternatives=(ellipse, ring))])
    (back,) = read_estimates(tmp_path)
    assert back.alternatives == (ellipse, ring)
    (tmp_path / "alternatives.csv").write_text(
        (tmp_path / "alternatives.csv").read_text().replace("ring", "circle")
    )
    with pytest.raises(DataError, match=r"alternatives\.csv.*shape.*none of ellipse, ring"):
        read_estimates(tmp_path)


def test_the_output_files_have_the_columns_of_the_run_format(tmp_path: Path) -> None:
    estimate = replace(
        an_estimate(),
        alternatives=(Alternative(1.5, 0, 1.0, 1, 1.0, 2.0, 0.5, 0.3, 0.2, 0.1),),
        parameters=(Parameter(1.5, 1, 2, "range_bias_m", 0.3, 0.1),),
    )
    write_estimates(tmp_path, [estimate], steps=[Step(1.0, 1, 0.7)])
    headers = {p.name: p.read_text().splitlines()[0] for p in tmp_path.iterdir()}
    assert headers == {
        "estimate.csv": "time_s,node,x_m,y_m,z_m,heading_rad,sigma_major_m,sigma_minor_m,"
        "sigma_angle_rad,sigma_z_m,sigma_heading_rad,status,episode,episode_probability,"
        "floor,floor_probability",
        "pairs.csv": "time_s,node,peer,distance_m,sigma_distance_m,bearing_rad,sigma_bearing_rad,"
        "status",
        "alternatives.csv": "time_s,alternative,probability,node,x_m,y_m,heading_rad,"
        "sigma_major_m,sigma_minor_m,sigma_angle_rad,shape",
        "parameters.csv": "time_s,node,peer,name,value,sigma",
        "steps.csv": "time_s,node,length_m",
    }
    write_estimates(tmp_path, [])
    assert not (tmp_path / "alternatives.csv").exists(), "an earlier run's"
    assert not (tmp_path / "steps.csv").exists(), "an earlier run's steps are not this one's"


def test_parameters_are_written_where_they_change(tmp_path: Path) -> None:
    same = Parameter(1.5, 1, None, "step_scale", 1.1, 0.05)
    estimates = [
        replace(an_estimate(), parameters=(same,)),
        replace(an_estimate(), time_s=2.5, parameters=(replace(same, time_s=2.5),)),
        replace(an_estimate(), time_s=3.5, parameters=(replace(same, time_s=3.5, value=1.2),)),
    ]
    write_estimates(tmp_path, estimates)
    rows = (tmp_path / "parameters.csv").read_text().splitlines()[1:]
    assert rows == ["1.5,1,,step_scale,1.1,0.05", "3.5,1,,step_scale,1.2,0.05"]


def test_a_foreign_estimate_needs_positions_alone(tmp_path: Path) -> None:
    write(tmp_path, estimate_csv="time_s,node,x_m,y_m\n0,1,1,2\n0,2,,\n")
    (estimate,) = read_estimates(tmp_path)
    assert estimate.nodes[0].x_m == 1.0
    assert math.isnan(estimate.nodes[1].x_m)
    assert math.isnan(estimate.nodes[0].heading_rad)


def test_the_status_of_a_pair_is_that_of_the_file(tmp_path: Path) -> None:
    nodes = "time_s,node,x_m,y_m\n" + "".join(f"{t},{n},{n},0\n" for t in (0, 1) for n in (1, 2, 3))
    pairs = "time_s,node,peer,distance_m,sigma_distance_m,status\n" + "".join(
        f"{t},{node},{peer},{peer - node},0.1,{status}\n"
        for t in (0, 1)
        for node, peer, status in ((1, 2, "ambiguous"), (1, 3, ""), (2, 3, "lost"))
    )
    write(tmp_path, estimate_csv=nodes, pairs_csv=pairs)
    estimates = read_estimates(tmp_path)
    assert estimates[0].pair_statuses() == ["ambiguous", "ok", "lost"]
    assert estimated_pairs(estimates)[1, 2].ok.tolist() == [0.0, 0.0]
    write_estimates(tmp_path, estimates)
    assert read_estimates(tmp_path)[1].pair_statuses() == ["ambiguous", "ok", "lost"]


@pytest.mark.parametrize("most", [2, pytest.param(None, marks=pytest.mark.soak)])
@pytest.mark.skipif(not DATA.is_dir(), reason="no folder of real recordings")
def test_every_real_recording_loads(most: int | None) -> None:
    """Of each data set so many, or all."""
    sets = [sorted(path.glob("*/run.toml")) for path in DATA.iterdir()]
    directories = [run.parent for runs in sets for run in runs[:most]]
    assert directories
    for directory in directories:
        run = load_run(directory)
        assert run.measurements or run.load_imu(), directory.name
        _ = run.priors
