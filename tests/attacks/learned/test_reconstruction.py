import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.learned import decoder
from attacks.learned.decoder import SIZE, Images, resized, train_decoder
from attacks.learned.reconstruction import reconstruct, score_images
from attacks.outcomes import CONTROL
from attacks.system import System

pytest.importorskip("torch")
pytest.importorskip("skimage")

CELLS = 8


def paint(descriptors: np.ndarray) -> Images:
    """A picture of 8 × 8 cells, each as bright as one of 64 numbers: what `embed` reads back."""
    cells = np.clip(127.5 + 400 * descriptors.reshape(-1, CELLS, CELLS), 0, 255)
    large = cells.repeat(SIZE // CELLS, axis=1).repeat(SIZE // CELLS, axis=2)
    return np.ascontiguousarray(np.repeat(large[..., None], 3, axis=3), dtype=np.uint8)


def embed(images: Images) -> np.ndarray:
    side = images.shape[1] // CELLS
    cells = images[..., 0].reshape(len(images), CELLS, side, CELLS, side).mean(axis=(2, 4))
    # The decoder is trained on mirror images too: what is read is the same for both.
    cells = (cells + cells[:, :, ::-1]) / 2
    rows = cells.reshape(len(images), -1) - 127.5
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9))


def symmetric(rows: np.ndarray) -> np.ndarray:
    cells = rows.reshape(-1, CELLS, CELLS)
    both = (cells + cells[:, :, ::-1]).reshape(len(rows), -1)
    return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True), dtype=np.float32)


@pytest.fixture
def mirrored(system: System) -> System:
    """The system with people whose descriptors are of mirror-symmetric pictures."""
    people = replace(
        system.victims,
        enrolled=symmetric(system.victims.enrolled),
        fresh=symmetric(system.victims.fresh),
    )
    return replace(system, victims=people)


@pytest.mark.long
def test_the_raw_descriptor_is_drawn_and_noise_is_not(
    mirrored: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoder, "_CHANNELS", (32, 16, 8, 8))  # pictures of 64 cells need no more
    rng = np.random.default_rng(0)
    faces = symmetric(rng.normal(size=(250, 64)))
    outcomes = reconstruct(
        mirrored,
        paint(faces),
        faces,
        paint(mirrored.victims.enrolled),
        embed=embed,
        guesses={"noise again": rng.normal(size=mirrored.victims.enrolled.shape)},
        seconds=1e9,
        epochs=10,
        seed=0,
    )
    rows = {each.variant: each for each in outcomes}
    assert list(rows) == ["raw embedding", "foot point", "noise again", "noise"]
    assert rows["raw embedding"].measured.value > 0.5
    assert rows["noise"].measured.value <= 0.15
    assert rows["noise again"].measured.value <= 0.15
    quality = [
        float(str(rows[name].details["psnr_mean_db"])) for name in ("raw embedding", "noise")
    ]
    assert quality[0] > quality[1] + 1
    assert not rows["noise"].judged
    assert rows["foot point"].judged


def test_a_decoder_that_draws_no_raw_embedding_proves_nothing(
    mirrored: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoder, "_CHANNELS", (8, 8, 8, 8))
    faces = mirrored.victims.enrolled
    blank = np.zeros((len(faces), SIZE, SIZE, 3), dtype=np.uint8)
    outcomes = reconstruct(
        mirrored, blank, faces, paint(faces), embed=embed, guesses={}, seconds=1e9, epochs=1, seed=0
    )
    assert [row.unjudged for row in outcomes] == [
        CONTROL,
        "it proves nothing, for its control, half of the raw embeddings drawn well enough to "
        "match, does not succeed either",
        CONTROL,
    ]


def test_scores_of_a_perfect_drawing_and_of_a_wrong_one(mirrored: System) -> None:
    fresh = mirrored.victims.enrolled
    photos = paint(fresh)
    perfect = score_images(photos, photos, fresh, embed=embed)
    np.testing.assert_allclose(perfect.ssim, 1.0)
    assert (perfect.psnr > 100).all()
    assert perfect.cosines.mean() > 0.99
    shifted = score_images(255 - photos, photos, fresh, embed=embed)
    difference = (255.0 - 2.0 * photos) ** 2
    expected = 10 * np.log10(255**2 / difference.mean(axis=(1, 2, 3)))
    np.testing.assert_allclose(shifted.psnr, expected)
    assert shifted.cosines.mean() < -0.9


def test_one_seed_draws_one_face(mirrored: System) -> None:
    faces = mirrored.victims.enrolled
    drawn = [
        train_decoder(paint(faces), faces, seconds=1e9, epochs=1, seed=3)(faces) for _ in range(2)
    ]
    assert drawn[0].shape == (len(faces), SIZE, SIZE, 3)
    assert drawn[0].dtype == np.uint8
    np.testing.assert_array_equal(drawn[0], drawn[1])


def test_resizing_keeps_the_mean() -> None:
    images = paint(np.random.default_rng(0).normal(size=(2, 64)) / 8)
    assert resized(images, SIZE) is images
    assert abs(resized(images, 32).mean() - images.mean()) < 1
    assert resized(images, 112).shape == (2, 112, 112, 3)


def test_what_does_not_fit_is_refused(mirrored: System) -> None:
    faces = mirrored.victims.enrolled
    options: dict[str, Any] = {"embed": embed, "guesses": {}, "seconds": 1, "seed": 0}
    with pytest.raises(AuditError, match="photo and a guess"):
        reconstruct(mirrored, paint(faces), faces, paint(faces)[:3], **options)
    with pytest.raises(AuditError, match="32 images"):
        train_decoder(paint(faces)[:8], faces[:8], seed=0)
    with pytest.raises(AuditError, match="uint8"):
        train_decoder(np.zeros((40, 8, 8)), faces, seed=0)


def test_without_the_extra_the_remedy_is_named(
    mirrored: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "skimage.metrics", None)
    faces = mirrored.victims.enrolled
    with pytest.raises(AuditError, match=r'pip install "veilface\[torch\]"'):
        reconstruct(
            mirrored, paint(faces), faces, paint(faces), embed=embed, guesses={}, seconds=1, seed=0
        )
