"""Where the kernels' machine code is kept, and whether it is there; knows nothing of numba.

A process that compiles for itself adds up in another order here and there than one that reads
what was compiled before (the compiler may reorder sums, and links what it has at hand): the same
measurements give estimates that differ in the last digits. So that a replay gives a session's
estimates to the last byte, whoever needs kernels has them compiled by a process of its own first.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

KERNELS = ("bank_kernels", "joint", "lanes", "noise", "particle_kernels", "starts_kernels")
"""Modules with kernels that sessions need (``fusion.warm_up``); others compile when used."""
SOURCES = Path(__file__).parent


def folders(told: str | None) -> list[Path]:
    """Where numba keeps it: as ``told`` (NUMBA_CACHE_DIR), by the source, in the user's cache."""
    if told:
        return [Path(told)]
    from platformdirs import user_cache_path

    return [SOURCES / "__pycache__", user_cache_path("numba", appauthor=False)]


def is_kept(places: Sequence[Path]) -> bool:
    """Whether every module of :data:`KERNELS` has been compiled since it was last changed."""
    pattern = f"py{sys.version_info.major}{sys.version_info.minor}"
    for module in KERNELS:
        source = (SOURCES / f"{module}.py").stat().st_mtime
        files = (f for place in places for f in place.rglob(f"{module}.*.{pattern}.nbi"))
        if not any(f.stat().st_mtime >= source for f in files):
            return False
    return True


def compile_apart() -> None:
    """Have all of it compiled by another process, where it is not kept yet.

    Where that fails, this process will compile for itself.
    """
    if is_kept(folders(os.environ.get("NUMBA_CACHE_DIR"))):
        return
    program = "from relpos import fusion; [fusion.rehearse(n) for n in fusion.SETTINGS]"
    subprocess.run(
        [sys.executable, "-c", program], check=False, stdin=subprocess.DEVNULL, capture_output=True
    )
