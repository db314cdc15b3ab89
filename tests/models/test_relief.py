"""Drawn heads that turn, and flat pictures, whole or behind a card, that do not."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from models.alignment import align
from models.relief import details_of, shows_relief
from tests.heads import POSES, Points, head
from tests.marked_heads import draw

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
