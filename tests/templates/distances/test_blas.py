"""The limit on the matrix library's threads: one for all callers, whichever threads they are on."""

import subprocess
import sys

SCRIPT = """
import threading
from concurrent.futures import ThreadPoolExecutor
from threadpoolctl import ThreadpoolController
from templates.distances.blas import single_threaded

with single_threaded():  # loads the libraries
    pass
controller = ThreadpoolController().select(user_api="blas")
controller.limit(limits=3)

def counts():
    return {library.num_threads for library in controller.lib_controllers}

assert counts() == {3}, counts()

# The thread that limits last is another one than the first.
with ThreadPoolExecutor(1) as other:
    def limited():
        with single_threaded() as available:
            return available, counts()
    with single_threaded() as available:
        assert (available, counts()) == (3, {1})
    assert other.submit(limited).result() == (3, {1})
    assert counts() == {3}, counts()

    # The thread that came first leaves first.
    first, second = single_threaded(), single_threaded()
    first.__enter__()
    other.submit(second.__enter__).result()
    first.__exit__(None, None, None)
    assert counts() == {1}, counts()
    other.submit(second.__exit__, None, None, None).result()
    assert counts() == {3}, counts()
"""


def test_the_limit_holds_on_every_thread_and_ends_with_its_last_caller() -> None:
    """In a process of its own: the setting is the process's."""
    subprocess.run([sys.executable, "-c", SCRIPT], check=True)
