"""Attacks with a person's own photo through enrollment and verification."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from attacks.impostor_presentations import verify_presentations
from models.pack import PackInfo
from templates.errors import ContractMismatch, Uncalibrated
from tests.verify.evaluation.liveness.sets import Stated, scored_set
from tests.verify.synthetic import N, calibrate_people, draw_people, make_generator
from verify import CalibrationOptions

PHOTOS = 6
OTHERS = draw_people(8, photos=(PHOTOS,), noise=0.3, seed=71).descriptors.reshape(8, PHOTOS, N)
INFO = PackInfo(
    name="tiny",
    n=N,
    embedder_file=Path("tiny.onnx"),
    embedder_sha256="ab" * 32,
    preprocessing={"size": 112, "mean": [127.5, 127.5, 127.5], "flip": False},
    detector=None,
)


@pytest.fixture(scope="module")
def contract():
    options = CalibrationOptions(probe_dims=(0,), probe_photos=(1,))
    return calibrate_people(draw_people(150), options=options).contract


# Species, subject, score, and whose embedding: (person, photo).
SHOWN = [
    *((None, "ann", 0.9, (0, shot)) for shot in range(5)),
    ("print", "ann", 0.1, (0, 5)),
    ("print", "ann", 0.1, (5, 0)),  # somebody else's photo
    *((None, "bob", 0.9, (1, shot)) for shot in range(3)),
    (None, "bob", None, (1, 3)),  # no face: neither enrolled by nor accepted
    ("mask", "bob", None, (1, 4)),
    *((None, "cid", 0.9, (2, shot)) for shot in range(2)),  # too few
    ("print", "cid", 0.1, (2, 2)),
    *((None, "dot", 0.9, (person, 1)) for person in (3, 4, 6)),  # three people
    ("print", "dot", 0.1, (3, 2)),
    (None, None, 0.9, (7, 0)),  # nobody's
]
STATED: list[Stated] = [entry[:3] for entry in SHOWN]
EMBEDDINGS = np.stack([OTHERS[person, shot] for _, _, _, (person, shot) in SHOWN])


def test_who_is_enrolled_and_what_is_tried(contract):
    scored = scored_set(STATED, EMBEDDINGS)
    verified = verify_presentations(scored, INFO, contract, make_generator())
    assert (verified.enrolled, verified.left_out) == (2, ("cid", "dot"))
    assert verified.level == contract.default_level
    # Ann is enrolled by the first, the middle and the last of five, bob by all three with a face.
    assert np.flatnonzero(verified.tried).tolist() == [1, 3, 5, 6, 10, 11]
    assert np.flatnonzero(verified.matched).tolist() == [1, 3, 5]
    assert (verified.iapmr("print", None).errors, verified.iapmr("print", None).trials) == (1, 2)
    assert verified.iapmr("print", 0.5).errors == 0
    assert (verified.iapmr("mask", None).errors, verified.iapmr("mask", None).trials) == (0, 1)
    rejected = verified.false_rejections(None)
    assert (rejected.errors, rejected.trials) == (1, 3)


def test_another_pack_and_an_unknown_level_are_refused(contract):
    scored = scored_set(STATED, EMBEDDINGS)
    other = replace(INFO, embedder_sha256="cd" * 32)
    with pytest.raises(ContractMismatch):
        verify_presentations(scored, other, contract, make_generator())
    with pytest.raises(Uncalibrated):
        verify_presentations(scored, INFO, contract, make_generator(), level="fmr-1e-9")
