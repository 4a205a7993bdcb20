"""MCAP on disk, so that a file that ends anywhere can be read up to there.

A file is written in whole *blocks*, each a chunk of messages and the index of its messages, behind
schemas, channels and metadata that stand at its beginning. Nothing that was written is touched
again, and nothing is kept in memory for the end: the summary that viewers seek by is made by
reading the file's own blocks, when it is closed, or later when it was not (:func:`finish`). The
records themselves are those of the library ``mcap``, whose writer holds the index of the whole
file in memory and cannot take back half a chunk that a full disk refused.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from relpos.recording.topics import Message as SessionMessage
from relpos.recording.topics import Topic
from relpos.version import __version__

MAGIC = b"\x89MCAP0\r\n"
HEAD_BYTES = 9
"""Head of a record: one byte for the opcode, eight for the length."""
_CHUNK_HEAD = struct.Struct("<QQQI")
_PACKED = struct.pack("<I", 4) + b"zstd"
"""Stands behind the head of each of our chunks, and hardly anywhere else."""
_SEARCH_BYTES = 1 << 20
MOST_UNPACKED_BYTES = 64 << 20
MOST_RATIO = 200
MOST_RATIO_FROM_BYTES = 1 << 16
"""Limits of a chunk; ours hold a megabyte and are packed to a fifth."""
CONTENT = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.METADATA,
    Opcode.ATTACHMENT,
)
"""Records before the end of the data; any other opcode is damage."""


def _bytes_of(builder: RecordBuilder) -> bytes:
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


# -- writing ---------------------------------------------------------------------------------------


def beginning(metadata: Mapping[str, Mapping[str, str]], topics: Iterable[Topic]) -> bytes:
    """Everything before the first block."""
    builder = RecordBuilder()
    builder.write(MAGIC)
    Header("", f"relpos {__version__}").write(builder)
    for name, values in metadata.items():
        Metadata(name, dict(values)).write(builder)
    builder.write(channel_records(numbered(topics), topics))
    return _bytes_of(builder)


def numbered(topics: Iterable[Topic]) -> dict[str, int]:
    """Topic -> channel, as every file of ours has them."""
    return {topic.name: number for number, topic in enumerate(topics, 1)}


def channel_records(numbers: Mapping[str, int], topics: Iterable[Topic]) -> bytes:
    """Schemas and channels; each schema has its channel's number."""
    builder = RecordBuilder()
    for topic in topics:
        number = numbers[topic.name]
        Schema(number, topic.schema, topic.schema_encoding, topic.schema_name).write(builder)
        Channel(number, topic.name, topic.encoding, {}, number).write(builder)
    return _bytes_of(builder)


def metadata_record(name: str, values: Mapping[str, str]) -> bytes:
    """A metadata record by itself, for between two blocks."""
    builder = RecordBuilder()
    Metadata(name, dict(values)).write(builder)
    return _bytes_of(builder)


class Block:
    """Messages that go to disk together, numbered from 1 on; ``numbers``: topic -> channel."""

    def __init__(self, numbers: Mapping[str, int]) -> None:
        self._numbers = numbers
        self._messages = bytearray()
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._sequence = 0

    def __len__(self) -> int:
        return len(self._messages)

    def add(self, message: SessionMessage) -> None:
        """Add a message."""
        number = self._numbers[message.topic]
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self._index.setdefault(number, []).append((message.log_ns, len(self._messages)))
        self._messages += _MESSAGE.pack(
            Opcode.MESSAGE,
            MESSAGE_HEAD.size + len(message.data),
            number,
            self._sequence,
            message.log_ns,
            message.publish_ns,
        )
        self._messages += message.data

    def pop(self) -> bytes:
        """Return the block's bytes, and empty the block."""
        raw = bytes(self._messages)
        times = [time_ns for entries in self._index.values() for time_ns, _ in entries]
        builder = RecordBuilder()
        Chunk(
            compression="zstd",
            data=zstandard.compress(raw),
            message_end_time=max(times),
            message_start_time=min(times),
            uncompressed_crc=zlib.crc32(raw),
            uncompressed_size=len(raw),
        ).write(builder)
        for number, entries in sorted(self._index.items()):
            MessageIndex(number, entries).write(builder)
        self._messages = bytearray()
        self._index = {}
        return _bytes_of(builder)


_MESSAGE = struct.Struct("<BQHIQQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")


# -- reading ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Piece:
    """One record in a file: where, what, how long (with its head)."""

    offset: int
    opcode: int
    length: int


class Walk:
    """The records of a file one after the other, as far as they are whole.

    Where the head of a record is damaged, it goes on with the next of our chunks. Afterwards
    ``end`` is where the last whole record before the end of the data ends, ``complete`` whether the
    file was closed (it has its summary and its closing magic), and ``gaps`` how many bytes were
    passed over at each damaged place.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file
        self.size = file.seek(0, os.SEEK_END)
        self.end = 0
        self.complete = False
        self.gaps: list[int] = []

    def __iter__(self) -> Iterator[Piece]:
        """Yield what stands before the end of the data; nothing where it is no MCAP at all."""
        self.file.seek(0)
        self.end = len(MAGIC)
        if self.file.read(len(MAGIC)) != MAGIC:
            self.end = self._next_chunk() or 0
            if self.end == 0:
                return
            self.gaps.append(self.end)
        while self.end + HEAD_BYTES <= self.size:
            self.file.seek(self.end)
            opcode, length = struct.unpack("<BQ", self.file.read(HEAD_BYTES))
            if opcode == Opcode.DATA_END:
                self.file.seek(self.size - len(MAGIC))
                self.complete = self.file.read() == MAGIC
                return
            after = self.end + HEAD_BYTES + length
            if opcode not in CONTENT or after > self.size:
                found = self._next_chunk()
                if found is None:  # A block that a crash left full of zeros, or half written.
                    return
                self.gaps.append(found - self.end)
                self.end = found
                continue
            piece = Piece(self.end, opcode, HEAD_BYTES + length)
            self.end = after
            yield piece

    def _next_chunk(self) -> int | None:
        """Return where the next whole chunk of ours begins; None where there is none."""
        before = HEAD_BYTES + _CHUNK_HEAD.size
        at = self.end + 1 + before
        while True:
            self.file.seek(at)
            part = self.file.read(_SEARCH_BYTES)
            found = part.find(_PACKED)
            if found < 0:
                if len(part) < _SEARCH_BYTES:
                    return None
                at += len(part) - len(_PACKED) + 1
                continue
            start = at + found - before
            self.file.seek(start)
            opcode, length = struct.unpack("<BQ", self.file.read(HEAD_BYTES))
            if opcode == Opcode.CHUNK and start + HEAD_BYTES + length <= self.size:
                return start
            at += found + 1

    def payload(self, piece: Piece, most: int | None = None) -> bytes:
        """Content of a record, or its first ``most`` bytes."""
        self.file.seek(piece.offset + HEAD_BYTES)
        length = piece.length - HEAD_BYTES
        return self.file.read(length if most is None else min(length, most))


def parse(kind: Any, payload: bytes) -> Any:
    """A record of that class; ValueError where it does not hold what it says."""
    stream = ReadDataStream(io.BytesIO(payload))
    try:
        return kind.read(stream, len(payload)) if kind is Message else kind.read(stream)
    except Exception as error:  # The library's own, struct's and Unicode's alike.
        raise ValueError(f"not a {kind.__name__.lower()}: {error}") from None


def unpack(chunk: Chunk) -> bytes:
    """The messages of a chunk; ValueError where they are not what was written.

    Nothing is unpacked beyond what a chunk of its size may hold, whatever it says.
    """
    size = chunk.uncompressed_size
    if size > min(MOST_UNPACKED_BYTES, MOST_RATIO * len(chunk.data) + MOST_RATIO_FROM_BYTES):
        raise ValueError(f"damaged: {len(chunk.data)} bytes that say they unpack to {size}")
    try:
        # The byte too many shows what is longer than it says.
        if chunk.compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
                raw = stream.read(size + 1)
        elif chunk.compression == "lz4":
            import lz4.frame

            raw = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
        elif chunk.compression == "":
            raw = chunk.data
        else:
            raise ValueError(f"unknown compression {chunk.compression!r}")
    except Exception as error:  # Each compression has errors of its own.
        raise ValueError(f"damaged: {error}") from None
    if len(raw) != size:
        raise ValueError(f"damaged: {len(raw)} bytes instead of {size}")
    if chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc:
        raise ValueError("damaged: the checksum does not fit")
    return bytes(raw)


@dataclass(frozen=True, slots=True)
class Entry:
    """A message as it stands in a file."""

    topic: str
    log_ns: int
    publish_ns: int
    sequence: int
    data: bytes


def records_in(raw: bytes) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of each record inside a chunk; ValueError where one is cut off."""
    view, at = memoryview(raw), 0
    while at < len(raw):
        if at + HEAD_BYTES > len(raw):
            raise ValueError("damaged: a record is cut off")
        opcode, length = struct.unpack_from("<BQ", raw, at)
        at += HEAD_BYTES + length
        if at > len(raw) or (opcode == Opcode.MESSAGE and length < MESSAGE_HEAD.size):
            raise ValueError("damaged: a record is cut off")
        yield opcode, view[at - length : at]


# -- the end ---------------------------------------------------------------------------------------


@dataclass
class _Summary:
    """The summary of a whole file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)

    def read(self, walk: Walk) -> None:
        """Add every whole block."""
        open_chunk: ChunkIndex | None = None
        for piece in walk:
            if piece.opcode == Opcode.CHUNK:
                open_chunk = self._chunk(walk, piece)
            elif piece.opcode == Opcode.MESSAGE_INDEX and open_chunk is not None:
                index = parse(MessageIndex, walk.payload(piece))
                open_chunk.message_index_offsets[index.channel_id] = piece.offset
                open_chunk.message_index_length += piece.length
                self.counts[index.channel_id] += len(index.records)
            elif piece.opcode == Opcode.SCHEMA:
                schema = parse(Schema, walk.payload(piece))
                self.schemas[schema.id] = schema
            elif piece.opcode == Opcode.CHANNEL:
                channel = parse(Channel, walk.payload(piece))
                self.channels[channel.id] = channel
            elif piece.opcode == Opcode.METADATA:
                name = parse(Metadata, walk.payload(piece)).name
                self.metadata.append(MetadataIndex(piece.offset, piece.length, name))

    def _chunk(self, walk: Walk, piece: Piece) -> ChunkIndex:
        head = walk.payload(piece, _CHUNK_HEAD.size + 64)
        first_ns, last_ns, raw_bytes, _ = _CHUNK_HEAD.unpack_from(head)
        (letters,) = struct.unpack_from("<I", head, _CHUNK_HEAD.size)
        at = _CHUNK_HEAD.size + 4
        index = ChunkIndex(
            chunk_length=piece.length,
            chunk_start_offset=piece.offset,
            compression=head[at : at + letters].decode(),
            compressed_size=piece.length - HEAD_BYTES - at - letters - 8,
            message_end_time=last_ns,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=first_ns,
            uncompressed_size=raw_bytes,
        )
        self.chunks.append(index)
        return index

    def encode(self, start: int) -> bytes:
        """Data end, summary, footer and magic for the place ``start``."""
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        summary_start = start + builder.count
        data_end = _bytes_of(builder)
        offsets: list[SummaryOffset] = []
        groups: list[tuple[Opcode, list[Any]]] = [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self.chunks)),
            (Opcode.METADATA_INDEX, list(self.metadata)),
        ]
        builder = RecordBuilder()
        for opcode, records in groups:
            begun = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(SummaryOffset(opcode, summary_start + begun, builder.count - begun))
        offset_start = summary_start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = _bytes_of(builder)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offset_start)
        builder = RecordBuilder()
        Footer(summary_start, offset_start, zlib.crc32(head, zlib.crc32(summary))).write(builder)
        return data_end + summary + _bytes_of(builder) + MAGIC

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            metadata_count=len(self.metadata),
            message_start_time=min((c.message_start_time for c in self.chunks), default=0),
            message_end_time=max((c.message_end_time for c in self.chunks), default=0),
            schema_count=len(self.schemas),
        )


def finish(path: Path) -> None:
    """Append the summary to a file that was not closed, after its last whole record. OSError."""
    with path.open("r+b") as file:
        walk = Walk(file)
        summary = _Summary()
        summary.read(walk)
        if walk.complete or walk.end == 0:
            return
        tail = summary.encode(walk.end)
        file.seek(walk.end)
        file.write(tail)
        file.truncate()
        file.flush()
        os.fsync(file.fileno())


def copy_blocks(
    source: IO[bytes], out: IO[bytes], newest: int, *, beginning: bool
) -> tuple[int, int]:
    """Copy every record that can be read; how many bytes cannot, and the newest sequence number.

    A block whose checksum does not fit is left out; the index of a block's messages is made anew,
    for it may be what was cut off. Without ``beginning`` the blocks alone are copied, without those
    up to ``newest``: a part begins with what the one before may hold as well.
    """
    lost = 0
    walk = Walk(source)
    for piece in walk:
        if piece.opcode == Opcode.MESSAGE_INDEX:
            continue
        if not beginning and piece.opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL):
            continue
        payload = walk.payload(piece)
        if piece.opcode == Opcode.METADATA and not _is_whole(Metadata, payload):
            lost += piece.length
            continue
        indexes = b""
        if piece.opcode == Opcode.CHUNK:
            try:
                indexes, last = _message_indexes(unpack(parse(Chunk, payload)))
            except ValueError:
                lost += piece.length
                continue
            if not beginning and last <= newest:
                continue
            newest = max(newest, last)
        out.write(struct.pack("<BQ", piece.opcode, piece.length - HEAD_BYTES) + payload + indexes)
    return lost + sum(walk.gaps) + (0 if walk.complete else walk.size - walk.end), newest


def _is_whole(kind: Any, payload: bytes) -> bool:
    try:
        parse(kind, payload)
    except ValueError:
        return False
    return True


def _message_indexes(raw: bytes) -> tuple[bytes, int]:
    """Return the index of a chunk's messages, and the greatest of their sequence numbers."""
    last = -1
    entries: dict[int, list[tuple[int, int]]] = {}
    at = 0
    for opcode, content in records_in(raw):
        if opcode == Opcode.MESSAGE:
            number, sequence, log_ns, _ = MESSAGE_HEAD.unpack_from(content)
            last = max(last, sequence)
            entries.setdefault(number, []).append((log_ns, at))
        at += HEAD_BYTES + len(content)
    builder = RecordBuilder()
    for number, places in sorted(entries.items()):
        MessageIndex(number, places).write(builder)
    return _bytes_of(builder), last
