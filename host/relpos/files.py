"""Writing files: whole, so that after a kill or a power cut it is the old one or the new one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


def printable(text: str) -> str:
    """Leave out what XML cannot hold: control characters."""
    return "".join(letter for letter in text if letter.isprintable())


def displayable(text: str) -> str:
    """Show as ``?`` what is no text: bytes of a file's name that are not UTF-8."""
    return text.encode("utf-8", "replace").decode()


def write_whole(path: Path, data: bytes, *, sync: bool = False, mode: int = 0o666) -> None:
    """Write a file beside the one that is there, and put it in its place; OSError.

    With ``sync`` both are on the disk when this returns. A link in the file's place is not
    followed. After a failure (a full disk) the old file is there and nothing beside it.
    """
    with _replacing(path, sync=sync, mode=mode) as file:
        file.write(data)


def write_output(path: Path, text: str) -> None:
    """Write a file that a user has named as a whole; see :func:`open_output`."""
    with open_output(path) as file:
        file.write(text.encode())


@contextlib.contextmanager
def open_output(path: Path) -> Iterator[BinaryIO]:
    """Write a file that a user has named, as :func:`write_whole` does; OSError names it.

    A link is followed, and what is no file (``/dev/stdout``, a pipe) is written into.
    """
    target = path.resolve() if path.is_symlink() else path
    try:
        if target.exists() and not target.is_file():
            with target.open("wb") as file:
                yield file
        else:
            with _replacing(target) as file:
                yield file
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


@contextlib.contextmanager
def _replacing(path: Path, *, sync: bool = False, mode: int = 0o666) -> Iterator[BinaryIO]:
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    try:
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(handle, "wb") as file:
            yield file
            if sync:
                file.flush()
                os.fsync(file.fileno())
        beside.replace(path)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename in (None, str(beside)):
            error.filename = str(path)
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
