"""A mission: a folder that outlives its sessions.

``mission.json`` says what it is, ``journal.jsonl`` holds all that was confirmed to somebody, a line
an event, on the disk before it is confirmed. ``checkpoint.json`` and ``tracks.csv`` hold where
everybody was, ``secret.key`` signs the devices' tokens. Each session adds its recording
(``recording-N.mcap``), all on the mission's clock, and its files (``session-N/``). The next session
goes on from the checkpoint and the seconds of the recording since then.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import secrets
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from relpos.errors import DataError
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.live.fusion_thread import known_poses
from relpos.live.inputs import Received
from relpos.live.sinks import Sink
from relpos.live.team_view import LogEntry, TeamView, to_json
from relpos.live.tracks import Tracks
from relpos.measurements import Prior

ABOUT, JOURNAL, CHECKPOINT, TRACKS, SECRET = (
    "mission.json",
    "journal.jsonl",
    "checkpoint.json",
    "tracks.csv",
    "secret.key",
)
CHECKPOINT_S = 2.0
WARM_UP_S = 12.0
"""How far before the checkpoint the recording is read again: a status comes each ten seconds, and
without the totals before it no motion is known."""
SYNC_S = 0.4


@dataclass
class About:
    """What a mission is; ``started_unix_s`` is second 0 of its clock, ``port`` its page's."""

    name: str
    source: str
    started_unix_s: float
    sessions: int = 0
    port: int | None = None
    ended_unix_s: float | None = None


@dataclass
class Resumed:
    """What the sessions before have left behind."""

    events: list[dict[str, Any]] = field(default_factory=list)
    priors: tuple[Prior, ...] = ()
    since_s: float = 0.0
    """Time of the checkpoint; 0 without one."""
    heard_s: dict[int, float] = field(default_factory=dict)
    """When each node was heard last."""
    arrived_s: float = 0.0
    """When the newest bytes arrived then: an emulated team has a time of its own."""
    tracks: Tracks = field(default_factory=Tracks)


class Mission:
    """The folder of a mission. DataError where it is none, or cannot be written."""

    def __init__(self, path: Path, about: About, key: bytes) -> None:
        self.path = path
        self.about = about
        self.key = key

    @classmethod
    def open(cls, path: Path, source: str | None = None, name: str | None = None) -> Mission:
        """Open the mission in that folder, or begin one; ``source`` replaces the one before."""
        if (path / ABOUT).exists():
            try:
                found = json.loads((path / ABOUT).read_text("utf-8"))
                about = About(**{f.name: found[f.name] for f in fields(About)})
                key = (path / SECRET).read_bytes()
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise DataError(f"{path}: not a mission's folder: {error}") from None
            about.source = source or about.source
            about.name = name or about.name
            return cls(path, about, key)
        if source is None:
            raise DataError(f"{path}: no mission there; to begin one, name the port, too")
        if path.exists() and any(path.iterdir()):
            raise DataError(f"{path}: neither a mission nor empty")
        path.mkdir(parents=True, exist_ok=True)
        key = secrets.token_bytes(32)
        handle = os.open(path / SECRET, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(key)
        mission = cls(path, About(name or path.name, source, time.time()), key)
        mission.save()
        return mission

    def save(self) -> None:
        """Write what it is."""
        _replace(self.path / ABOUT, json.dumps(asdict(self.about), indent=1))

    def recording(self, session: int) -> Path:
        """Return the file in which a session is recorded."""
        return self.path / f"recording-{session}.mcap"

    def recordings(self) -> list[Path]:
        """Return the recordings so far, in order."""
        files = (self.recording(n) for n in range(1, self.about.sessions + 1))
        return [file for file in files if file.exists()]

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the journal's events, and the devices of its exercises."""
        yield from _events(self.path / JOURNAL)
        for folder in sorted(self.path.glob("exercise-*")):
            yield from (event for event in _events(folder / JOURNAL) if event["kind"] == "device")

    def exercise(self, source: str) -> Mission:
        """Begin an exercise: a mission of its own in a folder below, with the same devices."""
        number = 1 + len(list(self.path.glob("exercise-*")))
        path = self.path / f"exercise-{number}"
        path.mkdir()
        return Mission(path, About(self.about.name, source, time.time(), sessions=1), self.key)

    def resume(self) -> Resumed:
        """Return what the sessions so far have left behind."""
        resumed = Resumed(list(self.events()))
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            found = json.loads((self.path / CHECKPOINT).read_text("utf-8"))
            rows = [Prior(**row) for row in found["priors"]]
            resumed.heard_s = {int(node): float(at_s) for node, at_s in found["heard_s"].items()}
            resumed.arrived_s = float(found["arrived_s"])
            resumed.since_s, resumed.priors = float(found["time_s"]), tuple(rows)
        with contextlib.suppress(OSError), (self.path / TRACKS).open(encoding="utf-8") as lines:
            for line in lines:
                with contextlib.suppress(ValueError):
                    node, time_s, x_m, y_m = line.split(",")
                    resumed.tracks.add(int(node), float(time_s), float(x_m), float(y_m))
        return resumed

    def is_running(self) -> bool:
        """Return whether a session has this mission now."""
        try:
            with self.lock():
                return False
        except (DataError, OSError):
            return True

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep the folder for one session; DataError where another one has it."""
        with (self.path / "lock").open("w") as file:
            with contextlib.suppress(ImportError):
                import fcntl

                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    raise DataError(f"{self.path}: another session has this mission") from None
            yield


class Journal:
    """Appends events in a thread of its own; an event is safe once the disk has confirmed it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._waiting: queue.SimpleQueue[tuple[int, str] | None] = queue.SimpleQueue()
        self._put = 0
        self._safe = 0
        self.trouble: str | None = None
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add(self, event: Mapping[str, Any]) -> int:
        """Append an event; return the number by which :meth:`is_safe` knows it."""
        self._put += 1
        self._waiting.put((self._put, to_json(event) + "\n"))
        return self._put

    @property
    def newest(self) -> int:
        """Number of the newest event."""
        return self._put

    def is_safe(self, number: int) -> bool:
        """Return whether the disk has confirmed that event and all before it."""
        return number <= self._safe

    def close(self) -> None:
        """Write what waits."""
        self._waiting.put(None)
        self._thread.join(5.0)

    def _run(self) -> None:
        lines: list[str] = []
        over = False
        while not over or lines:
            first = None if lines else self._waiting.get()
            if not lines and first is None:
                return
            found = [] if first is None else [first]
            while not self._waiting.empty():
                item = self._waiting.get()
                if item is None:
                    over = True
                    break
                found.append(item)
            lines += [line for _, line in found]
            number = max([self._safe + 0, *(n for n, _ in found)])
            try:
                self._write("".join(lines))
            except OSError as error:
                self.trouble = f"{self._path}: {error.strerror or error}: nothing is confirmed"
                if over:
                    return
                time.sleep(SYNC_S)
                self._waiting.put((number, ""))
                continue
            lines, self.trouble, self._safe = [], None, number

    def _write(self, text: str) -> None:
        with self._path.open("ab") as file:
            size = file.tell()
            # A line that a power cut left half must not swallow the next one.
            data = text.encode()
            if size and not _ends_line(self._path):
                data = b"\n" + data
            try:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            except OSError:
                with contextlib.suppress(OSError):
                    os.truncate(self._path, size)
                raise


class MissionFiles(Sink):
    """Keeps the mission's checkpoint, tracks and log while a session runs."""

    def __init__(self, mission: Mission, journal: Journal, since_s: float = 0.0) -> None:
        self._path = mission.path
        self._journal = journal
        self._checkpoint_s = since_s
        self._spaced = Tracks()
        self._lines: list[str] = []
        self._heard_s: dict[int, float] = {}
        self._arrived_s = 0.0
        self._trouble: str | None = None

    def received(self, arrival_s: float, data: bytes) -> None:
        """Note when the newest bytes came."""
        self._arrived_s = arrival_s

    def updated(self, view: TeamView) -> None:
        """Note when each node was heard last."""
        for person in view.people:
            if person.seen_s is not None:
                self._heard_s[person.node] = view.time_s - person.seen_s

    def estimated(self, estimate: Estimate) -> None:
        """Keep where everybody is."""
        for n in estimate.nodes:
            if n.status in (NodeStatus.OK, NodeStatus.STALE) and self._spaced.add(
                n.node, estimate.time_s, n.x_m, n.y_m
            ):
                self._lines.append(f"{n.node},{estimate.time_s:.2f},{n.x_m:.2f},{n.y_m:.2f}\n")
        if estimate.time_s < self._checkpoint_s + CHECKPOINT_S:
            return
        self._checkpoint_s = estimate.time_s
        priors = [asdict(prior) for prior in known_poses(estimate)]
        try:
            if self._lines:
                with (self._path / TRACKS).open("a", encoding="utf-8") as file:
                    file.writelines(self._lines)
                self._lines.clear()
            heard_s = {str(node): at_s for node, at_s in self._heard_s.items()}
            found = {
                "time_s": estimate.time_s,
                "arrived_s": self._arrived_s,
                "heard_s": heard_s,
                "priors": priors,
            }
            _replace(self._path / CHECKPOINT, json.dumps(found), sync=False)
            self._trouble = None
        except OSError as error:
            self._trouble = f"{self._path}: {error.strerror or error}: checkpoints are not written"

    def logged(self, entry: LogEntry) -> None:
        """Append a line to the journal."""
        self._journal.add({"kind": "log", "entry": asdict(entry)})

    def trouble(self) -> str | None:
        """Return what cannot be written."""
        return self._journal.trouble or self._trouble

    def close(self) -> None:
        """Write what waits."""
        self._journal.close()


def read_again(
    inputs: Iterable[tuple[float, Any]], feed: Any, resumed: Resumed
) -> Iterator[Received]:
    """Yield recorded inputs once more; of those before the checkpoint only the link learns.

    ``feed(data, arrival_s)`` decodes bytes.
    """
    since_s = resumed.since_s
    for arrival_s, entered in inputs:
        if arrival_s < resumed.arrived_s - WARM_UP_S:
            continue
        data = getattr(entered, "data", None)
        observations: Sequence[Any] = (entered,) if data is None else feed(data, arrival_s)
        known = tuple(o for o in observations if o.time_s > since_s)
        yield Received(arrival_s, b"", known, again=True)


def _events(journal: Path) -> Iterator[dict[str, Any]]:
    """Yield a journal's events; a last line that a power cut left half is left out."""
    with contextlib.suppress(FileNotFoundError), journal.open("rb") as lines:
        for line in lines:
            with contextlib.suppress(ValueError):
                event = json.loads(line)
                if isinstance(event, dict) and "kind" in event:
                    yield event


def _ends_line(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


def _replace(path: Path, text: str, *, sync: bool = True) -> None:
    """Write a file as a whole: it is the old one or the new one, whatever happens."""
    beside = path.with_name(path.name + ".new")
    with beside.open("w", encoding="utf-8") as file:
        file.write(text)
        if sync:
            file.flush()
            os.fsync(file.fileno())
    beside.replace(path)
