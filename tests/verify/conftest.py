"""One calibration of synthetic people, shared by the tests of this package."""

import pytest

from tests.verify.synthetic import People, calibrate_people, draw_people
from verify import Calibrated


@pytest.fixture(scope="package")
def people() -> People:
    return draw_people(150)


@pytest.fixture(scope="package")
def calibrated(people: People) -> Calibrated:
    return calibrate_people(people)
