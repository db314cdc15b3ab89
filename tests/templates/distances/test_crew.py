import os
import subprocess
import sys
import threading

import pytest

from templates.distances.crew import Crew
from tests.patience import PATIENCE_S

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity"), reason="the system places threads alone"
)


def test_helpers_may_run_wherever_the_caller_may() -> None:
    barrier = threading.Barrier(3, timeout=PATIENCE_S)

    def work(_: int) -> set[int]:
        barrier.wait()
        return os.sched_getaffinity(0)

    for _ in range(2):
        with Crew(3) as crew:
            assert crew.map(work, range(3)) == [os.sched_getaffinity(0)] * 3


def test_the_first_failure_is_raised_and_the_helpers_work_again() -> None:
    def fail(item: int) -> None:
        raise ValueError(str(item))

    with Crew(2) as crew:
        with pytest.raises(ValueError, match=r"[01]"):
            crew.map(fail, range(8))
        assert crew.map(str, range(8)) == list("01234567")


def test_a_forked_child_has_helpers_of_its_own() -> None:
    with Crew(2) as crew:
        crew.map(str, range(8))
    child = os.fork()
    if not child:
        barrier = threading.Barrier(2, timeout=PATIENCE_S)

        def meet(_: int) -> None:
            barrier.wait()

        try:
            with Crew(2) as crew:
                crew.map(meet, range(2))
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
"""
    subprocess.run([sys.executable, "-c", code], check=True)
