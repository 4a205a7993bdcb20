"""Writing files: whole, so that after a kill or a power cut it is the old one or the new one."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def printable(text: str) -> str:
    """Leave out what XML cannot hold: control characters."""
    return "".join(letter for letter in text if letter.isprintable())


def write_whole(path: Path, data: bytes, *, sync: bool = False, mode: int = 0o666) -> None:
    """Write a file beside the one that is there, and put it in its place; OSError.

    With ``sync`` both are on the disk when this returns. A link in the file's place is not
    followed. After a failure (a full disk) the old file is there and nothing beside it.
    """
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    try:
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        error.filename = error.filename or str(path)
        with contextlib.suppress(OSError):
            beside.unlink()
        raise
    if sync:
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Let a new or replaced file keep its place after a power cut; not every system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
