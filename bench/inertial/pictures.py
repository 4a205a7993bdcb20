"""Tracks as pictures for docs/deadreckoning.md."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import replay
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import recordings
from recordings import Track

GOOD_WAYPOINTS = "085"  # 100 m, 15 waypoints, 89 s
BAD_WAYPOINTS = "072"  # the first leg is taken wrong, and 25 % too long
LOST_SAMPLES = "5-6"
SOUND_SAMPLES = "5-4"


def track_of(recording: replay.Recording, *, magnetometer: bool = False) -> Track:
    """Positions (n,) in complex metres as the library has them."""
    field = recording.field_ut if magnetometer else None
    rows = replay.reckon(recording.imu, field, leg_length_m=recording.leg_length_m).rows
    return np.asarray(rows["x_m"] + 1j * rows["y_m"])


def _axes(width: float, height: float, columns: int) -> tuple[Figure, list[Axes]]:
    figure, axes = plt.subplots(
        1, columns, figsize=(width, height), squeeze=False, layout="constrained"
    )
    for one in axes[0]:
        one.set_aspect("equal", adjustable="datalim")
        one.grid(alpha=0.3)
        one.set_xlabel("x / m")
        one.tick_params(labelsize=8)
    axes[0][0].set_ylabel("y / m")
    return figure, list(axes[0])


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)


def corridor(path: Path) -> None:
    """The same corridor both ways, from where it is entered."""
    figure, (axes,) = _axes(7.5, 3.0, 1)
    for name, label in zip(recordings.CORRIDOR, ("there", "back"), strict=True):
        recording = replay.load(replay.DATA / "walk_chest" / name)
        track = track_of(recording)
        # Both from the same end: the way back is turned round and set on its own last position.
        track = track if label == "there" else (track[-1] - track)[::-1]
        heading = np.angle(track[len(track) // 8] - track[0])
        track = (track - track[0]) * np.exp(-1j * heading)
        axes.plot(track.real, track.imag, label=f"{label}", lw=1.2)
    axes.legend(fontsize=8)
    axes.set_title("walk_chest: one corridor both ways, gyroscope alone", fontsize=9)
    _save(figure, path)


def waypoints(path: Path) -> None:
    """A waypoint walk that works and one that does not."""
    figure, both = _axes(9.0, 4.2, 2)
    for axes, name in zip(both, (GOOD_WAYPOINTS, BAD_WAYPOINTS), strict=True):
        folder = replay.DATA / "walk_handheld_waypoints" / name
        recording = replay.load(folder)
        times_s, places = recordings.waypoints_of(folder)
        axes.plot(places.real - places[0].real, places.imag - places[0].imag, "k.--", label="truth")
        for magnetometer, label in ((False, "gyroscope"), (True, "with magnetometer")):
            track = track_of(recording, magnetometer=magnetometer)
            at = recordings.at_waypoints(recording, track, times_s)
            turn = (recordings.aligned(at, places)[1] - places[0]) / (at[1] - at[0])
            moved = (track - at[0]) * turn
            lines = axes.plot(moved.real, moved.imag, lw=1.0, label=label)
            marks = (at - at[0]) * turn
            axes.plot(marks.real, marks.imag, ".", color=lines[0].get_color())
        axes.set_title(f"walk_handheld_waypoints/{name}", fontsize=9)
        axes.legend(fontsize=8)
    _save(figure, path)


def lower_back(path: Path) -> None:
    """10 m, U-turn, 10 m: a sound recording, and one that lost samples on the way back."""
    figure, both = _axes(9.0, 3.0, 2)
    for axes, name in zip(both, (SOUND_SAMPLES, LOST_SAMPLES), strict=True):
        recording = replay.load(replay.DATA / "walk_lowerback_20m" / name)
        track = track_of(recording)
        axes.plot(track.real, track.imag, lw=1.2)
        axes.plot([0, 10], [0, 0], "k--", lw=0.8)
        axes.plot(track[-1].real, track[-1].imag, "o", ms=4)
        note = ", samples lost in the source" if name == LOST_SAMPLES else ""
        axes.set_title(f"walk_lowerback_20m/{name}{note}", fontsize=9)
    _save(figure, path)


def draw(folder: Path) -> None:
    """Write all pictures into ``folder``."""
    mpl.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    corridor(folder / "deadreckoning-corridor.png")
    waypoints(folder / "deadreckoning-waypoints.png")
    lower_back(folder / "deadreckoning-lowerback.png")
