"""Tables for pandas: the run format's files with the wearers' names and true distances beside.

What is added are columns, which every reader of the run format ignores: the tables are a run
directory and an estimate directory still.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from relpos.exchange.content import Content
from relpos.runs.appending import write_rows
from relpos.runs.estimates import write_estimates
from relpos.runs.run import TABLE_NAMES, save_run
from relpos.tracks import Track, sample, true_tracks

_OF_PAIRS = ("pairs.csv", "ranges.csv")
_AS_THEY_ARE = ("landmarks.csv", "imu.csv")
"""Without a node, or without end: names would double raw inertial data."""

_Rows = list[dict[str, str]]


def write_tables(content: Content, directory: Path) -> list[Path]:
    """Write every table there is something for, one header line each; return them."""
    directory.mkdir(parents=True, exist_ok=True)
    save_run(content.run, directory)
    # Other files in there are not relpos's to change.
    written = {path for name in TABLE_NAMES if (path := directory / name).exists()}
    if content.estimates:
        written |= {*write_estimates(directory, content.estimates, steps=content.run.steps)}
    paths = sorted(written)
    true = true_tracks(content.run.truth)
    for path in paths:
        if path.name not in _AS_THEY_ARE:
            _extend(path, content, true)
    return paths


def _extend(path: Path, content: Content, true: Mapping[int, Track]) -> None:
    names = {str(node): content.name_of(node) for node in content.node_ids} | {"": ""}
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        header = list(reader.fieldnames or [])
        rows: _Rows = list(reader)
    columns: dict[str, Sequence[object]] = {
        f"{who}_name": [names.get(row[who], f"node {row[who]}") for row in rows]
        for who in ("node", "peer")
        if who in header
    }
    if path.name in _OF_PAIRS and true:
        columns["true_distance_m"] = _true_distances(rows, true)
    if content.start_unix_s is not None:
        start_unix_s = content.start_unix_s
        columns["unix_s"] = [f"{start_unix_s + float(row['time_s']):.6f}" for row in rows]
    write_rows(
        path,
        [*header, *columns],
        (
            [*row.values(), *(column[k] for column in columns.values())]
            for k, row in enumerate(rows)
        ),
    )


def _true_distances(rows: _Rows, true: Mapping[int, Track]) -> list[object]:
    """Return the true distance of each row's two nodes at its time; empty where not known."""
    of_pair: dict[tuple[int, int], list[int]] = {}
    for k, row in enumerate(rows):
        of_pair.setdefault((int(row["node"]), int(row["peer"])), []).append(k)
    distances: list[object] = [""] * len(rows)
    for (node, peer), places in of_pair.items():
        if node not in true or peer not in true:
            continue
        at_s = np.array([float(rows[k]["time_s"]) for k in places])
        position_m, _ = sample([true[node], true[peer]], at_s)
        distance_m = np.hypot(*(position_m[:, 1] - position_m[:, 0]).T)
        for k, value in zip(places, distance_m.tolist(), strict=True):
            distances[k] = round(value, 4)
    return distances
