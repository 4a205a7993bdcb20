"""Real walks laid out as a team in one space and time, with ranges drawn along their true tracks.

Nobody has published people with ranges between them and truth. So what a node reported on real
walks is joined to one mission a wearer: between two pieces the wearer turns on the spot towards a
place in the area, and the node's report of that turn is drawn, all else is the recording's. Truth
between surveyed points or foot contacts is straight. Ranges err as `range_errors` says.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from relpos.errors import DataError
from relpos.measurements import Measurement, Motion, Prior, Range, Truth
from relpos.runs import Description, Run
from relpos.settings import parse, setting
from relpos.simulation import range_errors

Floats = npt.NDArray[np.float64]

ROOM_M = 8.0
"""Distance of an office's walls from each other, both ways."""
HEARD_THROUGH = 0.6
"""Of ranges through a wall, those that are received."""
FACES_AWAY_RAD = math.radians(120.0)
"""A wearer who looks so far away from the other has the body in between."""
TURNING_ROUND_S = 1.5
"""Who has walked there and back begins to turn round again so long before the trial's end."""
PAUSE_S = 2.0
TURN_SIGMA_RAD = math.radians(3.0)
"""Error of a drawn turn on the spot (U-turns of docs/walkers.md: 2 degrees in the middle)."""
START_M, START_RAD = 0.3, math.radians(10.0)
"""How well a start is known: a first leg between surveyed points says the heading to 12 degrees."""


@dataclass(frozen=True, slots=True)
class TeamSettings:
    """What ``--set`` may change."""

    seconds: float = setting(1200.0, "length of the run", 10.0, 1e5)
    area_m: float = setting(25.0, "side of the square area", 5.0, 1e3)
    piece_m: float = setting(15.0, "a straight walk is turned after so much", 2.0, 1e4)
    walls: int = setting(0, "1: an office with walls every 8 m", 0, 1)
    range_rate_hz: float = setting(0.7, "ranges a second and pair", 0.0, 50.0)
    max_range_m: float = setting(30.0, "reach", 1.0, 1e5)


def settings_of(overrides: Mapping[str, str | float] | None) -> TeamSettings:
    """Return the settings, changed by the values of ``--set``."""
    return parse(TeamSettings, overrides or {}, "a team of recordings")


@dataclass(frozen=True)
class Track:
    """Where a wearer truly was: increasing times (n,), places (n,), unwrapped headings (n,)."""

    time_s: Floats
    place_m: npt.NDArray[np.complex128]
    heading_rad: Floats

    def at(self, time_s: Floats) -> tuple[npt.NDArray[np.complex128], Floats]:
        """Places and headings at times (m,); outside of the track, those of its ends."""
        x, y, heading = (
            np.interp(time_s, self.time_s, column)
            for column in (self.place_m.real, self.place_m.imag, self.heading_rad)
        )
        return x + 1j * y, heading

    def until(self, end_s: float) -> Track:
        """The part of the track before a time."""
        place, heading = self.at(np.array([end_s]))
        kept = self.time_s < end_s
        return Track(
            np.r_[self.time_s[kept], end_s],
            np.r_[self.place_m[kept], place],
            np.r_[self.heading_rad[kept], heading],
        )

    def later(self, shift_s: float) -> Track:
        """The same track at other times."""
        return replace(self, time_s=self.time_s + shift_s)


@dataclass(frozen=True)
class Wearer:
    """What a node reported on a mission, and the true tracks of its parts, on the same clock."""

    motions: Sequence[Motion]
    tracks: Sequence[Track]


def true_tracks(run: Run) -> list[Track]:
    """The true tracks of a recording with one wearer.

    From surveyed points or a track, from a walk there and back (``uturn_start``), or from a
    straight bout; distance follows the foot contacts. How wide a turn was nobody measured: there
    and back are two tracks. DataError where nothing says the track.
    """
    if len(run.truth) > 1:
        return [_through([(t.time_s, complex(t.x_m, t.y_m)) for t in run.truth])]
    times = {name: [e.time_s for e in run.events if e.event == name] for name in _MARKS}
    length_m = run.description.true_distance_m
    if times["uturn_start"] and length_m is not None:
        begin, end = times["trial_start"][0], times["trial_end"][0]
        turn = times["uturn_start"][0], times["uturn_end"][0]
        there = _leg(begin, turn[0], times["foot_contact"], 0.5 * length_m)
        back = _leg(turn[1], end, times["foot_contact"], 0.5 * length_m)
        return [there, back.until(end - TURNING_ROUND_S)]
    if len(times["bout_start"]) == len(times["bout_end"]) == 1 and length_m is not None:
        bout = times["bout_start"][0], times["bout_end"][0]
        return [_leg(*bout, times["foot_contact"], length_m)]
    raise DataError(
        f"{run.name}: nothing says the track: a recording for a team needs truth.csv, a walk there "
        "and back (trial_start, uturn_start, uturn_end, trial_end) or one straight bout, and "
        "true_distance_m"
    )


_MARKS = (
    "trial_start", "trial_end", "uturn_start", "uturn_end", "bout_start", "bout_end", "foot_contact"
)  # fmt: skip


def _leg(begin_s: float, end_s: float, contacts_s: Sequence[float], length_m: float) -> Track:
    """The track of a straight leg: every step as long as the next.

    The part before the first contact brings the body over half a step, from above both feet to
    between them; a shorter part, such as that before a turn, counts by its duration.
    """
    times = [begin_s, *sorted({t for t in contacts_s if begin_s < t < end_s}), end_s]
    parts_s = np.diff(times)
    steps = np.minimum(parts_s / np.median(parts_s), 1.0)
    steps[0] = min(steps[0], 0.5)
    places = length_m * np.r_[0.0, np.cumsum(steps)] / steps.sum()
    return Track(np.array(times), places.astype(complex), np.zeros(len(times)))


def _through(points: Sequence[tuple[float, complex]]) -> Track:
    """Straight between points; the heading turns from leg to leg within a second."""
    kept = [points[0], *(b for a, b in itertools.pairwise(points) if b[0] > a[0])]
    time_s = np.array([t for t, _ in kept])
    place_m = np.array([p for _, p in kept])
    legs = np.diff(place_m)
    moved = np.flatnonzero(np.abs(legs) > 0.0)
    if not len(moved):
        raise DataError("a track that does not move")
    # A leg without a way keeps the heading before it, the first ones the first that is known.
    source = np.maximum.accumulate(np.where(np.abs(legs) > 0.0, np.arange(len(legs)), moved[0]))
    heading = np.unwrap(np.angle(legs[source]))
    half_s = 0.5 * np.minimum(1.0, np.minimum(np.diff(time_s)[:-1], np.diff(time_s)[1:]))
    knots_s = np.stack([time_s[1:-1] - half_s, time_s[1:-1] + half_s], axis=1).ravel()
    knots_s = np.r_[time_s[0], knots_s, time_s[-1]]
    knots = np.repeat(heading, 2)
    every = np.union1d(time_s, knots_s)
    x, y = (np.interp(every, time_s, part) for part in (place_m.real, place_m.imag))
    return Track(every, x + 1j * y, np.interp(every, knots_s, knots))


# --- a wearer's mission --------------------------------------------------------------------------


def _pieces(track: Track, motions: Sequence[Motion], piece_m: float) -> list[tuple[float, float]]:
    """Spans between reports of the node, within the truth, of about ``piece_m`` each."""
    times = [m.time_s for m in motions if track.time_s[0] <= m.time_s <= track.time_s[-1]]
    spans = []
    begin = times[0] if times else 0.0
    for time in times[1:]:
        ends, _ = track.at(np.array([begin, time]))
        if abs(ends[1] - ends[0]) >= piece_m or time == times[-1]:
            spans.append((begin, time))
            begin = time
    return spans


def _join(
    node: int, wearer: Wearer, settings: TeamSettings, rng: np.random.Generator
) -> tuple[list[Motion], Track]:
    """One wearer's motions and true track, piece by piece, all of them again until the run's end.

    What the node reports outside of the truth is left out: who stands there may turn.
    """
    pieces = [
        (track, *span)
        for track in wearer.tracks
        for span in _pieces(track, wearer.motions, settings.piece_m)
    ]
    if not pieces:
        raise DataError(f"wearer {node}: no report of the node falls within the truth")
    place = complex(*rng.uniform(0.25, 0.75, 2) * settings.area_m)
    heading, now_s = float(rng.uniform(-math.pi, math.pi)), 0.0
    motions: list[Motion] = []
    knots: list[tuple[float, complex, float]] = [(0.0, place, heading)]
    phase_s = float(rng.uniform(0.1, 0.9))
    for track, begin, end in itertools.cycle(pieces):
        if now_s >= settings.seconds:
            break
        inside = track.time_s[(track.time_s > begin) & (track.time_s < end)]
        times = np.r_[begin, inside, end]
        places, headings = track.at(times)
        way = (places - places[0]) * cmath.exp(-1j * headings[0])
        goal = complex(*rng.uniform(0.0, settings.area_m, 2))
        turn = cmath.phase(goal - place) - (cmath.phase(way[-1]) if abs(way[-1]) > 0.5 else 0.0)
        turn = math.remainder(turn - heading, 2.0 * math.pi)
        told = turn + TURN_SIGMA_RAD * rng.standard_normal()
        since_s = now_s + (phase_s if now_s == 0.0 else 0.0)
        heading += turn
        knots.append((since_s + PAUSE_S, place, heading))
        motions.append(
            Motion(
                since_s + PAUSE_S, node, 0.0, 0.0, told, 0.01, 0.01, TURN_SIGMA_RAD, moving=False
            )
        )
        shift_s = since_s + PAUSE_S - begin
        origin, start = place, heading
        for t, w, h in zip(times[1:], way[1:], headings[1:], strict=True):
            heading = float(start + h - headings[0])
            place = origin + complex(w) * cmath.exp(1j * start)
            knots.append((float(t + shift_s), place, heading))
        motions += [
            replace(m, node=node, time_s=m.time_s + shift_s, gain_version=None)
            for m in wearer.motions
            if begin < m.time_s <= end
        ]
        now_s = end + shift_s
    joined = Track(*(np.array(column) for column in zip(*knots, strict=True)))
    return [m for m in motions if m.time_s <= settings.seconds], joined


# --- the team ------------------------------------------------------------------------------------


def _ranges(
    tracks: Sequence[Track], settings: TeamSettings, rng: np.random.Generator
) -> list[Range]:
    made = []
    pairs = [(a, b) for a in range(len(tracks)) for b in range(a + 1, len(tracks))]
    for (a, b), one in zip(pairs, rng.spawn(len(pairs)), strict=True):
        count = one.poisson(settings.range_rate_hz * settings.seconds)
        time_s = np.sort(one.uniform(0.0, settings.seconds, count))
        (at, looks), (other, its_looks) = tracks[a].at(time_s), tracks[b].at(time_s)
        line = other - at
        distance_m = np.abs(line)
        walls = np.zeros(count)
        if settings.walls:
            for here, there in ((at.real, other.real), (at.imag, other.imag)):
                walls += np.abs(np.floor(there / ROOM_M) - np.floor(here / ROOM_M))
        away = np.abs(np.angle(line * np.exp(-1j * looks))) > FACES_AWAY_RAD
        away |= np.abs(np.angle(-line * np.exp(-1j * its_looks))) > FACES_AWAY_RAD
        moved_m = np.abs(np.diff(line, prepend=line[:1]))
        error_m = range_errors.errors_m(
            distance_m,
            range_errors.places(moved_m, one),
            one.standard_normal(count),
            body=away,
            wall=walls > 0,
        )
        reach = (1.0 - 0.5 * distance_m / settings.max_range_m) * HEARD_THROUGH**walls
        heard = (one.random(count) < reach) & (distance_m < settings.max_range_m)
        first = one.random(count) < 0.5
        for k in np.flatnonzero(heard):
            node, peer = (a, b) if first[k] else (b, a)
            measured_m = max(float(distance_m[k] + error_m[k]), 0.01)
            made.append(Range(float(time_s[k]), node + 1, peer + 1, measured_m))
    return made


def make_team(wearers: Sequence[Wearer], settings: TeamSettings, seed: int, source: str) -> Run:
    """A run of the wearers, numbered from 1, with its truth; the same arguments, the same run."""
    motion_rng, range_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2)
    )
    joined = [
        _join(node, wearer, settings, one)
        for node, (wearer, one) in enumerate(
            zip(wearers, motion_rng.spawn(len(wearers)), strict=True), start=1
        )
    ]
    tracks = [track for _, track in joined]
    whole_s = np.arange(math.floor(settings.seconds) + 1.0)
    truth = []
    for node, track in enumerate(tracks, start=1):
        places, headings = track.at(whole_s)
        truth += [
            Truth(float(t), node, float(p.real), float(p.imag), math.remainder(h, 2.0 * math.pi))
            for t, p, h in zip(whole_s, places, headings, strict=True)
        ]
    measured: list[Measurement] = [m for motions, _ in joined for m in motions]
    measured += _ranges(tracks, settings, range_rng)
    priors = tuple(
        Prior(
            node, float(t.place_m[0].real), float(t.place_m[0].imag), float(t.heading_rad[0]),
            START_M, START_RAD,
        )
        for node, t in enumerate(tracks, start=1)
    )  # fmt: skip
    return Run(
        name=f"recorded-team-{seed}",
        description=Description(source=source, heading_known=True, priors=priors),
        measurements=tuple(sorted(measured, key=lambda m: m.time_s)),
        truth=tuple(sorted(truth, key=lambda t: (t.time_s, t.node))),
    )
