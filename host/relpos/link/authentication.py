"""The team key, and counters that distinguish a new frame from a repeated one.

docs/protocol.md describes a frame's tag and counter. Nothing here changes state before a frame has
been verified by :func:`relpos.protocol.framing.decode`.
"""

from __future__ import annotations

import enum
import json
import os
import secrets
import time
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from pathlib import Path

from relpos.errors import DataError
from relpos.files import sync_folder, write_whole
from relpos.protocol import messages as wire
from relpos.said import Said

EPOCH_UNIX_S = 1_704_067_200
"""2024-01-01 UTC: where the host's counter begins."""
COUNTS_PER_S = 8
"""Frames a second that a host may send without end. The 32 bits wrap in 2041, which nothing minds:
nodes compare counters modulo 2^32, and told theirs, the host goes on from it."""
WINDOW = 64
"""How far behind the newest a frame may be and still be accepted, once."""
WRAP = 1 << 32
DAY_S, HOUR_S = 86_400.0, 3600.0
MAX_JUMP = 1 << 24
"""How far ahead of the newest a frame may be: a node's frames of a month, which a host that was
away may have missed. A node that is further ahead has to answer a challenge."""


KEYLESS = Said(
    "keyless",
    "no team key (--key-file): anybody with such a radio can forge reports and command the nodes; "
    "`relpos node set PORT key --key-file FILE --new --cable` makes one",
)
"""Told wherever a team is heard under the key that every new node has."""


class HostCounter:
    """Counters of the host's frames to one addressee: eighths of a second, or the last one plus 1.

    ``clock`` gives Unix time in seconds. Two hosts of a team, or one that was restarted, need no
    common memory while their clocks are right to a few seconds. Where a clock is wrong, the node
    says what it took last, and :meth:`follow` goes on from that.
    """

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._last: int | None = None

    def next(self) -> int:
        """Return the next frame's counter."""
        now = self._now()
        if self._last is None or (now - self._last - 1) % WRAP < wire.MAX_COMMAND_JUMP:
            self._last = now
        else:
            self._last = (self._last + 1) % WRAP
        self._last = self._last or 1  # 0 is a node's that has obeyed nothing yet
        return self._last

    def follow(self, newest: int) -> str | None:
        """Go on from the newest counter that a node says it took; say what is wrong, if anything.

        A refusal of a frame that another one overtook changes nothing.
        """
        if self._last is not None and (self._last - newest) % WRAP <= wire.MAX_COMMAND_JUMP:
            return None
        self._last = newest
        fault = clock_fault(self._clock())
        ahead_s = (newest - self._now()) / COUNTS_PER_S
        if fault is not None or abs(ahead_s) < HOUR_S:
            return fault
        day = time.strftime("%Y-%m-%d", time.gmtime(self._clock()))
        if ahead_s > 0.0:
            return Said(
                "host-ahead",
                "the host that commanded it last had a clock {days:.1f} days ahead of this "
                "computer's, which says {day}: one of them is wrong; commands go on all the same",
                days=ahead_s / DAY_S,
                day=day,
            )
        return Said(
            "host-behind",
            "the host that commanded it last had a clock {days:.1f} days behind this computer's, "
            "which says {day}: one of them is wrong; commands go on all the same",
            days=-ahead_s / DAY_S,
            day=day,
        )

    def _now(self) -> int:
        now_s = self._clock()
        return 0 if clock_fault(now_s) else int((now_s - EPOCH_UNIX_S) * COUNTS_PER_S) % WRAP


def clock_fault(now_s: float) -> str | None:
    """Say in a line what is wrong with a computer's clock (Unix time); None where nothing is."""
    if now_s >= EPOCH_UNIX_S:
        return None
    day = time.strftime("%Y-%m-%d", time.gmtime(max(now_s, 0.0)))
    return Said(
        "clock-wrong",
        "this computer's clock says {day}, which cannot be: nodes refuse commands and beacons "
        "that seem older than earlier ones, until they have told theirs; set the clock",
        day=day,
    )


def of_node(node: int, text: str) -> Said:
    """Return a remark as one about a node."""
    return Said("of-node", "node {node}: {text}", node=str(node), text=text)


class Verdict(enum.Enum):
    """Result of the check of a frame's counter."""

    NEW = "new"
    LATE = "late"
    DUPLICATE = "duplicate"
    REPLAYED = "replayed"
    JUMPED = "jumped"


@dataclass(slots=True)
class CounterWindow:
    """The counters seen from one sender: ``newest``, and which of the :data:`WINDOW` up to it."""

    newest: int = -1
    _seen: int = 0

    def check(self, counter: int) -> Verdict:
        """Return whether a frame of that counter is new; changes nothing."""
        if counter > self.newest:
            known = self.newest >= 0
            return Verdict.JUMPED if known and counter - self.newest > MAX_JUMP else Verdict.NEW
        behind = self.newest - counter
        if behind >= WINDOW:
            return Verdict.REPLAYED
        return Verdict.DUPLICATE if self._seen >> behind & 1 else Verdict.LATE

    def add(self, counter: int) -> None:
        """Store the counter of an accepted frame."""
        if counter > self.newest:
            ahead = counter - self.newest
            self._seen = (self._seen << min(ahead, WINDOW) | 1) & ((1 << WINDOW) - 1)
            self.newest = counter
        else:
            self._seen |= 1 << (self.newest - counter)

    @classmethod
    def after(cls, newest: int) -> CounterWindow:
        """Return a window in which everything up to ``newest`` has been seen."""
        return cls(newest, (1 << WINDOW) - 1)


# -- key files -------------------------------------------------------------------------------------


def write_new_key(path: Path) -> bytes:
    """Write and return a random key, for its owner to read; DataError if the file exists."""
    key = secrets.token_bytes(wire.KEY_BYTES)
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with os.fdopen(handle, "w", encoding="ascii") as file:
                file.write(key.hex() + "\n")
                file.flush()
                os.fsync(file.fileno())  # nodes are given it next, and obey nobody without it
        except OSError:
            path.unlink()
            raise
    except FileExistsError as error:
        raise DataError(f"{path} exists already: a key is not overwritten") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror}") from error
    sync_folder(path.parent)
    return key


def read_key(path: Path) -> bytes:
    """Return the key in a file (32 hexadecimal digits); DataError, which never quotes it."""
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise DataError(f"{path}: no key can be read: {reason}") from error
    try:
        key = bytes.fromhex(text)
    except ValueError as error:
        raise DataError(
            f"{path}: a key file holds 32 hexadecimal digits and nothing else"
        ) from error
    if len(key) != wire.KEY_BYTES:
        raise DataError(f"{path}: a key has 32 hexadecimal digits, this one {2 * len(key)}")
    return key


class SeenCounters:
    """Stores each node's newest counter in a file beside the key, for the next start of the host.

    Without it, recorded frames could be sent again to a host that has just started.
    """

    EVERY_S = 5.0

    def __init__(self, path: Path) -> None:
        self.path = path
        self._saved_s = -self.EVERY_S
        self._saved: dict[int, int] = {}

    @classmethod
    def beside(cls, key_file: Path) -> SeenCounters:
        """Return the counters that belong to a key file."""
        return cls(key_file.with_name(key_file.name + ".seen"))

    def load(self) -> dict[int, int]:
        """Return node to newest counter, empty without a file; DataError where it is damaged."""
        try:
            values = json.loads(self.path.read_text(encoding="ascii"))
            self._saved = {int(node): int(counter) for node, counter in values.items()}
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, AttributeError, TypeError) as error:
            raise DataError(
                f"{self.path}: not a counter file: delete it; until each node has been heard, "
                "old frames can then be sent again"
            ) from error
        return dict(self._saved)

    def save(
        self,
        newest: Mapping[int, int],
        now_s: float,
        *,
        at_once: bool = False,
        lowered: Container[int] = (),
    ) -> None:
        """Write counters that have grown, at most every few seconds; DataError where that fails.

        Those of the nodes in ``lowered`` are written as they are.
        """
        if newest == self._saved or not (at_once or now_s - self._saved_s >= self.EVERY_S):
            return
        merged = dict(self._saved)
        for node, counter in newest.items():
            merged[node] = counter if node in lowered else max(counter, merged.get(node, -1))
        self._saved_s = now_s
        try:
            write_whole(self.path, json.dumps(merged).encode())
        except OSError as error:
            raise DataError(f"{self.path}: cannot be written: {error.strerror}") from error
        self._saved = merged
