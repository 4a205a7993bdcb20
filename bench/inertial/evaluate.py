"""Dead reckoning on the real walks: every figure that docs/deadreckoning.md quotes.

Run as ``.venv/bin/python bench/inertial/evaluate.py``: all data sets. ``--only lowerback``,
``chest``, ``daily`` or ``waypoints`` takes one of them, ``--floor`` adds what step models reach
with the foot contacts given, ``--registers`` the difference when the walks are played into the
emulated chip (``relpos deadreckon``), ``--json FILE`` writes the figures for a machine,
``--pictures DIR`` draws tracks, ``--table`` prints what was asked for beside its bar, ``--verbose``
every walk. ``--people odd`` or ``even`` shows half the people of the lower-back walks: constants
are chosen on the odd ones and reported on the even ones.
"""

from __future__ import annotations

import argparse
import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import floors
import numpy as np
import pictures
import replay
from numpy.typing import NDArray
from replay import Array, Reckoning, Recording

from recordings import CORRIDOR, Track, aligned, at_waypoints, fitted, folders, waypoints_of

Figures = dict[str, float]
TRUE_M = 20.0
CALIBRATED_SIGMA = 0.03  # scale error left after a calibration walk
TURN_MARGIN_S = 0.5  # around the annotated U-turn, in which the trunk still turns
STRIDES_S = 2.0  # about two strides: the trunk's swing averages out
SLOW = "Test11"  # of walk_daily_lowerback: the slow indoor activity


def percent(values: Sequence[float] | Array) -> Array:
    """Relative errors as percent."""
    return 100.0 * np.asarray(values, dtype=np.float64)


def spread(name: str, errors: Array) -> Figures:
    """Mean, mean absolute, median absolute and worst of signed errors."""
    size = np.abs(errors)
    return {
        f"{name}_mean": float(errors.mean()),
        f"{name}_mean_abs": float(size.mean()),
        f"{name}_median_abs": float(np.median(size)),
        f"{name}_worst": float(size.max()),
    }


def nees(
    name: str, squares: Array, groups: Sequence[str] | NDArray[np.str_], seed: int = 0
) -> Figures:
    """Mean of normalised squares and its 95 % interval, resampling whole groups (people)."""
    rng = np.random.default_rng(seed)
    labels = np.array(groups)
    parts = [squares[labels == label] for label in np.unique(labels)]
    means = []
    for _ in range(2000):
        drawn = rng.integers(len(parts), size=len(parts))
        means.append(np.concatenate([parts[i] for i in drawn]).mean())
    low, high = np.percentile(means, [2.5, 97.5])
    return {name: float(squares.mean()), f"{name}_low": float(low), f"{name}_high": float(high)}


# --- walk_lowerback_20m --------------------------------------------------------------------------


@dataclass(frozen=True)
class LowerBackWalk:
    """One walk of 20 m, as the library saw it."""

    recording: Recording
    result: Reckoning
    score: replay.StepScore
    turn_deg: float  # across the U-turn, less 180
    legs_deg: float  # between the directions of the two legs, less 180

    @property
    def person(self) -> str:
        """Number of the person."""
        return self.recording.name.split("-")[0]

    @property
    def error(self) -> float:
        """Relative distance error."""
        return self.result.distance_m / TRUE_M - 1.0


def turns_deg(recording: Recording, heading_rad: Array) -> tuple[float, float]:
    """Turn across the U-turn with margin, and between the legs' mean directions; less 180."""
    heading = np.unwrap(heading_rad)
    time = recording.time_s
    begin, end = recording.trial_s
    turn_begin = float(recording.times_of("uturn_start")[0]) - TURN_MARGIN_S
    turn_end = float(recording.times_of("uturn_end")[0]) + TURN_MARGIN_S

    def mean(after: float, before: float) -> float:
        return float(heading[(time >= after) & (time <= before)].mean())

    def beyond(change_rad: float) -> float:
        return float(np.degrees(abs(change_rad))) - 180.0

    near = mean(turn_end, turn_end + STRIDES_S) - mean(turn_begin - STRIDES_S, turn_begin)
    # The first step starts and the last ones stop the walk: people begin to turn round again.
    far = mean(turn_end, end - 1.5) - mean(begin + 1.0, turn_begin)
    return beyond(near), beyond(far)


def lowerback_walks() -> list[LowerBackWalk]:
    """Every walk through the library, stature alone, no magnetometer."""
    walks = []
    for folder in folders("walk_lowerback_20m"):
        recording = replay.load(folder)
        result = replay.reckon(recording.imu, leg_length_m=recording.leg_length_m)
        score = replay.score_steps(recording, recording.time_s[result.step_ticks])
        turn, legs = turns_deg(recording, result.rows["heading_rad"])
        walks.append(LowerBackWalk(recording, result, score, turn, legs))
    return walks


def calibrated_errors(
    walks: Sequence[LowerBackWalk], *, believed: bool = True
) -> tuple[Array, Array, list[str]]:
    """Every ordered pair of a person's walks: error, normalised square, person.

    The first walk of a pair calibrates the gain, the second one is judged. Without ``believed`` the
    gain makes the first walk 20 m, whatever is known of people.
    """
    errors, squares, people = [], [], []
    for first in walks:
        others = [w for w in walks if w.person == first.person and w is not first]
        if not others:
            continue
        gain = replay.calibrate(first.recording, TRUE_M, believed=believed)
        for walk in others:
            result = replay.reckon(
                walk.recording.imu,
                leg_length_m=walk.recording.leg_length_m,
                step_gain=gain,
                scale_sigma=CALIBRATED_SIGMA,
            )
            error = result.distance_m / TRUE_M - 1.0
            errors.append(error)
            squares.append((TRUE_M * error) ** 2 / result.rows["variance_along_m2"][-1])
            people.append(walk.person)
    return np.array(errors), np.array(squares), people


def lowerback_figures(walks: Sequence[LowerBackWalk], intact: NDArray[np.bool_]) -> Figures:
    """All figures of the given walks; ``intact`` says which lost no samples."""
    errors = percent([w.error for w in walks])
    out: Figures = {"walks": len(walks), "intact_walks": int(intact.sum())}
    for name, chosen in (("", np.ones(len(walks), bool)), ("intact_", intact)):
        contacts = sum(w.score.contacts for w, c in zip(walks, chosen, strict=True) if c)
        found = sum(w.score.found for w, c in zip(walks, chosen, strict=True) if c)
        extra = sum(w.score.extra for w, c in zip(walks, chosen, strict=True) if c)
        out |= {
            f"{name}contacts": contacts,
            f"{name}steps_found_percent": 100.0 * found / contacts,
            f"{name}steps_extra_percent": 100.0 * extra / contacts,
        }
        out |= spread(f"{name}distance_error_percent", errors[chosen])
    by_person = [errors[[w.person == p for w in walks]] for p in {w.person for w in walks}]
    out["distance_error_percent_within_person_sd"] = float(
        np.sqrt(np.mean([np.var(part) for part in by_person]))
    )
    turns = np.array([w.turn_deg for w in walks])
    out |= spread("turn_error_deg", turns) | spread("intact_turn_error_deg", turns[intact])
    out["turn_within_5_deg_percent"] = 100.0 * float(np.mean(np.abs(turns) <= 5.0))
    out |= spread("legs_error_deg", np.array([w.legs_deg for w in walks]))
    squares = np.array(
        [(TRUE_M * w.error) ** 2 / w.result.rows["variance_along_m2"][-1] for w in walks]
    )
    persons = np.array([w.person for w in walks])
    out |= nees("nees_along", squares, persons)
    out |= nees("intact_nees_along", squares[intact], persons[intact])
    errors_c, squares_c, people = calibrated_errors(walks)
    out |= spread("calibrated_distance_error_percent", percent(errors_c))
    out |= nees("calibrated_nees_along", squares_c, people)
    sound = [w for w, kept in zip(walks, intact, strict=True) if kept]
    errors_c, squares_c, people = calibrated_errors(sound)
    out |= spread("intact_calibrated_distance_error_percent", percent(errors_c))
    out |= nees("intact_calibrated_nees_along", squares_c, people)
    for name, some in (("", walks), ("intact_", sound)):
        errors_c, _, _ = calibrated_errors(some, believed=False)
        out |= spread(f"{name}ratio_calibrated_distance_error_percent", percent(errors_c))
    return out


@functools.cache
def contact_walks() -> tuple[list[floors.Walk], list[floors.Ceiling], NDArray[np.bool_]]:
    """The walks with their contacts, what their signal holds, and which lost no samples."""
    walks = [floors.prepare(replay.load(folder)) for folder in folders("walk_lowerback_20m")]
    ceilings = [floors.ceiling_of(walk) for walk in walks]
    intact = [floors.is_intact(w, c) for w, c in zip(walks, ceilings, strict=True)]
    return walks, ceilings, np.array(intact)


def lowerback(people: str, verbose: bool) -> Figures:
    """Distance, steps and turn of walk_lowerback_20m."""
    _, _, intact = contact_walks()
    walks = lowerback_walks()
    if verbose:
        for walk, sound in zip(walks, intact, strict=True):
            rows = walk.result.rows
            print(
                f"  {walk.recording.name:6} {100 * walk.error:+6.1f} % turn {walk.turn_deg:+6.1f} "
                f"legs {walk.legs_deg:+6.1f} deg steps {walk.score.found}/{walk.score.contacts} "
                f"+{walk.score.extra} forward {np.degrees(rows['forward_rad'][-1]):+5.0f} "
                f"end ({rows['x_m'][-1]:+5.2f},{rows['y_m'][-1]:+5.2f}) "
                f"{walk.result.counters['doubtful_steps']} doubtful"
                f"{'' if sound else ', samples lost'}"
            )
    chosen = [people == "all" or (int(walk.person) % 2 == 1) == (people == "odd") for walk in walks]
    return lowerback_figures(
        [w for w, c in zip(walks, chosen, strict=True) if c], intact[np.array(chosen)]
    )


def floor() -> Figures:
    """Step models and ideal detectors with the contacts given; prints a table."""
    walks, ceilings, intact = contact_walks()
    print(f"  {'contacts given':45} {'stature alone':>22} {'odd -> even':>12} {'one walk':>14}")
    print(f"  {'mean absolute error, percent':45} {'all':>6} {'worst':>7} {'intact':>7}", end="")
    print(f" {'':12} {'all':>6} {'worst':>7}   constants")
    out: Figures = {}
    for name, model in floors.MODELS.items():
        result = floors.floor_of(model, walks, intact)
        alone, one_walk = np.abs(percent(result.stature_alone)), np.abs(percent(result.calibrated))
        even = float(np.abs(percent(result.even_people)).mean())
        print(
            f"  {name:45} {alone.mean():6.2f} {alone.max():7.1f} {alone[intact].mean():7.2f} "
            f"{even:12.2f} {one_walk.mean():6.2f} {one_walk.max():7.1f}   "
            f"{' '.join(f'{c:.3f}' for c in result.constants)}"
        )
        out[f"stature_alone_percent: {name}"] = float(alone.mean())
        out[f"calibrated_percent: {name}"] = float(one_walk.mean())
    best = min(out[f"calibrated_percent: {name}"] for name in floors.PENDULUMS)
    out["floor_calibrated_pendulum_percent"] = best
    out["bar_calibrated_percent"] = min(4.5, 1.1 * best)
    contacts = sum(c.contacts for c in ceilings)
    out["contacts"] = contacts
    out["contacts_without_motion"] = sum(c.dead for c in ceilings)
    out["contacts_on_the_same_foot"] = sum(c.repeated for c in ceilings)
    out["walks_with_lost_samples"] = int((~intact).sum())
    out["ceiling_found_percent_every_bump"] = 100.0 * sum(c.every_bump for c in ceilings) / contacts
    for name, kept in (("", np.ones(len(walks), bool)), ("intact_", intact)):
        scores = [c.oscillations for c, k in zip(ceilings, kept, strict=True) if k]
        count = sum(s.contacts for s in scores)
        out[f"{name}oscillations_found_percent"] = 100.0 * sum(s.found for s in scores) / count
        out[f"{name}oscillations_extra_percent"] = 100.0 * sum(s.extra for s in scores) / count
    return {key: value for key, value in out.items() if ": " not in key} | {
        key: value for key, value in out.items() if ": " in key
    }


# --- walk_daily_lowerback ------------------------------------------------------------------------


def daily(verbose: bool) -> Figures:
    """Distance inside and outside the bouts of walk_daily_lowerback."""
    out: Figures = {}
    sums: dict[str, list[tuple[float, float]]] = {"slow": [], "straight": []}
    outside = {"slow": 0.0, "straight": 0.0}
    for folder in folders("walk_daily_lowerback"):
        recording = replay.load(folder)
        result = replay.reckon(recording.imu, leg_length_m=recording.leg_length_m)
        starts = [(t, float(v)) for t, name, v in recording.events if name == "bout_start"]
        edges_s = np.stack([[t for t, _ in starts], recording.times_of("bout_end")], axis=1)
        times_s = recording.time_s[result.step_ticks]
        claimed = np.diff(replay.walked_m(times_s, result.step_lengths_m, edges_s.ravel()))[::2]
        true = np.array([length for _, length in starts])
        kind = "slow" if SLOW in folder.name else "straight"
        sums[kind] += list(zip(claimed.tolist(), true.tolist(), strict=True))
        beyond = result.distance_m - float(claimed.sum())
        outside[kind] += beyond
        ratio = 100.0 * (claimed.sum() / true.sum() - 1.0)
        out[f"{folder.name}_bouts_error_percent"] = float(ratio)
        if verbose:
            pairs = " ".join(f"{c:.1f}/{t:.1f}" for c, t in zip(claimed, true, strict=True))
            print(
                f"  {folder.name:22} bouts {claimed.sum():6.2f} of {true.sum():6.2f} m "
                f"({ratio:+.0f} %), outside {beyond:5.1f} m in "
                f"{recording.time_s[-1] - np.diff(edges_s, axis=1).sum():.0f} s, "
                f"{result.rows['steps'][-1]} steps: {pairs}"
            )
    for kind, bouts in sums.items():
        claimed, true = np.array(bouts).T
        out[f"{kind}_bouts"] = len(bouts)
        out[f"{kind}_summed_error_percent"] = float(100.0 * (claimed.sum() / true.sum() - 1.0))
        out[f"{kind}_mean_abs_error_per_bout_percent"] = float(
            100.0 * np.abs(claimed / true - 1.0).mean()
        )
        out[f"{kind}_outside_m"] = outside[kind]
    return out


# --- walk_chest ----------------------------------------------------------------------------------


def chest(verbose: bool) -> Figures:
    """Corridor, repeated walk, and every recording of walk_chest."""
    out: Figures = {}
    lengths: dict[str, float] = {}
    repeated = []
    corners: list[tuple[float, float]] = []
    for folder in folders("walk_chest"):
        recording = replay.load(folder)
        result = replay.reckon(recording.imu)
        with_field = replay.reckon(recording.imu, recording.field_ut)
        steps = int(result.rows["steps"][-1])
        lengths[folder.name] = result.distance_m
        if "K_calibration" in folder.name:
            repeated.append(result.distance_m)
            out[f"K_calibration_{folder.name[-5]}_steps"] = steps
            out[f"K_calibration_{folder.name[-5]}_m"] = result.distance_m
        if folder.name in CORRIDOR:
            way = "there" if folder.name == CORRIDOR[0] else "back"
            out[f"corridor_{way}_m"], out[f"corridor_{way}_steps"] = result.distance_m, steps
        if recording.time_s[-1] > 30.0 and result.distance_m > 5.0:
            # Corridors meet at right angles: a walk has turned by a multiple of them.
            turns = np.degrees([result.turn_rad, with_field.turn_rad])
            corners.append(tuple(np.abs(turns - 90.0 * np.round(turns / 90.0))))
        if "static" in folder.name.lower():
            out[f"{folder.name}_m"] = result.distance_m
        if verbose:
            each = result.step_lengths_m
            print(
                f"  {folder.name[-46:]:46} {result.distance_m:7.2f} m {steps:4d} steps "
                f"({each.min(initial=9):.2f} to {each.max(initial=0):.2f} m) turn "
                f"{np.degrees(result.turn_rad):+7.1f}, with magnetometer "
                f"{np.degrees(with_field.turn_rad):+7.1f} deg "
                f"({with_field.counters['rejected_magnetic']} readings rejected), "
                f"{result.counters['doubtful_steps']} doubtful, "
                f"{result.counters['lost_steps']} lost"
            )
    out["corridor_ratio_percent"] = 100.0 * (lengths[CORRIDOR[1]] / lengths[CORRIDOR[0]] - 1.0)
    off = np.median(corners, axis=0)
    out["right_angle_median_deg"], out["magnetometer_right_angle_median_deg"] = map(float, off)
    middle = float(np.mean(repeated))
    out["K_calibration_worst_from_mean_percent"] = float(
        100.0 * np.abs(np.array(repeated) / middle - 1.0).max()
    )
    out["K_calibration_range_percent"] = float(100.0 * np.ptp(repeated) / middle)
    return out


# --- walk_handheld_waypoints ---------------------------------------------------------------------


def waypoint_figures(tracks: Sequence[tuple[Track, Track]]) -> Figures:
    """Errors from pairs of (estimate, places), both (n,) complex metres at the waypoints.

    The first two waypoints are spent on the alignment: the figures are of the others, but for those
    "with second waypoint", where only the scale shows. In percent of the distance walked, which is
    the way along the waypoints: of the whole walk, and ("so far") until the waypoint. The best turn
    and scale are fitted to all waypoints: what is left then is no matter of one angle and factor.
    """
    whole, until, turned, scaled, every, ends, scale = [], [], [], [], [], [], []
    for estimate, places in tracks:
        legs = np.abs(np.diff(places))
        way = np.concatenate(([0.0], np.cumsum(legs)))
        error = np.abs(aligned(estimate, places) - places)
        good = np.isfinite(error) & (np.arange(len(places)) >= 2)
        whole.append(error[good] / way[-1])
        until.append(error[good] / way[good])
        every.append(error[np.isfinite(error)][1:] / way[-1])
        ends.append(error[good][-1] / way[-1])
        other = np.abs(fitted(estimate, places) - places)
        turned.append(other[np.isfinite(other)][1:] / way[-1])
        other = np.abs(fitted(estimate, places, scale=True) - places)
        scaled.append(other[np.isfinite(other)][1:] / way[-1])
        direct = np.nansum(np.abs(np.diff(estimate)))
        scale.append(direct / legs.sum() - 1.0)
    out: Figures = {"walks": len(tracks), "waypoints": sum(map(len, whole))}
    for name, parts in (
        ("", whole),
        ("so_far_", until),
        ("with_second_waypoint_", every),
        ("best_turn_", turned),
        ("best_turn_and_scale_", scaled),
    ):
        values = percent(np.concatenate(parts))
        out[f"{name}median_percent"] = float(np.median(values))
        out[f"{name}p90_percent"] = float(np.percentile(values, 90))
    walk_means = percent([part.mean() for part in whole])
    out["walk_mean_median_percent"] = float(np.median(walk_means))
    out["walk_mean_p90_percent"] = float(np.percentile(walk_means, 90))
    out["end_median_percent"] = float(np.median(percent(ends)))
    out["chord_scale_median_percent"] = float(np.median(percent(scale)))
    return out


def gyro_heading_rad(walk: floors.Walk) -> Array:
    """Yaw (n,) from the raw gyroscope about the vertical: no bias, no correction."""
    up = walk.up
    rate = np.sum(walk.recording.imu[:, 3:] * up, axis=1)
    return np.cumsum(rate) / replay.RATE_HZ


def waypoints(verbose: bool) -> Figures:
    """Position errors of walk_handheld_waypoints, without and with magnetometer."""
    kinds: dict[str, list[tuple[Track, Track]]] = {
        "plain": [],
        "magnetometer": [],
        "bound_true_distances": [],
        "bound_true_directions": [],
    }
    squares = []
    for folder in folders("walk_handheld_waypoints"):
        recording = replay.load(folder)
        times_s, places = waypoints_of(folder)
        plain = replay.reckon(recording.imu)
        field = replay.reckon(recording.imu, recording.field_ut)
        for name, result in (("plain", plain), ("magnetometer", field)):
            track = result.rows["x_m"] + 1j * result.rows["y_m"]
            kinds[name].append((at_waypoints(recording, track, times_s), places))
        heading = gyro_heading_rad(floors.prepare(recording, steps=False))
        way = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(places)))))
        # The path along the waypoints is the shortest possible, and the best distance known.
        squares.append((plain.distance_m - way[-1]) ** 2 / plain.rows["variance_along_m2"][-1])
        true_m = np.diff(np.interp(recording.time_s, times_s, way), prepend=0.0)
        leg = np.clip(np.searchsorted(times_s, recording.time_s, "right") - 1, 0, len(places) - 2)
        direction = np.angle(np.diff(places))[leg]
        claimed = np.diff(
            replay.walked_m(
                recording.time_s[plain.step_ticks], plain.step_lengths_m, recording.time_s
            ),
            prepend=0.0,
        )
        for name, lengths, angle in (
            ("bound_true_distances", true_m, heading),
            ("bound_true_directions", claimed, direction),
        ):
            track = np.cumsum(lengths * np.exp(1j * angle))
            kinds[name].append((at_waypoints(recording, track, times_s), places))
        if verbose:
            one = waypoint_figures(kinds["plain"][-1:])
            other = waypoint_figures(kinds["magnetometer"][-1:])
            drift = np.degrees(np.unwrap(plain.rows["heading_rad"])[-1] - heading[-1])
            print(
                f"  {folder.name} {way[-1]:6.1f} m, {len(places):2d} waypoints, first leg "
                f"{abs(places[1] - places[0]):4.1f} m: mean {one['walk_mean_median_percent']:5.1f} "
                f"end {one['end_median_percent']:5.1f} best turn "
                f"{one['best_turn_median_percent']:5.1f} scale "
                f"{one['chord_scale_median_percent']:+6.1f} %, with magnetometer mean "
                f"{other['walk_mean_median_percent']:5.1f} %, {plain.rows['steps'][-1]:3d} steps, "
                f"heading {drift:+6.1f} deg off the raw gyroscope, "
                f"forward {np.degrees(plain.rows['forward_rad'][-1]):+4.0f}"
            )
    out = {
        f"{kind}_{name}" if kind != "plain" else name: value
        for kind, tracks in kinds.items()
        for name, value in waypoint_figures(tracks).items()
    }
    return out | nees("nees_along", np.array(squares), [str(k) for k in range(len(squares))])


# --- the same walks through the emulated chip ---


def registers(verbose: bool) -> Figures:
    """What `relpos deadreckon` makes of the walks, against the library called directly.

    Between the two lie the chip's filter (causal, with its delay), its range and steps of 0.0012
    m/s2, the instants at which the firmware reads it, and lengths in whole millimetres.
    """
    from relpos.emulator.deadreckoning import WearerSettings, play
    from relpos.runs import load_run

    distances, turns = [], []
    same_steps = 0
    for data_set in ("walk_lowerback_20m", "walk_chest", "walk_handheld_waypoints"):
        for folder in folders(data_set):
            recording = replay.load(folder)
            leg_m = recording.leg_length_m
            direct = replay.reckon(recording.imu, recording.field_ut, leg_length_m=leg_m)
            ((node, imu),) = load_run(folder).load_imu().items()
            played = play(node, imu, WearerSettings(leg_m))
            turn = sum(motion.dtheta_rad for motion in played.motions)
            same_steps += len(played.steps) == int(direct.rows["steps"][-1])
            turns.append(np.degrees(turn - direct.turn_rad))
            if direct.distance_m > 1.0:
                distances.append(played.distance_m / direct.distance_m - 1.0)
            if verbose:
                print(
                    f"  {data_set}/{folder.name[-30:]:30} {direct.distance_m:7.2f} m directly, "
                    f"{played.distance_m:7.2f} through the chip, steps "
                    f"{direct.rows['steps'][-1]} and {len(played.steps)}, turn {turns[-1]:+.1f} deg"
                )
    size = np.abs(percent(distances))
    return {
        "walks": len(turns),
        "same_steps_percent": 100.0 * same_steps / len(turns),
        "distance_mean_percent": float(percent(distances).mean()),
        "distance_median_abs_percent": float(np.median(size)),
        "distance_p90_abs_percent": float(np.percentile(size, 90)),
        "distance_worst_percent": float(size.max()),
        "turn_median_abs_deg": float(np.median(np.abs(turns))),
        "turn_p90_abs_deg": float(np.percentile(np.abs(turns), 90)),
    }


# --- what was asked for ---


@dataclass(frozen=True)
class Goal:
    """A figure and the bounds asked of its absolute value."""

    data_set: str
    name: str
    words: str
    least: float = 0.0
    most: float = np.inf

    @property
    def bar(self) -> str:
        """The bounds in words."""
        if not np.isfinite(self.most):
            return f"at least {self.least:g}" if self.least else ""
        return f"{self.least:g} to {self.most:g}" if self.least else f"at most {self.most:g}"


GOALS = [
    Goal("lowerback", "steps_found_percent", "steps found one to one, %", least=98.0),
    Goal("lowerback", "steps_extra_percent", "steps extra, %", most=1.0),
    Goal("lowerback", "distance_error_percent_mean_abs", "stature alone, mean abs %", most=5.0),
    Goal("lowerback", "distance_error_percent_median_abs", "stature alone, median abs %"),
    Goal("lowerback", "distance_error_percent_worst", "stature alone, worst %"),
    Goal(
        "lowerback",
        "calibrated_distance_error_percent_mean_abs",
        "after one calibration walk, mean abs %",
        most=4.5,
    ),
    Goal(
        "lowerback",
        "ratio_calibrated_distance_error_percent_mean_abs",
        "the same, gain as the walk asks",
    ),
    Goal("lowerback", "turn_error_deg_median_abs", "U-turn, median abs deg", most=5.0),
    Goal("lowerback", "turn_error_deg_mean_abs", "U-turn, mean abs deg", most=5.0),
    Goal("lowerback", "nees_along", "NEES along, stature alone", 0.5, 2.0),
    Goal("lowerback", "calibrated_nees_along", "NEES along, one calibration walk", 0.5, 2.0),
    Goal("daily", "slow_summed_error_percent", "slow bouts, summed %", most=15.0),
    Goal("daily", "slow_mean_abs_error_per_bout_percent", "slow, mean abs a bout %", most=25.0),
    Goal("daily", "slow_outside_m", "slow, claimed outside the bouts, m"),
    Goal("daily", "straight_summed_error_percent", "straight walks, summed %", most=15.0),
    Goal("chest", "corridor_ratio_percent", "corridor, back against there, %", most=0.7),
    Goal("chest", "corridor_there_steps", "corridor, steps there", 164, 169),
    Goal("chest", "corridor_back_steps", "corridor, steps back", 164, 169),
    Goal("chest", "K_calibration_worst_from_mean_percent", "repeated walk, worst %", most=3.0),
    Goal("waypoints", "median_percent", "median, % of the way walked", most=5.0),
    Goal("waypoints", "p90_percent", "90th percentile, %"),
    Goal("waypoints", "best_turn_median_percent", "median with the best turn, %"),
    Goal("waypoints", "magnetometer_median_percent", "with magnetometer, median %", most=5.0),
    Goal("waypoints", "magnetometer_p90_percent", "with magnetometer, 90th percentile, %"),
    Goal("waypoints", "bound_true_distances_median_percent", "raw gyro, true distances, median %"),
]


def print_goals(figures: dict[str, Figures]) -> None:
    """Print what was asked for as a Markdown table."""
    print("| data | figure | reached | intact walks | bar | |\n|---|---|---|---|---|---|")
    for goal in GOALS:
        if goal.data_set not in figures:
            continue
        value = figures[goal.data_set][goal.name]
        intact = figures[goal.data_set].get(f"intact_{goal.name}")
        met = goal.least <= abs(value) <= goal.most
        verdict = ("met" if met else "**missed**") if goal.bar else ""
        cells = [
            goal.data_set,
            goal.words,
            f"{value:.2f}" if value % 1 else f"{value:.0f}",
            "" if intact is None else f"{intact:.2f}",
            goal.bar,
            verdict,
        ]
        print("| " + " | ".join(cells) + " |")


# --- main ----------------------------------------------------------------------------------------


def show(title: str, figures: Figures) -> None:
    """Print figures, one a line."""
    print(title)
    for name, value in figures.items():
        print(f"  {name:52} {value:10.2f}" if value % 1 else f"  {name:52} {value:10.0f}")


def main() -> None:
    """Evaluate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--people", choices=["odd", "even", "all"], default="all")
    parser.add_argument("--only", choices=["lowerback", "daily", "chest", "waypoints"])
    parser.add_argument("--floor", action="store_true", help="step models with contacts given")
    parser.add_argument("--verbose", action="store_true", help="a line for every walk")
    parser.add_argument("--registers", action="store_true", help="through the emulated chip, too")
    parser.add_argument("--table", action="store_true", help="what was asked for, as Markdown")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="draw tracks into a folder")
    options = parser.parse_args()
    parts: dict[str, Callable[[], Figures]] = {
        "lowerback": lambda: lowerback(options.people, options.verbose),
        "daily": lambda: daily(options.verbose),
        "chest": lambda: chest(options.verbose),
        "waypoints": lambda: waypoints(options.verbose),
    }
    figures: dict[str, Figures] = {}
    for name, part in parts.items():
        if options.only in (None, name):
            figures[name] = part()
            if not options.table:
                show(f"{name}:", figures[name])
    if options.floor:
        print("floor:")
        figures["floor"] = floor()
        show("", {k: v for k, v in figures["floor"].items() if ": " not in k})
    if options.registers:
        figures["registers"] = registers(options.verbose)
        show("registers:", figures["registers"])
    if options.table:
        print_goals(figures)
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    if options.pictures is not None:
        pictures.draw(options.pictures)


if __name__ == "__main__":
    main()
