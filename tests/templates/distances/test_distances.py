"""Distances agree with independent computations, whichever of the three files computes them."""

import functools
import itertools
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from templates.distances import (
    DEFAULT_STEPS,
    Metric,
    exact,
    nearest,
    paired_distances,
    pairwise_distances,
    similarity,
)
from templates.errors import InvalidEmbedding, InvalidTemplate, TemplateError
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.templates.distances.batches import (
    BACKENDS,
    METRICS,
    N,
    backend,
    faces,
    matrix,
    pairs,
    randoms,
    units,
)

# --- independent computations, in float64 ------------------------------------------------------


def brute_euclidean(a: SubspaceBatch, b: SubspaceBatch) -> float:
    """Least squares by singular values; directions equal up to float32 storage count once."""
    gap = b.foot.astype(np.float64) - a.foot
    rows = np.vstack([a.basis, b.basis]).astype(np.float64)
    solution = scipy.linalg.lstsq(rows.T, gap, cond=1e-6)[0]
    return float(np.linalg.norm(gap - rows.T @ solution))


def brute_spherical(a: SubspaceBatch, b: SubspaceBatch, restarts: int = 8) -> float:
    """Quasi-Newton minimisation over both spheres from random starts."""
    p, q = a.foot.astype(np.float64), b.foot.astype(np.float64)
    d, e = a.basis.astype(np.float64), b.basis.astype(np.float64)

    def gap(x: np.ndarray) -> float:
        u, v = x[: a.m] / np.linalg.norm(x[: a.m]), x[a.m :] / np.linalg.norm(x[a.m :])
        return float(np.sum((p + a.radii[0] * d.T @ u - q - b.radii[0] * e.T @ v) ** 2))

    starts = Keystream.seeded("restarts").normal((restarts, a.m + b.m))
    options = {"gtol": 1e-10}
    best = min(
        scipy.optimize.minimize(gap, start, method="BFGS", options=options).fun for start in starts
    )
    return float(np.sqrt(best))


def brute_point(point: np.ndarray, b: SubspaceBatch, metric: str) -> float:
    offset = point - b.foot.astype(np.float64)
    basis = b.basis.astype(np.float64)
    inside = basis.T @ scipy.linalg.lstsq(basis.T, offset)[0]
    if metric == "euclidean":
        return float(np.linalg.norm(offset - inside))
    # The nearest point of the sphere around the foot point lies towards the projection.
    nearest = b.foot + b.radii[0] * inside / np.linalg.norm(inside)
    return float(np.linalg.norm(point - nearest))


BRUTE: dict[str, Callable[[SubspaceBatch, SubspaceBatch], float]] = {
    "euclidean": brute_euclidean,
    "spherical": brute_spherical,
}


MEETING = {"shared decoy", "two shared decoys", "contained", "identical"}


@functools.cache
def brute_force(name: str, metric: str) -> float:
    return BRUTE[metric](*pairs()[name])


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("relation", pairs())
def test_subspace_pairs_agree_with_brute_force(relation: str, metric: str, name: str):
    a, b = pairs()[relation]
    expected = brute_force(relation, metric)
    for one, two in ((a, b), (b, a)):
        seen = matrix(name, SubspaceBatch.of([one]), SubspaceBatch.of([two]), metric=metric)
        if relation in MEETING:
            assert 0 <= seen[0, 0] < (1e-6 if metric == "euclidean" else 1e-5)
        else:
            assert seen[0, 0] == pytest.approx(expected, rel=1e-4 if expected > 0.1 else 1e-3)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("metric", METRICS)
def test_points_agree_with_brute_force(metric: str, name: str):
    stream = Keystream.seeded("points")
    points = units(stream, 30)
    templates = lift(units(stream, 12), strategy="random", m=5, stream=stream)
    # Points of the sets, and points at 0.01 and 0.09 from one, where squares cancel.
    near = [templates[i].project(points[i]) for i in range(6)]
    near = [x / np.linalg.norm(x) for x in near]
    member = templates.feet[0] + templates.radii[0] * templates.bases[0, 0].astype(np.float64)
    for step in (0.01, 0.09):
        moved = member + step * units(stream, 1)[0]
        near.append(moved / np.linalg.norm(moved))
    points = np.vstack([points, *near]).astype(np.float32).astype(np.float64)
    seen = matrix(name, points, templates, metric=metric)
    expected = np.array([[brute_point(x, t, metric) for t in templates] for x in points])
    assert expected.min() < 0.02
    rtol, atol = (1e-6, 5e-7) if name == "exact" else (2e-5, 2e-6)
    np.testing.assert_allclose(seen, expected, rtol=rtol, atol=atol)


# --- the two in float32 against float64 --------------------------------------------------------


@pytest.mark.parametrize("name", ["compiled", "torch"])
@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize(
    ("m", "k", "n"),
    [(1, 1, 64), (1, 9, 64), (2, 2, 64), (3, 4, 200), (7, 5, 64), (2, 16, 128), (20, 33, 512)],
)
def test_float32_agrees_with_the_specification(m: int, k: int, n: int, metric: str, name: str):
    a, b = faces(21, m, seed=1, n=n), faces(37, k, seed=2, n=n)
    points = units(Keystream.seeded("points"), 21, n).astype(np.float32)
    expected = matrix("exact", points, b, metric=metric)
    np.testing.assert_allclose(matrix(name, points, b, metric=metric), expected, rtol=3e-6)
    # Some pairs meet, and no product in float32 can say so.
    b = SubspaceBatch(np.concatenate([b.feet, b.feet[:2]]), np.concatenate([b.bases, b.bases[:2]]))
    for one, two in ((a, b), (b[:30], b)):
        seen = similarity(matrix(name, one, two, metric=metric).astype(np.float64))
        expected = similarity(matrix("exact", one, two, metric=metric, steps=400))
        assert (seen - expected).max() < 2e-5
        # The search for the maximum on the sphere may end in the lower of two.
        missing = expected - seen
        assert np.quantile(missing, 0.98) < 3e-6
        assert missing.max() < (3e-6 if metric == "euclidean" else 1e-2)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("scale", [1.5, 40.0, 1e25])
@pytest.mark.parametrize("metric", METRICS)
def test_sets_outside_the_sphere_and_squares_that_overflow(metric: str, scale: float, name: str):
    axes = np.eye(64)
    outside = SubspaceBatch((scale * axes[5])[None], axes[None, :3])
    templates = faces(6, 4, seed=4, n=64)
    points = np.vstack([units(Keystream.seeded(2), 4, 64), np.zeros((1, 64))])
    for probes, others in ((outside, templates), (templates, outside), (points, outside)):
        np.testing.assert_allclose(
            matrix(name, probes, others, metric=metric),
            matrix("exact", probes, others, metric=metric),
            rtol=3e-6,
        )


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("size", [1e-25, 1e-12, 1e12, 1e25])
def test_the_length_of_a_point_does_not_count_on_the_sphere(size: float, name: str) -> None:
    templates, points = randoms(20, 2, seed=1), units(Keystream.seeded(1), 3)
    seen = matrix(name, size * points, templates, metric="spherical")
    np.testing.assert_allclose(seen, matrix(name, points, templates, metric="spherical"), rtol=1e-5)


@pytest.mark.parametrize(("dtype", "atol"), [(np.float64, 1e-10), (np.float32, 3e-6)])
def test_a_matrix_of_lifted_pairs_is_made_of_its_pairs(dtype: type, atol: float):
    """One product for all, in either precision, gives what each pair gives alone in float64."""
    a, b = faces(5, 3, seed=1), faces(6, 7, seed=2)
    for left, right in ((a, b), (b, a), pairs()["close"]):
        i, j = np.indices((len(left), len(right))).reshape(2, -1)
        options = {"metric": Metric.SPHERICAL, "steps": 400}
        expected = exact.pairs(left, right, i, j, **options).reshape(len(left), -1)
        seen = matrix("exact", left, right, metric="spherical", steps=400, dtype=dtype)
        np.testing.assert_allclose(similarity(seen), similarity(expected), rtol=0, atol=atol)


def test_a_leading_eigenvector_that_is_orthogonal_to_the_start_of_the_loops() -> None:
    inside = np.array([[0.6, 0.02], [0.02, 0.6]])
    left, right = np.zeros((2, 16)), np.eye(2, 16)
    left[:, :2], left[:, 2:4] = inside, np.linalg.cholesky(np.eye(2) - inside @ inside.T)
    a, b = (SubspaceBatch(np.zeros((1, 16)), rows[None]) for rows in (left, right))
    seen = matrix("compiled", a, b, metric="spherical", steps=200)
    expected = matrix("exact", a, b, metric="spherical", steps=200)
    np.testing.assert_allclose(seen, expected, atol=1e-4)


# --- convergence of the spherical iteration ----------------------------------------------------


def hard_pairs() -> tuple[SubspaceBatch, SubspaceBatch]:
    return faces(5, 16, seed=3), faces(6, 16, seed=4)


@functools.cache
def restarted_similarities(restarts: int) -> np.ndarray:
    """Best of many random restarts of the plain alternation, 2000 steps, in float64."""
    a, b = hard_pairs()
    out = np.empty((len(a), len(b)))
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            p, q = x.foot.astype(np.float64), y.foot.astype(np.float64)
            d, e = x.basis.astype(np.float64), y.basis.astype(np.float64)
            g, h = x.radii[0] * d @ q, y.radii[0] * e @ p
            middle = x.radii[0] * y.radii[0] * d @ e.T
            v = Keystream.seeded("restart", i, j).normal((y.m, restarts))
            for _ in range(2000):
                u = g[:, None] + middle @ v
                u /= np.linalg.norm(u, axis=0)
                v = h[:, None] + middle.T @ u
                v /= np.linalg.norm(v, axis=0)
            values = g @ u + h @ v + np.sum(u * (middle @ v), axis=0)
            out[i, j] = p @ q + values.max()
    return out


@pytest.mark.parametrize("name", BACKENDS)
def test_default_steps_reach_the_best_of_many_restarts(name: str):
    a, b = hard_pairs()
    best = restarted_similarities(64)
    missing = best - similarity(matrix(name, a, b, metric="spherical").astype(np.float64))
    assert np.abs(missing).max() < (1e-6 if name == "exact" else 2e-6)
    # docs/method.md §3.5: many pairs unfinished after 10 plain steps; the data must be that hard.
    few = best - similarity(matrix(name, a, b, metric="spherical", steps=3))
    assert (few > 1e-4).mean() > 0.3


@pytest.mark.parametrize("kind", ["faces", "crossing"])
def test_more_steps_never_lower_the_similarity(kind: str):
    # Subspaces of R⁸ with m = 5 cross; the extrapolation overshoots on many of them.
    a, b = {
        "faces": (faces(10, 8, seed=5), faces(10, 6, seed=6)),
        "crossing": (randoms(40, 5, seed=1, n=8), randoms(40, 5, seed=2, n=8)),
    }[kind]
    similarities = [
        similarity(matrix("exact", a, b, metric="spherical", steps=steps))
        for steps in (1, 2, 3, 4, 5, 6, 7, 8, 13, 30, DEFAULT_STEPS, 200)
    ]
    far = similarities[-1] < 0.99  # nearer pairs get steps of their own in float64
    assert far.sum() > 80
    for before, after in itertools.pairwise(similarities):
        assert (after[far] >= before[far] - 1e-12).all()
    assert (similarities[-1] > similarities[0] + 1e-4)[far].any()


# --- algebra -----------------------------------------------------------------------------------


@settings(max_examples=25)
@given(
    m=st.integers(1, 6),
    k=st.integers(1, 6),
    seed=st.integers(0, 10**6),
    metric=st.sampled_from(METRICS),
)
def test_distances_obey_the_order_of_the_sets(m: int, k: int, seed: int, metric: str):
    stream = Keystream.seeded(seed)
    x, y = units(stream, 3), units(stream, 4)
    a = lift(x, strategy="random", m=m, stream=stream)
    b = lift(y, strategy="random", m=k, stream=stream)
    subspaces = matrix("exact", a, b, metric=metric)
    points = matrix("exact", x, b, metric=metric)
    raw = np.linalg.norm(x[:, None] - y[None], axis=2)
    # The iteration may stop short of the nearest points of two spheres (docs/method.md §3.5).
    short = 1e-4 if metric == "spherical" else 1e-6
    assert np.isfinite(subspaces).all()
    assert (subspaces <= points + short).all()
    # Subspaces are float32, whose rounding moves where one meets the sphere by as much over the
    # radius of what they share: 2e-4 is met once in a thousand random subspaces of one dimension.
    radii = np.sqrt(np.maximum(1 - b.foot_norms**2, 1e-12))
    assert (points <= raw + 1e-6 + np.finfo(np.float32).eps / 2 / radii).all()
    np.testing.assert_allclose(matrix("exact", b, a, metric=metric), subspaces.T, atol=short)
    euclidean = matrix("exact", a, b, metric="euclidean")
    assert (euclidean <= subspaces + 1e-6).all()
    # A larger set is nearer: the first m directions of a, and those with more.
    if m > 1:
        smaller = SubspaceBatch(a.feet, a.bases[:, :-1])
        assert (subspaces <= matrix("exact", smaller, b, metric=metric) + 1e-6).all()


@pytest.mark.parametrize("metric", METRICS)
def test_paired_is_the_diagonal_of_pairwise(metric: str):
    a, b = faces(15, 4, seed=9), faces(15, 7, seed=10)
    for probes in (a, units(Keystream.seeded(1), 15, 128)):
        paired = paired_distances(probes, b, metric=metric)
        assert paired.dtype == np.float32
        assert paired.shape == (15,)
        expected = np.diagonal(pairwise_distances(probes, b, metric=metric))
        np.testing.assert_allclose(paired, expected, atol=2e-6)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("metric", METRICS)
def test_tiles_bound_the_memory_and_do_not_show(
    metric: str, name: str, monkeypatch: pytest.MonkeyPatch
):
    a, b = randoms(150, 6, seed=11), randoms(150, 7, seed=12)
    points = units(Keystream.seeded(2), 900).astype(np.float32)
    module, options = backend(name)
    whole = [matrix(name, probes, b, metric=metric) for probes in (points, a)]
    for size, value in {
        "_CHUNK_BYTES": 1 << 16,
        "_SIDE": 32,
        "_TASK_PAIRS": 1 << 12,
        "_TEMPLATE_ROWS": 128,
        "_TILE_BYTES": {"cpu": 1 << 16},
    }.items():
        if hasattr(module, size):
            monkeypatch.setattr(module, size, value)
    tiled = [matrix(name, probes, b, metric=metric) for probes in (points, a)]
    for one, two in zip(whole, tiled, strict=True):
        np.testing.assert_allclose(two, one, atol=5e-6)
    tracemalloc.start()
    for _ in module.tiles(a, b, metric=Metric(metric), steps=50, **options):
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The cross-Gram matrix of the subspaces alone would be 5 MB.
    assert 4 * 150 * 7 * 150 * 8 > 5e6
    assert peak < 3 << 20


# --- odd and hostile input ---------------------------------------------------------------------


def test_zero_probe_is_as_far_as_the_method_says():
    templates = faces(4, 5, seed=13)
    zero = np.zeros((1, 128), dtype=np.float32)
    np.testing.assert_allclose(
        pairwise_distances(zero, templates, metric="euclidean")[0], templates.foot_norms, rtol=1e-6
    )
    for distances in (
        pairwise_distances(zero, templates, metric="spherical")[0],
        paired_distances(np.repeat(zero, 4, axis=0), templates, metric="spherical"),
    ):
        np.testing.assert_allclose(distances, np.sqrt(2), rtol=1e-6)


POINTS, TEMPLATES = units(Keystream.seeded(5), 3), randoms(3, 4, seed=16)
BROKEN = SubspaceBatch(TEMPLATES.feet * np.inf, TEMPLATES.bases)


@pytest.mark.parametrize(
    ("probes", "templates", "options", "error", "message"),
    [
        (POINTS * np.nan, TEMPLATES, {}, InvalidEmbedding, "not finite"),
        (POINTS * 1e39, TEMPLATES, {}, InvalidEmbedding, "not finite"),
        (POINTS[:, :-1], TEMPLATES, {}, InvalidEmbedding, "shape"),
        (POINTS[0], TEMPLATES, {}, InvalidEmbedding, "shape"),
        (randoms(3, 4, seed=17, n=N + 1), TEMPLATES, {}, InvalidTemplate, "does not fit"),
        (POINTS, BROKEN, {}, InvalidTemplate, "not finite"),
        (BROKEN, TEMPLATES, {}, InvalidTemplate, "not finite"),
        (POINTS, TEMPLATES, {"steps": 0}, TemplateError, "at least one step"),
        (POINTS, TEMPLATES, {"metric": "cosine"}, ValueError, "is not a valid Metric"),
    ],
)
@pytest.mark.parametrize("measure", [pairwise_distances, paired_distances])
def test_wrong_probes_templates_and_options_are_refused(
    measure, probes, templates, options, error: type[Exception], message: str
):
    with pytest.raises(error, match=message):
        measure(probes, templates, **{"metric": "spherical", **options})


def test_wrong_counts_are_refused():
    with pytest.raises(TemplateError, match="do not pair"):
        paired_distances(POINTS[:2], TEMPLATES, metric="spherical")
    with pytest.raises(TemplateError, match="at least 1"):
        nearest(POINTS, TEMPLATES, k=0, metric="spherical")


def test_similarity_is_the_cosine_of_unit_points():
    x, y = units(Keystream.seeded(6), 2)
    assert similarity(float(np.linalg.norm(x - y))) == pytest.approx(x @ y)
    np.testing.assert_allclose(similarity(np.array([0.0, np.sqrt(2), 2.0])), [1, 0, -1], atol=1e-12)
