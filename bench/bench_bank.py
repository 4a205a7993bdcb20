"""What an epoch of the bank costs: N 6, paper-p1, one thread.

    python bench/bench_bank.py [--hypotheses 200 1] [--rounds 9]

An epoch is 2 s: two motions of each user and about 5.3 ranges. For each number of hypotheses:

* measurements handed over as arrays, epoch by epoch (``move``, ``update``, ``end_instant``);
* one measurement after another through the public interface, an estimate a second, detection and
  snapshots for rewinding included; with the same state (no range biases), once
  reading none of its estimates and once all of them, and with default settings.

Figures are processor time: over those epochs in which the bank had just that many hypotheses, the
median (and the mean: snapshots and the learning of detection come now and then) of the least of
several rounds over the same run, since other work on the machine only adds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping

import numpy as np

from relpos import fusion
from relpos.fusion.bank.core import BankCore
from relpos.fusion.bank.estimator import Bank
from relpos.fusion.estimator_settings import BankSettings
from relpos.fusion.models.ranging import Repeats
from relpos.fusion.switching import SwitchingEstimator
from relpos.measurements import Motion, Range
from relpos.simulation.paper import SimulatedRun, simulate_paper

EPOCH_S = 2.0


def core_of(run: SimulatedRun, hypotheses: int) -> BankCore:
    """A bank with the run's users, without biases."""
    core = BankCore(BankSettings(hypotheses=hypotheses, biased=0.0), 0)
    for prior in run.priors:
        core.add_node((prior.x_m, prior.y_m, prior.heading_rad), 0.0, 0.0)
    return core


def use_ranges(core: BankCore, first: np.ndarray, second: np.ndarray, range_m: np.ndarray) -> None:
    """Update with ranges on one level, of users who stand."""
    count = len(first)
    nought, repeats = np.zeros(count), Repeats(np.ones(count), np.zeros(count))
    no_velocity, no_outliers = np.zeros((count, 4)), np.zeros((count, 3))
    core.update(first, second, range_m, nought, nought, repeats, no_velocity, no_outliers)


def core_us(run: SimulatedRun, hypotheses: int) -> dict[str, np.ndarray]:
    """Microseconds of each epoch's parts (E,), NaN where there were others than so many."""
    motions = [m for m in run.measurements if isinstance(m, Motion)]
    ranges = [m for m in run.measurements if isinstance(m, Range)]
    rows = np.array([m.node - 1 for m in motions])
    moves = np.array([(m.dx_m, m.dy_m, m.dtheta_rad, 1.0) for m in motions])
    first = np.array([m.node - 1 for m in ranges])
    second = np.array([m.peer - 1 for m in ranges])
    range_m, unreported = np.array([m.range_m for m in ranges]), np.full((len(moves), 3), np.nan)
    ends_s = np.arange(EPOCH_S, run.measurements[-1].time_s + EPOCH_S, EPOCH_S)
    move_ends = np.searchsorted([m.time_s for m in motions], ends_s, side="right")
    range_ends = np.searchsorted([m.time_s for m in ranges], ends_s, side="right")
    core = core_of(run, hypotheses)
    parts: dict[str, list[float]] = {"advance": [], "update": [], "end_instant": []}
    moved = ranged = 0
    for end_s, m, r in zip(ends_s.tolist(), move_ends.tolist(), range_ends.tolist(), strict=True):
        some_moves, some_ranges = slice(moved, m), slice(ranged, r)
        moved, ranged = m, r
        ours = core.hypotheses.count == hypotheses
        marks = [time.thread_time()]
        core.move(rows[some_moves], moves[some_moves], unreported[some_moves])
        marks.append(time.thread_time())
        if len(first[some_ranges]):
            use_ranges(core, first[some_ranges], second[some_ranges], range_m[some_ranges])
        marks.append(time.thread_time())
        core.end_instant(end_s)
        marks.append(time.thread_time())
        for name, spent in zip(parts, np.diff(marks), strict=True):
            parts[name].append(
                1e6 * spent if ours and core.hypotheses.count == hypotheses else np.nan
            )
    return {name: np.array(values) for name, values in parts.items()}


def interface_us(
    run: SimulatedRun, hypotheses: int, settings: Mapping[str, object], *, read: bool
) -> np.ndarray:
    """Microseconds of each epoch (E,), NaN as above."""
    estimator = fusion.make("bank", run.priors, {"hypotheses": hypotheses, **settings}, 0)
    assert isinstance(estimator, SwitchingEstimator)
    marks, counts, end_s = [time.thread_time()], [count_of(estimator)], EPOCH_S
    for measurement in run.measurements:
        if measurement.time_s > end_s:
            end_s += EPOCH_S
            marks.append(time.thread_time())
            counts.append(count_of(estimator))
        for estimate in estimator.process(measurement):
            if read:
                assert estimate.nodes
    ours = np.array(counts) == hypotheses
    return np.where(ours[1:] & ours[:-1], 1e6 * np.diff(marks), np.nan)


def count_of(estimator: SwitchingEstimator) -> int:
    """How many hypotheses the bank has now."""
    core = estimator.estimator.core
    assert isinstance(core, Bank)
    return core.core.hypotheses.count


def figure(rounds: list[np.ndarray]) -> str:
    """Median and mean over epochs of the least of the rounds (R, E)."""
    least = np.min(rounds, axis=0)
    return f"{np.nanmedian(least):.0f} us (mean {np.nanmean(least):.0f})"


def main() -> None:
    """Print a paragraph for each number of hypotheses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hypotheses", type=int, nargs="+", default=[200, 1])
    parser.add_argument("--rounds", type=int, default=9)
    args = parser.parse_args()
    run = simulate_paper("paper-p1", 0, {"seconds": 300.0})
    for hypotheses in args.hypotheses:
        core_us(run, hypotheses)
        rounds = [core_us(run, hypotheses) for _ in range(args.rounds)]
        parts = {
            name: np.nanmedian(np.min([r[name] for r in rounds], axis=0)) for name in rounds[0]
        }
        total = figure([np.sum(list(r.values()), axis=0) for r in rounds])
        print(
            f"{hypotheses} hypotheses, states of 30: {total} an epoch ("
            + ", ".join(f"{name} {value:.0f}" for name, value in parts.items())
            + ")"
        )
        for words, settings, read in (
            ("measurement by measurement, the same state", {"biased": 0.0}, False),
            ("  and every estimate looked at", {"biased": 0.0}, True),
            ("  and default settings, states of 46", {}, True),
        ):
            summary = figure(
                [interface_us(run, hypotheses, settings, read=read) for _ in range(args.rounds)]
            )
            print(f"  {words}: {summary}", flush=True)


if __name__ == "__main__":
    main()
