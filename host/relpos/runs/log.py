"""``log.csv``: what happened in a session, to whom, by whom."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from relpos.errors import DataError

LOG_FILE = "log.csv"
LOG_COLUMNS = ("time_s", "unix_s", "kind", "node", "by", "text")


FORMULA = re.compile(r"'*[=+\-@]")
"""What spreadsheets would compute, apostrophes before it included."""


def shielded(text: str) -> str:
    """Return a cell that a spreadsheet shows, and does not compute: names come from anybody."""
    return f"'{text}" if FORMULA.match(text) else text


def _plain(cell: str) -> str:
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell


def read_log(directory: Path | str) -> list[dict[str, str]]:
    """Read the log of a session's output directory; empty where there is none."""
    path = Path(directory) / LOG_FILE
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError:
        return []
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path}: not a log: {error}") from None
    return [
        {**row, "by": _plain(row["by"]), "text": _plain(row["text"])}
        for row in rows
        if all(isinstance(row.get(name), str) for name in LOG_COLUMNS)
    ]
