"""Noise on decoys and descriptors: how much, on both alike, and bound to the generator's id."""

import json

import numpy as np
import pytest

from attacks.privacy import AttackSetup, privacy_of
from attacks.second_order import second_moment, with_noise_moment, without_noise_moment
from templates.decoys import NOISE_ENERGY, DecoyGenerator
from templates.decoys.generator import GENERATOR_FORMAT
from templates.errors import DecoyError
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift, with_noise

N = 64
NOISE = NOISE_ENERGY / N


def faces(count: int, seed: int) -> np.ndarray:
    """Rows that hardly vary along the last quarter of the axes."""
    rng = np.random.default_rng(seed)
    scale = np.where(np.arange(N) < 3 * N // 4, 1.0, 1e-3)
    rows = rng.normal(size=(count, N)) * scale
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def generator() -> DecoyGenerator:
    return DecoyGenerator.fit(faces(600, 1), noise=NOISE)


def test_it_is_kept_and_named_by_the_id(generator: DecoyGenerator) -> None:
    read = DecoyGenerator.from_bytes(generator.to_bytes())
    assert read.noise == NOISE
    assert read.source_id == generator.source_id
    silent = DecoyGenerator(generator.statistics)
    assert silent.source_id != generator.source_id
    assert b"noise" not in silent.to_bytes()[:4096]


@pytest.mark.parametrize(
    "written", ["-1.0", "0.2", "nan", "inf", "1e-3", " 0.001", "x", 0.001, None]
)
def test_a_file_may_not_claim_any_noise(generator: DecoyGenerator, written: object) -> None:
    data = generator.to_bytes()
    # The header's JSON holds the fields as JSON in a text.
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    (key,) = header["__metadata__"]
    fields = json.loads(header["__metadata__"][key])
    assert fields["format"] == GENERATOR_FORMAT
    fields["noise"] = written
    header["__metadata__"][key] = json.dumps(fields, sort_keys=True, separators=(",", ":"))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with pytest.raises(DecoyError):
        DecoyGenerator.from_bytes(len(text).to_bytes(8, "little") + text + data[8 + size :])


def test_decoys_and_descriptors_get_the_same(generator: DecoyGenerator) -> None:
    silent = DecoyGenerator(generator.statistics)
    quiet = slice(3 * N // 4, N)
    drawn = []
    for source in (silent, generator):
        with Keystream.seeded("noise") as stream:
            drawn.append(source.draw(4000, 1, stream=stream)[:, 0])
    points = faces(4000, 2).astype(np.float64)
    with Keystream.seeded("noise of descriptors") as stream:
        moved = with_noise(points, Strategy.ADVERSARIAL, generator, stream)
        assert with_noise(points, Strategy.ADVERSARIAL, silent, stream) is points
    assert np.allclose(np.linalg.norm(moved, axis=1), 1)
    expected = NOISE / (1 + NOISE_ENERGY)
    for rows in (drawn[1], moved):
        assert np.mean(rows[:, quiet] ** 2) == pytest.approx(expected, rel=0.05)
    assert np.mean(drawn[0][:, quiet] ** 2) < expected / 100
    cosines = np.einsum("ij,ij->i", points, moved)
    assert np.mean(cosines) == pytest.approx(1 / np.sqrt(1 + NOISE_ENERGY), abs=0.01)


def test_two_lifts_of_one_descriptor_no_longer_meet_in_it(generator: DecoyGenerator) -> None:
    one = faces(1, 3)
    for source, meets in ((DecoyGenerator(generator.statistics), True), (generator, False)):
        with Keystream.seeded("lifts") as stream:
            batch = lift(one, strategy=Strategy.ADVERSARIAL, m=8, source=source, stream=stream)
        template = batch[0]
        offset = one[0] - template.foot
        outside = np.linalg.norm(offset - template.basis.T @ (template.basis @ offset))
        assert (float(outside) < 1e-5) is meets


def test_it_takes_from_the_attacker_what_quiet_axes_told(generator: DecoyGenerator) -> None:
    """Decoys that vary otherwise along axes where faces hardly do."""
    rng = np.random.default_rng(4)
    wider = faces(600, 1) + rng.normal(scale=3e-4, size=(600, N))
    wider = (wider / np.linalg.norm(wider, axis=1, keepdims=True)).astype(np.float32)
    people = faces(200, 5)
    opened = {}
    for noise in (0.0, NOISE):
        setup = AttackSetup.of(
            people, people, faces(3000, 6), DecoyGenerator.fit(wider, noise=noise), match_cosine=0.7
        )
        opened[noise] = privacy_of(setup, strategy=Strategy.ADVERSARIAL, m=12).strongest.found.value
    assert opened[NOISE] < opened[0.0] / 2


def test_the_attacker_knows_what_the_noise_does_to_second_moments(
    generator: DecoyGenerator,
) -> None:
    points = faces(20_000, 7).astype(np.float64)
    with Keystream.seeded("moments") as stream:
        seen = second_moment(with_noise(points, Strategy.ADVERSARIAL, generator, stream))
    known = with_noise_moment(second_moment(points), NOISE)
    assert np.abs(seen - known).max() < 0.05 * known.max()
    assert np.trace(known) == pytest.approx(1)
    back = without_noise_moment(known, NOISE)
    assert np.allclose(back, second_moment(points), atol=1e-12)
