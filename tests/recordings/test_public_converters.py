"""Each converter, given a small made-up archive in its source's own layout."""

import io
import pickle

import numpy as np
import pytest
import scipy

from relpos.errors import DataError
from relpos.recordings import (
    back,
    chest,
    daily,
    four_robots,
    hamburg,
    mocap,
    museum,
    phone_strides,
    ranges,
    still,
    treadmill,
    two_robots,
)
from relpos.recordings.tables import Archive


@pytest.fixture
def source(tmp_path):
    """Writes files, name -> text or bytes, and returns them as an archive."""

    def write(files):
        for name, content in files.items():
            place = tmp_path / name
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content if isinstance(content, bytes) else content.encode())
        return Archive(tmp_path)

    return write


def test_a_stride_ends_where_the_reference_counts_on(source):
    line = "test 0 0 9.8 0.1 0 0 22 0 -53 {ms} {length} {count} {way}"
    rows = [(5000, 0.0, 0, 0.0), (5010, 1.25, 1, 1.25), (5020, 1.25, 1, 1.25), (245001, 1, 2, 2.25)]
    text = "\n".join(
        line.format(ms=ms, length=length, count=count, way=way) for ms, length, count, way in rows
    )
    archive = source({f"{phone_strides.FOLDER}{w}.txt": text for w in phone_strides.WALKS})
    first, *others = phone_strides.convert(archive)
    assert len(others) == 9
    assert (first.name, len(first.imu)) == ("w1024073735", 3)  # the last is behind 240 s
    assert first.imu[1] == "0.0100,1,0,0,9.8,0.1,0,0,22,0,-53"
    assert list(first.events) == [
        "0.0000,1,bout_start,1.250",
        "0.0100,1,stride_length_right_m,1.250",
        "0.0100,1,right_stride_end,1",
        "0.0200,1,bout_end,",
    ]


def test_a_true_outdoor_distance_has_the_height_in_it(source):
    text = "Distance,RSSI(dBm),RSSI_fp(dBm)\n" + "2.05,-78.5,-80.25\n" * 50 + ",,\nMean\n"
    (table,) = ranges.outdoor(source({"Static_measurements/LOS/height_50.0cm/2m.csv": text}))
    lines = table.others["errors.csv"]
    assert len(lines) == 1 + ranges.READINGS
    assert lines[1] == "los,0.5,2.0616,2.05,-78.5,-80.25"  # the hypotenuse of 2 and .5 m


def test_a_university_range_keeps_its_rooms(source):
    names = "real_rng,rng,rssi,fp_power,condition,bias,env"
    text = f"{names}\n6.269,8.045,-80.136,-93.968,nlos,0.012051091,hwhw\n"
    (table,) = ranges.university(source({"meta_University.csv": text}))
    assert table.others["errors.csv"][1] == "nlos,hwhw,6.269,8.045,-80.136,-93.968,0.012051"
    with pytest.raises(DataError, match="the source has changed"):
        list(ranges.outdoor(Archive(source({})._path)))


def logs(lines, trials):
    """The same log for every trial."""
    names = (trial.replace("_", "_repetition") for trial in trials)
    return {f"{museum.FOLDER}{name}.txt": "\n".join(lines) for name in names}


def test_a_log_of_a_phone_is_cut_around_its_points(source):
    lines = ["% made up", "POSI;10.0;1;49.46;11.11;0;100", "POSI;20.0;2;49.4601;11.11;0;100"]
    for k in range(60):
        app, sensor = 0.5 * k, 100.0 + 0.5 * k
        lines += [f"ACCE;{app};{sensor};0;0;9.8;3", f"GYRO;{app};{sensor - 0.25};{k};0;0;3"]
        lines.append(f"MAGN;{app};{sensor};20;0;-40;3")
    first, *others = museum.convert(source(logs(lines, museum.TRIALS)))
    assert len(others) == 16
    assert len(first.imu) == 25  # 9 s to 21 s
    assert first.imu[0] == "0.0000,1,0,0,9.8,18.5,0,0,20,0,-40"  # between two of the gyroscope
    north_m = float(first.truth[1].split(",")[3])
    assert first.truth[0] == "1.0000,1,0,0,"
    assert north_m == pytest.approx(11.12, abs=0.01)  # 1e-4 of the 10,000 km / 90 of a degree


def test_a_log_with_pressure_keeps_the_floors_of_its_points(source):
    lines = ["POSI;1.0;1;49.46;11.11;0;100", "POSI;4.0;2;49.4601;11.11;-2;100"]
    for k in range(11):
        lines += [f"{kind};{0.5 * k};{0.5 * k};0;0;9.8;3" for kind in ("ACCE", "GYRO", "MAGN")]
        lines.append(f"PRES;{0.5 * k};{0.5 * k};{980 + 0.1 * k};3")
    first, *others = museum.heights(source(logs(lines, museum.FLOOR_TRIALS)))
    assert len(others) == 49
    table = first.tables()["imu.csv"].splitlines()
    assert table[0].endswith(",mz_ut,pressure_pa")
    assert table[1] == "0.0000,1,0,0,9.8,0,0,9.8,0,0,9.8,98000.0"
    assert list(first.events) == ["1.0000,1,floor,0", "4.0000,1,floor,-2"]


def test_points_of_a_plan_keep_their_heights(source):
    files = {}
    for folder in hamburg.WALKS.values():
        for kind in ("acc", "gyr", "mag"):
            files[f"SensorLog/{folder}/{kind}.csv"] = "1e12 1 2 3\n1.00000000001e12 4 5 6\n"
        files[f"SensorLog/{folder}/bar.csv"] = "1e12 1013.25\n1.00000000001e12 1013.20\n"
        files[f"SensorLog/{folder}/ref.csv"] = "1e12 500 700 1.3\n1.000000009e12 503 704 7.6"
    _, run = hamburg.convert(source(files))
    assert run.name == "zero2four"
    assert run.imu[1] == "0.0100,1,4,5,6,4,5,6,4,5,6,101320.0"
    assert run.others["truth.csv"][1:] == ["0.000,1,0.0,0.0,,0.0", "9.000,1,3.0,4.0,,6.3"]
    files[f"SensorLog/{folder}/bar.csv"] = "1e12 1013.25\n"
    with pytest.raises(DataError, match="the source has changed"):
        list(hamburg.convert(source(files)))


def matlab(**variables):
    stream = io.BytesIO()
    scipy.io.savemat(stream, variables)
    return stream.getvalue()


def test_a_bout_whose_length_was_not_seen_is_left_out(source):
    bout = {
        "Start": 0.01,
        "End": 0.03,
        "Length": 4.25,
        "InitialContact_Event": np.array([0.01, np.nan, 0.03]),
        "InitialContact_LeftRight": np.array(["Left", "Right", "Right"], object),
    }
    sensor = {"Acc": np.tile([1.0, 0.0, 0.5], (4, 1)), "Gyr": np.ones((4, 3)) * 180.0}
    sensor["Mag"] = np.zeros((4, 3))
    seen, unseen = (
        {"SU": {"LowerBack": sensor}, "Standards": {"Stereophoto": {"MicroWB": b}}}
        for b in (bout, {**bout, "Length": np.array([])})
    )
    data = matlab(
        data={
            "TimeMeasure1": {
                "Test5": {"Trial1": unseen, "Trial2": seen},
                "Test11": {"Trial1": unseen},
            }
        }
    )
    about = matlab(infoForAlgo={"TimeMeasure1": {"Height": 168, "SensorHeight": 97.5}})
    folder = "example_data/data/lab"
    files = {f"{folder}/{person}/data.mat": data for person in daily.PEOPLE}
    files |= {f"{folder}/{person}/infoForAlgo.mat": about for person in daily.PEOPLE}
    runs = list(daily.convert(source(files)))
    assert [run.name for run in runs] == ["HA002_Test5_Trial2", "MS001_Test5_Trial2"]
    assert list(runs[0].events) == [
        "0.010,1,bout_start,4.250",
        "0.010,1,foot_contact,left",
        "0.030,1,bout_end,",
        "0.030,1,foot_contact,right",
    ]
    assert runs[0].imu[1].startswith("0.0100,1,9.80665,0,4.90332,3.14159,")
    assert "stature_m = 1.68\nsensor_height_m = 0.975" in runs[0].description


def test_a_boards_packets_become_eight_chips(source):
    packets = b""
    for k in range(3):
        clock = (0xFFFFFFF0 + k * 1_000_000) % 2**32  # wraps between the first and the second
        values = np.zeros((8, 6), ">i2")
        values[1, 2], values[1, 3] = 2048, 164
        head = b"\xaa" + k.to_bytes(2, "big") + b"\x64" + clock.to_bytes(4, "big")
        packets += head + values.tobytes() + b"\0\0"
    name = "experimental_data/calibration/exp_1/data.bin"
    (run,) = still.chips(source({name: b"\xa0\x28\0\xc8" + packets}))
    assert len(run.imu) == 3 * 8
    assert run.imu[9] == "0.0156,2,0,0,9.8066,0.17453,0,0,,,"  # 1 g, 10 degrees a second
    with pytest.raises(DataError, match="the source has changed"):
        list(still.chips(source({name: b"\0" * 400})))


def test_stamps_in_clumps_are_spread_evenly(source):
    h5py = pytest.importorskip("h5py", reason="needs the extra 'recordings'")
    folder = "data/set-2/unmoved-with-x-pointing-forward-10min/"
    stamps = [0.0, 0.001, 0.002, 0.03]
    tables = {
        "mpu6050_accelerometer": ("accelBuffer", [stamps, [0] * 4, [0] * 4, [-1] * 4]),
        "mpu6050_gyroscope": ("gyroBuffer", [stamps, [180] * 4, [0] * 4, [0] * 4]),
        "hmc5883l_compass": ("compassBuffer", [[0.0, 0.03], [0.1, 0.4], [0, 0], [0, 0]]),
    }
    files = {}
    for file, (name, rows) in tables.items():
        stream = io.BytesIO()
        with h5py.File(stream, "w") as written:
            written[name] = np.array(rows, np.float64)
        files[f"{folder}{file}.mat"] = stream.getvalue()
    (run,) = still.ten_minutes(source(files))
    assert run.imu[1] == "0.0100,1,0,0,-9.8066,3.1416,0,0,20,0,0"


def test_markers_that_glide_make_an_imu_that_feels_gravity_alone(source):
    frames = 200
    place = np.array([[0.2, 0.1, 0.9], [0.2, -0.1, 0.9], [0.0, 0.05, 1.0], [0.0, -0.05, 1.0]])
    header = ["Trajectories", "200", "," + "".join(f",F1:{m},," for m in mocap.MARKERS), "", ""]
    rows = []
    for k in range(frames):
        cells = [f"{1000 * v:.6f}" for v in (place + np.array([0.005 * k, 0.0, 0.0])).ravel()]
        if k < 30:
            cells[-3:] = ["", "", ""]  # lost: three are enough
        rows.append(",".join([f"{k + 1}", "0", *cells]))
    text = "\n".join([*header, *rows, ""])
    files = {f"data/{p}/Gang/{p}Gang1.csv": text for p in mocap.PEOPLE}
    first, *others = mocap.walks(source(files))
    assert len(others) == 4
    samples = np.array([[float(v) for v in line.split(",")[2:8]] for line in first.imu])
    assert len(samples) == (frames - 2 * mocap.EDGE) // 2
    level = np.tile([0, 0, 9.80665, 0, 0, 0], (60, 1))
    assert samples[10:-10] == pytest.approx(level, abs=0.01)  # the low-pass starts from rest
    truth = [line.split(",") for line in first.others["truth.csv"]]
    x_m, z_m = float(truth[8][2]), float(truth[8][5])
    assert (x_m, z_m) == pytest.approx((0.45, 1.0), abs=1e-3)  # after 0.45 s at 1 m/s
    assert "leg_length_m = 0.864" in first.description
    with pytest.raises(DataError, match="the source has changed"):
        list(mocap.stairs(Archive(source({})._path)))


def test_a_foot_that_stands_each_second_tells_its_strides():
    times_s = np.arange(400) / 100.0
    swing = np.clip(np.sin(2.0 * np.pi * times_s), 0.0, None)  # the first half of each second
    velocity = 4.0 * swing**2  # 1 m a stride
    foot = np.zeros((400, 12))
    foot[:, 3] = 6.0 * swing + 0.01 * np.abs(times_s % 1.0 - 0.75)
    foot[:, 9] = np.gradient(velocity, times_s)
    instants, lengths_m = treadmill.strides(foot)
    assert instants == pytest.approx([75, 175, 275, 375], abs=2)
    assert lengths_m == pytest.approx([1.0] * 3, abs=0.01)


def test_a_sheet_of_seven_sensors_becomes_the_back_and_its_feet(source):
    openpyxl = pytest.importorskip("openpyxl", reason="needs the extra 'recordings'")
    kinds = [f"{kind}_read_{axis}" for kind in ("Acc", "Gyro", "Mag") for axis in "xyz"]
    header = [f" {kind}_{sensor}" for sensor in (1, 6, 7) for kind in kinds]
    swing = np.zeros(300)
    swing[150:200] = np.sin(2.0 * np.pi * np.arange(50) / 50.0)  # 1 m: to and fro once
    force = swing * 1e4 * 2.0 * np.pi / 0.25 / 9.80665

    def written(header):
        book, stream = openpyxl.Workbook(), io.BytesIO()
        book.active.append(header)
        for k in range(300):
            turning = (-1) ** k * 10000.0 * (150 <= k < 200)
            foot = [force[k], 0, 10000, 0, turning, 0, 0, 0, 0]
            book.active.append([*foot, *foot, -9826, 1193, -610, 219, 189, 30, 189, -392, 132])
        book.save(stream)
        return stream.getvalue()

    sheet = written(header)
    archive = source({f"Dataset/Additional/Marzia/{n}.xlsx": sheet for n in back.AUTHOR[:1]})
    first = next(back.author(archive))
    rates = "0.038223,0.032987,0.005236"
    assert first.imu[0] == f"0.0000,1,-9.636,1.1699,-0.59821,{rates},18.9,-39.2,13.2"
    marks = [line.split(",")[2:] for line in first.events]
    assert [mark for mark, _ in marks] == ["stride_length_left_m", "stride_length_right_m"]
    assert [float(length_m) for _, length_m in marks] == pytest.approx([1.0, 1.0], abs=0.02)
    changed = {f"Dataset/Additional/Marzia/{n}.xlsx": written(header[1:]) for n in back.AUTHOR[:1]}
    with pytest.raises(DataError, match=r"2\.xlsx: 'Acc_read_x_1'.*the source has changed"):
        list(back.author(source(changed)))


def test_a_treadmill_table_without_its_columns_has_changed(source):
    files = {}
    for person in treadmill.TRIALS:
        for export in range(8):
            folder = f"data/1019_pp{person}/Xsens/exported{export:03d}"
            for sensor in treadmill.SENSORS[0].values():
                files[f"{folder}/MT_{sensor}.txt"] = "// Xsens\nPacketCounter\tAcc_X\n1\t9.8\n"
    with pytest.raises(DataError, match=r"exported003.*Acc_Y.*the source has changed"):
        list(treadmill.convert(source(files)))


def test_a_chest_log_is_named_by_its_path_and_a_short_one_is_left_out(source):
    line = "0{n},{stamp},9.8,0.1,0.2,0.01,0.02,0.03,-0.5,0.2,1,18,-78,-17"
    log = "\n".join(line.format(n=k, stamp=281696 + 100 * k) for k in range(1000))
    text = f"{chest.COLUMNS},Roll,Pitch,Yaw\n{log}\n"
    raw = "Robust Adaptive Kalman Filter Algorithm/RawData/"
    files = {"Data/test 1/out-000.txt": text, f"{raw}25.02/Lpath.txt": text}
    first, second = chest.convert(source(files | {f"{raw}short.txt": text[:5000]}))
    assert (first.name, second.name) == ("Data__test_1__out-000", "L__25.02__Lpath")
    assert first.imu[1] == "0.0100,1,9.8,0.1,0.2,0.01,0.02,0.03,-22.5,9,45"
    with pytest.raises(DataError, match="the source has changed"):
        list(chest.convert(source({f"{raw}short.txt": "other,columns\n"})))


class Frame:
    """Stands for the source's own classes; pickled by its attributes."""

    def __init__(self, poses):
        self.sampled_t, self.sampled_T = 100.0 + 0.1 * np.arange(len(poses)), poses


class Robot:
    def __init__(self, poses):
        self.vicon_frame = self.vio_frame = Frame(poses)


class Uwb:
    def __init__(self, count):
        self.sampled_t = [np.float64(100.0 + 0.1 * k) for k in range(count)]
        self.sampled_d = [np.float64(3.0 + k) for k in range(count)]


def harm():
    raise AssertionError("a function of the pickle was run")


class Harmful:
    def __reduce__(self):
        return harm, ()


def test_robots_drive_along_y_of_their_markers_and_nothing_of_the_pickle_runs(source):
    poses = np.tile(np.eye(4), (22, 1, 1))
    poses[:, 1, 3] = -0.1 * np.arange(22)  # 1 m/s towards -y
    run = {"tb2": Robot(poses), "tb3": Robot(poses), "uwb": Uwb(22), "more": Harmful()}
    packed = pickle.dumps(run)
    files = {two_robots.FOLDER + path: packed for path in two_robots.RUNS.values()}
    runs = list(two_robots.convert(source(files)))
    assert [r.name for r in runs] == list(two_robots.RUNS)
    tables = runs[0].tables()
    assert tables["truth.csv"].split()[3] == "0.5000,1,0,-0.5,4.71239"  # 270 degrees
    assert tables["motion.csv"].split()[1:4:2] == ["1.1000,1,0,-1.1,0", "2.1000,1,0,-1,0"]
    assert tables["ranges.csv"].split()[2] == "1.0000,1,2,13"
    with pytest.raises(DataError, match="the source has changed"):
        list(two_robots.convert(source(dict.fromkeys(files, b"no pickle"))))


def test_four_robots_keep_their_ranges_and_truth_and_get_noisy_motion(source):
    count = 701
    way = np.stack([np.arange(count) / 70.0, np.zeros(count)], axis=1)
    arrays = {}
    for n in four_robots.ROBOTS:
        arrays[f"optitrack_turtle{n:02d}_pose_np"] = way
        arrays[f"optitrack_turtle{n:02d}_orientation_np"] = np.zeros(count)
        for peer in four_robots.ROBOTS:
            arrays[f"uwb_range_{n}_{peer}_np"] = np.full(count, 10.0 * peer + n)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    (run,) = four_robots.convert(source({four_robots.FILE: stream.getvalue()}))
    tables = {name: text.split()[1:] for name, text in run.tables().items()}
    assert tables["truth.csv"][4] == "0.5714,1,0.0571429,0,0"
    assert tables["ranges.csv"][:2] == ["0.0000,1,3,13", "0.0000,1,4,14"]
    motion = np.array([line.split(",") for line in tables["motion.csv"]], float)
    assert len(motion) == 400
    assert motion[:, 2].mean() == pytest.approx(0.1, abs=0.003)
    assert motion[:, 2:].std(axis=0) == pytest.approx([0.0112, 0.01, 0.0087], rel=0.15)
