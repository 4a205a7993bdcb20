"""Recordings of real people through the firmware as a team."""

import numpy as np
import pytest

from relpos.emulator.recorded_team import one_mission
from relpos.runs import load_run
from relpos.runs.imu import ImuRecording
from shared_data import DATA
from support.command import relpos


def standing(up, seconds):
    count = round(100 * seconds)
    force = np.tile(9.81 * np.array(up), (count, 1))
    return ImuRecording(
        np.arange(count) / 100.0, force, np.zeros((count, 3)), np.full((count, 3), np.nan)
    )


def test_recordings_join_without_a_jump_of_gravity():
    tilted = np.array([0.3, 0.0, np.sqrt(1.0 - 0.09)])
    mission, placed = one_mission([standing([0, 0, 1], 3.0), standing(tilted, 4.0)], 16.0)
    assert [k for k, _ in placed] == [0, 1, 0]
    assert np.allclose(mission.acceleration_m_s2, [0.0, 0.0, 9.81])
    assert np.diff(mission.time_s).min() > 0.0
    assert np.diff(mission.time_s) == pytest.approx(0.01, abs=1e-6)


@pytest.mark.skipif(
    not (DATA / "walk_lowerback_20m").is_dir(),
    reason="no recordings: walk_lowerback_20m is not in ../shared/data (or RELPOS_DATA)",
)
def test_simulate_writes_a_team_of_real_walkers(tmp_path):
    walks = DATA / "walk_lowerback_20m"
    done = relpos(
        "simulate", "--recordings", walks / "11-*", walks / "13-1", "--seed", 0,
        "--out", tmp_path / "team", "--set", "seconds=40",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    run = load_run(tmp_path / "team")
    assert run.node_ids == (1, 2)
    assert len(run.ranges) > 10
    assert len(run.truth) == 2 * 41
    for node in run.node_ids:
        way = sum(np.hypot(m.dx_m, m.dy_m) for m in run.motions if m.node == node)
        assert 10.0 < way < 45.0


def test_what_simulate_is_to_make_has_to_be_clear(tmp_path):
    out = ("--seed", 0, "--out", tmp_path / "team")
    for arguments in (["--scenario", "paper", "--recordings", "a"], [], ["--scenario", "lab", "a"]):
        done = relpos("simulate", *arguments, *out)
        assert done.exit_code == 2
        assert "--recordings" in done.output
