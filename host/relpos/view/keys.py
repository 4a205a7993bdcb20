"""Keys of a terminal without waiting for a line: termios on POSIX, msvcrt on Windows."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from typing import Any


def has_keys() -> bool:
    """Return whether keys reach this program.

    False in the background, where reading the terminal would stop the program.
    """
    if not sys.stdin.isatty():
        return False
    if sys.platform == "win32":
        return True
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:
        return False


def raw_keys() -> tuple[Callable[[float], str], Callable[[], None]]:
    """Return a function that reads keys for so many seconds, and one that restores the terminal.

    OSError where the terminal is gone.
    """
    return _windows_keys() if sys.platform == "win32" else _posix_keys()


def _windows_keys() -> tuple[Callable[[float], str], Callable[[], None]]:
    import msvcrt

    # Typeshed declares these for Windows alone.
    console: Any = msvcrt

    def read(wait_s: float) -> str:
        until_s = time.monotonic() + wait_s
        while time.monotonic() < until_s:
            if console.kbhit():
                return str(console.getwch())
            time.sleep(0.02)
        return ""

    return read, lambda: None


def _posix_keys() -> tuple[Callable[[float], str], Callable[[], None]]:
    import select
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before: Any = termios.tcgetattr(descriptor)
    # Unlike raw mode, cbreak keeps signals: Ctrl-C ends the session as always.
    tty.setcbreak(descriptor)

    def read(wait_s: float) -> str:
        ready, _, _ = select.select([descriptor], [], [], wait_s)
        if not ready:
            return ""
        typed = os.read(descriptor, 64)
        if not typed:
            raise OSError("no more keys")
        text = typed.decode("utf-8", "ignore")
        # An arrow key sends an escape sequence, whose letters are not keys.
        return "" if text.startswith("\x1b") else text

    return read, lambda: termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
