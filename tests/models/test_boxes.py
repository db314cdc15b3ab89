import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from models.boxes import (
    MAX_CANDIDATES,
    Face,
    non_maximum_suppression,
    ranked,
)


def overlap(a, b) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    inner = max(width, 0) * max(height, 0)
    total = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - inner
    return inner / total if total > 0 else 0.0


def brute_force(boxes, scores, threshold) -> list[int]:
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda i: (-scores[i], i)):
        if all(overlap(boxes[i], boxes[j]) <= threshold for j in kept):
            kept.append(i)
    return kept


box = st.tuples(*[st.integers(0, 60)] * 2, *[st.integers(1, 40)] * 2).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(box, st.integers(1, 6)), min_size=1, max_size=25),
    st.sampled_from([0.3, 0.4, 0.7]),
)
def test_equals_greedy_suppression_by_hand(items, threshold):
    boxes = np.array([b for b, _ in items], dtype=np.float32)
    scores = np.array([s for _, s in items], dtype=np.float32)
    kept = non_maximum_suppression(boxes, scores, threshold=threshold)
    assert kept.tolist() == brute_force(boxes.astype(float), scores, threshold)


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
