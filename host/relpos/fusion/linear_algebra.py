"""One thread for NumPy's linear algebra while an estimator is made and while it runs.

A BLAS library divides its sums among its threads, so their last digits depend on the number of
cores. With one thread a recording gives the same bytes on any number, and the small matrices of a
team are multiplied faster, too.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from threadpoolctl import threadpool_limits


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which BLAS uses one thread; afterwards it is as before."""
    limits: AbstractContextManager[object] = threadpool_limits(limits=1, user_api="blas")
    return limits
