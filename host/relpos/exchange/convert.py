"""Reading any source into content, and writing content in another format."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

from relpos.errors import DataError
from relpos.exchange.content import (
    PLACED,
    Content,
    Point,
    as_estimates,
    as_truth,
    points_of,
)
from relpos.exchange.formats import TRAITS, Format, Kind, format_of
from relpos.exchange.times import iso_of, possible
from relpos.geodesy import MapFrame, Pin, place
from relpos.measurements import BOUNDS, Truth, out_of_bounds
from relpos.recording import is_recording, open_recording, save_recording
from relpos.runs.estimates import read_estimates, read_initial, write_estimates
from relpos.runs.landmarks import PRESS, Landmark, read_landmarks, truth_from_presses
from relpos.runs.run import RECEIVED, TABLE_NAMES, Run, holds_run, load_run, save_run
from relpos.runs.table import MOST_WHOLE, find_table, remove_table

_Written = tuple[list[Path], list[str]]

_ESTIMATE_TABLES = (
    "estimate.csv",
    "pairs.csv",
    "alternatives.csv",
    "parameters.csv",
    "initial.csv",
    "summary.json",
)


@dataclass(frozen=True)
class Hints:
    """Facts from the user that the source does not state.

    ``run`` is the recording that the source belongs to; ``format``, ``kind`` and ``node`` say
    what a trajectory is; ``start_unix_s`` when the run's second 0 was.
    """

    format: Format | None = None
    run: Path | None = None
    kind: Kind | None = None
    node: int | None = None
    start_unix_s: float | None = None
    pins: tuple[Pin, ...] = ()


def read(source: Path, hints: Hints) -> Content:
    """Read whatever ``source`` is; DataError where it is nothing that is known."""
    form = hints.format or _format_of(source)
    if not TRAITS[form].readable:
        raise DataError(f"{source}: {form} is written, not read; convert its source instead")
    if form is Format.MCAP:
        return _started(_read_mcap(source), hints)
    if form in (Format.RUN, Format.CSV):
        return _started(_read_directory(source, hints), hints)
    return _read_tracks(source, form, _started(_base(source, hints), hints), hints)


def _format_of(source: Path) -> Format:
    if not source.exists():
        raise DataError(f"{source}: no such file or directory")
    if source.is_dir():
        estimated = find_table(source, "estimate.csv")
        if (source / "run.toml").exists() or estimated or holds_run(source):
            return Format.RUN
        if any(source.glob("*.tum")):
            return Format.TUM
        raise DataError(f"{source}: neither a run nor an estimate nor TUM trajectories in there")
    if is_recording(source):
        return Format.MCAP
    form = format_of(source)
    if form is None:
        raise DataError(f"{source}: of what format is it? (--from {', '.join(Format)})")
    return form


def _base(source: Path, hints: Hints) -> Content:
    """Return the recording that the source belongs to; an empty one where none is named."""
    if hints.run is None:
        return Content(Run(name=source.resolve().stem))
    form = _format_of(hints.run)
    if form is Format.MCAP:
        return _read_mcap(hints.run)
    if form is not Format.RUN:
        raise DataError(f"{hints.run}: neither a run directory nor a recording")
    return _of_run(hints.run)


def _of_run(directory: Path) -> Content:
    run = load_run(directory)
    return Content(run, remarks=_press_remarks(run))


def _read_directory(source: Path, hints: Hints) -> Content:
    estimates = tuple(read_estimates(source)) if find_table(source, "estimate.csv") else ()
    priors = read_initial(source) if estimates else None
    received = source / RECEIVED
    if hints.run is not None:
        content = _base(source, hints)
    elif estimates and received.is_dir():
        content = _of_run(received)
        content = replace(content, run=replace(content.run, name=source.resolve().name))
    else:
        content = _of_run(source)
    if not estimates:
        return content
    return replace(content, estimates=estimates, priors=priors, recording=None)


def _press_remarks(run: Run) -> tuple[str, ...]:
    presses = truth_from_presses(run.landmarks, run.events, run.node_ids)
    return tuple(presses.remarks()) if presses.truth == run.truth else ()


def _started(content: Content, hints: Hints) -> Content:
    if hints.start_unix_s is None:
        return content
    return replace(content, start_unix_s=hints.start_unix_s)


def _read_mcap(source: Path) -> Content:
    opened = open_recording(source)
    if next(opened.entries(), None) is None:
        raise DataError(f"{source}: empty: nothing was recorded")
    run = opened.run
    start_unix_s = None if opened.started_unix_ns is None else opened.started_unix_ns * 1e-9
    remarks = (*opened.remarks, *_press_remarks(run))
    return Content(run, tuple(opened.estimates()), start_unix_s, remarks, opened)


def _read_tracks(source: Path, form: Format, base: Content, hints: Hints) -> Content:
    """Lay the trajectories of the source over the recording that they belong to."""
    if not source.exists():
        raise DataError(f"{source}: no such file or directory")
    remarks: list[str] = list(base.remarks)
    start_unix_s = base.start_unix_s
    points: dict[Kind, list[Point]]
    landmarks: Sequence[Landmark] = ()
    if form is Format.TUM:
        from relpos.exchange import tum

        files = tum.find_files(source)
        if not files:
            raise DataError(f"{source}: no trajectories (*.tum) in there")
        points = tum.read_files(files, hints.node, hints.kind, start_unix_s)
    else:
        frame, words = frame_of(base, hints.pins, Kind.TRUTH if base.run.truth else Kind.ESTIMATE)
        remarks += words
        maps = _maps_of(form)
        if form is Format.GPX and start_unix_s is None:
            start_unix_s = maps.first_time(source)
            if start_unix_s is not None:
                first = iso_of(start_unix_s)
                remarks.append(
                    f"second 0 is {first}, the file's first time (--start says otherwise)"
                )
        points = maps.read_tracks(source, frame, start_unix_s, node=hints.node, kind=hints.kind)
        landmarks = maps.read_landmarks(source, frame)
    if not points and not landmarks:
        raise DataError(f"{source}: neither tracks nor landmarks in it")
    _check(source, [p for own in points.values() for p in own], landmarks)
    run, estimates = base.run, base.estimates
    if points.get(Kind.TRUTH):
        run = replace(run, truth=as_truth(points[Kind.TRUTH]))
    if landmarks:
        run = replace(run, landmarks=tuple(landmarks))
    if points.get(Kind.ESTIMATE):
        try:
            estimates = as_estimates(points[Kind.ESTIMATE])
        except DataError as error:
            raise DataError(f"{source}: {error}") from None
    untouched = base.recording if not points.get(Kind.ESTIMATE) else None
    return Content(run, estimates, start_unix_s, tuple(remarks), untouched)


def _check(source: Path, points: Sequence[Point], landmarks: Sequence[Landmark]) -> None:
    """Raise DataError where a run with these rows could not be read."""
    surveyed = [Truth(0.0, 0, mark.x_m, mark.y_m, None, mark.z_m) for mark in landmarks]
    for row in (*as_truth(points), *surveyed):
        field = "node" if row.node > MOST_WHOLE else out_of_bounds(row)
        if field is not None:
            low, high = BOUNDS.get(field, (0, MOST_WHOLE))
            words = f"{field} {getattr(row, field):g} is not between {low:g} and {high:g}"
            raise DataError(f"{source}: at {row.time_s:g} s: {words}")


def _maps_of(form: Format) -> ModuleType:
    """Return the module of a format of maps; what they offer has the same names in each."""
    if form is Format.GPX:
        from relpos.exchange import gpx

        return gpx
    from relpos.exchange import geojson

    return geojson


def frame_of(content: Content, pins: Sequence[Pin], kind: Kind) -> tuple[MapFrame, tuple[str, ...]]:
    """Return where on the map the content lies, pinned nodes looked up in its tracks."""
    placing = place(pins, content.locate(kind))
    return placing.frame, placing.remarks


def with_landmarks(content: Content, path: Path, pins: Sequence[Pin]) -> Content:
    """Turn the run's landmark presses into its truth, by a table of surveyed landmarks.

    DataError where the run has another truth already, no presses, or none that counts.
    """
    run = content.run
    own = truth_from_presses(run.landmarks, run.events, run.node_ids)
    if run.truth and own.truth != run.truth:
        raise DataError(
            f"{run.name}: has a truth of its own (truth.csv) already; move it away to have the "
            "presses' instead"
        )
    form = format_of(path)
    remarks: tuple[str, ...] = tuple(r for r in content.remarks if r not in own.remarks())
    landmarks: Sequence[Landmark]
    if form is not None and TRAITS[form].on_map:
        frame, words = frame_of(content, pins, Kind.TRUTH)
        remarks += words
        landmarks = _maps_of(form).read_landmarks(path, frame)
    else:
        landmarks = read_landmarks(path)
    if not landmarks:
        raise DataError(f"{path}: no landmark in it")
    pressed = sum(event.event == PRESS for event in run.events)
    if not pressed:
        raise DataError(f"{run.name}: no landmark was pressed (event 'landmark' in events.csv)")
    presses = truth_from_presses(landmarks, run.events, run.node_ids)
    if not presses.truth:
        raise DataError(f"{run.name}: no press counts: {'; '.join(presses.remarks())}")
    run = replace(run, landmarks=tuple(landmarks), truth=presses.truth)
    summary = f"truth from {len(presses.truth)} of {pressed} landmark presses"
    return replace(content, run=run, remarks=(*remarks, summary, *presses.remarks()))


def located_alone(content: Content) -> Content:
    """Leave out of the estimates what is no position: nodes ambiguous or not located."""
    return replace(
        content,
        recording=None,
        estimates=tuple(
            replace(e, nodes=tuple(n for n in e.nodes if n.status in PLACED))
            for e in content.estimates
        ),
    )


def write(
    content: Content, form: Format, out: Path, *, pins: Sequence[Pin] = (), overwrite: bool = False
) -> _Written:
    """Write the content to ``out``; return the files and remarks about them.

    What is there already is left alone unless ``overwrite``; then what an earlier conversion to
    the same format left is removed, because it is no part of this one.
    """
    if content.start_unix_s is not None:
        # A recording's or a GPX file's own start may be anything.
        where = f"{content.run.name}: second 0 of the run (--start says otherwise)"
        possible(content.start_unix_s, iso_of(content.start_unix_s), where)
    _make_room(out, form, overwrite=overwrite)
    if TRAITS[form].one_file:
        out.parent.mkdir(parents=True, exist_ok=True)
        on_map = TRAITS[form].on_map
        return _write_map(content, form, out, pins) if on_map else _WRITERS[form](content, out)
    return _write_folder(content, form, out)


def _write_folder(content: Content, form: Format, out: Path) -> _Written:
    """Write all files of a format beside the old ones, and put them in their place together."""
    new = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    try:
        with TemporaryDirectory(prefix=".part-", dir=out) as beside:
            part = Path(beside) / out.resolve().name  # A bag's files are named after the folder.
            try:
                files, remarks = _WRITERS[form](content, part)
            except OSError as error:
                at = Path(error.filename or part)
                if at.is_relative_to(part):
                    error.filename = str(out / at.relative_to(part))
                raise
            _remove_old(out, form)
            for path in part.iterdir():
                path.replace(out / path.name)
    finally:
        if new and not any(out.iterdir()):
            out.rmdir()
    return [out / path.name for path in files], remarks


def _make_room(out: Path, form: Format, *, overwrite: bool) -> None:
    if TRAITS[form].one_file:
        if out.is_dir():
            raise DataError(f"{out}: a directory; {form} is one file")
        if out.exists() and not overwrite:
            raise DataError(f"{out}: is there already (--overwrite replaces it)")
        return
    if out.exists() and not out.is_dir():
        raise DataError(f"{out}: a file; {form} is a directory")
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        raise DataError(f"{out}: is there already and not empty (--overwrite replaces it)")


def _remove_old(out: Path, form: Format) -> None:
    """Remove what an earlier conversion to the same format has left, and nothing of others."""
    old: list[Path] = []
    if form is Format.TUM:
        ours = re.compile(rf"({'|'.join(Kind)})_[0-9]+\.tum")
        old = [path for path in out.iterdir() if ours.fullmatch(path.name)]
    about = out / "metadata.yaml"
    if form is Format.ROSBAG2 and about.is_file():
        # Of the old bag is what it lists; another .mcap is somebody's recording.
        lines = about.read_text(encoding="utf-8", errors="replace").splitlines()
        listed = {line.strip().removeprefix("- ") for line in lines}
        old = [about, *(path for path in out.glob("*.mcap") if path.name in listed)]
    for path in old:
        path.unlink()
    if form in (Format.RUN, Format.CSV):
        for name in (*TABLE_NAMES, *_ESTIMATE_TABLES):
            remove_table(out, name)


def _write_run(content: Content, out: Path) -> _Written:
    save_run(content.run, out)
    if content.estimates:
        write_estimates(out, content.estimates, steps=content.run.steps, priors=content.priors)
    return sorted(out.iterdir()), []


def _write_csv(content: Content, out: Path) -> _Written:
    from relpos.exchange.tables import write_tables

    return write_tables(content, out), []


def _write_mcap(content: Content, out: Path) -> _Written:
    start_ns = 0 if content.start_unix_s is None else round(content.start_unix_s * 1e9)
    # Under its own name only when it is whole.
    part = out.with_name(f"{out.name}.part")
    part.unlink(missing_ok=True)
    try:
        remarks = save_recording(
            part,
            content.run,
            content.estimates,
            started_unix_ns=start_ns,
            source=content.recording,
        )
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    return [out], [*remarks, *_undated(content)]


def _write_tum(content: Content, out: Path) -> _Written:
    from relpos.exchange.tum import file_name, write_tum

    out.mkdir()
    files: list[Path] = []
    remarks: list[str] = []
    for kind in Kind:
        tracks = points_of(content, kind)
        for node, points in tracks.items():
            files.append(out / file_name(kind, node))
            write_tum(files[-1], points)
        for what, field, advice in (
            ("heading", "heading_rad", "compare positions, not angles"),
            ("height", "z_m", "compare x and y alone"),
        ):
            lacking = [n for n, ps in tracks.items() if any(isnan(getattr(p, field)) for p in ps)]
            if lacking:
                remarks.append(
                    f"the {kind} has poses without a {what}, written as {what} 0 (node "
                    f"{', '.join(map(str, lacking))}): {advice}"
                )
    if not files:
        raise DataError(f"{content.run.name}: neither estimates nor truth: fuse it first")
    guesses = sum(n.status not in PLACED for e in content.estimates for n in e.nodes)
    if guesses:
        remarks.append(
            f"{guesses} poses are guesses at nodes not located (--located leaves them out)"
        )
    return files, remarks


def _write_map(content: Content, form: Format, out: Path, pins: Sequence[Pin]) -> _Written:
    kinds = [Kind.ESTIMATE] if content.estimates else []
    remarks: list[str] = []
    if content.run.truth:
        if not kinds or content.one_frame:
            kinds.append(Kind.TRUTH)
        else:
            remarks.append(
                "the truth is left out: the starts were not known, so the estimate has a frame of "
                "its own"
            )
    if not kinds and not content.run.landmarks:
        raise DataError(f"{content.run.name}: neither estimates nor truth: fuse it first")
    frame, words = frame_of(content, pins, kinds[0] if kinds else Kind.TRUTH)
    if content.run.landmarks and Kind.TRUTH not in kinds and content.estimates:
        # They are surveyed in the truth's frame.
        content = replace(content, run=replace(content.run, landmarks=()))
        remarks.append("so are the landmarks, which are surveyed in the truth's")
    if form is Format.GPX and content.start_unix_s is None:
        remarks.append("the points have no times: say when the run's second 0 was (--start)")
    _maps_of(form).write_tracks(out, content, kinds, frame)
    return [out], [*words, *remarks]


def _write_rosbag2(content: Content, out: Path) -> _Written:
    from relpos.exchange.rosbag2 import write_rosbag2

    write_rosbag2(out, content)
    return sorted(out.iterdir()), _undated(content)


def _write_rrd(content: Content, out: Path) -> _Written:
    from relpos.exchange.rrd import write_rrd

    write_rrd(out, content)
    return [out], []


def _undated(content: Content) -> list[str]:
    if content.start_unix_s is not None:
        return []
    return ["its clock begins in 1970: say when the run's second 0 was (--start)"]


_WRITERS: dict[Format, Callable[[Content, Path], _Written]] = {
    Format.RUN: _write_run,
    Format.MCAP: _write_mcap,
    Format.TUM: _write_tum,
    Format.CSV: _write_csv,
    Format.ROSBAG2: _write_rosbag2,
    Format.RRD: _write_rrd,
}
