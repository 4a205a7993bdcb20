"""Late measurements are put in their place, and no estimate waits for them."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from relpos import fusion
from relpos.fusion.estimator import Estimate
from relpos.fusion.rewind import Rewinder
from relpos.fusion.timeline import Advance, Epoch, Ranging, Sensed, Step, Timeline
from relpos.measurements import Height, Measurement, Motion, Range
from relpos.simulation.paper import simulate_paper


@dataclass
class Log:
    """A core of the simplest kind: it logs its steps and draws random numbers."""

    steps: list[Step] = field(default_factory=list)
    dice: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    thrown: list[float] = field(default_factory=list)
    calls: list[Step] = field(default_factory=list)
    """Every step ever processed, the repeated ones included."""

    def update(self, step: Step, timeline: Timeline) -> Estimate | None:
        self.calls.append(step)
        self.steps.append(step)
        self.thrown.append(self.dice.random())
        return Estimate(step.time_s, (), ()) if isinstance(step, Epoch) else None

    def cost_s(self, step: Step) -> float:
        return 1e-5

    @property
    def clocks(self) -> None:
        """Nothing is learned of time stamps."""

    @property
    def shared(self) -> tuple[object, ...]:
        return (self.calls, *self.calls)

    def check_run(self, counters: Mapping[str, int]) -> None:
        pass

    def counters(self) -> Counter[str]:
        return Counter()


def rewinder() -> Rewinder:
    return Rewinder(Log(), Timeline([1, 2, 3], reorder_s=0.3, max_lag_s=1.5))


def log_of(rewinder: Rewinder) -> Log:
    """The core that is current now."""
    assert isinstance(rewinder.core, Log)
    return rewinder.core


def feed(rewinder: Rewinder, measurements: Iterable[Measurement]) -> list[Estimate]:
    return [e for m in measurements for e in rewinder.process(m)] + rewinder.finish()


def team(seconds: int = 40, slow: Sequence[int] = ()) -> list[Measurement]:
    """Three nodes with phases of their own, ranges and heights between their reports.

    Nodes in ``slow`` report every 3 s.
    """
    given: list[Measurement] = []
    for k in range(1, seconds):
        for node in (1, 2, 3):
            period = 3 if node in slow else 1
            if k % period == 0:
                given.append(Motion(k + 0.27 * (node - 1), node, 0.5 * period, 0.01 * k, 0.1))
        given += [Range(k + 0.5, 1, 2, 3.0 + k), Range(k + 0.5, 2, 3, 4.0), Range(k + 0.8, 1, 3, k)]
        given.append(Height(k + 0.9, 2, 0.1 * k))
    return sorted(given, key=lambda m: m.time_s)


def delayed(
    measurements: Sequence[Measurement], share: float, seed: int, most_s: float = 4.9
) -> list[Measurement]:
    """Put a share of them up to ``most_s`` later among the others."""
    rng = np.random.default_rng(seed)
    late = rng.random(len(measurements)) < share
    arrival = [m.time_s for m in measurements] + late * rng.uniform(0.0, most_s, len(measurements))
    return [measurements[k] for k in np.argsort(arrival, kind="stable")]


@pytest.mark.parametrize(
    ("share", "seed"),
    [
        (0.05, 1),
        *(pytest.param(*row, marks=pytest.mark.soak) for row in ((0.05, 2), (1.0, 5))),
        (0.4, 3),
        (1.0, 4),
    ],
)
def test_a_replay_gives_the_result_of_punctual_measurements(share: float, seed: int) -> None:
    straight, mixed = rewinder(), rewinder()
    ordered = team()
    feed(straight, ordered)
    shuffled = delayed(ordered, share, seed)
    assert shuffled != ordered
    feed(mixed, shuffled)
    assert log_of(mixed).steps == log_of(straight).steps
    assert log_of(mixed).thrown == log_of(straight).thrown
    assert mixed.counters()["rewinds"] > 0
    assert straight.counters()["rewinds"] == 0
    assert not any("late" in name for name in mixed.counters())


def test_the_steps_are_those_of_a_timeline_that_waits_long_enough() -> None:
    quick = rewinder()
    ordered = team(slow=[2])
    feed(quick, delayed(ordered, 0.3, 7, most_s=1.5))
    patient = Timeline([1, 2, 3], reorder_s=0.3, max_lag_s=5.0)
    steps = [s for m in ordered for s in patient.push(m)] + patient.finish()
    assert log_of(quick).steps == steps


def test_estimates_do_not_wait_for_what_is_late_and_come_only_once() -> None:
    quick = rewinder()
    lags, times = [], []
    newest = 0.0
    for m in delayed(team(), 0.3, 8):
        newest = max(newest, m.time_s)
        for estimate in quick.process(m):
            times.append(estimate.time_s)
            lags.append(newest - estimate.time_s)
    assert max(lags) < 3.0
    assert float(np.median(lags)) < 1.5
    assert times == sorted(set(times))
    assert len(times) > 30


def test_a_node_that_falls_silent_delays_no_other_and_its_path_is_not_lost() -> None:
    ordered = [m for m in team() if not (isinstance(m, Motion) and m.node == 3 and m.time_s > 10)]
    quick = rewinder()
    lags = []
    for m in ordered:
        lags += [m.time_s - e.time_s for e in quick.process(m)]
    assert max(lags) < 2.5
    # It comes back after 20 s with one long displacement.
    back = Motion(39.9, 3, 7.0, 0.0, 0.0)
    feed(quick, [back])
    way = [s for s in log_of(quick).steps if isinstance(s, Advance) and s.node == 3]
    assert sum(s.fraction for s in way) == pytest.approx(9 + 1)
    # What lies within the window is spread over its time, the rest handed out at its beginning.
    last = [s for s in way if s.time_s > 11.0]
    assert last[0].time_s < 34.5
    assert len(last) > 5
    assert quick.counters()["motions_beyond_window"] == 1


def test_ranges_later_than_the_window_are_dropped_and_counted() -> None:
    quick = rewinder()
    feed(quick, [*team(), Range(20.2, 1, 2, 99.0)])
    assert not any(
        isinstance(s, Ranging) and s.ranges[0].range_m == 99.0 for s in log_of(quick).steps
    )
    assert quick.counters()["ranges_late"] == 1


def test_a_late_height_is_put_in_its_place() -> None:
    quick = rewinder()
    ordered = team()
    at = next(k for k, m in enumerate(ordered) if m.time_s > 24.0)
    feed(quick, [*ordered[:at], Height(20.2, 1, 7.5), *ordered[at:]])
    sensed = [s for s in log_of(quick).steps if isinstance(s, Sensed)]
    assert [s.time_s for s in sensed] == sorted(s.time_s for s in sensed)
    assert any(s.measurement == Height(20.2, 1, 7.5) for s in sensed)


def test_refused_ranges_are_counted_once_whatever_is_replayed() -> None:
    quick = rewinder()
    ordered = team()
    broken = [Range(10.2, 1, 2, 0.0), Range(20.2, 2, 2, 1.0)]
    feed(quick, delayed(sorted([*ordered, *broken], key=lambda m: m.time_s), 0.5, 9))
    counted = quick.counters()
    assert (counted["ranges_failed"], counted["ranges_to_itself"]) == (1, 1)


def test_a_burst_of_late_reports_costs_one_replay() -> None:
    ordered = team()
    late = [m for m in ordered if isinstance(m, Range) and 20.0 < m.time_s < 23.0]
    assert len(late) == 9
    rest = [m for m in ordered if m not in late]
    at = next(k for k, m in enumerate(rest) if m.time_s > 24.0)
    quick = rewinder()
    feed(quick, [*rest[:at], *late, *rest[at:]])
    assert quick.counters()["rewinds"] == 1
    # At most the window, a report and a second between copies.
    assert 0 < quick.counters()["rewound_steps"] < 8.0 * len(log_of(quick).steps) / 40


def test_a_call_replays_a_bounded_part_and_the_next_calls_the_rest() -> None:
    ordered = team()
    at = next(k for k, m in enumerate(ordered) if m.time_s > 24.0)
    late = [*ordered[:at], Height(20.2, 1, 7.5), *ordered[at:]]
    quick = rewinder()
    quick.most_s = 1e-4
    most, estimates = 0, []
    for m in late:
        before = len(log_of(quick).calls)
        estimates += quick.process(m)
        most = max(most, len(log_of(quick).calls) - before)
    estimates += quick.finish()
    assert most <= 11
    assert quick.counters()["rewound_steps"] > 3 * most
    straight = rewinder()
    whole = feed(straight, sorted(late, key=lambda m: m.time_s))
    assert log_of(quick).steps == log_of(straight).steps
    assert log_of(quick).thrown == log_of(straight).thrown
    assert [e.time_s for e in estimates] == [e.time_s for e in whole]


def test_the_history_stays_bounded_without_any_motion() -> None:
    quick = Rewinder(Log(), Timeline(reorder_s=0.3, max_lag_s=1.5))
    for k in range(600):
        quick.process(Range(0.1 * k, 1, 2, 3.0))
    assert len(quick._history) < 200
    assert len(quick._copies) < 10


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_the_bank_ends_with_late_data_as_it_does_with_sorted(share: float) -> None:
    run = simulate_paper("paper-h", 3, {"seconds": 60.0})
    final = []
    for measurements in (run.measurements, delayed(run.measurements, share, 4)):
        bank = fusion.make("bank", run.priors, {"hypotheses": 20}, 1)
        estimates = [e for m in measurements for e in bank.process(m)] + bank.finish()
        times = [e.time_s for e in estimates]
        assert times == sorted(set(times))
        final.append(estimates[-1])
        rewinds = bank.counters().get("rewinds", 0)
    assert final[1] == final[0]
    assert rewinds > 0


@pytest.mark.parametrize("estimator", ["bank", "particle"])
def test_copies_go_without_the_garbage_collector_as_soon_as_they_are_too_old(
    estimator: str,
) -> None:
    run = simulate_paper("paper", seed=3, overrides={"seconds": 40, "nodes": 3})
    filter_ = fusion.make(estimator, run.priors, seed=0)
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        for m in run.measurements:
            filter_.process(m)
        gc.collect()
        left = {type(thing) for thing in gc.garbage}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert not [kind for kind in left if kind.__module__.startswith("relpos")]
