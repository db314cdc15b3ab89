import numpy as np
import pytest
from sklearn.covariance import ledoit_wolf

from attacks.stored.face_statistics import FaceStatistics


@pytest.mark.parametrize(("count", "n"), [(3, 20), (40, 20), (400, 20), (30, 64)])
def test_the_covariance_is_that_of_ledoit_and_wolf(count: int, n: int) -> None:
    rng = np.random.default_rng(count)
    rows = rng.normal(size=(count, n)) * np.linspace(0.2, 2.0, n) + 0.3
    statistics = FaceStatistics.of(rows)
    expected, share = ledoit_wolf(rows)
    assert 0 < share < 1
    np.testing.assert_allclose(statistics.colouring @ statistics.colouring, expected, rtol=1e-9)
    np.testing.assert_allclose(statistics.mean, rows.mean(axis=0))
