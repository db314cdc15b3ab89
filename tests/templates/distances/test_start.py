"""The compiled loops where their first start is orthogonal to the leading eigenvector."""

import numpy as np

from templates.distances import compiled, exact
from templates.distances.metric import Metric
from templates.space.subspace import SubspaceBatch


def test_a_leading_eigenvector_that_is_orthogonal_to_the_start() -> None:
    inside = np.array([[0.6, 0.02], [0.02, 0.6]])
    left, right = np.zeros((2, 16)), np.eye(2, 16)
    left[:, :2], left[:, 2:4] = inside, np.linalg.cholesky(np.eye(2) - inside @ inside.T)
    foot = np.zeros((1, 16), np.float32)
    a, b = (SubspaceBatch(foot, rows[None].astype(np.float32)) for rows in (left, right))
    ((_, _, fast),) = compiled.tiles(a, b, metric=Metric.SPHERICAL, steps=200, threads=1)
    ((_, _, true),) = exact.tiles(a, b, metric=Metric.SPHERICAL, steps=200)
    np.testing.assert_allclose(fast, true, atol=1e-4)
