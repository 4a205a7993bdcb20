"""The files of an estimate: those under "Out" of the run format."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import astuple
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from relpos.errors import DataError
from relpos.fusion.estimator import (
    Alternative,
    Episode,
    Estimate,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    Shape,
)
from relpos.measurements import Prior, Step
from relpos.runs.appending import AppendedTable, close_all
from relpos.runs.table import (
    Column,
    Parser,
    bounded,
    find_table,
    node_id,
    not_negative,
    number,
    numbered_rows,
    read_text,
    whole,
)

T = TypeVar("T")


def _one_of(words: type[StrEnum]) -> Parser:
    """Return the parser of a word that is one of these."""

    def parse(text: str) -> StrEnum:
        try:
            return words(text)
        except ValueError:
            raise ValueError(f"is none of {', '.join(words)}") from None

    return parse


def _index(text: str) -> int:
    value = whole(text)
    if value < 0:
        raise ValueError("is negative")
    return value


_ESTIMATE_TABLE = (
    Column("time_s", bounded("time_s")),
    Column("node", node_id),
    # An estimator that knows nothing of a node may leave its cells empty.
    Column("x_m", number, optional=True),
    Column("y_m", number, optional=True),
    Column("z_m", number, optional=True),
    Column("heading_rad", number, optional=True),
    Column("sigma_major_m", not_negative, optional=True),
    Column("sigma_minor_m", not_negative, optional=True),
    Column("sigma_angle_rad", number, optional=True),
    Column("sigma_z_m", not_negative, optional=True),
    Column("sigma_heading_rad", not_negative, optional=True),
    Column("status", _one_of(NodeStatus), optional=True),
    Column("episode", _one_of(Episode), optional=True),
    Column("episode_probability", not_negative, optional=True),
    Column("floor", whole, optional=True),
    Column("floor_probability", not_negative, optional=True),
)
_PAIR_TABLE = (
    Column("time_s", bounded("time_s")),
    Column("node", node_id),
    Column("peer", node_id),
    Column("distance_m", number),
    Column("sigma_distance_m", not_negative, optional=True),
    Column("bearing_rad", number, optional=True),
    Column("sigma_bearing_rad", not_negative, optional=True),
    Column("status", _one_of(NodeStatus), optional=True),
)
_ALTERNATIVE_TABLE = (
    Column("time_s", bounded("time_s")),
    Column("alternative", _index),
    Column("probability", not_negative),
    Column("node", node_id),
    Column("x_m", number),
    Column("y_m", number),
    Column("heading_rad", number),
    Column("sigma_major_m", not_negative),
    Column("sigma_minor_m", not_negative),
    Column("sigma_angle_rad", number),
    Column("shape", _one_of(Shape)),
)
_PARAMETER_TABLE = (
    Column("time_s", bounded("time_s")),
    Column("node", node_id),
    Column("peer", node_id, optional=True),
    Column("name", str),
    Column("value", number),
    Column("sigma", not_negative, optional=True),
)
ESTIMATE_COLUMNS, PAIR_COLUMNS, ALTERNATIVE_COLUMNS, PARAMETER_COLUMNS = (
    tuple(column.name for column in table)
    for table in (_ESTIMATE_TABLE, _PAIR_TABLE, _ALTERNATIVE_TABLE, _PARAMETER_TABLE)
)
_INITIAL_TABLE = (
    Column("node", node_id),
    Column("x_m", number),
    Column("y_m", number),
    Column("heading_rad", number),
    # Empty: not known.
    Column("sigma_m", not_negative, optional=True),
    Column("sigma_rad", not_negative, optional=True),
)
STEP_COLUMNS = ("time_s", "node", "length_m")

_DECIMALS = 6
"""Micrometres and microradians: far below any sensor here, and files a third the size."""


def write_estimates(
    directory: Path | str,
    estimates: Iterable[Estimate],
    *,
    steps: Sequence[Step] = (),
    priors: Sequence[Prior] | None = None,
) -> list[Path]:
    """Write ``estimate.csv``, ``pairs.csv`` and ``parameters.csv``, the others when any.

    ``priors`` are the starts that the estimator began with; without a row nobody's was known.

    ``parameters.csv`` holds a row where a learned value or its sigma has changed.

    An ``alternatives.csv`` or ``steps.csv`` of an earlier run is removed where this one has no
    rows for it. Returns the files written.
    """
    with EstimateFiles(directory, priors) as files:
        for estimate in estimates:
            files.write(estimate)
        files.write_steps(steps)
    return files.written


class EstimateFiles:
    """The files of :func:`write_estimates`, written as the estimates come.

    Rows that a full disk refuses wait: see :mod:`relpos.runs.appending`.
    """

    def __init__(self, directory: Path | str, priors: Sequence[Prior] | None = None) -> None:
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        self._estimates = AppendedTable(directory / "estimate.csv", ESTIMATE_COLUMNS)
        self._pairs = AppendedTable(directory / "pairs.csv", PAIR_COLUMNS)
        self._parameters = AppendedTable(directory / "parameters.csv", PARAMETER_COLUMNS)
        self._alternatives = AppendedTable(
            directory / "alternatives.csv", ALTERNATIVE_COLUMNS, wanted=False
        )
        self._steps = AppendedTable(directory / "steps.csv", STEP_COLUMNS, wanted=False)
        names = [column.name for column in _INITIAL_TABLE]
        self._initial = AppendedTable(directory / "initial.csv", names, wanted=priors is not None)
        self.write_initial(priors or ())
        self._last: dict[tuple[str, int, int | None], tuple[float, float]] = {}

    def write_initial(self, priors: Iterable[Prior]) -> None:
        """Write starts that the estimator begins with."""
        self._initial.add(
            [None if value == math.inf else value for value in astuple(prior)] for prior in priors
        )

    def __enter__(self) -> EstimateFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, estimate: Estimate) -> None:
        """Append one estimate; of its parameters those that have changed."""
        time_s = estimate.time_s
        self._estimates.add(_rows(estimate.nodes, ESTIMATE_COLUMNS, time_s))
        self._pairs.add(map(_cell, (time_s, *row)) for row in pair_rows(estimate))
        changed = changes(estimate.parameters, self._last)
        self._parameters.add(_rows(changed, PARAMETER_COLUMNS))
        if estimate.alternatives:
            self._alternatives.add(_rows(estimate.alternatives, ALTERNATIVE_COLUMNS))

    def write_steps(self, steps: Sequence[Step]) -> None:
        """Append steps."""
        if steps:
            self._steps.add(_rows(steps, STEP_COLUMNS))

    @property
    def tables(self) -> tuple[AppendedTable, ...]:
        """The files."""
        return (
            self._estimates,
            self._pairs,
            self._alternatives,
            self._parameters,
            self._steps,
            self._initial,
        )

    @property
    def written(self) -> list[Path]:
        """The files that are there."""
        return [table.path for table in self.tables if table.exists]

    def close(self) -> None:
        """Finish them; OSError where something could not be written."""
        close_all(self.tables)


def drop_page(directory: Path | str) -> None:
    """Remove the report of the estimate that was there before; a page of somebody else stays."""
    page = Path(directory) / "index.html"
    with suppress(OSError):
        with page.open("rb") as file:
            is_report = b" - relpos</title>" in file.read(4096)
        if is_report:
            page.unlink()


def read_estimates(directory: Path | str) -> list[Estimate]:
    """Read what :func:`write_estimates` wrote, but for the steps, back, ordered by time.

    An estimate of another program may hold times, nodes and positions alone: a missing figure
    becomes NaN, a missing status of a node ``ok``. DataError where there is no ``estimate.csv``.
    """
    directory = Path(directory)
    if find_table(directory, "estimate.csv") is None:
        raise DataError(f"{directory}: no estimate.csv in there")
    nodes = _by_time(directory, "estimate.csv", _ESTIMATE_TABLE, _node_estimate)
    pairs = _by_time(directory, "pairs.csv", _PAIR_TABLE, _pair_estimate)
    alternatives = _by_time(
        directory, "alternatives.csv", _ALTERNATIVE_TABLE, lambda row: Alternative(**row)
    )
    parameters = _by_time(
        directory,
        "parameters.csv",
        _PARAMETER_TABLE,
        lambda row: Parameter(**row | {"sigma": _nan_if_none(row["sigma"])}),
    )
    return [
        Estimate(
            time_s,
            tuple(nodes.get(time_s, ())),
            tuple(pairs.get(time_s, ())),
            tuple(alternatives.get(time_s, ())),
            tuple(parameters.get(time_s, ())),
        )
        for time_s in sorted({*nodes, *pairs, *alternatives, *parameters})
    ]


def read_initial(directory: Path | str) -> tuple[Prior, ...] | None:
    """Return the starts that an estimate began with; None where its files do not say."""
    path = find_table(Path(directory), "initial.csv")
    if path is None:
        return None
    priors = []
    for _, (node, *pose, sigma_m, sigma_rad) in numbered_rows(
        path, read_text(path), _INITIAL_TABLE
    ):
        sigmas = (math.inf if sigma is None else sigma for sigma in (sigma_m, sigma_rad))
        priors.append(Prior(node, *pose, *sigmas))
    return tuple(priors)


def _by_time(
    directory: Path,
    name: str,
    columns: Sequence[Column],
    make: Callable[[dict[str, Any]], T],
) -> dict[float, list[T]]:
    """Read a table and return what ``make`` makes of its rows, by time; empty without a file."""
    made: dict[float, list[T]] = {}
    path = find_table(directory, name)
    if path is not None:
        names = [column.name for column in columns]
        for _, cells in numbered_rows(path, read_text(path), columns):
            made.setdefault(cells[0], []).append(make(dict(zip(names, cells, strict=True))))
    return made


def _pair_estimate(row: dict[str, Any]) -> PairEstimate:
    figures: dict[str, Any] = {name: _nan_if_none(row[name]) for name in PAIR_COLUMNS[3:-1]}
    return PairEstimate(row["node"], row["peer"], **figures, status=row["status"])


def _node_estimate(row: dict[str, Any]) -> NodeEstimate:
    """Undo the ellipse: its axes and angle back to the three entries of the covariance."""
    figures = ESTIMATE_COLUMNS[2 : ESTIMATE_COLUMNS.index("status")]
    known = {name: _nan_if_none(row[name]) for name in figures}
    along, across = known["sigma_major_m"] ** 2, known["sigma_minor_m"] ** 2
    c, s = math.cos(known["sigma_angle_rad"]), math.sin(known["sigma_angle_rad"])
    return NodeEstimate(
        node=row["node"],
        x_m=known["x_m"],
        y_m=known["y_m"],
        heading_rad=known["heading_rad"],
        variance_x_m2=along * c * c + across * s * s,
        variance_y_m2=along * s * s + across * c * c,
        covariance_xy_m2=(along - across) * c * s,
        sigma_heading_rad=known["sigma_heading_rad"],
        status=row["status"] or NodeStatus.OK,
        z_m=known["z_m"],
        sigma_z_m=known["sigma_z_m"],
        **{name: row[name] for name in ESTIMATE_COLUMNS[-4:]},
    )


def _nan_if_none(value: float | None) -> float:
    return math.nan if value is None else float(value)


def changes(
    parameters: Iterable[Parameter],
    last: dict[tuple[str, int, int | None], tuple[float, float]] | None = None,
) -> list[Parameter]:
    """Leave out what repeats the same parameter's last row; ``last`` remembers it between calls."""
    last = {} if last is None else last
    kept: list[Parameter] = []
    for row in parameters:
        key, figures = (row.name, row.node, row.peer), (row.value, row.sigma)
        if last.get(key) != figures:
            last[key] = figures
            kept.append(row)
    return kept


def pair_rows(estimate: Estimate) -> Iterable[tuple[object, ...]]:
    """Yield the cells of ``pairs.csv`` behind the time, of every pair."""
    for pair, status in zip(estimate.pairs, estimate.pair_statuses(), strict=True):
        yield *(getattr(pair, name) for name in PAIR_COLUMNS[1:-1]), str(status)


def _rows(
    rows: Iterable[object], columns: Sequence[str], time_s: float | None = None
) -> Iterable[Sequence[object]]:
    """Yield rounded cells by their columns; ``time_s`` where the rows have no time of their own."""
    own = columns if time_s is None else columns[1:]
    first = () if time_s is None else (_cell(time_s),)
    for row in rows:
        yield *first, *(_cell(getattr(row, name)) for name in own)


def _cell(value: object) -> object:
    if isinstance(value, StrEnum):
        return str(value)
    return round(float(value), _DECIMALS) if isinstance(value, float) else value
