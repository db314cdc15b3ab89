"""FairFace's label files, also as spreadsheets have left them.

Columns are ``file,age,gender,race,service_test``; ``file`` is a path relative to the folder of the
label file. Spreadsheets turn the ages 3-9 and 10-19 into dates; those are repaired here.
"""

from pathlib import Path

from verify.datasets import DatasetError, csv_rows, decoded, read_whole

AGES = ("0-2", "3-9", "10-19", "20-29", "30-39", "40-49", "50-59", "60-69", "more than 70")
GENDERS = ("Male", "Female")
RACES = (
    *("East Asian", "Southeast Asian", "Middle Eastern", "Latino_Hispanic"),
    *("Black", "White", "Indian"),
)
CLASSES = {"gender": GENDERS, "race": RACES, "age": AGES}
_MAX_BYTES = 64 * 2**20
# 3-9 read as a date is 3 September or 9 March; 10-19 is 19 October or October (20)19.
_DATES = {
    **dict.fromkeys(("03-sep", "3-sep", "sep-03", "sep-3"), "3-9"),
    **dict.fromkeys(("09-mar", "9-mar", "mar-09", "mar-9"), "3-9"),
    **dict.fromkeys(("19-oct", "oct-19"), "10-19"),
}


def repaired_age(text: str) -> str | None:
    """Return the age range that a cell means; None for one that means none.

    Examples
    --------
    >>> repaired_age("03-Sep"), repaired_age("Oct-19"), repaired_age("20-29")
    ('3-9', '10-19', '20-29')
    """
    plain = text.strip()
    return plain if plain in AGES else _DATES.get(plain.lower())


def label_files(source: Path) -> list[Path]:
    """Label files of a photo folder: inside it, or beside it."""
    return [
        *sorted(source.glob("fairface_label_*.csv")),
        *sorted(source.resolve().parent.glob("fairface_label_*.csv")),
    ]


def read_labels(file: Path) -> dict[Path, dict[str, str]]:
    """Read a label file: by the resolved path of a photo, its age, gender and race."""
    folder = file.resolve().parent
    text = decoded(read_whole(file, most=_MAX_BYTES), file=file)
    labels = {}
    for where, row in csv_rows(file, text, required=("file", *CLASSES)):
        if not row["file"] or not row["file"].isprintable():
            raise DatasetError(f"{where}: the name of the file is empty or not printable")
        row["age"] = repaired_age(row["age"]) or row["age"]
        for name, known in CLASSES.items():
            if row[name] not in known:
                raise DatasetError(f"{where}: the {name} is none of {', '.join(known)}")
        labels[(folder / row["file"]).resolve()] = {name: row[name] for name in CLASSES}
    return labels
