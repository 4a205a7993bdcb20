"""The file that a recorder writes, and what becomes of it where the disk refuses.

Blocks are handed over whole, written at once, and kept until the disk has confirmed them. A full
disk is asked again: the file goes on at the byte where it stopped. A file that cannot go on at all
(its size limit, a disk that was unplugged and is back) is followed by another part,
FILE.part2.mcap, which begins with the blocks that were not confirmed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Condition, Thread

from relpos.errors import DataError
from relpos.files import sync_folder
from relpos.recording import container

NO_ROOM = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
SYNC_EVERY_S = 0.4
CLOSE_RETRY_S = 0.1
MOST_UNCONFIRMED = 64 << 20
"""Bytes written that the disk has not confirmed: beyond, the recorder's queue grows instead."""


class Disk:
    """Calls to the disk; tests replace them by failing ones."""

    def write(self, file: int, data: memoryview) -> int:
        """Write some of it; how much. OSError."""
        return os.write(file, data)

    def sync(self, file: int) -> None:
        """Return once what was written is on the disk. OSError."""
        os.fsync(file)


def part_path(path: Path, part: int) -> Path:
    """Return the path of the ``part``-th part of a recording."""
    return path if part == 1 else path.with_name(f"{path.stem}.part{part}{path.suffix}")


def parts_of(path: Path) -> Iterator[Path]:
    """Yield a recording's file, and those that may be its further parts."""
    number, part = 1, path
    while number == 1 or part.exists():
        yield part
        number += 1
        part = part_path(path, number)


class _Syncer:
    """Has the disk confirm a file, in a thread: a write never waits for the disk to be done.

    Without it a slow disk would keep from the file what a killed process could have left there.
    """

    def __init__(self, disk: Disk, handle: int, size: int) -> None:
        self.handle = handle
        self._disk = disk
        self._wanted = size
        self._confirmed = size
        self._since_s: float | None = None
        self._error: OSError | None = None
        self._ended = self._hurry = False
        self._changed = Condition()
        Thread(target=self._run, name="disk", daemon=True).start()

    def ask(self, size: int) -> None:
        """Request confirmation of the file up to ``size``."""
        with self._changed:
            self._wanted = size
            if self._since_s is None and size > self._confirmed:
                self._since_s = time.monotonic()
            self._changed.notify_all()

    def confirmed(self) -> int:
        """Size that was confirmed. OSError, once, where the disk has refused since."""
        with self._changed:
            error, self._error = self._error, None
            if error is not None:
                raise error
            return self._confirmed

    def late_s(self) -> float:
        """Return for how long the oldest unconfirmed bytes wait."""
        with self._changed:
            return 0.0 if self._since_s is None else time.monotonic() - self._since_s

    def wait(self, size: int, timeout_s: float) -> bool:
        """Wait until it has confirmed ``size``; whether it has."""
        with self._changed:
            self._hurry = True
            self._changed.notify_all()
            self._changed.wait_for(
                lambda: self._confirmed >= size or self._error is not None, timeout_s
            )
            return self._confirmed >= size

    def end(self) -> None:
        """Close the file once nothing is being confirmed any more."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                # In between others may use the disk, and flash memory lasts longer.
                self._changed.wait_for(lambda: self._ended or self._hurry, SYNC_EVERY_S)
                self._changed.wait_for(lambda: self._ended or self._wanted > self._confirmed)
                if self._ended:
                    break
                wanted = self._wanted
            error: OSError | None = None
            asked_s = time.monotonic()
            try:
                self._disk.sync(self.handle)
            except OSError as refused:
                error = refused
            with self._changed:
                if error is None:
                    self._confirmed = wanted
                    self._since_s = asked_s if self._wanted > wanted else None
                else:
                    # What the system held may be gone with this: it is written again.
                    self._error = error
                    self._wanted = self._confirmed
                    self._since_s = None
                self._changed.notify_all()
        with contextlib.suppress(OSError):
            os.close(self.handle)


class Output:
    """Writes whole blocks to a file and its further parts.

    ``beginning(part)`` gives what each part begins with. DataError where ``path`` or a second part
    exists already, or cannot be made.
    """

    def __init__(self, path: Path, beginning: Callable[[int], bytes], disk: Disk) -> None:
        self._first = path
        self._beginning = beginning
        self._disk = disk
        self.part = 0
        self._syncer: _Syncer
        self._blocks: list[bytes] = []
        """Not confirmed yet, the first of them at ``_start`` of the file."""
        self._start = 0
        self._written = 0
        """Bytes of them that the system has taken."""
        second = part_path(path, 2)
        try:
            if second.exists():
                raise FileExistsError(errno.EEXIST, "", str(second))
            path.parent.mkdir(parents=True, exist_ok=True)
            self._begin(1)
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
        """Whether something is not written yet, or too much not confirmed."""
        size = sum(map(len, self._blocks))
        return size > self._written or size > MOST_UNCONFIRMED

    def late_s(self) -> float:
        """Return for how long written bytes wait for the disk's confirmation."""
        return self._syncer.late_s()

    def put(self, block: bytes) -> None:
        """Hand over a block; it is written by :meth:`flush`."""
        self._blocks.append(block)

    def flush(self) -> None:
        """Write everything, and have it confirmed by and by. OSError where it cannot be, now."""
        try:
            self._write()
        except OSError as error:
            if error.errno in NO_ROOM:
                raise
            if error.errno == errno.EFBIG:
                self._truncate_to_whole()
            self._begin(self.part + 1)
            self._write()

    def _write(self) -> None:
        handle = self._syncer.handle
        try:
            confirmed = self._syncer.confirmed()
        except OSError:
            os.lseek(handle, self._start, os.SEEK_SET)
            self._written = 0
            raise
        while self._blocks and self._start + len(self._blocks[0]) <= confirmed:
            size = len(self._blocks.pop(0))
            self._start += size
            self._written -= size
        before = 0
        for block in self._blocks:
            while (at := self._written - before) < len(block):
                self._written += self._disk.write(handle, memoryview(block)[at:])
            before += len(block)
        self._syncer.ask(self._start + self._written)

    def _begin(self, part: int) -> None:
        """Begin a part; what is not confirmed goes there. OSError, and nothing has changed."""
        path = part_path(self._first, part)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        handle = os.open(path, flags, 0o666)
        start = self._beginning(part)
        try:
            # At once: a file of this name that is no recording would block the name.
            if self._disk.write(handle, memoryview(start)) < len(start):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._disk.sync(handle)
            sync_folder(path.parent)
        except OSError:
            os.close(handle)
            path.unlink(missing_ok=True)
            raise
        if part > 1:
            self._cut()
            self._syncer.end()
        self.part, self._start, self._written = part, len(start), 0
        self._syncer = _Syncer(self._disk, handle, len(start))

    def _whole(self) -> int:
        """Return how many blocks are written whole."""
        size = count = 0
        for block in self._blocks:
            size += len(block)
            if size > self._written:
                break
            count += 1
        return count

    def _truncate_to_whole(self) -> None:
        """Leave in a file that may not grow what is whole in it, if the disk confirms it."""
        count = self._whole()
        size = sum(map(len, self._blocks[:count]))
        with contextlib.suppress(OSError):
            os.ftruncate(self._syncer.handle, self._start + size)
            self._disk.sync(self._syncer.handle)
            os.lseek(self._syncer.handle, self._start + size, os.SEEK_SET)
            self._start += size
            self._written = 0
            del self._blocks[:count]

    def _cut(self) -> None:
        """End the present part with its last confirmed block."""
        with contextlib.suppress(OSError):
            os.ftruncate(self._syncer.handle, self._start)

    def close(self, timeout_s: float) -> bool:
        """Close the file, with the summary that viewers seek by; whether all of it is on the disk.

        Only what the disk confirms in time counts; of a block half of which is there, nothing.
        """
        until_s = time.monotonic() + timeout_s
        confirmed = False
        while not confirmed:
            # Once more also where the disk has refused to confirm: it is written again, then.
            with contextlib.suppress(OSError):
                self.flush()
            whole = self._start + sum(map(len, self._blocks[: self._whole()]))
            left_s = until_s - time.monotonic()
            confirmed = not self.waiting and self._syncer.wait(whole, max(left_s, 0.0))
            if left_s <= 0.0:
                break
            if not confirmed:
                time.sleep(min(left_s, CLOSE_RETRY_S))
        with contextlib.suppress(OSError):
            os.ftruncate(self._syncer.handle, whole)
            confirmed = confirmed or self._syncer.wait(whole, 0.0)
        complete = not self.waiting and confirmed
        self._syncer.end()
        if not confirmed:
            return False
        try:
            container.finish(self.path)
        except OSError:
            return False
        return complete
