"""Folders of photos that bulk commands are given; what is not read of them is named."""

import csv
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from api.cli.console import message
from api.cli.errors import CommandError, UsageError
from verify import LabelledFolder, labelled_folder
from verify.datasets import SUFFIXES, distinct_files, is_photo, photos_alone, visible

COLUMNS = ("subject", "photo")
_MOST_NAMED = 5
_ENDINGS = ", ".join(sorted(SUFFIXES))


def find_photos(folder: Path) -> list[Path]:
    """All photos below a folder, in the order of their paths; copies of a file count once.

    What else lies there is named to the person.

    Raises
    ------
    CommandError
        It is no folder, or has no photo.
    """
    if not folder.is_dir():
        raise CommandError(f"{folder} is not a folder")
    files = sorted(_files_below(folder))
    photos = [file for file in files if is_photo(file)]
    if not photos:
        raise CommandError(f"{folder} has no file in {_ENDINGS}, at any depth")
    others = [str(file.relative_to(folder)) for file in files if not is_photo(file)]
    _tell_others(folder, others)
    distinct = distinct_files(photos)
    _tell_copies(folder, len(photos) - len(distinct))
    return distinct


def labelled_people(folder: Path) -> LabelledFolder:
    """Read ``folder/Person/photo.jpg``; copies of one person's photo count once.

    What is left out is named to the person.

    Raises
    ------
    DatasetError
        As of `verify.labelled_folder`.
    """
    labelled = labelled_folder(folder)
    albums: dict[str, list[Path]] = {}
    for path, name in zip(labelled.paths, labelled.identities, strict=True):
        albums.setdefault(name, []).append(path)
    kept = [(path, name) for name, album in albums.items() for path in distinct_files(album)]
    _tell_others(folder, labelled.ignored)
    _tell_copies(folder, len(labelled) - len(kept))
    paths, identities = zip(*kept, strict=True)
    return replace(labelled, paths=paths, identities=identities)


@dataclass(frozen=True)
class Albums:
    """Photos of people.

    Parameters
    ----------
    photos
        By subject id. Names that are spellings of one id are one person.
    left_out
        Why nobody can be enrolled, by a name that breaks the rule or has no photo.
    """

    photos: Mapping[str, Sequence[Path]]
    left_out: Mapping[str, str]


def albums_of(source: Path) -> Albums:
    """Photos by person, of ``source/Person/photo.jpg`` or of a CSV file with a photo on each line.

    The file has the columns ``subject`` and ``photo``, a path relative to the file.

    Raises
    ------
    UsageError
        The file lacks a column, or a line a value.
    DatasetError
        As of `verify.labelled_folder`.
    """
    # Imported here: most commands that read folders open no store, which takes seconds to load.
    from templates.store.identifiers import InvalidIdentifier, checked_subject_id

    albums: dict[str, list[Path]] = {}
    left_out: dict[str, str] = {}
    folders = [entry.name for entry in visible(source) if entry.is_dir()] if source.is_dir() else []
    for name, photo in _named_photos(source):
        try:
            albums.setdefault(checked_subject_id(name), []).append(photo)
        except InvalidIdentifier as error:
            left_out[name] = str(error)
    for name in folders:
        if unicodedata.normalize("NFC", name) not in albums:
            left_out.setdefault(name, f"no photo that is read: photos end in {_ENDINGS}")
    return Albums(albums, left_out)


def _named_photos(source: Path) -> Iterator[tuple[str, Path]]:
    """Yield each photo with the name that stands beside it."""
    if source.is_dir():
        labelled = labelled_people(source)
        yield from zip(labelled.identities, labelled.paths, strict=True)
        return
    empty = True
    try:
        with source.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            if not set(COLUMNS) <= set(rows.fieldnames or ()):
                raise UsageError(f"{source} needs a first line with the columns subject,photo")
            for row in rows:
                subject, photo = (row[name] for name in COLUMNS)
                if not subject or not photo:
                    raise UsageError(f"{source}, line {rows.line_num}: a subject and a photo")
                empty = False
                yield subject, source.parent / photo
    except FileNotFoundError:
        raise UsageError(f"{source} is neither a folder nor a CSV file") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{source} cannot be read as CSV: {error}") from None
    if empty:
        raise UsageError(f"{source} names nobody")


def people_or_faces(folder: Path) -> LabelledFolder:
    """:func:`labelled_people`; or, of a folder without subfolders, each photo as a person."""
    if not folder.is_dir() or any(entry.is_dir() for entry in visible(folder)):
        return labelled_people(folder)
    return photos_alone(folder, find_photos(folder))


def _files_below(folder: Path) -> Iterator[Path]:
    for entry in visible(folder):
        if entry.is_dir():
            yield from _files_below(entry)
        else:
            yield entry


def _tell_others(folder: Path, others: Sequence[str]) -> None:
    if others:
        more = ", …" if len(others) > _MOST_NAMED else ""
        message(
            f"note: not read in {folder}: {', '.join(others[:_MOST_NAMED])}{more} ({len(others):,} "
            f"in all; photos end in {_ENDINGS})"
        )


def _tell_copies(folder: Path, copies: int) -> None:
    if copies:
        message(f"note: copies of another photo in {folder} do not count: {copies:,}")
