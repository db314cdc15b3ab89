"""Which face of a photo is meant, of boxes in a picture of 240 x 240 pixels."""

from collections.abc import Sequence

import numpy as np
import pytest

from models.boxes import Face
from models.errors import MultipleFaces, NoFace
from models.selection import FacePolicy, select_face

# Left, top and side of square boxes. The middle of the picture is (120, 120).
SPECK = (115, 115, 12)
MAIN = (40, 40, 100)
HALF = (150, 0, 70)  # of the area of MAIN 0.49
NEAR = (150, 0, 75)  # 0.56
ASIDE = (0, 0, 110)  # 1.21, and not over the middle
FAR = (0, 0, 115)  # 1.32
LOW = (60, 122, 100)  # starts just below the middle


def face(left: float, top: float, side: float) -> Face:
    box = np.array([left, top, left + side, top + side], np.float32)
    return Face(box, 0.9, np.zeros((5, 2), np.float32))


def select(faces: Sequence[Face], policy: FacePolicy | None, *, min_size: float = 24.0) -> Face:
    return select_face(faces, policy, shape=(240, 240, 3), min_size=min_size)


DOMINANT, LARGEST, SINGLE = FacePolicy.DOMINANT, FacePolicy.LARGEST, FacePolicy.SINGLE


@pytest.mark.parametrize(
    ("boxes", "policy", "taken"),
    [
        ((MAIN, HALF), DOMINANT, MAIN),
        ((HALF, MAIN), DOMINANT, MAIN),
        ((MAIN, NEAR), DOMINANT, None),
        ((MAIN, HALF, HALF), DOMINANT, MAIN),
        ((ASIDE, HALF), DOMINANT, None),
        ((LOW, HALF), DOMINANT, None),
        ((ASIDE,), DOMINANT, ASIDE),  # nobody else is in the picture
        ((MAIN, NEAR), LARGEST, MAIN),
        ((MAIN, ASIDE), LARGEST, None),  # a hair would decide
        ((MAIN, FAR), LARGEST, FAR),  # a smaller face in the middle is not taken for it
        ((MAIN, MAIN), LARGEST, None),
        ((MAIN, HALF), SINGLE, None),
        # A face that could not be used is no second one.
        *(((SPECK, MAIN), policy, MAIN) for policy in FacePolicy),
        *(((SPECK,), policy, SPECK) for policy in FacePolicy),
        ((SPECK, MAIN), None, SPECK),  # of labelled photos, the first in rank
    ],
)
def test_the_face_that_is_meant(
    boxes: Sequence[tuple[float, float, float]],
    policy: FacePolicy | None,
    taken: tuple[float, float, float] | None,
) -> None:
    faces = [face(*box) for box in boxes]
    if taken is None:
        with pytest.raises(MultipleFaces, match=f"shows {len(faces)} faces") as caught:
            select(faces, policy)
        assert caught.value.details == {"faces": len(faces)}
        assert ("face=largest" in str(caught.value)) == (policy is DOMINANT)
    else:
        assert select(faces, policy) is faces[boxes.index(taken)]


@pytest.mark.parametrize("policy", [*FacePolicy, None])
def test_no_face(policy: FacePolicy | None) -> None:
    with pytest.raises(NoFace, match="come closer"):
        select([], policy)
