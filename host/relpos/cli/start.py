"""Where ``relpos`` begins: Ctrl-C while the commands are still imported is no traceback either."""

from __future__ import annotations

import sys


def run() -> None:
    """Run the command line."""
    try:
        # The import alone takes most of the first second.
        from relpos.cli.main import app

        app()
    except KeyboardInterrupt:
        # In the words of relpos.cli.main, which may not be there yet.
        print("relpos: interrupted", file=sys.stderr)
        sys.exit(1)
