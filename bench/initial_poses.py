"""Unknown initial poses: how soon they are found, and how honest the estimate is until then.

    python bench/initial_poses.py [--seeds 50] [--first 0] [--every 10] [--only paper|robots|...]

*paper*: scenario P1 with no initial poses, or only a part of them; aligned RMSE at 120 s, and how
often the alternatives' 90 % region holds the truth until all are located, its area beside that of a
blind guess (90 % of the disc whose radius is the longest range so far).
*robots*: two robots, windows of 90 s cut out of the recordings every so many seconds, each with
nothing scored. "Under .5 m" is the first time from which the body-frame error (both directions) is
less for five seconds; "declared" is when both are ``ok``.
*still* and *four*: the recordings in which one robot stands.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from relpos import fusion, tracks
from relpos.evaluation import metrics, regions
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.measurements import Measurement, Prior, Range, Truth
from relpos.runs import load_run
from relpos.simulation.paper import simulate_paper
from shared_data import DATA

Floats = npt.NDArray[np.float64]

WINDOW_S = 90.0


@dataclass(frozen=True)
class ScoredRun:
    """One run: by epoch (T,), NaN where there is nothing to say."""

    time_s: Floats
    located: Floats
    inside: Floats
    area_m2: Floats
    blind_m2: Floats
    ring: Floats
    cost_s: Floats
    estimates: list[Estimate]
    truth: tuple[Truth, ...]

    def scored(self) -> metrics.Metrics:
        """Score everything, guesses included."""
        return metrics.evaluate(
            tracks.estimated_tracks(self.estimates), tracks.true_tracks(self.truth)
        )


def run_bank(
    measurements: Sequence[Measurement],
    truth: tuple[Truth, ...],
    priors: Sequence[Prior],
    seed: int,
) -> ScoredRun:
    """Run the bank and look at every epoch."""
    true = tracks.true_tracks(truth)
    estimator = fusion.make("bank", priors, {}, seed)
    longest_m, frame = 0.0, None
    rows: list[tuple[float, ...]] = []
    estimates: list[Estimate] = []
    started = time.perf_counter()
    for measurement in [*measurements, None]:
        if isinstance(measurement, Range):
            longest_m = max(longest_m, measurement.range_m)
        new = estimator.finish() if measurement is None else estimator.process(measurement)
        spent, started = time.perf_counter() - started, time.perf_counter()
        for e in new:
            located = [n.node for n in e.nodes if n.status is NodeStatus.OK]
            if frame is None and located:
                frame = tracks.UNMOVED if priors else regions.into_frame_of([e], true)
            looks = regions.look(e, true, frame or tracks.UNMOVED)
            mean = [math.nan] * 3
            if looks:
                mean = np.mean([(q.holds, q.area_m2, q.ring) for q in looks], axis=0).tolist()
            blind = regions.SHARE * math.pi * longest_m**2
            rows.append((e.time_s, len(located) / len(e.nodes), *mean, blind, spent / len(new)))
        if new:
            started = time.perf_counter()
        estimates += new
    time_s, located_share, inside_, area_, ring_, blind_, cost = np.array(rows).T
    return ScoredRun(time_s, located_share, inside_, area_, blind_, ring_, cost, estimates, truth)


def paper(seeds: range) -> None:
    """Print scenario P1 from starts of which nothing, or only a part, is known."""
    print(f"scenario paper-p1, {len(seeds)} seeds from {seeds[0]}, 180 s")
    print(f"{'known at the start':24}{'<.5 m':>7}{'at 120 s':>10}{'later':>7}"
          f"{'in 90 %':>9}{'area':>8}{'blind':>8}{'ms':>6}")  # fmt: skip
    kinds: dict[str, Callable[[Sequence[Prior]], Sequence[Prior]]] = {
        "nothing": lambda p: (),
        "headings": lambda p: [replace(q, sigma_m=math.inf, sigma_rad=0.05) for q in p],
        "places": lambda p: [replace(q, sigma_m=0.2, sigma_rad=math.inf) for q in p],
        "all but one's": lambda p: [q for q in p if q.node != 4],
    }
    for name, keep in kinds.items():
        at, later, inside, area, blind, cost = [], [], [], [], [], []
        for seed in seeds:
            run = simulate_paper("paper-p1", seed, {"seconds": 180.0})
            scored = run_bank(run.measurements, run.truth, keep(run.priors), seed)
            m = scored.scored()
            error = m.position_rmse_over_time_m
            at.append(float(np.interp(120.0, m.time_s, error)))
            later.append(float(np.sqrt((error[m.time_s > 120.0] ** 2).mean())))
            vague = np.isfinite(scored.inside)
            inside += list(scored.inside[vague])
            area += list(scored.area_m2[vague])
            blind += list(scored.blind_m2[vague])
            cost += list(scored.cost_s[vague])
        print(
            f"{name:24}{np.mean(np.array(at) < 0.5):7.0%}{np.mean(at):10.2f}{np.mean(later):7.2f}"
            f"{np.mean(inside):9.1%}{np.mean(area):8.1f}{np.mean(blind):8.0f}"
            f"{1e3 * np.median(cost):6.1f}",
            flush=True,
        )


def robots(every_s: int) -> None:
    """Print two robots from every window of the recordings."""
    found, declared, wrong, after, inside, cost = [], [], [], [], [], []
    for name in ("exp3_los", "exp4_los"):
        run = load_run(DATA / "two_robots_vio" / name)
        for begin in range(0, 131, every_s):
            cut = [
                replace(m, time_s=m.time_s - begin)
                for m in run.measurements
                if begin <= m.time_s < begin + WINDOW_S
            ]
            truth = tuple(replace(q, time_s=q.time_s - begin) for q in run.truth)
            scored = run_bank(cut, truth, (), 0)
            m = scored.scored()
            error, at = m.body_frame_rmse_over_time_m, m.time_s
            short = np.convolve(error < 0.5, np.ones(5), "valid") == 5
            found.append(at[np.argmax(short)] if short.any() else math.inf)
            both = np.flatnonzero(scored.located == 1.0)
            since = scored.time_s[both[0]] if both.size else math.inf
            declared.append(since)
            if both.size:
                wrong.append(np.interp(since, at, error) > 1.0)
                after += list(error[at > since])
            inside += list(scored.inside[np.isfinite(scored.inside)])
            cost += list(scored.cost_s[np.isfinite(scored.inside)])
    print(f"two robots, {len(found)} starts, one each {every_s} s of two recordings")
    for title, values in (("under .5 m", found), ("declared", declared)):
        middle, late = np.quantile(np.array(values), (0.5, 0.9), method="higher")
        print(f"  {title:12} median {middle:.0f} s, 90 % {late:.0f} s")
    print(f"  declared wrongly by more than 1 m: {np.mean(wrong):.1%} of {len(wrong)}")
    print(f"  body-frame RMSE afterwards {np.sqrt(np.mean(np.square(after))):.2f} m, "
          f"median {np.median(after):.2f} m")  # fmt: skip
    print(f"  until then the 90 % region holds the truth in {np.mean(inside):.1%} of the epochs, "
          f"{1e3 * np.median(cost):.1f} ms an epoch")  # fmt: skip


def still() -> None:
    """Print the recording in which one of two robots stands."""
    run = load_run(DATA / "two_robots_vio" / "exp1_unobservable")
    scored = run_bank(run.measurements, tuple(run.truth), (), 0)
    vague = np.isfinite(scored.inside)
    print(
        f"exp1_unobservable: {np.mean(scored.located == 1.0):.0%} of the epochs declared, the "
        f"region ({np.nanmean(scored.area_m2):.0f} m^2) holds the truth in "
        f"{scored.inside[vague].mean():.1%}, a ring in {scored.ring[vague].mean():.0%}"
    )


def four() -> None:
    """Print the four robots with uncalibrated ranges."""
    run = load_run(DATA / "four_robots_uwb" / "run1")
    for seed in range(3):
        scored = run_bank(run.measurements, tuple(run.truth), (), seed)
        m = scored.scored()
        error = m.position_rmse_over_time_m
        bad = m.time_s[error > 0.5]
        first = scored.time_s[np.argmax(scored.located == 1.0)]
        print(
            f"four_robots_uwb, seed {seed}: aligned under .5 m from {bad.max(initial=0.0):.0f} s, "
            f"all located at {first:.0f} s, then "
            f"{np.sqrt(np.mean(error[m.time_s > first] ** 2)):.2f} m; "
            f"region {np.nanmean(scored.inside):.0%}"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--only", default="", choices=["", "paper", "robots", "still", "four"])
    given = parser.parse_args()
    # The first call compiles.
    warm = simulate_paper("paper-p1", 0, {"seconds": 10.0})
    run_bank(warm.measurements, warm.truth, (), 0)
    if given.only in ("", "robots"):
        robots(given.every)
    if given.only in ("", "still"):
        still()
    if given.only in ("", "four"):
        four()
    if given.only in ("", "paper"):
        paper(range(given.first, given.first + given.seeds))


if __name__ == "__main__":
    main()
