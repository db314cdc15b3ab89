"""Threads of the service share the arenas of the C library."""

import platform
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE_S

COUNT = """
import ctypes, sys, threading
from api.service.allocator import keep_few_arenas

assert keep_few_arenas(1)
everybody = threading.Barrier(8)

def work():
    held = [bytearray(1000) for _ in range(1000)]
    everybody.wait()

threads = [threading.Thread(target=work) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p
file = ctypes.c_void_p(libc.fopen(sys.argv[1].encode(), b"w"))
assert libc.malloc_info(0, file) == 0
libc.fclose(file)
print(open(sys.argv[1]).read().count("<heap nr="))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has no arenas")
def test_threads_share_two_arenas(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", COUNT, str(tmp_path / "arenas")],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        cwd=Path(__file__).resolve().parents[3],
        check=True,
    )
    assert int(done.stdout) <= 2
