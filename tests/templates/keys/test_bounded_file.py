import os
import threading
from pathlib import Path
from typing import BinaryIO

import pytest

from templates.keys.private_file import read_at_most


class Noting:
    """A file that notes how many bytes it was asked for at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.asked: list[int] = []

    def read(self, size: int) -> bytes:
        self.asked.append(size)
        return self._file.read(size)

    def fileno(self) -> int:
        return self._file.fileno()


@pytest.mark.parametrize("size", [0, 1, 3 * 2**20 + 5])
def test_a_small_file_costs_little_under_a_large_limit(tmp_path: Path, size: int) -> None:
    content = os.urandom(size)
    (tmp_path / "file").write_bytes(content)
    with (tmp_path / "file").open("rb") as file:
        noting = Noting(file)
        assert read_at_most(noting, 2**40) == content  # type: ignore[arg-type]
    assert max(noting.asked) <= max(size + 1, 2**20)


@pytest.mark.parametrize(("size", "most"), [(10, 10), (11, 10), (5 * 2**20, 2**20), (5, 0)])
def test_one_byte_more_than_the_limit_tells_of_a_larger_file(
    tmp_path: Path, size: int, most: int
) -> None:
    content = os.urandom(size)
    (tmp_path / "file").write_bytes(content)
    with (tmp_path / "file").open("rb") as file:
        assert read_at_most(file, most) == content[: most + 1]


@pytest.mark.parametrize(("size", "most"), [(3 * 2**20, 2**30), (3 * 2**20, 2**20), (0, 5)])
def test_a_pipe_which_has_no_size_is_read_as_well(size: int, most: int) -> None:
    content = os.urandom(size)
    reading, writing = os.pipe()

    def write() -> None:
        with os.fdopen(writing, "wb") as file:
            try:
                file.write(content)
                file.flush()
            except BrokenPipeError:
                pass

    thread = threading.Thread(target=write)
    thread.start()
    with os.fdopen(reading, "rb") as file:
        assert read_at_most(file, most) == content[: most + 1]
    thread.join()
