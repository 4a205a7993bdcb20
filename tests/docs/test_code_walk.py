"""The walk through the code in docs/architecture.md: names exist, in the order of a run."""

from __future__ import annotations

import importlib
import json
import os
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import groupby
from pathlib import Path

import pytest

from relpos import fusion
from relpos.emulator.team import EmulatedTeam, TeamConfig
from relpos.link.port import Link
from relpos.link.xbee import virtual_time
from relpos.live.composer import Composer
from relpos.live.files import FileSink
from relpos.live.fusion_thread import FusionThread
from relpos.live.inputs import PortInput
from relpos.live.requests import Request
from relpos.live.session import LiveSession
from relpos.live.team_view import Hello
from relpos.measurements import Motion, Prior, Range
from relpos.recording import make_recorder
from relpos.recording.about import About
from relpos.runs import Description
from relpos.view.access import listen
from relpos.view.web import WebView
from support.command import relpos

pytty = pytest.importorskip("tty")

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "host" / "relpos"
PATIENCE_S = 60.0
NODES = (1, 2, 3)
START_S = 8.0
"""By then the last of three walkers has set off."""
ELSEWHERE = ("view.server.",)
"""What runs in the page's process."""


def walks() -> dict[str, list[list[str]]]:
    """Heading -> the names in backticks of each numbered line."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    section = page.split("## From sensor to screen")[1].split("\n## ")[0]
    found = {}
    for part in section.split("\n### ")[1:]:
        title, _, body = part.partition("\n")
        lines = re.findall(r"^\d+\. (.*?)(?=^\d+\. |^$)", body, re.MULTILINE | re.DOTALL)
        found[title] = [re.findall(r"`([^`]+)`", line) for line in lines]
    return found


def python_names(title: str) -> list[str]:
    """The Python function that each line of a walk begins with, in order."""
    first = [names[0] for names in walks()[title]]
    return [n for n in first if n.split(".")[0] in ROOMS and not n.startswith(ELSEWHERE)]


ROOMS = {path.stem for path in PACKAGE.iterdir()}
NAMES = sorted({n for lines in walks().values() for names in lines for n in names if " " not in n})


def exists(name: str) -> bool:
    """Whether a function of the firmware, a Python object or a file is there."""
    if "::" in name:
        sources = (ROOT / "firmware" / "lib").rglob("*.cpp")
        return any(f" {name}(" in path.read_text(encoding="utf-8") for path in sources)
    if name.endswith(".js"):
        return (PACKAGE / "view" / "static" / "js" / name).exists()
    if name.endswith(".csv"):
        return True
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(["relpos", *parts[:k]]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            found = getattr(found, part, None)
        return found is not None
    return False


class Trace:
    """The package's functions as they are called: (thread, name)."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str]] = []
        self.on = False

    def __call__(self, frame: object, event: str, _: object) -> None:
        if event == "call" and self.on:
            code = frame.f_code  # type: ignore[attr-defined]
            if code.co_filename.startswith(str(PACKAGE)):
                module = code.co_filename[len(str(PACKAGE)) + 1 : -3].replace(os.sep, ".")
                thread = threading.current_thread().name
                self.calls.append(
                    (thread, f"{module.removesuffix('.__init__')}.{code.co_qualname}")
                )

    @contextmanager
    def traced(self) -> Iterator[None]:
        """Trace this thread and those that begin meanwhile."""
        before = sys.getprofile()
        threading.setprofile(self)
        sys.setprofile(self)
        try:
            yield
        finally:
            sys.setprofile(before)
            threading.setprofile(None)

    def during(
        self, act: Callable[[], object], until: Callable[[], bool] = lambda: True
    ) -> list[tuple[str, str]]:
        """What is called while ``act`` runs, in another thread than the traced ones.

        And after it, ``until`` that has been called, or in vain.
        """
        self.calls = []
        self.on = True
        act()
        with suppress(AssertionError):
            wait_for(until)
        self.on = False
        return self.calls

    def walked(self, title: str) -> bool:
        """Whether the functions of a walk have been called in its order."""
        return missing_call(title, self.calls) is None


def missing_call(title: str, calls: list[tuple[str, str]]) -> str | None:
    """The first function of a walk that is not called after those before it."""
    called = iter(name for _, name in calls)
    return next((name for name in python_names(title) if name not in called), None)


class PressedPage(WebView):
    """The page, with presses of a phone as if its process had passed them on."""

    def __init__(self, *args: object) -> None:
        self.pressed: deque[bytes] = deque()
        super().__init__(*args)  # type: ignore[arg-type]

    def press(self) -> None:
        now_ms = time.time() * 1e3
        press = {"id": "one", "landmark": "17", "unix_ms": now_ms}
        body = {"node": 1, "presses": [press], "sent_unix_ms": now_ms, "clock_offset_ms": 0.0}
        asked = {"id": 1, "kind": "presses", "unix_s": now_ms * 1e-3, "body": body}
        self.pressed.append(json.dumps(asked).encode() + b"\n")

    def requests(self) -> Sequence[Request]:
        # In the session's thread, as what the process passes on: neither loses the other's bytes.
        while self.pressed:
            self._in = self.pressed.popleft() + self._in
        return super().requests()


def wait_for(condition: Callable[[], bool]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.01)


@pytest.fixture(scope="module")
def traces(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[str, str]]]:
    """Title of a walk -> the calls of a live session, and of its replay, from its cause on."""
    with EmulatedTeam(TeamConfig("paper", len(NODES), 14.0, 2, beacons=True)) as team:
        chunks = [(us * 1e-6, virtual_time(us) + data) for us, data in team.stream()]
    link = Link()
    decoded, newest_s = [], []
    for arrival_s, data in chunks:
        observations = link.feed(data, arrival_s)
        decoded.append({type(o) for o in observations})
        fused_s = [o.time_s for o in observations if isinstance(o, Motion | Range)]
        newest_s.append(max([*newest_s[-1:], *fused_s], default=0.0))
    ranges = next(k for k, (s, _) in enumerate(chunks) if s > START_S and Range in decoded[k])
    step = next(k for k in range(ranges + 12, len(chunks)) if Motion in decoded[k])

    fusion.warm_up("bank")  # compiling under a profiler would take minutes
    out = tmp_path_factory.mktemp("walk")
    master, slave = os.openpty()
    pytty.setraw(slave)
    trace = Trace()
    found: dict[str, list[tuple[str, str]]] = {}
    with trace.traced():
        priors = [Prior(node, 0.0, 0.0, 0.0) for node in NODES]
        thread = FusionThread(lambda p: fusion.make("bank", p, {"hypotheses": 16}, seed=0), priors)
        door, access = listen("127.0.0.1:0")
        page = PressedPage(door, access, Hello("walk", "port", "bank", time.time()))
        recorder = make_recorder(
            out / "walk.mcap",
            About(
                1_790_000_000_000_000_000, "port", "bank", {"hypotheses": "16"}, initial="common"
            ),
        )
        files = FileSink(out / "fused", Description(), keep_received=True)
        source = PortInput(os.ttyname(slave), Link())
        session = LiveSession(source, thread, Composer(), [page, files, recorder], lasts=True)

        def write(begin: int, end: int) -> None:
            for _, data in chunks[begin:end]:
                os.write(master, data)
            wait_for(lambda: thread.failure is not None or thread.newest_s >= newest_s[end - 1])

        def walk(title: str, act: Callable[[], object]) -> None:
            found[title] = trace.during(act, lambda: trace.walked(title))

        def shown_thrice() -> bool:
            return [name for _, name in trace.calls].count("view.web.WebView.updated") >= 3

        def drive() -> None:
            try:
                # What this still causes is shown by the third view.
                trace.during(lambda: write(0, ranges), shown_thrice)
                found["idle"] = trace.during(lambda: time.sleep(0.7), shown_thrice)
                walk("One range", lambda: write(ranges, step))
                trace.during(lambda: None, shown_thrice)
                walk("One step", lambda: write(step, len(chunks)))
                walk("One landmark press", page.press)
            finally:
                session.stop()

        driver = threading.Thread(target=drive)
        driver.start()
        for _ in session.run():
            pass
        driver.join()
        session.finish()
        found["One replayed byte"] = trace.during(
            lambda: relpos("fuse", out / "walk.mcap", "--out", out, "--no-report")
        )
    os.close(master)
    return found


@pytest.mark.parametrize("name", NAMES)
def test_a_name_of_the_walk_exists(name: str) -> None:
    assert exists(name)


def test_the_walk_is_short_and_numbered() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    section = page.split("## From sensor to screen")[1].split("\n## ")[0]
    assert len(section.split()) <= 900
    assert {len(lines) >= 4 for lines in walks().values()} == {True}


@pytest.mark.parametrize("title", walks())
def test_functions_are_called_in_the_order_of_the_walk(
    title: str, traces: dict[str, list[tuple[str, str]]]
) -> None:
    names, calls = python_names(title), traces[title]
    assert len(names) >= 3
    missing = missing_call(title, calls)
    assert missing is None, f"{missing} is not called after those before it"
    # What a session also calls while nothing comes in has no first call that counts.
    idle = {name for _, name in traces["idle"]}
    first: dict[str, tuple[str, int]] = {}
    for k, (thread, name) in enumerate(calls):
        first.setdefault(name, (thread, k))
    by_thread = sorted((first[n][0], names.index(n), first[n][1]) for n in names if n not in idle)
    for thread, rows in groupby(by_thread, key=lambda row: row[0]):
        times = [k for *_, k in rows]
        assert times == sorted(times), f"in {thread} they are first called in another order"
