"""The team in a terminal, also over ssh: a sink that draws the newest view.

It draws in a thread of its own, so that a slow line or a stopped terminal does not delay the
session. Only lines that have changed are sent.
"""

from __future__ import annotations

import _thread
import atexit
import os
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import Any, TextIO

from relpos.live.requests import Request
from relpos.live.sinks import Sink
from relpos.live.team_view import TeamView
from relpos.said import Said
from relpos.view.keys import has_keys, raw_keys
from relpos.view.text_page import RenderOptions, alarming, page, unattended

TROUBLE = Said("terminal", "terminal view: {reason}", reason="")
DRAW_S = 0.5
"""Two pages a second, a few hundred bytes each."""
PLAIN_S = 5.0
"""Pages to a file or pipe: seldom enough for a log."""
REPAINT_S = 10.0
"""The whole page is redrawn this often, over anything that was written to the terminal."""
BELL_S = 5.0
TRAIL_S = 90.0
TRAIL_EVERY_S = 1.0
KEY_WAIT_S = 0.1


class TerminalView(Sink):
    """Draws views on a terminal, reads keys, rings the bell when an alarm begins."""

    def __init__(
        self,
        me: int | None = None,
        *,
        title: str = "relpos",
        stream: TextIO | None = None,
        keys: bool = True,
    ) -> None:
        """Draw on ``stream`` (default: stdout); a file gets a plain page every :data:`PLAIN_S`."""
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
        self._pending: deque[Request] = deque()
        self._request_count = 0
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._screen = self._stream.isatty()
        self._threads = [threading.Thread(target=self._draw_until_stopped, daemon=True)]
        if self._screen and keys and has_keys():
            self._threads.append(threading.Thread(target=self._read_keys, daemon=True))
        # Restore the terminal however the program ends.
        atexit.register(self.close)
        for thread in self._threads:
            thread.start()

    def updated(self, view: TeamView) -> None:
        """Store the newest view for the drawing thread; an alarm wakes it."""
        self._view = view
        if alarming(view) - self._rung:
            self._wake.set()

    def trouble(self) -> str | None:
        """Return why nothing is drawn any more; None when all is well."""
        return self._trouble

    def requests(self) -> list[Request]:
        """Return the requests made by keys since the last call."""
        return [self._pending.popleft() for _ in range(len(self._pending))]

    def respond(self, request: Request, reply: dict[str, Any], status: int = 200) -> None:
        """Nothing to do: the next view shows it."""

    def close(self) -> None:
        """Restore the terminal."""
        atexit.unregister(self.close)
        self._stop.set()
        self._wake.set()
        for thread in self._threads:
            thread.join(2.0)

    # -- drawing ----------------------------------------------------------------------------------

    def _draw_until_stopped(self) -> None:
        try:
            if self._screen:
                # Alternate screen, no cursor, no wrapping; the end restores the old screen.
                self._write("\x1b[?1049h\x1b[?25l\x1b[?7l")
            while not self._stop.is_set():
                self._wake.wait(DRAW_S if self._screen else PLAIN_S)
                self._wake.clear()
                if self._view is not None and not self._stop.is_set():
                    self._draw(self._view)
        except OSError as error:
            self._trouble = TROUBLE.filled(reason=error.strerror or str(error))
        except Exception as error:  # the session goes on and shows the trouble
            self._trouble = TROUBLE.filled(reason=repr(error))
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
            # A serial line does not know its size.
            columns, rows = columns or 80, rows or 24
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
        """Add to the trails of the last :data:`TRAIL_S`."""
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
        """Return a bell for a new alarm, and again while a person's alarm is not acknowledged.

        An alarm of the session rings once: a bell that rings on for a cable is ignored when it
        rings for a person.
        """
        alarms = alarming(view)
        new = alarms - self._rung
        now_s = time.monotonic()
        person = any(isinstance(alarm, int) for alarm in alarms)
        again = person and now_s - self._rung_s >= BELL_S
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
        """Carry out a key's command."""
        options = self._options
        match key:
            case "a":
                self._acknowledge()
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
                # As Ctrl-C does. os.kill would end the program at once on Windows, files unwritten.
                _thread.interrupt_main()
            case _:
                return
        self._wake.set()

    def _acknowledge(self) -> None:
        """Request to acknowledge the alarm on top; the next press is for the next one."""
        if self._view is None:
            return
        for person in unattended(self._view)[:1]:
            self._request_count += 1
            self._pending.append(
                Request(self._request_count, "acknowledge", time.time(), {"node": person.node})
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
            read, restore = raw_keys()
            try:
                while not self._stop.is_set():
                    for key in read(KEY_WAIT_S):
                        self.press(key)
            finally:
                restore()


def takes_utf8(stream: TextIO) -> bool:
    """Return whether the terminal shows braille and arrows."""
    encoding = (getattr(stream, "encoding", None) or "").lower().replace("-", "")
    # The Linux console has 512 glyphs, without braille.
    return encoding == "utf8" and os.environ.get("TERM") not in ("linux", "dumb", "vt100", "vt220")
