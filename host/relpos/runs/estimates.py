"""What a fusion leaves behind: the files under "Out" of the run format."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from relpos.errors import DataError
from relpos.fusion.estimator import (
    Alternative,
    Estimate,
    NodeEstimate,
    NodeStatus,
    PairEstimate,
    Parameter,
    Shape,
)
from relpos.measurements import Step
from relpos.runs.appending import AppendedTable, close_all
from relpos.runs.table import Column, find_table, node_id, not_negative, number, read_rows

ESTIMATE_COLUMNS = [
    "time_s",
    "node",
    "x_m",
    "y_m",
    "z_m",
    "heading_rad",
    "sigma_major_m",
    "sigma_minor_m",
    "sigma_angle_rad",
    "sigma_z_m",
    "sigma_heading_rad",
    "status",
]
PAIR_COLUMNS = (
    "time_s",
    "node",
    "peer",
    "distance_m",
    "sigma_distance_m",
    "bearing_rad",
    "sigma_bearing_rad",
)
ALTERNATIVE_COLUMNS = [
    "time_s",
    "alternative",
    "probability",
    "node",
    "x_m",
    "y_m",
    "heading_rad",
    "sigma_major_m",
    "sigma_minor_m",
    "sigma_angle_rad",
    "shape",
]
PARAMETER_COLUMNS = (
    "time_s",
    "node",
    "peer",
    "name",
    "value",
    "sigma",
)
STEP_COLUMNS = ("time_s", "node", "length_m")

_DECIMALS = 6
"""Micrometres and microradians: far below any sensor here, and files a third the size."""


def write_estimates(
    directory: Path | str,
    estimates: Iterable[Estimate],
    *,
    steps: Sequence[Step] = (),
) -> list[Path]:
    """Write ``estimate.csv``, ``pairs.csv`` and ``parameters.csv``, the others when any.

    ``parameters.csv`` holds a row where a learned value or its sigma has changed.

    An ``alternatives.csv`` or ``steps.csv`` that an earlier run left here and this one has
    nothing for is removed, lest it be taken for this one's. Returns the files written.
    """
    with EstimateFiles(directory) as files:
        for estimate in estimates:
            files.write(estimate)
        files.write_steps(steps)
    return files.written


class EstimateFiles:
    """The files of :func:`write_estimates`, written as the estimates come.

    What cannot be written for now (a full disk) waits: see :mod:`relpos.runs.appending`.
    """

    def __init__(self, directory: Path | str) -> None:
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        self._estimates = AppendedTable(directory / "estimate.csv", ESTIMATE_COLUMNS)
        self._pairs = AppendedTable(directory / "pairs.csv", PAIR_COLUMNS)
        self._parameters = AppendedTable(directory / "parameters.csv", PARAMETER_COLUMNS)
        self._alternatives = AppendedTable(
            directory / "alternatives.csv", ALTERNATIVE_COLUMNS, wanted=False
        )
        self._steps = AppendedTable(directory / "steps.csv", STEP_COLUMNS, wanted=False)
        self._last: dict[tuple[str, int, int | None], tuple[float, float]] = {}

    def __enter__(self) -> EstimateFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, estimate: Estimate) -> None:
        """Append one estimate; of its parameters those that have changed."""
        self._estimates.add(map(_rounded_row, _estimate_rows((estimate,))))
        self._pairs.add(map(_rounded_row, _pair_rows((estimate,))))
        self._parameters.add(
            map(
                _rounded_row,
                _attribute_rows(changes(estimate.parameters, self._last), PARAMETER_COLUMNS),
            )
        )
        if estimate.alternatives:
            self._alternatives.add(
                map(_rounded_row, _attribute_rows(estimate.alternatives, ALTERNATIVE_COLUMNS))
            )

    def write_steps(self, steps: Sequence[Step]) -> None:
        """Append steps."""
        if steps:
            self._steps.add(map(_rounded_row, _attribute_rows(steps, STEP_COLUMNS)))

    @property
    def tables(self) -> tuple[AppendedTable, ...]:
        """The files."""
        return (
            self._estimates,
            self._pairs,
            self._alternatives,
            self._parameters,
            self._steps,
        )

    @property
    def written(self) -> list[Path]:
        """The files that are there."""
        return [table.path for table in self.tables if table.exists]

    def close(self) -> None:
        """Finish them; OSError where something could not be written."""
        close_all(self.tables)


def read_estimates(directory: Path | str) -> list[Estimate]:
    """Read what :func:`write_estimates` wrote, but for the steps, back, ordered by time.

    Somebody else's estimate may hold times, nodes and positions alone: what is missing becomes
    NaN, a missing status ``ok``. DataError where there is no ``estimate.csv``.
    """
    directory = Path(directory)
    path = find_table(directory, "estimate.csv")
    if path is None:
        raise DataError(f"{directory}: no estimate.csv in there")
    nodes: dict[float, list[NodeEstimate]] = {}
    for time_s, node, x_m, y_m, *rest in read_rows(path, _ESTIMATE_TABLE):
        heading, major, minor, angle, sigma_heading, status, z, sigma_z = rest
        nodes.setdefault(time_s, []).append(
            _node_estimate(
                node, x_m, y_m, heading, major, minor, angle, sigma_heading, status, z, sigma_z
            )
        )
    pairs: dict[float, list[PairEstimate]] = {}
    pairs_path = find_table(directory, "pairs.csv")
    if pairs_path is not None:
        for time_s, *cells in read_rows(pairs_path, _PAIR_TABLE):
            node, peer, *figures = cells
            pairs.setdefault(time_s, []).append(
                PairEstimate(node, peer, *(_nan_if_none(figure) for figure in figures))
            )
    alternatives: dict[float, list[Alternative]] = {}
    alternatives_path = find_table(directory, "alternatives.csv")
    if alternatives_path is not None:
        for row in read_rows(alternatives_path, _ALTERNATIVE_TABLE):
            alternatives.setdefault(row[0], []).append(Alternative(*row))
    parameters: dict[float, list[Parameter]] = {}
    parameters_path = find_table(directory, "parameters.csv")
    if parameters_path is not None:
        for row in read_rows(parameters_path, _PARAMETER_TABLE):
            time_s, node, peer, name, value, sigma = row
            learned = Parameter(time_s, node, peer, name, value, _nan_if_none(sigma))
            parameters.setdefault(time_s, []).append(learned)
    tables = (nodes, pairs, alternatives, parameters)
    return [
        Estimate(
            time_s,
            tuple(nodes.get(time_s, ())),
            tuple(pairs.get(time_s, ())),
            tuple(alternatives.get(time_s, ())),
            tuple(parameters.get(time_s, ())),
        )
        for time_s in sorted(set[float]().union(*tables))
    ]


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


def _estimate_rows(estimates: Iterable[Estimate]) -> Iterable[Sequence[object]]:
    for estimate in estimates:
        for node in estimate.nodes:
            yield (
                estimate.time_s,
                *(getattr(node, name) for name in ESTIMATE_COLUMNS[1:-1]),
                str(node.status),
            )


def _pair_rows(estimates: Iterable[Estimate]) -> Iterable[Sequence[object]]:
    for estimate in estimates:
        for pair in estimate.pairs:
            yield (estimate.time_s, *(getattr(pair, name) for name in PAIR_COLUMNS[1:]))


def _attribute_rows(rows: Iterable[object], names: Sequence[str]) -> Iterable[Sequence[object]]:
    return ([getattr(row, name) for name in names] for row in rows)


def _rounded_row(row: Iterable[object]) -> list[object]:
    return [_rounded(cell) for cell in row]


def _rounded(value: object) -> object:
    return round(float(value), _DECIMALS) if isinstance(value, float) else value


def _status(text: str) -> NodeStatus:
    try:
        return NodeStatus(text)
    except ValueError:
        raise ValueError(f"is none of {', '.join(NodeStatus)}") from None


_ESTIMATE_TABLE = (
    Column("time_s", number),
    Column("node", node_id),
    # An estimator that knows nothing of a node may leave its cells empty.
    Column("x_m", number, optional=True),
    Column("y_m", number, optional=True),
    Column("heading_rad", number, optional=True),
    Column("sigma_major_m", not_negative, optional=True),
    Column("sigma_minor_m", not_negative, optional=True),
    Column("sigma_angle_rad", number, optional=True),
    Column("sigma_heading_rad", not_negative, optional=True),
    Column("status", _status, optional=True),
    Column("z_m", number, optional=True),
    Column("sigma_z_m", not_negative, optional=True),
)
_PAIR_TABLE = (
    Column("time_s", number),
    Column("node", node_id),
    Column("peer", node_id),
    Column("distance_m", number),
    Column("sigma_distance_m", not_negative, optional=True),
    Column("bearing_rad", number, optional=True),
    Column("sigma_bearing_rad", not_negative, optional=True),
)


def _whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise ValueError("is negative")
    return value


def _shape(text: str) -> Shape:
    try:
        return Shape(text)
    except ValueError:
        raise ValueError(f"is none of {', '.join(Shape)}") from None


_ALTERNATIVE_TABLE = (
    Column("time_s", number),
    Column("alternative", _whole),
    Column("probability", not_negative),
    Column("node", node_id),
    Column("x_m", number),
    Column("y_m", number),
    Column("heading_rad", number),
    Column("sigma_major_m", not_negative),
    Column("sigma_minor_m", not_negative),
    Column("sigma_angle_rad", number),
    Column("shape", _shape),
)
_PARAMETER_TABLE = (
    Column("time_s", number),
    Column("node", node_id),
    Column("peer", node_id, optional=True),
    Column("name", str),
    Column("value", number),
    Column("sigma", not_negative, optional=True),
)


def _nan_if_none(value: Any) -> float:
    return math.nan if value is None else float(value)


def _node_estimate(
    node: int,
    x_m: float | None,
    y_m: float | None,
    heading: float | None,
    major: float | None,
    minor: float | None,
    angle: float | None,
    sigma_heading: float | None,
    status: NodeStatus | None,
    z_m: float | None,
    sigma_z: float | None,
) -> NodeEstimate:
    """Undo the ellipse: its axes and angle back to the three entries of the covariance."""
    along, across = _nan_if_none(major) ** 2, _nan_if_none(minor) ** 2
    c, s = math.cos(_nan_if_none(angle)), math.sin(_nan_if_none(angle))
    return NodeEstimate(
        node=node,
        x_m=_nan_if_none(x_m),
        y_m=_nan_if_none(y_m),
        heading_rad=_nan_if_none(heading),
        variance_x_m2=along * c * c + across * s * s,
        variance_y_m2=along * s * s + across * c * c,
        covariance_xy_m2=(along - across) * c * s,
        sigma_heading_rad=_nan_if_none(sigma_heading),
        status=status or NodeStatus.OK,
        z_m=_nan_if_none(z_m),
        sigma_z_m=_nan_if_none(sigma_z),
    )
