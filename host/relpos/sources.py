"""Where data comes from: a run directory, a recording (MCAP) or a serial port.

This module stands above :mod:`relpos.runs` and :mod:`relpos.recording`, which do not know each
other's files; :func:`relpos.load` and the commands choose here.
"""

from __future__ import annotations

from pathlib import Path

from relpos.errors import DataError
from relpos.recording import is_recording, open_recording
from relpos.runs import Run, load_run


def load(path: Path | str) -> Run:
    """Read a run directory, or a recording as a run. DataError names the first fault."""
    if is_recording(path):
        return open_recording(path).run
    path = Path(path)
    if path.is_dir():
        return load_run(path)
    if path.exists():
        raise DataError(f"{path}: neither a run directory nor a recording (.mcap)")
    raise DataError(f"{path}: no such run directory or recording")


def is_port(source: str) -> bool:
    """Return whether the source can only be a serial port: a device, a pyserial URL, a COM name."""
    if "://" in source or (source.upper().startswith("COM") and source[3:].isdigit()):
        return True
    path = Path(source)
    return path.is_char_device() or (not path.exists() and path.is_relative_to("/dev"))


__all__ = ["is_port", "is_recording", "load"]
