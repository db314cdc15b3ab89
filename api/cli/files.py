"""Reading files under limits, and names to leave out."""

from pathlib import Path

from api.cli.errors import CommandError, UsageError
from models.decoding import MAX_BYTES
from templates.keys.private_file import read_at_most

MAX_CONTRACT_BYTES = 2**28


def read_bounded(path: Path, most: int) -> bytes:
    """Read a file that has at most ``most`` bytes."""
    with path.open("rb") as file:
        data = read_at_most(file, most)
    if len(data) > most:
        raise CommandError(f"{path} has more than {most} bytes; is it the right file?")
    return data


def read_photo(path: Path) -> bytes:
    """Read a photo that somebody named."""
    try:
        return read_bounded(path, MAX_BYTES)
    except FileNotFoundError:
        raise UsageError(f"no such photo: {path}") from None


def read_names(source: Path) -> frozenset[str]:
    """Names to leave out: the subfolders of a folder, or the lines of a text file.

    Lines are names of people, or paths of photos relative to the folder that is read; empty lines
    and lines that start with ``#`` say nothing.
    """
    if source.is_dir():
        return frozenset(path.name for path in source.iterdir() if path.is_dir())
    lines = read_bounded(source, 16 * 2**20).decode("utf-8", errors="replace").splitlines()
    return frozenset(line.strip() for line in lines if line.strip() and line[:1] != "#")


def is_left_out(photo: Path, folder: Path, names: frozenset[str]) -> bool:
    """Whether a photo of the folder belongs to a name that is left out."""
    relative = photo.relative_to(folder)
    return relative.as_posix() in names or any(part in names for part in relative.parts[:-1])
