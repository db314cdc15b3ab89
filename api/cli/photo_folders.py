"""Folders of photos that bulk commands are given; what is not read of them is named."""

import csv
import unicodedata
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from api.cli.console import message
from api.cli.errors import CommandError, UsageError
from verify import LabelledFolder, labelled_folder
from verify.datasets import SUFFIXES, distinct_files, is_named, is_photo, photos_alone, visible

_ENDINGS = ", ".join(sorted(SUFFIXES))


def find_photos(folder: Path) -> list[Path]:
    """All photos below a folder, in the order of their paths; copies of a file count once.

    What else lies there is named to the person.
    """
    if not folder.is_dir():
        raise CommandError(f"{folder} is not a folder")
    files = sorted(_files_below(folder))
    photos = [file for file in files if is_photo(file)]
    if not photos:
        raise CommandError(f"{folder} has no file in {_ENDINGS}, at any depth")
    distinct = distinct_files(photos)
    others = [str(file.relative_to(folder)) for file in files if not is_photo(file)]
    _note_unread(folder, others, copies=len(photos) - len(distinct))
    return distinct


def photos_of(folders: Sequence[Path], names: Collection[str]) -> tuple[list[Path], int]:
    """Photos of folders without those of the names, each once; and how many were left out."""
    folder_of = {photo: folder for folder in folders for photo in find_photos(folder)}
    kept = [photo for photo, folder in folder_of.items() if not is_named(photo, folder, names)]
    return kept, len(folder_of) - len(kept)


def labelled_people(folder: Path) -> LabelledFolder:
    """Read ``folder/Person/photo.jpg``; copies of one person's photo count once.

    What is left out is named to the person.
    """
    labelled = labelled_folder(folder)
    distinct = {name: distinct_files(album) for name, album in labelled.albums.items()}
    copies = len(labelled) - sum(map(len, distinct.values()))
    _note_unread(folder, labelled.ignored, copies=copies)
    return labelled.with_albums(distinct)


def people_or_faces(folder: Path) -> LabelledFolder:
    """:func:`labelled_people`; or, of a folder without subfolders, each photo as a person."""
    if not folder.is_dir() or any(entry.is_dir() for entry in visible(folder)):
        return labelled_people(folder)
    return photos_alone(folder, find_photos(folder))


def albums_of(source: Path) -> tuple[dict[str, list[Path]], dict[str, str]]:
    """Photos by subject id, and why others cannot be enrolled.

    Of ``source/Person/photo.jpg``, or of a CSV file with the columns ``subject`` and ``photo``, a
    path relative to the file. Names that are spellings of one id are one person.
    """
    # Imported here: most commands that read folders open no store, which takes seconds to load.
    from templates.store.identifiers import InvalidIdentifier, checked_subject_id

    if source.is_dir():
        albums = labelled_people(source).albums
        photos = [(name, photo) for name, album in albums.items() for photo in album]
    else:
        photos = _listed_photos(source)
    albums = {}
    left_out: dict[str, str] = {}
    for name, photo in photos:
        try:
            albums.setdefault(checked_subject_id(name), []).append(photo)
        except InvalidIdentifier as error:
            left_out[name] = str(error)
    for entry in visible(source) if source.is_dir() else ():
        if entry.is_dir() and unicodedata.normalize("NFC", entry.name) not in albums:
            left_out.setdefault(entry.name, f"no photo that is read: photos end in {_ENDINGS}")
    return albums, left_out


def _listed_photos(file: Path) -> list[tuple[str, Path]]:
    """Read the people and photos of a CSV file."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{file} is neither a folder nor a CSV file: {error}") from None
    if not rows or not all(row.get("subject") and row.get("photo") for row in rows):
        raise UsageError(f"{file} needs the columns subject,photo, and both on every line")
    return [(row["subject"], file.parent / row["photo"]) for row in rows]


def _files_below(folder: Path) -> Iterator[Path]:
    for entry in visible(folder):
        if entry.is_dir():
            yield from _files_below(entry)
        else:
            yield entry


def _note_unread(folder: Path, others: Sequence[str], *, copies: int) -> None:
    if others:
        message(f"note: not read in {folder}: {len(others):,} files, as {others[0]}")
    if copies:
        message(f"note: copies of another photo in {folder} do not count: {copies:,}")
