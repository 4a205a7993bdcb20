"""The file that a recorder writes, and what becomes of it where the disk refuses.

Blocks are handed over whole and kept until the disk has confirmed them. A full disk is asked again:
the file goes on at the byte where it stopped. A file that cannot go on at all (its size limit, a
disk that was unplugged and is back) is followed by another part, FILE.part2.mcap, which begins with
the blocks that were not confirmed.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

from relpos.errors import DataError
from relpos.recording import container

NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


class Disk:
    """What is asked of the disk; tests put a worse one in its place."""

    def write(self, file: int, data: memoryview) -> int:
        """Write some of it; how much. OSError."""
        return os.write(file, data)

    def sync(self, file: int) -> None:
        """Return once what was written is on the disk. OSError."""
        os.fsync(file)


def part_path(path: Path, part: int) -> Path:
    """Where the ``part``-th part of a recording is."""
    return path if part == 1 else path.with_name(f"{path.stem}.part{part}{path.suffix}")


class Output:
    """Whole blocks to a file and its further parts.

    ``beginning(part)`` gives what each part begins with. DataError where ``path`` or a second part
    exists already, or cannot be made.
    """

    def __init__(self, path: Path, beginning: Callable[[int], bytes], disk: Disk) -> None:
        self._first = path
        self._beginning = beginning
        self._disk = disk
        self.part = 0
        self._handle = -1
        self._blocks: list[bytes] = []
        """Not confirmed yet."""
        self._written = 0
        """Bytes of them that the disk has taken."""
        self._confirmed = 0
        """Size of the file up to the last confirmed block."""
        second = part_path(path, 2)
        try:
            if second.exists():
                raise FileExistsError(errno.EEXIST, "", str(second))
            self._begin(1)
            self.flush()
        except FileExistsError as error:
            raise DataError(
                f"{error.filename} exists already: a recording is not overwritten"
            ) from None
        except OSError as error:
            raise DataError(f"{path}: cannot be recorded to: {error.strerror}") from None

    @property
    def path(self) -> Path:
        """The part that is being written."""
        return part_path(self._first, self.part)

    @property
    def waiting(self) -> bool:
        """Whether the disk has still to confirm something."""
        return bool(self._blocks)

    def put(self, block: bytes) -> None:
        """Hand over a block; it is written by :meth:`flush`."""
        self._blocks.append(block)

    def flush(self) -> None:
        """Have the disk take and confirm everything. OSError where it does not, for now."""
        try:
            self._flush()
        except OSError as error:
            if error.errno in NO_ROOM or not self._confirmed:
                raise
            self._begin(self.part + 1)
            self._flush()

    def _flush(self) -> None:
        if not self._blocks:
            return
        data = memoryview(b"".join(self._blocks))
        while self._written < len(data):
            self._written += self._disk.write(self._handle, data[self._written :])
        self._disk.sync(self._handle)
        self._confirmed += len(data)
        self._blocks, self._written = [], 0

    def _begin(self, part: int) -> None:
        """Begin a part; what is not confirmed goes there. OSError, and nothing has changed."""
        path = part_path(self._first, part)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        handle = os.open(path, flags, 0o666)
        start = self._beginning(part)
        try:
            # At once: a file of this name that is no recording would stand in everybody's way.
            if self._disk.write(handle, memoryview(start)) < len(start):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._disk.sync(handle)
            _sync_directory(path.parent)
        except OSError:
            os.close(handle)
            path.unlink(missing_ok=True)
            raise
        if part > 1:
            self._leave()
        self.part, self._handle, self._written = part, handle, 0
        self._confirmed = len(start)

    def _leave(self) -> None:
        """Close the present part as well as the disk allows; what is there stays readable."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, self._confirmed)
        with contextlib.suppress(OSError):
            os.close(self._handle)
        with contextlib.suppress(OSError, ValueError):
            container.finish(self.path)

    def close(self) -> bool:
        """Close the file, with the summary that viewers seek by; whether there was room for it."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._handle, self._confirmed)
        os.close(self._handle)
        try:
            container.finish(self.path)
        except OSError:
            return False
        return not self._blocks


def _sync_directory(directory: Path) -> None:
    """Have the disk confirm that a new file has its name; not every system can be asked."""
    with contextlib.suppress(OSError):
        handle = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
