"""A run and its estimates as a recording; a recording once more, whole and closed."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from relpos.errors import DataError
from relpos.fusion.estimator import Estimate
from relpos.recording import container, topics
from relpos.recording.about import DESCRIPTION, About
from relpos.recording.encoder import Encoder
from relpos.recording.reader import Recording
from relpos.recording.schemas import all_topics
from relpos.runs.description import description_text
from relpos.runs.run import Run

BLOCK_BYTES = 1 << 20


def save(
    path: Path,
    run: Run,
    estimates: Sequence[Estimate],
    started_unix_ns: int,
    source: Recording | None,
) -> list[str]:
    """See :func:`relpos.recording.save_recording`."""
    try:
        with path.open("xb") as out:
            if source is None:
                remarks = _write_run(out, run, estimates, started_unix_ns)
            else:
                remarks = _write_again(out, run, source)
        container.finish(path)
    except FileExistsError:
        raise DataError(f"{path} exists already: a recording is not overwritten") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    return remarks


def _write_run(
    out: IO[bytes], run: Run, estimates: Sequence[Estimate], started_unix_ns: int
) -> list[str]:
    about = About(
        started_unix_ns, source=run.name, description=replace(run.description, name=run.name)
    )
    every = all_topics()
    out.write(container.beginning(about.metadata(), every))
    writer = _Writer(out, Encoder(started_unix_ns, run.description.names), every)
    for landmark in run.landmarks:
        writer.add_row(0.0, landmark)
    for time_s, item in _by_time(run, estimates):
        if isinstance(item, Estimate):
            writer.add(time_s, item)
        else:
            writer.add_row(time_s, item)
    writer.end()
    imu = run.directory is not None and any(run.directory.glob("imu.csv*"))
    return [f"{run.directory}: imu.csv has no place in a recording and stays there"] * imu


def _write_again(out: IO[bytes], run: Run, source: Recording) -> list[str]:
    lost, newest = 0, -1
    about = source.about if source.files[0].head_damaged else None
    if about is not None:
        out.write(container.beginning(about.metadata(), all_topics()))
    else:
        out.write(container.MAGIC)
    for file in source.files:
        with file.path.open("rb") as stream:
            is_first = file is source.files[0] and about is None
            unread, newest = container.copy_blocks(stream, out, newest, beginning=is_first)
            lost += unread
    there = {channel.topic: number for number, channel in source.files[0].channels.items()}
    further = [topic for topic in all_topics() if topic.name not in there]
    free = max(there.values(), default=0) + 1
    numbers = there | {topic.name: free + k for k, topic in enumerate(further)}
    out.write(container.channel_records(numbers, further))
    if run.description != (source.about.description if source.about else None):
        text = description_text(replace(run.description, name=run.name))
        out.write(container.metadata_record(DESCRIPTION, {"text": text}))
    encoder = Encoder(source.started_unix_ns or 0, run.description.names)
    writer = _Writer(out, encoder, (), numbers)
    known = source.run
    for landmark in run.landmarks:
        if landmark not in known.landmarks:
            writer.add_row(0.0, landmark)
    if run.truth != known.truth:
        for row in run.truth:
            writer.add_row(row.time_s, row)
    writer.end()
    return [f"{lost} bytes could not be read and are left out"] * bool(lost)


def _by_time(run: Run, estimates: Sequence[Estimate]) -> Iterator[tuple[float, Any]]:
    rows = (run.measurements, run.events, run.statuses, run.steps, run.truth, estimates)
    timed = ([(row.time_s, k, n, row) for n, row in enumerate(same)] for k, same in enumerate(rows))
    for time_s, _, _, row in heapq.merge(*timed, key=lambda entry: entry[:3]):
        yield time_s, row


class _Writer:
    """Blocks of a size that viewers like, one after the other."""

    def __init__(
        self,
        out: IO[bytes],
        encoder: Encoder,
        every: Sequence[topics.Topic],
        numbers: dict[str, int] | None = None,
    ) -> None:
        self._out = out
        self._encoder = encoder
        self._block = container.Block(container.numbered(every) if numbers is None else numbers)

    def add_row(self, time_s: float, row: Any) -> None:
        """Add an observation, a truth or a landmark."""
        self.add(time_s, (row,))

    def add(self, time_s: float, item: Any) -> None:
        for message in self._encoder.messages(time_s, item):
            self._block.add(message)
        if len(self._block) > BLOCK_BYTES:
            self.end()

    def end(self) -> None:
        """Write the open block."""
        if len(self._block):
            self._out.write(self._block.pop())
