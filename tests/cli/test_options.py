"""Options that cannot do what they say: refused in a line, before anything is computed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from relpos.evaluation.report.page import _PAGE
from support.command import relpos


def refusal(*arguments: object) -> str:
    result = relpos(*arguments)
    assert (result.exit_code, result.stdout) == (1, ""), result.output
    assert result.stderr.count("\n") == 1
    return result.stderr.removeprefix("relpos: ")


IMU = "time_s,node,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s\n" + "".join(
    f"{t / 100},1,0,0,9.8,0,0,0\n" for t in range(200)
)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{t},{n},0.5,0,0.1\n" for t in range(1, 9) for n in (1, 2))
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "motion.csv").write_text("time_s,node,dx_m,dy_m,dtheta_rad\n" + rows)
    (tmp_path / "walk" / "run.toml").write_text('initial_pose = "common"\n')
    ranges = "".join(f"{t},1,2,{1 + 0.1 * t}\n" for t in range(1, 9))
    (tmp_path / "walk" / "ranges.csv").write_text("time_s,node,peer,range_m\n" + ranges)
    return tmp_path / "walk"


QUICK = ("--estimator", "deadreckoning", "--no-report")


@pytest.mark.parametrize(
    ("words", "needs"),
    [
        ("fuse walk --view-listen 0.0.0.0", "--view"),
        ("fuse walk --https", "--view"),
        ("fuse walk --open", "--view"),
        ("fuse walk --me 99", "--terminal"),
        ("fuse walk --pin 48,11", "--cot"),
        ("fuse walk --seconds 5", "of a port, --view"),
        ("fuse walk --speed 3", "--view, --terminal"),
        ("fuse walk --record a.mcap --speed 3", "--view, --terminal"),
        ("fuse /dev/ttyNOPE7 --view --speed 3", "not of a port"),
        ("fuse walk --key-file /nope", "a port or a recording"),
        ("fuse walk --teach", "a port"),
        ("fuse walk --view --report", "only on a port"),
        ("fuse /dev/ttyNOPE7 --report", "--view"),
        ("demo --view-listen 0.0.0.0", "--view"),
        ("demo --terminal --https", "--view"),
        ("demo --open", "--view"),
        ("report walk --estimate e --smooth", "--estimate"),
        ("report walk --estimate e --set a=b", "--estimate"),
        ("report walk --estimate e --seed 0", "--estimate"),
        ("report walk --estimate e --estimator particle", "--estimate"),
        ("replay a.mcap --log log.csv --open", "--log"),
        ("replay a.mcap --log log.csv --seconds 3", "--log"),
        ("replay a.mcap --log log.csv --view-listen 0.0.0.0", "--log"),
        ("replay a.mcap --log log.csv --pin 48,11", "--log FILE.kml"),
        ("replay a.mcap --pin 48,11", "--log FILE.kml"),
    ],
)
def test_an_option_that_has_no_effect_is_refused_with_what_it_needs(
    run: Path, words: str, needs: str
) -> None:
    said = refusal(*words.split())
    option, _, why = said.partition(": ")
    assert option in words.split()
    assert needs in why


def test_options_that_switch_off_what_is_not_there_and_keys_of_the_environment_are_no_mistake(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RELPOS_KEY_FILE", "/nope")
    done = relpos("fuse", run, *QUICK, "--no-open", "--no-teach", "--out", "out")
    assert done.exit_code == 0, done.output


def fused_remarks(run: Path) -> list[str]:
    """What is told beside the result, which JSON holds too."""
    told = relpos("fuse", run, *QUICK).stderr.splitlines()
    remarks = json.loads(relpos("fuse", run, *QUICK, "--json").stdout)["remarks"]
    assert set(remarks) <= set(told)
    return remarks


def test_nodes_that_range_and_report_no_motion_are_named(run: Path) -> None:
    assert fused_remarks(run) == []
    with (run / "ranges.csv").open("a") as table:
        table.write("3,1,4,2.5\n4,3,1,2.5\n4,1,7,2\n4,1,8,0\n")
    (run / "run.toml").write_text('initial_pose = "common"\n[nodes.7]\npost = true\n')
    (line,) = fused_remarks(run)
    assert line == (
        "nodes 3, 4: no motion (motion.csv), so taken to stand still, as anchors do; whoever moves "
        "needs rows"
    )


def test_what_run_toml_says_in_vain_is_told(run: Path) -> None:
    (run / "run.toml").write_text(
        'inital_pose = "common"\n[nodes.1]\nstatur_m = 1.8\n[building]\nfloors_m = [0.0]\n'
        + "".join(f"[initial.{n}]\nx_m = 0\ny_m = 0\nheading_rad = 0\n" for n in (1, 2, 99))
    )
    assert fused_remarks(run) == [
        "run.toml: nothing reads inital_pose, nodes.1.statur_m: misspelt?",
        "run.toml: no such node: [initial.99]",
    ]


def test_a_run_that_is_shown_takes_seconds_and_speed(run: Path) -> None:
    words = ("--estimator", "deadreckoning", "--view", "--view-listen", "127.0.0.1:0", "--no-open")
    done = relpos("fuse", run, *words, "--speed", 0, "--seconds", 0.1, "--out", "out")
    assert done.exit_code == 0, done.output


def test_a_source_that_is_missing_is_named_before_its_options(run: Path) -> None:
    assert "nowhere" in refusal("fuse", "nowhere", "--seconds", 5)


@pytest.mark.parametrize("shown", [(), ("--record", "walk.mcap")])
def test_an_estimate_without_a_page_leaves_no_page_of_another_estimate_beside_it(
    run: Path, tmp_path: Path, shown: tuple[str, ...]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "index.html").write_text(_PAGE)
    assert relpos("fuse", run, *QUICK, "--out", "out", *shown).exit_code == 0
    assert not (tmp_path / "out" / "index.html").exists()


def test_a_page_of_somebody_else_stays_beside_an_estimate(run: Path, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<title>My relpos site</title>")
    assert relpos("fuse", run, *QUICK, "--out", ".").exit_code == 0
    assert (tmp_path / "index.html").exists()


@pytest.fixture
def nothing_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes minutes fails the test."""
    for name in (
        "relpos.api.fuse",
        "relpos.emulator.serving.record_team",
        "relpos.emulator.recorded_team.record_team",
        "relpos.emulator.deadreckoning.reckon_run",
        "relpos.fusion.warm_up",
        "relpos.emulator.process.EmulatorProcess",
    ):
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("it computes first"))


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("fuse walk --out FILE", "FILE"),
        ("fuse walk --out FILE/sub", "FILE/sub"),
        ("fuse walk --view --out FILE", "FILE"),
        ("report walk --out FOLDER", "FOLDER"),
        ("report walk --out FILE/page.html", "FILE"),
        ("report walk --figures FILE", "FILE"),
        ("demo --out FILE", "FILE"),
        ("demo --view --out FILE", "FILE"),
        ("demo --view --view-listen 127.0.0.1:70000", "127.0.0.1:70000"),
        ("demo --view --view-listen 192.0.2.1:8460", "192.0.2.1:8460"),
        ("fuse walk --view --view-listen 127.0.0.1:70000", "127.0.0.1:70000"),
        ("fuse walk --foxglove 127.0.0.1:70000", "127.0.0.1:70000"),
        ("fuse walk --record FILE/a.mcap", "FILE"),
        ("fuse /dev/null --key-file nowhere", "nowhere"),
        ("simulate --recordings a b --seed 1 --out FILE", "FILE"),
        ("deadreckon walk --out FILE", "FILE"),
    ],
)
def test_what_cannot_be_written_or_served_is_refused_before_anything_is_computed(
    run: Path, nothing_computed: None, words: str, names: str
) -> None:
    Path("FILE").write_text("")
    Path("FOLDER").mkdir()
    (run / "imu.csv").write_text(IMU)
    assert names in refusal(*words.split())


def test_a_session_is_recorded_into_a_folder_that_is_not_there_yet(run: Path) -> None:
    assert relpos("fuse", run, *QUICK, "--record", "new/folder/walk.mcap").exit_code == 0
    assert Path("new/folder/walk.mcap").stat().st_size


def test_looking_whether_a_folder_can_be_written_leaves_none(run: Path) -> None:
    (run / "ranges.csv").unlink()
    assert "no ranges" in refusal("fuse", run, "--out", "new/out")
    assert not Path("new").exists()


@pytest.mark.parametrize("name", ["o/x.txt", "log", "FOLDER.csv"])
def test_a_log_that_is_neither_a_table_nor_a_map_is_refused(run: Path, name: str) -> None:
    Path("FOLDER.csv").mkdir()
    said = refusal("replay", "a.mcap", "--log", name)
    assert said.startswith(("--log", "FOLDER.csv"))
    assert (".csv nor .kml" in said) is not name.endswith(".csv")


@pytest.mark.parametrize("folders", [("nowhere",), ("walk", "nowhere")])
def test_recordings_that_are_missing_are_named_before_any_is_played(
    run: Path, monkeypatch: pytest.MonkeyPatch, folders: tuple[str, ...]
) -> None:
    monkeypatch.setattr(
        "relpos.emulator.recorded_team.play", lambda *_, **__: pytest.fail("it plays first")
    )
    (run / "imu.csv").write_text(IMU)
    said = refusal("simulate", "--recordings", *folders, "--seed", 1, "--out", "team")
    assert said == "nowhere: no such folder\n"


def test_a_key_that_is_none_is_refused_before_there_is_a_mission(tmp_path: Path) -> None:
    (tmp_path / "plan.png").write_bytes(b"\x89PNG")
    words = ("mission", tmp_path / "m", "--key-file", tmp_path / "plan.png", "--seconds", 1)
    assert "no key can be read" in refusal(*words)
    assert not (tmp_path / "m").exists()


def test_a_new_key_that_has_no_folder_is_refused_before_a_board_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("relpos.link.port.open_port", lambda *_: pytest.fail("the board's port"))
    key = tmp_path / "stick" / "team.key"
    said = refusal("node", "flash", "/dev/ttyACM0", "--new", "--key-file", key)
    assert said == f"{key}: cannot be written: there is no folder {key.parent}\n"


def test_a_recording_under_another_name_is_told(run: Path) -> None:
    done = relpos("fuse", run, *QUICK, "--record", "tracks.csv", "--out", "out")
    assert done.exit_code == 0, done.output
    assert "tracks.csv: an MCAP recording, whatever its name says\n" in done.stderr
    again = relpos("fuse", "tracks.csv", *QUICK, "--record", "b.MCAP", "--out", "again")
    assert again.exit_code == 0, again.output
    assert "whatever" not in again.stderr
