"""One thread for NumPy's linear algebra while an estimator is made and while it runs.

A BLAS library divides its sums among its threads, so their last digits depend on the number of
cores. With one thread a recording gives the same bytes on any number, and the small matrices of a
team are multiplied faster, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

from threadpoolctl import OpenBLASController, threadpool_limits

_LOCK = Lock()
_USERS: list[threadpool_limits] = []
"""One entry for each context that is open; the first knows how it was before."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS use one thread; after the last of all threads' contexts it is as before."""
    # Compiled kernels multiply by SciPy's library. Loaded later, it would not be limited.
    import scipy.linalg.cython_blas  # noqa: F401

    with _LOCK:
        _take_control()
        _USERS.append(threadpool_limits(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _LOCK:
            if len(_USERS) > 1:
                del _USERS[1]
            else:
                _take_control()
                _USERS.pop().restore_original_limits()


def _take_control() -> None:
    """Let this thread set the limits: otherwise only the thread that set them first can."""
    OpenBLASController.clear_controlling_thread(force=True)
