"""The team in a terminal: a sink that draws the newest view, for a laptop in the rain over ssh.

It draws in a thread of its own: a line that is slow, or a terminal that has been stopped, holds up
nobody. Only lines that have changed are sent.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, TextIO

from relpos.live.requests import Request
from relpos.live.sinks import Sink
from relpos.live.team_view import TeamView
from relpos.view.text_page import RenderOptions, alarming, page, unattended

DRAW_S = 0.5
"""Two pages a second: as fast as anybody reads, a few hundred bytes each."""
PLAIN_S = 5.0
"""Where it is no terminal, a page this often does not flood a log."""
REPAINT_S = 10.0
"""Whatever else was written over the page is gone by then."""
BELL_S = 5.0
TRAIL_S = 90.0
TRAIL_EVERY_S = 1.0
KEY_WAIT_S = 0.1


class TerminalView(Sink):
    """Draws pictures on a terminal, reads keys, rings the bell when an alarm begins."""

    def __init__(
        self,
        me: int | None = None,
        *,
        title: str = "relpos",
        stream: TextIO | None = None,
        keys: bool = True,
    ) -> None:
        """Take over the terminal that ``stream`` (stdout) is; a plain file gets a page at times."""
        self._stream = stream or sys.stdout
        self._options = RenderOptions(me=me, title=title, utf8=takes_utf8(self._stream))
        self._view: TeamView | None = None
        self._trails: dict[int, deque[tuple[float, float]]] = {}
        self._trailed_s = -TRAIL_EVERY_S
        self._drawn: list[str] = []
        self._painted_s = 0.0
        self._size = (0, 0)
        self._rung: frozenset[str | int] = frozenset()
        self._rung_s = 0.0
        self._trouble: str | None = None
        self._asks: deque[Request] = deque()
        self._asked = 0
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._screen = self._stream.isatty()
        self._threads = [threading.Thread(target=self._draw_until_stopped, daemon=True)]
        if self._screen and keys and _has_keys():
            self._threads.append(threading.Thread(target=self._read_keys, daemon=True))
        # Whatever ends the program, the terminal is given back.
        atexit.register(self.close)
        for thread in self._threads:
            thread.start()

    def updated(self, view: TeamView) -> None:
        """Leave the newest view for the drawing thread; an alarm wakes it."""
        self._view = view
        if alarming(view) - self._rung:
            self._wake.set()

    def trouble(self) -> str | None:
        """Say that the terminal is gone; None when all is well."""
        return self._trouble

    def requests(self) -> list[Request]:
        """What was asked for by keys since the last call."""
        return [self._asks.popleft() for _ in range(len(self._asks))]

    def respond(self, request: Request, reply: dict[str, Any], status: int = 200) -> None:
        """Nothing to do: the next view shows it."""

    def close(self) -> None:
        """Give the terminal back as it was."""
        atexit.unregister(self.close)
        self._stop.set()
        self._wake.set()
        for thread in self._threads:
            thread.join(2.0)

    # -- drawing ----------------------------------------------------------------------------------

    def _draw_until_stopped(self) -> None:
        try:
            if self._screen:
                # The other screen, no cursor, no wrapping: what was there comes back in the end.
                self._write("\x1b[?1049h\x1b[?25l\x1b[?7l")
            while not self._stop.is_set():
                self._wake.wait(DRAW_S if self._screen else PLAIN_S)
                self._wake.clear()
                if self._view is not None and not self._stop.is_set():
                    self._draw(self._view)
        except OSError as error:
            self._trouble = f"terminal view: {error.strerror or error}"
        except Exception as error:  # the session goes on, and says that this does not
            self._trouble = f"terminal view: has failed: {error!r}"
        finally:
            if self._screen:
                with suppress(OSError, ValueError):
                    self._write("\x1b[?7h\x1b[?25h\x1b[?1049l")

    def _draw(self, view: TeamView) -> None:
        from rich.console import Console

        self._follow(view)
        columns, rows = 100, len(view.people) + 26
        if self._screen:
            columns, rows = os.get_terminal_size(self._stream.fileno())
        console = Console(
            file=self._stream, force_terminal=self._screen or None, legacy_windows=False
        )
        options = replace(self._options, columns=columns, rows=rows, trails=self._trails)
        lines = page(view, options)
        bell = self._bell(view) if self._screen else ""
        if not self._screen:
            text = "\n".join(line.plain.rstrip() for line in lines[:-1])
            self._write(text.rstrip() + "\n\n")
            return
        drawn = []
        for line in lines:
            with console.capture() as captured:
                console.print(line, end="", no_wrap=True, overflow="ignore", crop=False)
            drawn.append(captured.get())
        now_s = time.monotonic()
        if (columns, rows) != self._size or now_s - self._painted_s > REPAINT_S:
            self._size, self._painted_s, self._drawn = (columns, rows), now_s, []
            bell += "\x1b[2J"
        before = self._drawn or [""] * len(drawn)
        changed = "".join(
            f"\x1b[{row};1H\x1b[K{line}"
            for row, (line, old) in enumerate(zip(drawn, before, strict=True), start=1)
            if line != old
        )
        self._drawn = drawn
        if bell or changed:
            self._write(bell + changed)

    def _follow(self, view: TeamView) -> None:
        """Keep where everybody has been of late."""
        if view.time_s - self._trailed_s < TRAIL_EVERY_S:
            return
        self._trailed_s = view.time_s
        for person in view.people:
            if person.x_m is not None and person.y_m is not None and person.status == "ok":
                trail = self._trails.setdefault(
                    person.node, deque(maxlen=int(TRAIL_S / TRAIL_EVERY_S))
                )
                trail.append((person.x_m, person.y_m))

    def _bell(self, view: TeamView) -> str:
        """Ring for a new alarm, and again as long as there is somebody nobody has seen to.

        What is wrong with the session rings once: a bell that goes on for a cable is not heard
        any more when it is for a person.
        """
        alarms = alarming(view)
        new = alarms - self._rung
        now_s = time.monotonic()
        somebody = any(isinstance(alarm, int) for alarm in alarms)
        again = somebody and now_s - self._rung_s >= BELL_S
        self._rung = alarms
        if self._options.muted or not (new or again):
            return ""
        self._rung_s = now_s
        return "\a"

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()

    # -- keys -------------------------------------------------------------------------------------

    def press(self, key: str) -> None:
        """Do what a key stands for."""
        options = self._options
        match key:
            case "a":
                self._see_to()
            case "m" | "M":
                self._options = replace(options, me=self._other(1 if key == "m" else -1))
            case "+" | "=":
                self._options = replace(options, zoom=options.zoom + 1)
            case "-":
                self._options = replace(options, zoom=options.zoom - 1)
            case "0":
                self._options = replace(options, zoom=0)
            case "u":
                self._options = replace(options, heading_up=not options.heading_up)
            case "t":
                self._options = replace(options, table=True, map=not options.map)
            case "c":
                self._options = replace(options, map=True, table=not options.table)
            case "b":
                self._options = replace(options, muted=not options.muted)
            case "q":
                # As Ctrl-C does: the session ends, and with it this view.
                os.kill(os.getpid(), signal.SIGINT)
            case _:
                return
        self._wake.set()

    def _see_to(self) -> None:
        """Tell everybody that the alarm on top is seen to; the next press is for the next one."""
        if self._view is None:
            return
        for person in unattended(self._view)[:1]:
            self._asked += 1
            self._asks.append(
                Request(self._asked, "acknowledge", time.time(), {"node": person.node})
            )

    def _other(self, step: int) -> int | None:
        view = self._view
        nodes = [person.node for person in view.people] if view is not None else []
        if not nodes:
            return self._options.me
        me = self._options.me
        place = nodes.index(me) if me in nodes else 0
        return nodes[(place + step) % len(nodes)]

    def _read_keys(self) -> None:
        with suppress(OSError, ValueError):
            read, restore = _raw_keys()
            try:
                while not self._stop.is_set():
                    for key in read(KEY_WAIT_S):
                        self.press(key)
            finally:
                restore()


def takes_utf8(stream: TextIO) -> bool:
    """Return whether braille and arrows can be shown there."""
    encoding = (getattr(stream, "encoding", None) or "").lower().replace("-", "")
    # The kernel's own console has 512 glyphs, braille not among them.
    return encoding == "utf8" and os.environ.get("TERM") not in ("linux", "dumb", "vt100", "vt220")


def _has_keys() -> bool:
    """Return whether keys come here: not to a program in the background, whom asking would stop."""
    if not sys.stdin.isatty():
        return False
    if sys.platform == "win32":
        return True
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:
        return False


def _raw_keys() -> tuple[Callable[[float], str], Callable[[], None]]:
    """Return what reads keys without waiting for a line, and what undoes that."""
    if sys.platform == "win32":
        import msvcrt

        def read(wait_s: float) -> str:
            until_s = time.monotonic() + wait_s
            while time.monotonic() < until_s:
                if msvcrt.kbhit():
                    return msvcrt.getwch()
                time.sleep(0.02)
            return ""

        return read, lambda: None
    import select
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before: Any = termios.tcgetattr(descriptor)
    # Signals stay: Ctrl-C ends the session as always.
    tty.setcbreak(descriptor)

    def read_posix(wait_s: float) -> str:
        ready, _, _ = select.select([descriptor], [], [], wait_s)
        if not ready:
            return ""
        typed = os.read(descriptor, 64)
        if not typed:
            raise OSError("no more keys")
        text = typed.decode("utf-8", "ignore")
        # Arrows and the like come as a sequence, whose letters are nobody's keys.
        return "" if text.startswith("\x1b") else text

    return read_posix, lambda: termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
