"""A source's files, and the tables of a run directory that are made of them."""

from __future__ import annotations

import gzip
import hashlib
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from relpos.errors import DataError

IMU_COLUMNS = "time_s,node,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s,mx_ut,my_ut,mz_ut"
EVENT_COLUMNS = "time_s,node,event,value"
TRUTH_COLUMNS = "time_s,node,x_m,y_m,heading_rad"


class Archive:
    """The files of a source: a folder, or a zip file whose one top folder is left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._zip = zipfile.ZipFile(path) if path.is_file() else None
        if self._zip is not None:
            names = [n for n in self._zip.namelist() if not n.endswith("/")]
            tops = {PurePosixPath(n).parts[0] for n in names}
            self._top = f"{tops.pop()}/" if len(tops) == 1 else ""
            self.names = sorted(n.removeprefix(self._top) for n in names)
        else:
            files = (p for p in path.rglob("*") if p.is_file())
            self.names = sorted(p.relative_to(path).as_posix() for p in files)

    def read(self, name: str) -> str:
        """Text of a file; DataError where the source has it no more."""
        if name not in self.names:
            raise DataError(f"{self._path}: no {name}: the source has changed")
        if self._zip is not None:
            return self._zip.read(self._top + name).decode("utf-8", "replace")
        return (self._path / name).read_text(encoding="utf-8", errors="replace")


@dataclass(frozen=True)
class ConvertedRun:
    """The text of a run directory's files; ``imu`` are lines below `IMU_COLUMNS`."""

    name: str
    description: str
    imu: Sequence[str]
    events: Sequence[str] = field(default_factory=tuple)
    truth: Sequence[str] = field(default_factory=tuple)

    def tables(self) -> dict[str, str]:
        """File name -> text."""
        parts = {
            "imu.csv": (IMU_COLUMNS, self.imu),
            "events.csv": (EVENT_COLUMNS, self.events),
            "truth.csv": (TRUTH_COLUMNS, self.truth),
        }
        return {
            name: "\n".join([columns, *lines]) + "\n"
            for name, (columns, lines) in parts.items()
            if lines
        }

    def write(self, folder: Path) -> None:
        """Write the run directory below ``folder``."""
        place = folder / self.name
        place.mkdir(parents=True, exist_ok=True)
        (place / "run.toml").write_text(self.description, encoding="utf-8")
        for name, text in self.tables().items():
            if name == "imu.csv":
                with gzip.open(place / "imu.csv.gz", "wt", encoding="utf-8") as stream:
                    stream.write(text)
            else:
                (place / name).write_text(text, encoding="utf-8")


def digest(runs: Iterable[ConvertedRun]) -> str:
    """SHA-256 of all tables in their order."""
    total = hashlib.sha256()
    for run in runs:
        for name, text in run.tables().items():
            total.update(f"{run.name}/{name}\n{text}".encode())
    return total.hexdigest()


def number(value: float) -> str:
    """Six significant digits."""
    return f"{value:.6g}"
