"""CSV files: written whole, or line by line while a session runs.

An appended file keeps in memory what the disk does not take (it is full, or was pulled out) and
tries again, so that nothing is missing once there is room. Lines are written whole: a reader
during the session, or after a crash, finds at most the last one broken.
"""

from __future__ import annotations

import csv
import errno
import io
import math
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import BinaryIO

from relpos.files import open_output, write_whole

WRITE_EVERY_S = 0.2
MOST_WAITING_BYTES = 64 << 20
"""Half an hour of twenty nodes. What comes while so much waits is lost, and counted."""


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write one CSV file; None and NaN become empty cells, a bool 0 or 1, floats in full."""
    with open_output(path) as file:
        text = io.TextIOWrapper(file, "utf-8", "replace", newline="", write_through=True)
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([_cell(value) for value in row] for row in rows)
        text.detach()


class AppendedTable:
    """A CSV file that grows; one that is not ``wanted`` is there once it has a row.

    Making it begins the file anew, or raises OSError. Later failures are in ``error``.
    """

    def __init__(self, path: Path, header: Sequence[str], *, wanted: bool = True) -> None:
        self.path = path
        self.error: OSError | None = None
        self.lost_rows = 0
        self._file: BinaryIO | None = None
        self._text = io.StringIO()
        self._writer = csv.writer(self._text, lineterminator="\n")
        self._writer.writerow(header)
        self._waiting = b""
        self._tried_s = -math.inf
        self._wanted = wanted
        path.unlink(missing_ok=True)
        if wanted:
            self.flush()
            if self.error is not None:
                raise self.error

    @property
    def exists(self) -> bool:
        """Whether there is such a file."""
        return self._file is not None

    def add(self, rows: Iterable[Iterable[object]]) -> None:
        """Append rows; on disk with the next call or that of :meth:`tick`, within 0.2 s."""
        for row in rows:
            if len(self._waiting) > MOST_WAITING_BYTES:
                self.lost_rows += 1
                continue
            self._writer.writerow([_cell(value) for value in row])
            self._wanted = True
        self.tick()

    def tick(self) -> None:
        """Write what waits, if that is due."""
        waits = self._waiting or self._text.tell()
        if waits and time.monotonic() >= self._tried_s + WRITE_EVERY_S:
            self.flush()

    def flush(self) -> None:
        """Try to write what waits; ``error`` says why it does not go, None where it does."""
        if not self._wanted:
            return
        self._tried_s = time.monotonic()
        # A file's name that a notice tells need not be text.
        self._waiting += self._text.getvalue().encode(errors="replace")
        self._text.seek(0)
        self._text.truncate()
        try:
            if self._file is None:
                self._file = self._begun()
            elif not self.path.exists():
                # Somebody deleted it: rows would go nowhere without any error.
                raise FileNotFoundError(errno.ENOENT, "was deleted", str(self.path))
            self._write(self._file)
        except OSError as error:
            error.filename = error.filename or str(self.path)
            self.error = error
            return
        self.error = None

    def _begun(self) -> BinaryIO:
        """Return the file with its header: a process killed meanwhile leaves none without."""
        header, rest = self._waiting.split(b"\n", 1)
        write_whole(self.path, header + b"\n")
        self._waiting = rest
        return self.path.open("ab", buffering=0)

    def _write(self, file: BinaryIO) -> None:
        """Write what waits; of what a disk that is nearly full takes, whole lines stay."""
        done = 0
        try:
            while done < len(self._waiting):
                done += file.write(self._waiting[done:]) or 0
        except OSError:
            whole = self._waiting.rfind(b"\n", 0, done) + 1
            file.truncate(file.seek(whole - done, io.SEEK_CUR))
            done = whole
            raise
        finally:
            self._waiting = self._waiting[done:]

    def close(self) -> None:
        """Write what waits and end; OSError where it does not go."""
        self.flush()
        if self._file is not None:
            self._file.close()
        if self.error is not None:
            raise self.error


def close_all(tables: Iterable[AppendedTable]) -> None:
    """Close every one, then raise the first OSError there was."""
    failed: OSError | None = None
    for table in tables:
        try:
            table.close()
        except OSError as error:
            failed = failed or error
    if failed is not None:
        raise failed


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return int(value)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return value
