"""Labels of people or photos from a CSV, for results by group and for hybrid+.

The first column is ``path`` or ``file``; every other column is an attribute, such as ``gender``,
``race`` or ``age``. A row labels one photo, by its path relative to the set (with or without its
suffix), or all photos of a person, by the name of the person's folder.
"""

import csv
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from verify.datasets import SUFFIXES, DatasetError, decoded, read_whole
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
    """What a label file says.

    Parameters
    ----------
    of
        By the path or name of a row: its labels by attribute; an empty cell is absent.
    """

    attributes: tuple[str, ...]
    of: Mapping[str, Mapping[str, str]]
    _stems: Mapping[str, Mapping[str, str]] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        names: dict[str, list[str]] = {}
        for name in self.of:
            names.setdefault(_stem(name), []).append(name)
        # Where rows differ in their suffix only, each speaks for its own file alone; a row
        # without suffix speaks for the others.
        speakers = {
            stem: own[0] if len(own) == 1 else stem
            for stem, own in names.items()
            if len(own) == 1 or stem in own
        }
        object.__setattr__(self, "_stems", {stem: self.of[name] for stem, name in speakers.items()})

    def __repr__(self) -> str:
        return f"Labels({len(self.of)} rows of {', '.join(self.attributes)})"

    def find(self, picture: str) -> Mapping[str, str]:
        """Labels of a picture by its name in the set; empty where no row speaks of it.

        The row of the whole path is taken first, then that of the path without suffix, then that
        of the nearest folder.
        """
        name = _normal(picture)
        if name in self.of:
            return self.of[name]
        if _stem(name) in self._stems:
            return self._stems[_stem(name)]
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

    Raises
    ------
    DatasetError
        Naming the first fault with its line: no such columns, wrong numbers of cells, a row without
        a path, two rows of one path that differ, an attribute with too many labels.
    """
    path = Path(file)
    text = decoded(read_whole(path, most=MAX_BYTES), file=path)
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    try:
        attributes = _attributes(path, [cell.strip().lower() for cell in next(reader, [])])
        of: dict[str, dict[str, str]] = {}
        groups: dict[str, set[str]] = {attribute: set() for attribute in attributes}
        for line in reader:
            cells = [cell.strip() for cell in line]
            if not any(cells):
                continue
            where = f"{path.name}: line {reader.line_num}"
            if len(cells) != len(attributes) + 1:
                header = len(attributes) + 1
                raise DatasetError(f"{where} has {len(cells)} cells, and the header {header}")
            name, labels = _normal(cells[0]), _labels(attributes, cells[1:])
            if not name:
                raise DatasetError(f"{where} has no path")
            if of.setdefault(name, labels) != labels:
                raise DatasetError(f"{where} labels {name} otherwise than a line before it")
            for attribute, label in labels.items():
                groups[attribute].add(label)
                if len(groups[attribute]) > MAX_GROUPS:
                    raise DatasetError(
                        f"{path.name}: the column {attribute} has more than {MAX_GROUPS} different "
                        "labels, which are names or numbers and no groups: remove the column, or "
                        "put its values into ranges"
                    )
    except csv.Error as error:
        raise DatasetError(f"{path.name} cannot be read as a CSV file ({error})") from None
    if not of:
        raise DatasetError(f"{path.name} has no row below the header")
    return Labels(tuple(name for name in attributes if name != _NO_ATTRIBUTE), of)


def _labels(attributes: Sequence[str], cells: Sequence[str]) -> dict[str, str]:
    labels = {
        attribute: cell
        for attribute, cell in zip(attributes, cells, strict=True)
        if cell and attribute != _NO_ATTRIBUTE
    }
    if "age" in labels:
        age = labels["age"]
        is_years = len(age) <= 3 and age.isdecimal()
        labels["age"] = repaired_age(age) or (age_group(int(age)) if is_years else age)
    return labels


def age_group(years: int) -> str:
    """Return the group of an age: ``2-4``, ``60 and more``."""
    place = bisect_right(YEARS, years)
    if place == len(YEARS):
        return f"{YEARS[-1]} and more"
    return f"{YEARS[place - 1]}-{YEARS[place] - 1}"


def _attributes(path: Path, header: Sequence[str]) -> list[str]:
    if not header or header[0] not in ("path", "file"):
        raise DatasetError(
            f"the first column of {path.name} is not path or file; expected a header such as "
            "path,gender,race,age"
        )
    attributes = list(header[1:])
    if not set(attributes) - {_NO_ATTRIBUTE} or "" in attributes:
        raise DatasetError(
            f"{path.name} needs a name for each column, and one attribute at least beside the "
            "path, such as gender"
        )
    if len(set(attributes)) != len(attributes):
        raise DatasetError(f"{path.name} has two columns of the same name")
    return attributes


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
