"""A recording read back: as a run, or as the very inputs of its session."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata

from relpos.errors import DataError
from relpos.fusion.estimator import Estimate, NodeEstimate
from relpos.measurements import BOUNDS, Observation
from relpos.recording import topics
from relpos.recording.about import About
from relpos.recording.container import (
    HEAD_BYTES,
    MAGIC,
    MESSAGE_HEAD,
    Entry,
    Piece,
    Walk,
    numbered,
    parse,
    records_in,
    unpack,
)
from relpos.recording.output import parts_of
from relpos.recording.schemas import all_topics
from relpos.runs.description import Description
from relpos.runs.landmarks import Landmark
from relpos.runs.run import Run, assemble
from relpos.version import __version__

_LATEST_S = BOUNDS["time_s"][1]
MAKE_WHOLE = "`relpos convert FILE --to mcap --out NEW` writes anew what is behind it"


@dataclass
class _File:
    """One part: its metadata, and how complete it is."""

    path: Path
    metadata: dict[str, dict[str, str]]
    channels: dict[int, Channel]
    unread: int
    """Bytes behind the last whole record."""
    damaged: int
    """Chunks whose content is not what was written."""
    closed: bool
    first_ns: int | None
    last_ns: int | None
    head_damaged: bool = False
    """Whether something before its first block is not what was written."""

    def supply_channels(self) -> None:
        """Take those of our files for channels whose own records are damaged."""
        ours = numbered(all_topics())
        known = {n: ours[c.topic] for n, c in self.channels.items() if c.topic in ours}
        wrong = [n for n, number in known.items() if n != number]
        if len(wrong) > len(known) / 2:
            return  # Another version's, which numbers them in another way.
        odd = [n for n in range(1, max(known, default=1)) if n not in known]
        self.head_damaged |= bool(wrong or odd)
        if self.head_damaged:
            for number in wrong:
                del self.channels[number]
            for name, number in ours.items():
                self.channels[number] = Channel(number, name, "json", {}, number)


@dataclass
class Recording:
    """An MCAP file and its further parts; what is in there is read when it is asked for.

    ``about`` is what the recording says of its session, None where it is another program's.
    ``remarks`` says in a line each what the reader should know: an end that is missing, gaps.
    """

    path: Path
    about: About | None
    files: list[_File]

    @classmethod
    def open(cls, path: Path) -> Recording:
        """Look through the file; DataError where it is no recording or cannot be read."""
        files: list[_File] = []
        about: About | None = None
        for part in parts_of(path):
            found = _look_through(part)
            its = None
            try:
                its = About.read(str(part), found.metadata)
            except DataError:
                found.head_damaged = True
            if files and (
                about is None or its is None or its.started_unix_ns != about.started_unix_ns
            ):
                break
            if its is not None:
                about = its if about is None else replace(its, part=about.part)
            files.append(found)
        known = {topic.name for topic in all_topics()}
        there = {channel.topic for file in files for channel in file.channels.values()}
        if about is None and files[0].channels and not known & there:
            raise DataError(f"{path}: an MCAP file, but no recording of relpos: none of its topics")
        for file in files:
            # Another version may have other topics.
            if file.head_damaged or (about is not None and about.version == __version__):
                file.supply_channels()
        recording = cls(path, about, files)
        if about is None and files[0].head_damaged:
            recording.about = recording._about_by_content()
        return recording

    def _about_by_content(self) -> About | None:
        """What can be said of a session whose recording's head is damaged; None where nothing."""
        for entry, entered in self._decoded({topics.SERIAL, *_OBSERVED}, _input):
            at_s = entered.arrival_s if entry.topic == topics.SERIAL else entered.time_s
            # Its bytes alone do not say whether it went on from a session before.
            return About(entry.publish_ns - round(at_s * 1e9), resumed=True)
        return None

    @property
    def started_unix_ns(self) -> int | None:
        """Unix time of the session's second 0; None where the recording does not say."""
        if self.about is None:
            return None
        return self.about.started_unix_ns or None

    @property
    def has_serial(self) -> bool:
        """Whether the bytes of the serial port are there, and not a converted run alone."""
        return any(True for _ in self.entries({topics.SERIAL}))

    @property
    def closed(self) -> bool:
        """Whether every part was closed."""
        return all(file.closed for file in self.files)

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """Remarks about the recording, a line each."""
        remarks: list[str] = []
        for file in self.files:
            if file.head_damaged:
                remarks.append(
                    f"{file.path}: its beginning is damaged: what it says of its session "
                    "(estimator, names, starts) may be missing"
                )
            if file.damaged:
                remarks.append(f"{file.path}: {file.damaged} damaged blocks are left out")
            if file in self._cut_off:
                cut = f", {file.unread} bytes of a last block are cut off" if file.unread else ""
                remarks.append(f"{file.path}: was not closed{cut}; read up to {self._end(file)}")
        if self._beyond_time:
            remarks.append(
                f"{self.path}: lasted {self._lasted_s / 86_400.0:.1f} days: what is behind "
                f"{_LATEST_S / 86_400.0:.0f} days, which no estimator takes, is left out"
            )
        remarks.extend(
            f"{self.path}: not recorded between {gap.from_s:.1f} and {gap.to_s:.1f} s: "
            f"{gap.inputs} reads of the port, {gap.others} estimates"
            for gap in self._rows({topics.GAP})
        )
        return tuple(remarks)

    @property
    def _lasted_s(self) -> float:
        last_ns = max((file.last_ns or 0 for file in self.files), default=0)
        return (last_ns - (self.about.started_unix_ns if self.about else 0)) * 1e-9

    @property
    def _beyond_time(self) -> bool:
        return self.about is not None and self._lasted_s > _LATEST_S

    @property
    def _cut_off(self) -> list[_File]:
        """Files that end too early; one that another part follows may lack a summary."""
        return [f for f in self.files if not f.closed and (f is self.files[-1] or f.unread)]

    def _end(self, file: _File) -> str:
        if file.last_ns is None:
            return "its beginning: nothing had been received"
        start_ns = self.about.started_unix_ns if self.about else file.first_ns or 0
        return f"second {(file.last_ns - start_ns) * 1e-9:.1f}"

    # -- content ----------------------------------------------------------------------------------

    def entries(self, wanted: Collection[str] | None = None) -> Iterator[Entry]:
        """Messages of the wanted topics in the order in which the session had them."""
        newest = -1
        for file in self.files:
            names = {number: channel.topic for number, channel in file.channels.items()}
            with opened(file.path) as stream:
                walk = Walk(stream)
                for piece in walk:
                    try:
                        records = _records_of(piece, walk)
                    except ValueError:
                        continue  # Counted when the file was looked through.
                    for opcode, content in records:
                        if opcode != Opcode.MESSAGE:
                            continue
                        number, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(content)
                        # A part begins with what the one before may hold as well.
                        again = file is not self.files[0] and sequence <= newest
                        newest = max(newest, sequence)
                        topic = names.get(number)
                        if again or topic is None or (wanted is not None and topic not in wanted):
                            continue
                        data = bytes(content[MESSAGE_HEAD.size :])
                        yield Entry(topic, log_ns, publish_ns, sequence, data)

    def inputs(self) -> Iterator[tuple[float, topics.Serial | Observation]]:
        """Yield the inputs of the session in order: reads of the port, and observations of phones.

        With each the session's time at which it did, in seconds.
        """
        for entry, entered in self._decoded({topics.SERIAL, *_PHONE}, _input):
            if isinstance(entered, topics.Serial):
                yield entered.arrival_s, entered
            elif topics.is_input(entered):
                yield self._session_s(entry), entered

    def observations(self) -> Iterator[Observation]:
        """Yield decoded observations, and those of phones, in the order of the session."""
        return self._rows(_OBSERVED)

    def observations_by_arrival(self) -> Iterator[tuple[float, Observation]]:
        """The same, each with the session's time at which it was there."""
        for entry, row in self._decoded(_OBSERVED, _row):
            yield self._session_s(entry), row

    def _session_s(self, entry: Entry) -> float:
        return (entry.log_ns - (self.about.started_unix_ns if self.about else 0)) * 1e-9

    def _rows(self, wanted: Collection[str]) -> Iterator[Any]:
        return (row for _, row in self._decoded(wanted, _row))

    def _decoded(self, wanted: Collection[str], decode: Any) -> Iterator[tuple[Entry, Any]]:
        for entry in self.entries(wanted):
            try:
                yield entry, decode(entry)
            except UNREADABLE as error:
                if isinstance(error, topics.BeyondTimeError) and self._beyond_time:
                    continue
                raise DataError(
                    f"{self.path}: message {entry.sequence} on {entry.topic}: not what it should "
                    f"be ({error!r})"
                ) from None

    def estimates(self) -> Iterator[Estimate]:
        """The recorded estimates, one after the other."""
        estimate: Estimate | None = None
        for _, (time_s, kind, rows) in self._decoded(set(topics.LISTS.values()), _list):
            if kind is NodeEstimate:
                if estimate is not None:
                    yield estimate
                estimate = Estimate(time_s, rows, ())
            elif estimate is not None and estimate.time_s == time_s:
                estimate = replace(estimate, **{topics.LIST_NAMES[kind]: rows})
        if estimate is not None:
            yield estimate

    @cached_property
    def run(self) -> Run:
        """The recording as a run, of its decoded measurements; truth where it was converted in."""
        return self.run_of(self.observations())

    def run_of(self, observations: Iterable[Observation]) -> Run:
        """The recording as a run of these observations: truth, landmarks and names are its own."""
        landmarks: dict[str, Landmark] = {}
        truth: dict[tuple[float, int], Any] = {}
        for row in self._rows({topics.TRUTH, topics.LANDMARK}):
            if isinstance(row, Landmark):
                landmarks[row.landmark] = row
            else:
                truth[row.time_s, row.node] = row
        counters = {
            "recording_not_closed": len(self._cut_off),
            "recording_blocks_damaged": sum(file.damaged for file in self.files),
            "recording_gaps": sum(1 for _ in self.entries({topics.GAP})),
        }
        description = self.about.description if self.about else Description()
        return assemble(
            description.name or self.path.stem,
            description,
            (*observations, *truth.values()),
            tuple(landmarks.values()),
            counters={name: count for name, count in counters.items() if count},
        )


_OBSERVED = {
    name
    for kind, name in topics.ROWS.items()
    if name not in (topics.TRUTH, topics.LANDMARK, topics.GAP)
}
_PHONE = {topics.ROWS[kind] for kind in topics.PHONE_KINDS}


UNREADABLE = (
    ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError, struct.error,
)  # fmt: skip
"""What a message raises that is not what it should be; the last by lists within lists."""


def _row(entry: Entry) -> Any:
    return topics.decode_row(entry.topic, entry.data)


def _list(entry: Entry) -> Any:
    return topics.decode_list(entry.topic, entry.data)


def _input(entry: Entry) -> Any:
    return topics.decode_serial(entry.data) if entry.topic == topics.SERIAL else _row(entry)


def opened(path: Path) -> Any:
    """Open a recording; DataError where it is none."""
    try:
        if path.exists() and not path.is_file():
            raise DataError(f"{path}: cannot be read: not a regular file")
        return path.open("rb")
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None


def _look_through(path: Path) -> _File:
    found = _File(path, {}, {}, 0, 0, closed=False, first_ns=None, last_ns=None)
    with opened(path) as stream:
        start = stream.read(len(MAGIC))
        walk, blocks = Walk(stream), 0
        for piece in walk:
            blocks += piece.opcode == Opcode.CHUNK
            found.head_damaged |= blocks == 1 and bool(walk.gaps)
            try:
                if piece.opcode == Opcode.METADATA:
                    record = parse(Metadata, walk.payload(piece))
                    found.metadata[record.name] = record.metadata
                elif piece.opcode == Opcode.CHANNEL:
                    channel = parse(Channel, walk.payload(piece))
                    found.channels[channel.id] = channel
            except ValueError:
                found.head_damaged |= blocks == 0
                found.damaged += blocks > 0
            if piece.opcode == Opcode.CHUNK:
                _look_into(found, walk.payload(piece))
            elif piece.opcode == Opcode.MESSAGE:
                found.damaged += piece.length < HEAD_BYTES + MESSAGE_HEAD.size
        if start != MAGIC[: len(start)] and not blocks:
            raise DataError(f"{path}: no MCAP file")
        found.damaged += len(walk.gaps)
        found.unread = 0 if walk.complete else walk.size - walk.end
        found.closed = walk.complete
    return found


def _records_of(piece: Piece, walk: Walk) -> list[tuple[int, memoryview]]:
    """The records of a chunk, or the message that stands alone; ValueError where damaged."""
    raw = b""
    if piece.opcode == Opcode.CHUNK:
        raw = unpack(parse(Chunk, walk.payload(piece)))
    elif piece.opcode == Opcode.MESSAGE:
        raw = struct.pack("<BQ", piece.opcode, piece.length - HEAD_BYTES) + walk.payload(piece)
    return list(records_in(raw))


def _look_into(found: _File, payload: bytes) -> None:
    try:
        chunk = parse(Chunk, payload)
        raw = unpack(chunk)
        for opcode, content in records_in(raw):
            if opcode == Opcode.CHANNEL:
                channel = parse(Channel, bytes(content))
                found.channels[channel.id] = channel
    except ValueError:
        found.damaged += 1
        return
    if found.first_ns is None:
        found.first_ns = chunk.message_start_time
    found.last_ns = max(chunk.message_end_time, found.last_ns or 0)


def parsed(path: Path, kind: Any, payload: bytes) -> Any:
    """Return a record of that class; DataError where it is damaged."""
    try:
        return parse(kind, payload)
    except ValueError as error:
        raise DataError(f"{path}: damaged: {error}; {MAKE_WHOLE}") from None
