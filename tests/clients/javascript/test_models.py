"""From photo to embedding in JavaScript, beside Python on the same pictures."""

import base64
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from models.decoding import decode_image
from models.errors import FaceError
from models.faces import FaceCrop
from models.pack import ModelPack
from tests.api.deployment import write_pack
from tests.clients.javascript.conftest import Node
from verify.preparation import recorded_of

Image = NDArray[np.uint8]


def contract_of(pack: ModelPack) -> dict[str, Any]:
    """What `GET /v1/contract` says of a pack."""
    return {
        "binding": {
            "embedder_sha256": pack.info.embedder_sha256,
            "preprocessing": pack.info.preprocessing,
            "n": pack.info.n,
        },
        "recorded": recorded_of(pack),
    }


def embedded(
    node: Node, pack: ModelPack, folder: Path, images: Sequence[Image]
) -> list[dict[str, Any]]:
    """What JavaScript makes of pictures."""
    detector = pack.info.detector
    answers = node(
        "embed.js",
        {
            "contract": contract_of(pack),
            "embedder": str(folder / pack.info.embedder_file),
            "detector": None if detector is None else str(folder / detector.file),
            "photos": [
                {
                    "data": base64.b64encode(image.tobytes()).decode(),
                    "width": image.shape[1],
                    "height": image.shape[0],
                }
                for image in images
            ],
        },
    )
    for answer in answers:
        if "code" not in answer:
            answer["crop"] = np.frombuffer(base64.b64decode(answer["crop"]), np.uint8)
            answer["embedding"] = np.frombuffer(base64.b64decode(answer["embedding"]), "<f4")
    return list(answers)


def png(image: Image) -> bytes:
    return bytes(cv2.imencode(".png", image[:, :, ::-1])[1])


def cropped(pack: ModelPack, image: Image) -> FaceCrop | FaceError:
    try:
        return pack.crop_photo(png(image))
    except FaceError as error:
        return error


def compare(pack: ModelPack, image: Image, ours: dict[str, Any]) -> None:
    """Hold what JavaScript made of a picture against what Python makes of it."""
    theirs = cropped(pack, image)
    if isinstance(theirs, FaceError):
        assert (ours["code"], set(ours["details"])) == (theirs.code, set(theirs.details))
        return
    assert "code" not in ours, ours
    if theirs.face is not None:
        gap = np.abs(np.asarray(ours["face"]["keypoints"]) - theirs.face.keypoints)
        assert gap.max() < 0.5
    crop = ours["crop"].reshape(theirs.crop.shape)
    assert np.abs(crop.astype(int) - theirs.crop).mean() < 1
    quality = asdict(theirs.quality)
    assert set(ours["quality"]) == set(quality)
    for name, value in quality.items():
        expected = None if value is None else pytest.approx(value, rel=0.02, abs=0.2)
        assert ours["quality"][name] == expected
    assert float(ours["embedding"] @ pack.embed(theirs.crop[None])[0]) >= 0.9995


def test_aligned_crops_of_every_size(node: Node, tmp_path: Path) -> None:
    """The pack without a detector takes squares: as they are, enlarged, halved, shrunk."""
    folder = write_pack(tmp_path / "tiny")
    pack = ModelPack.load(folder, threads=1)
    rng = np.random.default_rng(5)
    small = rng.integers(0, 256, (14, 14, 3), dtype=np.uint8)
    images = [
        np.asarray(cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC), np.uint8)
        for side in (112, 60, 224, 301)
    ]
    images.append(np.full((112, 112, 3), 250, np.uint8))  # too bright, and without any detail
    for image, ours in zip(images, embedded(node, pack, folder, images), strict=True):
        compare(pack, image, ours)


@pytest.mark.long
@pytest.mark.parametrize("pack_dir", ["mbf_pack_dir", "yunet_pack_dir"])
def test_photos_of_people(
    node: Node, request: pytest.FixtureRequest, pack_dir: str, lfw_photos: Path
) -> None:
    """Both detectors, on photos as they are, cut tightly, turned, halved, small."""
    folder = request.getfixturevalue(pack_dir)
    pack = ModelPack.load(folder, threads=1)
    people = sorted(path for path in lfw_photos.iterdir() if path.is_dir())
    photos = [decode_image(next(iter(sorted(path.glob("*.jpg")))).read_bytes()) for path in people]
    images = list(photos[:20])
    images += [photo[60:190, 60:190] for photo in photos[20:23]]
    images += [
        np.ascontiguousarray(np.rot90(photo, k)) for k in (1, 2, 3) for photo in photos[40:42]
    ]
    images += [np.ascontiguousarray(photo[:, 125:]) for photo in photos[40:42]]
    images += [
        np.asarray(cv2.resize(photo, (900, 700), interpolation=cv2.INTER_LINEAR), np.uint8)
        for photo in photos[24:26]
    ]
    images += [np.concatenate(photos[26:28], axis=1), np.zeros((200, 300, 3), np.uint8)]
    answers = embedded(node, pack, folder, images)
    for image, ours in zip(images, answers, strict=True):
        compare(pack, image, ours)
    assert any("upside down" in answer.get("message", "") for answer in answers)
    # Most of them show one usable face; the others must be refused alike.
    assert sum("code" not in answer for answer in answers) > len(images) // 2
