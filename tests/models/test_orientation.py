from collections import Counter

import numpy as np
import pytest

from models.decoding import decode_image
from models.errors import FaceError
from models.pack import ModelPack
from models.quality import DEFAULT_QUALITY
from models.selection import FacePolicy
from models.synthetic import encode_photo


@pytest.fixture(scope="module", params=["w600k_mbf", "yunet_mobilefacenet128"])
def pack(shared_data, request):
    return ModelPack.load(shared_data / "packs" / request.param, threads=1)


@pytest.fixture(scope="module")
def photos(lfw_photos):
    paths = sorted(lfw_photos.glob("*/*_0001.jpg"))[::4]
    return [decode_image(path.read_bytes()) for path in paths]


def answers(pack, photos, quarters, quality) -> Counter[str]:
    given: Counter[str] = Counter()
    for photo in photos:
        data = encode_photo(np.rot90(photo, quarters))
        try:
            pack.crop_photo(data, policy=FacePolicy.LARGEST, quality=quality)
            given["accepted"] += 1
        except FaceError as error:
            given[str(error)] += 1
    return given


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turned_photos_are_refused(pack, photos, quarters):
    assert answers(pack, photos, quarters, DEFAULT_QUALITY)["accepted"] == 0


def test_bulk_extraction_says_what_is_upside_down(pack, photos):
    """Without limits a detector that is not sure of anything may still take an ear for a face."""
    given = answers(pack, photos, 2, None)
    assert given["accepted"] <= 0.05 * len(photos), given
    assert given["The photo is upside down: turn it."] >= 0.7 * len(photos), given


def test_upright_photos_are_not_refused(pack, photos):
    assert answers(pack, photos, 0, None) == {"accepted": len(photos)}
