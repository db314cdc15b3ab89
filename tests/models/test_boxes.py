import numpy as np

from models.boxes import (
    MAX_CANDIDATES,
    Face,
    non_maximum_suppression,
    ranked,
)


def test_a_box_that_overlaps_a_better_one_is_suppressed():
    """Of 10 x 10 boxes, moved by 3 (overlap 0.54), 5 (0.33) and 20."""
    boxes = np.array([[x, 0, x + 10, 10] for x in (3, 0, 5, 20)], dtype=np.float32)
    kept = non_maximum_suppression(boxes, np.array([0.7, 0.9, 0.8, 0.6], np.float32), threshold=0.4)
    assert kept.tolist() == [1, 2, 3]


def test_a_flood_of_candidates_is_cut_to_the_best():
    count = MAX_CANDIDATES + 50
    x = np.arange(count, dtype=np.float32) * 10
    boxes = np.stack([x, x * 0, x + 5, x * 0 + 5], axis=1)
    kept = non_maximum_suppression(
        boxes, np.linspace(0.5, 1, count, dtype=np.float32), threshold=0.4
    )
    assert kept.tolist() == list(range(count - 1, 49, -1))


def face(x1, y1, x2, y2, score=0.9) -> Face:
    return Face(np.array([x1, y1, x2, y2], np.float32), score, np.zeros((5, 2), np.float32))


def test_a_central_face_comes_before_a_larger_one_in_the_corner():
    central, corner = face(90, 90, 110, 110), face(0, 0, 40, 40)
    assert ranked([corner, central], (200, 200, 3)) == [central, corner]
    assert ranked([corner, face(0, 0, 190, 190)], (200, 200, 3))[1] is corner
