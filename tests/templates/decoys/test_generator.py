"""The generator of decoys that belong to nobody."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import ks_2samp, multivariate_normal
from sklearn.mixture import GaussianMixture

from templates.decoys import (
    Attributes,
    DecoyGenerator,
    DecoySource,
    container,
    load_source,
)
from templates.decoys.generator import GENERATOR_FORMAT, MAX_GENERATOR_BYTES
from templates.decoys.mixture import fit_mixture
from templates.decoys.statistics import (
    DescriptorStatistics,
    band_edges,
    feature_count,
    leading_axes,
)
from templates.errors import DecoyError
from templates.keys.randomness import Keystream
from templates.keys.sealing import KeyringSealer, MasterKeyring

N = 80
MADE = "5a" * 32
Rows = NDArray[np.float32]


def face_like(count: int, seed: int, n: int = N) -> Rows:
    """Unit rows as descriptors are: two crowds, a steep spectrum, and blur.

    The blur of a face raises the energy on all its minor axes at once, as a random scale.
    """
    world = np.random.default_rng(99)
    rotation = np.linalg.qr(world.normal(size=(n, n)))[0]
    mean = world.normal(size=n)
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(count, n))
    z[:, 0] = 0.4 * z[:, 0] + np.where(rng.random(count) < 0.3, -2.0, 0.86)
    z[:, 48:] *= np.exp(0.5 * rng.normal(size=(count, 1)))
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
    assert fitted.draw(5, 0, stream=Keystream.fresh()).shape == (5, 0, N)
    with pytest.raises(DecoyError, match="negative"):
        fitted.draw(1, -1, stream=Keystream.fresh())


def test_no_decoy_comes_twice(fitted: DecoyGenerator) -> None:
    decoys = draw(fitted, 5000, "fresh")  # more than one chunk
    assert len({row.tobytes() for row in decoys}) == 5000


def test_draws_are_a_function_of_the_stream(fitted: DecoyGenerator) -> None:
    first = draw(fitted, 50, "a")
    assert np.array_equal(first, draw(fitted, 50, "a"))
    assert not np.isclose(first, draw(fitted, 50, "b")).all(axis=1).any()


def test_decoys_have_the_mean_and_covariance_of_fresh_descriptors(fitted: DecoyGenerator) -> None:
    decoys, real = draw(fitted, 20000, "moments"), face_like(20000, seed=2)
    # 3,000 descriptors were fitted: their own mean is off by up to 0.02, their covariance by
    # 3 % of the largest variance; normalising the decoys takes 4 % from the first axis.
    np.testing.assert_allclose(decoys.mean(axis=0), real.mean(axis=0), atol=0.02)
    covariance = np.cov(real, rowvar=False)
    largest = np.linalg.eigvalsh(covariance)[-1]
    difference = np.linalg.eigvalsh(np.cov(decoys, rowvar=False) - covariance)
    assert np.abs(difference).max() < 0.08 * largest


def test_decoys_follow_the_shape_that_a_gaussian_misses(fitted: DecoyGenerator) -> None:
    """Two crowds on the first axis, and energy on minor axes that varies more than chi-square's.

    A Gaussian of the same mean and covariance is the control: the same test refuses it.
    """
    real, decoys = face_like(6000, seed=3), draw(fitted, 6000, "shape")
    rng = np.random.default_rng(4)
    gaussian = rng.multivariate_normal(real.mean(axis=0), np.cov(real, rowvar=False), 6000)
    gaussian /= np.linalg.norm(gaussian, axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.cov(face_like(20000, seed=5), rowvar=False))

    def first_axis(x: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.asarray(x @ vectors[:, -1], np.float64)

    def minor_energy(x: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.asarray(np.log(((x @ vectors[:, :30]) ** 2).sum(axis=1)), np.float64)

    for statistic in (first_axis, minor_energy):
        apart = ks_2samp(statistic(real), statistic(decoys)).statistic
        control = ks_2samp(statistic(real), statistic(gaussian)).statistic
        assert control > 0.12
        assert apart < 0.06


def test_fitting_is_deterministic_and_sees_the_data() -> None:
    rows = face_like(600, seed=1)
    first = DecoyGenerator.fit(rows)
    assert DecoyGenerator.fit(rows.copy()).source_id == first.source_id
    assert DecoyGenerator.fit(face_like(600, seed=2)).source_id != first.source_id


@pytest.mark.parametrize(("count", "n"), [(100, 2), (100, 3), (120, 128), (400, 20)])
def test_few_descriptors_or_dimensions_are_enough_to_fit(count: int, n: int) -> None:
    x = np.random.default_rng(0).normal(size=(count, n))
    generator = DecoyGenerator.fit(x / np.linalg.norm(x, axis=1, keepdims=True))
    decoys = draw(generator, 50, "few")
    np.testing.assert_allclose(np.linalg.norm(decoys, axis=1), 1, atol=1e-5)
    assert DecoyGenerator.from_bytes(generator.to_bytes()).source_id == generator.source_id


def test_descriptors_in_a_subspace_give_decoys_in_it() -> None:
    """Below 64 numbers; with more, a small subspace is refused (see below)."""
    plane = np.linalg.qr(np.random.default_rng(0).normal(size=(32, 8)))[0]
    x = np.random.default_rng(1).normal(size=(500, 8)) @ plane.T
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    decoys = draw(DecoyGenerator.fit(x), 100, "plane")
    outside = decoys - decoys @ plane @ plane.T
    assert np.abs(outside).max() < 1e-5


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
    with pytest.raises(DecoyError):
        DecoyGenerator.fit(rows)


def test_the_subject_has_no_say(fitted: DecoyGenerator) -> None:
    with pytest.raises(DecoyError, match=r"hybrid\+ needs a labelled decoy pool"):
        fitted.draw(1, 2, stream=Keystream.fresh(), unlike=[Attributes("Male", "White")])
    with pytest.raises(DecoyError, match="no sub-databases"):
        fitted.draw(1, 2, stream=Keystream.fresh(), sub_databases=16)


def test_bytes_round_trip(fitted: DecoyGenerator) -> None:
    data = fitted.to_bytes()
    again = DecoyGenerator.from_bytes(data)
    assert isinstance(again, DecoySource)
    assert again.to_bytes() == data
    assert again.source_id == fitted.source_id
    assert again.n == N
    assert np.array_equal(draw(again, 20, "same"), draw(fitted, 20, "same"))


def test_save_and_load(fitted: DecoyGenerator, tmp_path: Path) -> None:
    path = tmp_path / "decoys.veil"
    fitted.save(path)
    assert path.stat().st_mode & 0o777 == 0o600
    assert DecoyGenerator.load(path).source_id == fitted.source_id
    sealer = KeyringSealer(MasterKeyring.create(tmp_path / "master.key"))
    loaded = load_source(path, sealer)
    assert isinstance(loaded, DecoyGenerator)
    assert loaded.source_id == fitted.source_id


def test_the_id_is_the_same_in_another_process(fitted: DecoyGenerator) -> None:
    """The writer's metadata map is unordered and seeded by process."""
    program = (
        "import sys; from templates.decoys import DecoyGenerator as G; "
        "print(G.from_bytes(G.from_bytes(sys.stdin.buffer.read()).to_bytes()).source_id)"
    )
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", program],
            input=fitted.to_bytes(),
            capture_output=True,
            check=True,
        )
        assert done.stdout.decode().strip() == fitted.source_id


def test_one_component_is_what_scikit_learn_fits() -> None:
    """Fewer than 1,000 descriptors are one component, in closed form."""
    features = np.random.default_rng(3).normal(size=(999, 7)) * np.linspace(0.1, 3, 7) + 0.5
    expected = GaussianMixture(1, reg_covar=1e-5).fit(features)
    weights, centres, covariances = fit_mixture(features, 1)
    assert weights.tolist() == [1.0]
    np.testing.assert_allclose(centres, expected.means_)
    np.testing.assert_allclose(covariances, expected.covariances_, rtol=1e-9, atol=1e-12)


def test_several_components_are_as_likely_as_those_of_scikit_learn() -> None:
    """Three crowds that overlap: the likelihood of rows that had no part in the fit."""
    rng = np.random.default_rng(4)
    centres = np.array([[0.0] * 5, [3.0, 0, 0, 0, 0], [0, 2.5, 0, 0, 0]])
    spreads = np.array([[1.0, 1, 1, 0.1, 0.1], [0.5, 2, 1, 0.1, 0.3], [1, 1, 0.2, 0.2, 0.1]])
    crowd = rng.choice(3, size=6000, p=[0.5, 0.3, 0.2])
    rows = centres[crowd] + spreads[crowd] * rng.normal(size=(6000, 5))
    fitted = fit_mixture(rows[:3000], 3)
    weights, means, covariances = fitted
    assert weights.sum() == pytest.approx(1.0)
    densities = [
        weight * multivariate_normal(mean, covariance).pdf(rows[3000:])
        for weight, mean, covariance in zip(weights, means, covariances, strict=True)
    ]
    ours = float(np.log(np.sum(densities, axis=0)).mean())
    theirs = GaussianMixture(3, reg_covar=1e-5, n_init=3, random_state=0).fit(rows[:3000])
    assert ours == pytest.approx(theirs.score(rows[3000:]), abs=0.01)
    again = fit_mixture(rows[:3000], 3)
    assert all(np.array_equal(one, other) for one, other in zip(fitted, again, strict=True))


def test_every_single_byte_flip_is_refused_or_gives_a_working_generator() -> None:
    generator = DecoyGenerator.fit(face_like(200, seed=1, n=4))
    data = generator.to_bytes()
    header = 8 + int.from_bytes(data[:8], "little")
    accepted = 0
    for position in range(len(data)):
        broken = bytearray(data)
        broken[position] ^= 0xFF
        try:
            other = DecoyGenerator.from_bytes(bytes(broken))
        except DecoyError:
            continue
        assert position >= header
        assert other.source_id != generator.source_id
        assert other.to_bytes() == bytes(broken)
        accepted += 1
    assert accepted > 0


@given(st.binary(max_size=400))
@settings(max_examples=200)
def test_noise_is_refused(data: bytes) -> None:
    with pytest.raises(DecoyError):
        DecoyGenerator.from_bytes(data)


@given(cut=st.floats(0, 1, exclude_max=True), tail=st.binary(max_size=20))
@settings(max_examples=100)
def test_truncated_or_longer_bytes_are_refused(cut: float, tail: bytes) -> None:
    data = DecoyGenerator.fit(face_like(200, seed=1, n=4)).to_bytes()
    with pytest.raises(DecoyError):
        DecoyGenerator.from_bytes(data[: int(cut * len(data))] + tail)
    with pytest.raises(DecoyError):
        DecoyGenerator.from_bytes(data + b"\0" + tail)


def with_header(header: bytes, body: bytes = b"") -> bytes:
    return len(header).to_bytes(8, "little") + header + body


METADATA = b'"__metadata__":{"veilface":"{\\"format\\":\\"%s\\",\\"version\\":1}"}' % (
    GENERATOR_FORMAT.encode()
)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0" * 8,
        b"\xff" * 8,
        (2**63).to_bytes(8, "little") + b"{}",
        with_header(b"{}"),
        with_header(b"[" * 5000),
        with_header(b"{" + METADATA + b"}"),
        with_header(b'{"__metadata__":{"veilface":"[]"}}'),
        with_header(b'{"__metadata__":[]}'),
        with_header(b"null"),
        with_header(b"\xff\xfe"),
        # Shapes and offsets that would allocate, overflow or lie outside the file.
        *(
            with_header(
                b"{" + METADATA + b',"mean":{"dtype":"F32","shape":%s,"data_offsets":%s}}' % pair,
                bytes(16),
            )
            for pair in (
                (b"[4000000000]", b"[0,16000000000]"),
                (b"[-4]", b"[0,16]"),
                (b"[4]", b"[16,0]"),
                (b"[4]", b"[-16,0]"),
                (b"[4.0]", b"[0,16]"),
                (b"[true]", b"[0,4]"),
                (b"[0]", b"[0,0]"),
                (b"4", b"[0,16]"),
                (b"[4]", b"[0]"),
                (b"[1,1,1,1,4]", b"[0,16]"),
                (b"[99999999999999999999999]", b"[0,16]"),
            )
        ),
    ],
)
def test_hostile_headers_are_refused(data: bytes) -> None:
    with pytest.raises(DecoyError):
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
    with pytest.raises(DecoyError, match="at most"):
        DecoyGenerator.load(path)


def parts(**changes: NDArray[np.floating]) -> dict[str, NDArray[np.float32]]:
    q = feature_count(N)
    values: dict[str, NDArray[np.floating]] = {
        "mean": np.zeros(N),
        "axes": np.eye(N),
        "weights": np.array([0.5, 0.5]),
        "centres": np.zeros((2, q)),
        "spreads": np.tile(np.eye(q), (2, 1, 1)),
    }
    return {name: np.asarray(value, np.float32) for name, value in (values | changes).items()}


@pytest.mark.parametrize(
    "changes",
    [
        {"mean": np.full(N, np.nan)},
        {"mean": np.zeros(1)},
        {"mean": np.zeros((1, N))},
        {"mean": np.full(N, 1e30)},
        {"axes": np.full((N, N), np.inf)},
        {"axes": np.zeros((N, N))},
        {"axes": np.eye(N + 1)},
        {"weights": np.array([0.5, 0.6])},
        {"weights": np.array([1.5, -0.5])},
        {"weights": np.array([])},
        {"weights": np.array([1.0])},
        {"centres": np.full((2, feature_count(N)), 50.0)},
        {"centres": np.zeros((2, 3))},
        {"spreads": np.full((2, feature_count(N), feature_count(N)), 1e9)},
    ],
)
def test_statistics_out_of_range_are_refused(changes: dict[str, NDArray[np.floating]]) -> None:
    DescriptorStatistics(**parts())
    with pytest.raises(DecoyError):
        DescriptorStatistics(**parts(**changes))


def test_a_generator_of_nothing_says_so() -> None:
    """Statistics in range whose samples have no direction: an error, not NaN."""
    axes = np.zeros((32, 32))
    axes[0, 0] = 1.0
    q = feature_count(32)
    degenerate = DecoyGenerator(
        DescriptorStatistics(
            mean=np.zeros(32, np.float32),
            axes=axes.astype(np.float32),
            weights=np.ones(1, np.float32),
            centres=np.zeros((1, q), np.float32),
            spreads=np.zeros((1, q, q), np.float32),
        )
    )
    with pytest.raises(DecoyError, match="without a direction"):
        degenerate.draw(2, 2, stream=Keystream.fresh())


def few_axes(count: int) -> NDArray[np.float64]:
    return np.diag((np.arange(N) < count).astype(np.float64))


def test_decoys_of_few_dimensions_are_refused() -> None:
    """They leave the hidden descriptor the one direction outside their subspace."""
    with pytest.raises(DecoyError, match=r"over 9 of 80 dimensions.*at least 10"):
        DescriptorStatistics(**parts(axes=few_axes(9)))
    assert DescriptorStatistics(**parts(axes=few_axes(11))).participation > 10
    x = np.random.default_rng(1).normal(size=(500, 8)) @ np.eye(N)[:8]
    with pytest.raises(DecoyError, match="hide nothing"):
        DecoyGenerator.fit(x / np.linalg.norm(x, axis=1, keepdims=True))


def test_hiding_the_few_dimensions_in_the_mixture_or_in_parallel_axes_is_refused() -> None:
    q = feature_count(N)
    quiet = np.zeros((2, q))
    quiet[:, leading_axes(N) :] = -9.0
    loud = np.tile(np.diag([30.0] * 2 + [1.0] * (q - 2)), (2, 1, 1))
    with pytest.raises(DecoyError, match="hide nothing"):
        DescriptorStatistics(**parts(centres=quiet, spreads=loud))
    parallel = np.zeros((N, N))
    parallel[:, 0] = 1.0
    with pytest.raises(DecoyError, match="not orthogonal"):
        DescriptorStatistics(**parts(axes=parallel))


def test_the_participation_ratio_is_that_of_what_is_drawn(fitted: DecoyGenerator) -> None:
    """Estimated from decoys: their deviations along the axes, without any formula of the model."""
    axes = fitted.statistics.axes.astype(np.float64)
    units = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    decoys = draw(fitted, 20000, "participation")
    sigma = np.std(decoys @ units.T, axis=0)
    assert fitted.statistics.participation == pytest.approx(
        sigma.sum() ** 2 / (sigma**2).sum(), rel=0.05
    )


def test_what_made_the_descriptors_is_part_of_the_file_and_of_its_id(tmp_path: Path) -> None:
    rows = face_like(200, seed=1, n=8)
    plain, made, other = (DecoyGenerator.fit(rows, made_with=m) for m in (None, MADE, "1" * 64))
    assert (plain.made_with, made.made_with) == (None, MADE)
    assert len({plain.source_id, made.source_id, other.source_id}) == 3
    made.save(tmp_path / "g")
    loaded = DecoyGenerator.load(tmp_path / "g")
    assert loaded.made_with == MADE
    assert loaded.source_id == made.source_id
    assert DecoyGenerator.from_bytes(plain.to_bytes()).made_with is None
    assert np.array_equal(draw(plain, 5, "x"), draw(made, 5, "x"))


@pytest.mark.parametrize(
    "value", [None, 7, "", "a" * 63, "A" * 64, "g" * 64, "a" * 64 + "\n", ["a"]]
)
def test_a_hostile_made_with_is_refused(value: object) -> None:
    """Null among them: absent and null would be two encodings of one content."""
    generator = DecoyGenerator.fit(face_like(200, seed=1, n=8), made_with=MADE)
    fields, arrays = container.decode(generator.to_bytes(), what="it", max_bytes=10**6)
    data = container.encode({**fields, "made_with": value}, arrays)  # type: ignore[dict-item]
    with pytest.raises(DecoyError, match="made_with must be 64"):
        DecoyGenerator.from_bytes(data)
    if isinstance(value, str):
        with pytest.raises(DecoyError, match="made_with must be 64"):
            DecoyGenerator(generator.statistics, made_with=value)


@given(n=st.integers(2, 4096))
@settings(max_examples=100)
def test_bands_partition_the_minor_axes(n: int) -> None:
    edges = band_edges(n)
    assert edges[0] == leading_axes(n) >= 1
    assert edges[-1] == n
    assert (np.diff(edges) >= 1).all()
    assert n < 64 or (np.diff(edges) <= 48).all()


def test_statistics_and_generator_show_no_number(fitted: DecoyGenerator) -> None:
    assert repr(fitted) == f"DecoyGenerator(n={N}, id {fitted.source_id[:12]})"
    assert repr(fitted.statistics) == f"DescriptorStatistics(n={N}, 4 components)"
