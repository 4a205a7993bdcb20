"""relpos beside its peers on the same measurements in the same run: time per UWB epoch and error.

    python bench/peers/compare.py [--quick | --full] [--out out/bench]

filterpy, Stone Soup, particles, pfilter and GTSAM get the same motions, ranges, starts and noise
levels as relpos' filters, as arrays, and are used as their documentation says: models as
functions or subclasses, exact Jacobians, all ranges of an instant as one measurement. Writes
peers.md, peers.csv, peers.png (error over time per epoch), scaling.csv and scaling.png (over the
number of particles and over the size of the team). Times are processor time on one thread, of the
median epoch in the fastest run; failures to run are listed. Default: some four minutes.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import one_thread  # noqa: F401  # isort: skip - before any library starts threads of its own
import matplotlib.pyplot as plt
import numpy as np

import gtsam_peers
import kalman_peers
import ours
import particle_peers
from case import Case, Score, crowd_case, paper_case, run_filter

Run = Callable[[Case, int], Score]


@dataclass(frozen=True)
class Contender:
    """One way of estimating; ``group`` are those that are alike, ``states`` what they estimate."""

    group: str
    name: str
    states: str
    run: Run
    own: bool = False


def _filter(make: Callable[..., object], **more: object) -> Run:
    return lambda case, seed: run_filter(case, partial(make, **more), seed)  # type: ignore[arg-type]


def _begun(run: Callable[[Case, np.ndarray], Score]) -> Run:
    return lambda case, seed: run(case, ours.begin_of(case))


def _interface(name: str, **settings: object) -> Run:
    return lambda case, seed: ours.through_interface(case, name, settings, seed)


JOINT, CLOUD = "joint filter", "particle filter, M 500, no dual step"
SMOOTHER, WHOLE = "smoother", "relpos through its interface, noise unknown"

CONTENDERS = (
    Contender(JOINT, "relpos joint (one hypothesis)", "5 N + 1, of which 3 N live",
              _filter(ours.JointAlone), True),
    Contender(JOINT, "relpos joint, watching and learning", "5 N + 1, of which 3 N live",
              _filter(ours.Joint), True),
    Contender(JOINT, "relpos large teams", "5 N: with heading drift, step scale",
              _filter(ours.Strips), True),
    Contender(JOINT, "filterpy EKF", "3 N", _filter(kalman_peers.FilterpyEKF)),
    Contender(JOINT, "filterpy UKF", "3 N", _filter(kalman_peers.FilterpyUKF)),
    Contender(JOINT, "Stone Soup EKF", "3 N", _filter(kalman_peers.StoneSoupEKF)),
    Contender(JOINT, "GTSAM iSAM2, lag 20 s", "3 N, 21 times",
              _filter(gtsam_peers.FixedLag, lag_s=20.0, incremental=True)),
    Contender(CLOUD, "relpos particle", "N x 500 x 3: x, y, heading",
              _filter(ours.Particles, size=500, alpha=0.0), True),
    Contender(CLOUD, "particles", "N x 500 x 3",
              _filter(particle_peers.ParticlesLibrary, size=500)),
    Contender(CLOUD, "pfilter", "N x 500 x 3", _filter(particle_peers.PfilterLibrary, size=500)),
    Contender(SMOOTHER, "relpos smoother", "3 N at every second", _begun(ours.smoother), True),
    Contender(SMOOTHER, "GTSAM Levenberg-Marquardt", "3 N at every second",
              _begun(gtsam_peers.batch)),
    Contender(WHOLE, "relpos bank", "up to 200 x (5 N and biases)", _interface("bank"), True),
    Contender(WHOLE, "relpos particle, dual step", "N x 500 x 3", _interface("particle"), True),
)  # fmt: skip


@dataclass
class Row:
    """A contender's mean errors over the seeds and its fastest time, on one scenario."""

    scenario: str
    contender: Contender
    scores: list[Score]
    failure: str = ""

    def mean(self, what: str) -> float:
        """Mean over the seeds."""
        return float(np.mean([getattr(s, what) for s in self.scores])) if self.scores else np.nan

    @property
    def epoch_us(self) -> float:
        """Fastest run's median epoch."""
        return min((s.epoch_us for s in self.scores), default=np.nan)


def attempt(run: Run, case: Case, seed: int) -> tuple[Score | None, str]:
    """Run one; return a missing package or failure as text, so that the others go on."""
    try:
        return run(case, seed), ""
    except Exception as failure:
        # Whatever a library or a changed kernel raises.
        return None, f"{type(failure).__name__}: {failure}".splitlines()[0]


def peers_table(seeds: int, seconds: int) -> list[Row]:
    """Everybody on the paper's scenario and on the same with good ranges."""
    rows = []
    for scenario in ("paper", "paper-p1"):
        short = paper_case(scenario, 0, 10)
        for contender in CONTENDERS:
            attempt(contender.run, short, 0)  # compiles, and loads the library
            row = Row(scenario, contender, [])
            for seed in range(seeds):
                got, row.failure = attempt(contender.run, paper_case(scenario, seed, seconds), seed)
                if got is None:
                    break
                row.scores.append(got)
            rows.append(row)
            summary = row.failure or f"{row.epoch_us:10.0f} us  {row.mean('distance_m'):.3f} m"
            print(f"  {scenario:9} {contender.name:38} {summary}", flush=True)
    return rows


def write_table(rows: Sequence[Row], out: Path) -> None:
    """peers.md and peers.csv."""
    lines = []
    with (out / "peers.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["scenario", "group", "name", "states", "distance_rmse_m",
                        "aligned_rmse_m", "epoch_us", "seeds", "failure"])  # fmt: skip
        for row in rows:
            c = row.contender
            table.writerow([row.scenario, c.group, c.name, c.states, row.mean("distance_m"),
                            row.mean("aligned_m"), row.epoch_us, len(row.scores),
                            row.failure])  # fmt: skip
    for group in dict.fromkeys(row.contender.group for row in rows):
        lines += [
            f"**{group}**",
            "",
            "| | states | P: us an epoch | distance / aligned m "
            "| P1: us an epoch | distance / aligned m |",
            "|---|---|---|---|---|---|",
        ]
        of = [row for row in rows if row.contender.group == group]
        for name in dict.fromkeys(row.contender.name for row in of):
            both = [row for row in of if row.contender.name == name]
            cells = [name, both[0].contender.states]
            for row in both:
                if row.scores:
                    cells += [
                        f"{row.epoch_us:.0f}",
                        f"{row.mean('distance_m'):.3f} / {row.mean('aligned_m'):.3f}",
                    ]
                else:
                    cells += ["not run", row.failure]
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    (out / "peers.md").write_text("\n".join(lines))


MARKS = {JOINT: "o", CLOUD: "s", SMOOTHER: "^", WHOLE: "D"}


def draw_peers(rows: Sequence[Row], out: Path) -> None:
    """Error over time per epoch, both logarithmic: down and left is better."""
    scenarios = list(dict.fromkeys(row.scenario for row in rows))
    names = list(dict.fromkeys(row.contender.name for row in rows))
    figure, axes = plt.subplots(1, len(scenarios), figsize=(15, 6.5), squeeze=False)
    for axis, scenario in zip(axes[0], scenarios, strict=True):
        for row in rows:
            c = row.contender
            if row.scenario != scenario or not row.scores:
                continue
            at = row.epoch_us, row.mean("distance_m")
            axis.plot(
                *at, MARKS[c.group], markersize=15, color="tab:blue" if c.own else "tab:orange",
                markeredgecolor="black", alpha=0.75,
            )  # fmt: skip
            axis.annotate(str(names.index(c.name) + 1), at, ha="center", va="center", fontsize=8)
        axis.set(xscale="log", yscale="log", title=scenario, xlabel="time per UWB epoch, us")
        axis.set_ylabel("distance RMSE, m")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.grid(which="both", alpha=0.25)
    handles = []
    for k, name in enumerate(names):
        c = next(row.contender for row in rows if row.contender.name == name)
        handles.append(
            plt.Line2D(
                [], [], marker=MARKS[c.group], linestyle="", markeredgecolor="black",
                color="tab:blue" if c.own else "tab:orange", label=f"{k + 1}  {name}",
            )
        )  # fmt: skip
    figure.legend(
        handles=handles, loc="outside center right", frameon=False, fontsize=9,
        title="circle: joint filter, square: particles,\ntriangle: smoother, diamond: through\n"
        "the interface, noise unknown;\nblue: relpos, orange: peers",
    )  # fmt: skip
    figure.tight_layout(rect=(0.0, 0.0, 0.79, 1.0))
    figure.savefig(out / "peers.png", dpi=110)
    plt.close(figure)


@dataclass(frozen=True)
class Point:
    """One measurement of the scaling."""

    series: str
    size: int
    score: Score


def over_particles(sizes: Sequence[int], seconds: int, budget_s: float) -> list[Point]:
    """Time and error over M, six users, good ranges."""
    case = paper_case("paper-p1", 0, seconds)
    series: dict[str, Callable[[int], Run]] = {
        "relpos, no dual step": lambda m: _filter(ours.Particles, size=m, alpha=0.0),
        "relpos, dual step .01": lambda m: _filter(ours.Particles, size=m, alpha=0.01),
        "particles": lambda m: _filter(particle_peers.ParticlesLibrary, size=m),
        "pfilter": lambda m: _filter(particle_peers.PfilterLibrary, size=m),
    }
    return _scaled(series, sizes, lambda _: case, budget_s, "M")


def over_nodes(sizes: Sequence[int], seconds: int, budget_s: float) -> list[Point]:
    """Time and error over N, eight neighbours each."""
    cases: dict[int, Case] = {}

    def case(nodes: int) -> Case:
        if nodes not in cases:
            cases[nodes] = crowd_case(nodes, 0, seconds)
        return cases[nodes]

    series: dict[str, Callable[[int], Run]] = {
        "relpos large teams": lambda _: _filter(ours.Strips),
        "relpos joint (one hypothesis)": lambda _: _filter(ours.JointAlone),
        "relpos bank, through its interface": lambda _: _interface("bank"),
        "filterpy EKF": lambda _: _filter(kalman_peers.FilterpyEKF),
        "Stone Soup EKF": lambda _: _filter(kalman_peers.StoneSoupEKF),
        "GTSAM iSAM2, lag 20 s": lambda _: _filter(
            gtsam_peers.FixedLag, lag_s=20.0, incremental=True
        ),
    }
    return _scaled(series, sizes, case, budget_s, "N")


def _scaled(
    series: dict[str, Callable[[int], Run]],
    sizes: Sequence[int],
    case: Callable[[int], Case],
    budget_s: float,
    letter: str,
) -> list[Point]:
    """Run every series up the sizes until one run would take longer than the budget."""
    points = []
    for name, make in series.items():
        last_s, last_size = 0.0, sizes[0]
        for size in sizes:
            if last_s * size / last_size > budget_s:
                print(f"  {name}: stopped before {letter} {size} (it would take too long)")
                break
            this = case(size)
            began = time.perf_counter()
            got, failure = attempt(make(size), this, 0)
            last_s, last_size = time.perf_counter() - began, size
            if got is None:
                print(f"  {name}, {letter} {size}: {failure}")
                break
            points.append(Point(name, size, got))
            print(f"  {name:38} {letter} {size:6}: {got.epoch_us:12.0f} us  "
                  f"{got.distance_m:.3f} m", flush=True)  # fmt: skip
    return points


def draw_scaling(particles: Sequence[Point], nodes: Sequence[Point], out: Path) -> None:
    """scaling.csv and scaling.png."""
    with (out / "scaling.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["over", "series", "size", "epoch_us", "distance_rmse_m", "aligned_rmse_m"])
        for over, points in (("particles", particles), ("nodes", nodes)):
            for p in points:
                table.writerow([over, p.series, p.size, p.score.epoch_us, p.score.distance_m,
                                p.score.aligned_m])  # fmt: skip
    figure, axes = plt.subplots(1, 2, figsize=(13, 5.5))
    for axis, points, label in (
        (axes[0], particles, "particles a user, M (N 6)"),
        (axes[1], nodes, "users, N (8 neighbours each)"),
    ):
        for name in dict.fromkeys(p.series for p in points):
            of = [p for p in points if p.series == name]
            axis.plot(
                [p.size for p in of], [p.score.epoch_us for p in of], marker="o", label=name,
                linestyle="-" if name.startswith("relpos") else "--",
            )  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel="time per UWB epoch, us")
        axis.axhline(2e6, color="grey", linewidth=0.8)
        axis.annotate("real time (2 s)", (0.02, 2e6), xycoords=("axes fraction", "data"),
                      va="bottom", fontsize=8, color="grey")  # fmt: skip
        axis.grid(which="both", alpha=0.25)
        axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(out / "scaling.png", dpi=110)
    plt.close(figure)


def main() -> int:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="one short run each: half a minute")
    size.add_argument("--full", action="store_true", help="twenty whole runs each")
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    given = parser.parse_args()
    seeds, seconds, budget_s = 4, 600, 15.0
    if given.quick:
        seeds, seconds, budget_s = 1, 60, 2.0
    if given.full:
        seeds, budget_s = 20, 120.0
    given.out.mkdir(parents=True, exist_ok=True)
    print(f"{len(CONTENDERS)} contenders, {seeds} runs of {seconds} s each, one thread")
    rows = peers_table(seeds, seconds)
    write_table(rows, given.out)
    draw_peers(rows, given.out)
    print("over the number of particles")
    sizes = (50, 500, 5_000) if given.quick else (50, 100, 200, 500, 1_000, 5_000, 20_000, 50_000)
    particles = over_particles(sizes, 20 if given.quick else 40, budget_s)
    print("over the size of the team")
    team = (6, 20, 60, 200) if given.quick else (6, 10, 20, 30, 60, 100, 200, 500, 1_000)
    nodes = over_nodes(team, 20, budget_s)
    draw_scaling(particles, nodes, given.out)
    print((given.out / "peers.md").read_text())
    print(f"written: {given.out}/peers.md, peers.csv, peers.png, scaling.csv, scaling.png")
    failed = [row for row in rows if row.failure]
    for row in failed:
        print(f"not run: {row.contender.name} on {row.scenario}: {row.failure}", file=sys.stderr)
    return 1 if any(row.contender.own for row in failed) else 0


if __name__ == "__main__":
    sys.exit(main())
