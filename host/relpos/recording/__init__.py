"""Recordings: a session in an MCAP file, with all received bytes, measurements and estimates.

:class:`~relpos.recording.recorder.Recorder` writes blocks in a thread of its own, so that neither
a slow disk nor a power failure costs more than a second;
:class:`~relpos.recording.reader.Recording`
reads them back, closed or not. :mod:`relpos.recording.replay` sends the bytes through the link
again, which gives the same estimates. The topics are Foxglove's or JSON with a schema, and
:mod:`relpos.recording.viewer` serves them to Foxglove's viewer. The libraries are the extra
``recording``, loaded when they are needed; begin reading with :mod:`relpos.recording.topics`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from relpos.errors import DataError
from relpos.extras import missing_extra

if TYPE_CHECKING:
    from relpos.fusion.estimator import Estimate
    from relpos.recording.about import About
    from relpos.recording.reader import Recording
    from relpos.recording.recorder import Recorder
    from relpos.recording.viewer import FoxgloveServer
    from relpos.runs import Run

SUFFIX = ".mcap"
MAGIC = b"\x89MCAP0\r\n"


def is_recording(path: Path | str) -> bool:
    """Return whether a file is a recording, by its name or its first bytes."""
    path = Path(path)
    if not path.is_file():
        return False
    if path.suffix.lower() == SUFFIX:
        return True
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def check(path: Path | None) -> None:
    """Refuse early: DataError where ``path`` exists already, RelposError where the extra lacks."""
    _check_installed()
    if path is not None and path.exists():
        raise DataError(f"{path} exists already: a recording is not overwritten")


def make_recorder(path: Path | str, about: About) -> Recorder:
    """A sink that records a session to ``path``. DataError where that exists or cannot be made."""
    _check_installed()
    from relpos.recording.recorder import Recorder

    return Recorder(path, about)


def open_recording(path: Path | str) -> Recording:
    """Read a recording, closed or not. DataError where it is none."""
    _check_installed()
    from relpos.recording.reader import Recording

    return Recording.open(Path(path))


def save_recording(
    path: Path | str,
    run: Run,
    estimates: Sequence[Estimate] = (),
    *,
    started_unix_ns: int = 0,
    source: Recording | None = None,
) -> list[str]:
    """Write a run and its estimates to a new recording; return remarks about it.

    ``source`` is the recording that the run was read from: what was received is taken over as it
    is, and so is everything else but truth and landmarks; of one that was not closed, whatever can
    be read. DataError where ``path`` exists or cannot be written.
    """
    _check_installed()
    from relpos.recording import saving

    return saving.save(Path(path), run, estimates, started_unix_ns, source)


def serve_foxglove(listen: str, about: About) -> FoxgloveServer:
    """A sink that shows a session to Foxglove's viewer at ``HOST:PORT``. DeviceError if taken."""
    _check_installed()
    from relpos.recording.viewer import FoxgloveServer

    return FoxgloveServer(listen, about)


def _check_installed() -> None:
    try:
        import foxglove  # noqa: F401
        import mcap  # noqa: F401
    except ImportError as error:
        raise missing_extra(str(error.name), "recording") from None
