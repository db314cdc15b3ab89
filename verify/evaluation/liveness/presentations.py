"""Sets of bona fide and attack presentations: a folder ``live/``, ``spoof/SPECIES/``, or a CSV."""

import re
from dataclasses import dataclass
from pathlib import Path

from templates.contract.liveness import SPECIES_NAME
from verify.datasets import DatasetError, csv_rows, is_photo, visible
from verify.evaluation.readers.reader import read_text

LIVE = "live"
ATTACKS = "spoof"
REQUIRED = ("path", "presentation")
FOLDER = f"expected {LIVE}/ and {ATTACKS}/SPECIES/ with photos in them"
TABLE = "expected path,presentation[,subject], where presentation is live or names the species"
_NUMBERED = re.compile(r"([0-9]{2,})_")


@dataclass(frozen=True)
class Presentation:
    """One photo of what was held before a camera."""

    path: Path
    name: str  # path relative to the set
    species: str | None  # of the attack instrument, such as print; None for a live face
    subject: str | None  # None where that is not known


@dataclass(frozen=True)
class PresentationSet:
    """Live and attack photos."""

    name: str
    presentations: tuple[Presentation, ...]  # live ones first, then by species and name

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
    """
    try:
        if path.is_dir():
            presentations = _folder(path)
        elif path.is_file():
            presentations = _csv(path)
        else:
            raise DatasetError(f"{path} is not there; {FOLDER}, or a CSV: {TABLE}")
    except OSError as error:
        raise DatasetError(f"{path} cannot be read: {error.strerror}") from None
    if not any(one.species is None for one in presentations):
        raise DatasetError(f"{path} has no live photo, and BPCER is of live photos")
    if attacks and all(one.species is None for one in presentations):
        raise DatasetError(f"{path} has no attack photo, and APCER is of attack photos")
    ordered = sorted(presentations, key=lambda one: (one.species or "", one.name))
    return PresentationSet(path.resolve().stem, tuple(ordered))


def _folder(root: Path) -> list[Presentation]:
    folders: dict[str | None, Path] = {None: root / LIVE}
    attacks = root / ATTACKS
    for folder in visible(attacks) if attacks.is_dir() else ():
        if not SPECIES_NAME.fullmatch(folder.name) or folder.name == LIVE or is_photo(folder):
            raise DatasetError(
                f"{root}: {ATTACKS}/{folder.name!a} is no name of a species; {FOLDER}"
            )
        if folder.is_dir():
            folders[folder.name] = folder
    for entry in visible(root):
        if entry.name not in (LIVE, ATTACKS) and (entry.is_dir() or is_photo(entry)):
            raise DatasetError(f"{root}: {entry.name} lies beside {LIVE}/ and {ATTACKS}/; {FOLDER}")
    photos: list[tuple[str | None, Path]] = []
    for species, folder in folders.items():
        inside = [photo for photo in sorted(folder.rglob("[!.]*")) if is_photo(photo)]
        if not inside:
            raise DatasetError(f"{root}: {folder.relative_to(root)} holds no photo; {FOLDER}")
        photos += [(species, photo) for photo in inside]
    numbers = [_NUMBERED.match(photo.name) for _, photo in photos]
    numbered = all(numbers)
    return [
        Presentation(
            photo,
            photo.relative_to(root).as_posix(),
            species,
            number[1] if number is not None and numbered else None,
        )
        for (species, photo), number in zip(photos, numbers, strict=True)
    ]


def _csv(file: Path) -> list[Presentation]:
    text = read_text(file, root=file.parent).text
    presentations: dict[str, Presentation] = {}
    for where, row in csv_rows(file, text, required=REQUIRED, optional=("subject",)):
        if fault := _fault_of(file, row):
            raise DatasetError(f"{where} {fault}")
        name, kind = row["path"], row["presentation"]
        if name in presentations:
            raise DatasetError(f"{where}: {name} is named twice")
        species, subject = None if kind == LIVE else kind, row.get("subject") or None
        presentations[name] = Presentation(file.parent / name, name, species, subject)
    return list(presentations.values())


def _fault_of(file: Path, row: dict[str, str]) -> str | None:
    if not row["path"] or not row["path"].isprintable():
        return "has no path"
    if not (file.parent / row["path"]).is_file():
        return f"names {row['path']}, which is not there"
    if not SPECIES_NAME.fullmatch(row["presentation"]):
        return "has neither live nor a species in presentation"
    printable = row.get("subject", "").isprintable()
    return None if printable else "has a subject that cannot be printed"
