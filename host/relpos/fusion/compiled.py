"""How kernels are compiled: numba, in one place and with one set of switches.

Floating point is strict (no ``fastmath``): the process that compiles a kernel and those that read
it from the cache compute the same bytes, so a replay is exact. Every kernel has a readable NumPy
reference in ``tests/reference`` that tests compare it with.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numba.core.config

from relpos.fusion import kernel_cache

F = TypeVar("F", bound=Callable[..., object])

# No kernel is called from C.
_jit: Any = numba.njit
_SWITCHES: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def compiled(function: F) -> F:
    """Compile a kernel at its first call, and keep it (:mod:`relpos.fusion.kernel_cache`)."""
    room = Path(cast(Any, function).__code__.co_filename).parent
    config: Any = numba.core.config
    # Numba reads the setting when it decorates; other users of numba keep theirs.
    others, config.CACHE_DIR = config.CACHE_DIR, str(kernel_cache.folder_here(room))
    try:
        return cast(F, _jit(cache=True, **_SWITCHES)(function))
    finally:
        config.CACHE_DIR = others


def inner(function: F) -> F:
    """Compile what only kernels call, with the first of them; it is kept with them alone."""
    return cast(F, _jit(**_SWITCHES, no_cpython_wrapper=True)(function))


def inlined(function: F) -> F:
    """Compile it into each kernel that calls it: small helpers, and what one kernel alone calls."""
    return cast(F, _jit(inline="always", error_model="numpy")(function))
