"""Any moment of a recording, found by its blocks' times: nothing before it is read.

The table of blocks comes from the heads of the blocks themselves, so that a file that was cut off
has one as well. Several recordings of one mission are one, on the mission's clock.
"""

from __future__ import annotations

import struct
import sys
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata

from relpos.errors import DataError
from relpos.fusion.estimator import Estimate, NodeEstimate
from relpos.measurements import BOUNDS, Event, Height, Motion, Range, Status
from relpos.recording import topics
from relpos.recording.about import About
from relpos.recording.container import (
    HEAD_BYTES,
    MESSAGE_HEAD,
    Piece,
    Walk,
    parse,
    records_in,
    unpack,
)
from relpos.recording.output import parts_of
from relpos.recording.reader import MAKE_WHOLE, UNREADABLE, opened, parsed
from relpos.runs.description import Description

BACK_S = 10.0
"""How old ranges may be that are shown."""
KEPT_BYTES = 32 << 20
"""Unpacked blocks in memory: minutes of a large team."""
_LISTS = frozenset(topics.LISTS.values())
_READ = _LISTS | {topics.ROWS[kind] for kind in (Motion, Height, Event, Status, Range)}
"""Everything else (bytes of the port, drawings) is most of a recording."""


@dataclass(frozen=True)
class _Block:
    """One chunk, between two times of the session."""

    start_ns: int
    end_ns: int
    file: int
    piece: Piece


@dataclass(frozen=True)
class Message:
    """A decoded message, and the session's time at which it was written."""

    time_s: float
    topic: str
    data: bytes


class Moments:
    """The moments of recordings that belong together, and of their further parts.

    DataError where one is none of ours.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = list(paths)
        paths = [part for path in paths for part in parts_of(path)]
        self._files = [opened(path) for path in paths]
        self._walks = [Walk(file) for file in self._files]
        self._topics: list[dict[int, str]] = []
        self._blocks: list[_Block] = []
        self._kept: OrderedDict[int, list[Message]] = OrderedDict()
        self._kept_bytes = 0
        self._without: set[int] = set()
        """Blocks that were seen to hold no estimate."""
        self._starts_ns: list[int] = []
        """Unix time of second 0 in each file: where a computer's clock was set, it differs."""
        self._begins_ns: list[int] = []
        """Rows up to there were read again in that session: the recording before has them."""
        seen: set[tuple[int, int, int]] = set()
        about: About | None = None
        begins_ns = 0
        for number, walk in enumerate(self._walks):
            metadata: dict[str, dict[str, str]] = {}
            names: dict[int, str] = {}
            blocks: list[_Block] = []
            for piece in walk:
                if piece.opcode == Opcode.METADATA:
                    record = parsed(paths[number], Metadata, walk.payload(piece))
                    metadata[record.name] = record.metadata
                elif piece.opcode == Opcode.CHANNEL:
                    channel = parsed(paths[number], Channel, walk.payload(piece))
                    names[channel.id] = channel.topic
                elif walk.gaps and not blocks:
                    raise DataError(f"{paths[number]}: its beginning is damaged; {MAKE_WHOLE}")
                elif piece.opcode == Opcode.CHUNK and piece.length >= HEAD_BYTES + 16:
                    start_ns, end_ns = struct.unpack("<QQ", walk.payload(piece, 16))
                    blocks.append(_Block(start_ns, end_ns, number, piece))
            self._topics.append(names)
            found = About.read(str(paths[number]), metadata)
            before_ns = about.started_unix_ns if about is not None else 0
            zero_ns = before_ns if found is None else found.started_unix_ns
            self._starts_ns.append(zero_ns)
            if paths[number] in self._paths:
                begins_ns = max((block.end_ns for block in self._blocks), default=-sys.maxsize)
            self._begins_ns.append(begins_ns)
            if paths[number] not in self._paths and (found is None or zero_ns != before_ns):
                continue  # Another recording's, by its name alone a part of this.
            about = found if found is not None else about
            for b in blocks:
                # A part begins with what the one before may hold as well.
                if (b.start_ns, b.end_ns, b.piece.length) not in seen:
                    start_ns, end_ns = b.start_ns - zero_ns, b.end_ns - zero_ns
                    self._blocks.append(replace(b, start_ns=start_ns, end_ns=end_ns))
            seen |= {(b.start_ns, b.end_ns, b.piece.length) for b in blocks}
        if about is None or not self._blocks:
            raise DataError(f"{paths[0]}: no recording of relpos, or nothing in it")
        self.started_unix_s = about.started_unix_ns * 1e-9
        self.description: Description = about.description
        self._blocks.sort(key=lambda block: block.end_ns)
        self._ends = [block.end_ns for block in self._blocks]
        self.from_s = min(block.start_ns for block in self._blocks) * 1e-9
        # What is behind it no reader takes, as :class:`Recording` says.
        self.to_s = min(self._ends[-1] * 1e-9, BOUNDS["time_s"][1])

    def again(self) -> Moments:
        """Return the same with files of their own, for another thread."""
        return Moments(self._paths)

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()

    def between(self, from_s: float, to_s: float, wanted: Collection[str]) -> Iterator[Message]:
        """Yield the messages of that time and of those topics, in order."""
        first = bisect_right(self._ends, round(from_s * 1e9) - 1)
        until_ns = round(to_s * 1e9)
        for index in range(first, len(self._blocks)):
            if self._blocks[index].start_ns > until_ns:
                break
            for message in self._messages(index):
                if from_s <= message.time_s <= to_s and message.topic in wanted:
                    yield message

    def _messages(self, index: int) -> list[Message]:
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        block = self._blocks[index]
        names, walk = self._topics[block.file], self._walks[block.file]
        zero_ns = self._starts_ns[block.file]
        messages = []
        try:
            raw = unpack(parse(Chunk, walk.payload(block.piece)))
            for opcode, content in records_in(raw):
                if opcode == Opcode.MESSAGE:
                    channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(content)
                    topic = names.get(channel, "")
                    is_new = topic in _LISTS or log_ns - zero_ns > self._begins_ns[block.file]
                    if topic in _READ and is_new:
                        data = bytes(content[MESSAGE_HEAD.size :])
                        messages.append(Message((log_ns - zero_ns) * 1e-9, topic, data))
        except ValueError:
            messages = []  # A damaged block: what it held is missing, nothing else.
        self._kept[index] = messages
        self._kept_bytes += sum(len(message.data) for message in messages)
        while self._kept_bytes > KEPT_BYTES and len(self._kept) > 1:
            _, dropped = self._kept.popitem(last=False)
            self._kept_bytes -= sum(len(message.data) for message in dropped)
        return messages

    def estimate_at(self, time_s: float) -> Estimate | None:
        """Return the newest estimate that was there by then, however old; None before the first.

        From that moment backwards: of a recording's lists those of one estimate alone are decoded.
        """
        until_ns = round(time_s * 1e9)
        last = min(bisect_right(self._ends, until_ns), len(self._blocks) - 1)
        later: list[Any] = []
        for index in range(last, -1, -1):
            if index in self._without or self._blocks[index].start_ns > until_ns:
                continue
            lists = [m for m in self._messages(index) if m.topic in _LISTS]
            if not lists:
                self._without.add(index)
            for message in reversed(lists):
                decoded = None if message.time_s > time_s else _decoded(topics.decode_list, message)
                if decoded is None:
                    continue
                if decoded[1] is NodeEstimate:
                    at_s, _, nodes = decoded
                    parts = {topics.LIST_NAMES[kind]: r for at, kind, r in later if at == at_s}
                    return replace(Estimate(at_s, nodes, ()), **parts)
                later.append(decoded)
        return None

    def rows(self, from_s: float, to_s: float, *kinds: type) -> Iterator[tuple[float, Any]]:
        """Yield decoded rows of these kinds with the time they were there."""
        for message in self.between(from_s, to_s, {topics.ROWS[kind] for kind in kinds}):
            row = _decoded(topics.decode_row, message)
            if row is not None:
                yield message.time_s, row


def _decoded(decode: Any, message: Message) -> Any:
    try:
        return decode(message.topic, message.data)
    except UNREADABLE:
        return None
