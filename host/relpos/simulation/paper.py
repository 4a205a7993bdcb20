"""The simulation of the paper's section V, as measurements and truth.

Six people walk round a 20 m x 10 m rectangle, counter-clockwise from one corner, one after the
other. The paper leaves the noise open; what is fixed here is scenario P of the project's fusion
notes (``paper``) and its variants:

===========  ==========================================================================
paper        P: heading noise at the corners only, sigma 1 m, under 15 m, detection 0.5
paper-p1     P with sigma 0.1 m
paper-a      white heading noise every step, sigma 0.1 m, unlimited range, detection 1
paper-h      A with ranges under 10 m only
paper-h2     H with detection 0.5 and sigma 0.3 m
===========  ==========================================================================

What a team does not know of itself is switched on by settings: wrong or unknown starts, ranges
that are too long, a user who is carried off, one whose odometry is worse than the others', step
lengths and headings that are wrong by a constant. What was drawn for them is in
:class:`Hidden`, for evaluation alone.

Everything is a pure function of the settings and the seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.measurements import Event, Measurement, Motion, Prior, Range, Truth
from relpos.settings import parse, setting

Floats = npt.NDArray[np.float64]

DISTANCE_NOISE = (0.05, 0.10, 0.20, 0.10, 0.15, 0.10)
"""s_i: standard deviation of user i's relative error of a step's length."""

HEADING_PATTERN = (1.0, 2.0, 4.0, 2.0, 3.0, 2.0)
"""User i's heading noise relative to user 1's (mean 2.33)."""


class Start(StrEnum):
    """What an estimator knows of the pose each user starts with."""

    KNOWN = "known"
    POSITION = "position"
    """The position alone: any heading."""
    HEADING = "heading"
    """The heading alone: any position."""
    UNKNOWN = "unknown"
    """Nothing: there are no priors."""


@dataclass(frozen=True, slots=True)
class PaperSettings:
    """What ``--set`` may change; the defaults are scenario P."""

    nodes: int = setting(6, "people; more than six repeat the six noise levels", 2, 1000)
    seconds: float = setting(600.0, "length of the run", 1.0, 1e6)
    length_m: float = setting(20.0, "long side of the rectangle", 0.1, 1e4)
    width_m: float = setting(10.0, "short side of the rectangle", 0.1, 1e4)
    speed_m_s: float = setting(0.5, "walking speed", 0.01, 100.0)
    spacing_s: float = setting(16.0, "time between the starts of two", 0.0, 1e5)
    motion_period_s: float = setting(1.0, "time between motions; each has noise", 0.01, 60.0)
    range_period_s: float = setting(2.0, "time between ranges of a pair", 0.01, 60.0)
    distance_noise_scale: float = setting(1.0, "factor on the noise of step lengths", 0.0, 1e6)
    turn_noise: float = setting(0.18, "relative error of a turn, mean of the six", 0.0, 1e6)
    heading_noise_deg: float = setting(0.0, "white error a step of user 1", 0.0, 1e6)
    sigma_range_m: float = setting(1.0, "standard deviation of a range", 0.0, 1e6)
    max_range_m: float = setting(15.0, "reading range; 0: unlimited", 0.0, 1e6)
    detection: float = setting(0.5, "probability that a range is received", 0.0, 1.0)
    start_shift_m: float = setting(0.0, "error of every prior, which does not say so", 0.0, 1e6)
    nlos_probability: float = setting(0.0, "share of ranges that are too long", 0.0, 1.0)
    nlos_min_m: float = setting(2.0, "by so much at least", 0.0, 1e6)
    nlos_max_m: float = setting(6.0, "by so much at most", 0.0, 1e6)
    # The one word among numbers: it is parsed apart, and its bounds are not read.
    start: Start = field(
        default=Start.KNOWN, metadata={"text": "what is known of starts", "low": 0.0, "high": 0.0}
    )
    kidnap_m: float = setting(0.0, "one user (drawn) is carried so far", 0.0, 1e4)
    """Into a random direction, without any odometry of it; there the user walks on round a
    rectangle that is shifted by as much."""
    kidnap_s: float = setting(300.0, "when that happens", 0.0, 1e6)
    noisy_user: int = setting(0, "whose motion noise is larger; 0: one is drawn", 0, 1000)
    noisy_factor: float = setting(1.0, "by this factor, without stating it", 0.0, 100.0)
    scale_error: float = setting(0.0, "spread of the hidden step scale", 0.0, 1.0)
    """The true length of every step is exp(N(0, this)) times the reported one, one draw a user."""
    heading_drift_deg_s: float = setting(0.0, "spread of the hidden heading drift", 0.0, 90.0)
    """One draw a user, who drifts while walking."""
    drift_while_waiting: int = setting(0, "1: and while waiting", 0, 1)


_WHITE_HEADING: Mapping[str, float] = {
    "turn_noise": 0.0,
    "heading_noise_deg": 1.65,
    "sigma_range_m": 0.1,
    "max_range_m": 0.0,
    "detection": 1.0,
}

SCENARIOS: Mapping[str, Mapping[str, float]] = {
    "paper": {},
    "paper-p1": {"sigma_range_m": 0.1},
    "paper-a": _WHITE_HEADING,
    "paper-h": {**_WHITE_HEADING, "max_range_m": 10.0},
    "paper-h2": {**_WHITE_HEADING, "max_range_m": 10.0, "detection": 0.5, "sigma_range_m": 0.3},
}
"""Scenario name -> how it differs from P."""


@dataclass(frozen=True, slots=True)
class Hidden:
    """What is hidden from estimators, for evaluation alone; every mapping has all nodes.

    ``step_scale`` is true over reported length, ``heading_drift_rad_s`` what the reported
    heading gains over the true one (the constants of the same names in ``parameters.csv``).
    ``distance_noise`` and ``turn_noise`` are the relative standard deviations of a step's length
    and of a turn, ``white_heading_rad`` that of a step's heading, as they were drawn from: with
    the noisy user's factor. ``carried_m`` is how far the kidnapped node is carried, along x and
    y, ``late_ranges`` are the (time, node, peer) of ranges that are too long.
    """

    step_scale: Mapping[int, float] = field(default_factory=dict)
    heading_drift_rad_s: Mapping[int, float] = field(default_factory=dict)
    distance_noise: Mapping[int, float] = field(default_factory=dict)
    turn_noise: Mapping[int, float] = field(default_factory=dict)
    white_heading_rad: Mapping[int, float] = field(default_factory=dict)
    noisy_node: int | None = None
    kidnapped_node: int | None = None
    carried_m: tuple[float, float] = (0.0, 0.0)
    late_ranges: frozenset[tuple[float, int, int]] = frozenset()


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """A run without a folder: measurements sorted by time, priors, and the truth apart."""

    name: str
    measurements: tuple[Measurement, ...]
    priors: tuple[Prior, ...]
    truth: tuple[Truth, ...]
    hidden: Hidden = field(default_factory=Hidden)
    events: tuple[Event, ...] = ()
    landmarks: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Surveyed places by their ids, (x, y) in metres."""
    floors_m: tuple[float, ...] = ()
    """Heights of a building's floors over the start's, from the lowest on."""
    posts: tuple[int, ...] = ()
    """Nodes at the command post."""


def settings_of(scenario: str, overrides: Mapping[str, str | float] | None = None) -> PaperSettings:
    """Return a scenario's settings, changed by ``overrides`` (the values of ``--set``).

    Raises RelposError for an unknown scenario or key and for a value out of range.
    """
    if scenario not in SCENARIOS:
        raise RelposError(f"unknown scenario '{scenario}': one of {', '.join(SCENARIOS)}")
    given = {**SCENARIOS[scenario], **(overrides or {})}
    start = given.pop("start", Start.KNOWN)
    if start not in list(Start):
        raise RelposError(f"setting start: '{start}' is not one of {', '.join(Start)}")
    settings = parse(PaperSettings, given, f"scenario {scenario}")
    settings = replace(settings, start=Start(str(start)))
    if settings.nlos_max_m < settings.nlos_min_m:
        raise RelposError("setting nlos_max_m is less than nlos_min_m")
    if settings.noisy_user > settings.nodes:
        raise RelposError(
            f"setting noisy_user: there is no user {settings.noisy_user} of {settings.nodes}"
        )
    if settings.motion_period_s > settings.seconds:
        raise RelposError(f"setting motion_period_s: no motion within {settings.seconds:g} s")
    if settings.kidnap_m > 0.0 and settings.kidnap_s >= settings.seconds:
        raise RelposError(
            f"setting kidnap_s: {settings.kidnap_s:g} is past the end at {settings.seconds:g} s"
        )
    return settings


def _corners(length: float, width: float) -> tuple[Floats, Floats]:
    """Path length at each corner of one lap, (5,), and the corners' positions, (5, 2)."""
    corners = np.array([[0, 0], [length, 0], [length, width], [0, width], [0, 0]], dtype=float)
    return np.cumsum([0.0, length, width, length, width]), corners


def true_poses(settings: PaperSettings) -> tuple[Floats, Floats, Floats]:
    """Give times (T,), positions (N, T, 2) and unwrapped headings (N, T) of all users.

    The heading at a corner is still that of the side behind: people turn, then move.
    """
    count = math.floor(settings.seconds / settings.motion_period_s + 1e-9)
    times = np.arange(count + 1, dtype=np.float64) * settings.motion_period_s
    starts = settings.spacing_s * np.arange(settings.nodes)
    path: Floats = settings.speed_m_s * np.maximum(times[None, :] - starts[:, None], 0.0)
    return times, *round_rectangle(path, settings.length_m, settings.width_m)


def round_rectangle(path_m: Floats, length: float, width: float) -> tuple[Floats, Floats]:
    """Positions (..., 2) and unwrapped headings after path lengths along a rectangle's sides."""
    arcs, corners = _corners(length, width)
    lap, along = np.divmod(path_m, arcs[-1])
    # Rounding must not put a person who has just reached a corner behind or beyond it.
    positions: Floats = np.stack([np.interp(along, arcs, corners[:, k]) for k in (0, 1)], axis=-1)
    side = np.clip(np.searchsorted(arcs, along - 1e-9, side="left") - 1, -1, 3)
    heading: Floats = np.maximum((4.0 * lap + side) * (math.pi / 2.0), 0.0)
    return positions, heading


def by_node(values: Floats) -> dict[int, float]:
    """Values by user (N,) with the nodes' ids, from 1 on."""
    return {k + 1: float(value) for k, value in enumerate(values)}


def by_user(values: Mapping[int, float]) -> Floats:
    """The inverse of :func:`by_node`, as a column (N, 1)."""
    return np.array(list(values.values()))[:, None]


def _draw(settings: PaperSettings, rng: np.random.Generator) -> Hidden:
    # Everything is drawn, used or not: no setting changes the random numbers of another.
    count = settings.nodes
    scale, drift = rng.standard_normal(count), rng.standard_normal(count)
    noisy = int(rng.integers(count))
    kidnapped = int(rng.integers(count))
    direction = rng.uniform(0.0, 2.0 * math.pi)
    if settings.noisy_user > 0:
        noisy = settings.noisy_user - 1
    pattern = np.resize(np.array(HEADING_PATTERN), count)
    factor = np.ones(count)
    factor[noisy] = settings.noisy_factor
    way_m = settings.kidnap_m
    return Hidden(
        by_node(np.exp(settings.scale_error * scale)),
        by_node(math.radians(settings.heading_drift_deg_s) * drift),
        by_node(
            np.resize(np.array(DISTANCE_NOISE), count) * settings.distance_noise_scale * factor
        ),
        by_node(settings.turn_noise * pattern / 2.33 * factor),
        by_node(math.radians(settings.heading_noise_deg) * pattern * factor),
        noisy + 1 if settings.noisy_factor != 1.0 else None,
        kidnapped + 1 if way_m > 0.0 else None,
        (way_m * math.cos(direction), way_m * math.sin(direction)),
    )


def report_motions(
    hidden: Hidden,
    times: Floats,
    positions: Floats,
    heading: Floats,
    rng: np.random.Generator,
    *,
    drift_while_waiting: bool = False,
) -> list[Motion]:
    """Make every user's odometry of true poses (T,), (N, T, 2), (N, T): turn, then move."""
    chord = np.diff(positions, axis=1)
    turn = np.diff(heading, axis=1)
    distance = np.linalg.norm(chord, axis=-1)
    # A chord that cuts a corner is not along the new heading; turn-then-move has it so only
    # where the corner falls between two motions.
    direction = np.where(
        distance > 0.0, np.arctan2(chord[..., 1], chord[..., 0]) - heading[:, 1:], 0.0
    )
    shape = distance.shape
    measured = distance * (1.0 + by_user(hidden.distance_noise) * rng.standard_normal(shape))
    measured /= by_user(hidden.step_scale)
    turned = turn * (1.0 + by_user(hidden.turn_noise) * rng.standard_normal(shape))
    turned += by_user(hidden.white_heading_rad) * rng.standard_normal(shape) * (distance > 0.0)
    drifts = (distance > 0.0) | drift_while_waiting
    turned += by_user(hidden.heading_drift_rad_s) * np.diff(times) * drifts
    dx, dy = measured * np.cos(turned + direction), measured * np.sin(turned + direction)
    return [
        Motion(float(times[k + 1]), i + 1, float(dx[i, k]), float(dy[i, k]), float(turned[i, k]))
        for k in range(shape[1])
        for i in range(shape[0])
    ]


def _ranges(
    settings: PaperSettings,
    hidden: Hidden,
    times: Floats,
    positions: Floats,
    rng: np.random.Generator,
) -> tuple[list[Range], frozenset[tuple[float, int, int]]]:
    """Give the ranges and which of them are too long; ``positions`` are without kidnapping."""
    first, second = np.triu_indices(settings.nodes, 1)
    instants = np.arange(
        settings.range_period_s, times[-1] + 1e-9, settings.range_period_s, dtype=float
    )
    at = np.stack(
        [
            [np.interp(instants, times, positions[i, :, k]) for k in (0, 1)]
            for i in range(settings.nodes)
        ]
    )
    if hidden.kidnapped_node is not None:
        carried_m = np.array(hidden.carried_m)[:, None]
        at[hidden.kidnapped_node - 1] += carried_m * (instants >= settings.kidnap_s)
    distance = np.hypot(*(at[first] - at[second]).transpose(1, 0, 2))
    noise = settings.sigma_range_m * rng.standard_normal(distance.shape)
    heard = rng.random(distance.shape) < settings.detection
    late = rng.random(distance.shape) < settings.nlos_probability
    excess = rng.uniform(settings.nlos_min_m, settings.nlos_max_m, distance.shape)
    if settings.max_range_m > 0.0:
        heard &= distance < settings.max_range_m
    # A ranging chip reports no negative distance; it matters only where two stand together.
    value = np.abs(distance + noise + late * excess)
    made, too_long = [], []
    for k, p in zip(*np.nonzero(heard.T), strict=True):
        key = (float(instants[k]), int(first[p]) + 1, int(second[p]) + 1)
        made.append(Range(*key, float(value[p, k])))
        if late[p, k]:
            too_long.append(key)
    return made, frozenset(too_long)


def _priors(
    settings: PaperSettings, positions: Floats, heading: Floats, rng: np.random.Generator
) -> tuple[Prior, ...]:
    shift = rng.uniform(0.0, 2.0 * math.pi, settings.nodes)
    if settings.start is Start.UNKNOWN:
        return ()
    sigma_m = math.inf if settings.start is Start.HEADING else 0.0
    sigma_rad = math.inf if settings.start is Start.POSITION else 0.0
    return tuple(
        Prior(
            i + 1,
            float(positions[i, 0, 0] + settings.start_shift_m * math.cos(shift[i])),
            float(positions[i, 0, 1] + settings.start_shift_m * math.sin(shift[i])),
            float(heading[i, 0]),
            sigma_m,
            sigma_rad,
        )
        for i in range(settings.nodes)
    )


def simulate_paper(
    scenario: str = "paper", seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> SimulatedRun:
    """Measurements, priors and truth of one run; the same arguments give the same run."""
    settings = settings_of(scenario, overrides)
    # A later stream does not change the ones before it: old seeds keep giving the same runs.
    motion_rng, range_rng, shift_rng, hidden_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)
    )
    hidden = _draw(settings, hidden_rng)
    times, positions, heading = true_poses(settings)
    motions = report_motions(
        hidden, times, positions, heading, motion_rng,
        drift_while_waiting=bool(settings.drift_while_waiting),
    )  # fmt: skip
    ranges, late = _ranges(settings, hidden, times, positions, range_rng)
    priors = _priors(settings, positions, heading, shift_rng)
    if hidden.kidnapped_node is not None:
        carried = (times >= settings.kidnap_s)[:, None]
        positions[hidden.kidnapped_node - 1] += np.array(hidden.carried_m) * carried
    measurements: list[Measurement] = sorted([*motions, *ranges], key=lambda m: m.time_s)
    truth = true_rows(times, positions, heading)
    hidden = replace(hidden, late_ranges=late)
    return SimulatedRun(scenario, tuple(measurements), priors, truth, hidden)


def true_rows(
    times: Floats, positions: Floats, heading: Floats, height: Floats | None = None
) -> tuple[Truth, ...]:
    """Rows of ``truth.csv`` of poses (T,), (N, T, 2), (N, T) at heights (N, T), where given."""
    return tuple(
        Truth(float(t), i + 1, float(positions[i, k, 0]), float(positions[i, k, 1]),
              math.remainder(float(heading[i, k]), 2.0 * math.pi),
              None if height is None else float(height[i, k]))
        for k, t in enumerate(times)
        for i in range(len(positions))
    )  # fmt: skip
