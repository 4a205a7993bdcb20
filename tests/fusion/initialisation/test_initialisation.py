"""Unknown initial poses: found when the data allow it, with honest uncertainty until then."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

import relpos
from reference import initialisation as reference
from relpos import fusion, tracks
from relpos.evaluation import metrics
from relpos.evaluation.regions import Region
from relpos.fusion.estimator import Estimate, NodeStatus, Shape
from relpos.fusion.initialisation.hypotheses import fitted
from relpos.fusion.initialisation.kernels import (
    Priors,
    Problem,
    Ranges,
    System,
    Tracks,
    normal_equations,
)
from relpos.fusion.initialisation.search import HypothesisSearch
from relpos.fusion.timeline import Advance
from relpos.measurements import Measurement, Motion, Prior, Range
from relpos.runs import NodeInfo, load_run
from relpos.simulation.paper import simulate_paper
from shared_data import DATA

Floats = npt.NDArray[np.float64]


class Walk:
    """People on given courses: truth (T, N) as complex places and headings, and measurements."""

    def __init__(
        self, starts: Sequence[complex], headings: Sequence[float], speeds: Floats, turns: Floats,
        seed: int = 0, sigma_m: float = 0.1,
    ) -> None:  # fmt: skip
        """``speeds`` and ``turns`` (T, N) in m/s and rad/s; a person turns, then goes."""
        rng = np.random.default_rng(seed)
        count, people = speeds.shape
        self.heading = np.array(headings) + np.vstack((np.zeros(people), turns)).cumsum(axis=0)
        steps = speeds * np.exp(1j * self.heading[1:])
        self.place = np.array(starts) + np.vstack((np.zeros(people), steps)).cumsum(axis=0)
        rows: list[Measurement] = []
        for t in range(count):
            for n in range(people):
                body = speeds[t, n] * np.exp(1j * turns[t, n])
                body *= 1.0 + 0.03 * rng.standard_normal()
                rows.append(Motion(t + 1.0, n + 1, body.real, body.imag, float(turns[t, n])))
            for a in range(people):
                for b in range(a + 1, people):
                    distance = abs(self.place[t + 1, a] - self.place[t + 1, b])
                    measured = abs(distance + sigma_m * rng.standard_normal())
                    rows.append(Range(t + 1.0, a + 1, b + 1, float(measured)))
        self.measurements = rows

    def seen(self, time: int, node: int, peer: int) -> complex:
        """Where ``peer`` really is in the body frame of ``node``."""
        off = self.place[time, peer - 1] - self.place[time, node - 1]
        return complex(off * np.exp(-1j * self.heading[time, node - 1]))

    def in_frame(self, time: int, node: int, frame: int = 1) -> complex:
        """Where ``node`` really is in the frame of ``frame``'s start."""
        off = self.place[time, node - 1] - self.place[0, frame - 1]
        return complex(off * np.exp(-1j * self.heading[0, frame - 1]))


def play(
    measurements: Sequence[Measurement], priors: Sequence[Prior] = (), seed: int = 0
) -> list[Estimate]:
    estimator = fusion.make("bank", priors, {}, seed)
    estimates = [e for m in measurements for e in estimator.process(m)]
    return estimates + estimator.finish()


def wander(seconds: int, people: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Half a metre a second, each on bending courses that stay within some ten metres."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(0.0, 0.2, (seconds, people))
    turns += 0.13 * np.where(np.arange(people) % 2, -1.0, 1.0) * (1.0 + 0.3 * np.arange(people))
    return np.full((seconds, people), 0.5), turns


def status(estimate: Estimate, node: int) -> NodeStatus:
    return next(n.status for n in estimate.nodes if n.node == node)


def seen(estimate: Estimate, node: int, peer: int) -> complex:
    a, b = (next(n for n in estimate.nodes if n.node == k) for k in (node, peer))
    return complex(b.x_m - a.x_m, b.y_m - a.y_m) * complex(np.exp(-1j * a.heading_rad))


def off_m(estimate: Estimate, walk: Walk, time: int, node: int, peer: int) -> float:
    """Error of ``peer`` seen from ``node``, less the tenth of the distance that headings cost."""
    really = walk.seen(time, node, peer)
    return abs(seen(estimate, node, peer) - really) - 0.1 * abs(really)


# -- the kernel ------------------------------------------------------------------------------------


def random_problem(seed: int) -> tuple[Problem, Floats]:
    """Three nodes, two knots, some ranges to fixed places; and a hypothesis (19,)."""
    rng = np.random.default_rng(seed)
    nodes, knots, times, count = 3, 2, 9, 20
    tracks = Tracks(
        rng.normal(0.0, 3.0, (times, nodes, 3)),
        rng.integers(0, knots + 1, (times, nodes)).astype(np.intp),
        rng.normal(0.0, 2.0, (knots + 1, nodes, 2)),
        rng.uniform(0.01, 0.1, (knots, nodes)),
    )
    tracks.knots[0] = 0.0
    priors = Priors(
        rng.integers(0, times, nodes).astype(np.intp), rng.normal(size=(nodes, 3)),
        rng.uniform(0.1, 4.0, (nodes, 3)),
    )  # fmt: skip
    priors.precision[1] = 0.0
    ends = np.array([(0, 1), (0, 2), (1, 2), (1, -1), (-1, 2)], dtype=np.intp)
    ranges = Ranges(
        ends[rng.integers(0, 5, count)], rng.integers(0, times, count).astype(np.intp),
        rng.uniform(0.5, 8.0, count), rng.uniform(0.02, 0.3, count),
        rng.uniform(0.0, 1.0, count), rng.random(count) < 0.2,
        rng.normal(0.0, 4.0, (count, 2, 2)),
    )  # fmt: skip
    parameters = rng.normal(0.0, 1.0, nodes * 6 + 1)
    parameters[3::6] *= 0.1
    return Problem(tracks, priors, ranges, np.full(3 * nodes, 2.0)), parameters


def system_of(problem: Problem, parameters: Floats) -> System:
    size = parameters.size
    system = System(np.zeros(1), np.zeros((size, size)), np.zeros(size))
    normal_equations(parameters, problem, system)
    return system


@pytest.mark.parametrize("seed", range(4))
def test_the_kernel_s_cost_is_that_of_the_reference(seed: int) -> None:
    problem, parameters = random_problem(seed)
    assert system_of(problem, parameters).cost[0] == pytest.approx(
        reference.cost(parameters, problem), rel=1e-9
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_kernel_s_gradient_is_half_the_slope_of_the_reference_downwards(seed: int) -> None:
    problem, parameters = random_problem(seed)
    gradient = system_of(problem, parameters).gradient
    slope = np.empty_like(gradient)
    for k in range(gradient.size):
        ends = []
        for sign in (1.0, -1.0):
            moved = parameters.copy()
            moved[k] += sign * 1e-5
            ends.append(reference.cost(moved, problem))
        slope[k] = (ends[0] - ends[1]) / 2e-5
    assert gradient == pytest.approx(-0.5 * slope, rel=1e-4, abs=1e-4)


def test_a_fit_returns_to_what_made_the_ranges() -> None:
    problem, parameters = random_problem(7)
    tracks, priors, ranges, _ = problem
    true = 0.3 * parameters
    true[3::6], true[4::6], true[5::6], true[-1] = 0.0, 0.0, 0.0, 0.0
    blocks = true[:-1].reshape(3, 6)

    def pose(node: int, time: int) -> tuple[complex, float]:
        place, heading = reference.pose_at(
            blocks[node], tracks.poses[time, node], int(tracks.segments[time, node]),
            tracks.knots[:, node],
        )  # fmt: skip
        x, y = tracks.place(blocks[node], node, time)
        assert complex(x, y) == pytest.approx(complex(place))
        return complex(place), heading

    for e, (a, b) in enumerate(ranges.ends):
        first, second = (
            pose(n, ranges.at[e])[0] if n >= 0 else complex(*ranges.places[e, k])
            for k, n in enumerate((a, b))
        )
        ranges.range_m[e], ranges.variance_m2[e] = abs(second - first), 0.01
    ranges.height2_m2[:], ranges.is_disc[:] = 0.0, False
    for i in range(3):
        place, heading = pose(i, int(priors.at[i]))
        priors.mean[i] = place.real, place.imag, heading
    begin = true + 0.05 * np.random.default_rng(1).standard_normal((5, true.size))
    fits = fitted(begin, 100, problem)
    poses = fits.parameters[:, :-1].reshape(5, 3, 6)[:, :, :3]
    assert poses == pytest.approx(np.broadcast_to(blocks[:, :3], poses.shape), abs=0.02)
    assert (np.linalg.eigvalsh(fits.covariances) > 0.0).all()


# -- what is not observable ------------------------------------------------------------------------


def test_before_any_node_moves_all_others_are_on_rings_about_the_first() -> None:
    still = np.zeros((6, 3))
    walk = Walk((0, 4 + 1j, -2 + 3j), (0.0, 1.0, 2.0), still, still)
    last = play(walk.measurements)[-1]
    assert status(last, 1) is NodeStatus.OK
    assert {status(last, n) for n in (2, 3)} == {NodeStatus.AMBIGUOUS}
    rings = {a.node: a for a in last.alternatives if a.shape is Shape.RING}
    assert set(rings) == {2, 3}
    for node, ring in rings.items():
        assert math.hypot(ring.x_m, ring.y_m) < 0.5
        assert ring.sigma_major_m == pytest.approx(abs(walk.place[0, node - 1]), abs=0.6)
    assert sum({a.alternative: a.probability for a in last.alternatives}.values()) == (
        pytest.approx(1.0)
    )


def test_on_a_straight_course_the_mirror_image_is_listed_and_a_turn_removes_it() -> None:
    speeds = np.tile((0.5, 0.0), (60, 1))
    turns = np.zeros((60, 2))
    turns[30, 0] = math.pi / 2
    walk = Walk((0, 5 + 4j), (0.0, 0.0), speeds, turns)
    estimates = play(walk.measurements)
    before = next(e for e in estimates if e.time_s >= 25.0)
    assert status(before, 2) is NodeStatus.AMBIGUOUS
    assert next(n.heading_rad for n in before.nodes if n.node == 1) == pytest.approx(0.0, abs=0.2)
    sides = {1: 0.0, -1: 0.0}
    for row in before.alternatives:
        if row.node == 2:
            assert abs(row.y_m) == pytest.approx(4.0, abs=1.2)
            sides[1 if row.y_m > 0 else -1] += row.probability
    assert min(sides.values()) > 0.2
    last = estimates[-1]
    assert status(last, 2) is NodeStatus.OK
    assert off_m(last, walk, 60, 1, 2) < 0.3


@pytest.mark.parametrize(
    ("seed", "settings"),
    [
        (5, {"pause_s": 30, "way_noise_m": 0.03, "turn_noise": 0.15, "step_scale": 1.15,
             "max_range_m": 15, "clock_off_s": -0.5, "lost_s": 15}),
        (12, {"area_m": 60, "way_noise_m": 0.15, "max_range_m": 60, "range_late_s": 0.2,
              "floors": 2, "start_m": 0.5, "compass_deg": 20}),
    ],
)  # fmt: skip
def test_noise_that_prefers_the_mirror_image_resolves_nobody(
    seed: int, settings: dict[str, float]
) -> None:
    noise = {"heading_noise_deg": 4, "range_rate_hz": 0.3, "sigma_range_m": 0.3}
    run = relpos.simulate("mission-base", seed, seconds=40, nodes=4, **noise, **settings)
    truth = tracks.true_tracks(run.truth)

    for e in relpos.fuse(run, initial="unknown").estimates:
        if len(e.nodes) == 4 and all(n.status is NodeStatus.OK for n in e.nodes):
            told = np.array([(n.x_m, n.y_m) for n in e.nodes])
            walked = [truth[n.node] for n in e.nodes]
            true = np.array([
                [np.interp(e.time_s, t.time_s, axis) for axis in (t.x_m, t.y_m)] for t in walked
            ])  # fmt: skip
            off_m2, image_off_m2 = (
                metrics.aligned_squared_distances(places, true).mean()
                for places in (told, told * (1.0, -1.0))
            )
            assert off_m2 < 4.0 * image_off_m2


def test_while_the_first_stands_alone_the_other_walks_on_a_ring() -> None:
    speeds, turns = wander(40, 2, seed=4)
    speeds[:, 0] = turns[:, 0] = 0.0
    walk = Walk((0, 4 + 0j), (0.0, 1.0), speeds, turns)
    # Both report before any motion, so the frame is the first node's.
    walk.measurements[:0] = [Motion(0.1, 1, 0, 0, 0), Motion(0.1, 2, 0, 0, 0)]
    walk.measurements.insert(2, Range(0.1, 1, 2, 4.0))
    inside = 0
    estimates = play(walk.measurements)
    for e in estimates:
        assert status(e, 2) in (NodeStatus.AMBIGUOUS, NodeStatus.UNLOCATED)
        if e.alternatives and e.time_s == int(e.time_s):
            place = walk.in_frame(int(e.time_s), 2)
            region = Region.of([a for a in e.alternatives if a.node == 2], draws=800)
            inside += region.contains(place.real, place.imag)
    assert inside >= 36


# -- what is observable ------------------------------------------------------------------------


@pytest.mark.parametrize("people", [2, 4])
def test_walking_nodes_are_located_relative_to_each_other(people: int) -> None:
    places = (0, 5 + 2j, -3 + 4j, 1 - 6j)[:people]
    walk = Walk(places, (0.4, 2.0, -1.0, 3.0)[:people], *wander(80, people, seed=2))
    estimates = play(walk.measurements)
    last = estimates[-1]
    for node in range(1, people + 1):
        assert status(last, node) is NodeStatus.OK
    for node, peer in ((1, 2), (2, 1)):
        assert off_m(last, walk, 80, node, peer) < 0.3
    # Never sure of what is wrong by more than a metre.
    for e in estimates:
        if status(e, 2) is NodeStatus.OK and e.time_s == int(e.time_s):
            assert off_m(e, walk, int(e.time_s), 1, 2) < 1.0


def test_a_node_that_joins_later_is_found_among_located_ones() -> None:
    walk = Walk((0, 5 + 2j, -3 + 4j), (0.0, 0.5, 2.0), *wander(70, 3, seed=5))
    late = [
        m
        for m in walk.measurements
        if m.time_s > 20.0 or (m.node != 3 and not (isinstance(m, Range) and m.peer == 3))
    ]
    priors = [Prior(1, 0.0, 0.0, 0.0, 0.05, 0.02), Prior(2, 5.0, 2.0, 0.5, 0.05, 0.02)]
    estimates = play(late, priors)
    joined = next(e for e in estimates if e.time_s >= 22.0)
    assert status(joined, 3) is NodeStatus.AMBIGUOUS
    assert {status(joined, n) for n in (1, 2)} == {NodeStatus.OK}
    assert status(estimates[-1], 3) is NodeStatus.OK
    assert off_m(estimates[-1], walk, 70, 1, 3) < 0.3


def test_known_headings_leave_only_places_to_be_found() -> None:
    walk = Walk((0, 5 + 2j, -3 + 4j), (0.3, 0.5, 2.0), *wander(40, 3, seed=6))
    priors = [Prior(n + 1, 0, 0, h, math.inf, 0.02) for n, h in enumerate((0.3, 0.5, 2.0))]
    last = play(walk.measurements, priors)[-1]
    assert {n.status for n in last.nodes} == {NodeStatus.OK}
    for node in last.nodes:
        off = node.heading_rad - walk.heading[40, node.node - 1]
        assert abs(math.remainder(off, 2.0 * math.pi)) < 0.3
    assert off_m(last, walk, 40, 1, 3) < 0.3


def test_the_paper_s_team_without_priors_is_found_within_two_minutes() -> None:
    run = simulate_paper("paper-p1", 11, {"seconds": 125.0})
    estimates = play(run.measurements)
    scored = metrics.evaluate(tracks.estimated_tracks(estimates), tracks.true_tracks(run.truth))
    at = scored.time_s >= 110.0
    assert float(np.mean(scored.position_rmse_over_time_m[at])) < 0.5
    assert {n.status for n in estimates[-1].nodes} == {NodeStatus.OK}


def test_the_same_seed_finds_the_same_initial_poses() -> None:
    walk = Walk((0, 5 + 2j), (0.4, 2.0), *wander(25, 2, seed=2))
    assert play(walk.measurements, seed=4) == play(walk.measurements, seed=4)


def test_a_copy_of_a_search_goes_on_as_the_search_does() -> None:
    walk = Walk((0, 5 + 2j), (0.4, 2.0), *wander(30, 2, seed=3))
    search = HypothesisSearch(seed=1)
    search.add(1, 0.0, np.zeros(3), np.zeros(3))
    search.add(2, 0.0, np.zeros(3), np.full(3, np.inf))
    copies = [search]

    def feed(measurement: Measurement) -> None:
        for one in copies:
            match measurement:
                case Motion(time_s, node, dx, dy, turn):
                    one.advance(Advance(time_s, node, 1.0, dx, dy, turn))
                case Range():
                    one.log.update(measurement.time_s, [measurement], {}, {})
                    one.solve()

    for m in walk.measurements:
        if m.time_s == 15.0 and len(copies) == 1:
            copies.append(deepcopy(search))
        feed(m)
    first, second = (one.mixture for one in copies)
    assert first.weights.tolist() == second.weights.tolist()
    assert first.poses.tolist() == second.poses.tolist()


def test_ranges_of_nodes_that_were_found_are_between_their_antennas() -> None:
    places, offset_m = (0, 5 + 2j, -3 + 4j), (0.5, 0.0)
    walk = Walk(places, (0.3, 0.5, 2.0), *wander(120, 3, seed=6))
    antenna = walk.place + complex(*offset_m) * np.exp(1j * walk.heading)
    measurements = [
        replace(m, range_m=float(abs(antenna[int(m.time_s), m.node - 1]
                                     - antenna[int(m.time_s), m.peer - 1])))
        if isinstance(m, Range) else m
        for m in walk.measurements
    ]  # fmt: skip
    worn = {n: NodeInfo(antenna_offset_m=offset_m) for n in (1, 2, 3)}
    estimator = fusion.make("bank", (), {}, 0, worn)
    last = [e for m in measurements for e in estimator.process(m)] + estimator.finish()
    off = [abs(walk.seen(120, p.node, p.peer)) - p.distance_m for p in last[-1].pairs]
    assert max(map(abs, off)) < 0.15


# -- real recordings -------------------------------------------------------------------------------


def test_two_robots_of_which_one_stands_are_never_reported_as_located() -> None:
    folder = DATA / "two_robots_vio" / "exp1_unobservable"
    if not folder.exists():
        pytest.skip(f"needs the recording {folder}")
    run = load_run(folder)
    truth = tracks.true_tracks(run.truth)
    start = (truth[1].x_m[0], truth[1].y_m[0], truth[1].heading_rad[0])
    inside, rings = [], 0
    for e in play(run.measurements):
        assert status(e, 2) is not NodeStatus.OK
        if not e.alternatives:
            continue
        x, y = (
            float(np.interp(e.time_s, truth[2].time_s, v)) for v in (truth[2].x_m, truth[2].y_m)
        )
        place = complex(x - start[0], y - start[1]) * complex(np.exp(-1j * start[2]))
        rows = [a for a in e.alternatives if a.node == 2]
        rings += rows[0].shape is Shape.RING
        inside.append(Region.of(rows, draws=600).contains(place.real, place.imag))
    assert len(inside) > 80
    assert np.mean(inside) > 0.97
    assert rings > 0.9 * len(inside)


def test_nodes_on_one_spot_are_not_reported_closer_than_their_ranges_resolve() -> None:
    rng = np.random.default_rng(4)
    nodes = (1, 2, 3, 4)
    measurements: list[Measurement] = []
    for second in range(1, 7):
        measurements += [
            Range(second - 0.5, a, b, max(abs(rng.normal(0.0, 0.1)), 0.01))
            for a in nodes
            for b in nodes
            if a < b
        ]
        measurements += [Motion(float(second), n, 0.0, 0.0, 0.0) for n in nodes]
    estimator = fusion.make("bank", (), {}, 0)
    estimates = [e for m in measurements for e in estimator.process(m)]
    sigmas = [p.sigma_distance_m for e in estimates for p in e.pairs]
    assert sigmas
    assert min(sigmas) > 0.02
