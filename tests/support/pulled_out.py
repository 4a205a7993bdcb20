"""A serial adapter that is pulled out as soon as it is spoken to."""

from __future__ import annotations

import contextlib
import os
import threading
import tty
from collections.abc import Iterator


@contextlib.contextmanager
def pulled_out() -> Iterator[str]:
    """The path of a pseudo-terminal that vanishes with the first bytes that are sent to it."""
    terminal, port = os.openpty()
    tty.setraw(port)
    path = os.ttyname(port)

    def run() -> None:
        with contextlib.suppress(OSError):  # nothing was sent
            os.read(terminal, 4096)
        os.close(terminal)

    threading.Thread(target=run, daemon=True).start()
    try:
        yield path
    finally:
        os.close(port)
