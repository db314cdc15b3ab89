import hashlib
import io
import json

import numpy as np
import pytest
from PIL import Image

from models.errors import (
    ImageError,
    PackError,
)
from models.pack import ModelPack
from models.pack_graphs import Role, read_graphs
from tests.models import graphs
from tests.models.graphs import pooled, pooling_embedder, unit, write_pack

GENDER = graphs.shaped([("data", ["N", 3, 96, 96])], [("fc1", [1, 3])])
LANDMARKS = graphs.shaped([("data", ["N", 3, 192, 192])], [("fc1", [1, 212])])


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def crop(size: int = 112, width: int | None = None) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (size, width or size, 3), dtype=np.uint8)


def test_a_folder_with_graphs_that_are_not_needed(tmp_path):
    folder = write_pack(tmp_path / "mine", emb=pooling_embedder(), g=GENDER, l=LANDMARKS)
    info = ModelPack.load(folder).info
    assert (info.name, info.n, info.detector) == ("mine", 147, None)
    assert info.embedder_sha256 == hashlib.sha256(pooling_embedder()).hexdigest()
    assert json.loads(json.dumps(info.preprocessing)) == {
        "version": 2,
        "alignment": "arcface-112",
        "size": 112,
        "channel_order": "rgb",
        "mean": [127.5] * 3,
        "scale": [127.5] * 3,
        "flip": False,
    }


def test_the_digest_is_of_the_upright_pixels_and_not_of_the_file(tmp_path):
    pack = ModelPack.load(write_pack(tmp_path / "mine", emb=pooling_embedder()))
    shown = crop()
    turned = io.BytesIO()
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    Image.fromarray(np.ascontiguousarray(shown[::-1, ::-1])).save(turned, "PNG", exif=exif)
    bitmap = io.BytesIO()
    Image.fromarray(shown).save(bitmap, "BMP")
    files = [png(shown), turned.getvalue(), bitmap.getvalue(), png(shown[::-1])]
    digests = [pack.embed_photo(file, quality=None, digested=True).picture for file in files]
    assert digests[0] == digests[1] == digests[2] != digests[3]
    assert pack.embed_photo(files[0], quality=None).picture is None


@pytest.mark.parametrize("missing", ["nowhere", "readme.txt"])
def test_no_pack_there(tmp_path, missing):
    (tmp_path / "readme.txt").write_text("hello")
    with pytest.raises(PackError, match=missing):
        ModelPack.load(tmp_path / missing)


SCRFD, BLIND, YUNET = (
    graphs.scrfd_shapes(),
    graphs.scrfd_shapes(keypoints=False),
    graphs.yunet_shapes(),
)
ZEROS = graphs.shaped([("x", ["N", 3, 112, 112])], [("y", [1, 512])])


@pytest.mark.parametrize(
    ("files", "said"),
    [
        (
            {"one": pooling_embedder(), "two": pooling_embedder(128)},
            r"2 embedders: one\.onnx and two\.onnx; leave one",
        ),
        (
            {"e": pooling_embedder(), "s": SCRFD, "y": YUNET},
            r"2 detectors: s\.onnx and y\.onnx",
        ),
        ({"e": pooling_embedder(), "d": BLIND}, r"d\.onnx.*without keypoints"),
        ({"g": GENDER, "d": YUNET}, r"no embedder. Seen: d\.onnx: .*; g\.onnx: 96 x 96"),
        ({"e": pooling_embedder(), "broken": b"oops"}, r"broken\.onnx"),
        ({"fake": ZEROS}, r"fake\.onnx"),
    ],
)
def test_a_pack_that_cannot_be_used_is_refused_by_its_files(tmp_path, files, said):
    with pytest.raises(PackError, match=said):
        ModelPack.load(write_pack(tmp_path, **files))


def test_pack_toml_overrides_what_the_graph_says(tmp_path):
    folder = write_pack(tmp_path, e=pooling_embedder())
    (folder / "pack.toml").write_text(
        '[embedder]\nmean = 0\nscale = [1, 2, 4]\nchannel_order = "bgr"\n'
    )
    pack = ModelPack.load(folder)
    pictures = crop()[None]
    x = pictures[..., ::-1] / np.array([1, 2, 4])
    expected = unit(x.reshape(1, 7, 16, 7, 16, 3).mean((2, 4)).transpose(0, 3, 1, 2).reshape(1, -1))
    np.testing.assert_allclose(pack.embed(pictures), expected, atol=2e-5)
    assert pack.info.preprocessing["channel_order"] == "bgr"


def test_flip_of_the_pack_is_part_of_the_preprocessing_and_is_used(tmp_path):
    folder = write_pack(tmp_path, e=pooling_embedder())
    pack = ModelPack.load(folder, flip=True)
    pictures = crop()[None]
    assert pack.info.preprocessing["flip"] is True
    expected = unit(pooled(pictures) + pooled(pictures[:, :, ::-1]))
    np.testing.assert_allclose(pack.embed(pictures), expected, atol=2e-5)
    plain = ModelPack.load(folder).embed(pictures)
    np.testing.assert_allclose(plain, unit(pooled(pictures)), atol=2e-5)


@pytest.fixture
def blind(tmp_path) -> ModelPack:
    return ModelPack.load(write_pack(tmp_path / "blind", e=pooling_embedder()))


def test_without_a_detector_an_aligned_crop_is_embedded(blind):
    sample = blind.embed_photo(png(crop()), quality=None)
    np.testing.assert_allclose(sample.embedding, unit(pooled(crop()[None]))[0], atol=2e-5)
    assert sample.box is None
    assert sample.quality.score is None


def test_without_a_detector_other_shapes_are_refused(blind):
    with pytest.raises(ImageError, match="must be square") as caught:
        blind.embed_photo(png(crop(112, 150)))
    assert caught.value.code == "unsupported_image"
    with pytest.raises(PackError, match="has no detector"):
        blind.detect(crop())


def test_neither_samples_nor_faces_show_numbers_of_a_descriptor(blind):
    sample = blind.embed_photo(png(crop()), quality=None)
    assert "embedding" not in repr(sample)
    assert "array" not in repr(sample)


def test_inspect_reports_also_what_cannot_be_loaded(tmp_path, mbf_pack_dir):
    folder = write_pack(tmp_path, a=pooling_embedder(), b=pooling_embedder(128), g=GENDER)
    reports = {report.file: report for report in read_graphs(folder)}
    assert [r.role for r in reports.values()] == [Role.EMBEDDER, Role.EMBEDDER, Role.UNUSED]
    assert "gender and age" in reports["g.onnx"].reason
    real = {report.file: report for report in read_graphs(mbf_pack_dir)}
    digest = hashlib.sha256((mbf_pack_dir / "w600k_mbf.onnx").read_bytes()).hexdigest()
    assert real["w600k_mbf.onnx"].sha256 == digest


# -- real models and real faces ----------------------------------------------------------------


@pytest.fixture(scope="module", params=["w600k_mbf", "yunet_mobilefacenet128"])
def real(request, shared_data) -> ModelPack:
    return ModelPack.load(shared_data / "packs" / request.param, threads=1)


def test_real_packs_are_recognised(real):
    expected = {"w600k_mbf": (512, "scrfd", 127.5), "yunet_mobilefacenet128": (128, "yunet", 0.0)}
    n, kind, mean = expected[real.info.name]
    assert (real.info.n, real.info.detector.kind) == (n, kind)
    assert real.info.preprocessing["mean"] == [mean] * 3
