"""Studies over many seeds: the same figures wherever they are computed, summed up rightly."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import Executor

import numpy as np
import pytest

from relpos.errors import RelposError
from relpos.evaluation import executors, study
from relpos.evaluation.study import Case, Statistic

SHORT = {"seconds": 30}
CASES = [
    Case("particles", overrides=SHORT, settings={"particles": 50}),
    Case("dead reckoning", overrides=SHORT, estimator="deadreckoning"),
    Case("no range", overrides={**SHORT, "detection": 0}),
]


def square(number: int) -> int:
    return number * number


def refuse(number: int) -> int:
    raise RelposError(f"{number} is refused")


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    with executors.executor(workers=2) as made:
        yield made


def figures(outcomes: list[study.Outcome]) -> list[list[float]]:
    return [[s.distance_m for s in o.scores] for o in outcomes]


@pytest.mark.soak
def test_every_core_gives_the_figures_of_one(pool: Executor) -> None:
    seeds = range(3)
    one = study.run(CASES, seeds, executors.Serial())
    many = study.run(CASES, seeds, pool)
    assert np.array_equal(figures(one), figures(many), equal_nan=True)
    assert [[s.seed for s in o.scores] for o in many] == [[0, 1, 2]] * 3
    assert [o.case.label for o in many] == [c.label for c in CASES]


def test_a_dask_cluster_gives_the_figures_of_one() -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
        executors.executor(cluster.scheduler_address) as pool,
    ):
        there = study.run(CASES, range(2), pool)
    here = study.run(CASES, range(2), executors.Serial())
    assert np.array_equal(figures(here), figures(there), equal_nan=True)


def test_a_cluster_that_is_not_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    monkeypatch.setattr(executors, "CONNECT_S", 0.2)
    with (
        pytest.raises(RelposError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"),
        executors.executor("tcp://127.0.0.1:9"),
    ):
        pass


def test_an_estimator_that_gives_up_is_reported_and_not_counted() -> None:
    outcome = study.run(CASES[2:], range(2), executors.Serial())[0]
    assert outcome.distance_m.count == 0
    assert math.isnan(outcome.distance_m.mean)
    assert len(outcome.failures) == 2
    assert "no usable range" in outcome.failures[0]


def test_results_come_in_the_order_of_the_jobs_with_progress(pool: Executor) -> None:
    progress: list[tuple[int, int]] = []
    jobs = [(k,) for k in range(7)]
    results = executors.run_all(
        pool, square, jobs, lambda done, total: progress.append((done, total))
    )
    assert results == [k * k for k in range(7)]
    assert progress == [(k, 7) for k in range(1, 8)]


def test_a_failed_job_is_raised_with_its_own_words(pool: Executor) -> None:
    with pytest.raises(RelposError, match="3 is refused"):
        executors.run_all(pool, refuse, [(3,)])


def test_a_figure_is_mean_standard_error_and_worst() -> None:
    figure = Statistic.of([1.0, 2.0, math.nan, 6.0])
    assert (figure.mean, figure.worst, figure.count) == (3.0, 6.0, 3)
    assert figure.error == pytest.approx(math.sqrt(7.0 / 3.0))
    assert figure.half_width == pytest.approx(1.96 * figure.error, rel=1e-4)


def test_the_bound_of_a_scenario_is_computed_once_for_all_its_estimators() -> None:
    progress: list[tuple[int, int]] = []
    found = study.bounds_of(
        CASES, range(2), executors.Serial(), lambda done, total: progress.append((done, total))
    )
    assert found[0] == found[1]
    assert found[2].filtering_distance_m > found[0].filtering_distance_m
    assert progress[-1] == (4, 4)
