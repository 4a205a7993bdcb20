"""Output of the commands: results on stdout, progress and remarks on stderr."""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from threading import Timer
from typing import TYPE_CHECKING, Any

import typer

from relpos.errors import DataError, RelposError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from relpos.evaluation.bounds import Totals
    from relpos.evaluation.consistency import Nees
    from relpos.evaluation.iso18305 import Assessment
    from relpos.evaluation.metrics import Metrics
    from relpos.evaluation.regions import Ambiguity
    from relpos.evaluation.scoring import Evaluation
    from relpos.evaluation.vertical import Vertical
    from relpos.fusion.estimator import Estimate

PROGRESS_AFTER_S = 1.0
"""A quicker stage shows nothing; the promise is two seconds."""

FEW_PARTS = 10
"""A stage of fewer parts reports too seldom: a log announces it by a line."""

STAGES = {"compiling": "compiling the estimator, once after an installation"}
"""Stages of :func:`relpos.fuse` in the words of the command line."""

PLAIN_PROGRESS_EVERY_S = 5.0
"""Interval of progress lines in a log, which must not be flooded."""


def print_json(document: Mapping[str, Any]) -> None:
    """Print one JSON document, the only thing on stdout."""
    typer.echo(json.dumps(document, allow_nan=False))


def remark(words: str) -> None:
    """Print a remark beside the result, on stderr."""
    typer.echo(words, err=True)


def console() -> Console:
    """Return where tables go: a pipe has no width, and 80 columns are too narrow for them."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 120, highlight=False)


def table(
    columns: Iterable[str],
    left: Container[str],
    *,
    title: str | None = None,
    caption: str | None = None,
) -> Table:
    """Return an empty table; the columns that are not ``left`` hold figures."""
    from rich.table import Table

    made = Table(title=title, caption=caption)
    for column in columns:
        made.add_column(column, justify="left" if column in left else "right")
    return made


def parse_settings(pairs: Sequence[str]) -> dict[str, str]:
    """Split the ``--set KEY=VALUE`` options; wrong usage where there is no ``=``."""
    settings: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key.strip() and equals and value.strip()):
            raise typer.BadParameter(f"'{pair}' is not KEY=VALUE", param_hint="--set")
        settings[key.strip()] = value.strip()
    return settings


def keep_recording(out: Path, command: str, made: str) -> None:
    """Refuse to replace a run that ``command`` has not ``made``: nobody could make it again."""
    from relpos.runs.description import read_description
    from relpos.runs.run import holds_run

    if not holds_run(out):
        return
    source = read_description(out / "run.toml").source or ""
    if not source.startswith(f"relpos {command} "):
        raise RelposError(f"{out}: holds a run that was not {made}: choose another --out")


def check_folder(folder: Path) -> None:
    """Refuse a folder in which nothing can be written, before minutes are computed. DataError."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        # Rights alone do not tell: of /proc, or of a disk that is mounted to be read.
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        for path in new:
            with suppress(OSError):
                path.rmdir()


def check_file(path: Path) -> None:
    """Refuse a file that cannot be written; see :func:`check_folder`. DataError."""
    if path.is_dir():
        raise DataError(f"{path}: a directory, where a file is to be written")
    check_folder(path.parent)


class Progress:
    """Shows how far a task is: a bar in a terminal, a line every few seconds in a log.

    Call it with the stage of the task, and how many of how many parts are done; a total of 0 says
    that the length is not known, None that there is no end. Quick stages show nothing.
    """

    def __init__(self) -> None:
        from rich.console import Console

        self._console = Console(stderr=True)
        # Asking each time takes a live session of 130 calls a second a hundredth of a core.
        self._in_terminal = self._console.is_terminal
        self._stage: str | None = None
        self._bar: Any = None
        self._started_s = self._printed_s = 0.0
        self._late: Timer | None = None

    def __call__(self, stage: str, done: int, total: int | None) -> None:
        """Show the stage."""
        now_s = time.monotonic()
        if stage != self._stage:
            self.close()
            self._stage, self._started_s, self._printed_s = stage, now_s, now_s
            if total is not None and total < FEW_PARTS and not self._in_terminal:
                # Only a stage that really takes long is announced: a quick failure stays one line.
                self._late = Timer(PROGRESS_AFTER_S, remark, args=(f"{stage} ...",))
                self._late.daemon = True
                self._late.start()
        if self._in_terminal:
            self._draw(stage, done, total, now_s)
        elif done and now_s - self._printed_s > PLAIN_PROGRESS_EVERY_S:
            self._printed_s = now_s
            remark(f"{stage}: {100 * done // total} %" if total else f"{stage}: {done}")

    def _draw(self, stage: str, done: int, total: int | None, now_s: float) -> None:
        from rich.progress import Progress as Bar

        if self._bar is None:
            if total and now_s - self._started_s < PROGRESS_AFTER_S:
                return
            self._bar = Bar(console=self._console, transient=True)
            self._bar.start()
            self._bar.add_task(stage, total=total or None)
        self._bar.update(self._bar.task_ids[0], completed=done, total=total or None)

    def close(self) -> None:
        """Remove what is shown."""
        if self._late is not None:
            self._late.cancel()
        if self._bar is not None:
            self._bar.stop()
        self._stage = self._late = self._bar = None


@contextmanager
def progress(
    words: Mapping[str, str] | None = None,
) -> Iterator[Callable[[str, int, int | None], None]]:
    """Yield a callback for long tasks of :mod:`relpos.api`; ``words``: stage -> what is shown."""
    shown = Progress()
    names = words or {}
    try:
        yield lambda stage, done, total: shown(names.get(stage, stage), done, total)
    finally:
        shown.close()


@contextmanager
def working(label: str) -> Iterator[None]:
    """Show a task of unknown length."""
    with progress() as show:
        show(label, 0, 0)
        yield


def print_evaluation(score: Evaluation) -> None:
    """Print all figures of one estimate."""
    print_metrics(score.run, score.metrics)
    if score.nees_position is not None and score.nees_heading is not None:
        print_nees(score.nees_position, score.nees_heading)
    if score.ambiguity is not None:
        print_ambiguity(score.ambiguity)
    print_iso(score.iso)
    if score.vertical is not None:
        print_vertical(score.vertical)
    if score.bound is not None:
        print_bound(score.bound)


FRAMES = {
    "as_given": "as given, in the truth's frame",
    "per_run": "one motion of the plane for the run",
    "per_epoch": "one motion of the plane a second",
}
"""Alignments of the estimate with the truth, in the words of tables."""


def print_iso(iso: Assessment) -> None:
    """Print the metrics of ISO/IEC 18305, a row for each way of alignment."""
    if not iso.known:
        return
    columns = ["aligned by", "mean", "RMS", "CE50", "CE95", "VE50", "VE95", "SE50", "SE95"]
    caption = f"coverage {100.0 * iso.coverage:.1f} %"
    shown = table(columns, columns[:1], title="ISO/IEC 18305", caption=caption)
    for frame, one in iso.frames.items():
        flat = one.horizontal
        shown.add_row(
            FRAMES[frame],
            *(metres(v) for v in (flat.mean_m, flat.rms_m, flat.e50_m, flat.e95_m)),
            *(
                metres(v)
                for kind in (one.vertical, one.spherical)
                for v in (kind.e50_m, kind.e95_m)
            ),
        )
    console().print(shown)


def print_vertical(found: Vertical) -> None:
    """Print heights, floors and stairs against the truth, a figure a line."""
    for name, words in found.lines():
        print(f"{name:<25}{words}")


def print_metrics(title: str, metrics: Metrics, baseline: Metrics | None = None) -> None:
    """Print a table per pair, the team's figures and how they go over time."""
    out = console()
    if metrics.time_s.size:
        title += f", the end at {metrics.time_s[-1]:.0f} s"
    columns = [
        "pair", "estimated (end)", "true (end)", "error (end)", "RMSE", "mean error", "body frame",
        "NEES",
    ]  # fmt: skip
    columns += ["dead reckoning RMSE"] * (baseline is not None)
    pairs = table(columns, ("pair",), title=title, caption=f"{metrics.epochs} whole seconds scored")
    for k, (pair, figures) in enumerate(metrics.pairs.items()):
        ends = [
            (float(e), float(t))
            for e, t in zip(
                metrics.pair_distance_m[:, k], metrics.pair_true_distance_m[:, k], strict=True
            )
            if math.isfinite(e) and math.isfinite(t)
        ]
        estimated, true = ends[-1] if ends else (math.nan, math.nan)
        cells = [
            metres(estimated),
            metres(true),
            metres(estimated - true, sign=True),
            metres(figures.distance_rmse_m),
            metres(figures.distance_error_mean_m, sign=True),
            metres(figures.body_frame_rmse_m),
            plain(figures.nees_distance),
        ]
        if baseline is not None:
            other = baseline.pairs.get(pair)
            cells.append(metres(other.distance_rmse_m if other else math.nan))
        pairs.add_row(f"{pair[0]} - {pair[1]}", *cells)
    out.print(pairs)
    out.print(f"relative distance RMSE   {metres(metrics.relative_distance_rmse_m)}")
    out.print(f"aligned position RMSE    {metres(metrics.relative_position_rmse_m)}")
    out.print(f"body-frame RMSE          {metres(metrics.body_frame_rmse_m)}")
    from relpos.evaluation import consistency

    chance = consistency.of_distances([metrics])
    left_out = f"; {metrics.nees_left_out} rows with sigma 0 left out" * bool(metrics.nees_left_out)
    out.print(
        f"NEES of the distance     {plain(metrics.nees_distance)} (1 is honest, "
        f"{plain(chance.low)} to {plain(chance.high)} by chance{left_out})"
    )
    if baseline is not None:
        factor = baseline.relative_distance_rmse_m / metrics.relative_distance_rmse_m
        out.print(
            f"dead reckoning           {metres(baseline.relative_distance_rmse_m)} relative "
            f"distance RMSE, {plain(factor)} times the fusion's"
        )
    _print_over_time(out, metrics)


def print_nees(position: Nees, heading: Nees) -> None:
    """Print the consistency of absolute poses, where estimate and truth have one frame."""
    for what, nees in (("positions", position), ("headings", heading)):
        console().print(
            f"NEES of the {what:<12} {plain(nees.mean)} "
            f"({plain(nees.low)} to {plain(nees.high)} by chance)"
        )


def print_bound(bound: Totals) -> None:
    """Print the Cramer-Rao bound: the least root mean square errors of any estimator."""
    for what, distance, position in (
        ("on line", bound.filtering_distance_m, bound.filtering_position_m),
        ("smoothed", bound.smoothing_distance_m, bound.smoothing_position_m),
    ):
        console().print(
            f"bound {what:<18} {metres(distance)} relative distance, {metres(position)} aligned"
        )


def print_ambiguity(ambiguity: Ambiguity) -> None:
    """Print how often the regions of ambiguous nodes contained the truth, and their area."""
    held = ambiguity.coverage
    typer.echo(
        f"while ambiguous          the 90 % region held the truth in {100.0 * held.share:.0f} % "
        f"of {ambiguity.looks} looks ({100.0 * held.low:.0f} to {100.0 * held.high:.0f} %); "
        f"{ambiguity.area_m2:.0f} m2 on average, a blind guess {ambiguity.blind_m2:.0f} m2"
    )


def print_last_pairs(
    title: str, estimates: Sequence[Estimate], scored_s: float | None = None
) -> None:
    """Print the relative positions at the end, or at the last second that is scored."""
    out = console()
    if not estimates:
        out.print(f"{title}: nothing could be estimated")
        return
    last = estimates[-1]
    if scored_s is not None:
        last = min(reversed(estimates), key=lambda estimate: abs(estimate.time_s - scored_s))
    out.print(f"{title}, at {last.time_s:.1f} s")
    pairs = table(("pair", "distance", "sigma", "bearing", "sigma "), ("pair",))
    for pair in last.pairs:
        pairs.add_row(
            f"{pair.node} - {pair.peer}",
            metres(pair.distance_m),
            metres(pair.sigma_distance_m),
            degrees(pair.bearing_rad),
            degrees(pair.sigma_bearing_rad),
        )
    out.print(pairs)
    states = [f"{node.node} {node.status}" for node in last.nodes if node.status != "ok"]
    if states:
        out.print(f"not located for sure: {', '.join(states)}")
    if last.alternatives:
        shares = {a.alternative: a.probability for a in last.alternatives}
        rings = sorted({a.node for a in last.alternatives if a.shape == "ring"})
        out.print(
            f"{len(shares)} possible modes (alternatives.csv): "
            + ", ".join(f"{100.0 * share:.0f} %" for share in shares.values())
            + (f"; somewhere on a ring: {', '.join(map(str, rings))}" if rings else "")
        )


def _print_over_time(out: Console, metrics: Metrics) -> None:
    import numpy as np

    if metrics.time_s.size < 2:
        return
    edges = np.linspace(metrics.time_s[0], metrics.time_s[-1] + 1e-9, 7)
    columns = ("seconds", "distance RMSE", "aligned RMSE", "body frame", "NEES")
    rows = table(columns, (), title="over time")
    for first, last in pairwise(edges):
        inside = (metrics.time_s >= first) & (metrics.time_s < last)
        if not inside.any():
            continue
        rows.add_row(
            f"{first:.0f} to {last:.0f}",
            metres(_root_mean_square(metrics.distance_rmse_over_time_m[inside])),
            metres(_root_mean_square(metrics.position_rmse_over_time_m[inside])),
            metres(_root_mean_square(metrics.body_frame_rmse_over_time_m[inside])),
            plain(_mean(metrics.nees_over_time[inside])),
        )
    out.print(rows)


def _mean(values: Any) -> float:
    finite = [float(v) for v in values if math.isfinite(v)]
    return sum(finite) / len(finite) if finite else math.nan


def _root_mean_square(values: Any) -> float:
    mean = _mean(values**2)
    return math.sqrt(mean) if math.isfinite(mean) else math.nan


def metres(value: float, *, sign: bool = False) -> str:
    """Format two decimals and the unit; a dash for an unknown value."""
    if not math.isfinite(value):
        return "-"
    return f"{value:+.2f} m" if sign else f"{value:.2f} m"


def degrees(value_rad: float) -> str:
    """Format whole degrees; a dash for an unknown value."""
    return f"{math.degrees(value_rad):.0f} deg" if math.isfinite(value_rad) else "-"


def plain(value: float) -> str:
    """Format two decimals; a dash for an unknown value."""
    return f"{value:.2f}" if math.isfinite(value) else "-"
