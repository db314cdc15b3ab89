import cv2
import numpy as np

from models.synthetic import draw_face, draw_people, draw_person


def test_a_person_and_a_photo_are_their_seeds():
    people = draw_people(range(4, 6), range(3))
    assert people.shape == (6, 112, 112, 3)
    assert people.dtype == np.uint8
    assert np.array_equal(people[4], draw_face(5, 1))
    assert len({face.tobytes() for face in people}) == 6
    assert draw_person(4) == draw_person(4) != draw_person(5)


def test_size_scales_the_picture():
    small, large = draw_face(5, 0, size=112), draw_face(5, 0, size=224)
    assert large.shape == (224, 224, 3)
    reduced = cv2.resize(large, (112, 112), interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - reduced.astype(int)).mean() < 8
