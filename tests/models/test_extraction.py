import io

import numpy as np
import pytest
from PIL import Image

from models import extraction
from models.cache import EmbeddingCache
from models.extraction import Extractor
from models.pack import ModelPack
from tests.models.graphs import pooled, pooling_embedder, unit, write_pack


@pytest.fixture(scope="module")
def pack(tmp_path_factory) -> ModelPack:
    return ModelPack.load(write_pack(tmp_path_factory.mktemp("p"), e=pooling_embedder()), threads=1)


def crop(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (112, 112, 3), dtype=np.uint8)


@pytest.fixture
def files(tmp_path):
    paths = []
    for seed in range(7):
        paths.append(tmp_path / f"{seed}.png")
        Image.fromarray(crop(seed)).save(paths[-1])
    return paths


def expected(seeds) -> np.ndarray:
    return unit(pooled(np.stack([crop(seed) for seed in seeds])))


def test_rows_follow_the_order_of_the_paths(pack, files, monkeypatch):
    monkeypatch.setattr(extraction, "CHUNK", 3)
    order = [4, 0, 6, 2, 1, 5, 3]
    result = Extractor(pack).extract([files[i] for i in order])
    np.testing.assert_allclose(result.embeddings, expected(order), atol=2e-5)
    assert result.paths == [files[i] for i in order]
    assert result.embeddings.dtype == np.float32
    assert result.embeddings.flags.c_contiguous
    assert result.failures == []


def test_every_file_is_accounted_for(pack, files, tmp_path):
    broken, wide, empty = tmp_path / "broken.png", tmp_path / "wide.png", tmp_path / "empty.png"
    broken.write_bytes(b"nothing")
    empty.write_bytes(b"")
    Image.fromarray(crop(1)[:50]).save(wide)
    paths = [files[0], broken, files[1], wide, tmp_path / "absent.png", empty]
    result = Extractor(pack).extract(paths)
    assert result.paths == [files[0], files[1]]
    assert [(f.path, f.code) for f in result.failures] == [
        (broken, "unsupported_image"),
        (wide, "unsupported_image"),
        (tmp_path / "absent.png", "unreadable_file"),
        (empty, "unsupported_image"),
    ]
    assert all(failure.reason.endswith(".") for failure in result.failures)
    assert result.failure_counts() == {"unsupported_image": 3, "unreadable_file": 1}
    np.testing.assert_allclose(result.embeddings, expected([0, 1]), atol=2e-5)


def test_a_file_over_the_limit_is_not_read_whole(pack, tmp_path):
    path = tmp_path / "huge.png"
    with path.open("wb") as file:
        file.truncate(2**40)
    result = Extractor(pack).extract([path])
    assert [failure.code for failure in result.failures] == ["image_too_large"]


def test_copies_of_one_file_are_embedded_once(pack, files, tmp_path, monkeypatch):
    copy = tmp_path / "copy.png"
    copy.write_bytes(files[0].read_bytes())
    seen = []
    real = pack.embed
    monkeypatch.setattr(pack, "embed", lambda crops: seen.append(len(crops)) or real(crops))
    result = Extractor(pack).extract([files[0], copy, files[1]])
    assert seen == [2]
    np.testing.assert_allclose(result.embeddings, expected([0, 0, 1]), atol=2e-5)


def test_the_cache_spares_the_second_run(pack, files, monkeypatch):
    cache = EmbeddingCache()
    first = Extractor(pack, cache=cache).extract(files)
    assert first.cached == 0
    monkeypatch.setattr(pack, "embed", lambda crops: pytest.fail("embedded again"))
    second = Extractor(pack, cache=cache).extract(files[::-1])
    assert second.cached == len(files)
    np.testing.assert_array_equal(second.embeddings, first.embeddings[::-1])


def test_another_model_or_preprocessing_misses_the_cache(pack, files, tmp_path):
    cache = EmbeddingCache()
    Extractor(pack, cache=cache).extract(files)
    folder = write_pack(tmp_path / "same", e=pooling_embedder())
    other_model = write_pack(tmp_path / "other", e=pooling_embedder(inside=True))
    others = [
        Extractor(ModelPack.load(folder, flip=True), cache=cache),
        Extractor(ModelPack.load(other_model), cache=cache),
    ]
    assert [other.extract(files[:1]).cached for other in others] == [0, 0]
    assert Extractor(ModelPack.load(folder), cache=cache).extract(files[:1]).cached == 1


def test_the_cache_file_is_written_even_when_inference_breaks(pack, files, monkeypatch):
    cache = EmbeddingCache()
    flushed = []
    monkeypatch.setattr(cache, "flush", lambda: flushed.append(True))
    monkeypatch.setattr(pack, "embed", lambda crops: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        Extractor(pack, cache=cache).extract(files)
    assert flushed == [True]


# -- real models and real faces ----------------------------------------------------------------


def test_aligned_crops_skip_detection(mbf_pack_dir, lfw_aligned, monkeypatch):
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    monkeypatch.setattr(pack, "detect", lambda image: pytest.fail("detected"))
    paths = sorted(lfw_aligned.glob("*/*_0001.jpg"))[:3]
    result = Extractor(pack, aligned=True).extract(paths)
    crops = np.stack([np.asarray(Image.open(io.BytesIO(p.read_bytes()))) for p in paths])
    np.testing.assert_allclose(result.embeddings, pack.embed(crops), atol=1e-5)


def test_a_cache_keeps_plain_and_flipped_embeddings_apart(tmp_path, files):
    folder = write_pack(tmp_path / "p", e=pooling_embedder())
    plain, flipped = (ModelPack.load(folder, threads=1, flip=flip) for flip in (False, True))
    cache = EmbeddingCache()
    made = [Extractor(pack, cache=cache).extract(files) for pack in (plain, flipped)]
    assert [extraction.cached for extraction in made] == [0, 0]
    assert len(cache) == 2 * len(files)
    assert Extractor(flipped, cache=cache).extract(files).cached == len(files)
