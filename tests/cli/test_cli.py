"""The command line from outside: what scripts rely on, and what bad input gets for an answer."""

from __future__ import annotations

import gzip
import json
import math
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import pytest
from typer.testing import Result

from relpos.cli import output
from relpos.evaluation.summary import FIGURES
from relpos.link import xbee
from relpos.measurements import Motion, Step
from relpos.protocol import framing
from relpos.protocol import messages as wire
from relpos.runs import load_run, read_estimates
from support.command import relpos

MOTION_HEADER = "time_s,node,dx_m,dy_m,dtheta_rad\n"


def one_clear_line(result: Result) -> str:
    """The complaint: a single line on stderr, nothing on stdout, exit status 1."""
    assert result.exit_code == 1, result.output
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("relpos: ")
    assert "Traceback" not in result.stderr
    return result.stderr


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute of the paper's scenario with three users."""
    directory = tmp_path_factory.mktemp("run") / "walk"
    result = relpos(
        "simulate", "--scenario", "paper", "--seed", 3, "--out", directory,
        "--set", "seconds=30", "--set", "nodes=3",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return directory


def a_run(directory: Path, ranges: str | None = None, motion: str | None = None) -> Path:
    directory.mkdir(exist_ok=True)
    if motion is None:
        rows = "".join(f"{t},{n},0.5,0,0.1\n" for t in range(1, 9) for n in (1, 2))
        motion = MOTION_HEADER + rows
    (directory / "run.toml").write_text('initial_pose = "common"\n')
    (directory / "motion.csv").write_text(motion)
    if ranges is not None:
        (directory / "ranges.csv").write_text("time_s,node,peer,range_m\n" + ranges)
    return directory


def test_help_names_the_commands_scripts_rely_on() -> None:
    shown = relpos("--help").stdout
    for command in ("demo", "emulate", "fuse", "simulate", "evaluate", "deadreckon"):
        assert command in shown


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("simulate", "[dirs]..."),
        ("doctor", "[port]"),
        ("mission", "[source]"),
        ("node flash", "[port]"),
        ("node radio", "[port]"),
        ("node set", "[settings]..."),
    ],
)
def test_usage_puts_what_may_be_left_out_in_one_pair_of_brackets(command, arguments) -> None:
    usage = next(x for x in relpos(*command.split(), "--help").stdout.splitlines() if "Usage" in x)
    assert "[[" not in usage
    # Versions of Typer differ in the case.
    assert usage.strip().lower().endswith(arguments)


@pytest.mark.parametrize("command", ["fuse", "mission", "demo", "emulate"])
def test_help_names_one_default_of_an_option(command: str) -> None:
    options = relpos(command, "--help").stdout.split("--")
    told, shown = ({x for x in options if f"{bracket}default: " in x} for bracket in "([")
    assert told
    assert shown
    assert not told & shown


def test_help_does_not_wait_for_numerical_libraries() -> None:
    program = (
        "import sys\nfrom typer.testing import CliRunner\nfrom relpos.cli import main\n"
        "CliRunner().invoke(main.app, ['--help'])\n"
        "print([m for m in ('numpy', 'scipy', 'matplotlib') if m in sys.modules])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert shown.stdout.strip() == "[]"


def test_fuse_help_lists_every_setting_with_its_default() -> None:
    from relpos import fusion

    shown = " ".join(relpos("fuse", "--help").stdout.replace("│", " ").split())
    for info in fusion.settings_of("particle"):
        assert f"{info.key} {info.default:g}" in shown, info.key


def test_simulated_runs_repeat_by_their_seed(simulated: Path, tmp_path: Path) -> None:
    relpos(
        "simulate", "--scenario", "paper", "--seed", 3, "--out", tmp_path / "again",
        "--set", "seconds=30", "--set", "nodes=3",
    )  # fmt: skip
    for name in ("motion.csv", "ranges.csv", "truth.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (simulated / name).read_bytes()
    assert len(load_run(simulated).priors) == 3


def test_fuse_writes_estimates_and_scores_them(simulated: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = relpos("fuse", simulated, "--out", out)
    assert result.exit_code == 0, result.stderr
    assert "1 - 2" in result.stdout
    assert "relative distance RMSE" in result.stdout
    assert read_estimates(out)
    for name in ("pairs.csv", "parameters.csv"):
        assert (out / name).stat().st_size > 0, name
    page = (out / "index.html").read_text()
    assert page.count('role="img"') >= 7
    assert "http" not in page, "the page is to work without a network"


def test_evaluate_gives_the_figures_fuse_gave(simulated: Path, tmp_path: Path) -> None:
    fused = relpos("fuse", simulated, "--out", tmp_path, "--seed", 7, "--json")
    scored = relpos("evaluate", simulated, "--estimate", tmp_path, "--json")
    first, second = json.loads(fused.stdout), json.loads(scored.stdout)
    for name in FIGURES:
        assert second[name] == pytest.approx(first[name], rel=1e-3), name
    assert [(p["node"], p["peer"]) for p in second["pairs"]] == [(1, 2), (1, 3), (2, 3)]
    series = second["over_time"]
    assert len(series["time_s"]) == len(series["relative_distance_rmse_m"]) == second["epochs"]
    assert first["dead_reckoning"]["relative_distance_rmse_m"] > 0.0
    table = relpos("evaluate", simulated, "--estimate", tmp_path).stdout
    assert "over time" in table


def test_the_same_seed_gives_the_same_estimate(simulated: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        relpos("fuse", simulated, "--out", tmp_path / name, "--seed", 5, "--json")
    assert (tmp_path / "a/estimate.csv").read_bytes() == (tmp_path / "b/estimate.csv").read_bytes()


def test_a_run_without_truth_is_fused_and_shown(tmp_path: Path) -> None:
    ranges = "".join(f"{t},1,2,{1 + 0.1 * t}\n" for t in range(1, 9))
    words = ("fuse", a_run(tmp_path / "r", ranges), "--out", tmp_path / "o", "--no-report")
    result = relpos(*words)
    assert result.exit_code == 0, result.stderr
    assert "1 - 2" in result.stdout
    document = json.loads(relpos("fuse", tmp_path / "r", "--out", tmp_path / "o", "--json").stdout)
    assert document["relative_distance_rmse_m"] is None


@pytest.mark.parametrize(
    "arguments",
    [
        ("fuse",),
        ("fuse", "x", "--estimator", "magic"),
        ("fuse", "x", "--no-such-option"),
        ("fuse", "x", "--set", "particles"),
        ("simulate", "--scenario", "paper"),
        ("nonsense",),
        ("evaluate", "x"),
    ],
)
def test_wrong_usage_is_exit_status_two(arguments: tuple[str, ...]) -> None:
    assert relpos(*arguments).exit_code == 2


def test_a_recording_that_is_there_is_refused_at_once(simulated: Path, tmp_path: Path) -> None:
    (tmp_path / "f.mcap").write_bytes(b"")
    message = one_clear_line(relpos("fuse", simulated, "--record", tmp_path / "f.mcap"))
    assert "exists already: a recording is not overwritten" in message


def test_an_unknown_setting_is_one_clear_line(simulated: Path) -> None:
    assert "no setting 'bogus'" in one_clear_line(relpos("fuse", simulated, "--set", "bogus=1"))
    one_clear_line(relpos("fuse", simulated, "--set", "particles=many"))


def test_a_missing_directory_is_one_clear_line(tmp_path: Path) -> None:
    for arguments in (
        ("fuse", tmp_path / "nowhere"),
        ("evaluate", tmp_path / "nowhere", "--estimate", tmp_path),
        ("deadreckon", tmp_path / "nowhere"),
    ):
        assert "nowhere" in one_clear_line(relpos(*arguments))


def test_a_port_that_does_not_exist_is_one_clear_line_before_anything_is_prepared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("relpos.fusion.warm_up", lambda name: pytest.fail("it prepares first"))
    assert "ttyNOPE" in one_clear_line(relpos("fuse", "/dev/ttyNOPE7"))
    one_clear_line(relpos("fuse", "nonsense://port"))


def test_a_row_without_its_last_cell_is_one_clear_line(tmp_path: Path) -> None:
    motion = MOTION_HEADER + "1,1,0.5,0,0\n2,1,0.5,0\n"
    message = one_clear_line(relpos("fuse", a_run(tmp_path / "r", "1,1,2,3\n", motion)))
    assert "motion.csv: line 3: column dtheta_rad is empty" in message


def test_a_run_that_a_kill_cut_off_is_fused_and_told(tmp_path: Path) -> None:
    run = a_run(tmp_path / "r", "".join(f"{t},1,2,3\n" for t in range(1, 9)))
    with (run / "ranges.csv").open("a") as file:
        file.write('9,1,"2')
    command = [sys.executable, "-m", "relpos.cli.main", "fuse", run, "--out", tmp_path / "out"]
    command += ["--estimator", "deadreckoning", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["counters"]["rows_cut_off"] == 1
    assert "ranges.csv: line 10 was cut off: left out" in done.stderr


def test_a_truncated_gzip_file_is_one_clear_line(tmp_path: Path) -> None:
    run = a_run(tmp_path / "r")
    whole = gzip.compress(b"time_s,node,peer,range_m\n" + b"1,1,2,3\n" * 500)
    (run / "ranges.csv.gz").write_bytes(whole[:40])
    assert "ranges.csv.gz" in one_clear_line(relpos("fuse", run))


def test_a_corrupted_description_is_one_clear_line(tmp_path: Path) -> None:
    run = a_run(tmp_path / "r", "1,1,2,3\n")
    for content in (b'name = "x', b"\x00\xff\xfe\n\n", b'initial_pose = "here"'):
        (run / "run.toml").write_bytes(content)
        assert "run.toml" in one_clear_line(relpos("fuse", run))


def test_binary_garbage_is_one_clear_line(tmp_path: Path) -> None:
    run = a_run(tmp_path / "r", "1,1,2,3\n")
    (run / "motion.csv").write_bytes(b"\x00\x9f\x92\x96\n" * 40)
    assert "motion.csv" in one_clear_line(relpos("fuse", run))
    (tmp_path / "file.bin").write_bytes(b"\x00\x9f")
    assert "file.bin" in one_clear_line(relpos("fuse", tmp_path / "file.bin"))


def test_ranges_that_all_failed_are_one_clear_line(tmp_path: Path) -> None:
    run = a_run(tmp_path / "r", "".join(f"{t},1,2,0\n" for t in range(1, 9)))
    assert "all 8 ranges are 0" in one_clear_line(relpos("fuse", run))


def test_no_ranges_at_all_are_one_clear_line(tmp_path: Path) -> None:
    assert "no ranges" in one_clear_line(relpos("fuse", a_run(tmp_path / "a")))
    assert "no ranges" in one_clear_line(relpos("fuse", a_run(tmp_path / "b", ranges="")))


def test_no_motion_at_all_is_one_clear_line(tmp_path: Path) -> None:
    run = a_run(tmp_path / "r", "1,1,2,3\n", MOTION_HEADER)
    assert "no motion" in one_clear_line(relpos("fuse", run))
    assert "no motion" in one_clear_line(relpos("fuse", run, "--estimator", "deadreckoning"))


def test_an_output_that_cannot_be_written_is_one_clear_line(
    simulated: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    message = one_clear_line(relpos("fuse", simulated, "--out", tmp_path / "file" / "sub"))
    assert "file" in message


def test_evaluating_without_truth_or_estimate_is_one_clear_line(
    simulated: Path, tmp_path: Path
) -> None:
    assert "no truth" in one_clear_line(
        relpos("evaluate", a_run(tmp_path / "r"), "--estimate", tmp_path)
    )
    assert "no estimate.csv" in one_clear_line(
        relpos("evaluate", simulated, "--estimate", tmp_path)
    )


def test_deadreckon_without_inertial_data_is_one_clear_line(tmp_path: Path) -> None:
    assert "imu.csv" in one_clear_line(relpos("deadreckon", a_run(tmp_path / "r")))


IMU_COLUMNS = "ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s,mx_ut,my_ut,mz_ut"


def test_deadreckon_sums_what_the_firmware_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from relpos.emulator.deadreckoning import FirmwareOutput, NodeResult, WearerSettings

    def replayed(*_: object, **__: object) -> dict[int, NodeResult]:
        motions = (Motion(1.0, 4, 0.5, 0.0, 0.5 * math.pi), Motion(2.0, 4, 0.5, 0.25, 0.5))
        steps = (Step(0.5, 4, 0.75), Step(1.5, 4, 0.5))
        return {
            4: NodeResult(
                FirmwareOutput(motions, steps, {}, clipped=7),
                WearerSettings(0.9, 1300),
                100,
                2,
                5.0,
            )
        }

    monkeypatch.setattr("relpos.emulator.deadreckoning.reckon_run", replayed)
    (tmp_path / "imu.csv").write_text(f"time_s,node,{IMU_COLUMNS}\n0,4,0,0,9.8,0,0,0,,,\n")
    result = relpos("deadreckon", tmp_path, "--out", tmp_path / "o", "--json")
    assert json.loads(result.stdout) == {
        "nodes": {
            "4": {
                "distance_m": 1.25,
                "steps": 2,
                "turn_rad": 2.0708,
                # Half a metre ahead; after a quarter turn to the left half a metre that way and a
                # quarter backwards.
                "x_m": 0.25,
                "y_m": 0.5,
                "leg_length_m": 0.9,
                "step_gain_permille": 1300,
                "step_scale": None,
                "samples": 100,
                "clipped_samples": 7,
            }
        }
    }
    assert "2 of 100 samples repeat a time" in result.stderr
    assert "7 of 100 samples are beyond the range" in result.stderr
    assert "5 samples a second are too few" in result.stderr
    assert json.loads((tmp_path / "o" / "summary.json").read_text()) == json.loads(result.stdout)
    written = load_run(tmp_path / "o")
    assert len(written.motions) == 2
    assert len(written.steps) == 2


def test_deadreckon_writes_the_truth_that_its_run_starts_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "imu.csv").write_text(f"time_s,node,{IMU_COLUMNS}\n0,1,0,0,9.8,0,0,0,,,\n")
    (tmp_path / "run.toml").write_text('initial_pose = "from truth"\n')
    (tmp_path / "truth.csv").write_text("time_s,node,x_m,y_m,heading_rad\n0,1,3,4,0.5\n")
    monkeypatch.setattr("relpos.emulator.deadreckoning.reckon_run", lambda *_, **__: {})
    result = relpos("deadreckon", tmp_path, "--out", tmp_path / "o")
    assert result.exit_code == 0, result.stderr
    (start,) = load_run(tmp_path / "o").priors
    assert (start.x_m, start.y_m) == (3.0, 4.0)


def test_deadreckon_plays_unsorted_gzipped_rows_of_several_nodes_without_magnetometer(
    tmp_path: Path,
) -> None:
    rows = []
    for k in range(400):
        # A second and a half of standing and a few bounces of 1.9 a second: no walk to score.
        force = 9.8 + (2.0 * math.sin(12.0 * (k * 0.02 - 3.0)) if k > 150 else 0.0)
        rows += [f"{k * 0.02 - 1.0:.3f},{node},0,0,{force:.4f},0,0,0" for node in (7, 300)]
    columns = IMU_COLUMNS.removesuffix(",mx_ut,my_ut,mz_ut")
    table = f"time_s,node,{columns}\n" + "\n".join(reversed(rows)) + "\n"
    (tmp_path / "imu.csv.gz").write_bytes(gzip.compress(table.encode()))
    result = relpos("deadreckon", tmp_path, "--out", tmp_path / "o", "--json")
    assert result.exit_code == 0, result.stderr
    nodes = json.loads(result.stdout)["nodes"]
    assert nodes["7"] == nodes["300"]
    assert nodes["7"]["steps"] > 4
    assert load_run(tmp_path / "o").steps[0].time_s > 1.5  # on the recording's clock


def test_dead_reckoning_needs_no_ranges(tmp_path: Path) -> None:
    words = ("fuse", a_run(tmp_path / "r"), "--out", tmp_path / "o", "--no-report")
    result = relpos(*words, "--estimator", "deadreckoning")
    assert result.exit_code == 0, result.stderr


def test_json_is_all_there_is_on_stdout(simulated: Path, tmp_path: Path) -> None:
    result = relpos("fuse", simulated, "--out", tmp_path, "--json")
    assert result.stdout.count("\n") == 1
    json.loads(result.stdout)
    assert not (tmp_path / "index.html").exists(), "scripts do not wait for pictures"


def test_a_port_that_vanishes_keeps_what_was_received(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    path = os.ttyname(theirs)
    os.close(theirs)

    def vanish() -> None:
        deadline_s = time.monotonic() + 60.0
        while not (tmp_path / "received").exists() and time.monotonic() < deadline_s:
            time.sleep(0.1)
        time.sleep(0.2)
        os.close(ours)

    closing = threading.Thread(target=vanish)
    closing.start()
    result = relpos("fuse", path, "--out", tmp_path)
    closing.join()
    assert result.exit_code == 1
    assert "vanished" in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr
    assert (tmp_path / "received" / "run.toml").exists()
    assert (tmp_path / "estimate.csv").exists()


def motion_bytes(node: int, second: int) -> bytes:
    """What a coordinator hands over when ``node`` reports half a metre a second."""
    values = dict.fromkeys(wire.MOTION.field, 0) | {"time_s": float(second), "x_m": 0.5 * second}
    frame = framing.encode(wire.MOTION, node, 0, 2 * second, values)
    return xbee.encode(xbee.Receive16(node, -50, frame), escaped=True)


def ranges_bytes(node: int, second: int, peer: int, range_m: float) -> bytes:
    entry = {"peer": peer, "range_m": range_m, "rss_dbm": -80, "age_s": 0.0, "quality": 0}
    frame = framing.encode(
        wire.RANGES, node, 0, 2 * second + 1, {"time_s": float(second), "ranges": [entry]}
    )
    return xbee.encode(xbee.Receive16(node, -50, frame), escaped=True)


def test_a_folder_whose_name_is_not_utf_8_is_fused_recorded_and_reported(tmp_path: Path) -> None:
    run = a_run(Path(f"{tmp_path}/gebäude\udcff"), "1,1,2,3\n")
    out, page = Path(f"{tmp_path}/out\udcff"), tmp_path / "report.html"
    quick = ("--estimator", "deadreckoning")
    for arguments in (
        ("fuse", run, "--out", out, *quick),
        ("report", run, "--out", page, *quick),
        ("fuse", run, "--record", tmp_path / "r.mcap", "--out", tmp_path / "again", *quick),
    ):
        result = relpos(*arguments)
        assert result.exit_code == 0, result.output
    for written in (out / "index.html", page):
        assert "<title>gebäude?" in written.read_text()


@pytest.mark.soak  # tests/system/test_chain.py interrupts a longer session
def test_an_interrupt_ends_listening_and_keeps_what_was_received(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    listening = subprocess.Popen(
        [
            sys.executable, "-m", "relpos.cli.main", "fuse", os.ttyname(theirs),
            "--initial", "common", "--out", str(tmp_path),
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # Where the tests run in the background SIGINT is ignored, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        assert listening.stderr is not None
        line = listening.stderr.readline()
        if "preparing" in line:
            line = listening.stderr.readline()
        assert "listening" in line
        for second in range(1, 13):
            for node in (1, 2):
                os.write(ours, motion_bytes(node, second))
            os.write(ours, ranges_bytes(1, second, 2, 1.5))
            # Ten times the real pace: what counts is that it is read as it comes.
            time.sleep(0.1)
        while select.select([theirs], [], [], 0.0)[0]:
            time.sleep(0.05)
        listening.send_signal(signal.SIGINT)
        stdout, stderr = listening.communicate(timeout=120)
    finally:
        listening.kill()
        os.close(ours)
        os.close(theirs)
    assert listening.returncode == 0, stderr
    assert "Traceback" not in stderr
    assert "frames 36" in stderr
    assert "1 - 2" in stdout
    received = load_run(tmp_path / "received")
    # The first report of a node only says where its totals stand.
    assert len(received.motions) >= 22
    assert len(received.ranges) == 12
    assert read_estimates(tmp_path)


def test_settings_are_split_at_their_first_equals_sign() -> None:
    assert output.parse_settings(["a=1", " b = x=y "]) == {"a": "1", "b": "x=y"}


def test_a_session_at_a_port_never_overwrites_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    master, slave = pty.openpty()
    try:
        for _ in range(2):
            before = set(tmp_path.glob("out/*"))
            done = relpos("fuse", os.ttyname(slave), "--seconds", 1.1)
            assert "Traceback" not in done.output
            assert len(set(tmp_path.glob("out/*")) - before) == 1
    finally:
        os.close(master)
        os.close(slave)


def test_a_run_that_was_not_simulated_is_not_replaced_by_one_that_is(
    simulated: Path, tmp_path: Path
) -> None:
    recorded = a_run(tmp_path / "recorded")
    before = (recorded / "motion.csv").read_bytes()
    refused = one_clear_line(
        relpos("simulate", "--scenario", "lab", "--seed", 3, "--out", recorded)
    )
    assert f"{recorded}: holds a run that was not simulated" in refused
    assert (recorded / "motion.csv").read_bytes() == before
    again = relpos(
        "simulate", "--scenario", "lab", "--seed", 3, "--out", simulated, "--set", "seconds=5"
    )
    assert again.exit_code == 0, again.output


def test_dead_reckoning_does_not_replace_the_recording_that_it_reads(tmp_path: Path) -> None:
    rows = "".join(f"{k / 50.0},1,0,0,9.81,0,0,0\n" for k in range(60))
    header = "time_s,node,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s\n"
    (tmp_path / "imu.csv").write_text(header + rows)
    refused = one_clear_line(relpos("deadreckon", tmp_path, "--out", tmp_path))
    assert "holds a run that was not dead-reckoned" in refused
    assert (tmp_path / "imu.csv").read_text() == header + rows


@pytest.mark.parametrize("name", ["imu.csv", "landmarks.csv"])
def test_a_recording_of_one_table_is_not_replaced_by_a_simulation(
    tmp_path: Path, name: str
) -> None:
    recorded = tmp_path / name
    recorded.write_text("rows that nobody can make again\n")
    refused = one_clear_line(
        relpos("simulate", "--scenario", "lab", "--seed", 3, "--out", tmp_path)
    )
    assert "holds a run that was not simulated" in refused
    assert recorded.read_text() == "rows that nobody can make again\n"


def test_a_simulation_that_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    refused = one_clear_line(
        relpos(
            "simulate", "--scenario", "paper", "--seed", 1, "--out", tmp_path / "out",
            "--set", "sigma_range_m=1e6", "--set", "seconds=20",
        )
    )  # fmt: skip
    assert "range_m of" in refused
    assert not (tmp_path / "out").exists()
