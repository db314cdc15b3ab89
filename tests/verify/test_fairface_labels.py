import pytest

from verify.fairface_labels import AGES, repaired_age


@pytest.mark.parametrize(
    ("cell", "age"),
    [
        *((age, age) for age in AGES),
        ("03-Sep", "3-9"),
        ("3-Sep", "3-9"),
        ("9-Mar", "3-9"),
        ("19-Oct", "10-19"),
        ("Oct-19", "10-19"),
        (" 20-29 ", "20-29"),
        ("20-30", None),
        ("12-Dec", None),
        ("", None),
    ],
)
def test_ages_that_a_spreadsheet_made_dates_of_are_repaired(cell, age):
    assert repaired_age(cell) == age
