"""How kernels are compiled: numba, in one place and with one set of switches.

Every kernel has a readable NumPy twin in :mod:`relpos.fusion.twins` that tests compare it with.
Machine code is kept on disk (beside the source, or in the user's cache where that is read-only),
so that only the very first run after an installation waits for the compiler.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile a kernel on its first call.

    Sums may be reordered and fused (``reassoc``, ``contract``: they vectorise), but infinities
    and NaN keep their meaning: kernels may rely on them.
    """
    fast = {"reassoc", "contract", "arcp", "nsz"}
    compile_it = numba.jit(
        nopython=True, cache=True, nogil=True, fastmath=fast, error_model="numpy"
    )
    return cast(F, compile_it(function))


def inlined(function: F) -> F:
    """Compile a small helper into every kernel that calls it."""
    return cast(F, numba.jit(nopython=True, inline="always", error_model="numpy")(function))
