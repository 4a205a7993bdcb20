"""Where compiled kernels are kept: in the user's cache, in folders named after their sources.

Numba notices a change of the file a kernel stands in, but not of a constant that another module
contributed to its machine code. So a digest of a room's kernels and of every module of ``fusion``
that they import, directly or not, names the folder: its content is never stale.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import platformdirs

FUSION = Path(__file__).parent
ROOM_BYTES = 8 << 20
"""More than the kernels of a room take on the disk."""
_COMPLETE = "complete"
"""This file stands in a room's folder once its kernels have been compiled."""
refused: list[Path] = []
"""The folder of all kernels, where it cannot be written and a temporary one takes its place."""


def root(chosen: str | None = None) -> Path:
    """Return the folder of all kernels; ``chosen`` is the value of ``NUMBA_CACHE_DIR``."""
    return Path(chosen) if chosen else platformdirs.user_cache_path("relpos") / "kernels"


def folder(room: Path, under: Path) -> Path:
    """Return the folder, below ``under``, of the kernels of the room ``room`` (a folder)."""
    digest = hashlib.sha256()
    for source in sorted(_sources(room)):
        digest.update(source.read_bytes())
    return under / f"{room.name}-{digest.hexdigest()[:16]}"


def _sources(room: Path) -> set[Path]:
    """Return the files of a room that hold kernels, and all of ``fusion`` that they import."""
    compiler = FUSION / "compiled.py"
    sources: set[Path] = set()
    waiting = [file for file in room.glob("*.py") if compiler in _imported(file)]
    while waiting:
        file = waiting.pop()
        if file not in sources:
            sources.add(file)
            waiting += _imported(file)
    return sources


@cache
def _imported(file: Path) -> set[Path]:
    """Return the files of ``fusion`` that a file imports."""
    found: set[Path] = set()
    for module, names in _IMPORT.findall(file.read_text(encoding="utf-8")):
        inside = FUSION.joinpath(*module.split(".")[2:])
        found |= {inside.with_suffix(".py")}
        found |= {(inside / name).with_suffix(".py") for name in re.findall(r"\w+", names)}
    return {source for source in found if source.is_file()}


# Parsing the sources would take .2 s of every start.
_IMPORT = re.compile(r"^ *from (relpos\.fusion[\w.]*) import (\([^)]*\)|[^\n(]+)", re.MULTILINE)


@cache
def folder_here(room: Path) -> Path:
    """Return the room's folder for this process and those that it starts; it can be written.

    Where the user's cache cannot be written, or its disk is full, kernels are kept until the
    process ends.
    """
    kept = folder(room, root(os.environ.get("NUMBA_CACHE_DIR")))
    try:
        kept.mkdir(parents=True, exist_ok=True)
        wanted = 0 if any(kept.iterdir()) else ROOM_BYTES
        with tempfile.TemporaryFile(dir=kept) as file:
            file.write(bytes(wanted))
            return kept
    except OSError:
        refused.append(kept.parent)
        temporary = tempfile.mkdtemp(prefix="relpos-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        os.environ["NUMBA_CACHE_DIR"] = temporary
        kept = folder(room, Path(temporary))
        kept.mkdir()
        return kept


def is_complete(rooms: Iterable[str], under: Path | None = None) -> bool:
    """Whether the kernels of these rooms have been compiled since their last change."""
    under = under or root(os.environ.get("NUMBA_CACHE_DIR"))
    return all((folder(FUSION / room, under) / _COMPLETE).exists() for room in rooms)


def mark_complete(room: str) -> None:
    """Note that every kernel of a room has been compiled."""
    (folder_here(FUSION / room) / _COMPLETE).touch()
