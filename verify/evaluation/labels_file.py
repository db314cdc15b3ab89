"""Labels of people or photos from a CSV, for results by group and for hybrid+.

The first column is ``path`` or ``file``; every other column is an attribute, such as ``gender``,
``race`` or ``age``. A row labels one photo, by its path relative to the set (with or without its
suffix), or all photos of a person, by the name of the person's folder.
"""

import csv
import re
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from verify.datasets import SUFFIXES, DatasetError, faults_in
from verify.fairface_labels import AGES, repaired_age

if TYPE_CHECKING:
    import _csv

MAX_BYTES = 16 * 2**20
MAX_GROUPS = 256
"""Different labels of one attribute; a column with more holds names or numbers, not groups."""
YEARS = (0, 2, 5, 8, 11, 14, 18, 30, 45, 60)
"""First year of each group of ages; below ten years a few years make much of a difference."""
# FairFace's mark of the photos of its own service test; it says nothing about a person.
_NO_ATTRIBUTE = "service_test"
# A month, as spreadsheets write it in English or German, or two equal separators between numbers.
_DATE = re.compile(
    r"(?<![a-zäöü])(jan|feb|mar|mrz|mär|apr|may|mai|jun|jul|aug|sep|oct|okt|nov|dec|dez)"
    r"(uary|uar|ruary|ruar|ch|z|il|e|i|y|ust|t|tember|ober|ember)?(?![a-zäöü])"
    r"|\d\s*([-/.])\s*\d+\s*\3\s*\d",
    re.IGNORECASE,
)


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
        by_stem: defaultdict[str, list[Mapping[str, str]]] = defaultdict(list)
        for name, row in self.of.items():
            by_stem[_stem(name)].append(row)
        # Where rows differ in their suffix only, each speaks for its own file alone; a row
        # without suffix speaks for the others.
        alone = {stem: rows[0] for stem, rows in by_stem.items() if len(rows) == 1}
        plain = {name: row for name, row in self.of.items() if _stem(name) == name}
        object.__setattr__(self, "_stems", alone | plain)

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
        Listing every fault with its line: no such columns, wrong numbers of cells, a row without
        a path, two rows of one path that differ, an attribute with too many labels, an age that
        is none of FairFace's beside others that are, or that is a date.
    """
    path = Path(file)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DatasetError(f"{path.name} is larger than {MAX_BYTES} bytes; is it a label file?")
        with path.open(encoding="utf-8-sig", newline="") as stream:
            return _read(path, csv.reader(stream, strict=True))
    except FileNotFoundError:
        raise DatasetError(f"the label file {path.name} is not there") from None
    except (OSError, UnicodeDecodeError, csv.Error):
        raise DatasetError(f"{path.name} cannot be read as a CSV file in UTF-8") from None


def _read(path: Path, reader: "_csv.Reader") -> Labels:
    lines = (
        (reader.line_num, cells)
        for cells in ([cell.strip() for cell in line] for line in reader)
        if any(cells)
    )
    header = next(lines, None)
    if header is None:
        raise DatasetError(f"{path.name} is empty; expected the columns path,gender,race …")
    attributes = _attributes(path, header[1])
    kept = tuple(name for name in attributes if name != _NO_ATTRIBUTE)
    groups: dict[str, dict[str, int]] = {attribute: {} for attribute in kept}
    made: dict[tuple[str, ...], dict[str, str]] = {}
    of: dict[str, dict[str, str]] = {}
    faults: list[str] = []
    for number, cells in lines:
        if len(cells) != len(attributes) + 1:
            faults.append(
                f"line {number} has {len(cells)} cells, and the header {len(attributes) + 1}"
            )
            continue
        name = _normal(cells[0])
        if not name:
            faults.append(f"line {number} has no path")
            continue
        key = tuple(cells[1:])
        if key not in made:
            # Rows of the same labels share them: there are far fewer of these than rows.
            made[key] = _labels(attributes, key)
            for attribute, label in made[key].items():
                groups[attribute].setdefault(label, number)
            if crowded := [name for name in kept if len(groups[name]) > MAX_GROUPS]:
                faults.append(
                    f"the column {crowded[0]} has more than {MAX_GROUPS} different labels, which "
                    "are names or numbers and no groups: remove the column, or put its values "
                    "into ranges"
                )
                break
        if of.setdefault(name, made[key]) != made[key]:
            faults.append(f"line {number} labels {name} otherwise than a line before it")
    faults += _faults_of_ages(groups.get("age", {}))
    if not of and not faults:
        faults.append("there is no row below the header")
    if faults:
        raise DatasetError(faults_in(Path(path.name), "expected labels as in its header", faults))
    return Labels(attributes=kept, of=of)


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


def _faults_of_ages(ages: Mapping[str, int]) -> list[str]:
    """Name what is wrong with the ages, given the line on which each comes first."""
    if not ages.keys().isdisjoint(AGES):
        return [
            f"line {number}: the age is none of {', '.join(AGES)}, which others are, and no date "
            "that a spreadsheet makes of one"
            for age, number in ages.items()
            if age not in AGES
        ]
    return [
        f"line {number}: the age is a date; write it as a range, such as 3-9, in a column of text"
        for age, number in ages.items()
        if _DATE.search(age)
    ]


def _attributes(path: Path, header: Sequence[str]) -> list[str]:
    names = [name.lower() for name in header]
    if names[0] not in ("path", "file"):
        raise DatasetError(
            f"the first column of {path.name} is not path or file; expected a header such as "
            "path,gender,race,age"
        )
    attributes = names[1:]
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
