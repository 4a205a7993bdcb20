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
import math
import os
import queue
import secrets
import stat
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from relpos.errors import DataError
from relpos.files import displayable, write_whole
from relpos.fusion.estimator import Estimate, NodeStatus
from relpos.live.fusion_thread import known_poses
from relpos.live.inputs import Received
from relpos.live.sinks import Sink
from relpos.live.team_view import LogEntry, TeamView, to_json
from relpos.live.tracks import Tracks
from relpos.measurements import BOUNDS, Prior
from relpos.runs.table import read_text, within_bounds
from relpos.said import Said

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
KEEP_LOOK_S = 0.005
MOST_ABOUT_BYTES = MOST_LINE_BYTES = 1 << 20
KEY_BYTES = 32
LAST_UNIX_S = 253_402_300_799.0
"""The end of the year 9999: no date is later."""


@dataclass
class About:
    """What a mission is; ``started_unix_s`` is second 0 of its clock, ``port`` its page's."""

    name: str
    source: str
    started_unix_s: float
    sessions: int = 0
    port: int | None = None
    ended_unix_s: float | None = None
    common: bool = False
    """Whether the nodes started at one pose."""
    post: int | None = None
    """The command post's node."""
    https: bool = False
    """Whether its page is served encrypted."""

    @classmethod
    def read(cls, text: str) -> About:
        """Return what a file says. ValueError or KeyError where it is none of ours."""
        # Earlier versions have none of these.
        found = {"common": False, "post": None, "https": False} | _object(text)
        about = cls(**{f.name: found[f.name] for f in fields(cls)})
        if not (
            isinstance(about.name, str)
            and isinstance(about.source, str)
            and _is_moment(about.started_unix_s)
            and type(about.sessions) is int
            and (about.port is None or (type(about.port) is int and 0 < about.port < 65536))
            and (about.ended_unix_s is None or _is_moment(about.ended_unix_s))
            and type(about.common) is bool
            and type(about.https) is bool
            and (about.post is None or (type(about.post) is int and about.post > 0))
        ):
            raise ValueError("values of another kind")
        return about


@dataclass
class Resumed:
    """What the sessions before have left behind."""

    events: list[dict[str, Any]] = field(default_factory=list)
    priors: tuple[Prior, ...] = ()
    begins: bool = True
    """Whether there is no checkpoint yet, so that everything recorded is read again."""
    since_s: float = 0.0
    """Time of the checkpoint; 0 without one."""
    heard_s: dict[int, float] = field(default_factory=dict)
    """When each node was heard last."""
    arrived_s: float = 0.0
    """When the newest bytes arrived then: an emulated team has a time of its own."""
    tracks: Tracks = field(default_factory=Tracks)

    @property
    def on_new_map(self) -> bool:
        """Whether the checkpoint is damaged, so that nothing fits the map any more."""
        return not self.begins and self.since_s == 0.0


class Mission:
    """The folder of a mission. DataError where it is none, or cannot be written."""

    def __init__(self, path: Path, about: About, key: bytes | None = None) -> None:
        self.path = path
        self.about = about
        self._key = key

    @classmethod
    def open(cls, path: Path, source: str | None = None, name: str | None = None) -> Mission:
        """Open the mission in that folder, or begin one; ``source`` replaces the one before."""
        if (path / ABOUT).exists():
            _check_own_files(path)
            try:
                about = About.read(read_text(path / ABOUT, MOST_ABOUT_BYTES))
            except (ValueError, KeyError) as error:
                raise DataError(f"{path}: not a mission's folder: {error}") from None
            about.source = source or about.source
            about.name = displayable(name or about.name)
            return cls(path, about)
        if source is None:
            raise DataError(f"{path}: no mission (relpos mission begins one), nor a recording")
        # A kill in the middle of this leaves some of them.
        begun = {SECRET, SECRET + ".new", ABOUT + ".new"}
        if path.exists() and any(file.name not in begun for file in path.iterdir()):
            raise DataError(f"{path}: neither a mission nor empty")
        path.mkdir(parents=True, exist_ok=True)
        _check_own_files(path)
        mission = cls(path, About(displayable(name or path.name), source, time.time()))
        assert mission.key
        mission.save()
        return mission

    @property
    def key(self) -> bytes:
        """What signs the devices' tokens; made where there is none, or only half of one."""
        if self._key is None:
            try:
                self._key = (self.path / SECRET).read_bytes()
            except FileNotFoundError:
                self._key = b""
            if len(self._key) != KEY_BYTES:
                self._key = secrets.token_bytes(KEY_BYTES)
                write_whole(self.path / SECRET, self._key, sync=True, mode=0o600)
        return self._key

    def keep_time(self, resumed: Resumed) -> str | None:
        """Let the mission's clock go on where the computer's has jumped since; say so then."""
        now_s = time.time() - self.about.started_unix_s
        if resumed.arrived_s <= now_s <= BOUNDS["time_s"][1]:
            return None
        jumped_s = now_s - resumed.arrived_s
        self.about.started_unix_s += jumped_s
        return (
            f"by this computer's clock the session before was {jumped_s / 3600.0:.1f} h ago: the "
            "mission's time goes on without them"
        )

    def save(self) -> None:
        """Write what it is."""
        write_whole(self.path / ABOUT, json.dumps(asdict(self.about), indent=1).encode(), sync=True)

    def recording(self, session: int) -> Path:
        """Return the file in which a session is recorded."""
        return self.path / f"recording-{session}.mcap"

    def recordings(self) -> list[Path]:
        """Return the recordings so far, in order."""
        files = (self.recording(n) for n in range(1, self.about.sessions + 1))
        return [file for file in files if file.exists()]

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the journal's events, and the devices of its exercises.

        Lines that are none of ours are left out; a log's ``entry`` is a :class:`LogEntry`.
        """
        yield from _events(self.path / JOURNAL)
        for folder in sorted(self.path.glob("exercise-*")):
            yield from (event for event in _events(folder / JOURNAL) if event["kind"] == "device")

    def exercise(self, source: str) -> Mission:
        """Begin an exercise: a mission of its own in a folder below, with the same devices."""
        number = 1
        while (path := self.path / f"exercise-{number}").exists():
            number += 1
        path.mkdir()
        return Mission(path, About(self.about.name, source, time.time(), sessions=1), self.key)

    def resume(self) -> Resumed:
        """Return what the sessions so far have left behind."""
        resumed = Resumed(list(self.events()), begins=not (self.path / CHECKPOINT).exists())
        with contextlib.suppress(DataError, ValueError, KeyError, TypeError, AttributeError):
            found = _object(read_text(self.path / CHECKPOINT, MOST_ABOUT_BYTES))
            rows = tuple(prior for row in found["priors"] for prior in _priors(row))
            heard_s = {int(node): _bounded("time_s", at) for node, at in found["heard_s"].items()}
            arrived_s, since_s = (_bounded("time_s", found[k]) for k in ("arrived_s", "time_s"))
            resumed.heard_s, resumed.arrived_s = heard_s, arrived_s
            resumed.since_s, resumed.priors = since_s, rows
        for line in _lines(self.path / TRACKS):
            with contextlib.suppress(ValueError):
                if not line.endswith(b"\n"):
                    raise ValueError("cut off")
                node, *point = line.decode().split(",")
                names = ("time_s", "x_m", "y_m")
                where = [_bounded(*row) for row in zip(names, map(float, point), strict=True)]
                resumed.tracks.add(int(node), *where)
        return resumed

    def put_tracks_away(self, resumed: Resumed) -> None:
        """Keep the tracks of another map apart from those that come."""
        resumed.tracks = Tracks()
        with contextlib.suppress(FileNotFoundError):
            (self.path / TRACKS).replace(self.path / f"tracks-{self.about.sessions}.csv")

    def is_running(self) -> bool:
        """Return whether a session has this mission now."""
        try:
            with self.lock(make=False):
                return False
        except DataError:
            return True
        except OSError:  # There is none, or it cannot be opened: a copy, or evidence.
            return False

    @contextlib.contextmanager
    def lock(self, *, make: bool = True) -> Iterator[None]:
        """Keep the folder for one session; DataError where another one has it."""
        with (self.path / "lock").open("a" if make else "r") as file:
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
        self.newest = 0
        """Number of the newest event."""
        self._safe = 0
        self.trouble: str | None = None
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def add(self, event: Mapping[str, Any]) -> int:
        """Append an event; return the number by which :meth:`is_safe` knows it."""
        self.newest += 1
        self._waiting.put((self.newest, to_json(event) + "\n"))
        return self.newest

    def keep(self, event: Mapping[str, Any]) -> None:
        """Append an event and wait for the disk; DataError where it cannot be written."""
        number = self.add(event)
        while not self.is_safe(number):
            if self.trouble is not None:
                raise DataError(self.trouble)
            time.sleep(KEEP_LOOK_S)

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
            number = max([self._safe, *(n for n, _ in found)])
            try:
                self._write("".join(lines))
            except OSError as error:
                self.trouble = Said(
                    "journal",
                    "{file}: {reason}: nothing is confirmed",
                    file=str(self._path),
                    reason=error.strerror or str(error),
                )
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
            if not _ends_line(self._path):
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
                    if not _ends_line(self._path / TRACKS):
                        file.write("?\n")  # No half line becomes a whole one.
                    file.writelines(self._lines)
                self._lines.clear()
            heard_s = {str(node): at_s for node, at_s in self._heard_s.items()}
            found = {
                "time_s": estimate.time_s,
                "arrived_s": self._arrived_s,
                "heard_s": heard_s,
                "priors": priors,
            }
            write_whole(self._path / CHECKPOINT, json.dumps(found).encode())
            self._trouble = None
        except OSError as error:
            self._trouble = Said(
                "checkpoints",
                "{file}: {reason}: checkpoints are not written",
                file=str(self._path),
                reason=error.strerror or str(error),
            )

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

    ``feed(data, arrival_s)`` decodes bytes. What phones sent may stand in two recordings: a session
    that went on has taken in what it had read again.
    """
    since_s = resumed.since_s
    phones: set[Any] = set()
    for arrival_s, entered in inputs:
        if arrival_s < resumed.arrived_s - WARM_UP_S or entered in phones:
            continue
        data = getattr(entered, "data", None)
        if data is None:
            phones.add(entered)
        observations: Sequence[Any] = (entered,) if data is None else feed(data, arrival_s)
        known = tuple(o for o in observations if o.time_s > since_s)
        yield Received(arrival_s, b"", known, again=True)


_KINDS: Mapping[str, tuple[type, ...]] = {
    "node": (int, type(None)), "time_s": (int, float), "unix_s": (int, float), "name": (str,),
    "by": (str,), "id": (str,), "role": (str,), "seconds": (int, float), "ids": (list,),
    "alert": (str, type(None)), "kind": (str,), "text": (str,), "said": (dict, type(None)),
}  # fmt: skip
"""What the values of an event, and of a log's entry, have to be."""
_NEEDED = {"device": {"id"}, "log": {"entry"}, "name": {"node", "name"}, "alert": {"node", "alert"}}


def _events(journal: Path) -> Iterator[dict[str, Any]]:
    """Yield a journal's events; a last line that a power cut left half is left out."""
    for line in _lines(journal):
        with contextlib.suppress(ValueError, KeyError, TypeError):
            event = _judged(_object(line))
            if not _NEEDED.get(event["kind"], set()) <= event.keys():
                continue
            if event["kind"] == "log":
                event["entry"] = LogEntry(**_judged(event["entry"]))
            yield event


def _judged(event: dict[str, Any]) -> dict[str, Any]:
    """Return an event. KeyError, TypeError or ValueError where a session cannot use it."""
    to_json(event)  # No NaN, which no page could be sent.
    if not all(isinstance(event[k], kinds) for k, kinds in _KINDS.items() if k in event):
        raise ValueError("values of another kind")
    # Not within the bounds of measurements: a device stays shut out after a week, too.
    if not all(_is_moment(abs(event[k])) for k in ("time_s", "seconds") if k in event):
        raise ValueError("not a time")
    if not _is_moment(event.get("unix_s", 0.0)):
        raise ValueError("not a date")
    return event


def _object(text: str | bytes) -> dict[str, Any]:
    """Return a JSON object; ValueError."""
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError("not an object")
    return found


def _is_number(value: object) -> bool:
    try:
        return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]
    except OverflowError:  # An integer of hundreds of digits.
        return False


def _is_moment(value: Any) -> bool:
    """Return whether a value is Unix time, or seconds that may be added to it."""
    return _is_number(value) and 0.0 <= value <= LAST_UNIX_S


def _bounded(name: str, value: Any) -> Any:
    if not _is_number(value):
        raise ValueError(f"{name}: not a number")
    return within_bounds(name, value)


def _priors(row: dict[str, Any]) -> Iterator[Prior]:
    """Yield the pose, if it is one: another's stays known without it."""
    with contextlib.suppress(ValueError):
        yield Prior(**{name: _bounded(name, value) for name, value in row.items()})


def _lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file, none where there is none; one that is too long ends them."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        while line := file.readline(MOST_LINE_BYTES):
            yield line


def _check_own_files(folder: Path) -> None:
    """Raise DataError where writing here would write elsewhere: somebody else made the folder."""
    for path in folder.rglob("*"):
        # A session that runs replaces its files meanwhile.
        with contextlib.suppress(FileNotFoundError):
            mode = path.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise DataError(f"{path}: a link or a device: not a mission's folder")


def _ends_line(path: Path) -> bool:
    """Return whether the next line would begin one: nothing, or no half line, is there."""
    with path.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return True
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
