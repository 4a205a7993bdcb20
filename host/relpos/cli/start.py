"""Where ``relpos`` begins: Ctrl-C while the commands are still imported is no traceback either."""

from __future__ import annotations

import os
import signal
import sys


def _end(*_: object) -> None:
    """End as Ctrl-C does, also where that is ignored, as in the background of a script."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        raise KeyboardInterrupt
    signal.raise_signal(signal.SIGINT)


def run() -> None:
    """Run the command line."""
    signal.signal(signal.SIGTERM, _end)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed (>&-): the next file that is opened took its place
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
    try:
        # The import alone takes most of the first second.
        from relpos.cli.main import app

        app()
    except KeyboardInterrupt:
        # In the words of relpos.cli.main, which may not be there yet.
        print("relpos: interrupted", file=sys.stderr)
        sys.exit(1)
