"""How the estimators do on missions that nobody planned, condition by condition.

    python bench/missions.py [--seeds 3] [--first 0] [--only TEXT] [--estimators bank,ekf]
                             [--set KEY=VALUE] [--workers N] [--seconds S] [--nodes N]
                             [--regrouping] [--mixed]

prints, for each condition of ``relpos.simulation.missions`` and each estimator: distance, aligned
and body-frame RMSE (m) and distance NEES, means over the seeds; of the pair-seconds with status
ok the shares whose distance errs by more than three sigmas and by more than 2 m, and of the
triangles of ok pairs the share that is told mirrored (%); the worst
seed's distance RMSE; processor seconds of a run; and the body-frame RMSE over that of ``ekf``,
where that runs, too. ``ekf`` is :class:`PlainEkf`, and ``exact`` :class:`ExactFilter`, for teams of
two: what is possible. ``smoother`` begins from the bank, which is ``large teams`` from 21 nodes on.
``--nodes`` gives every condition a team of that size.

``--mixed`` prints instead a line for each seed, whose team, sensors and conditions are all drawn
(:func:`mixed`): how they do together, where nobody chose what meets what.

``--regrouping`` prints instead, for the splits, how long after all have met again the team is right
(aligned error below 1 m) and said to be (everybody is ok) for ten seconds.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, replace

import numpy as np
import numpy.typing as npt

from relpos import fusion, tracks
from relpos.errors import RelposError
from relpos.evaluation import metrics, study
from relpos.evaluation.executors import executor
from relpos.fusion.estimator import Estimate, NodeEstimate, NodeStatus, PairEstimate
from relpos.fusion.resampling import systematic
from relpos.fusion.rewind import Rewinder
from relpos.fusion.timeline import Advance, Epoch, Ranging, Step, Timeline
from relpos.measurements import Prior
from relpos.simulation import missions

TOLD = {"ekf": f"{__file__}:PlainEkf", "exact": f"{__file__}:ExactFilter"}
"""Estimators that are told the noise of ``base``, which few conditions change."""
PARTICLES = 20_000


class JointEkf:
    """One extended Kalman filter of all poses, told the noise of ``base``; no gate, no constants.

    State (3 N,): x, y (m), heading (rad) of each node.
    """

    def __init__(self, priors: Sequence[Prior]) -> None:
        self.row = {p.node: 3 * k for k, p in enumerate(priors)}
        self.mean = np.array([(p.x_m, p.y_m, p.heading_rad) for p in priors]).ravel()
        sigmas = np.array([(p.sigma_m, p.sigma_m, p.sigma_rad) for p in priors]).ravel()
        self.covariance = np.diag(sigmas**2 + 1e-6)
        self.noise = missions.MissionSettings()

    @property
    def clocks(self) -> None:
        """Nothing is learned of time stamps."""

    @property
    def shared(self) -> tuple[object, ...]:
        """Nothing else refers to what it changes."""
        return (self.row,)

    def update(self, step: Step, timeline: Timeline) -> Estimate | None:
        """Process one step; an estimate at the end of an epoch."""
        if isinstance(step, Advance):
            self._move(step)
        elif isinstance(step, Ranging):
            for measured in step.ranges:
                self._range(self.row[measured.node], self.row[measured.peer], measured.range_m)
        elif isinstance(step, Epoch):
            return self._estimate(step.time_s)
        return None

    def _noise_of(self, step: Advance) -> tuple[float, float, float]:
        """Return the variances of x, y (m^2), and of the heading (rad^2) of a displacement."""
        s = self.noise
        place = s.way_noise_m**2 * math.hypot(step.dx_m, step.dy_m)
        turn = math.radians(s.heading_noise_deg) ** 2 * step.duration_s
        turn += (s.turn_noise * step.dtheta_rad) ** 2 / max(step.fraction, 1e-9)
        return place, place, turn

    def _move(self, step: Advance) -> None:
        at = self.row[step.node]
        c, n = math.cos(self.mean[at + 2]), math.sin(self.mean[at + 2])
        x, y = c * step.dx_m - n * step.dy_m, n * step.dx_m + c * step.dy_m
        jacobian = np.eye(len(self.mean))
        jacobian[at : at + 2, at + 2] = -y, x
        self.mean[at : at + 3] += x, y, step.dtheta_rad
        self.covariance = jacobian @ self.covariance @ jacobian.T
        for entry, variance in enumerate(self._noise_of(step)):
            self.covariance[at + entry, at + entry] += variance

    def _range(self, a: int, b: int, range_m: float) -> None:
        off = self.mean[b : b + 2] - self.mean[a : a + 2]
        distance = max(float(np.hypot(*off)), 1e-3)
        row = np.zeros(len(self.mean))
        row[a : a + 2], row[b : b + 2] = -off / distance, off / distance
        gain = self.covariance @ row
        gain /= row @ gain + self.noise.sigma_range_m**2
        self.mean += gain * (range_m - distance)
        joseph = np.eye(len(row)) - np.outer(gain, row)
        self.covariance = joseph @ self.covariance @ joseph.T
        self.covariance += np.outer(gain, gain) * self.noise.sigma_range_m**2

    def _estimate(self, time_s: float) -> Estimate:
        nodes, pairs, p = [], [], self.covariance
        for node, k in sorted(self.row.items()):
            x, y, heading = self.mean[k : k + 3].tolist()
            sigma_rad = math.sqrt(p[k + 2, k + 2])
            nodes.append(
                NodeEstimate(node, x, y, math.remainder(heading, math.tau), p[k, k],
                             p[k + 1, k + 1], p[k, k + 1], sigma_rad, NodeStatus.OK)
            )  # fmt: skip
            for peer, m in sorted(self.row.items()):
                if peer <= node:
                    continue
                off = self.mean[m : m + 2] - self.mean[k : k + 2]
                distance = float(np.hypot(*off))
                unit = off / max(distance, 1e-9)
                i, j = slice(k, k + 2), slice(m, m + 2)
                along = float(unit @ (p[i, i] + p[j, j] - p[i, j] - p[j, i]) @ unit)
                bearing = math.atan2(off[1], off[0])
                pairs.append(PairEstimate(node, peer, distance, math.sqrt(along), bearing, 0.1))
        return Estimate(time_s, tuple(nodes), tuple(pairs))

    def cost_s(self, step: Step) -> float:
        """Return 0: a bench never waits."""
        return 0.0

    def check_run(self, counters: Mapping[str, int]) -> None:
        """Accept every run."""

    def counters(self) -> Counter[str]:
        """Count nothing."""
        return Counter()


class JointParticles(JointEkf):
    """Two users' poses as particles, told the noise of ``base``: near their exact posterior."""

    def __init__(self, priors: Sequence[Prior]) -> None:
        super().__init__(priors)
        self.rng = np.random.default_rng(0)
        self.poses = np.repeat(self.mean[None], PARTICLES, axis=0)
        self.log_weight = np.zeros(PARTICLES)

    def _move(self, step: Advance) -> None:
        at, noise = self.row[step.node], self._noise_of(step)
        heading = self.poses[:, at + 2].copy()
        c, s = np.cos(heading), np.sin(heading)
        moved = c * step.dx_m - s * step.dy_m, s * step.dx_m + c * step.dy_m, step.dtheta_rad
        for entry, (by, variance) in enumerate(zip(moved, noise, strict=True)):
            drawn = self.rng.standard_normal(PARTICLES)
            self.poses[:, at + entry] += by + math.sqrt(variance) * drawn

    def _range(self, a: int, b: int, range_m: float) -> None:
        distance = np.hypot(*(self.poses[:, b : b + 2] - self.poses[:, a : a + 2]).T)
        self.log_weight -= 0.5 * ((range_m - distance) / self.noise.sigma_range_m) ** 2
        weight = self._weights()
        if 1.0 / (weight**2).sum() < 0.5 * PARTICLES:
            self.poses = self.poses[systematic(weight, PARTICLES, self.rng)]
            self.log_weight[:] = 0.0

    def _weights(self) -> npt.NDArray[np.float64]:
        weight = np.exp(self.log_weight - self.log_weight.max())
        normalised: npt.NDArray[np.float64] = weight / weight.sum()
        return normalised

    def _estimate(self, time_s: float) -> Estimate:
        """Report the mean distance, and the mean poses so far apart: those lie inside of arcs."""
        weight = self._weights()
        self.mean = weight @ self.poses
        each = np.hypot(*(self.poses[:, 3:5] - self.poses[:, :2]).T)
        distance = float(weight @ each)
        off = self.mean[3:5] - self.mean[:2]
        off *= 0.5 * (distance / np.hypot(*off) - 1.0)
        self.mean[:2], self.mean[3:5] = self.mean[:2] - off, self.mean[3:5] + off
        spread = self.poses - self.mean
        self.covariance = (spread.T * weight) @ spread
        whole = super()._estimate(time_s)
        sigma = math.sqrt(weight @ (each - distance) ** 2)
        return replace(whole, pairs=(replace(whole.pairs[0], sigma_distance_m=sigma),))


class ExactFilter(Rewinder):
    """The estimator around :class:`JointParticles`."""

    def __init__(self, priors: Sequence[Prior] = ()) -> None:
        super().__init__(JointParticles(priors), Timeline([p.node for p in priors]))


class PlainEkf(Rewinder):
    """The estimator around :class:`JointEkf`."""

    def __init__(self, priors: Sequence[Prior] = ()) -> None:
        super().__init__(JointEkf(priors), Timeline([p.node for p in priors]))


def case(
    condition: str, estimator: str, settings: dict[str, str], **overrides: float
) -> study.Case:
    """Make one line of the table; ``overrides`` are settings of the mission."""
    name = TOLD.get(estimator, "bank" if estimator == "smoother" else estimator)
    given = {} if estimator in TOLD else settings
    label = f"{condition:18}{estimator:9}"
    scenario = f"{missions.PREFIX}-{condition}"
    return study.Case(label, scenario, overrides, name, given, smooth=estimator == "smoother")


def row_of(made: study.Outcome, plain: study.Outcome | None) -> str:
    """Return a line of the table; ``plain`` is what the plain EKF made of the same runs."""
    ratio = made.body_frame_m.mean / plain.body_frame_m.mean if plain else math.nan
    return (
        f"{made.case.label:27}{made.distance_m.mean:9.2f}{made.aligned_m.mean:9.2f}"
        f"{made.body_frame_m.mean:8.2f}{ratio:7.2f}{made.nees.mean:8.2f}"
        f"{100 * made.ok_over_3_sigma.mean:8.1f}{100 * made.ok_over_2_m.mean:7.1f}"
        f"{100 * made.ok_wrong_side.mean:8.2f}"
        f"{made.distance_m.worst:8.2f}{made.busy_s.mean:7.1f}"
        + "".join(f"  {reason}" for reason in made.failures[:1])
    )


USUAL: Mapping[str, Sequence[float]] = {
    "nodes": (2, 3, 4, 5, 6, 8, 10), "area_m": (15, 30, 60), "speed_m_s": (0.5, 1, 1.5),
    "pause_s": (2, 5, 30), "way_noise_m": (0.03, 0.06, 0.15), "heading_noise_deg": (0.5, 1.5, 4),
    "turn_noise": (0, 0.06, 0.15), "step_scale": (0.85, 1, 1, 1.15),
    "range_rate_hz": (0.1, 0.3, 0.7, 3), "sigma_range_m": (0.05, 0.1, 0.3),
    "max_range_m": (15, 30, 60),
}  # fmt: skip
"""What each mixed mission draws; the one below, with its probability, it may have."""
AMISS: Mapping[str, tuple[float, Sequence[float]]] = {
    "drift_deg_min": (0.3, (2, 6)), "walls": (0.2, (1,)), "nlos_share": (0.25, (0.2, 0.5)),
    "shadow_m": (0.25, (0.3, 0.8)), "range_late_s": (0.2, (0.2, 0.6)),
    "clock_off_s": (0.2, (-0.5, 0.8)), "gap_s": (0.2, (2, 5)), "lost_s": (0.15, (15,)),
    "reboot_s": (0.15, (8,)), "floors": (0.15, (2,)), "heights": (0.5, (1,)),
    "abreast": (0.07, (1,)), "in_line": (0.07, (1,)), "start_m": (0.3, (0.5,)),
    "start_deg": (0.3, (10,)), "compass_deg": (0.2, (20,)),
}  # fmt: skip
BASE = asdict(missions.MissionSettings())


def mixed(seed: int) -> dict[str, float]:
    """Draw the settings of a mission that nobody chose."""
    rng = np.random.default_rng(seed)
    drawn = {name: rng.choice(values).item() for name, values in USUAL.items()}
    for name, (probability, values) in AMISS.items():
        if rng.random() < probability:
            drawn[name] = rng.choice(values).item()
    return drawn


def print_mixed(
    seeds: range, estimator: str, settings: dict[str, str], seconds: float, pool: Executor
) -> None:
    """Print a line for each mixed mission, and how many keep what `ok` promises."""
    kept = 0
    for seed in seeds:
        drawn = mixed(seed)
        one = case("base", estimator, settings, seconds=seconds, **drawn)
        one = replace(one, label=f"{seed:<18}{estimator:9}")
        made = study.run([one], range(seed, seed + 1), pool)[0]
        said = " ".join(f"{k}={v:g}" for k, v in drawn.items() if v != BASE[k])
        print(f"{row_of(made, None)}  {said}", flush=True)
        # NaN where nobody is ever said to be ok: nothing is promised.
        kept += not (made.ok_over_3_sigma.mean > 0.015 or made.ok_over_2_m.mean > 0.002)
    print(f"{kept} of {len(seeds)}: at most 1.5 % over three sigmas and 0.2 % over 2 m")


WAIT_S, HELD_S, RIGHT_M = 120.0, 10, 1.0
"""A run is followed for so long after a regrouping; right is an aligned error below ``RIGHT_M``,
and said so where everybody is ok, both for ``HELD_S``."""


def regrouped_s(truth: Mapping[int, tracks.Track], since_s: float, reach_m: float) -> float:
    """Return when each of one half is in reach of the other half, as it will be from then on."""
    times = np.arange(since_s, max(t.time_s[-1] for t in truth.values()))
    place = np.array([
        [np.interp(times, t.time_s, axis) for axis in (t.x_m, t.y_m)] for t in truth.values()
    ])  # fmt: skip
    half = len(place) // 2
    apart = np.hypot(*np.moveaxis(place[:half, None] - place[None, half:], 2, 0))
    met = (apart.min(axis=1) < reach_m).all(axis=0) & (apart.min(axis=0) < reach_m).all(axis=0)
    return float(times[np.argmax(met)])


def right_after_s(condition: str, settings: dict[str, str], seed: int) -> tuple[float, float]:
    """Return how long after a regrouping a team is right, and right and said to be (s; or nan)."""
    one = case(condition, "bank", settings)
    mission = missions.settings_of(one.scenario)
    run = missions.simulate_mission(one.scenario, seed)
    truth = tracks.true_tracks(run.truth)
    met_s = regrouped_s(truth, 0.25 * mission.seconds + mission.split_s, mission.max_range_m)
    estimator = fusion.make("bank", run.priors, settings, seed + study.ESTIMATOR_SEED)
    some = [m for m in run.measurements if m.time_s < met_s + WAIT_S]
    estimates = [e for m in some for e in estimator.process(m)]
    estimates = [e for e in [*estimates, *estimator.finish()] if e.time_s > met_s]
    made = metrics.evaluate(
        tracks.estimated_tracks(estimates), truth, tracks.estimated_pairs(estimates)
    )
    right = made.position_rmse_over_time_m < RIGHT_M
    ok = np.array([all(n.status is NodeStatus.OK for n in e.nodes) for e in estimates])
    at = np.searchsorted([e.time_s for e in estimates], made.time_s).clip(0, len(ok) - 1)

    def held(good: npt.NDArray[np.bool_]) -> float:
        lasting = np.convolve(good, np.ones(HELD_S), "valid") == HELD_S
        return float(made.time_s[np.argmax(lasting)]) - met_s if lasting.any() else math.nan

    return held(right), held(right & ok[at])


def print_regrouping(seeds: range, settings: dict[str, str], pool: Executor) -> None:
    """Print, for each mission with a split, when the team is right again."""
    for condition in (c for c in missions.CONDITIONS if "split" in c):
        jobs = [pool.submit(right_after_s, condition, settings, seed) for seed in seeds]
        both = np.array([job.result() for job in jobs])
        for label, after_s in zip(("right", "and said to be"), both.T, strict=True):
            told = " ".join(f"{s:.0f}" for s in after_s)
            print(
                f"{condition:18}{label:16}{(after_s <= 60.0).sum()} of {len(seeds)} in 60 s: {told}"
            )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", default="", help="conditions whose name has this text, or a,b")
    parser.add_argument("--estimators", default="bank,ekf")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seconds", type=float, default=None, help="length of each mission")
    parser.add_argument("--nodes", type=int, default=None, help="how many people, in each")
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--regrouping", action="store_true", help="when splits are right again")
    parser.add_argument("--mixed", action="store_true", help="all conditions drawn, seed by seed")
    given = parser.parse_args()
    settings = dict(pair.partition("=")[::2] for pair in given.set)
    if given.nodes is not None and (given.mixed or given.regrouping):
        parser.error("--nodes is for the table of conditions alone")
    in_each = {"seconds": given.seconds, "nodes": given.nodes}
    overrides = {name: value for name, value in in_each.items() if value is not None}
    conditions = [
        c for c in missions.CONDITIONS if any(text in c for text in given.only.split(","))
    ]
    if not conditions:
        raise RelposError(
            f"no condition's name has '{given.only}': {', '.join(missions.CONDITIONS)}"
        )
    seeds = range(given.first, given.first + given.seeds)
    with executor(workers=given.workers) as pool:
        if given.regrouping:
            print_regrouping(seeds, settings, pool)
            return
        print(f"seeds {seeds[0]} to {seeds[-1]}; m, means; shares of the ok pair-seconds in %")
        print(
            f"{'':27}{'distance':>9}{'aligned':>9}{'body':>8}{'/ekf':>7}{'NEES':>8}{'>3 sig':>8}"
            f"{'>2 m':>7}{'mirror':>8}{'worst':>8}{'s/run':>7}"
        )
        if given.mixed:
            for name in given.estimators.split(","):
                print_mixed(seeds, name, settings, given.seconds or 300.0, pool)
            return
        for condition in conditions:
            names = given.estimators.split(",")
            made = {
                n: study.run([case(condition, n, settings, **overrides)], seeds, pool)[0]
                for n in names
            }
            for outcome in made.values():
                print(row_of(outcome, made.get("ekf")), flush=True)


if __name__ == "__main__":
    try:
        main()
    except RelposError as error:
        raise SystemExit(f"missions: {error}") from None
