"""Sets of bona fide and attack presentations: a folder ``live/``, ``spoof/SPECIES/``, or a CSV."""

import csv
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from templates.contract.liveness import SPECIES_NAME
from verify.datasets import SUFFIXES, DatasetError, faults_in
from verify.evaluation.readers.protocol_files import read_text

LIVE = "live"
ATTACKS = "spoof"
REQUIRED = ("path", "presentation")
COLUMNS = (*REQUIRED, "subject")
FOLDER = f"expected {LIVE}/ and {ATTACKS}/SPECIES/ with photos in them"
TABLE = "expected path,presentation[,subject], where presentation is live or names the species"
_NUMBERED = re.compile(r"([0-9]{2,})_")


@dataclass(frozen=True)
class Presentation:
    """One photo of what was held before a camera.

    Parameters
    ----------
    name
        Its path relative to the set.
    species
        Of the attack instrument, such as ``print``; None for a live face.
    subject
        Whose face it shows; None where that is not known.
    """

    path: Path
    name: str
    species: str | None
    subject: str | None


@dataclass(frozen=True)
class PresentationSet:
    """Live and attack photos.

    Parameters
    ----------
    name, kind
        Of the folder or file; ``folder`` or ``csv``.
    presentations
        Live ones first, then by species and name.
    """

    name: str
    kind: str
    presentations: tuple[Presentation, ...]

    @property
    def species(self) -> tuple[str, ...]:
        """Attack species, sorted."""
        return tuple(sorted({one.species for one in self.presentations if one.species}))

    @property
    def subjects(self) -> int | None:
        """Number of people; None where that is not known of every photo."""
        names = {one.subject for one in self.presentations}
        return None if None in names else len(names)


def read_presentations(path: Path, *, attacks: bool) -> PresentationSet:
    """Read a set; the photos are not opened here.

    Where the name of every photo of a folder begins with a number and an underscore, as in NUAA
    (``0001_00_…``), that number is the subject's.

    Raises
    ------
    DatasetError
        Listing every fault.
    """
    try:
        if path.is_dir():
            found = _folder(path)
        elif path.is_file():
            found = _csv(path)
        else:
            raise DatasetError(f"{path} is not there; {FOLDER}, or a CSV: {TABLE}")
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from None
    if not any(one.species is None for one in found):
        raise DatasetError(f"{path} has no live photo, and BPCER is of live photos")
    if attacks and all(one.species is None for one in found):
        raise DatasetError(f"{path} has no attack photo, and APCER is of attack photos")
    ordered = sorted(found, key=lambda one: (one.species or "", one.name))
    kind = "folder" if path.is_dir() else "csv"
    return PresentationSet(path.resolve().stem, kind, tuple(ordered))


def _folder(root: Path) -> list[Presentation]:
    faults: list[str] = []
    species: dict[str | None, Path] = {}
    for entry in _entries(root):
        if entry.name == LIVE and entry.is_dir():
            species[None] = entry
        elif entry.name == ATTACKS and entry.is_dir():
            for folder in _entries(entry):
                if not folder.is_dir():
                    if folder.suffix.lower() in SUFFIXES:
                        faults.append(f"photo {ATTACKS}/{folder.name} lies in no species' folder")
                elif SPECIES_NAME.fullmatch(folder.name) and folder.name != LIVE:
                    species[folder.name] = folder
                else:
                    faults.append(f"{ATTACKS}/{folder.name!a} is no name of a species")
        elif entry.is_dir() or entry.suffix.lower() in SUFFIXES:
            faults.append(f"{entry.name} lies beside {LIVE}/ and {ATTACKS}/")
    photos: list[tuple[str | None, Path]] = []
    for name, folder in species.items():
        inside = [
            photo
            for photo in sorted(folder.rglob("*"))
            if photo.suffix.lower() in SUFFIXES
            and photo.is_file()
            and not any(part.startswith(".") for part in photo.relative_to(root).parts)
        ]
        if not inside:
            faults.append(f"{folder.relative_to(root)} holds no photo")
        photos += [(name, photo) for photo in inside]
    if not species:
        faults.append(f"there is no {LIVE}/ in it")
    if faults:
        raise DatasetError(faults_in(root, FOLDER, faults))
    numbers = [_NUMBERED.match(photo.name) for _, photo in photos]
    numbered = all(numbers)
    return [
        Presentation(
            photo,
            photo.relative_to(root).as_posix(),
            name,
            number[1] if number is not None and numbered else None,
        )
        for (name, photo), number in zip(photos, numbers, strict=True)
    ]


def _entries(folder: Path) -> list[Path]:
    return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))


def _csv(file: Path) -> list[Presentation]:
    text = read_text(file, root=file.parent).text
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    faults: list[str] = []
    found: list[Presentation] = []
    try:
        header = [cell.strip().lower() for cell in next(reader, [])]
        faults += [f"line 1 has no column {name}" for name in REQUIRED if name not in header]
        faults += [
            f"line 1 has the unknown column {name!a}" for name in header if name not in COLUMNS
        ]
        if len(set(header)) < len(header):
            faults.append("line 1 names a column twice")
        for cells in reader if not faults else ():
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                faults.append(f"line {reader.line_num} has {len(cells)} cells, not {len(header)}")
                continue
            row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
            wrong = _faults_of(file, row)
            if wrong:
                faults.append(f"line {reader.line_num} {' and '.join(wrong)}")
                continue
            kind = row["presentation"]
            found.append(
                Presentation(
                    file.parent / row["path"],
                    row["path"],
                    None if kind == LIVE else kind,
                    row.get("subject") or None,
                )
            )
    except csv.Error as error:
        faults.append(f"line {reader.line_num} is not CSV ({error})")
    twice = [name for name, count in Counter(one.name for one in found).items() if count > 1]
    faults += [f"{name} is named twice" for name in twice]
    if faults:
        raise DatasetError(faults_in(file, TABLE, faults))
    return found


def _faults_of(file: Path, row: dict[str, str]) -> list[str]:
    wrong = []
    if not row["path"] or not row["path"].isprintable():
        wrong.append("has no path")
    elif not (file.parent / row["path"]).is_file():
        wrong.append(f"names {row['path']}, which is not there")
    if not SPECIES_NAME.fullmatch(row["presentation"]):
        wrong.append("has neither live nor a species in presentation")
    if not row.get("subject", "").isprintable():
        wrong.append("has a subject that cannot be printed")
    return wrong
