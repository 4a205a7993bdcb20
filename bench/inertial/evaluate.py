"""Dead reckoning on every recorded walk: docs/walkers.md is generated from it.

Run as ``.venv/bin/python bench/inertial/evaluate.py``: a table of all sets below the folder of the
recordings, whatever they are called. Constants are chosen without the set, or without the person,
that is judged. ``--page FILE`` writes the page, ``--json FILE`` the figures for a machine,
``--pictures DIR`` draws tracks, ``--verbose`` prints every walk, ``--registers`` plays walks into
the emulated chip (``relpos deadreckon``) and compares.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import replay
import walks as walking
from replay import Array
from walks import Choice, Fit, Score, Walk

from recordings import CORRIDOR, Track, aligned, at_waypoints, fitted, folders, gyro_heading_rad

Figures = dict[str, float]
PLACE = "<!-- figures -->"


def percent(values: Sequence[float] | Array) -> Array:
    """Relative errors as percent."""
    return 100.0 * np.asarray(values, dtype=np.float64)


def mean_of(values: Sequence[float] | Array) -> float | None:
    """Mean, None of nothing."""
    return float(np.mean(values)) if len(values) else None


# --- all sets ------------------------------------------------------------------------------------


@dataclass
class Row:
    """A group of walks, judged with constants that have not seen its set. Percent and degrees."""

    group: str
    people: int
    parts: int
    mean: float
    mean_abs: float
    worst_tenth: float
    person_left_out: float  # mean absolute, constants from all but the person
    nees: float
    flagged: float  # of the runs, those with more than half of their steps flagged
    calibrated: float | None  # mean absolute, after one walk of the same person
    calibrated_nees: float | None
    steps_found: float | None
    steps_extra: float | None
    turn_deg: float | None  # median absolute
    turn_nees: float | None
    loop: float | None  # mean distance of a loop's end from its beginning, of the way


def errors(found: Sequence[Score]) -> Array:
    """Signed errors in percent."""
    return percent([score.error for score in found])


def judge(
    group: str, members: Sequence[Walk], fit: Fit, biases_rad_s: Array, verbose: bool = False
) -> Row:
    """The figures of a group."""
    choice = fit.without_set(members[0].data_set)
    with walking.choose(choice):
        results = [walk.reckon(choice.gain) for walk in members]
        found = [s for w, r in zip(members, results, strict=True) for s in walking.scores(w, r)]
        again = walking.calibrated(members, choice.gain)
        turned = np.array(
            [t for w in members for t in walking.turn_errors(w, choice.gain, biases_rad_s)]
        )
    alone = []
    for person in sorted({walk.person for walk in members}):
        alone += person_left_out([w for w in members if w.person == person], fit)
    size = np.abs(errors(found))
    contacts = [w for w in members if len(w.recording.contacts_s)]
    steps = [
        replay.score_steps(w.recording, w.recording.time_s[r.step_ticks])
        for w, r in zip(members, results, strict=True)
        if w in contacts
    ]
    count = sum(score.contacts for score in steps)
    turns = [walking.turn_error(w, r) for w, r in zip(members, results, strict=True)]
    loops = [
        abs(r.rows["x_m"][-1] + 1j * r.rows["y_m"][-1]) / w.parts[0].true_m
        for w, r in zip(members, results, strict=True)
        if w.loop
    ]
    if verbose:
        for score, turn in zip(found, turns, strict=False):
            print(f"  {score.walk.recording.name:40} {100 * score.error:+6.1f} % turn {turn}")
    return Row(
        group,
        len({walk.person for walk in members}),
        len(found),
        float(errors(found).mean()),
        float(size.mean()),
        float(np.quantile(size, 0.9)),
        float(np.abs(errors(alone)).mean()),
        float(np.mean([score.square for score in found])),
        float(100.0 * np.mean([score.flagged > 0.5 for score in found])),
        mean_of(np.abs(errors(again))),
        mean_of([score.square for score in again]),
        100.0 * sum(score.found for score in steps) / count if count else None,
        100.0 * sum(score.extra for score in steps) / count if count else None,
        float(np.median(np.abs(turned[:, 0]))) if len(turned) else None,
        float(turned[:, 1].mean()) if len(turned) else None,
        mean_of(percent(loops)),
    )


def person_left_out(own: Sequence[Walk], fit: Fit) -> list[Score]:
    """A person's scores with constants from all other people, of the same set too."""
    identity = own[0].data_set, own[0].person
    choice = fit.without(lambda walk: (walk.data_set, walk.person) == identity)
    with walking.choose(choice):
        return [s for w in own for s in walking.scores(w, w.reckon(choice.gain))]


# --- surveyed points -----------------------------------------------------------------------------


def waypoint_figures(tracks: Sequence[tuple[Track, Track]]) -> Figures:
    """Errors from pairs of (estimate, places), both (n,) complex metres at the waypoints.

    The first two waypoints are spent on the alignment: the figures are of the others, in percent of
    the way along the waypoints. The best turn is fitted to all waypoints: what is left then is no
    matter of one angle.
    """
    whole, turned = [], []
    for estimate, places in tracks:
        way = np.abs(np.diff(places)).sum()
        error = np.abs(aligned(estimate, places) - places)
        good = np.isfinite(error) & (np.arange(len(places)) >= 2)
        whole.append(error[good] / way)
        other = np.abs(fitted(estimate, places) - places)
        turned.append(other[np.isfinite(other)][1:] / way)
    out: Figures = {"walks": len(tracks), "waypoints": sum(map(len, whole))}
    for name, parts in (("", whole), ("best_turn_", turned)):
        values = percent(np.concatenate(parts))
        out[f"{name}median_percent"] = float(np.median(values))
        out[f"{name}p90_percent"] = float(np.percentile(values, 90))
    return out


def waypoints(members: Sequence[Walk], choice: Choice | None = None) -> dict[str, Figures]:
    """Position errors without and with magnetometer, and of raw gyroscope with true distances."""
    kinds: dict[str, list[tuple[Track, Track]]] = {"plain": [], "magnetometer": [], "bound": []}
    gain = choice.gain if choice else None
    with walking.choose(choice or Choice((), 0.0)):
        for walk in members:
            assert walk.points is not None
            recording, (times_s, places) = walk.recording, walk.points
            field = recording.field_ut if np.isfinite(recording.field_ut).all() else None
            for name, used in (("plain", None), ("magnetometer", field)):
                rows = replay.reckon(recording.imu, used, step_gain=gain).rows
                track = rows["x_m"] + 1j * rows["y_m"]
                kinds[name].append((at_waypoints(recording, track, times_s), places))
            heading = gyro_heading_rad(recording)
            way = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(places)))))
            true_m = np.diff(np.interp(recording.time_s, times_s, way), prepend=0.0)
            track = np.cumsum(true_m * np.exp(1j * heading))
            kinds["bound"].append((at_waypoints(recording, track, times_s), places))
    return {name: waypoint_figures(tracks) for name, tracks in kinds.items()}


# --- walk_chest: no length is known, but walks were repeated --------------------------------------


def chest() -> Figures:
    """Corridor both ways, a repeated walk, and a sensor at rest."""
    out: Figures = {}
    lengths: dict[str, float] = {}
    repeated = []
    for folder in folders("walk_chest"):
        recording = replay.load(folder)
        result = replay.reckon(recording.imu)
        lengths[folder.name] = result.distance_m
        steps = int(result.rows["steps"][-1])
        if "K_calibration" in folder.name:
            repeated.append(result.distance_m)
            out[f"K_calibration_{folder.name[-5]}_steps"] = steps
        if folder.name in CORRIDOR:
            way = "there" if folder.name == CORRIDOR[0] else "back"
            out[f"corridor_{way}_m"], out[f"corridor_{way}_steps"] = result.distance_m, steps
        if "static" in folder.name.lower():
            out[f"{folder.name}_m"] = result.distance_m
    out["corridor_ratio_percent"] = 100.0 * (lengths[CORRIDOR[1]] / lengths[CORRIDOR[0]] - 1.0)
    spread = np.array(repeated) / np.mean(repeated) - 1.0
    out["K_calibration_worst_from_mean_percent"] = float(100.0 * np.abs(spread).max())
    return out


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


# --- the page -------------------------------------------------------------------------------------


def cell(value: float | None, digits: int = 1) -> str:
    """A number, or nothing where it is not known."""
    return "" if value is None else f"{value:.{digits}f}"


def table(rows: Sequence[Row]) -> str:
    """The figures of all groups as Markdown."""
    lines = [
        "|set|people, walks|mean|abs|tenth|person out|one walk|found, extra|NEES|flagged|",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        steps = "" if row.steps_found is None else f"{row.steps_found:.1f}, {row.steps_extra:.1f}"
        again = "" if row.calibrated is None else f", {row.calibrated_nees:.2f}"
        cells = [
            row.group,
            f"{row.people}, {row.parts}",
            f"{row.mean:+.1f}",
            cell(row.mean_abs),
            cell(row.worst_tenth),
            cell(row.person_left_out),
            cell(row.calibrated),
            steps,
            cell(row.nees, 2) + again,
            cell(row.flagged, 0),
        ]
        lines.append("|" + "|".join(cells) + "|")
    return "\n".join(lines)


def track_table(rows: Sequence[Row], found: Sequence[Walk], fit: Fit) -> str:
    """Turns, loops and surveyed points as Markdown."""
    lines = ["|set|figure|reached|", "|---|---|---|"]
    for row in rows:
        if row.turn_deg is not None:
            lines.append(
                f"|{row.group}|net turn, median; NEES|{row.turn_deg:.1f} deg; {row.turn_nees:.2f}|"
            )
        if row.loop is not None:
            lines.append(f"|{row.group}|end of a loop, of the way|{row.loop:.1f} %|")
    for group, members in walking.groups_of([walk for walk in found if walk.points]):
        figures = waypoints(members, fit.without_set(members[0].data_set))
        for name, words in (
            ("plain", "points, median / 90th percentile"),
            ("magnetometer", "with magnetometer"),
            ("bound", "raw gyroscope, true distances"),
        ):
            one = figures[name]
            lines.append(
                f"|{group}|{words}|{one['median_percent']:.1f} / {one['p90_percent']:.1f} %|"
            )
    return "\n".join(lines)


def write_page(path: Path, rows: Sequence[Row], found: Sequence[Walk], fit: Fit) -> None:
    """Replace what stands between the two marks of the page by the tables."""
    before, _, after = path.read_text().split(PLACE)
    final = fit.without(lambda walk: False)
    values = ", ".join(f"{n} {v:g}" for n, v in zip(walking.CONSTANTS, final.values, strict=True))
    text = (
        f"\n{table(rows)}\n\n{track_table(rows, found, fit)}\n\n"
        f"All walks together choose {values} and a gain of {final.gain:.2f}.\n"
    )
    path.write_text(f"{before}{PLACE}{text}{PLACE}{after}")


def main() -> None:
    """Evaluate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--verbose", action="store_true", help="a line for every walk")
    parser.add_argument("--registers", action="store_true", help="only this: through the chip")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--page", type=Path, metavar="FILE", help="renew the tables of the page")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="draw tracks into a folder")
    options = parser.parse_args()
    if options.registers:
        for name, value in registers(options.verbose).items():
            print(f"{name:40} {value:8.2f}")
        return
    found = walking.find(replay.DATA)
    fit = Fit(found)
    biases_rad_s = walking.chip_biases_rad_s(replay.DATA)
    rows = [judge(g, w, fit, biases_rad_s, options.verbose) for g, w in walking.groups_of(found)]
    print(table(rows))
    print(track_table(rows, found, fit))
    if (replay.DATA / "walk_chest").is_dir():
        print("\n".join(f"{name} {value:.2f}" for name, value in chest().items()))
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    if options.page is not None:
        write_page(options.page, rows, found, fit)
    if options.pictures is not None:
        import pictures

        pictures.draw(options.pictures)


if __name__ == "__main__":
    main()
