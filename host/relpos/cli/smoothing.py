"""The smoothed tracks of a recording that is played, computed in a process of their own."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from relpos.errors import interrupts_kept
from relpos.live.tracks import Tracks

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnProcess

NICE = 10
"""Playing and seeking come first."""


class Smoothing:
    """Smooths recordings, each by itself, from the first call on; returns the tracks once there.

    None means not yet; no tracks, that none could be computed.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = list(paths)
        self._process: SpawnProcess | None = None

    def __call__(self) -> Tracks | None:
        """Return the tracks, or None."""
        if self._process is None:
            self._start()
        try:
            return self._pipe.recv() if self._pipe.poll() else None
        except EOFError:
            return Tracks()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_smooth, args=(self._paths, theirs), name="relpos smoother", daemon=True
        )
        with interrupts_kept():
            self._process.start()
        theirs.close()

    def close(self) -> None:
        """End it."""
        if self._process is not None:
            self._pipe.close()
            self._process.kill()
            self._process.join()


def _smooth(paths: list[Path], pipe: Connection) -> None:
    """Body of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(NICE)
    tracks = Tracks()
    for path in paths:
        _add(path, tracks)
    pipe.send(tracks)


def _add(path: Path, tracks: Tracks) -> None:
    """Add a recording's tracks, moved onto those that its session had."""
    import numpy as np

    from relpos import api, fusion
    from relpos.errors import RelposError
    from relpos.evaluation.report.content import alignment
    from relpos.recording import open_recording
    from relpos.tracks import located_tracks

    recording = open_recording(path)
    about = recording.about
    # A file must not choose the code that runs.
    name = about.estimator if about is not None and about.estimator in fusion.SETTINGS else "bank"
    common = about is not None and about.initial == "common"
    try:
        result = api.fuse(recording.run, name, smooth=True, initial="common" if common else None)
    except RelposError:
        return
    smoothed, live = located_tracks(result.estimates), located_tracks(recording.estimates())
    # Where the start was unknown each has a frame of its own: they are laid over one another.
    onto = alignment(smoothed, live)
    for node, track in smoothed.items():
        points_m = onto(np.column_stack((track.x_m, track.y_m)))
        for time_s, (x_m, y_m) in zip(track.time_s, points_m, strict=True):
            tracks.add(node, float(time_s), float(x_m), float(y_m))
