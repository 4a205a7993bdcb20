"""How kernels are compiled: numba, in one place and with one set of switches.

Every kernel has a readable NumPy twin in :mod:`relpos.fusion.twins` that tests compare it with.
Machine code is kept on disk (beside the source, or in the user's cache where that is read-only),
so that only the very first run after an installation waits for the compiler.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from relpos.fusion import quick_typing  # noqa: F401  (registers its rules)

F = TypeVar("F", bound=Callable[..., object])

_SWITCHES: dict[str, Any] = {
    "nopython": True,
    "nogil": True,
    "fastmath": {"reassoc", "contract", "arcp", "nsz"},
    "error_model": "numpy",
    # No kernel is called from C.
    "no_cfunc_wrapper": True,
}


def compiled(function: F) -> F:
    """Compile a kernel on its first call.

    Sums may be reordered and fused (``reassoc``, ``contract``: they vectorise), but infinities
    and NaN keep their meaning: kernels may rely on them.
    """
    return cast(F, numba.jit(cache=True, **_SWITCHES)(function))


def inner(function: F) -> F:
    """Compile what only kernels call, with the first of them.

    It is kept with them, and not once more by itself; nor does it get the code that takes Python's
    arguments.
    """
    return cast(F, numba.jit(**_SWITCHES | {"no_cpython_wrapper": True})(function))


def inlined(function: F) -> F:
    """Compile it into each kernel that calls it: small helpers, and what one kernel alone calls."""
    return cast(F, numba.jit(nopython=True, inline="always", error_model="numpy")(function))
