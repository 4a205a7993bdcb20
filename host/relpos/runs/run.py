"""A run directory as a whole: measurements in time order, priors, and the truth kept apart."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate, chain
from operator import attrgetter
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from relpos.errors import DataError
from relpos.files import displayable, write_whole
from relpos.measurements import (
    MEASUREMENTS,
    Event,
    Heading,
    Height,
    Measurement,
    Motion,
    Observation,
    Prior,
    Range,
    Status,
    Step,
    Truth,
    common_priors,
    out_of_bounds,
)
from relpos.runs.appending import AppendedTable, close_all, write_rows
from relpos.runs.description import (
    Description,
    InitialPose,
    NodeInfo,
    description_text,
    read_description,
    write_description,
)
from relpos.runs.imu import IMU_COLUMNS, ImuRecording, read_imu
from relpos.runs.landmarks import Landmark, read_landmarks, truth_from_presses
from relpos.runs.table import (
    Column,
    Parser,
    bounded,
    bounded_whole,
    find_table,
    flag,
    node_id,
    numbered_rows,
    plain_type,
    read_text,
    remove_table,
)

PRIOR_FROM_TRUTH_WITHIN_S = 2.0
"""A first truth pose later than this after a node's start says nothing of its start. The same
2 s as the metrics allow between two rows that are interpolated."""

ARRIVES_WITHIN_S = 1.0
"""A session writes rows as they arrive: nine ranges in ten within a tenth of a second, all but lost
frames' within this."""

SPARSE_S, CRAWLING_M_S = 2.0, 0.005
"""A walk whose times are milliseconds: rows seconds apart (up to 500 a second), at the thousandth
of a person's speed. Nodes that stand still report small errors as often as ever."""


@dataclass(frozen=True)
class Run:
    """One recording. ``measurements`` are what an estimator may see, sorted by time.

    ``truth`` is for evaluation alone. ``counters`` says how many rows of note were met:
    ``ranges_failed`` (a range of 0 or less, kept as the failure marker it is),
    ``landmarks_unknown`` (presses of a landmark without a survey), ``landmarks_repeated`` (pressed
    twice in passing), ``landmarks_of_strangers`` (by nodes without other data), ``unsorted_rows``
    (by more than :data:`ARRIVES_WITHIN_S`) and ``rows_cut_off`` (at a table's end, by a kill).
    """

    name: str
    description: Description = field(default_factory=Description)
    measurements: tuple[Measurement, ...] = ()
    events: tuple[Event, ...] = ()
    statuses: tuple[Status, ...] = ()
    steps: tuple[Step, ...] = ()
    landmarks: tuple[Landmark, ...] = ()
    truth: tuple[Truth, ...] = ()
    directory: Path | None = None
    counters: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def node_ids(self) -> tuple[int, ...]:
        """Every node that moves, ranges, is ranged to or is described, in order."""
        ids = set(self.description.nodes)
        for measurement in self.measurements:
            ids.add(measurement.node)
            if isinstance(measurement, Range):
                ids.add(measurement.peer)
        return tuple(sorted(ids))

    @property
    def nodes(self) -> dict[int, NodeInfo]:
        """Each node with its description; the defaults where ``run.toml`` has none."""
        return {node: self.description.nodes.get(node, NodeInfo()) for node in self.node_ids}

    @property
    def heading_known(self) -> bool:
        """Whether the headings of the nodes have one reference."""
        return self.description.heading_known

    @property
    def motions(self) -> tuple[Motion, ...]:
        """The motions among the measurements."""
        return tuple(m for m in self.measurements if isinstance(m, Motion))

    @property
    def ranges(self) -> tuple[Range, ...]:
        """The ranges among the measurements, failures (0) included."""
        return tuple(m for m in self.measurements if isinstance(m, Range))

    @property
    def priors(self) -> tuple[Prior, ...]:
        """The stated starts; the table of a node replaces ``initial_pose``."""
        tables = {prior.node: prior for prior in self.description.priors}
        merged = {p.node: p for p in self.priors_for(self.description.initial_pose)} | tables
        return tuple(merged[node] for node in sorted(merged))

    def priors_for(self, initial: InitialPose) -> tuple[Prior, ...]:
        """Return one prior a node that is known of under ``initial``, whatever the run says.

        DataError where the truth is asked for and is not there.
        """
        if initial is InitialPose.UNKNOWN:
            return ()
        if initial is InitialPose.COMMON:
            return common_priors(self.node_ids)
        priors = _priors_from_truth(self)
        return tuple(priors[node] for node in sorted(priors))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is worth a look before the run is fused, a line each."""
        ranging = {n for r in self.ranges if r.range_m > 0.0 for n in (r.node, r.peer)}
        moving = {motion.node for motion in self.motions}
        posts = {node for node, info in self.nodes.items() if info.post}
        words = []
        if still := sorted(ranging - moving - posts):
            who = f"node{'s' * (len(still) > 1)} {', '.join(map(str, still))}"
            words.append(
                f"{who}: no motion (motion.csv), so taken to stand still, as anchors do; whoever "
                "moves needs rows"
            )
        if unread := self.description.unread:
            more = ", ..." * (len(unread) > 5)
            words.append(f"run.toml: nothing reads {', '.join(unread[:5])}{more}: misspelt?")
        strangers = {prior.node for prior in self.description.priors} - set(self.node_ids)
        if strangers and self.measurements:
            tables = ", ".join(f"[initial.{node}]" for node in sorted(strangers))
            words.append(f"run.toml: no such node: {tables}")
        return tuple(words)

    def check_usable(self, *, needs_ranges: bool = True) -> None:
        """Raise DataError where nothing can be concluded: without motion, or without ranges."""
        where, ranges = self.directory or self.name, self.ranges
        if not self.motions:
            raise DataError(f"{where}: no motion in this run (motion.csv): nothing to fuse")
        if not needs_ranges:
            return
        if not ranges:
            raise DataError(f"{where}: no ranges in this run (ranges.csv): nothing to fuse")
        if all(measured.range_m <= 0.0 for measured in ranges):
            raise DataError(
                f"{where}: all {len(ranges)} ranges are 0, which marks a failed measurement: "
                "nothing to fuse"
            )

    def load_imu(self) -> dict[int, ImuRecording]:
        """Read the raw inertial recording of every node; empty where the run has none."""
        return read_imu(self.directory) if self.directory is not None else {}


def load_run(path: Path | str) -> Run:
    """Read a run directory. DataError names file, line and column of the first fault."""
    directory = Path(path)
    if not directory.exists():
        raise DataError(f"{directory}: no such run directory")
    if not directory.is_dir():
        raise DataError(f"{directory}: not a directory")
    description = read_description(directory / "run.toml")
    counters: Counter[str] = Counter()
    rows = [row for table in _TABLES for row in table.read(directory, counters)]
    surveyed = find_table(directory, "landmarks.csv")
    landmarks = tuple(read_landmarks(surveyed)) if surveyed is not None else ()
    name = description.name or directory.resolve().name
    _check_time_unit(directory, [row for row in rows if isinstance(row, Motion)])
    return assemble(name, description, rows, landmarks, directory=directory, counters=counters)


def _check_time_unit(directory: Path, motions: Sequence[Motion]) -> None:
    """Raise DataError where people crawl at millimetres a second: the times are milliseconds."""
    before: dict[int, float] = {}
    way_m, slow_m = 0.0, 0.0
    for motion in motions:
        took_s = motion.time_s - before.get(motion.node, math.inf)
        before[motion.node] = motion.time_s
        went_m = math.hypot(motion.dx_m, motion.dy_m)
        way_m += went_m
        if took_s > SPARSE_S and went_m < CRAWLING_M_S * took_s:
            slow_m += went_m
    if way_m > 10.0 and slow_m > 0.9 * way_m:
        raise DataError(
            f"{directory}: motion.csv: {way_m:.0f} m at less than {CRAWLING_M_S * 1e3:g} mm/s: "
            "time_s is in seconds, these look like milliseconds"
        )


def assemble(
    name: str,
    description: Description,
    rows: Iterable[Observation | Truth],
    landmarks: Sequence[Landmark] = (),
    *,
    directory: Path | None = None,
    counters: Mapping[str, int] | None = None,
) -> Run:
    """Make a run of rows in any order; of those at one time, motion comes first, then ranges.

    Presses at surveyed ``landmarks`` make the truth where the rows hold none.
    """
    by_kind = _by_kind(rows)
    for same in by_kind.values():
        same.sort(key=attrgetter("time_s"))
    counted = Counter(counters or {})
    measurements = sorted(
        (row for kind in MEASUREMENTS for row in by_kind[kind]), key=attrgetter("time_s")
    )
    counted["ranges_failed"] += sum(row.range_m <= 0.0 for row in by_kind[Range])
    run = Run(
        name=name,
        description=description,
        measurements=tuple(measurements),
        events=tuple(by_kind[Event]),
        statuses=tuple(by_kind[Status]),
        steps=tuple(by_kind[Step]),
        landmarks=tuple(landmarks),
        truth=tuple(by_kind[Truth]),
        directory=directory,
    )
    if not run.truth:
        presses = truth_from_presses(landmarks, run.events, run.node_ids)
        counted.update(presses.counters())
        run = replace(run, truth=presses.truth)
    return replace(run, counters=dict(+counted))


def save_run(run: Run, path: Path | str) -> None:
    """Write a run directory that :func:`load_run` reads back to the same run.

    A table that the run has nothing for is not written, and not left of a run that was there;
    ``imu.csv`` is copied through. DataError, before anything is written, where a row has a number
    that could not be read back.
    """
    directory = Path(path)
    imu = run.load_imu()
    by_kind = _by_kind(chain(run.measurements, run.events, run.statuses, run.steps, run.truth))
    for row in chain.from_iterable(by_kind.values()):
        if name := out_of_bounds(row):
            raise DataError(f"{directory}: not written: {name} cannot be read back: {row}")
    directory.mkdir(parents=True, exist_ok=True)
    description = replace(run.description, name=run.name)
    # What is no text, as of a folder's name that is not UTF-8, is "?".
    text = displayable(description_text(description))
    write_whole(directory / "run.toml", text.encode())
    for table in _TABLES:
        remove_table(directory, table.name)
        if rows := by_kind[table.kind]:
            write_rows(
                directory / table.name,
                table.names,
                ([getattr(row, name) for name in table.names] for row in rows),
            )
    remove_table(directory, "landmarks.csv")
    if run.landmarks:
        write_rows(
            directory / "landmarks.csv",
            ["id", "x_m", "y_m", "z_m"],
            ([mark.landmark, mark.x_m, mark.y_m, mark.z_m] for mark in run.landmarks),
        )
    remove_table(directory, "imu.csv")
    if imu:
        write_imu(directory, imu)


def write_imu(directory: Path, recordings: Mapping[int, ImuRecording]) -> None:
    """Write ``imu.csv`` of one or more nodes, by time."""
    blocks = [
        np.column_stack(
            (
                recording.time_s,
                np.full(recording.time_s.shape, float(node)),
                recording.acceleration_m_s2,
                recording.angular_rate_rad_s,
                recording.magnetic_field_ut,
                np.full(recording.time_s.shape, np.nan)
                if recording.pressure_pa is None
                else recording.pressure_pa,
            )
        )
        for node, recording in recordings.items()
    ]
    table = np.concatenate(blocks)
    table = table[np.argsort(table[:, 0], kind="stable")]
    # Rows of empty cells take many times as long to read.
    width = len(IMU_COLUMNS) - bool(np.isnan(table[:, -1]).all())
    write_rows(
        directory / "imu.csv",
        IMU_COLUMNS[:width],
        ([row[0], int(row[1]), *row[2:width]] for row in table.tolist()),
    )


class RunFiles:
    """A run directory that grows as observations come, for sessions of any length.

    Rows stand in the order of arrival. Tables that an earlier run left here are removed. ``Run``
    directories of it load like any other.
    """

    def __init__(self, path: Path | str, description: Description) -> None:
        self._directory = Path(path)
        self._directory.mkdir(parents=True, exist_ok=True)
        for table in _TABLES:
            remove_table(self._directory, table.name)
        self.describe(description)
        self._files = {
            table.kind: (
                AppendedTable(self._directory / table.name, table.names, wanted=False),
                table.names,
            )
            for table in _TABLES
            if table.kind is not Truth
        }

    def describe(self, description: Description) -> None:
        """Replace the description of the run."""
        write_description(self._directory / "run.toml", description)

    def write(self, observations: Iterable[Observation]) -> None:
        """Add observations, in the order of their arrival."""
        for observation in observations:
            table, names = self._files[type(observation)]
            table.add(([getattr(observation, name) for name in names],))

    @property
    def tables(self) -> tuple[AppendedTable, ...]:
        """The files."""
        return tuple(table for table, _ in self._files.values())

    def close(self) -> None:
        """Write what waits; OSError where something could not be written."""
        close_all(self.tables)


@dataclass(frozen=True)
class _Table:
    """One file of the run directory, whose columns are the fields of the class of its rows."""

    name: str
    kind: type

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [field.name for field in fields(self.kind)]

    def read(self, directory: Path, counters: Counter[str]) -> list[Any]:
        """Rows in the order of the file."""
        path = find_table(directory, self.name)
        if path is None:
            return []
        rows: list[Any] = []
        defaults = [field.default for field in fields(self.kind)]
        for line, cells in numbered_rows(path, read_text(path), _columns_of(self.kind), counters):
            known = zip(cells, defaults, strict=True)
            row = self.kind(*(default if cell is None else cell for cell, default in known))
            if isinstance(row, Range) and row.node == row.peer:
                raise DataError(
                    f"{path}: line {line}: column peer: node {row.node} ranges to itself"
                )
            rows.append(row)
        newest = accumulate((row.time_s for row in rows), max)
        counters["unsorted_rows"] += sum(
            row.time_s < before_s - ARRIVES_WITHIN_S
            for row, before_s in zip(rows, newest, strict=True)
        )
        return rows


def _columns_of(kind: type) -> list[Column]:
    """Return a column a field: what has a default may be missing, and the type says how to read it.

    A number is within the bounds of the quantity that the field is named after.
    """
    hints, columns = get_type_hints(kind), []
    for one in fields(kind):
        name, (_, plain) = one.name, plain_type(hints[one.name])
        parsers: dict[type, Parser] = {
            float: bounded(name), int: bounded_whole(name), bool: flag, str: str,
        }  # fmt: skip
        parse = node_id if name in ("node", "peer") else parsers[plain]
        columns.append(Column(name, parse, one.default is not MISSING))
    return columns


_TABLES = (
    _Table("motion.csv", Motion),
    _Table("ranges.csv", Range),
    _Table("height.csv", Height),
    _Table("heading.csv", Heading),
    _Table("events.csv", Event),
    _Table("status.csv", Status),
    _Table("steps.csv", Step),
    _Table("truth.csv", Truth),
)
RECEIVED = "received"
"""Folder of a session with the run that it received."""

TABLE_NAMES = (*(table.name for table in _TABLES), "imu.csv", "landmarks.csv")
"""The tables of a run directory."""


def holds_run(directory: Path) -> bool:
    """Return whether a folder has one of the tables of a run."""
    return any(find_table(directory, name) for name in TABLE_NAMES)


def _by_kind(rows: Iterable[Observation | Truth]) -> dict[type, list[Any]]:
    by_kind: dict[type, list[Any]] = {table.kind: [] for table in _TABLES}
    for row in rows:
        by_kind[type(row)].append(row)
    return by_kind


def _priors_from_truth(run: Run) -> dict[int, Prior]:
    if not run.truth:
        raise DataError(
            f"{run.name}: the initial pose is to come from the truth, but there is none"
        )
    starts: dict[int, float] = {}
    for measurement in run.measurements:
        starts.setdefault(measurement.node, measurement.time_s)
    priors: dict[int, Prior] = {}
    for row in run.truth:
        if row.node in priors:
            continue
        late_s = row.time_s - starts.get(row.node, row.time_s)
        if late_s > PRIOR_FROM_TRUTH_WITHIN_S:
            continue
        priors[row.node] = Prior(
            row.node,
            row.x_m,
            row.y_m,
            row.heading_rad if row.heading_rad is not None else 0.0,
            sigma_rad=0.0 if row.heading_rad is not None else math.inf,
        )
    return priors
