"""Generators that were compared before `DecoyGenerator` became what it is.

Each is fitted to real embeddings and draws as many of nobody's; the product ships one of them.
The experiments use NumPy's generator: nothing here makes a template that anybody keeps.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri
from sklearn.cluster import KMeans
from sklearn.decomposition import FastICA
from sklearn.mixture import GaussianMixture

from templates.decoys import Attributes, DecoyGenerator, DecoyPool, DecoySource
from templates.decoys.fitting import cross_fitted, mixture_features, principal_axes
from templates.decoys.statistics import DescriptorStatistics
from templates.keys.randomness import Keystream

Array = npt.NDArray[np.float64]
Sampler = Callable[[int, np.random.Generator], Array]


@dataclass(frozen=True)
class FitData:
    """What a candidate may learn from; ``norms`` are those of the embeddings before scaling."""

    descriptors: npt.NDArray[np.float32]
    classes: npt.NDArray[np.int64]
    norms: Array | None = None

    @property
    def x(self) -> Array:
        """The embeddings in float64."""
        return self.descriptors.astype(np.float64)


class SampledSource:
    """A candidate behind the protocol of lifting."""

    source_id = "experiment"
    made_with: str | None = None
    noise: float = 0.0

    def __init__(self, sample: Sampler, n: int) -> None:
        self.n = n
        self._sample = sample

    def draw(
        self,
        rows: int,
        k: int,
        *,
        stream: Keystream,
        unlike: Sequence[Attributes] | None = None,
        sub_databases: int | None = None,
    ) -> npt.NDArray[np.float32]:
        """Draw; the stream only seeds NumPy's generator."""
        if unlike is not None or sub_databases is not None:
            raise ValueError("a candidate draws independently of the subject")
        rng = np.random.default_rng(int.from_bytes(stream.token(16), "little"))
        x = self._sample(rows * k, rng)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        return x.astype(np.float32).reshape(rows, k, self.n)


def gaussian(data: FitData) -> Sampler:
    """Full covariance of the embeddings (docs/design-measurements.md §1.3)."""
    x = data.x
    return _affine(x.mean(axis=0), _root(np.cov(x, rowvar=False)))


def gaussian_of_unscaled(data: FitData) -> Sampler:
    """Full covariance of the embeddings before they are scaled to unit length."""
    assert data.norms is not None
    return gaussian(FitData((data.x * data.norms[:, None]).astype(np.float32), data.classes))


def gaussian_cross_fitted(data: FitData) -> Sampler:
    """Variances along the principal axes estimated on embeddings that did not find the axes."""
    x = data.x
    axes = principal_axes(x)
    deviations = np.sqrt(np.mean(cross_fitted(x, axes) ** 2, axis=0))
    return _affine(x.mean(axis=0), axes * deviations[:, None])


def class_balanced(data: FitData) -> Sampler:
    """Means per gender and race, classes equally likely, one covariance within the classes."""
    x = data.x
    means = np.array([x[data.classes == c].mean(axis=0) for c in np.unique(data.classes)])
    _, place = np.unique(data.classes, return_inverse=True)
    within = _affine(np.zeros(x.shape[1]), _root(np.cov(x - means[place], rowvar=False)))
    return lambda count, rng: means[rng.integers(len(means), size=count)] + within(count, rng)


def gaussian_mixture(data: FitData) -> Sampler:
    """Eight k-means clusters; each covariance half its own, half the average within clusters."""
    x = data.x
    labels = KMeans(8, n_init=2, random_state=0).fit_predict(x)
    own = [np.cov(x[labels == c], rowvar=False) for c in range(8)]
    shares = np.bincount(labels) / len(x)
    average = np.einsum("c,cij->ij", shares, np.array(own))
    parts = [
        _affine(x[labels == c].mean(axis=0), _root(0.5 * own[c] + 0.5 * average)) for c in range(8)
    ]

    def sample(count: int, rng: np.random.Generator) -> Array:
        chosen = rng.choice(8, size=count, p=shares)
        out = np.empty((count, x.shape[1]))
        for c, part in enumerate(parts):
            out[chosen == c] = part(int(np.sum(chosen == c)), rng)
        return out

    return sample


def copula(data: FitData) -> Sampler:
    """Independent principal coordinates, each with its empirical quantiles."""
    x = data.x
    mean, axes = x.mean(axis=0), principal_axes(x)
    return _quantiles((x - mean) @ axes.T, mean, axes)


def independent_components(data: FitData) -> Sampler:
    """Independent components (FastICA), each with its empirical quantiles."""
    x = data.x
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ica = FastICA(64, whiten="unit-variance", max_iter=30, random_state=0).fit(x)
    sources = ica.transform(x)
    low = _quantiles(sources, x.mean(axis=0), ica.mixing_.T)
    rest = x - ica.inverse_transform(sources)
    high = _affine(np.zeros(x.shape[1]), _root(np.cov(rest, rowvar=False)))
    return lambda count, rng: low(count, rng) + high(count, rng)


def rotation_gaussianization(data: FitData, *, layers: int = 12) -> Sampler:
    """Marginal Gaussianization and a random rotation, in turn (RBIG), sampled backwards."""
    x = data.x
    n = x.shape[1]
    mean, axes = x.mean(axis=0), principal_axes(x)
    z = (x - mean) @ axes.T
    scales = z.std(axis=0)
    z /= scales
    rng = np.random.default_rng(0)
    levels = np.linspace(0.002, 0.998, 200)
    grid = ndtri(levels)
    steps: list[tuple[Array, Array]] = []
    for _ in range(layers):
        rotation = np.linalg.qr(rng.standard_normal((n, n)))[0]
        z = z @ rotation
        table = np.quantile(z, levels, axis=0)
        z = np.column_stack([_monotone(z[:, j], table[:, j], grid) for j in range(n)])
        steps.append((rotation, table))

    def sample(count: int, rng: np.random.Generator) -> Array:
        y = rng.standard_normal((count, n))
        for rotation, table in reversed(steps):
            y = np.column_stack([_monotone(y[:, j], grid, table[:, j]) for j in range(n)])
            y = y @ rotation.T
        return np.asarray(mean + (y * scales) @ axes, dtype=np.float64)

    return sample


def neighbour_mixture(data: FitData) -> Sampler:
    """Convex mixtures of a face and four of its twenty nearest: close to its training faces."""
    x = data.x
    nearest = np.argsort(-(x @ x.T), axis=1)[:, :20]

    def sample(count: int, rng: np.random.Generator) -> Array:
        centre = rng.integers(len(x), size=count)
        others = nearest[centre[:, None], rng.integers(1, 20, size=(count, 4))]
        members = np.hstack([centre[:, None], others])
        shares = rng.dirichlet(np.ones(5), size=count)
        return np.asarray(np.einsum("ck,ckn->cn", shares, x[members]), dtype=np.float64)

    return sample


def bands_without_clusters(data: FitData) -> Sampler:
    """The product's generator with a single component: energies, but no clusters."""
    x = data.x
    axes = principal_axes(x)
    coordinates = cross_fitted(x, axes)
    deviations = np.sqrt(np.mean(coordinates**2, axis=0))
    features = mixture_features(coordinates / deviations)
    mixture = GaussianMixture(1, reg_covar=1e-5).fit(features)
    statistics = DescriptorStatistics(
        mean=x.mean(axis=0).astype(np.float32),
        axes=(axes * deviations[:, None]).astype(np.float32),
        weights=mixture.weights_.astype(np.float32),
        centres=mixture.means_.astype(np.float32),
        spreads=np.linalg.cholesky(mixture.covariances_).astype(np.float32),
    )
    return _of(DecoyGenerator(statistics))


def product(data: FitData) -> Sampler:
    """`templates.decoys.DecoyGenerator`."""
    return _of(DecoyGenerator.fit(data.descriptors))


CANDIDATES: dict[str, Callable[[FitData], Sampler]] = {
    "gaussian": gaussian,
    "gaussian, unscaled embeddings": gaussian_of_unscaled,
    "gaussian, cross-fitted": gaussian_cross_fitted,
    "gaussian, class-balanced": class_balanced,
    "gaussian mixture, 8 clusters": gaussian_mixture,
    "copula on principal axes": copula,
    "independent components": independent_components,
    "rotation gaussianization": rotation_gaussianization,
    "mixture of five neighbours": neighbour_mixture,
    "bands, no clusters": bands_without_clusters,
    "product": product,
}


def source(name: str, data: FitData) -> DecoySource:
    """The candidate, or the pool of the fitted people themselves, behind the protocol."""
    if name == "real pool":
        return DecoyPool(data.descriptors)
    if name == "product":
        return DecoyGenerator.fit(data.descriptors)
    return SampledSource(CANDIDATES[name](data), data.descriptors.shape[1])


def _of(generator: DecoyGenerator) -> Sampler:
    def sample(count: int, rng: np.random.Generator) -> Array:
        stream = Keystream.seeded("experiment", int(rng.integers(2**31)))
        return generator.draw(count, 1, stream=stream)[:, 0].astype(np.float64)

    return sample


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(np.sqrt(np.maximum(values, 0))[:, None] * vectors.T, dtype=np.float64)


def _affine(mean: Array, factor: Array) -> Sampler:
    return lambda count, rng: mean + rng.standard_normal((count, len(factor))) @ factor


def _quantiles(coordinates: Array, mean: Array, axes: Array) -> Sampler:
    levels = np.linspace(0.0, 1.0, 201)
    table = np.quantile(coordinates, levels, axis=0)

    def sample(count: int, rng: np.random.Generator) -> Array:
        uniform = ndtr(rng.standard_normal((count, table.shape[1])))
        drawn = [np.interp(uniform[:, j], levels, table[:, j]) for j in range(table.shape[1])]
        return mean + np.column_stack(drawn) @ axes

    return sample


def _monotone(values: Array, from_: Array, to: Array) -> Array:
    """Piecewise linear map of one grid to another, continued with slope 1 beyond its ends."""
    inside = np.interp(values, from_, to)
    return np.asarray(
        inside + np.minimum(values - from_[0], 0) + np.maximum(values - from_[-1], 0),
        dtype=np.float64,
    )
