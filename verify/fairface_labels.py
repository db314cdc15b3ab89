"""The labels that FairFace knows, and its ages as spreadsheets have left them."""

AGES = (
    "0-2",
    "3-9",
    "10-19",
    "20-29",
    "30-39",
    "40-49",
    "50-59",
    "60-69",
    "more than 70",
)
GENDERS = ("Male", "Female")
RACES = (
    "East Asian",
    "Southeast Asian",
    "Middle Eastern",
    "Latino_Hispanic",
    "Black",
    "White",
    "Indian",
)
# 3-9 read as a date is 3 September or 9 March; 10-19 is 19 October or October (20)19.
_DATES = {
    "03-sep": "3-9",
    "3-sep": "3-9",
    "sep-03": "3-9",
    "sep-3": "3-9",
    "09-mar": "3-9",
    "9-mar": "3-9",
    "mar-09": "3-9",
    "mar-9": "3-9",
    "19-oct": "10-19",
    "oct-19": "10-19",
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
