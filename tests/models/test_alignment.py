import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.alignment import TEMPLATE_112, align, similarity_transform, template
from models.errors import PackError


def umeyama(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Equations 34-43 of Umeyama 1991, by singular values."""
    mean_s, mean_t = source.mean(0), target.mean(0)
    centred = source - mean_s
    covariance = (target - mean_t).T @ centred / len(source)
    u, d, vt = np.linalg.svd(covariance)
    sign = np.ones(2)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        sign[-1] = -1
    rotation = u @ np.diag(sign) @ vt
    scale = (d * sign).sum() / (centred**2).sum(1).mean()
    return np.column_stack([scale * rotation, mean_t - scale * rotation @ mean_s])


points = st.lists(
    st.tuples(st.floats(-500, 500), st.floats(-500, 500)), min_size=5, max_size=5
).map(np.array)


@given(points, st.integers(0, 2**32 - 1))
def test_equals_umeyama_by_singular_values(source, seed):
    spread = np.linalg.norm(source - source.mean(0))
    if spread < 1:
        return
    target = TEMPLATE_112 + np.random.default_rng(seed).normal(0, 3, (5, 2))
    np.testing.assert_allclose(
        similarity_transform(source, target), umeyama(source, target), rtol=1e-6, atol=1e-6
    )


def test_points_that_coincide_are_refused():
    with pytest.raises(ValueError, match="all equal"):
        similarity_transform(np.ones((5, 2)), TEMPLATE_112)


@pytest.mark.parametrize(
    ("size", "factor", "shift"), [(112, 1, 0), (224, 2, 0), (128, 1, 8), (256, 2, 16)]
)
def test_template_of_other_sizes(size, factor, shift):
    np.testing.assert_allclose(template(size), TEMPLATE_112 * factor + [shift, 0])


@pytest.mark.parametrize("size", [0, -112, 100, 160])
def test_sizes_without_a_template_are_refused(size):
    with pytest.raises(PackError, match="multiples of 112 or of 128"):
        template(size)


def test_warp_is_bilinear_with_a_black_border():
    """A shift by half a pixel averages neighbours; outside of the picture is 0."""
    image = np.random.default_rng(0).integers(0, 256, (112, 112, 3), dtype=np.uint8)
    crop = align(image, TEMPLATE_112 + np.array([0.5, 0]), size=112)
    expected = (image[:, :-1].astype(float) + image[:, 1:]) / 2
    assert np.abs(crop[:, :-1] - expected).max() <= 1
    far = align(image, TEMPLATE_112 + np.array([60, 0]), size=112)
    assert far[:, 60:].max() == 0
    np.testing.assert_array_equal(far[:, :50], image[:, 60:110])
    assert crop.flags.c_contiguous
