"""Teams of real walkers: their recordings as one mission each, played through the firmware.

``simulation.recorded_team`` lays out what comes back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from relpos.errors import DataError
from relpos.runs import Run, load_run
from relpos.runs.imu import ImuRecording
from relpos.simulation.recorded_team import Wearer, make_team, settings_of, true_tracks

from .deadreckoning import WearerSettings, leg_length_m, play
from .surroundings import FloatArray

PAUSE_S = 2.0
"""Between two recordings the wearer stands so long."""
QUIET_S = 1.0
"""The quietest second of a recording, to and fro, is what its sensor shows meanwhile."""


def runs_of(wearer: str) -> list[Run]:
    """The recordings of one wearer: a run directory, a folder of them, or a pattern of either."""
    given = Path(wearer)
    found = sorted(given.parent.glob(given.name)) if given.name else [given]
    if not found:
        raise DataError(f"{wearer}: no such folder")
    runs = []
    for path in found:
        if (path / "run.toml").exists():
            runs.append(load_run(path))
        else:
            runs += [load_run(inside.parent) for inside in sorted(path.glob("*/run.toml"))]
    runs = [run for run in runs if run.load_imu()]
    if not runs:
        raise DataError(f"{wearer}: no run directory with imu.csv")
    return runs


def _towards(source: FloatArray, target: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes one direction to another."""
    a, b = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -0.999:
        raise DataError("a recording is upside down against the one before it")
    cross = np.cross(np.eye(3), axis)
    rotation: FloatArray = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    return rotation


def one_mission(
    recordings: Sequence[ImuRecording], seconds: float
) -> tuple[ImuRecording, list[tuple[int, float]]]:
    """Recordings of one wearer as one, again and again until it is long enough.

    Each is turned such that gravity goes on from where it was. Returns with it, for each part, its
    place in ``recordings`` and what its clock is behind the mission's.
    """
    parts: list[FloatArray] = []
    placed: list[tuple[int, float]] = []
    now_s, up = 0.0, None
    while now_s < seconds:
        k = len(placed) % len(recordings)
        one = recordings[k]
        period_s = float(np.median(np.diff(one.time_s)))
        short = max(round(0.5 / period_s), 1)
        # (n, 2, 3): force and rate. The field of another place says nothing on this track.
        vectors = np.stack([one.acceleration_m_s2, one.angular_rate_rad_s], axis=1)
        if up is not None:
            vectors = vectors @ _towards(vectors[:short, 0].mean(axis=0), up).T
        time_s = one.time_s - one.time_s[0] + now_s
        window = min(max(round(QUIET_S / period_s), 2), len(time_s))
        sums = np.cumsum(np.r_[[np.zeros(3)], vectors[:, 1] ** 2], axis=0).sum(axis=1)
        quiet = int(np.argmin(sums[window:] - sums[:-window]))
        still = vectors[quiet : quiet + window]
        last = vectors[-short:, 0].mean(axis=0)
        still = still @ _towards(still[:, 0].mean(axis=0), last).T
        count = round(PAUSE_S / period_s)
        still = np.tile(np.r_[still, still[::-1]], (math.ceil(count / window), 1, 1))[:count]
        pause_s = time_s[-1] + period_s * np.arange(1, count + 1)
        placed.append((k, now_s - float(one.time_s[0])))
        parts.append(
            np.column_stack([np.r_[time_s, pause_s], np.r_[vectors, still].reshape(-1, 6)])
        )
        now_s = float(pause_s[-1]) + period_s
        up = last
    rows = np.concatenate(parts)
    no_field = np.full((len(rows), 3), np.nan)
    return ImuRecording(rows[:, 0], rows[:, 1:4], rows[:, 4:7], no_field), placed


def record_team(
    wearers: Sequence[str], seed: int = 0, overrides: Mapping[str, str | float] | None = None
) -> Run:
    """Play every wearer's recordings through the firmware and lay the wearers out as a team.

    DataError where a recording has no inertial data or nothing says its track.
    """
    settings = settings_of(overrides)
    # All of them first: playing one takes a while.
    recorded = [runs_of(wearer) for wearer in wearers]
    if len(recorded) < 2:
        raise DataError("a team needs two wearers or more, each with recordings of its own")
    team = []
    for number, runs in enumerate(recorded):
        # Wearers begin with different recordings, or two of the same folder would walk alike.
        first = number % len(runs)
        runs = runs[first:] + runs[:first]
        tracks, recordings = [true_tracks(run) for run in runs], []
        for run in runs:
            nodes = list(run.load_imu().values())
            if len(nodes) != 1:
                raise DataError(f"{run.name}: a recording for a team has one node")
            recordings += nodes
        mission, placed = one_mission(recordings, settings.seconds)
        leg_m = leg_length_m(runs[0], next(iter(runs[0].load_imu())))
        motions = play(1, mission, WearerSettings(leg_m)).motions
        team.append(
            Wearer(motions, [track.later(shift_s) for k, shift_s in placed for track in tracks[k]])
        )
    chosen = "".join(f" --set {key}={value}" for key, value in (overrides or {}).items())
    source = f"relpos simulate --recordings {' '.join(wearers)} --seed {seed}{chosen}"
    return make_team(team, settings, seed, source)
