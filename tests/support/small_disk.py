"""A disk that can be filled."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def small_disk(folder: Path, mebibytes: int) -> Iterator[Path]:
    """A disk at ``folder`` where this user may mount one, else a plain folder."""
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={mebibytes}m", "relpos", str(folder)]
    with contextlib.suppress(OSError):
        subprocess.run(["mount", *options], capture_output=True, check=False)
    try:
        yield folder
    finally:
        if folder.is_mount():
            # Lazy: what a failure has left open there must not keep it mounted.
            subprocess.run(["umount", "--lazy", str(folder)], check=True)
