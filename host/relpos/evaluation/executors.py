"""Executors for many independent jobs: this process, all cores, or a Dask cluster.

Everything takes a :class:`concurrent.futures.Executor`, so that the same code runs in all three
places. Jobs are module-level functions with picklable arguments that depend on nothing else: the
same arguments give the same result wherever they run.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context
from typing import Any, ParamSpec, TypeVar

from relpos.errors import RelposError

P = ParamSpec("P")
T = TypeVar("T")

CONNECT_S = 10.0
"""Timeout of the connection to a scheduler."""


class Serial(Executor):
    """Runs every job in this process when it is submitted."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run the job; the future is done."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def executor(cluster: str | None = None, workers: int | None = None) -> Iterator[Executor]:
    """Yield an executor: ``workers`` processes (all cores), or the cluster at an address.

    One worker is this process itself. ``cluster`` is the address of a Dask scheduler, as
    ``tcp://host:8786``; its workers need relpos installed. RelposError where that fails.
    """
    if cluster is not None:
        yield from _on_cluster(cluster)
        return
    count = workers or os.cpu_count() or 1
    if count == 1:
        yield Serial()
        return
    # Each process does its own sums; more BLAS threads than cores only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Spawned, not forked: a fork copies locks that threads of this process may hold.
    with ProcessPoolExecutor(
        count, mp_context=get_context("spawn"), initializer=_leave_interrupts_to_the_parent
    ) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _leave_interrupts_to_the_parent() -> None:
    """Ignore Ctrl-C, which reaches every process of a terminal; the parent reports it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _on_cluster(address: str) -> Iterator[Executor]:
    try:
        # By name: an extra that is not installed has no types to check.
        distributed: Any = import_module("distributed")
    except ImportError:
        raise RelposError(
            "--cluster needs Dask: pip install 'relpos[cluster]', here and on the workers"
        ) from None
    try:
        client = distributed.Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise RelposError(f"no Dask scheduler at {address}: {error or 'no answer'}") from None
    with client:
        if not client.scheduler_info().get("workers"):
            raise RelposError(f"the Dask scheduler at {address} has no workers")
        with client.get_executor() as pool:
            yield pool


def run_all(
    pool: Executor,
    function: Callable[..., T],
    jobs: Sequence[tuple[Any, ...]],
    on_done: Callable[[int, int], None] | None = None,
) -> list[T]:
    """Call ``function`` with the arguments of every job; results in the order of the jobs.

    ``on_done`` is called after every job with how many are done, of how many. The first failure is
    raised, and what has not begun is not begun.
    """
    futures: dict[Future[T], int] = {}
    results: dict[int, T] = {}
    try:
        for k, job in enumerate(jobs):
            futures[pool.submit(function, *job)] = k
        for future in as_completed(futures):
            results[futures[future]] = future.result()
            if on_done is not None:
                on_done(len(results), len(jobs))
    except BrokenProcessPool:
        raise RelposError(
            "a worker process died: too little memory? Try fewer workers, or --cluster"
        ) from None
    finally:
        for future in futures:
            future.cancel()
    return [results[k] for k in range(len(jobs))]
