"""Features are functions of the set, and hold what their description says."""

import numpy as np

from attacks.attributes.features import MOST_NEIGHBOURS, Axes, features_of
from attacks.attributes.neighbours import nearest_neighbours
from templates.decoys import DecoyPool
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.attacks.attributes.people import faces

GALLERY, VICTIMS, DECOYS = faces(200, seed=1), faces(12, seed=2), faces(40, seed=3)
AXES = Axes.fit(GALLERY)
TEMPLATES = lift(
    VICTIMS.embeddings,
    strategy="hybrid",
    m=4,
    source=DecoyPool(DECOYS.embeddings),
    stream=Keystream.seeded("features"),
)


def features(templates: SubspaceBatch) -> np.ndarray:
    near = nearest_neighbours(templates, GALLERY.embeddings, k=MOST_NEIGHBOURS)
    return features_of(templates, AXES, near, GALLERY)


def test_another_basis_of_the_same_sets_gives_the_same_features() -> None:
    turns = np.linalg.qr(np.random.default_rng(0).standard_normal((12, 4, 4)))[0]
    turned = SubspaceBatch(TEMPLATES.feet, (turns @ TEMPLATES.bases).astype(np.float32))
    assert np.abs(turned.bases - TEMPLATES.bases).max() > 0.1
    here, there = features(TEMPLATES), features(turned)
    np.testing.assert_allclose(here, there, atol=1e-5)


def test_features_agree_with_their_formulas() -> None:
    rows = features(TEMPLATES)
    w, mu = AXES.discriminants.astype(np.float64), AXES.prototypes.astype(np.float64)
    assert (len(w), len(mu)) == (1 + 3, 2 + 3)
    for row, template in zip(rows, TEMPLATES, strict=True):
        p, basis = template.foot.astype(np.float64), template.basis.astype(np.float64)
        projection = basis.T @ basis
        moments = w @ projection @ w.T
        widths = np.sqrt(np.einsum("ci,ij,cj->c", mu, projection, mu))
        wanted = [
            w @ p,
            moments[np.triu_indices(4)],
            [np.linalg.norm(p)],
            mu @ p + template.radii[0] * widths,
            template.radii[0] * np.sqrt(np.diag(moments)),
        ]
        start = np.concatenate(wanted)
        np.testing.assert_allclose(row[: len(start)], start, atol=1e-5)
        # Two metrics, two numbers of neighbours, five classes; shares of an attribute add to 1.
        assert len(row) == len(start) + 2 * 2 * 5
        np.testing.assert_allclose(row[len(start) :].sum(), 2 * 2 * 2, atol=1e-5)


def test_discriminants_are_those_of_scikit_learn() -> None:
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis

    many = faces(4000, seed=4, n=16)
    own = Axes.fit(many).discriminants[0]
    theirs = LinearDiscriminantAnalysis(solver="lsqr").fit(many.embeddings, many.labels["gender"])
    axis = theirs.coef_[0] / np.linalg.norm(theirs.coef_[0])
    # Ours is shrunk a little.
    assert own @ axis > 0.99
