"""The number of threads of the linear algebra does not show in an estimate."""

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import relpos
from relpos.fusion.linear_algebra import one_thread


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_blas_has_one_thread_inside_the_context_and_as_many_as_before_behind_it() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        with one_thread():
            assert threads() == {1}
        assert threads() == {2}


@pytest.mark.parametrize("smooth", [False, True])
def test_an_estimate_is_the_same_with_one_thread_and_with_two(smooth: bool) -> None:
    run = relpos.simulate("paper-p1", 3, seconds=20)
    estimates = []
    for limit in (1, 2):
        with threadpool_limits(limits=limit, user_api="blas"):
            estimates.append(relpos.fuse(run, smooth=smooth).estimates)
    assert estimates[0] == estimates[1]
