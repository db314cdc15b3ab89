"""Labels of people or photos from a CSV, for results by group and for hybrid+.

The first column is ``path`` or ``file``; every other column is an attribute, such as ``gender``,
``race`` or ``age``. A row labels one photo, by its path relative to the set (with or without its
suffix), or all photos of a person, by the name of the person's folder.
"""

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from verify.datasets import SUFFIXES, DatasetError, csv_rows, decoded, read_whole
from verify.fairface_labels import repaired_age

MAX_BYTES = 16 * 2**20
MAX_GROUPS = 256
"""Different labels of one attribute; a column with more holds names or numbers, not groups."""
YEARS = (0, 2, 5, 8, 11, 14, 18, 30, 45, 60)
"""First year of each group of ages; below ten years a few years make much of a difference."""
# FairFace's mark of the photos of its own service test; it says nothing about a person.
_NO_ATTRIBUTE = "service_test"


@dataclass(frozen=True, repr=False)
class Labels:
    """What a label file says."""

    attributes: tuple[str, ...]
    # By the path or name of a row, and by that without suffix; an empty cell is absent.
    of: Mapping[str, Mapping[str, str]]

    def find(self, picture: str) -> Mapping[str, str]:
        """Labels of a picture by its name in the set; empty where no row speaks of it.

        The row of the whole path is taken first, then that of the path without suffix, then that
        of the nearest folder.
        """
        name = _normal(picture)
        for key in (name, _stem(name)):
            if key in self.of:
                return self.of[key]
        folder = name.rpartition("/")[0]
        while folder:
            above, _, alone = folder.rpartition("/")
            for key in (folder, alone):
                if key in self.of:
                    return self.of[key]
            folder = above
        return {}

    def column(self, attribute: str, pictures: Iterable[str]) -> list[str | None]:
        """One attribute of each picture; None where it has no label."""
        return [self.find(picture).get(attribute) for picture in pictures]


def read_labels(file: Path | str) -> Labels:
    """Read a label file.

    Ages in years are put into groups (`age_group`). Those of FairFace that a spreadsheet made dates
    of are repaired.
    """
    path = Path(file)
    rows = csv_rows(path, decoded(read_whole(path, most=MAX_BYTES), file=path), required=())
    if not rows:
        raise DatasetError(f"{path} has no row below the header")
    key, *columns = rows[0][1]
    attributes = tuple(name for name in columns if name != _NO_ATTRIBUTE)
    if key not in ("path", "file") or not attributes:
        raise DatasetError(
            f"{path}: the first column is path or file, and one attribute at least follows, such "
            "as gender"
        )
    of: dict[str, dict[str, str]] = {}
    for where, row in rows:
        name = _normal(row[key])
        if not name:
            raise DatasetError(f"{where} has no path")
        labels = {attribute: row[attribute] for attribute in attributes if row[attribute]}
        if "age" in labels:
            labels["age"] = _age(labels["age"])
        if of.setdefault(name, labels) != labels:
            raise DatasetError(f"{where} labels {name} otherwise than a line before it")
    for attribute in attributes:
        if len({labels.get(attribute) for labels in of.values()} - {None}) > MAX_GROUPS:
            raise DatasetError(
                f"{path}: the column {attribute} has more than {MAX_GROUPS} different labels, which"
                " are names or numbers and no groups: remove the column, or put its values into"
                " ranges"
            )
    return Labels(attributes, {**{_stem(name): labels for name, labels in of.items()}, **of})


def _age(cell: str) -> str:
    is_years = len(cell) <= 3 and cell.isdecimal()
    return repaired_age(cell) or (age_group(int(cell)) if is_years else cell)


def age_group(years: int) -> str:
    """Return the group of an age: ``2-4``, ``60 and more``."""
    place = bisect_right(YEARS, years)
    if place == len(YEARS):
        return f"{YEARS[-1]} and more"
    return f"{YEARS[place - 1]}-{YEARS[place] - 1}"


def _normal(name: str) -> str:
    """Path with single slashes, without ``.``; empty where nothing is left."""
    path = name.strip().replace("\\", "/")
    plain = "/".join([part for part in path.split("/") if part not in ("", ".")])
    return f"/{plain}" if plain and path[0] == "/" else plain


def _stem(name: str) -> str:
    """Path without the suffix of a photo; names of people may hold dots."""
    stem, dot, suffix = name.rpartition(".")
    is_photo = stem and stem[-1] != "/" and f"{dot}{suffix.lower()}" in SUFFIXES
    return stem if is_photo else name
