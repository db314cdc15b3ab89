"""The dimension that a calibration takes, and what its verdict says of the choice."""

import pytest

from api.cli.verdict import verdict_lines
from api.process.preparation import _operating_point
from templates.contract.verdict import Verdict
from templates.space.lifting import Strategy
from tests.verify.population import N, decoys, photos_of
from verify import CalibrationOptions


@pytest.mark.parametrize("asked", [None, 8])
def test_few_people_get_a_quarter_of_the_numbers_and_are_told(asked: int | None) -> None:
    """Half of them would leave little of a face, and so few people show nothing of any m."""
    point = _operating_point(
        photos_of(30, 2, seed=4).reshape(-1, N),
        [str(number // 2) for number in range(60)],
        decoys(),
        strategy=Strategy.ADVERSARIAL,
        m=asked,
        options=CalibrationOptions(),
        progress=lambda _what, _share: None,
    )
    assert point.dim == (asked or N // 4)
    privacy = point.tried[point.dim]
    assert privacy.status == "FAIL"
    accuracy = {"level": "fmr-1e-3", "enrolled_photos": 3, "probe_photos": 3}
    said = verdict_lines(Verdict(privacy, type(privacy)(privacy.rate, 0.02, accuracy)))[0]
    assert said.endswith("so m is a default, no result of these people.") == (asked is None)
