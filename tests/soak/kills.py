"""Kills of real processes: the session, the page's server, the team; and a disk that fills.

An episode is an emulated team in real time, and sessions over it, each killed with SIGKILL: of a
mission, which has to go on, or of `relpos fuse` with any of its outputs.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import httpx
from oracle import require

from relpos.measurements import Motion
from relpos.recording import open_recording
from relpos.recording.topics import Serial
from relpos.runs import load_run, read_estimates
from support.small_disk import small_disk

PATIENCE_S = 90.0
"""For what has no promise of its own on a busy computer."""
RECORDED_S, WRITTEN_S = 1.0, 2.0
"""What a kill may take from a recording, and from the plain files."""
DISK_MB = 16
ROOM_S = 1.0
"""Within which what waited is written, once there is room."""
T = TypeVar("T")


def wait_for(what: str, found: Callable[[], T]) -> T:
    """Return what ``found`` gives once it is true."""
    until_s = time.monotonic() + PATIENCE_S
    while not (got := found()):
        require(time.monotonic() < until_s, what, f"not within {PATIENCE_S:.0f} s")
        time.sleep(0.05)
    return got


class Process:
    """A command of relpos, what it says, and its end."""

    def __init__(self, said: Path, *arguments: object) -> None:
        self._said = said
        with said.open("w") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "relpos.cli.main", *map(str, arguments)],
                stdout=file, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip

    def said(self) -> str:
        """Return what it has said so far."""
        return self._said.read_text(errors="replace")

    def says(self, pattern: str) -> str:
        """Return the first words that fit; empty where it ends without them."""

        def found() -> str | None:
            words, over = re.search(pattern, self.said()), self._process.poll() is not None
            return words[0] if words else "-" if over else None

        words = wait_for(f"a process says {pattern} or ends", found)
        return "" if words == "-" else words

    def kill(self) -> None:
        """Kill it and its children."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        require("Traceback" not in self.said(), "no process ends with a traceback", self.said())

    def kill_server(self) -> bool:
        """Kill the page's server; return whether there was one."""
        tasks = Path(f"/proc/{self._process.pid}/task").glob("*/children")
        servers = [int(child) for task in tasks for child in task.read_text().split()
                   if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()]  # fmt: skip
        for server in servers:
            os.kill(server, signal.SIGKILL)
        return bool(servers)


class Page:
    """A guest of a session's page, and the newest view that it was given."""

    def __init__(self, address: str, cookies: httpx.Cookies | None = None) -> None:
        self.base = re.sub(r"[/?]+(token=.*)?$", "", address)
        self._client = httpx.Client(timeout=30.0, follow_redirects=True, cookies=cookies)
        self._client.get(address)
        self.view: dict[str, Any] = {}

    @property
    def cookies(self) -> httpx.Cookies:
        """By which a mission knows the guest again."""
        return self._client.cookies

    def look(self) -> bool:
        """Return whether there is a view."""
        with contextlib.suppress(httpx.TransportError):
            answer = self._client.get(f"{self.base}/api/picture")
            if answer.status_code == 200:
                require("NaN" not in answer.text and "Infinity" not in answer.text, "a view")
                self.view = json.loads(answer.text)
                return True
            require(answer.status_code == 503, "a guest gets a view", answer.text)
        return False

    def name(self, node: int, name: str) -> int:
        """Return the answer's status; 503 without one."""
        try:
            body = {"node": node, "name": name}
            status = self._client.post(f"{self.base}/api/name", json=body).status_code
        except httpx.TransportError:
            return 503
        require(status in (200, 429, 503), "a name is taken or refused in words", status)
        return status

    def heard_s(self) -> float:
        """Return when anybody was heard last, in the session's time; 0 before."""
        ages_s = [p["seen_s"] for p in self.view["people"] if p["seen_s"] is not None]
        return float(self.view["time_s"]) - min(ages_s) if ages_s else 0.0

    def moved_s(self) -> float:
        """Return until when anybody's motion is known, in the session's time."""
        return max((float(p["motion_s"] or 0.0) for p in self.view["people"]), default=0.0)

    def close(self) -> None:
        """Leave."""
        self._client.close()


class Host:
    """Sessions over one team, and what must be left of each."""

    def __init__(self, rng: random.Random, folder: Path, disk: Path, mission: bool) -> None:
        self._rng, self._folder, self._mission = rng, folder, mission
        self._disk = disk
        self._ballast = disk / "ballast"
        self._names: dict[int, set[str]] = {}
        """The confirmed name of each node, and those after it that had no answer."""
        self._cookies: httpx.Cookies | None = None
        self._outputs: list[str] = []
        self.kills = self.restarts = 0
        self.lost_s = {"recording": 0.0, "files": 0.0}
        """The most that a kill took."""
        self._full = False
        self._room_s = 0.0
        """When the disk had room again."""
        self._killed_s = 0.0
        self._start_team()

    def _start_team(self) -> None:
        said = self._folder / "team"
        nodes, seed = self._rng.choice((2, 3, 5)), self._rng.randrange(1000)
        self.team = Process(said, "emulate", "--nodes", nodes, "--seed", seed)
        self._port = self.team.says(r"/dev/\S+")
        require(self._port != "", "the team begins", self.team.said())

    def _command(self, number: int) -> list[object]:
        quiet = ["--initial", "common", "--view-listen"]
        if self._mission:
            again = (self._disk / "mission" / "mission.json").exists()
            where = "127.0.0.1" if again else "127.0.0.1:0"
            return ["mission", self._disk / "mission", self._port, *quiet, where, "--no-open"]
        out = self._disk / f"out-{number}"
        chosen = {
            "--record": ["--record", out.with_suffix(".mcap")],
            "--cot": ["--cot", "udp://127.0.0.1:6969", "--pin", "47.0,8.0,0"],
            "--foxglove": ["--foxglove", "127.0.0.1:0"],
            "--terminal": ["--terminal"],
        }
        self._outputs = [name for name in chosen if self._rng.random() < 0.5]
        words = [word for name in self._outputs for word in chosen[name]]
        return ["fuse", self._port, "--out", out, *words, "--view", *quiet, "127.0.0.1:0",
                "--no-open"]  # fmt: skip

    def run(self, number: int) -> None:
        """One session until its kill."""
        rng, said = self._rng, self._folder / f"session-{number}"
        session = Process(said, *self._command(number))
        try:
            address = session.says(r"http://\S+")
            if self._full and not address:
                session.kill()
                self._set_full(False)
                session = Process(said, *self._command(number))
                address = session.says(r"http://\S+")
            require(address != "", "a session begins, also after a kill", session.said())
            page = Page(address, self._cookies)
            wait_for("the page has a view of somebody", lambda: page.look() and page.heard_s())
            self._check_names(page)
            self._live(session, page, rng.uniform(1.0, 6.0))
        finally:
            session.kill()
        self._killed_s = time.monotonic()
        self.kills += 1
        self._check_files(number, page)
        self._cookies = page.cookies if self._mission else None
        page.close()
        if rng.random() < 0.2:
            self.team.kill()
            self._start_team()

    def _live(self, session: Process, page: Page, seconds: float) -> None:
        """Guests, kills of the server, a disk that is full for a while."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            dice = self._rng.random()
            if dice < 0.1:
                node, name = self._rng.randrange(1, 3), f"Kim {self._rng.randrange(100)}"
                if (status := page.name(node, name)) == 200:
                    self._names[node] = {name}
                elif status == 503 and node in self._names:
                    self._names[node].add(name)
            elif dice < 0.13 and session.kill_server():
                self.restarts += 1
                wait_for("the page is back after its server's kill", page.look)
            elif dice < 0.16:
                self._set_full(not self._full)
            time.sleep(0.1)
            page.look()

    def _set_full(self, full: bool) -> None:
        """Fill the disk, or make room again."""
        if not self._disk.is_mount():
            return
        self._full = full
        if not full:
            self._room_s = time.monotonic()
            self._ballast.unlink(missing_ok=True)
            return
        with contextlib.suppress(OSError), self._ballast.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))

    def _check_names(self, page: Page) -> None:
        if not self._mission:
            self._names.clear()
            return

        def named() -> bool:
            page.look()
            shown = {person["node"]: person["name"] for person in page.view["people"]}
            return all(shown[node] in names for node, names in self._names.items() if node in shown)

        wait_for(f"confirmed names are there after a kill: {self._names}", named)

    def _check_files(self, number: int, page: Page) -> None:
        """What is left can be read, and lacks no more than promised."""
        folder = self._disk / ("mission" if self._mission else "")
        recordings = sorted(folder.glob("recording-*.mcap" if self._mission else "*.mcap"))
        for path in recordings[-1:]:
            recording = open_recording(path)
            newest_s = max((s for s, e in recording.inputs() if isinstance(e, Serial)), default=0.0)
            if path.stem.endswith(f"-{number + 1 if self._mission else number}"):
                # By the computer's clock: an emulated team has one of its own.
                began_s = recording.about.started_unix_ns * 1e-9
                lost_s = page.view["arrived_unix_s"] - began_s - newest_s
                self._check_lost("recording", lost_s, RECORDED_S)
        out = folder / f"session-{number + 1}" if self._mission else folder / f"out-{number}"
        if out.is_dir():
            with contextlib.suppress(FileNotFoundError):
                read_estimates(out)
        if (out / "received" / "motion.csv").exists():
            run = load_run(out / "received")
            newest_s = max((m.time_s for m in run.measurements if isinstance(m, Motion)), default=0)
            self._check_lost("files", page.moved_s() - newest_s, WRITTEN_S)

    def _check_lost(self, where: str, lost_s: float, most_s: float) -> None:
        if self._full or self._killed_s < self._room_s + ROOM_S:
            return  # What waits for room is lost by a kill; that it waits was told.
        self.lost_s[where] = max(self.lost_s[where], lost_s)
        require(lost_s <= most_s, f"a kill takes {most_s:.0f} s of {where} at most", lost_s)

    def close(self) -> None:
        """End the team, and give the disk back."""
        self.team.kill()


def episode(seed: int, out: Path) -> str:
    """Run one; a line about it. ViolationError where a promise is broken."""
    rng = random.Random(seed)
    mission, sessions = rng.random() < 0.5, rng.randrange(3, 6)
    with small_disk(out / "disk", DISK_MB) as disk:
        host = Host(rng, out, disk, mission)
        try:
            for number in range(sessions):
                host.run(number)
        finally:
            host.close()
    lost = ", ".join(f"{seconds:.2f} s of {where}" for where, seconds in host.lost_s.items())
    kind = "mission" if mission else "fuse"
    return f"{kind}, {host.kills} kills of sessions, {host.restarts} of servers, lost {lost}"
