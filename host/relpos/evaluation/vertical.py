"""How far an estimate is from the truth in height: metres, floors, stairs.

Scored at every whole second where the truth has a height. Heights are over the start's floor,
which is 0 in a run with ``[building] floors_m``; of other runs one shift for all is taken out.
ISO/IEC 18305 names floor detection probability (8.2), VE95 (8.10) and SE95 (8.11).

Episodes are those of the run's ``episode`` events. *Off stairs* is who neither climbs, rides nor
falls and is within ``BETWEEN_M`` of a floor. A flight is an episode ``up`` or ``down``; it is found
where the estimate states that direction for ``FOUND_S`` until ``LAG_S`` after its end. What the
estimate states elsewhere is false, stretches with less than ``LAG_S`` between them counted once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from relpos import tracks
from relpos.evaluation.finite import mean, root_mean
from relpos.evaluation.iso18305 import percentile
from relpos.evaluation.metrics import MIN_NODES_FOR_SHAPE, aligned_squared_distances
from relpos.fusion.estimator import Estimate
from relpos.measurements import Event
from relpos.tracks import MAX_GAP_S, Track, Tracks, align, interpolate, whole_seconds

Floats = npt.NDArray[np.float64]
Words = npt.NDArray[np.str_]

BETWEEN_M = 1.25
"""Who lies on a floor has the tag so far below a standing wearer's; a landing is further off."""

LAG_S = 5.0
"""An episode is stated late: steps have to be counted first."""
FOUND_S = 2.0

CLAIMED = 0.9
"""A floor with a higher probability is claimed."""

ON_STAIRS = ("up", "down", "lift", "falling")
FLIGHTS = ("up", "down")


@dataclass(frozen=True, slots=True)
class Vertical:
    """The figures; NaN where one is undefined.

    ``rmse_m`` and ``ve95_m`` are of heights, ``relative_rmse_m`` of the height differences of all
    pairs, ``aligned_3d_rmse_m`` of positions after the best motion of the plane and vertical shift
    at each second, ``se95_m`` after one motion of the plane for the run. ``floor_by_height`` is how
    often the floor nearest to the estimated height is the true one, off stairs; ``floor_right``
    the same of the floor that is stated, none counted as wrong; ``wrong_claimed`` the share of all
    node-seconds in which a floor is claimed that is not there. ``stairs_way`` is the way on
    flights, estimated over true. ``false_flights_h`` are per hour of one wearer with an estimate.
    ``fall_error_m`` is the largest height error three seconds after a fall. ``not_scored`` says
    what the estimate or the run has nothing for.
    """

    seconds: int
    rmse_m: float
    relative_rmse_m: float
    ve95_m: float
    se95_m: float
    aligned_3d_rmse_m: float
    nees: float
    floor_by_height: float = math.nan
    floor_right: float = math.nan
    wrong_claimed: float = math.nan
    stairs_way: float = math.nan
    flights: int = 0
    flights_found: float = math.nan
    false_flights_h: float = math.nan
    rides: int = 0
    rides_found: float = math.nan
    fall_error_m: float = math.nan
    not_scored: tuple[str, ...] = ()

    @property
    def has_floors(self) -> bool:
        """Whether the run has floors."""
        return math.isfinite(self.floor_by_height)

    def lines(self) -> list[tuple[str, str]]:
        """Return what tables show: the figures that are defined, and what is not scored."""
        shown = [
            ("height RMSE between two", self.relative_rmse_m, "{:.2f} m"),
            ("height RMSE", self.rmse_m, "{:.2f} m"),
            ("VE95", self.ve95_m, "{:.2f} m"),
            ("SE95", self.se95_m, "{:.2f} m"),
            ("aligned RMSE in 3D", self.aligned_3d_rmse_m, "{:.2f} m"),
            ("NEES of the height", self.nees, "{:.2f}"),
            ("nearest floor right", self.floor_by_height, "{:.1%}"),
            ("stated floor right", self.floor_right, "{:.1%}"),
            ("wrong floor claimed", self.wrong_claimed, "{:.2%}"),
            ("way on flights", self.stairs_way, "{:.2f} of the true one"),
            ("flights found", self.flights_found, f"{{:.1%}} of {self.flights}"),
            ("false flights", self.false_flights_h, "{:.1f} an hour and wearer"),
            ("rides found", self.rides_found, f"{{:.1%}} of {self.rides}"),
            ("height 3 s after a fall", self.fall_error_m, "off by {:.2f} m"),
        ]
        lines = [(name, words.format(v)) for name, v, words in shown if math.isfinite(v)]
        return lines + [("not scored", words) for words in self.not_scored]


@dataclass(frozen=True)
class _Node:
    """One node at whole seconds (n,): estimate, truth, what is stated, what is true."""

    time_s: Floats
    estimate: Track
    truth: Track
    sigma_z_m: Floats
    floor: Floats
    floor_probability: Floats
    episode: Words
    true_episode: Words
    spans: Sequence[tuple[float, float, str]]
    """Begin, end and word of each true episode; the last ends with the run, at infinity."""

    @property
    def ended(self) -> list[tuple[float, float, str]]:
        """The spans that end before the run does: of the last nobody knows how it goes on."""
        return [span for span in self.spans if math.isfinite(span[1])]

    @property
    def error_m(self) -> Floats:
        """Of the height."""
        return np.asarray(self.estimate.z_m - self.truth.z_m)


def score(
    estimates: Sequence[Estimate],
    truth: Tracks,
    floors_m: Sequence[float] = (),
    events: Sequence[Event] = (),
) -> Vertical | None:
    """Score heights, floors and episodes; None where the truth has no height."""
    known = {node: t for node, t in truth.items() if np.isfinite(t.z_m).any()}
    if not known:
        return None
    nodes = _sampled(estimates, known, events)
    if not floors_m:
        nodes = _shifted(nodes)
    errors = _stacked(n.error_m for n in nodes.values())
    if not np.isfinite(errors).any():
        return None
    sigmas = _stacked(n.sigma_z_m for n in nodes.values())
    told = sigmas > 0.0
    errors_m = np.abs(errors[np.isfinite(errors)])
    relative, aligned = _between(nodes)
    states_floors = any(np.isfinite(n.floor).any() for n in nodes.values())
    states_episodes = any((n.episode != "").any() for n in nodes.values())
    known_episodes = any(e.event == "episode" for e in events)
    found = Vertical(
        int(errors_m.size),
        root_mean(errors**2),
        relative,
        percentile(errors_m, 0.95),
        _se95(nodes),
        aligned,
        mean((errors[told] / sigmas[told]) ** 2),
        not_scored=tuple(
            words
            for words, missing in (
                ("floors: the run has no [building] floors_m", not floors_m),
                ("floors: the estimate states none", bool(floors_m) and not states_floors),
                ("stairs: the run has no episode events", not known_episodes),
                ("flights: the estimate states none", known_episodes and not states_episodes),
            )
            if missing
        ),
    )
    if floors_m:
        found = _with_floors(found, nodes, floors_m, stated=states_floors)
    return _with_flights(found, nodes, stated=states_episodes) if known_episodes else found


def _sampled(
    estimates: Sequence[Estimate], truth: Tracks, events: Sequence[Event]
) -> dict[int, _Node]:
    estimated = tracks.estimated_tracks(estimates)
    stated: dict[int, list[tuple[float, float, float, float, str]]] = {}
    for estimate in estimates:
        for n in estimate.nodes:
            stated.setdefault(n.node, []).append(
                (
                    estimate.time_s,
                    n.sigma_z_m,
                    math.nan if n.floor is None else float(n.floor),
                    math.nan if n.floor_probability is None else n.floor_probability,
                    "" if n.episode is None else str(n.episode),
                )
            )
    nodes = {}
    for node in sorted(set(truth) & set(estimated)):
        at_s = whole_seconds([truth[node]])
        own = [(e.time_s, e.value) for e in events if e.node == node and e.event == "episode"]
        time_s, sigma, floor, chance, words = (np.array(c) for c in zip(*stated[node], strict=True))
        last = np.searchsorted(time_s, at_s, side="right") - 1
        fresh = (last >= 0) & (at_s - time_s[last] <= MAX_GAP_S)
        sigma, floor, chance = (
            np.where(fresh, column[last], math.nan) for column in (sigma, floor, chance)
        )
        nodes[node] = _Node(
            at_s,
            _at(estimated[node], at_s),
            _at(truth[node], at_s),
            sigma,
            floor,
            chance,
            np.where(fresh, words[last], ""),
            _true_episodes(own, at_s),
            _spans(own),
        )
    return nodes


def _at(track: Track, at_s: Floats) -> Track:
    x, y, z = (interpolate(track.time_s, c, at_s) for c in (track.x_m, track.y_m, track.z_m))
    heading = interpolate(track.time_s, track.heading_rad, at_s, circular=True)
    return Track(at_s, x, y, heading, z)


def _true_episodes(own: Sequence[tuple[float, str]], at_s: Floats) -> Words:
    if not own:
        return np.full(at_s.shape, "")
    begins, words = np.array([t for t, _ in own]), np.array([w for _, w in own])
    last = np.searchsorted(begins, at_s, side="right") - 1
    return np.asarray(np.where(last >= 0, words[last], ""))


def _spans(own: Sequence[tuple[float, str]]) -> list[tuple[float, float, str]]:
    return [(begin_s, end_s, w) for (begin_s, w), (end_s, _) in pairwise([*own, (math.inf, "")])]


def _shifted(nodes: Mapping[int, _Node]) -> dict[int, _Node]:
    """Take one shift out of all heights."""
    errors = _stacked(n.error_m for n in nodes.values())
    shift = float(np.nanmedian(errors)) if np.isfinite(errors).any() else 0.0
    return {
        node: replace(n, estimate=replace(n.estimate, z_m=n.estimate.z_m - shift))
        for node, n in nodes.items()
    }


def _between(nodes: Mapping[int, _Node]) -> tuple[float, float]:
    """Return the relative vertical RMSE, over pairs, and the aligned one in three dimensions."""
    seconds = np.unique(_stacked(n.time_s for n in nodes.values()))
    shape = (seconds.size, len(nodes))
    errors = np.full(shape, math.nan)
    flat = np.full((*shape, 4), math.nan)
    for k, n in enumerate(nodes.values()):
        rows = np.searchsorted(seconds, n.time_s)
        errors[rows, k] = n.error_m
        flat[rows, k] = np.column_stack([n.estimate.x_m, n.estimate.y_m, n.truth.x_m, n.truth.y_m])
    pairs = [(errors[:, i] - errors[:, j]) ** 2 for i in range(len(nodes)) for j in range(i)]
    squares = []
    for z, xy in zip(errors, flat, strict=True):
        there = np.isfinite(z) & np.isfinite(xy).all(axis=1)
        if there.sum() >= MIN_NODES_FOR_SHAPE:
            off = z[there] - z[there].mean()
            squares.append(aligned_squared_distances(xy[there, :2], xy[there, 2:]) + off**2)
    return root_mean(_stacked(pairs)), root_mean(_stacked(squares))


def _se95(nodes: Mapping[int, _Node]) -> float:
    points = [
        np.column_stack([n.estimate.x_m, n.estimate.y_m, n.truth.x_m, n.truth.y_m, n.error_m])
        for n in nodes.values()
    ]
    rows = np.concatenate(points)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not rows.size:
        return math.nan
    off = align(rows[:, :2], rows[:, 2:4])(rows[:, :2]) - rows[:, 2:4]
    return percentile(np.sqrt((off**2).sum(axis=1) + rows[:, 4] ** 2), 0.95)


def _with_floors(
    found: Vertical, nodes: Mapping[int, _Node], floors_m: Sequence[float], *, stated: bool
) -> Vertical:
    levels, start = np.array(floors_m), list(floors_m).index(0.0)
    near, right, wrong, scored = [], [], 0, 0
    for n in nodes.values():
        z, there = n.truth.z_m, np.isfinite(n.truth.z_m)
        true = _nearest(levels, z) - start
        off_stairs = there & (np.abs(z - levels[true + start]) <= BETWEEN_M)
        off_stairs &= ~np.isin(n.true_episode, ON_STAIRS)
        seen = off_stairs & np.isfinite(n.estimate.z_m)
        near.append(((_nearest(levels, n.estimate.z_m) - start) == true)[seen])
        right.append((n.floor == true)[off_stairs])
        below = np.clip(np.searchsorted(levels, z, side="right") - 1, 0, None) - start
        fits = np.where(off_stairs, n.floor == true, (n.floor == below) | (n.floor == below + 1))
        claims = np.isfinite(n.floor) & (n.floor_probability > CLAIMED)
        wrong += int((there & claims & ~fits).sum())
        scored += int(there.sum())
    found = replace(found, floor_by_height=mean(_stacked(near)))
    if not stated:
        return found
    return replace(found, floor_right=mean(_stacked(right)), wrong_claimed=wrong / max(scored, 1))


def _nearest(levels: Floats, z_m: Floats) -> npt.NDArray[np.int64]:
    off = np.abs(np.nan_to_num(z_m, nan=1e9)[:, None] - levels)
    return np.asarray(off.argmin(axis=1))


def _with_flights(found: Vertical, nodes: Mapping[int, _Node], *, stated: bool) -> Vertical:
    flights = rides = climbed = rode = false = 0
    surplus_m = way_m = hours = 0.0
    falls = [math.nan]
    for n in nodes.values():
        hours += np.isfinite(n.sigma_z_m).sum() / 3600.0
        for begin_s, end_s, word in n.ended:
            inside = (n.time_s >= begin_s) & (n.time_s <= end_s + LAG_S)
            hit = int(((n.episode == word) & inside).sum()) >= FOUND_S
            if word in FLIGHTS:
                flights, climbed = flights + 1, climbed + hit
            elif word == "lift":
                rides, rode = rides + 1, rode + hit
            elif word == "falling":
                after = n.time_s >= end_s + 3.0
                falls += np.abs(n.error_m[after][:1]).tolist()
        false += _false_flights(n)
        own_surplus_m, own_m = _way_on_flights(n)
        surplus_m, way_m = surplus_m + own_surplus_m, way_m + own_m
    found = replace(
        found,
        flights=flights,
        rides=rides,
        stairs_way=1.0 + surplus_m / way_m if way_m > 0.0 else math.nan,
        fall_error_m=float(np.nanmax(falls)) if np.isfinite(falls).any() else math.nan,
    )
    if not stated:
        return found
    return replace(
        found,
        flights_found=climbed / flights if flights else math.nan,
        rides_found=rode / rides if rides else math.nan,
        false_flights_h=false / hours if hours else math.nan,
    )


def _false_flights(n: _Node) -> int:
    """Count stretches that are stated as a flight where there is none of that direction."""
    false = 0
    for word in FLIGHTS:
        at_s = n.time_s[n.episode == word]
        if not at_s.size:
            continue
        for bout_s in np.split(at_s, np.flatnonzero(np.diff(at_s) > LAG_S) + 1):
            true = (b - FOUND_S <= bout_s[-1] and bout_s[0] <= e + 2.0 * LAG_S
                    for b, e, what in n.spans if what == word)  # fmt: skip
            false += not any(true)
    return false


def _way_on_flights(n: _Node) -> tuple[float, float]:
    """Return what the estimate's forward way exceeds the true one by on flights, and that (m).

    What is taken back after a flight's end counts, ``LAG_S`` long.
    """
    ahead = [
        np.cos(t.heading_rad[:-1]) * np.diff(t.x_m) + np.sin(t.heading_rad[:-1]) * np.diff(t.y_m)
        for t in (n.estimate, n.truth)
    ]
    known = np.isfinite(ahead[0]) & np.isfinite(ahead[1]) & (np.diff(n.time_s) <= 1.0)
    inside_s, lagged = np.zeros(known.size), np.zeros(known.size, dtype=bool)
    from_s, until_s = n.time_s[:-1], n.time_s[1:]
    for begin_s, end_s, word in n.ended:
        if word in FLIGHTS:
            inside_s += np.clip(np.minimum(until_s, end_s) - np.maximum(from_s, begin_s), 0.0, 1.0)
            lagged |= (until_s > begin_s) & (from_s < end_s + LAG_S)
    surplus = float((ahead[0] - ahead[1])[lagged & known].sum())
    return surplus, float((ahead[1] * inside_s)[known].sum())


def _stacked(parts: object) -> Floats:
    return np.concatenate([np.empty(0), *parts])  # type: ignore[misc]
