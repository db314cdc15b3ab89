from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from models.decoding import decode_image
from models.demo import build_demo_pack
from models.extraction import Photo
from models.pack import ModelPack
from models.synthetic import draw_face, encode_photo
from verify.evaluation.embedding import FileEmbedder, PackEmbedder, are_aligned
from verify.evaluation.embeddings_file import EmbeddingsFile
from verify.evaluation.verification_set import VerificationSet, contiguous_folds


@contextmanager
def no_progress(_: str, __: int) -> Iterator[Callable[[int], None]]:
    yield lambda _: None


BROKEN = b"\x89PNG\r\n\x1a\nnot a photo"
FACES = [encode_photo(draw_face(number)) for number in range(6)]


def verification_set(pictures: Sequence[Photo]) -> VerificationSet:
    """Every picture in one pair, genuine and impostor in turn."""
    first = np.arange(0, len(pictures) - 1, dtype=np.int64)
    return VerificationSet(
        name="made",
        kind="pairs",
        pictures=tuple(pictures),
        first=first,
        second=first + 1,
        same=first % 2 == 0,
        folds=contiguous_folds(len(first)),
    )


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> ModelPack:
    return ModelPack.load(build_demo_pack(tmp_path_factory.mktemp("pack")), threads=1)


@pytest.fixture
def mixed(tmp_path: Path) -> VerificationSet:
    """Photos in files and in memory, copies of them, two copies of a broken one, and none."""
    for number in (0, 1):
        (tmp_path / f"{number}.png").write_bytes(FACES[number])
    return verification_set(
        [
            Photo("Ann/0.png", tmp_path / "0.png"),
            Photo("broken", BROKEN),
            Photo("copy of 0", FACES[0]),
            Photo("Bob/1.png", tmp_path / "1.png"),
            Photo("broken too", BROKEN),
            Photo("2", FACES[2]),
            Photo("copy of 2", FACES[2]),
            Photo("Cas/3.png", tmp_path / "absent.png"),
            Photo("Cas/4.png", tmp_path / "absent too.png"),
        ]
    )


def test_every_picture_has_a_row_or_a_reason(mixed: VerificationSet, pack: ModelPack) -> None:
    seen: list[int] = []

    @contextmanager
    def progress(_: str, total: int) -> Iterator[Callable[[int], None]]:
        seen.append(total)
        yield seen.append

    embedder = PackEmbedder(pack, {}, aligned=True)
    found = embedder.embed(mixed, cache=None, progress=progress)
    crops = [decode_image(FACES[number]) for number in (0, 0, 1, 2, 2)]
    alone = np.concatenate([pack.embed(crop[None]) for crop in crops])
    np.testing.assert_array_equal(found.rows, [0, -1, 1, 2, -1, 3, 4, -1, -1])
    np.testing.assert_allclose(found.embeddings, alone, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.embeddings, axis=1), 1, atol=1e-6)
    assert [(failure.path.as_posix(), failure.code) for failure in found.failures] == [
        ("broken", "unsupported_image"),
        ("broken too", "unsupported_image"),
        ("Cas/3.png", "unreadable_file"),
        ("Cas/4.png", "unreadable_file"),
    ]
    assert seen == [9, 9]


def test_photos_that_a_file_of_embeddings_lacks_failed_to_acquire() -> None:
    rows = np.eye(4, dtype=np.float32)
    embeddings = EmbeddingsFile(("c.png", "x.png", "a.png", "y.png"), rows, "0" * 64)
    pairs = verification_set([Photo(f"{name}.png", b"") for name in "abcd"])
    embedder = FileEmbedder(embeddings, "own.npz")
    found = embedder.embed(pairs, cache=None, progress=no_progress)
    np.testing.assert_array_equal(found.rows, [0, -1, 1, -1])
    np.testing.assert_array_equal(found.embeddings, rows[[2, 0]])
    assert [(str(each.path), each.code) for each in found.failures] == [
        ("b.png", "not_in_file"),
        ("d.png", "not_in_file"),
    ]


def test_photos_are_aligned_where_all_have_the_size_of_the_embedder(tmp_path: Path) -> None:
    small = [Photo(f"{i}", face) for i, face in enumerate(FACES)]
    photo = Photo("photo", encode_photo(draw_face(1, size=250)))
    broken = Photo("broken", BROKEN)
    absent = Photo("absent", tmp_path / "absent.png")
    assert are_aligned(verification_set(small), 112)
    assert not are_aligned(verification_set(small), 128)
    assert not are_aligned(verification_set([*small, photo]), 112)
    assert are_aligned(verification_set([broken, absent, *small]), 112)
    assert not are_aligned(verification_set([broken, absent]), 112)
