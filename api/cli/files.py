"""Reading photos and other files under limits, and names to leave out."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from api.cli.errors import CommandError, UsageError
from models.decoding import MAX_BYTES
from models.errors import PhotoRejected
from templates.keys.private_file import read_bounded
from templates.space.agreement import InconsistentImages

MAX_CONTRACT_BYTES = 2**28


def read_photos(paths: Sequence[Path], *, most: int) -> list[bytes]:
    """Read the photos that somebody named, at most so many."""
    if len(paths) > most:
        raise UsageError(f"give 1 to {most} photos, not {len(paths)}")
    try:
        return [read_bounded(path, MAX_BYTES) for path in paths]
    except FileNotFoundError as error:
        raise UsageError(f"no such photo: {error.filename}") from None


@contextmanager
def naming_photo(photos: Sequence[Path]) -> Iterator[None]:
    """Say of what is wrong with a photo which file it is."""
    try:
        yield
    except PhotoRejected as error:
        raise CommandError(f"{photos[error.index].name}: {error.cause}") from None
    except InconsistentImages as error:
        raise CommandError(error.sentence([photo.name for photo in photos])) from None


def read_names(source: Path | None) -> frozenset[str]:
    """Names to leave out: the subfolders of a folder, or the lines of a text file.

    Lines are names of people, or paths of photos relative to the folder that is read; empty lines
    and lines that start with ``#`` say nothing.
    """
    if source is None:
        return frozenset()
    if source.is_dir():
        return frozenset(path.name for path in source.iterdir() if path.is_dir())
    lines = read_bounded(source, 16 * 2**20).decode("utf-8", errors="replace").splitlines()
    return frozenset(line.strip() for line in lines if line.strip() and line[:1] != "#")
