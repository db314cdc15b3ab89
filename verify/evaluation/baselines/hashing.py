"""Similarities of pairs under a hashing scheme, with and without a stolen token."""

from collections.abc import Iterator
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from templates.keys.randomness import Keystream
from verify.evaluation.baselines import biohashing, mlp_hash
from verify.evaluation.baselines.orthonormal import Flips, Matrix

MATRICES = 4
"""Sets of orthonormal matrices per seed; the tokens of all pairs are made of them."""
_TILE = 512
_COMPARED = 1 << 18

Codes = NDArray[np.uint8]


class Hash(StrEnum):
    """A hashing scheme."""

    BIOHASHING = "biohashing"
    MLP_HASH = "mlp-hash"


_SCHEMES = {Hash.BIOHASHING: biohashing, Hash.MLP_HASH: mlp_hash}


def hash_similarities(
    descriptors: NDArray[np.float32],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    same: NDArray[np.bool_],
    *,
    scheme: Hash,
    bits: int,
    stolen: bool,
    seed: int,
) -> NDArray[np.float64]:
    """Similarity 1 − d_H / bits of every pair, d_H being the Hamming distance of its codes.

    Parameters
    ----------
    descriptors : (N, n) float32
        Unit rows.
    first, second : (P,) int64
        Positions in ``descriptors``.
    same : (P,) bool
        Whether a pair shows one person.
    bits
        Length of a code, 1 … n.
    stolen
        False: a genuine pair is hashed under one token, an impostor's photos under two. True: the
        impostor holds the victim's token, so every pair is hashed under one.
    seed
        Of the tokens. The similarities are a function of all arguments, to the last bit where
        matrix products run on the same number of threads.

    Raises
    ------
    ValueError
        Where ``bits`` is not 1 … n, or the arrays do not fit.

    Notes
    -----
    Every pair has tokens of its own, but orthonormalising matrices for each would take hours and
    change nothing. A token is one of ``MATRICES`` sets of Haar matrices W, taken in turn, with the
    inputs of each layer multiplied by random signs D that are drawn anew for the token. D W is
    again Haar-distributed, so a similarity has exactly the distribution that it has under a matrix
    drawn for it alone. The two tokens of an impostor pair are of different sets, hence
    independent. Pairs of one set are related through W only, seen through independent signs.
    """
    count, n = len(first), descriptors.shape[1]
    if not 1 <= bits <= n:
        raise ValueError(f"a code of embeddings of {n} numbers has 1 to {n} bits, not {bits}")
    if not first.shape == second.shape == same.shape == (count,):
        raise ValueError("hashing needs one first photo, second photo and truth for each pair")
    one_token = same | stolen
    codes = np.empty((2, count, packed_bytes(bits)), dtype=np.uint8)
    set_of = np.arange(count) % MATRICES
    for number in range(MATRICES):
        own = np.flatnonzero(set_of == number)
        strangers = np.flatnonzero(~one_token & ((set_of + 1) % MATRICES == number))
        if not own.size + strangers.size:
            continue
        name = ("hashing baseline", str(scheme), seed, number)
        layers = _SCHEMES[scheme].weights(n, bits, stream=Keystream.seeded(*name, "matrices"))
        for pairs, flips in _tokens(own, layers, Keystream.seeded(*name, "tokens")):
            codes[0, pairs] = _packed(scheme, descriptors[first[pairs]], layers, flips)
            shared = one_token[pairs]
            codes[1, pairs[shared]] = _packed(
                scheme,
                descriptors[second[pairs[shared]]],
                layers,
                tuple(signs[shared] for signs in flips),
            )
        for pairs, flips in _tokens(strangers, layers, Keystream.seeded(*name, "strangers")):
            codes[1, pairs] = _packed(scheme, descriptors[second[pairs]], layers, flips)
    distances = np.bitwise_count(codes[0] ^ codes[1]).sum(axis=1, dtype=np.int64)
    similarities: NDArray[np.float64] = 1.0 - distances / bits
    return similarities


def packed_bytes(bits: int) -> int:
    """Bytes of a stored code."""
    return (bits + 7) // 8


def hash_comparison(codes_a: Codes, codes_b: Codes) -> NDArray[np.int64]:
    """Hamming distances of every code to every other, (A, B), as a matcher would compute them.

    Parameters
    ----------
    codes_a, codes_b : (A, b) and (B, b) uint8
        Packed codes (``numpy.packbits``), of equal length.
    """
    words_a, words_b = _words(codes_a), _words(codes_b)
    distances = np.zeros((len(words_a), len(words_b)), dtype=np.int64)
    rows = max(1, _COMPARED // max(1, len(words_b)))
    for start in range(0, len(words_a), rows):
        tile = distances[start : start + rows]
        for column_a, column_b in zip(words_a[start : start + rows].T, words_b.T, strict=True):
            tile += np.bitwise_count(column_a[:, None] ^ column_b[None, :])
    return distances


def _words(codes: Codes) -> NDArray[np.uint64]:
    """Codes as 64-bit words, padded with zeros."""
    padded = np.zeros((len(codes), -(-codes.shape[1] // 8) * 8), dtype=np.uint8)
    padded[:, : codes.shape[1]] = codes
    return padded.view(np.uint64)


def _packed(
    scheme: Hash,
    descriptors: NDArray[np.float32],
    layers: tuple[Matrix, ...],
    flips: tuple[Flips, ...],
) -> Codes:
    return np.packbits(_SCHEMES[scheme].code(descriptors, layers, flips), axis=1)


def _tokens(
    pairs: NDArray[np.int64], layers: tuple[Matrix, ...], stream: Keystream
) -> Iterator[tuple[NDArray[np.int64], tuple[Flips, ...]]]:
    """Tiles of pairs, with the signs of each pair's token."""
    widths = [len(layer) for layer in layers]
    row = packed_bytes(sum(widths))
    for start in range(0, len(pairs), _TILE):
        tile = pairs[start : start + _TILE]
        drawn = np.frombuffer(stream.token(len(tile) * row), dtype=np.uint8)
        ones = np.unpackbits(drawn.reshape(len(tile), row), axis=1, count=sum(widths))
        signs = np.float32(1) - np.float32(2) * ones
        yield tile, tuple(np.split(signs, np.cumsum(widths)[:-1], axis=1))
