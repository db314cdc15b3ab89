"""BioHashing and MLP-Hash against closed forms and against hashing by hand."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from templates.keys.randomness import Keystream
from verify.evaluation.baselines import (
    Hash,
    biohashing,
    hash_comparison,
    hash_similarities,
    hashing,
    mlp_hash,
    packed_bytes,
)
from verify.evaluation.baselines.orthonormal import orthonormal

N = 128
PAIRS = 500
COSINE = 0.6


def unit(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def pairs_at(cosine: float, count: int, n: int = N) -> NDArray[np.float32]:
    """``count`` pairs of unit rows of exactly this cosine: first all firsts, then all seconds."""
    rng = np.random.default_rng(3)
    first = unit(rng.normal(size=(count, n)))
    other = rng.normal(size=(count, n))
    other = unit(other - np.sum(other * first, axis=1, keepdims=True) * first)
    second = cosine * first + math.sqrt(1 - cosine**2) * other
    return np.concatenate([first, second]).astype(np.float32)


def scores(
    descriptors: NDArray[np.float32],
    scheme: Hash,
    *,
    same: bool,
    stolen: bool = False,
    bits: int = N,
    seed: int = 0,
) -> NDArray[np.float64]:
    count = len(descriptors) // 2
    first = np.arange(count)
    truth = np.full(count, same)
    return hash_similarities(
        descriptors, first, first + count, truth, scheme=scheme, bits=bits, stolen=stolen, seed=seed
    )


def agreement(cosine: float) -> float:
    """Probability that a random hyperplane leaves both on one side (Goemans & Williamson 1995)."""
    return 1 - math.acos(cosine) / math.pi


def after_hidden_layers(cosine: float) -> float:
    """Cosine after wide random layers with max(0, x): Cho & Saul's arc-cosine kernel (2009)."""
    for _ in range(mlp_hash.HIDDEN_LAYERS):
        angle = math.acos(cosine)
        cosine = (math.sin(angle) + (math.pi - angle) * cosine) / math.pi
    return cosine


@pytest.mark.parametrize(("inputs", "outputs"), [(40, 24), (24, 40), (32, 32)])
def test_matrices_are_orthonormal(inputs: int, outputs: int) -> None:
    matrix = orthonormal(inputs, outputs, stream=Keystream.seeded(1)).astype(np.float64)
    assert matrix.shape == (inputs, outputs)
    gram = matrix.T @ matrix if outputs <= inputs else matrix @ matrix.T
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-5)


def test_directions_are_uniform() -> None:
    """Haar: entry (0, 0) has mean 0 and variance 1/n; unsigned QR would make it negative always."""
    stream = Keystream.seeded("haar")
    entries = np.array([orthonormal(16, 16, stream=stream)[0, 0] for _ in range(2000)])
    assert abs(entries.mean()) < 5 * 0.25 / math.sqrt(2000)
    assert entries.var() == pytest.approx(1 / 16, rel=0.15)


def test_a_biohash_is_the_signs_of_projections() -> None:
    descriptors = pairs_at(0.3, 3)
    (directions,) = biohashing.weights(N, 50, stream=Keystream.seeded(2))
    flips = np.where(np.random.default_rng(0).random((6, N)) < 0.5, -1, 1).astype(np.float32)
    found = biohashing.code(descriptors, (directions,), (flips,))
    for row, signs, bits in zip(descriptors, flips, found, strict=True):
        token = np.diag(signs.astype(np.float64)) @ directions.astype(np.float64)
        assert bits.tolist() == [float(row.astype(np.float64) @ d) > 0 for d in token.T]


def test_an_mlp_hash_passes_every_layer() -> None:
    descriptors = pairs_at(0.3, 3)
    layers = mlp_hash.weights(N, 50, stream=Keystream.seeded(2))
    assert [layer.shape for layer in layers] == [(128, 256), (256, 256), (256, 256), (256, 50)]
    rng = np.random.default_rng(0)
    flips = tuple(
        np.where(rng.random((6, len(layer))) < 0.5, -1, 1).astype(np.float32) for layer in layers
    )
    found = mlp_hash.code(descriptors, layers, flips)
    for number, row in enumerate(descriptors.astype(np.float64)):
        for place, layer in enumerate(layers):
            row = (flips[place][number][:, None] * layer.astype(np.float64)).T @ row
            if place < len(layers) - 1:
                row = np.where(row > 0, row, 0)
        assert found[number].tolist() == (row > row.mean()).tolist()


@pytest.mark.parametrize(("n", "width"), [(64, 128), (512, 1024), (768, 1024), (4096, 4096)])
def test_hidden_layers_never_narrow(n: int, width: int) -> None:
    assert mlp_hash.hidden_width(n) == width


def test_biohashing_agrees_as_the_angle_says() -> None:
    found = scores(pairs_at(COSINE, PAIRS), Hash.BIOHASHING, same=True)
    # The mean of 500 scores, whose own deviation is below that of 128 independent bits.
    assert found.mean() == pytest.approx(agreement(COSINE), abs=5 * 0.5 / math.sqrt(N * PAIRS))
    assert np.array_equal(found * N, np.round(found * N))


@pytest.mark.parametrize("cosine", [0.0, COSINE])
def test_mlp_hash_agrees_as_the_kernel_says(cosine: float) -> None:
    found = scores(pairs_at(cosine, PAIRS), Hash.MLP_HASH, same=True)
    # 0.01 is for layers of 256 units, where the kernel is that of infinitely many.
    assert found.mean() == pytest.approx(agreement(after_hidden_layers(cosine)), abs=0.01)


@pytest.mark.parametrize("scheme", list(Hash))
def test_two_tokens_make_any_two_codes_independent(scheme: Hash) -> None:
    """Even of one and the same photo: Hamming distances are binomial with p = 1/2."""
    one = pairs_at(1.0, PAIRS)
    found = scores(one, scheme, same=False)
    deviation = 0.5 / math.sqrt(N)
    assert found.mean() == pytest.approx(0.5, abs=5 * deviation / math.sqrt(PAIRS))
    assert found.std() == pytest.approx(deviation, rel=0.12)
    assert np.all(scores(one, scheme, same=True) == 1)
    assert np.all(scores(one, scheme, same=False, stolen=True) == 1)


@pytest.mark.parametrize("scheme", list(Hash))
def test_a_stolen_token_changes_impostors_only(scheme: Hash) -> None:
    descriptors = pairs_at(COSINE, 60)
    first, same = np.arange(60), np.arange(60) % 2 == 0
    normal, stolen = (
        hash_similarities(
            descriptors, first, first + 60, same, scheme=scheme, bits=N, stolen=given, seed=1
        )
        for given in (False, True)
    )
    assert np.array_equal(normal[same], stolen[same])
    assert stolen[~same].mean() > normal[~same].mean() + 0.1
    assert np.array_equal(stolen, scores(descriptors, scheme, same=True, seed=1))


def test_scores_are_distributed_as_under_a_matrix_of_their_own() -> None:
    """One pair again and again: signs on few matrices against a fresh matrix each time."""
    x, y = pairs_at(COSINE, 1, n=48)
    repeated = np.concatenate([np.tile(x, (1500, 1)), np.tile(y, (1500, 1))])
    found = scores(repeated, Hash.BIOHASHING, same=True, bits=40)
    rng = np.random.default_rng(11)
    fresh = np.empty(1500)
    for trial in range(1500):
        q, r = np.linalg.qr(rng.normal(size=(48, 40)))
        token = q * np.sign(np.diagonal(r))
        fresh[trial] = np.mean((x @ token > 0) == (y @ token > 0))
    error = math.hypot(found.std(), fresh.std()) / math.sqrt(1500)
    assert abs(found.mean() - fresh.mean()) < 4 * error
    assert found.std() == pytest.approx(fresh.std(), rel=0.1)


@pytest.mark.parametrize("scheme", list(Hash))
def test_similarities_depend_on_the_seed_and_on_no_tile(
    scheme: Hash, monkeypatch: pytest.MonkeyPatch
) -> None:
    descriptors = pairs_at(0.2, 100)
    found = scores(descriptors, scheme, same=False, bits=100, seed=5)
    assert np.array_equal(found, scores(descriptors, scheme, same=False, bits=100, seed=5))
    assert not np.array_equal(found, scores(descriptors, scheme, same=False, bits=100, seed=6))
    monkeypatch.setattr(hashing, "_TILE", 3)
    # A product of other shape may round a projection across 0.
    tiled = scores(descriptors, scheme, same=False, bits=100, seed=5)
    np.testing.assert_allclose(tiled, found, atol=0.011)


def test_few_pairs_and_none() -> None:
    descriptors = pairs_at(0.2, 1)
    assert scores(descriptors, Hash.BIOHASHING, same=False).shape == (1,)
    assert scores(descriptors[:0], Hash.BIOHASHING, same=False).shape == (0,)


@pytest.mark.parametrize("bits", [0, N + 1])
def test_codes_are_no_longer_than_descriptors(bits: int) -> None:
    with pytest.raises(ValueError, match=f"1 to 128 bits, not {bits}"):
        scores(pairs_at(0.2, 2), Hash.BIOHASHING, same=True, bits=bits)


def test_arrays_must_fit() -> None:
    with pytest.raises(ValueError, match="for each pair"):
        hash_similarities(
            pairs_at(0.2, 2),
            np.arange(2),
            np.arange(2),
            np.ones(3, bool),
            scheme=Hash.BIOHASHING,
            bits=8,
            stolen=False,
            seed=0,
        )


def test_stored_bytes() -> None:
    assert [packed_bytes(bits) for bits in (1, 8, 9, 512)] == [1, 1, 2, 64]


@pytest.mark.parametrize("bits", [5, 64, 100, 512])
def test_comparison_counts_the_bits_that_differ(bits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hashing, "_COMPARED", 16)
    rng = np.random.default_rng(bits)
    a, b = rng.random((7, bits)) < 0.5, rng.random((5, bits)) < 0.5
    found = hash_comparison(np.packbits(a, axis=1), np.packbits(b, axis=1))
    assert found.tolist() == [[int(np.sum(x != y)) for y in b] for x in a]
