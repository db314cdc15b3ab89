"""How faces are divided."""

from typing import Any

import numpy as np
import pytest

from attacks.attributes.faces import LabelledFaces, attacker_faces, split
from attacks.errors import AuditError
from tests.attacks.attributes.people import CLASSES, faces

TRAIN, VALIDATION = faces(60, seed=1), faces(20, seed=2)


def keys(some: LabelledFaces) -> set[bytes]:
    return {row.tobytes() for row in some.descriptors}


def test_parts_have_no_face_in_common_and_leave_none_out() -> None:
    parts = split(TRAIN, VALIDATION, lifting=25, attack=35, attacked_most=None, seed=3)
    assert [len(parts.lifting), len(parts.attack), len(parts.attacked)] == [25, 35, 20]
    assert keys(parts.lifting) | keys(parts.attack) == keys(TRAIN)
    assert keys(parts.attacked) == keys(VALIDATION)


def test_labels_follow_their_faces() -> None:
    label = {r.tobytes(): c for r, c in zip(TRAIN.descriptors, TRAIN.labels["race"], strict=True)}
    some = split(TRAIN, VALIDATION, lifting=25, attack=30, attacked_most=7, seed=3)
    assert [len(some.attack), len(some.attacked)] == [30, 7]
    for row, code in zip(some.attack.descriptors, some.attack.labels["race"], strict=True):
        assert label[row.tobytes()] == code


def test_a_seed_gives_the_same_parts_and_another_seed_others() -> None:
    one, same, other = (
        split(TRAIN, VALIDATION, lifting=25, attack=35, attacked_most=None, seed=s)
        for s in (4, 4, 5)
    )
    assert one.lifting.descriptors.tobytes() == same.lifting.descriptors.tobytes()
    assert keys(one.lifting) != keys(other.lifting)


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ({"lifting": 60, "attack": None}, "60 lifting faces and the others"),
        ({"lifting": 0, "attack": None}, "must be 1 or more"),
        ({"lifting": 30, "attack": 31}, "cannot be taken from 60 training faces"),
    ],
)
def test_sizes_that_do_not_fit_are_named(sizes: dict[str, Any], said: str) -> None:
    with pytest.raises(AuditError, match=said):
        attacker_faces(60, **sizes)


def test_without_a_face_to_attack_it_is_said() -> None:
    nobody = VALIDATION.take(np.arange(0))
    with pytest.raises(AuditError, match="at least one face must be attacked"):
        split(TRAIN, nobody, lifting=25, attack=35, attacked_most=None, seed=0)


def test_labels_that_are_no_class_are_counted_and_not_shown() -> None:
    rows = TRAIN.descriptors[:2]
    with pytest.raises(AuditError, match="1 of 2 labels of gender are no class of it") as error:
        LabelledFaces.of_names(rows, {"gender": ["Male", "x9"]}, {"gender": CLASSES["gender"]})
    assert "x9" not in str(error.value)


def test_names_come_back_as_they_were_given() -> None:
    names = ["Female", "Male", "Female"]
    some = LabelledFaces.of_names(
        TRAIN.descriptors[:3], {"gender": names}, {"gender": CLASSES["gender"]}
    )
    assert some.names("gender") == names
    assert [a.gender for a in some.decoy_attributes()] == names
    assert [a.race for a in some.decoy_attributes()] == [None] * 3
