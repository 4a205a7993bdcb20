"""Running an estimator over a run, and the result with its tables."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from relpos.errors import RelposError
from relpos.evaluation.iso18305 import Latency
from relpos.fusion.estimator import Progress
from relpos.fusion.linear_algebra import one_thread
from relpos.runs.estimates import PAIR_COLUMNS, PARAMETER_COLUMNS, pair_rows

if TYPE_CHECKING:
    from relpos.fusion.estimator import Estimate, Estimator, Parameter
    from relpos.measurements import Measurement, Prior, Step

Floats = npt.NDArray[np.float64]

POSE_COLUMNS = (
    "time_s",
    "node",
    "x_m",
    "y_m",
    "z_m",
    "heading_rad",
    "variance_x_m2",
    "variance_y_m2",
    "covariance_xy_m2",
    "sigma_z_m",
    "sigma_heading_rad",
    "status",
)
_TABLES = {"poses": POSE_COLUMNS, "pairs": PAIR_COLUMNS, "parameters": PARAMETER_COLUMNS}


@dataclass(frozen=True)
class EstimatorRun:
    """The estimates of one estimator over a sequence of measurements, with their times.

    ``emitted_s`` (T,) is the time of the measurement upon which each estimate was returned,
    ``computing_s`` the estimator's wall time over all ``measurements``. ``failure`` is the error
    that ended it, ``interrupted`` is whether Ctrl-C did; earlier estimates are kept.
    """

    estimates: tuple[Estimate, ...] = ()
    emitted_s: Floats = field(default_factory=lambda: np.empty(0))
    computing_s: float = 0.0
    measurements: int = 0
    counters: Mapping[str, int] = field(default_factory=dict)
    failure: RelposError | None = None
    interrupted: bool = False

    @property
    def latency(self) -> Latency | None:
        """How much later than its own time an estimate was returned; None without estimates."""
        if not self.estimates or not self.emitted_s.size:
            return None
        own_s = np.array([estimate.time_s for estimate in self.estimates])
        wait_s = np.maximum(self.emitted_s - own_s, 0.0)
        return Latency(
            float(np.median(wait_s)),
            float(np.quantile(wait_s, 0.95)),
            float(wait_s.max()),
            self.computing_s / max(self.measurements, 1),
        )


def run_estimator(
    estimator: Estimator,
    measurements: Sequence[Measurement],
    progress: Progress | None = None,
) -> EstimatorRun:
    """Pass every measurement to an estimator in order, then let it finish.

    A RelposError of the estimator, or Ctrl-C, ends the run and is stored in it; any other error
    is a fault of the program and is raised.
    """
    progress = progress or (lambda stage, done, total: None)
    estimates: list[Estimate] = []
    emitted: list[float] = []
    computing, count, now_s = 0.0, 0, -math.inf
    failure: RelposError | None = None
    interrupted = False
    with one_thread():
        try:
            for measurement in measurements:
                progress("fusing", count, len(measurements))
                now_s = max(now_s, measurement.time_s)
                count += 1
                started = time.perf_counter()
                new = estimator.process(measurement)
                computing += time.perf_counter() - started
                estimates += new
                emitted += len(new) * [now_s]
        except KeyboardInterrupt:
            interrupted = True
        except RelposError as error:
            failure = error
        try:
            progress("finishing", 0, 0)
            started = time.perf_counter()
            new = estimator.finish()
            computing += time.perf_counter() - started
            estimates += new
            emitted += len(new) * [now_s]
        except RelposError as error:
            failure = failure or error
    return EstimatorRun(
        tuple(estimates),
        np.array(emitted),
        computing,
        count,
        dict(estimator.counters()) if failure is None else {},
        failure,
        interrupted,
    )


@dataclass(frozen=True)
class Result:
    """An estimator's estimates of one run: what ``fuse`` returns and ``evaluate`` scores.

    ``parameters`` are the learned values, a row for each change. ``priors`` are the starts that
    the estimator began with. For a result that was read from files ``estimator_run`` is None,
    and ``priors`` where they do not tell.
    """

    estimator: str
    estimates: tuple[Estimate, ...]
    parameters: tuple[Parameter, ...] = ()
    counters: Mapping[str, float] = field(default_factory=dict)
    seed: int | None = None
    settings: Mapping[str, object] = field(default_factory=dict)
    priors: tuple[Prior, ...] | None = None
    smoothed: bool = False
    estimator_run: EstimatorRun | None = field(default=None, compare=False)

    @property
    def latency(self) -> Latency | None:
        """How much later than its own time an estimate was returned; None where not observed."""
        return None if self.estimator_run is None else self.estimator_run.latency

    def arrays(self, table: str = "poses") -> dict[str, npt.NDArray[Any]]:
        """Return a table as arrays (n,), one a column, by time and node.

        ``poses``: x, y, z in m, heading in rad, the position's covariance in m^2, sigmas in m and
        rad, in the estimate's frame; ``pairs``: horizontal distance in m and bearing in rad of
        peer from node, with sigmas; ``parameters``: what was learned, in the unit of its name.
        RelposError for another table's name.
        """
        names, rows = _columns(table), self._rows(table)
        columns = zip(*rows, strict=True) if rows else [()] * len(names)
        return {name: _array(name, column) for name, column in zip(names, columns, strict=True)}

    def frame(self, table: str = "poses") -> Any:
        """Return a table as a pandas DataFrame; a NumPy record array without pandas.

        The tables and their units are those of :meth:`arrays`.
        """
        arrays = self.arrays(table)
        try:
            pandas = import_module("pandas")
        except ImportError:
            types = [(name, column.dtype) for name, column in arrays.items()]
            return np.rec.fromarrays(list(arrays.values()), dtype=types)
        return pandas.DataFrame(arrays)

    def save(self, directory: Path | str, steps: Sequence[Step] = ()) -> list[Path]:
        """Write the run format's files (``estimate.csv``, ...); return their paths."""
        from relpos.runs import write_estimates

        return write_estimates(directory, self.estimates, steps=steps, priors=self.priors)

    def _rows(self, table: str) -> list[tuple[Any, ...]]:
        if table == "poses":
            return [
                (e.time_s, *(getattr(n, name) for name in POSE_COLUMNS[1:]))
                for e in self.estimates
                for n in e.nodes
            ]
        if table == "pairs":
            return [(e.time_s, *row) for e in self.estimates for row in pair_rows(e)]
        return [tuple(getattr(p, name) for name in PARAMETER_COLUMNS) for p in self.parameters]

    def __str__(self) -> str:
        """Return one line about the result."""
        last = self.estimates[-1].time_s if self.estimates else 0.0
        return f"{self.estimator}: {len(self.estimates)} estimates up to {last:.1f} s"

    def __repr__(self) -> str:
        """Return one line, not thousands of numbers."""
        return f"<relpos.Result {self}>"


def result_of(
    estimator: str,
    estimator_run: EstimatorRun,
    *,
    seed: int | None = None,
    settings: Mapping[str, object] | None = None,
    priors: Sequence[Prior] | None = None,
    smoothed: bool = False,
) -> Result:
    """Make a result of an estimator's run."""
    return Result(
        estimator,
        estimator_run.estimates,
        _learned(estimator_run.estimates),
        estimator_run.counters,
        seed,
        dict(settings or {}),
        None if priors is None else tuple(priors),
        smoothed,
        estimator_run,
    )


def read_result(directory: Path | str) -> Result:
    """Read the files of an estimate; DataError where they are faulty."""
    from relpos.runs import read_estimates, read_initial

    estimates = tuple(read_estimates(directory))
    return Result("estimate", estimates, _learned(estimates), priors=read_initial(directory))


def _learned(estimates: Sequence[Estimate]) -> tuple[Parameter, ...]:
    from relpos.runs.estimates import changes

    return tuple(changes(row for estimate in estimates for row in estimate.parameters))


def _columns(table: str) -> tuple[str, ...]:
    if table not in _TABLES:
        raise RelposError(f"no table '{table}': one of {', '.join(_TABLES)}")
    return _TABLES[table]


def _array(name: str, column: Sequence[Any]) -> npt.NDArray[Any]:
    if name == "node":
        return np.array(column, dtype=np.int64)
    if name == "peer":
        # Of a parameter that belongs to one node alone.
        return np.array([-1 if one is None else one for one in column], dtype=np.int64)
    if name in ("status", "name"):
        return np.array([str(one) for one in column], dtype=np.str_)
    return np.array(column, dtype=np.float64)
