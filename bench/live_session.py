"""What the live benches share: where a session's page is."""

from __future__ import annotations

import re
import subprocess
import threading


def page_of(session: subprocess.Popen[str]) -> tuple[str, str]:
    """Wait until it says where its page is; return ``://HOST:PORT`` and the key to it.

    What it says from then on is read and dropped.
    """
    assert session.stderr is not None
    found = next(f for line in session.stderr if (f := re.search(r"http(://\S+?)/\?(\S+)", line)))
    threading.Thread(target=lambda: list(session.stderr or ()), daemon=True).start()
    return found[1], found[2]
