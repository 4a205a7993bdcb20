"""Errors that a user can cause: the command line turns each into one line and exit status 1."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class RelposError(Exception):
    """Base of every error whose cause lies in the data, the device or the request.

    ``result``: the :class:`relpos.Result` up to there, where an estimator has failed.
    """

    result: Any = None


class DataError(RelposError):
    """A file, a recording or a run directory is not what it should be."""


class DeviceError(RelposError):
    """A port, a radio or a node does not answer as it should."""


class FusionInterrupted(KeyboardInterrupt):
    """Ctrl-C has ended an estimator; ``result`` is its :class:`relpos.Result` up to there."""

    def __init__(self, result: Any) -> None:
        super().__init__()
        self.result = result


def words_of(error: Exception) -> str:
    """Return an error in words: of a file's, with its name."""
    if not isinstance(error, OSError):
        # The text itself: a page may know it by its key.
        return error.args[0] if error.args and isinstance(error.args[0], str) else str(error)
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Let processes that are started within leave Ctrl-C, which reaches all of a terminal, to this.

    Whoever ignores it only in its own first line prints a traceback while it still imports.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # the first process starts it, and then unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Let Ctrl-C wait until this is done, a second one excepted.

    Raised within a callback of the compiler's library, it would be printed and forgotten.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, _: object) -> None:
        if came:
            raise KeyboardInterrupt
        came.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        signal.raise_signal(signal.SIGINT)
