import hashlib
import subprocess
import sys

import cv2
import numpy as np
import pytest

from models.synthetic import draw_face, draw_people, encode_photo


def test_a_face_is_a_small_rgb_picture():
    face = draw_face(3, 1)
    assert face.shape == (112, 112, 3)
    assert face.dtype == np.uint8
    assert face.std() > 10


def test_the_same_seeds_give_the_same_bytes_in_another_process():
    program = (
        "import hashlib; from models.synthetic import draw_face;"
        "print(hashlib.sha256(draw_face(11, 4).tobytes()).hexdigest())"
    )
    seen = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert seen == hashlib.sha256(draw_face(11, 4).tobytes()).hexdigest()


def test_photos_of_a_person_differ_and_people_differ_more():
    people = draw_people(range(20), range(2)).astype(np.float64).reshape(20, 2, 112, 112, 3)
    faces = people[:, :, 40:100, 25:87]  # where the background is not
    faces = faces - faces.mean(axis=(2, 3), keepdims=True)
    faces = faces / faces.std(axis=(2, 3), keepdims=True)

    def apart(a: np.ndarray, b: np.ndarray) -> float:
        return float(((a - b) ** 2).mean())

    same = [apart(faces[i, 0], faces[i, 1]) for i in range(20)]
    other = [apart(faces[i, 0], faces[(i + 1) % 20, 1]) for i in range(20)]
    assert min(same) > 0
    assert np.median(other) > 1.5 * np.median(same)


def test_size_scales_the_picture():
    small = draw_face(5, 0, size=112)
    large = draw_face(5, 0, size=224)
    assert large.shape == (224, 224, 3)
    reduced = cv2.resize(large, (112, 112), interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - reduced.astype(int)).mean() < 8


def test_people_come_in_order():
    people = draw_people(range(4, 6), range(3))
    assert people.shape == (6, 112, 112, 3)
    assert np.array_equal(people[4], draw_face(5, 1))


def test_an_encoded_photo_decodes_to_itself():
    face = draw_face(2, 2)
    decoded = cv2.imdecode(np.frombuffer(encode_photo(face), np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert np.array_equal(decoded[:, :, ::-1], face)


@pytest.mark.parametrize(
    ("arguments", "said"), [((-1, 0), "seeds"), ((0, -1), "seeds"), ((0, 0, 8), "16 to 1024")]
)
def test_impossible_requests_are_refused(arguments, said):
    identity, photo, *size = arguments
    with pytest.raises(ValueError, match=said):
        draw_face(identity, photo, **({"size": size[0]} if size else {}))
