"""Strict reading of one CSV file: a wrong cell is named by file, line and column.

The standard library's ``csv`` does the splitting; this adds what a recording needs: plain or
gzipped, columns by name in any order, unknown ones ignored, optional cells empty, no NaN.
"""

from __future__ import annotations

import csv
import gzip
import io
import logging
import math
import os
import types
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Union, get_args, get_origin

from relpos.errors import DataError
from relpos.measurements import BOUNDS, LEAST_SIGMA

_LOG = logging.getLogger(__name__)

MOST_LINE_BYTES = 64 << 20
"""A GeoJSON file is one line."""
MOST_UNPACKED_BYTES = 64 << 20
MOST_RATIO = 50
"""A gzipped file may unpack to the one and, on top, to so many times its size; recordings reach
twenty."""
_PART_BYTES = 1 << 20
MOST = 1e100
"""Of a number without bounds of its own."""

Parser = Callable[[str], Any]


@dataclass(frozen=True)
class Column:
    """One column of a table: its name, how a cell is read, and whether it may be missing.

    A parser raises ``ValueError`` with the words that follow the cell: ``"is not a number"``.
    """

    name: str
    parse: Parser
    optional: bool = False


def number(text: str) -> float:
    """Read a finite decimal number whose square is one, too.

    NaN and infinity are refused: a recording has no such value.
    """
    value = _finite(text)
    if abs(value) > MOST:
        raise ValueError("is too large")
    return value


def _finite(text: str) -> float:
    try:
        value = math.nan if "_" in text else float(text)
    except ValueError:
        raise ValueError("is not a number") from None
    if not math.isfinite(value):
        raise ValueError("is not a finite number")
    return value


def not_negative(text: str) -> float:
    """Read a standard deviation or a length."""
    value = number(text)
    if value < 0.0:
        raise ValueError("is negative")
    return value


def bounded(name: str) -> Parser:
    """Return the parser of a quantity that :data:`relpos.measurements.BOUNDS` names."""
    return lambda text: within_bounds(name, _finite(text))


def bounded_whole(name: str) -> Parser:
    """Return the same of a quantity that is counted."""
    return lambda text: int(within_bounds(name, whole(text)))


def within_bounds(name: str, value: float) -> float:
    """Return the value of the quantity ``name``; ValueError where it is beyond its bounds."""
    low, high = BOUNDS.get(name, (-math.inf, math.inf))
    if name.startswith("sigma") and 0.0 < value < LEAST_SIGMA:
        raise ValueError(f"is less than {LEAST_SIGMA:g}, and not 0")
    if low <= value <= high:
        return value
    if low == 0.0 and value < 0.0:
        raise ValueError("is negative")
    raise ValueError(f"is not between {low:g} and {high:g}")


def plain_type(hint: Any) -> tuple[bool, Any]:
    """Return whether the type of a field allows None, and the type beside it."""
    if get_origin(hint) in (Union, types.UnionType):
        return True, next(part for part in get_args(hint) if part is not type(None))
    return False, hint


MOST_WHOLE = 2**53 - 1
"""Of greater ones, two that follow each other may be one number of 64 bits."""


def whole(text: str) -> int:
    """Read a whole number; ``3.0`` is one, as spreadsheets write it."""
    try:
        value = number(text)
    except ValueError:
        raise ValueError("is not a whole number") from None
    if value != int(value):
        raise ValueError("is not a whole number")
    if abs(value) > MOST_WHOLE:
        raise ValueError(f"is greater than {MOST_WHOLE}")
    return int(value)


def node_id(text: str) -> int:
    """Read a node's id, which is never negative."""
    value = whole(text)
    if value < 0:
        raise ValueError("is no node id")
    return value


def flag(text: str) -> bool:
    """Read 0 or 1, or false or true."""
    try:
        return {"0": False, "1": True, "false": False, "true": True}[text.lower()]
    except KeyError:
        raise ValueError("is neither 0 nor 1") from None


def find_table(directory: Path, name: str) -> Path | None:
    """Return the file of a table: ``NAME`` or ``NAME.gz``, or None; both at once are refused."""
    # A link to where nothing is (a disk that was taken out) is no missing table.
    found = [path for path in _files_of(directory, name) if os.path.lexists(path)]
    if len(found) == 2:
        raise DataError(f"{directory}: both {name} and {name}.gz are there; which one counts?")
    return found[0] if found else None


def remove_table(directory: Path, name: str) -> None:
    """Remove the file of a table that an earlier run or estimate left, packed or not."""
    for path in _files_of(directory, name):
        path.unlink(missing_ok=True)


def _files_of(directory: Path, name: str) -> tuple[Path, Path]:
    return directory / name, directory / f"{name}.gz"


def read_text(path: Path, most_bytes: int | None = None) -> str:
    """Read a whole file as text, unpacked where it is gzipped; DataError in one line otherwise.

    Somebody else's file takes no more memory than a file of its size deserves: a device, a line
    longer than :data:`MOST_LINE_BYTES` and a gzip file that unpacks to a multiple are refused.
    """
    try:
        if not path.is_file():
            raise DataError(f"{path}: cannot be read: not a regular file")
        packed = path.suffix == ".gz"
        if most_bytes is None:
            ratio = MOST_RATIO if packed else 1
            most_bytes = MOST_UNPACKED_BYTES + ratio * path.stat().st_size
        with gzip.open(path) if packed else path.open("rb") as file:
            data = _read_lines(path, file, most_bytes)
    except (EOFError, gzip.BadGzipFile, zlib.error):
        raise DataError(f"{path}: the gzip file is truncated or damaged") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if "unexpected end" in error.reason:  # a kill cut a character off
            return data[: error.start].decode("utf-8-sig")
        line = data.count(b"\n", 0, error.start) + 1
        raise DataError(f"{path}: line {line}: not UTF-8 text") from None


def _read_lines(path: Path, file: Any, most_bytes: int) -> bytearray:
    data, line_bytes = bytearray(), 0
    while part := file.read(_PART_BYTES):
        data += part
        end = max(part.rfind(b"\n"), part.rfind(b"\r"))
        line_bytes = len(part) - end - 1 if end >= 0 else line_bytes + len(part)
        if line_bytes > MOST_LINE_BYTES:
            line = data.count(b"\n") + 1
            raise DataError(f"{path}: line {line}: longer than {MOST_LINE_BYTES >> 20} MB")
        if len(data) > most_bytes:
            raise DataError(f"{path}: more than {most_bytes >> 10} kB of text")
    return data


def numbered_rows(
    path: Path, text: str, columns: Sequence[Column], counters: Counter[str] | None = None
) -> Iterator[tuple[int, tuple[Any, ...]]]:
    """Yield the number of the line that a row ends on, and its cells in the order of ``columns``.

    None stands for a missing option; lines without any content are skipped. A last row that a kill
    cut off is left out, told, and counted as ``rows_cut_off``. DataError names the first thing
    wrong.
    """
    end = max(text.rfind("\n"), text.rfind("\r")) + 1 or len(text)
    reader = csv.reader(io.StringIO(text[:end], newline=""), strict=True)
    line = 1
    try:
        header = next(reader, None)
        if header is None:
            raise DataError(f"{path}: empty, not even a header line")
        places = find_columns(path, header, columns)
        width = len(header)
        for cells in reader:
            line = reader.line_num
            if any(cell.strip() for cell in cells):
                yield line, _parse_row(path, line, header, cells, places)
                width = len(cells)
        line = reader.line_num + 1
        if text[end:].strip(" \t,"):
            row = _row_without_end(path, line, text[end:], width, header, places)
            if row is not None:
                yield line, row
                return
            _LOG.warning("%s: line %d was cut off: left out", path, line)
            if counters is not None:
                counters["rows_cut_off"] += 1
    except csv.Error as error:
        line = max(line, reader.line_num)
        raise DataError(f"{path}: line {line}: not CSV: {error}") from None


def _row_without_end(
    path: Path,
    line: int,
    text: str,
    width: int,
    header: Sequence[str],
    places: Sequence[tuple[Column, int | None]],
) -> tuple[Any, ...] | None:
    """Return the row of a last line that does not end; None where it stops short.

    A session that is killed while it writes leaves such a row: right as far as it goes.
    """
    try:
        (cells,) = csv.reader([text], strict=True)
    except csv.Error as error:
        if "unexpected end" in str(error):
            return None
        raise
    try:
        row = _parse_row(path, line, header, cells, places)
    except DataError:
        last = len(cells) - 1
        before = [(column, place) for column, place in places if place is not None and place < last]
        _parse_row(path, line, header, cells[:last], before)
        if last >= len(header):
            raise
        return None
    return None if len(cells) < width else row


def find_columns(
    path: Path, header: Sequence[str], columns: Sequence[Column]
) -> list[tuple[Column, int | None]]:
    """Return each column with its place in the header (None: an optional one is missing)."""
    names = [name.strip() for name in header]
    places: list[tuple[Column, int | None]] = []
    for column in columns:
        if names.count(column.name) > 1:
            raise DataError(f"{path}: line 1: column {column.name} is there twice")
        place = names.index(column.name) if column.name in names else None
        if place is None and not column.optional:
            hint = "; cells are separated by ',' here" if len(names) == 1 else ""
            raise DataError(f"{path}: line 1: column {column.name} is missing{hint}")
        places.append((column, place))
    return places


def _parse_row(
    path: Path,
    line: int,
    header: Sequence[str],
    cells: Sequence[str],
    places: Sequence[tuple[Column, int | None]],
) -> tuple[Any, ...]:
    if any(cell.strip() for cell in cells[len(header) :]):
        raise DataError(
            f"{path}: line {line}: {len(cells)} cells for {len(header)} columns, "
            f"after column {header[-1].strip()}"
        )
    row: list[Any] = []
    for column, place in places:
        text = cells[place].strip() if place is not None and place < len(cells) else ""
        if not text:
            if not column.optional:
                raise DataError(f"{path}: line {line}: column {column.name} is empty")
            row.append(None)
            continue
        try:
            row.append(column.parse(text))
        except ValueError as error:
            raise DataError(
                f"{path}: line {line}: column {column.name}: {_quote(text)} {error}"
            ) from None
    return tuple(row)


def _quote(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:40] + "...")
