"""Labels of people or photos from a CSV, for results by group and for hybrid+.

The first column is ``path`` or ``file``; every other column is an attribute, such as ``gender``,
``race`` or ``age``. A row labels one photo, by its path relative to the set (with or without its
suffix), or all photos of a person, by the name of the person's folder.
"""

import csv
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from templates.decoys import Attributes
from verify.datasets import SUFFIXES, DatasetError
from verify.fairface_labels import AGES, repaired_age

MAX_BYTES = 64 * 2**20
MAX_GROUPS = 256
"""Different labels of one attribute; a column with more holds names or numbers, not groups."""
# FairFace's mark of the photos of its own service test; it says nothing about a person.
_NO_ATTRIBUTE = "service_test"
_DATE = re.compile(r"\d{1,4}-[A-Za-z]{3}|[A-Za-z]{3}-\d{1,4}")
_MOST_FAULTS = 20


@dataclass(frozen=True, repr=False)
class Labels:
    """What a label file says.

    Parameters
    ----------
    attributes
        Names of the attributes, in the order of the columns.
    of
        By the path or name of a row: its labels by attribute; an empty cell is absent.
    """

    attributes: tuple[str, ...]
    of: Mapping[str, Mapping[str, str]]
    _stems: Mapping[str, Mapping[str, str]] = field(init=False, compare=False)

    def __post_init__(self) -> None:
        found: defaultdict[str, list[Mapping[str, str]]] = defaultdict(list)
        for name, row in self.of.items():
            found[_stem(name)].append(row)
        # Where rows differ in their suffix only, each speaks for its own file alone; a row
        # without suffix speaks for the others.
        alone = {stem: rows[0] for stem, rows in found.items() if len(rows) == 1}
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
        for folder in PurePosixPath(name).parents:
            for key in (str(folder), folder.name):
                if key in self.of:
                    return self.of[key]
        return {}

    def column(self, attribute: str, pictures: Iterable[str]) -> list[str | None]:
        """One attribute of each picture; None where it has no label."""
        return [self.find(picture).get(attribute) for picture in pictures]

    def attributes_of(self, pictures: Iterable[str]) -> list[Attributes]:
        """Gender and race of each picture, as hybrid+ takes them."""
        rows = [self.find(picture) for picture in pictures]
        return [Attributes(gender=row.get("gender"), race=row.get("race")) for row in rows]


def read_labels(file: Path | str) -> Labels:
    """Read a label file. Ages of FairFace that a spreadsheet made dates of are repaired.

    Raises
    ------
    DatasetError
        Listing every fault with its line: no such columns, wrong numbers of cells, a row without
        a path, two rows of one path that differ, an age that is a date of no known meaning.
    """
    path = Path(file)
    lines = _lines(path)
    if not lines:
        raise DatasetError(f"{path.name} is empty; expected the columns path,gender,race …")
    attributes = _attributes(path, lines[0][1])
    faults: list[str] = []
    of: dict[str, dict[str, str]] = {}
    for number, cells in lines[1:]:
        name, row = _row(attributes, cells, number=number, faults=faults)
        if name and of.setdefault(name, row) != row:
            faults.append(f"line {number} labels {name} otherwise than a line before it")
    kept = tuple(name for name in attributes if name != _NO_ATTRIBUTE)
    for attribute in kept:
        count = len({row[attribute] for row in of.values() if attribute in row})
        if count > MAX_GROUPS:
            faults.append(
                f"the column {attribute} has {count} different labels, and {MAX_GROUPS} groups are "
                "the most: remove the column, or put its values into ranges"
            )
    if not of and not faults:
        faults.append("there is no row below the header")
    if faults:
        shown = "; ".join(faults[:_MOST_FAULTS])
        more = f"; and {len(faults) - _MOST_FAULTS} more" if len(faults) > _MOST_FAULTS else ""
        raise DatasetError(f"{path.name} has {len(faults)} fault(s): {shown}{more}")
    return Labels(attributes=kept, of=of)


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and cells of each line that is not blank."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DatasetError(f"{path.name} is larger than {MAX_BYTES} bytes; is it a label file?")
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, strict=True)
            return [
                (reader.line_num, [cell.strip() for cell in cells])
                for cells in reader
                if any(cell.strip() for cell in cells)
            ]
    except FileNotFoundError:
        raise DatasetError(f"the label file {path.name} is not there") from None
    except (OSError, UnicodeDecodeError, csv.Error):
        raise DatasetError(f"{path.name} cannot be read as a CSV file in UTF-8") from None


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


def _row(
    attributes: Sequence[str], cells: Sequence[str], *, number: int, faults: list[str]
) -> tuple[str, dict[str, str]]:
    """Name and labels of a line; the name is empty where the line has a fault."""
    if len(cells) != len(attributes) + 1:
        faults.append(f"line {number} has {len(cells)} cells, and the header {len(attributes) + 1}")
        return "", {}
    name = _normal(cells[0])
    if name in ("", "."):
        faults.append(f"line {number} has no path")
        return "", {}
    row = {
        attribute: cell
        for attribute, cell in zip(attributes, cells[1:], strict=True)
        if cell and attribute != _NO_ATTRIBUTE
    }
    if "age" in row:
        repaired = repaired_age(row["age"])
        if repaired is None and _DATE.fullmatch(row["age"]):
            faults.append(
                f"line {number}: the age is a date that a spreadsheet made of none of "
                f"{', '.join(AGES)}"
            )
            return "", {}
        row["age"] = repaired or row["age"]
    return name, row


def _normal(name: str) -> str:
    return str(PurePosixPath(name.strip().replace("\\", "/")))


def _stem(name: str) -> str:
    """Path without the suffix of a photo; names of people may hold dots."""
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else name
