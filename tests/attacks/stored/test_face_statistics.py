import numpy as np
import pytest

from attacks.stored.face_statistics import FaceStatistics


@pytest.mark.parametrize(("count", "n"), [(3, 20), (40, 20), (400, 20), (30, 64)])
def test_the_covariance_is_that_of_ledoit_and_wolf(count: int, n: int) -> None:
    """Their equations 9 to 14, of the mean square of ‖x xᵀ − S‖, photo by photo."""
    rng = np.random.default_rng(count)
    rows = rng.normal(size=(count, n)) * np.linspace(0.2, 2.0, n) + 0.3
    statistics = FaceStatistics.of(rows)
    centred = rows - rows.mean(axis=0)
    sample = centred.T @ centred / count
    target = np.trace(sample) / n * np.eye(n)
    distance = ((sample - target) ** 2).sum()
    error = np.mean([((np.outer(x, x) - sample) ** 2).sum() for x in centred]) / count
    share = min(error, distance) / distance
    assert 0 < share < 1
    expected = share * target + (1 - share) * sample
    np.testing.assert_allclose(statistics.colouring @ statistics.colouring, expected, rtol=1e-9)
    np.testing.assert_allclose(statistics.mean, rows.mean(axis=0))
