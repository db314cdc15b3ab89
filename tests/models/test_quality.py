from dataclasses import asdict

import cv2
import numpy as np
import pytest

from models.decoding import decode_image
from models.errors import FaceError, FaceTooSmall, LowQuality
from models.pack import ModelPack
from models.quality import (
    Quality,
    check,
    measure_pose,
    measure_sharpness,
)
from models.selection import FacePolicy
from models.synthetic import encode_photo
from tests.models.graphs import linked_pack

GOOD = Quality(
    score=0.9,
    face_size=100.0,
    sharpness=3.0,
    brightness=120.0,
    exposure=200.0,
    yaw=0.0,
    pitch=0.0,
    roll=0.0,
    border=0.5,
    aspect=1.4,
)


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(112, 112))
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def streak(length: int, angle: float) -> np.ndarray:
    kernel = np.zeros((length, length))
    middle = length // 2
    for r in np.linspace(-middle, middle, 8 * length):
        y, x = middle + r * np.sin(angle), middle + r * np.cos(angle)
        kernel[round(y), round(x)] = 1
    return kernel / kernel.sum()


@pytest.mark.parametrize("angle", [0, np.pi / 4, np.pi / 2, 3 * np.pi / 4])
def test_motion_blur_in_any_direction_is_seen(angle):
    sharp = texture()
    moved = cv2.filter2D(sharp, -1, streak(15, angle), borderType=cv2.BORDER_REFLECT)
    assert measure_sharpness(moved) < 0.35 * measure_sharpness(sharp)


def test_sharpness_falls_with_blur_and_ignores_exposure_and_contrast():
    sharp = texture()
    values = [measure_sharpness(cv2.GaussianBlur(sharp, (0, 0), s)) for s in (1, 2, 3, 4)]
    assert all(np.diff([measure_sharpness(sharp), *values]) < 0)
    soft = (sharp * 0.4 + 10).astype(np.uint8)
    assert measure_sharpness(soft) == pytest.approx(measure_sharpness(sharp), rel=0.05)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"score": 0.1}, "score"),
        ({"sharpness": 0.1}, "blur"),
        ({"brightness": 3.0}, "darkness"),
        ({"exposure": 30.0}, "darkness"),
        ({"brightness": 253.0}, "brightness"),
        ({"yaw": -88.0}, "pose"),
        ({"pitch": 80.0}, "pose"),
        ({"roll": -179.0}, "turned"),
        ({"border": -0.1}, "hidden"),
        ({"aspect": 2.1}, "hidden"),
    ],
)
def test_each_failure_is_named_with_value_and_limit(change, name):
    with pytest.raises(LowQuality, match=name) as caught:
        check(Quality(**(asdict(GOOD) | change)), recommended_score=0.6)
    assert list(caught.value.details) == [name]
    detail = caught.value.details[name]
    ((measured, value),) = change.items()
    if name in ("pose", "hidden"):
        assert list(detail) == [measured]
        detail = detail[measured]
    assert detail["value"] == value
    assert caught.value.code == "low_quality"


def test_all_failures_are_named_at_once():
    bad = Quality(**(asdict(GOOD) | {"sharpness": 0.0, "brightness": 1.0, "yaw": 80.0}))
    with pytest.raises(LowQuality) as caught:
        check(bad)
    assert list(caught.value.details) == ["blur", "darkness", "pose"]


def test_a_small_face_is_told_apart():
    with pytest.raises(FaceTooSmall) as caught:
        check(Quality(**(asdict(GOOD) | {"face_size": 12.0, "sharpness": 0.0})))
    assert caught.value.code == "face_too_small"
    assert caught.value.details == {"size": {"value": 12.0, "limit": 24.0}}


DEGRADED = {
    "defocus": (lambda x: cv2.GaussianBlur(x, (0, 0), 6), "blur"),
    "shaken": (lambda x: cv2.filter2D(x, -1, streak(25, 0.0)), "blur"),
    "dark": (lambda x: (x * 0.08).astype(np.uint8), "darkness"),
    "overexposed": (lambda x: np.clip(x * 6.0 + 60, 0, 255).astype(np.uint8), "brightness"),
}


@pytest.fixture(scope="module")
def pack(mbf_pack_dir, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pack")
    smaller_canvas = "[detector]\ninput_size = 320\n"
    return ModelPack.load(linked_pack(folder, mbf_pack_dir, smaller_canvas), threads=1)


@pytest.fixture(scope="module")
def photos(lfw_photos):
    paths = sorted(lfw_photos.glob("*/*_0001.jpg"))[::8]
    return [decode_image(path.read_bytes()) for path in paths]


def refusal(pack, image) -> set[str]:
    try:
        pack.crop_photo(encode_photo(image), policy=FacePolicy.LARGEST)
    except LowQuality as error:
        return set(error.details)
    except FaceError as error:
        return {error.code}
    return set()


def test_good_real_photos_pass(pack, photos):
    assert [refusal(pack, photo) for photo in photos] == [set()] * len(photos)


@pytest.mark.parametrize("kind", DEGRADED)
def test_degraded_real_photos_are_refused_by_name(pack, photos, kind):
    spoil, name = DEGRADED[kind]
    reasons = [refusal(pack, spoil(photo)) for photo in photos]
    named = sum(bool(reason & {name, "no_face"}) for reason in reasons)
    assert named >= 0.9 * len(photos), reasons


PARTS = {
    "eye strip": lambda x: x[95:125, 75:175].repeat(2, 0).repeat(2, 1),
    "right half": lambda x: x[:, 125:],
    "left half": lambda x: x[:, :125],
    "lower half": lambda x: x[125:],
    "forehead and eyes": lambda x: x[60:125, 70:180],
    "mouth and chin": lambda x: x[140:190, 75:175],
    "squeezed": lambda x: cv2.resize(x, (125, 250), interpolation=cv2.INTER_AREA),
}


@pytest.mark.parametrize("part", PARTS)
def test_parts_of_real_faces_are_refused(pack, photos, part):
    reasons = [refusal(pack, PARTS[part](photo)) for photo in photos]
    assert all(reasons), reasons


def test_a_dark_face_in_a_well_exposed_picture_passes(pack, photos):
    """As dark skin is in a photo that is not underexposed."""
    for photo in photos:
        image = photo.copy()
        image[40:210, 55:195] //= 9
        assert "darkness" not in refusal(pack, image)


def test_profiles_are_refused_for_their_pose(pack, fairface):
    """Profiles and frontal faces of the set, told apart by eye."""
    sides = {"11884": 1, "10365": -1, "12204": 1, "11997": 1, "12656": -1}
    for name, side in sides.items():
        image = decode_image((fairface / "train" / f"{name}.jpg").read_bytes())
        assert "pose" in refusal(pack, image)
        assert np.sign(measure_pose(pack.detect(image)[0].keypoints)[0]) == side
    for name in ("10336", "10376", "10852"):
        image = decode_image((fairface / "train" / f"{name}.jpg").read_bytes())
        assert "pose" not in refusal(pack, image)
