"""Drawn heads that turn, and flat pictures, whole or behind a card, that do not."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from models.alignment import align
from models.decoding import decode_image
from models.head_pose import head_pose
from models.pack import ModelPack
from models.relief import details_of, shows_relief
from tests.heads import POSES, Points, head
from tests.marked_heads import draw
from verify.challenge import Movement, movement_of

TURNS = ["turn_left", "turn_right", "look_up", "look_down"]
TILTED = np.array([[0.9, 0.1, 20], [-0.05, 1.0, 10], [2e-4, 1e-4, 1]])


def crop_of(points: Points, person: int = 0) -> NDArray[np.uint8]:
    return align(draw(points, person, marked=False), points, size=112)


@pytest.mark.parametrize("pose", TURNS)
@pytest.mark.parametrize("person", range(3))
def test_a_head_that_turns_shows_relief(pose: str, person: int) -> None:
    first = details_of(crop_of(head(), person))
    assert shows_relief(first, details_of(crop_of(head(**POSES[pose]), person)))


def test_a_flat_picture_shows_none_however_it_is_held_or_hidden() -> None:
    front = crop_of(head())
    tilted = cv2.warpPerspective(front, TILTED, (112, 112))
    card = front.copy()
    card[:, :45] = 90
    blurred = cv2.GaussianBlur(front, (0, 0), 8)
    blank = np.full_like(front, 120)
    for shown in (front, tilted, card, blurred, blank):
        assert not shows_relief(details_of(front), details_of(np.asarray(shown, np.uint8)))


@pytest.mark.parametrize("side", [Movement.TURN_LEFT, Movement.TURN_RIGHT])
@pytest.mark.parametrize("person", ["Angela_Bassett", "Antonio_Banderas", "Anna_Kournikova"])
def test_a_card_over_a_photo_moves_the_points_and_shows_no_relief(
    lfw_photos: Path, mbf_pack_dir: Path, person: str, side: Movement
) -> None:
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    file = lfw_photos / person / f"{person}_0001.jpg"
    photo = decode_image(file.read_bytes())
    face = pack.detect(photo)[0]
    x1, _, x2, _ = (int(value) for value in face.box)
    covered = photo.copy()
    if side is Movement.TURN_RIGHT:
        covered[:, : x1 + (x2 - x1) * 45 // 100] = 128
    else:
        covered[:, x2 - (x2 - x1) * 45 // 100 :] = 128
    other = pack.detect(covered)[0]
    assert movement_of(head_pose(other.keypoints), head_pose(face.keypoints)) is side
    crops = pack.align(photo, face), pack.align(covered, other)
    assert not shows_relief(*map(details_of, crops))
