"""Where ``relpos`` begins: Ctrl-C while the commands are still imported is no traceback either."""

from __future__ import annotations

import os
import sys


def run() -> None:
    """Run the command line."""
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
