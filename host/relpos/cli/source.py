"""What ``relpos fuse`` is given: a run directory, a recording or a port."""

from __future__ import annotations

from pathlib import Path

from relpos.errors import DataError


def is_port(source: str) -> bool:
    """Tell whether the source can only be a serial port: a device, a pyserial URL, a COM name."""
    if "://" in source or (source.upper().startswith("COM") and source[3:].isdigit()):
        return True
    path = Path(source)
    return path.is_char_device() or (not path.exists() and path.is_relative_to("/dev"))


def check_recording(source: str) -> Path:
    """Return the run directory that the source names; DataError says what it is instead."""
    path = Path(source)
    if path.is_dir():
        return path
    if path.exists():
        raise DataError(f"{source}: neither a run directory nor a recording (.mcap)")
    raise DataError(f"{source}: no such run directory or port")
