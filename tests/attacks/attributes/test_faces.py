"""How faces are divided."""

import numpy as np
import pytest

from attacks.attributes.faces import LabelledFaces, split
from attacks.outcomes import AuditError
from tests.attacks.attributes.people import CLASSES, faces

TRAIN, VALIDATION = faces(60, seed=1), faces(20, seed=2)


def keys(some: LabelledFaces) -> set[bytes]:
    return {row.tobytes() for row in some.embeddings}


def test_parts_have_no_face_in_common_and_labels_follow_their_faces() -> None:
    whole, same, other = (
        split(TRAIN, VALIDATION, lifting=25, attack=35, attacked_most=None, seed=seed)
        for seed in (3, 3, 4)
    )
    assert [len(whole.lifting), len(whole.attack), len(whole.attacked)] == [25, 35, 20]
    assert keys(whole.lifting) | keys(whole.attack) == keys(TRAIN)
    assert keys(whole.attacked) == keys(VALIDATION)
    assert whole.lifting.embeddings.tobytes() == same.lifting.embeddings.tobytes()
    assert keys(whole.lifting) != keys(other.lifting)
    some = split(TRAIN, VALIDATION, lifting=25, attack=30, attacked_most=7, seed=3)
    assert [len(some.attack), len(some.attacked)] == [30, 7]
    label = {r.tobytes(): c for r, c in zip(TRAIN.embeddings, TRAIN.labels["race"], strict=True)}
    for row, code in zip(some.attack.embeddings, some.attack.labels["race"], strict=True):
        assert label[row.tobytes()] == code


def test_without_a_face_to_attack_it_is_said() -> None:
    nobody = VALIDATION.take(np.arange(0))
    with pytest.raises(AuditError, match="at least one face must be attacked"):
        split(TRAIN, nobody, lifting=25, attack=35, attacked_most=None, seed=0)


def test_decoys_are_labelled() -> None:
    genders, races = ["Female", "Male", "Female"], ["A", "C", "B"]
    rows = TRAIN.embeddings[:3]
    some = LabelledFaces.of_names(rows, {"gender": genders, "race": races}, CLASSES)
    labels = some.decoy_attributes()
    assert [label.gender for label in labels] == genders
    assert [label.race for label in labels] == races
