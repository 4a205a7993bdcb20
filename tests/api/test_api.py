"""The Python interface: five lines from a recording to a score, light until it is used."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import relpos


@pytest.fixture(scope="module")
def run() -> relpos.Run:
    return relpos.simulate("paper", 3, seconds=40)


@pytest.fixture(scope="module")
def result(run: relpos.Run) -> relpos.Result:
    return relpos.fuse(run, "particle", seed=1, settings={"particles": 50})


def test_importing_relpos_loads_nothing_heavy() -> None:
    code = "import relpos, sys; print(sorted(m for m in sys.modules if m in {'numpy','numba'}))"
    result_of_process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result_of_process.stdout.strip() == "[]"


def test_every_name_it_promises_is_there() -> None:
    for name in relpos.__all__:
        assert getattr(relpos, name) is not None
        assert name in dir(relpos)
    with pytest.raises(AttributeError, match="no attribute 'fues'"):
        relpos.fues  # noqa: B018


def test_the_same_seed_gives_the_same_result(run: relpos.Run, result: relpos.Result) -> None:
    again = relpos.fuse(run, "particle", seed=1, settings={"particles": 50})
    np.testing.assert_array_equal(again.arrays()["x_m"], result.arrays()["x_m"])
    other = relpos.fuse(run, "particle", seed=2, settings={"particles": 50})
    assert (other.arrays()["x_m"] != result.arrays()["x_m"]).any()


def test_a_result_written_and_read_scores_the_same(
    run: relpos.Run, result: relpos.Result, tmp_path: Path
) -> None:
    result.save(tmp_path)
    here, there = relpos.evaluate(result, run), relpos.evaluate(tmp_path, run)
    assert there.metrics.relative_distance_rmse_m == pytest.approx(
        here.metrics.relative_distance_rmse_m, abs=1e-5
    )
    assert there.bound == here.bound
    assert there.bound is not None
    assert "relative distance RMSE" in str(here)


def test_frames_are_tables_of_pandas(result: relpos.Result) -> None:
    pandas = pytest.importorskip("pandas")
    poses = result.frame()
    assert isinstance(poses, pandas.DataFrame)
    assert len(poses) == sum(len(e.nodes) for e in result.estimates)
    assert set(poses["status"]) == {"ok"}
    assert poses.groupby("node")["x_m"].count().to_dict() == dict.fromkeys(range(1, 7), 40)
    pairs = result.frame("pairs")
    assert (pairs["node"] < pairs["peer"]).all()


def test_a_frame_is_a_record_array_without_pandas(
    result: relpos.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    poses = result.frame()
    assert isinstance(poses, np.recarray)
    np.testing.assert_array_equal(poses.x_m, result.arrays()["x_m"])
    with pytest.raises(relpos.RelposError, match="no table 'positions': one of poses"):
        result.frame("positions")


def test_learned_parameters_are_a_table_too(run: relpos.Run) -> None:
    learned = relpos.fuse(run, settings={"hypotheses": 20}).arrays("parameters")
    assert "step_scale" in set(learned["name"])
    assert learned["value"].shape == learned["time_s"].shape


def test_the_start_can_be_overruled(run: relpos.Run) -> None:
    given = relpos.fuse(run, "deadreckoning", initial="truth")
    moved = relpos.fuse(
        run, "deadreckoning", initial=[relpos.Prior(n, 5.0, 0.0, 0.0) for n in run.node_ids]
    )
    apart = moved.arrays()["x_m"] - given.arrays()["x_m"]
    np.testing.assert_allclose(apart, 5.0, atol=1e-9)
    with pytest.raises(relpos.RelposError, match="none of unknown, common, truth"):
        relpos.fuse(run, initial="somewhere")


def test_latency_is_what_the_estimator_waits_in_the_runs_time(
    run: relpos.Run, result: relpos.Result
) -> None:
    # An estimate of a second comes when somebody's next motion shows that the second is over.
    assert result.latency is not None
    assert result.latency.wait_median_s == pytest.approx(1.0)

    class AtTheEnd:
        def process(self, measurement: relpos.Measurement) -> list[relpos.Estimate]:
            return []

        def finish(self) -> list[relpos.Estimate]:
            return list(result.estimates)

        def counters(self) -> dict[str, int]:
            return {}

    late = relpos.fuse(run, AtTheEnd()).latency
    assert late is not None
    assert late.wait_max_s == pytest.approx(39.0)


def test_a_run_without_truth_cannot_be_scored(run: relpos.Run, result: relpos.Result) -> None:
    from dataclasses import replace

    with pytest.raises(relpos.DataError, match="no truth"):
        relpos.evaluate(result, replace(run, truth=()))
