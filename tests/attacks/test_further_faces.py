import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.further_faces import FurtherFaces, strangers_among
from tests.verify.synthetic import unit


def test_victims_are_left_out_by_name_and_by_photo() -> None:
    rows = unit(np.random.default_rng(0).normal(size=(8, 40)))
    names = ["ada", "ada", "bea", "bea"]
    # The same photo encoded again; the same name; a calibrating person; nobody known.
    again = unit(rows[0] + 1e-3 * rows[7])
    further = FurtherFaces(
        "more", np.stack([again, rows[4], rows[2], rows[5]]), ("", "ada", "bea", "")
    )
    kept = strangers_among(further, rows[:4], names, {"ada"})
    np.testing.assert_array_equal(kept.embeddings, np.stack([rows[2], rows[5]]))
    assert (kept.people, kept.left_out) == (("bea", ""), 2)
    assert kept.to_json() == {"name": "more", "faces": 2, "left_out": 2}


def test_embeddings_of_another_pack_are_refused() -> None:
    rows = unit(np.random.default_rng(0).normal(size=(4, 40)))
    with pytest.raises(AuditError, match="same pack"):
        strangers_among(FurtherFaces("more", rows[:, :8], ("",) * 4), rows, ["a"] * 4, {"a"})
