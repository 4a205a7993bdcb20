"""The Python interface: five lines from a recording to a score, light until it is used."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import relpos
from relpos.evaluation.result import read_result
from relpos.measurements import Event


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


def test_a_run_whose_starts_are_unknown_has_no_bound() -> None:
    """It would be hundreds of metres, which every estimator beats, by what stands for unknown."""
    for start in ("unknown", "position", "heading"):
        assert relpos.bound(relpos.simulate("paper-p1", 3, seconds=20, start=start)) is None
    assert relpos.bound(relpos.simulate("paper-p1", 3, seconds=20, start="known")) is not None


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
    with pytest.raises(relpos.DataError, match="no truth"):
        relpos.evaluate(result, replace(run, truth=()))


def test_a_run_that_is_saved_over_another_is_the_same_when_loaded(
    run: relpos.Run, tmp_path: Path
) -> None:
    (tmp_path / "height.csv").write_text("time_s,node,height_m\n1.0,1,0.5\n")
    (tmp_path / "motion.csv.gz").write_bytes(b"an older run")
    relpos.save(run, tmp_path)
    assert relpos.load(tmp_path).measurements == run.measurements


@pytest.mark.parametrize("seed", [None, -1, "1", 1.5])
def test_a_seed_that_is_no_whole_number_is_refused(run: relpos.Run, seed: Any) -> None:
    with pytest.raises(relpos.RelposError, match="seed: "):
        relpos.simulate("lab", seed)
    with pytest.raises(relpos.RelposError, match="seed: "):
        relpos.fuse(run, seed=seed)


@pytest.mark.parametrize("estimator", [3, None])
def test_what_is_no_estimator_is_refused(run: relpos.Run, estimator: Any) -> None:
    with pytest.raises(relpos.RelposError, match="estimator: "):
        relpos.fuse(run, estimator)


def test_a_path_in_place_of_a_run_is_refused(result: relpos.Result, tmp_path: Path) -> None:
    path: Any = "walk"
    with pytest.raises(relpos.RelposError, match="load reads one"):
        relpos.fuse(path)
    with pytest.raises(relpos.RelposError, match="load reads one"):
        relpos.evaluate(result, path)
    with pytest.raises(relpos.RelposError, match="load reads one"):
        relpos.bound(path)
    with pytest.raises(relpos.RelposError, match="load reads one"):
        relpos.save(path, tmp_path)


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        (relpos.Prior(1, math.nan, 0.0, 0.0), "node 1 is not finite"),
        (relpos.Prior(1, 0.0, 0.0, 0.0, -1.0), "sigma of node 1 is negative"),
        (relpos.Prior(1, 1e300, 0.0, 0.0), "x_m of node 1 is beyond its bounds"),
        (relpos.Prior(-1, 0.0, 0.0, 0.0), "-1 is no node id"),
        (relpos.Prior("1", 0.0, 0.0, 0.0), "something else than a number"),  # type: ignore[arg-type]
        (relpos.Prior(1, None, 0.0, 0.0), "something else than a number"),  # type: ignore[arg-type]
        ((1, 0.0, 0.0, 0.0), "tuple, not a relpos.Prior"),
    ],
)
def test_a_start_that_cannot_be_is_refused(
    run: relpos.Run, prior: relpos.Prior, words: str
) -> None:
    with pytest.raises(relpos.RelposError, match=words):
        relpos.fuse(run, initial=[prior])


def test_settings_that_are_no_mapping_are_refused(run: relpos.Run) -> None:
    text: Any = "hypotheses=1"
    with pytest.raises(relpos.RelposError, match="settings: "):
        relpos.fuse(run, settings=text)


def test_starts_and_measurements_may_come_from_a_generator(run: relpos.Run) -> None:
    given = relpos.fuse(run, "deadreckoning", initial=run.priors)
    assert relpos.fuse(run, "deadreckoning", initial=(p for p in run.priors)) == given
    assert relpos.fuse(run, "deadreckoning", measurements=iter(run.measurements)) == given


def test_results_of_the_same_estimates_are_equal(run: relpos.Run, result: relpos.Result) -> None:
    assert relpos.fuse(run, "particle", seed=1, settings={"particles": 50}) == result
    assert relpos.fuse(run, "particle", seed=2, settings={"particles": 50}) != result


@pytest.mark.parametrize("given", [None, 3, [1]])
def test_what_is_no_result_is_refused(run: relpos.Run, given: Any) -> None:
    with pytest.raises(relpos.RelposError, match=r"not a relpos\.Estimate"):
        relpos.evaluate(given, run)


def test_a_number_that_cannot_be_read_back_is_not_saved(run: relpos.Run, tmp_path: Path) -> None:
    relpos.save(run, tmp_path)
    unknown = replace(run.motions[0], sigma_x_m=math.nan)
    with pytest.raises(relpos.DataError, match="sigma_x_m cannot be read back"):
        relpos.save(replace(run, measurements=(unknown,)), tmp_path)
    assert relpos.load(tmp_path).measurements == run.measurements


def test_an_estimate_that_is_read_is_scored_from_the_start_that_it_was_fused_from(
    run: relpos.Run, tmp_path: Path
) -> None:
    for initial, known in (("truth", True), ("common", False)):
        result = relpos.fuse(run, "deadreckoning", initial=initial)
        result.save(tmp_path)
        here, there = relpos.evaluate(result, run), relpos.evaluate(tmp_path, run)
        assert (there.nees_position is not None) is (here.nees_position is not None) is known
        assert set(there.iso.frames) == set(here.iso.frames)
        assert read_result(tmp_path).priors == result.priors
    vague = (relpos.Prior(1, 0.1 + 0.2, 2.0, 0.5, math.inf, 0.25),)
    replace(result, priors=vague).save(tmp_path)
    assert read_result(tmp_path).priors == vague
    replace(result, priors=()).save(tmp_path)
    assert read_result(tmp_path).priors == ()
    replace(result, priors=None).save(tmp_path)
    assert read_result(tmp_path).priors is None


def test_evaluations_of_the_same_estimates_are_equal(
    run: relpos.Run, result: relpos.Result
) -> None:
    assert relpos.evaluate(result, run) == relpos.evaluate(result, run)
    other = relpos.fuse(run, "deadreckoning")
    assert relpos.evaluate(other, run) != relpos.evaluate(result, run)


def test_texts_that_are_none_are_saved_with_question_marks(run: relpos.Run, tmp_path: Path) -> None:
    pressed = Event(1.0, 1, "land\udcff")
    relpos.save(replace(run, name="walk\udcff", events=(pressed,)), tmp_path)
    saved = relpos.load(tmp_path)
    assert (saved.name, saved.events[0].event) == ("walk?", "land?")
