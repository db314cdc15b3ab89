"""Liveness graphs: which file is one, what it is fed, and what its output means."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from models.alignment import template
from models.errors import ModelError, PackError
from models.liveness import crop_face, square_region
from models.pack import ModelPack
from tests.models.graphs import (
    fixed_face_detector,
    linked_pack,
    mean_liveness,
    pooling_embedder,
    write_pack,
)

BOX = (30.0, 25.0, 80.0, 95.0)
# The live class reads blue, the first attack red, the second is a constant 0.
WEIGHTS = np.array([[0.0, 0.02, 0.0], [0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])
NAMED = "2.7_80x80_net"
NET = mean_liveness(WEIGHTS)
OPEN = mean_liveness(WEIGHTS, size="side")
TWO = mean_liveness(np.array([[2.0, 0.0], [0.0, 1.0], [0.0, 0.0]]), size=64)


def stated(**keys: object) -> str:
    lines = [f"{key} = {value}" for key, value in keys.items()]
    return "\n".join(["[[liveness]]", *lines, ""])


SQUARE = stated(
    file='"two.onnx"',
    crop_scale=1.5,
    crop='"square"',
    channel_order='"rgb"',
    input_range="[0, 1]",
    live_class=0,
)


def picture(seed: int = 0, height: int = 112, width: int = 112) -> np.ndarray:
    """Smooth colours that differ everywhere."""
    small = np.random.default_rng(seed).integers(30, 226, (5, 5, 3), dtype=np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def pack_of(folder, toml: str = "", **graphs: bytes) -> ModelPack:
    detector = fixed_face_detector(BOX, template(112))
    write_pack(folder, emb=pooling_embedder(), det=detector, **graphs)
    if toml:
        (folder / "pack.toml").write_text(toml)
    return ModelPack.load(folder)


def box_crop(frame: np.ndarray, box, scale: float) -> np.ndarray:
    """The rule of minivision, in integers of one axis after the other."""
    ends = []
    for axis, length in ((1, frame.shape[0]), (0, frame.shape[1])):
        side = box[axis + 2] - box[axis]
        least = min(
            scale,
            (frame.shape[0] - 1) / (box[3] - box[1]),
            (frame.shape[1] - 1) / (box[2] - box[0]),
        )
        low = box[axis] + side / 2 - side * least / 2
        high = box[axis] + side / 2 + side * least / 2
        if low < 0:
            low, high = 0, high - low
        if high > length - 1:
            low, high = low - (high - length + 1), length - 1
        ends.append((max(0, int(low + 1e-9)), min(length, int(high + 1e-9) + 1)))
    (top, bottom), (left, right) = ends
    return frame[top:bottom, left:right]


@pytest.mark.parametrize("scale", [1.0, 2.7, 8.0])
@pytest.mark.parametrize("box", [BOX, (0.0, 0.0, 40.0, 50.0), (75.5, 60.25, 118.0, 112.0)])
def test_the_crop_of_a_box(box, scale):
    frame = picture(1, 112, 130)
    crop = crop_face(frame, box, shape="box", scale=scale, size=80)
    cut = box_crop(frame, box, scale)
    expected = cv2.resize(cut, (80, 80), interpolation=cv2.INTER_LINEAR)
    assert np.array_equal(crop, expected)


@pytest.mark.parametrize(
    ("box", "size", "off"),
    [
        ((0.0, 0.0, 40.0, 80.0), 64, 0),
        ((120.0, 130.0, 190.0, 199.0), 64, 0),
        ((50.0, 50.0, 150.0, 150.0), 32, 0),
        # What is seen of so large a square is reduced first: its border lies on reduced pixels.
        ((0.0, 0.0, 199.0, 199.0), 64, 2),
    ],
)
def test_a_square_is_exact_and_mirrors_the_frame_over_its_border(box, size, off):
    frame = picture(3, 200, 200)
    left, top, side = square_region(box, 1.5)
    pad = 200
    mirrored = np.pad(frame, ((pad, pad), (pad, pad), (0, 0)), mode="reflect")
    cut = mirrored[top + pad :, left + pad :][:side, :side]
    expected = cv2.resize(cut, (size, size), interpolation=cv2.INTER_AREA).astype(int)
    crop = crop_face(frame, box, shape="square", scale=1.5, size=size).astype(int)
    assert np.abs(crop - expected).max() <= off


@pytest.mark.parametrize(
    "box",
    [
        (10.0, 10.0, 10.0, 30.0),
        (-30.0, 5.0, 0.0, 30.0),
        (5.0, 112.0, 9.0, 130.0),
        (float("nan"), 1.0, 9.0, 9.0),
    ],
)
def test_a_box_outside_the_frame_is_refused(box):
    with pytest.raises(ModelError, match="no area inside"):
        crop_face(picture(), box, shape="box", scale=2.0, size=80)


def softmax(logits: np.ndarray) -> np.ndarray:
    shares = np.exp(logits - logits.max())
    return shares / shares.sum()


def test_minifasnet_is_fed_bgr_from_0_to_255_and_its_share_of_class_1_is_the_score(tmp_path):
    pack = pack_of(tmp_path, **{NAMED: NET})
    frame = picture(5)
    crop = cv2.resize(box_crop(frame, BOX, 2.7), (80, 80), interpolation=cv2.INTER_LINEAR)
    means = crop.astype(np.float64).mean(axis=(0, 1))[::-1]
    expected = softmax(means @ WEIGHTS)[1]
    assert pack.liveness.score(frame, BOX) == pytest.approx(expected, abs=1e-5)
    assert 0.05 < expected < 0.95


def test_several_graphs_are_averaged(tmp_path):
    names = (NAMED, "4_0_0_80x80_net")
    other = mean_liveness(WEIGHTS[:, [1, 0, 2]])
    graphs = dict(zip(names, (NET, other), strict=True))
    alone = [
        pack_of(tmp_path / name, **{name: graph}).liveness.score(picture(6), BOX)
        for name, graph in graphs.items()
    ]
    both = pack_of(tmp_path / "both", **graphs).liveness
    assert both.score(picture(6), BOX) == pytest.approx(np.mean(alone))
    assert abs(alone[0] - alone[1]) > 0.01
    assert [graph.crop_scale for graph in both.members] == [2.7, 4.0]


def test_two_logits_as_pack_toml_states_them(tmp_path):
    pack = pack_of(tmp_path, SQUARE, two=TWO)
    frame = picture(7)
    left, top, side = square_region(BOX, 1.5)
    assert min(left, top) >= 0
    assert max(left, top) + side <= 112
    cut = frame[top : top + side, left : left + side]
    crop = cv2.resize(cut, (64, 64), interpolation=cv2.INTER_AREA).astype(np.float64) / 255
    red, green, _ = crop.mean(axis=(0, 1))
    expected = softmax(np.array([2 * red, green]))[0]
    assert pack.liveness.score(frame, BOX) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "scale"),
    [
        ("2.7_80x80_MiniFASNetV2", 2.7),
        ("4_0_0_80x80_MiniFASNetV1SE", 4.0),
        ("minifasnet_v1se_4.0_80x80", 4.0),
        ("minifasnet_v2_2.7_80x80", 2.7),
    ],
)
def test_the_scale_in_the_name_that_the_authors_give(tmp_path, name, scale):
    assert pack_of(tmp_path, **{name: NET}).liveness.members[0].crop_scale == scale


@pytest.mark.parametrize(
    ("toml", "graphs", "said"),
    [
        ("", {"net": NET}, r"net\.onnx.*crop_scale in pack\.toml.*Or remove the file\."),
        (stated(file='"gone.onnx"'), {NAMED: NET}, r"gone\.onnx"),
        (stated(file=f'"{NAMED}.onnx"', live_class=3), {NAMED: NET}, "3 classes.*live_class 3"),
        (stated(file='"open.onnx"', crop_scale=2), {"open": OPEN}, "takes any x any pixels"),
        (stated(file='"emb.onnx"', crop_scale=2), {}, "no embedder"),
    ],
)
def test_mistakes_are_named(tmp_path, toml, graphs, said):
    with pytest.raises(PackError, match=said):
        pack_of(tmp_path, toml, **graphs)


def test_a_threshold_belongs_to_the_file_and_to_what_it_is_fed(tmp_path):
    packs = [
        pack_of(tmp_path / "a", **{NAMED: NET}),
        pack_of(tmp_path / "b", **{"2.7_80x80_renamed": NET}),
        pack_of(tmp_path / "c", **{"4.0_80x80_net": NET}),
        pack_of(tmp_path / "d", **{NAMED: mean_liveness(WEIGHTS / 2)}),
    ]
    ids = [pack.liveness.graphs for pack in packs]
    assert ids[0] == ids[1]
    assert len(set(ids)) == 3


def test_a_photo_is_decoded_and_detected_once(tmp_path, monkeypatch):
    pack = pack_of(tmp_path, **{NAMED: NET})
    detect, calls = ModelPack.detect, []
    monkeypatch.setattr(
        ModelPack, "detect", lambda self, image: calls.append(1) or detect(self, image)
    )
    data = png(picture(8))
    plain = pack.embed_photo(data, quality=None)
    sample = pack.embed_photo(data, quality=None, liveness=True)
    assert len(calls) == 2
    assert plain.liveness is None
    assert sample.liveness == pytest.approx(pack.liveness.score(picture(8), BOX), abs=1e-4)
    assert np.array_equal(sample.embedding, plain.embedding)
    assert sample.box == pytest.approx(BOX, abs=1e-3)
    several = pack.embed_photos([data, data], quality=None, liveness=True)
    assert [one.liveness for one in several] == [sample.liveness] * 2


SE = "minifasnet_v2se_1.5_128x128.onnx"


@pytest.mark.parametrize("two_logits", [False, True])
def test_real_graphs_tell_their_authors_photos_apart(
    minifasnet_pack_dir, mbf_pack_dir, shared_data, tmp_path, two_logits
):
    folder = minifasnet_pack_dir
    if two_logits:
        folder = linked_pack(tmp_path, mbf_pack_dir, SQUARE.replace("two.onnx", SE))
        (folder / SE).symlink_to(shared_data / "packs" / "liveness_minifasnet_se" / SE)
    pack = ModelPack.load(folder)
    for photo in sorted((shared_data / "packs" / "liveness").glob("*.jpg")):
        sample = pack.embed_photo(photo.read_bytes(), policy=None, quality=None, liveness=True)
        assert (sample.liveness > 0.5) == photo.stem.startswith("image_T")
