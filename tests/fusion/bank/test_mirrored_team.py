"""A team that is believed to be its own mirror image: distances fit, left and right do not."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable

import numpy as np
import pytest

import relpos
from relpos import fusion
from relpos.fusion.bank.mirrored import mirror_image, open_sides
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.fusion.models.handedness import Handedness
from relpos.fusion.timeline import Advance
from relpos.measurements import Measurement, Motion, Prior, Range

PEOPLE, SECONDS, STRAIGHT_S, SIGMA_M = 4, 60, 20, 0.1


def walks(seed: int) -> tuple[np.ndarray, np.ndarray, list[Measurement]]:
    """All go straight on for ``STRAIGHT_S``, then turn about: places and headings (T, N)."""
    rng = np.random.default_rng(seed)
    turns = 0.4 * rng.normal(size=(SECONDS, PEOPLE))
    turns[:STRAIGHT_S] = 0.0
    headings = rng.uniform(-math.pi, math.pi, PEOPLE) + np.vstack([np.zeros(PEOPLE), turns]).cumsum(
        axis=0
    )
    places = np.empty((SECONDS + 1, PEOPLE), dtype=complex)
    places[0] = rng.uniform(-8.0, 8.0, PEOPLE) + 1j * rng.uniform(-8.0, 8.0, PEOPLE)
    places[1:] = places[0] + (0.7 * np.exp(1j * headings[1:])).cumsum(axis=0)
    rows: list[Measurement] = []
    for t in range(SECONDS):
        for n in range(PEOPLE):
            step = 0.7 * cmath.rect(1.0 + 0.03 * rng.normal(), turns[t, n])
            rows.append(Motion(t + 1.0, n + 1, step.real, step.imag, float(turns[t, n])))
        for a in range(PEOPLE):
            for b in range(a + 1, PEOPLE):
                far_m = abs(places[t + 1, b] - places[t + 1, a]) + SIGMA_M * rng.normal()
                rows.append(Range(t + 1.0, a + 1, b + 1, float(abs(far_m))))
    return places, headings, rows


def seen(places: np.ndarray, headings: np.ndarray) -> np.ndarray:
    """Where everybody sees everybody else (N, N): ahead and left, as complex numbers."""
    return (places[None, :] - places[:, None]) * np.exp(-1j * headings[:, None])


def is_mirrored_and_ok(estimate: Estimate, truth: np.ndarray) -> bool:
    """Whether left and right are exchanged in an estimate that says to be right."""
    nodes = estimate.nodes
    if len(nodes) < PEOPLE or any(n.status is not NodeStatus.OK for n in nodes):
        return False
    return is_mirrored(estimate, truth)


def is_mirrored(estimate: Estimate, truth: np.ndarray) -> bool:
    """Whether left and right are exchanged."""
    nodes = estimate.nodes
    own = seen(
        np.array([complex(n.x_m, n.y_m) for n in nodes]), np.array([n.heading_rad for n in nodes])
    )
    return bool(np.abs(own.conj() - truth).sum() < 0.5 * np.abs(own - truth).sum())


def seconds(
    told: Callable[[Estimate, np.ndarray], bool],
    estimates: list[Estimate],
    places: np.ndarray,
    headings: np.ndarray,
) -> list[int]:
    """Return the whole seconds at which ``told`` holds."""
    whole = [(e, round(e.time_s)) for e in estimates if e.time_s == round(e.time_s)]
    return [t for e, t in whole if told(e, seen(places[t], headings[t]))]


def longest_s(seconds: list[int]) -> int:
    """How many of some rising seconds follow each other at most."""
    longest = run = 0
    for k, second in enumerate(seconds):
        run = run + 1 if k and second == seconds[k - 1] + 1 else 1
        longest = max(longest, run)
    return longest


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 12))]
)
@pytest.mark.parametrize("start", ["unknown", "vague", "mirrored"])
def test_a_mirrored_team_is_never_ok_for_more_than_five_seconds(start: str, seed: int) -> None:
    places, headings, rows = walks(seed)
    told, turned = places[0], headings[0]
    sigma_m, sigma_rad, since_s = 6.0, 1.2, 0
    if start == "mirrored":
        # Told and wrong: nothing can tell before anybody has turned.
        told, turned, sigma_m, sigma_rad, since_s = told.conj(), -turned, 1.0, 0.3, STRAIGHT_S
    else:
        rng = np.random.default_rng(100 + seed)
        told = told + sigma_m * (rng.normal(size=PEOPLE) + 1j * rng.normal(size=PEOPLE))
        turned = turned + sigma_rad * rng.normal(size=PEOPLE)
    priors = [
        Prior(n + 1, told[n].real, told[n].imag, turned[n], sigma_m, sigma_rad)
        for n in range(PEOPLE)
    ]
    bank = fusion.make("bank", () if start == "unknown" else priors, seed=seed)
    estimates = [e for m in rows for e in bank.process(m)] + bank.finish()
    wrong = seconds(is_mirrored_and_ok, estimates, places, headings)
    assert (STRAIGHT_S - 1 in wrong) == (start == "mirrored")
    assert longest_s([second for second in wrong if second > since_s]) <= 5


@pytest.mark.parametrize(
    "seed", [0, 9, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 9))]
)
def test_turns_tell_a_team_that_is_sure_of_its_mirror_image(seed: int) -> None:
    places, headings, rows = walks(seed)
    told = zip(places[0].conj(), -headings[0], strict=True)
    priors = [Prior(n + 1, z.real, z.imag, turned, 0.1, 0.05) for n, (z, turned) in enumerate(told)]
    bank = fusion.make("bank", priors, seed=seed)
    estimates = [e for m in rows for e in bank.process(m)] + bank.finish()
    wrong = seconds(is_mirrored, estimates, places, headings)
    assert STRAIGHT_S - 1 in wrong
    assert max(wrong) < 40
    # Nor is it told to be turned in the world as its image was.
    off_rad = [
        abs(cmath.phase(cmath.rect(1.0, node.heading_rad - turned))) / node.sigma_heading_rad
        for node, turned in zip(estimates[-1].nodes, headings[-1], strict=True)
    ]
    assert max(off_rad) < 3.0


def test_a_mirror_image_has_the_same_distances_and_the_other_sides() -> None:
    rng = np.random.default_rng(5)
    nodes, size = 4, 5 * 4 + 3
    x = rng.normal(size=(6, size)) * 3.0
    root = rng.normal(size=(6, size, size))
    p = root @ root.transpose(0, 2, 1)
    image, spread = mirror_image(x, p, nodes)
    for before, after, p_before, p_after in zip(x, image, p, spread, strict=True):
        own, other = (
            seen(state[0:20:5] + 1j * state[1:20:5], state[2:20:5]) for state in (before, after)
        )
        assert other == pytest.approx(own.conj())
        assert after[[3, 4, 20, 21, 22]] == pytest.approx(before[[3, 4, 20, 21, 22]])
        # How well a distance is known, alone and together with a constant, stays the same.
        for i, k in ((0, 1), (2, 3)):
            known = []
            for state, covariance in ((before, p_before), (after, p_after)):
                off = state[[5 * k, 5 * k + 1]] - state[[5 * i, 5 * i + 1]]
                slope = np.zeros(size)
                slope[[5 * k, 5 * k + 1]] = off / np.hypot(*off)
                slope[[5 * i, 5 * i + 1]] = -slope[[5 * k, 5 * k + 1]]
                known.append((slope @ covariance @ slope, slope @ covariance[:, 21]))
            assert known[1] == pytest.approx(known[0])
    again, back = mirror_image(image, spread, nodes)
    assert np.exp(1j * (again - x)[:, 2:20:5]) == pytest.approx(np.ones((6, 4)))
    assert again[:, 0:20:5] == pytest.approx(x[:, 0:20:5])
    assert back == pytest.approx(p)


def test_noise_alone_does_not_choose_between_a_team_and_its_mirror_image() -> None:
    # From one spot: first turns are made where nobody has gone anywhere, and the ways are straight.
    conditions = {"nodes": 5, "start_m": 0.5, "start_deg": 10, "pause_s": 30, "max_range_m": 60}
    noise = {"heading_noise_deg": 4.0, "turn_noise": 0.15, "range_rate_hz": 3.0}
    run = relpos.simulate("mission-base", 1, seconds=40, sigma_range_m=0.3, **conditions, **noise)
    result = relpos.fuse(run, initial="unknown")
    score = relpos.evaluate(result, run, bound=False).metrics
    known_s = [
        round(e.time_s) for e in result.estimates if all(n.status is NodeStatus.OK for n in e.nodes)
    ]
    assert known_s
    at = np.isin(score.time_s.round(), known_s)
    assert score.position_rmse_over_time_m[at].max() < 1.5


def crosses_a_line(seed: int) -> tuple[np.ndarray, np.ndarray, list[Measurement]]:
    """Three walk straight on, the third through the line of the others: places, headings, rows."""
    rng = np.random.default_rng(seed)
    headings = np.array([0.0, 0.0, -0.06])
    places = np.array([0.0, 12.0, 24.0 + 2.5j]) + 0.8 * np.arange(161)[:, None] * np.exp(
        1j * headings
    )
    drifts = np.radians(0.1) * rng.normal(size=3)
    rows: list[Measurement] = []
    for t in range(1, 161):
        for n in range(3):
            turn_rad = drifts[n] + np.radians(2.0) * rng.normal()
            step = 0.8 * (1.0 + 0.05 * rng.normal()) * cmath.rect(1.0, turn_rad)
            rows.append(Motion(float(t), n + 1, step.real, step.imag, float(turn_rad)))
        for a, b in ((0, 1), (0, 2), (1, 2)):
            far_m = abs(places[t, b] - places[t, a]) + SIGMA_M * rng.normal()
            rows.append(Range(float(t), a + 1, b + 1, float(far_m)))
    return places, headings, rows


# Of 24 seeds these were told wrong but for 38 and 47: these are two of 14 out of 80 others that
# were still, when hypotheses alone were asked. In 38 the noise of a heading passed for a bend, in
# 47 hypotheses were never on both sides.
@pytest.mark.parametrize(
    "seed",
    [
        *(2, 3, 38, 47),
        *(pytest.param(seed, marks=pytest.mark.soak) for seed in (1, 5, 8, 9, 15, 17, 20, 23)),
    ],
)
def test_who_leaves_a_line_is_not_told_on_the_wrong_side(seed: int) -> None:
    places, headings, rows = crosses_a_line(seed)
    priors = [Prior(n + 1, z.real, z.imag, headings[n]) for n, z in enumerate(places[0])]
    bank = fusion.make("bank", priors, seed=seed)
    wrong = []
    for e in [e for m in rows for e in bank.process(m)]:
        told = np.array([complex(n.x_m, n.y_m) for n in e.nodes])
        aside_m = [
            ((z[1] - z[0]).conj() * (z[2] - z[0])).imag / abs(z[1] - z[0])
            for z in (told, places[round(e.time_s)])
        ]
        ok = all(n.status is NodeStatus.OK for n in e.nodes)
        if ok and np.prod(aside_m) < 0.0 and np.abs(aside_m).min() > 3.0:
            wrong.append(round(e.time_s))
    assert not wrong or longest_s(wrong) <= 5


def test_three_of_whom_one_may_be_on_either_side_are_open_and_no_others() -> None:
    rng = np.random.default_rng(3)
    line = np.array([0.0, 10.0, 20.0, 200j, 210j, 215j - 8.0])
    places = line + 0.1 * (rng.normal(size=(100, 6)) + 1j * rng.normal(size=(100, 6)))
    places[:, 2] += 2j * np.where(np.arange(100) < 30, -1.0, 1.0)
    near = np.abs(line[:, None] - line) < 50.0
    even = np.full(100, 0.01)
    sides, in_line = open_sides(places, even, near)
    assert sides.tolist() == [True] * 3 + [False] * 3
    assert not in_line[3:].any()
    assert not np.any(open_sides(places, even, np.eye(6, dtype=bool)))
    # Seven in a hundred are left out.
    few = np.where(np.arange(100) < 30, 0.07 / 30, 0.93 / 70)
    assert not np.any(open_sides(places, few, near))
    # A place that is not known at all is on no side.
    places[:, 2] = line[2] + 3j * rng.normal(size=100)
    sides, in_line = open_sides(places, even, near)
    assert not sides.any()
    assert in_line.tolist() == [True] * 3 + [False] * 3


def test_hypotheses_that_agree_on_a_side_of_a_line_are_in_it_all_the_same() -> None:
    near = np.ones((3, 3), dtype=bool)
    for high_m, is_in_line in ((0.5, True), (1.0, False)):
        one = np.array([[0.0, 10.0 + 1j * high_m, 20.0]])
        sides, in_line = open_sides(one, np.ones(1), near)
        assert not sides.any()
        assert in_line.tolist() == [is_in_line] * 3


def go(handedness: Handedness, seconds: int, turn_rad: float = 0.0, node: int = 1) -> None:
    for _ in range(seconds):
        handedness.move(Advance(0.0, node, 1.0, 1.0, 0.0, turn_rad))


def test_a_bent_way_tells_the_side_of_those_alone_whose_distance_to_it_is_known() -> None:
    handedness = Handedness()
    near = {1: {2, 3}, 2: {1, 3}, 3: {1, 2}, 4: {5}, 5: {4}}
    assert handedness.unsure({1, 2, 3, 4}, near, {}) == {1, 2, 3, 4}
    go(handedness, 6, 0.5, node=5)
    assert handedness.unsure(set(), near, {}) == {1, 2, 3}
    assert handedness.unsure(set(), near | {3: {1, 2, 4, 5, 6}, 6: {3}}, {}) == {1, 2}
    go(handedness, 6, 0.5, node=3)
    assert handedness.unsure(set(), near, {}) == set()


@pytest.mark.parametrize(
    ("sigma_rad", "seconds", "turn_rad", "is_open"),
    [(0.2, 9, 0.0, True), (0.1, 9, 0.0, False), (0.2, 3, 0.0, False), (0.2, 9, 0.3, False)],
)
def test_who_leaves_a_line_may_be_on_either_side_if_neither_heading_nor_turns_tell(
    sigma_rad: float, seconds: int, turn_rad: float, is_open: bool
) -> None:
    handedness, near = Handedness(), {1: {2, 3}, 2: {1, 3}, 3: {1, 2}}
    for _ in range(seconds):
        assert handedness.unsure(set(), near, {1: sigma_rad}) == set()
        go(handedness, 1, turn_rad)
    assert handedness.unsure(set(), near, {1: sigma_rad}) == set()
    assert handedness.unsure(set(), near, {}) == ({1} if is_open else set())
    go(handedness, 60)
    assert handedness.unsure(set(), near, {}) == ({1} if is_open else set())
    go(handedness, 6, 0.5)
    assert handedness.unsure(set(), near, {}) == set()


def test_the_noise_of_a_heading_bends_no_way_and_a_corner_does() -> None:
    bent = 0
    for seed in range(200):
        rng, handedness = np.random.default_rng(seed), Handedness()
        handedness.unsure({1}, {1: set()}, {})
        for _ in range(160):
            turn_rad = math.radians(2.0) * rng.normal()
            handedness.move(Advance(0.0, 1, 1.0, 0.8, 0.0, turn_rad))
            bent += 1 not in handedness.unsure(set(), {1: set()}, {})
        go(handedness, 1, 0.5 * math.pi)
        go(handedness, 4)
        assert handedness.unsure(set(), {1: set()}, {}) == set()
    assert bent == 0
