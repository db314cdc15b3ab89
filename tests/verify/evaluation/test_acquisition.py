from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import LocalCluster

from models.cache import EmbeddingCache
from models.decoding import decode_image
from models.demo import build_demo_pack
from models.extraction import Extraction, Extractor
from models.pack import ModelPack
from models.synthetic import draw_face, encode_photo
from verify.evaluation import acquisition
from verify.evaluation.acquisition import (
    Acquired,
    PackSource,
    acquire,
    are_aligned,
    digest_of_pictures,
    digests,
    from_file,
)
from verify.evaluation.backends import Backend, BackendError
from verify.evaluation.embeddings_file import EmbeddingsFile
from verify.evaluation.verification_set import (
    Picture,
    PictureBytes,
    PictureFile,
    VerificationSet,
    contiguous_folds,
)

BROKEN = b"\x89PNG\r\n\x1a\nnot a photo"
FACES = [encode_photo(draw_face(number)) for number in range(6)]
LOCAL = Backend(None, 1)
HERE = Backend("this process", 1)


def verification_set(pictures: Sequence[Picture]) -> VerificationSet:
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
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_demo_pack(tmp_path_factory.mktemp("pack"))


@pytest.fixture(scope="module")
def pack(folder: Path) -> ModelPack:
    return ModelPack.load(folder, threads=1)


@pytest.fixture
def mixed(tmp_path: Path) -> VerificationSet:
    """Photos in files and in memory, copies of them, two copies of a broken one, and none."""
    for number in (0, 1):
        (tmp_path / f"{number}.png").write_bytes(FACES[number])
    return verification_set(
        [
            PictureFile("Ann/0.png", tmp_path / "0.png"),
            PictureBytes("broken", BROKEN),
            PictureBytes("copy of 0", FACES[0]),
            PictureFile("Bob/1.png", tmp_path / "1.png"),
            PictureBytes("broken too", BROKEN),
            PictureBytes("2", FACES[2]),
            PictureBytes("copy of 2", FACES[2]),
            PictureFile("Cas/3.png", tmp_path / "absent.png"),
            PictureFile("Cas/4.png", tmp_path / "absent too.png"),
        ]
    )


def source_of(pack: ModelPack, folder: Path, /, **changed: object) -> PackSource:
    facts: dict[str, object] = {
        "folder": folder,
        "embedder_sha256": pack.info.embedder_sha256,
        "providers": ("CPUExecutionProvider",),
        "threads": 1,
        "flip": False,
        "aligned": True,
    }
    return PackSource(**(facts | changed))  # type: ignore[arg-type]


def acquired(
    pairs: VerificationSet,
    pack: ModelPack,
    source: PackSource,
    *,
    backend: Backend = LOCAL,
    cache: EmbeddingCache | None = None,
    seen: list[int] | None = None,
) -> Acquired:
    return acquire(
        pairs,
        digests(pairs),
        pack,
        source,
        cache=cache,
        backend=backend,
        progress=([] if seen is None else seen).append,
    )


def check_mixed(found: Acquired, pack: ModelPack) -> None:
    crops = [decode_image(FACES[number]) for number in (0, 1, 2)]
    alone = np.concatenate([pack.embed(crop[None]) for crop in crops])
    np.testing.assert_array_equal(found.rows, [0, -1, 0, 1, -1, 2, 2, -1, -1])
    np.testing.assert_allclose(found.descriptors, alone, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-6)
    names = [failure.path.as_posix() for failure in found.failures]
    assert names == ["broken", "broken too", "Cas/3.png", "Cas/4.png"]
    assert [failure.code for failure in found.failures[:2]] == ["unsupported_image"] * 2


def test_every_picture_has_a_row_or_a_reason(
    mixed: VerificationSet, pack: ModelPack, folder: Path
) -> None:
    seen: list[int] = []
    found = acquired(mixed, pack, source_of(pack, folder), seen=seen)
    check_mixed(found, pack)
    assert [failure.code for failure in found.failures[2:]] == ["unreadable_file"] * 2
    # Equal pictures are worked on once, and those that cannot be read not at all.
    assert seen == [5, 4]


def test_equal_pictures_are_embedded_once(
    pack: ModelPack, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[int] = []
    plain = ModelPack.embed

    def counted(self: ModelPack, crops: np.ndarray) -> np.ndarray:
        given.append(len(crops))
        return plain(self, crops)

    monkeypatch.setattr(ModelPack, "embed", counted)
    # Copies far apart, so that they would be in different chunks.
    monkeypatch.setattr(acquisition, "CHUNK", 2)
    monkeypatch.setattr("models.extraction.CHUNK", 2)
    pairs = verification_set([PictureBytes(f"{i}", FACES[i % 3]) for i in range(12)])
    found = acquired(pairs, pack, source_of(pack, folder))
    assert sum(given) == 3
    np.testing.assert_array_equal(found.rows, np.arange(12) % 3)


def test_a_cache_serves_the_second_call(
    mixed: VerificationSet, pack: ModelPack, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = EmbeddingCache()
    source = source_of(pack, folder)
    first = acquired(mixed, pack, source, cache=cache)
    assert len(cache) == 3

    def refused(self: ModelPack, crops: np.ndarray) -> np.ndarray:
        raise AssertionError("embedded again")

    monkeypatch.setattr(ModelPack, "embed", refused)
    second = acquired(mixed, pack, source, cache=cache)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    np.testing.assert_array_equal(first.rows, second.rows)
    assert first.failures == second.failures
    with pytest.raises(AssertionError, match="embedded again"):
        acquired(mixed, pack, source)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Backend]:
    with LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=":0",
        local_directory=str(tmp_path_factory.mktemp("workers")),
    ) as running:
        yield Backend.parse(running.scheduler_address.replace("tcp", "dask"), jobs=1)


def backwards(
    backend: Backend, function: Callable[..., Any], shared: object, items: Iterable[object]
) -> Iterator[tuple[int, Any]]:
    yield from reversed([(i, function(shared, item)) for i, item in enumerate(items)])


# A cluster takes ten seconds of the processor; `test_backends.py` has one in `make test`.
@pytest.fixture(params=["here", pytest.param("cluster", marks=pytest.mark.long)])
def elsewhere(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Backend:
    """A cluster; or the same work in this process, the last first."""
    if request.param == "cluster":
        cluster: Backend = request.getfixturevalue("cluster")
        return cluster
    monkeypatch.setattr(acquisition, "spread", backwards)
    return HERE


def test_a_cluster_gives_the_same_descriptors(
    mixed: VerificationSet,
    pack: ModelPack,
    folder: Path,
    elsewhere: Backend,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Several chunks, which are ready in any order.
    monkeypatch.setattr(acquisition, "CHUNK", 2)
    monkeypatch.setattr("models.extraction.CHUNK", 2)
    more = [PictureBytes(f"more {number}", face) for number, face in enumerate(FACES)]
    pairs = verification_set([*mixed.pictures, *more])
    here = acquired(pairs, pack, source_of(pack, folder))
    seen: list[int] = []
    with monkeypatch.context() as inside:
        if elsewhere != HERE:  # Workers are processes of their own: this one embeds nothing.
            inside.setattr(ModelPack, "embed", None)
        there = acquired(pairs, pack, source_of(pack, folder), backend=elsewhere, seen=seen)
    np.testing.assert_array_equal(there.rows, here.rows)
    np.testing.assert_array_equal(there.descriptors, here.descriptors)
    assert there.failures == here.failures
    assert sum(seen) == len(pairs.pictures)
    check_mixed(acquired(mixed, pack, source_of(pack, folder), backend=elsewhere), pack)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"folder": Path("/absent/pack")}, "does not find the pack .*same path there"),
        ({"embedder_sha256": "0" * 64}, "another embedder in the pack"),
    ],
)
def test_a_worker_without_the_pack_is_named(
    pack: ModelPack, folder: Path, elsewhere: Backend, changed: dict[str, object], reason: str
) -> None:
    pairs = verification_set([PictureBytes(f"{i}", face) for i, face in enumerate(FACES)])
    with pytest.raises(BackendError, match=reason):
        acquired(pairs, pack, source_of(pack, folder, **changed), backend=elsewhere)


def test_a_worker_loads_the_pack_as_it_is_told(pack: ModelPack, folder: Path) -> None:
    """The mirror image, and whether photos are crops already, come from the source."""
    pairs = verification_set([PictureBytes(f"{i}", face) for i, face in enumerate(FACES)])
    chunk = acquisition._loaded_chunk(pairs.pictures)
    source = source_of(pack, folder, flip=True)
    flipped: Extraction = acquisition._extract(source, chunk)
    own = ModelPack.load(folder, threads=1, flip=True)
    wanted = Extractor(own, aligned=True).extract(chunk, progress=False)
    np.testing.assert_array_equal(flipped.descriptors, wanted.descriptors)
    plain = acquired(pairs, pack, source_of(pack, folder)).descriptors
    assert np.abs(flipped.descriptors - plain).max() > 1e-3


def test_digests_tell_contents_apart(mixed: VerificationSet) -> None:
    found = digests(mixed)
    assert found[0] == found[2] != found[3]
    assert found[7] == found[8] == ""
    assert len(digest_of_pictures(found)) == 64
    assert digest_of_pictures(found) == digest_of_pictures(list(found))
    assert digest_of_pictures(found) != digest_of_pictures(found[::-1])


def test_photos_that_a_file_of_embeddings_lacks_failed_to_acquire() -> None:
    rows = np.eye(4, dtype=np.float32)
    embeddings = EmbeddingsFile(("c.png", "x.png", "a.png", "y.png"), rows, "0" * 64)
    pairs = verification_set([PictureBytes(f"{name}.png", b"") for name in "abcd"])
    found = from_file(pairs, embeddings)
    np.testing.assert_array_equal(found.rows, [0, -1, 1, -1])
    np.testing.assert_array_equal(found.descriptors, rows[[2, 0]])
    assert [(str(each.path), each.code) for each in found.failures] == [
        ("b.png", "not_in_file"),
        ("d.png", "not_in_file"),
    ]


def test_photos_are_aligned_where_all_have_the_size_of_the_embedder(tmp_path: Path) -> None:
    small = [PictureBytes(f"{i}", face) for i, face in enumerate(FACES)]
    photo = PictureBytes("photo", encode_photo(draw_face(1, size=250)))
    broken = PictureBytes("broken", BROKEN)
    absent = PictureFile("absent", tmp_path / "absent.png")
    assert are_aligned(verification_set(small), 112)
    assert not are_aligned(verification_set(small), 128)
    assert not are_aligned(verification_set([*small, photo]), 112)
    assert are_aligned(verification_set([broken, absent, *small]), 112)
    assert not are_aligned(verification_set([broken, absent]), 112)
