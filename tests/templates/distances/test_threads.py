"""Threads of the distances, and of the matrix library beneath them."""

import os
import subprocess
import sys
import threading

import pytest

from templates.distances.threads import share
from tests.patience import PATIENCE_S


def meet(count: int) -> None:
    """Let as many threads meet, each for one item."""
    barrier = threading.Barrier(count, timeout=PATIENCE_S)
    seen: list[int] = []

    def work(_: int) -> None:
        barrier.wait()
        seen.append(threading.get_ident())

    share(work, range(count), count)
    assert len(set(seen)) == count
    assert threading.get_ident() in seen


def test_the_caller_and_its_helpers_share_the_items() -> None:
    meet(3)
    meet(3)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system places threads alone")
def test_helpers_may_run_wherever_the_caller_may() -> None:
    barrier = threading.Barrier(3, timeout=PATIENCE_S)
    allowed: list[set[int]] = []

    def work(_: int) -> None:
        barrier.wait()
        allowed.append(os.sched_getaffinity(0))

    for _ in range(2):
        allowed.clear()
        share(work, range(3), 3)
        assert allowed == [os.sched_getaffinity(0)] * 3


def test_every_item_is_done_once_however_few_the_threads() -> None:
    done: list[int] = []
    share(done.append, range(100), 3)
    share(done.append, range(100), 1)
    assert sorted(done) == sorted([*range(100), *range(100)])


def test_the_first_failure_is_raised_and_the_helpers_work_again() -> None:
    calls: list[int] = []

    def fail(item: int) -> None:
        calls.append(item)
        raise ValueError(str(item))

    with pytest.raises(ValueError, match=r"[01]"):
        share(fail, range(8), 2)
    assert len(calls) <= 2
    meet(2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system does not fork")
def test_a_forked_child_has_helpers_of_its_own() -> None:
    meet(2)
    child = os.fork()
    if not child:
        try:
            meet(2)
            os._exit(0)
        except BaseException:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 0


def test_the_library_of_compiled_code_is_held_to_one_thread_from_its_first_product() -> None:
    """In a process of its own, where nothing else has loaded it."""
    code = """
from threadpoolctl import ThreadpoolController
from templates.distances import blas
from templates.distances.kernels import tiles
with blas.single_threaded():
    libraries = ThreadpoolController().select(user_api="blas").lib_controllers
    assert any("scipy" in each.filepath for each in libraries)
    assert all(each.num_threads == 1 for each in libraries)
libraries = ThreadpoolController().select(user_api="blas").lib_controllers
assert all(each.num_threads == 2 for each in libraries)
"""
    two = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", code], check=True, env=two)
