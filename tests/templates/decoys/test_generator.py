"""The generator of decoys that belong to nobody."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from templates.decoys import (
    Attributes,
    DecoyGenerator,
    container,
    load_source,
)
from templates.decoys.fitting import separating_direction
from templates.decoys.generator import GENERATOR_FORMAT, MAX_GENERATOR_BYTES
from templates.errors import DecoyError, InvalidEmbedding, TemplateError
from templates.keys.randomness import Keystream
from templates.keys.sealing import MasterKeyring, Sealer

N = 80
MADE = "5a" * 32
Rows = NDArray[np.float32]


def face_like(count: int, seed: int, n: int = N, *, kind: int = 0) -> Rows:
    """Unit rows with a mean and a steep spectrum, as embeddings have; of kinds that differ."""
    world = np.random.default_rng([99, kind])
    rotation = np.linalg.qr(np.eye(n) + 0.1 * kind * world.normal(size=(n, n)) / n**0.5)[0]
    mean = np.random.default_rng(99).normal(size=n)
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(count, n))
    x = 0.3 * mean / np.linalg.norm(mean) + (z * 0.2 * 0.95 ** np.arange(n)) @ rotation.T
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def fitted() -> DecoyGenerator:
    return DecoyGenerator.fit(face_like(3000, seed=1))


def draw(generator: DecoyGenerator, count: int, *parts: str | int) -> Rows:
    return generator.draw(count, 1, stream=Keystream.seeded(*parts))[:, 0]


def test_decoys_are_unit_float32_rows(fitted: DecoyGenerator) -> None:
    decoys = fitted.draw(7, 5, stream=Keystream.fresh())
    assert decoys.shape == (7, 5, N)
    assert decoys.dtype == np.float32
    assert decoys.flags.c_contiguous
    norms = np.linalg.norm(decoys.astype(np.float64), axis=2)
    np.testing.assert_allclose(norms, 1, atol=1e-6)
    assert fitted.draw(0, 5, stream=Keystream.fresh()).shape == (0, 5, N)
    assert repr(fitted) == f"DecoyGenerator(n={N}, k={N}, id {fitted.source_id[:12]})"
    assert fitted.draw(5, 0, stream=Keystream.fresh()).shape == (5, 0, N)


def test_draws_are_a_function_of_the_stream_and_never_repeat(fitted: DecoyGenerator) -> None:
    first = draw(fitted, 5000, "a")  # more than one chunk
    assert np.array_equal(first, draw(fitted, 5000, "a"))
    both = np.concatenate([first, draw(fitted, 5000, "b")])
    assert len({row.tobytes() for row in both}) == 10_000


def test_decoys_have_the_mean_and_covariance_of_fresh_descriptors(fitted: DecoyGenerator) -> None:
    decoys, real = draw(fitted, 20000, "moments"), fitted.project(face_like(20000, seed=2))
    # 3,000 embeddings were fitted: their own mean is off by up to 0.02, their covariance by 5 % of
    # the largest variance; scaling the decoys to length 1 takes 7 % from the first axis.
    np.testing.assert_allclose(decoys.mean(axis=0), real.mean(axis=0), atol=0.02)
    covariance = np.cov(real, rowvar=False)
    largest = np.linalg.eigvalsh(covariance)[-1]
    difference = np.linalg.eigvalsh(np.cov(decoys, rowvar=False) - covariance)
    assert np.abs(difference).max() < 0.15 * largest


def test_embeddings_are_projected_on_the_leading_axes(fitted: DecoyGenerator) -> None:
    rows = face_like(500, seed=7)
    reduced = fitted.reduced(50)
    assert (reduced.n, reduced.k, fitted.k) == (N, 50, N)
    inside = rows.astype(np.float64) @ reduced.axes
    expected = inside / np.linalg.norm(inside, axis=1, keepdims=True)
    projected = reduced.project(rows)
    assert projected.dtype == np.float32
    np.testing.assert_allclose(projected, expected, atol=1e-6)
    # The leading axes hold the most variance that any so many directions hold.
    every = np.linalg.eigvalsh(np.cov(face_like(20000, seed=8), rowvar=False))[::-1]
    held = np.trace(np.cov(face_like(20000, seed=8) @ reduced.axes, rowvar=False))
    assert held == pytest.approx(every[:50].sum(), rel=0.01)
    # All axes together turn the space, and no distance changes.
    products = fitted.project(rows).astype(np.float64)
    np.testing.assert_allclose(products @ products.T, rows @ rows.T, atol=1e-5)


def test_a_reduced_generator_is_the_leading_part_of_the_whole(fitted: DecoyGenerator) -> None:
    reduced = fitted.reduced(50)
    np.testing.assert_allclose(reduced.covariance, fitted.covariance[:50, :50], atol=1e-6)
    assert fitted.reduced(N) is fitted
    assert reduced.reduced(20).source_id == fitted.reduced(20).source_id
    assert draw(reduced, 3, "few").shape == (3, 50)
    variances = np.diag(fitted.covariance)
    axes = fitted.axes_for(0.9)
    assert variances[:axes].sum() >= 0.9 * variances.sum() > variances[: axes - 1].sum()
    for wrong in (1, N + 1):
        with pytest.raises(DecoyError, match="axes"):
            fitted.reduced(wrong)
    with pytest.raises(DecoyError, match="51 were asked for"):
        reduced.reduced(51)


def test_what_has_no_part_along_the_axes_is_refused(fitted: DecoyGenerator) -> None:
    reduced = fitted.reduced(50)
    outside = fitted.axes[:, -1][None]
    with pytest.raises(InvalidEmbedding, match="no part along the axes"):
        reduced.project(outside)
    for wrong in (np.ones((1, N)), np.full((1, N), np.nan), np.eye(N + 1)[:1]):
        with pytest.raises(InvalidEmbedding):
            reduced.project(wrong)


def test_the_unit_axes_give_the_same_decoys(fitted: DecoyGenerator) -> None:
    plain = fitted.in_coordinates_of_embeddings()
    rows = face_like(10, seed=3)
    np.testing.assert_allclose(plain.project(rows), rows, atol=1e-6)
    turned = fitted.axes @ fitted.covariance @ fitted.axes.T
    np.testing.assert_allclose(plain.covariance, turned, atol=1e-7)
    np.testing.assert_allclose(plain.mean, fitted.axes @ fitted.mean, atol=1e-6)
    with pytest.raises(DecoyError, match="fewer axes"):
        fitted.reduced(50).in_coordinates_of_embeddings()


def test_an_adapted_generator_is_nearer_to_the_kind_of_the_sample() -> None:
    """Than one of the many alone, of the sample alone, and of both as they are."""
    many, few, unseen = (
        face_like(4000, seed=1),
        face_like(120, seed=2, kind=1),
        face_like(4000, seed=3, kind=1),
    )
    names = [str(number) for number in range(120)]

    def likelihood(generator: DecoyGenerator) -> float:
        """Mean log likelihood of people of the kind who are in no fit."""
        x = unseen.astype(np.float64) @ generator.axes - generator.mean
        whitened = np.linalg.solve(generator.root.astype(np.float64), x.T)
        return float(
            -np.log(np.diag(generator.root)).sum() - 0.5 * np.mean(np.sum(whitened**2, axis=0))
        )

    adapted = likelihood(DecoyGenerator.adapt(many, few, names))
    for rows in (many, few, np.concatenate([many, few])):
        assert adapted > likelihood(DecoyGenerator.fit(rows)) + 1


@pytest.mark.parametrize(
    ("like", "people", "words"),
    [
        (np.eye(N)[:50], 50, "100 or more embeddings"),
        (face_like(200, seed=2, n=40), 200, "cannot adapt"),
        (face_like(200, seed=2), 199, "do not fit"),
        (face_like(200, seed=2), 1, "50 or more people"),
        (2 * face_like(200, seed=2), 200, "norm 1"),
    ],
)
def test_a_sample_that_cannot_be_adapted_to_is_refused(like: Rows, people: int, words: str) -> None:
    names = ["one"] * len(like) if people == 1 else [str(number) for number in range(people)]
    with pytest.raises(TemplateError, match=words):
        DecoyGenerator.adapt(face_like(500, seed=1), like, names)


def test_the_classifier_is_that_of_scikit_learn() -> None:
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(900, 12))
    truth = rng.random(900) < 1 / (1 + np.exp(-rows @ rng.normal(size=12) + 1))
    found = separating_direction(rows, truth)
    # Both penalise half the squared weights by 100; theirs divides the loss by it.
    theirs = LogisticRegression(C=0.01, class_weight="balanced", tol=1e-10, max_iter=1000)
    np.testing.assert_allclose(found, theirs.fit(rows, truth).coef_[0], atol=1e-4)


@pytest.mark.parametrize(("count", "n"), [(100, 2), (100, 3), (120, 128), (400, 20)])
def test_few_descriptors_or_dimensions_are_enough_to_fit(count: int, n: int) -> None:
    x = np.random.default_rng(0).normal(size=(count, n))
    generator = DecoyGenerator.fit(x / np.linalg.norm(x, axis=1, keepdims=True))
    decoys = draw(generator, 50, "few")
    np.testing.assert_allclose(np.linalg.norm(decoys, axis=1), 1, atol=1e-5)
    assert DecoyGenerator.from_bytes(generator.to_bytes()).source_id == generator.source_id


@pytest.mark.parametrize(
    "rows",
    [
        np.ones((99, 4)) / 2,
        np.ones((200, 4)) / 2,
        np.ones((200, 4)),
        np.full((200, 4), np.nan),
        np.zeros((200, 4)),
        np.ones(200),
        np.ones((200, 1)),
    ],
)
def test_what_cannot_be_fitted_is_refused(rows: NDArray[np.float64]) -> None:
    with pytest.raises(TemplateError):
        DecoyGenerator.fit(rows)


def test_the_subject_has_no_say(fitted: DecoyGenerator) -> None:
    with pytest.raises(DecoyError, match=r"hybrid\+ needs a labelled decoy pool"):
        fitted.draw(1, 2, stream=Keystream.fresh(), unlike=[Attributes("Male", "White")])
    with pytest.raises(DecoyError, match="no sub-databases"):
        fitted.draw(1, 2, stream=Keystream.fresh(), sub_databases=16)


def test_a_file_keeps_the_fit_and_what_made_the_embeddings(tmp_path: Path) -> None:
    rows = face_like(200, seed=1, n=8)
    plain, made, other = (DecoyGenerator.fit(rows, made_with=m) for m in (None, MADE, "1" * 64))
    assert plain.source_id == DecoyGenerator.fit(rows.copy()).source_id
    assert len({plain.source_id, made.source_id, other.source_id}) == 3
    path = tmp_path / "decoys.veil"
    sealer = Sealer(MasterKeyring([bytes(32)]))
    for generator in (plain, made):
        generator.save(path)
        assert path.stat().st_mode & 0o777 == 0o600
        for loaded in (DecoyGenerator.load(path), load_source(path, sealer)):
            assert isinstance(loaded, DecoyGenerator)
            assert loaded.source_id == generator.source_id
            assert loaded.made_with == generator.made_with


def with_header(header: bytes, body: bytes = b"") -> bytes:
    return len(header).to_bytes(8, "little") + header + body


METADATA = b'"__metadata__":{"veilface":"{\\"format\\":\\"%s\\",\\"version\\":2}"}' % (
    GENERATOR_FORMAT.encode()
)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff" * 8,
        (2**63).to_bytes(8, "little") + b"{}",
        with_header(b"[" * 5000),
        with_header(b"{" + METADATA + b"}"),
        with_header(b'{"__metadata__":{"veilface":"[]"}}'),
        with_header(b"\xff\xfe"),
    ],
)
def test_hostile_headers_are_refused(data: bytes) -> None:
    with pytest.raises(DecoyError):
        DecoyGenerator.from_bytes(data)


@pytest.mark.parametrize("dtype", [np.complex64, np.float64])
def test_numbers_of_another_type_are_refused_before_they_are_cast(
    fitted: DecoyGenerator, dtype: type[np.generic]
) -> None:
    fields, arrays = container.decode(fitted.to_bytes(), what="x", max_bytes=MAX_GENERATOR_BYTES)
    data = container.encode(fields, {name: part.astype(dtype) for name, part in arrays.items()})  # type: ignore[arg-type]
    with pytest.raises(DecoyError, match="not float32"):
        DecoyGenerator.from_bytes(data)


def test_foreign_encodings_of_the_same_content_are_refused(fitted: DecoyGenerator) -> None:
    """One content has one id, so a padded header may not decode."""
    data = fitted.to_bytes()
    size = int.from_bytes(data[:8], "little")
    padded = (size + 8).to_bytes(8, "little") + data[8 : 8 + size] + b" " * 8 + data[8 + size :]
    with pytest.raises(DecoyError, match="canonical"):
        DecoyGenerator.from_bytes(padded)


def test_too_many_bytes_are_refused_before_they_are_read(tmp_path: Path) -> None:
    with pytest.raises(DecoyError, match="at most"):
        DecoyGenerator.from_bytes(bytes(MAX_GENERATOR_BYTES + 1))
    path = tmp_path / "huge"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(DecoyError, match="more than"):
        DecoyGenerator.load(path)


def parts(**changes: NDArray[np.floating]) -> dict[str, NDArray[np.float32]]:
    values: dict[str, NDArray[np.floating]] = {
        "axes": np.eye(N)[:, :70],
        "mean": np.zeros(70),
        "root": np.eye(70),
    }
    return {name: np.asarray(value, np.float32) for name, value in (values | changes).items()}


@pytest.mark.parametrize(
    "changes",
    [
        {"mean": np.full(70, np.nan)},
        {"mean": np.zeros(69)},
        {"mean": np.zeros((1, 70))},
        {"mean": np.full(70, 1e30)},
        {"axes": np.full((N, 70), np.inf)},
        {"axes": np.zeros((N, 70))},
        {"axes": np.eye(70)[:69]},
        {"axes": 2 * np.eye(N)[:, :70]},
        {"axes": np.eye(N)},
        {"root": np.eye(71)},
        {"root": np.eye(70) * 1e9},
        {"root": -np.eye(70)},
        {"root": np.eye(70) + np.eye(70, k=1)},
        {"root": np.zeros((70, 70))},
        # Decoys along a few axes hide nothing.
        {"root": np.diag([1.0] * 5 + [1e-3] * 65)},
    ],
)
def test_parts_out_of_range_are_refused(changes: dict[str, NDArray[np.floating]]) -> None:
    DecoyGenerator(**parts())
    with pytest.raises(DecoyError):
        DecoyGenerator(**parts(**changes))


def test_a_generator_of_nothing_says_so() -> None:
    """Parts in range whose samples have no direction: an error, not NaN."""
    degenerate = DecoyGenerator(np.eye(4), np.zeros(4), 1e-9 * np.eye(4))
    with pytest.raises(DecoyError, match="without a direction"):
        degenerate.draw(2, 2, stream=Keystream.fresh())


@pytest.mark.parametrize("value", [7, "", "a" * 63, "A" * 64, "g" * 64, "a" * 64 + "\n", ["a"]])
def test_a_hostile_made_with_is_refused(value: object) -> None:
    generator = DecoyGenerator.fit(face_like(200, seed=1, n=8), made_with=MADE)
    fields, arrays = container.decode(generator.to_bytes(), what="it", max_bytes=10**6)
    data = container.encode({**fields, "made_with": value}, arrays)  # type: ignore[dict-item]
    with pytest.raises(DecoyError, match="made_with must be 64"):
        DecoyGenerator.from_bytes(data)
    null = container.encode({**fields, "made_with": None}, arrays)  # type: ignore[dict-item]
    with pytest.raises(DecoyError, match="canonical"):  # absent is the one encoding
        DecoyGenerator.from_bytes(null)
    if isinstance(value, str):
        with pytest.raises(DecoyError, match="made_with must be 64"):
            DecoyGenerator(generator.axes, generator.mean, generator.root, made_with=value)
