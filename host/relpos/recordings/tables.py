"""A source's files, and the tables of a run directory that are made of them."""

from __future__ import annotations

import gzip
import hashlib
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt

from relpos.errors import DataError

Array = npt.NDArray[np.float64]
IMU_COLUMNS = (
    "time_s,node,ax_m_s2,ay_m_s2,az_m_s2,gx_rad_s,gy_rad_s,gz_rad_s,mx_ut,my_ut,mz_ut,pressure_pa"
)
EVENT_COLUMNS = "time_s,node,event,value"
TRUTH_COLUMNS = "time_s,node,x_m,y_m,heading_rad"
MOTION_COLUMNS = "time_s,node,dx_m,dy_m,dtheta_rad"
RANGE_COLUMNS = "time_s,node,peer,range_m"
PA_OF_MBAR = 100.0


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

    def read_bytes(self, name: str) -> bytes:
        """Content of a file; DataError where the source has it no more."""
        if name not in self.names:
            raise DataError(f"{self._path}: no {name}: the source has changed")
        if self._zip is not None:
            return self._zip.read(self._top + name)
        return (self._path / name).read_bytes()

    def read(self, name: str) -> str:
        """Text of a file; DataError where the source has it no more."""
        text = self.read_bytes(name).decode("utf-8", "replace")
        return text.replace("\r\n", "\n")

    def below(self, folder: str, ending: str = "") -> list[str]:
        """Names in a folder; DataError where there are none any more."""
        found = [n for n in self.names if n.startswith(folder) and n.endswith(ending)]
        if not found:
            raise DataError(f"{self._path}: no {folder}*{ending}: the source has changed")
        return found


@dataclass(frozen=True)
class ConvertedRun:
    """The text of a run directory's files; ``imu`` are lines below the first of `IMU_COLUMNS`.

    ``others``: further tables, file name -> lines with the header. A table of range errors is no
    run: its description is a text.
    """

    name: str
    description: str
    imu: Sequence[str] = ()
    events: Sequence[str] = ()
    truth: Sequence[str] = ()
    others: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def tables(self) -> dict[str, str]:
        """File name -> text."""
        width = self.imu[0].count(",") + 1 if self.imu else 0
        parts = {
            "imu.csv": (",".join(IMU_COLUMNS.split(",")[:width]), self.imu),
            "events.csv": (EVENT_COLUMNS, self.events),
            "truth.csv": (TRUTH_COLUMNS, self.truth),
        }
        filled = {name: [columns, *lines] for name, (columns, lines) in parts.items() if lines}
        return {name: "\n".join(lines) + "\n" for name, lines in {**filled, **self.others}.items()}

    def write(self, folder: Path) -> None:
        """Write the run directory below ``folder``."""
        place = folder / self.name
        place.mkdir(parents=True, exist_ok=True)
        described = "SOURCE.txt" if "errors.csv" in self.others else "run.toml"
        (place / described).write_text(self.description, encoding="utf-8")
        for name, text in self.tables().items():
            if name in ("imu.csv", "errors.csv"):
                with gzip.open(place / f"{name}.gz", "wt", encoding="utf-8") as stream:
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


def number(value: float, digits: int = 6) -> str:
    """That many significant digits; an empty cell where there is no value."""
    return "" if np.isnan(value) else f"{value:.{digits}g}"


def imu_lines(times_s: Array, samples: Array, digits: int = 5, node: int = 1) -> list[str]:
    """Lines of imu.csv: ``samples`` (n, 6), with the field (n, 9), and with pressure (n, 10)."""
    none = ",,," if samples.shape[1] == 6 else ""
    return [
        f"{t:.4f},{node},"
        + ",".join(number(v, digits) for v in row[:9])
        + none
        + "".join(f",{pressure_pa:.1f}" for pressure_pa in row[9:])
        for t, row in zip(times_s.tolist(), samples.tolist(), strict=True)
    ]


def event_lines(marks: Iterable[tuple[float, str, str]], digits: int = 4) -> list[str]:
    """Lines of events.csv of node 1, in their order, of (time, event, value)."""
    return [f"{time:.{digits}f},1,{event},{value}" for time, event, value in sorted(marks)]


def described(name: str, source: str, *lines: str) -> str:
    """The text of run.toml."""
    return "\n".join([f'name = "{name}"', f'source = "{source}"', *lines]) + "\n"
