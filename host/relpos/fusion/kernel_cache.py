"""Where compiled kernels are kept: in the user's cache, in folders named after their sources.

Numba notices a change of the file a kernel stands in, but not of a constant that another module
contributed to its machine code. A room imports the common ground alone (docs/architecture.md), so
a digest of both names a folder whose content is never stale.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import platformdirs

FUSION = Path(__file__).parent
_COMPLETE = "complete"
"""This file stands in a room's folder once its kernels have been compiled."""


def root(chosen: str | None = None) -> Path:
    """Return the folder of all kernels; ``chosen`` is the value of ``NUMBA_CACHE_DIR``."""
    return Path(chosen) if chosen else platformdirs.user_cache_path("relpos") / "kernels"


def folder(room: Path, under: Path) -> Path:
    """Return the folder, below ``under``, of the kernels of the room ``room`` (a folder)."""
    digest = hashlib.sha256()
    sources = {*FUSION.glob("*.py"), *(FUSION / "models").glob("*.py"), *room.glob("*.py")}
    for source in sorted(sources):
        digest.update(source.read_bytes())
    return under / f"{room.name}-{digest.hexdigest()[:16]}"


@cache
def folder_here(room: Path) -> Path:
    """Return the room's folder for this process; it can be written.

    Where the user's cache cannot be written, kernels are kept until the process ends.
    """
    kept = folder(room, root(os.environ.get("NUMBA_CACHE_DIR")))
    try:
        kept.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=kept):
            return kept
    except OSError:
        temporary = tempfile.mkdtemp(prefix="relpos-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        return Path(temporary)


def is_complete(rooms: Iterable[str], under: Path | None = None) -> bool:
    """Whether the kernels of these rooms have been compiled since their last change."""
    under = under or root(os.environ.get("NUMBA_CACHE_DIR"))
    return all((folder(FUSION / room, under) / _COMPLETE).exists() for room in rooms)


def mark_complete(room: str) -> None:
    """Note that every kernel of a room has been compiled."""
    (folder_here(FUSION / room) / _COMPLETE).touch()
