"""The number of threads of the linear algebra does not show in an estimate."""

import os
import subprocess
import sys

import pytest
from threadpoolctl import threadpool_limits

import relpos

CONTEXTS = """
from concurrent.futures import Future, ThreadPoolExecutor
from threadpoolctl import threadpool_info, threadpool_limits
import scipy.linalg
from relpos.fusion.linear_algebra import one_thread

def threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

def here(function, *arguments):
    done = Future()
    done.set_result(function(*arguments))
    return done

with threadpool_limits(limits=2, user_api="blas"):
    first, second = one_thread(), one_thread()
    first.__enter__()
    second.__enter__()
    assert threads() == {1}
    first.__exit__(None, None, None)
    assert threads() == {1}
    second.__exit__(None, None, None)
    assert threads() == {2}

    with ThreadPoolExecutor(1) as another:
        for opens, closes in [(another.submit, here), (here, another.submit)]:
            first, second = one_thread(), one_thread()
            opens(first.__enter__).result()
            assert threads() == {1}
            closes(second.__enter__).result()
            opens(first.__exit__, None, None, None).result()
            assert threads() == {1}
            closes(second.__exit__, None, None, None).result()
            assert threads() == {2}
"""


def test_blas_has_one_thread_until_the_last_context_ends_and_as_many_as_before_behind_it() -> None:
    # A session that another test has left would hold it in this process.
    done = subprocess.run(
        [sys.executable, "-c", CONTEXTS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("smooth", [False, True])
def test_an_estimate_is_the_same_with_one_thread_and_with_two(smooth: bool) -> None:
    run = relpos.simulate("paper-p1", 3, seconds=12)
    estimates = []
    for limit in (1, 2):
        with threadpool_limits(limits=limit, user_api="blas"):
            estimates.append(relpos.fuse(run, smooth=smooth).estimates)
    assert estimates[0] == estimates[1]


def test_scipys_library_has_one_thread_too_where_it_is_first_used_within_the_context() -> None:
    script = (
        "from threadpoolctl import threadpool_info\n"
        "from relpos.fusion.linear_algebra import one_thread\n"
        "with one_thread():\n"
        "    import scipy.linalg\n"
        "    print({pool['num_threads'] for pool in threadpool_info()})\n"
    )
    several = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=several, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "{1}"
