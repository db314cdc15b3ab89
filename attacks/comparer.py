"""Linkage by a comparer that is trained on templates of the attacker's own people.

``attacks.linkage`` compares two templates by one number that was thought of beforehand. Here
several such numbers of a pair are weighed by logistic regression, fitted to pairs of which the
attacker knows who they are of. Both templates are un-rotated: the keys leaked.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.likelihood import attacker_moments
from attacks.linkage import foot_cosines, linkage_outcome, nearest_similarities
from attacks.outcomes import CONTROL, AttackOutcome, Leaked
from attacks.population import Subjects
from attacks.second_order import likeliest_descriptors
from attacks.stored.recording import decoy_count
from attacks.system import System
from attacks.unlinkability import unlinkability
from templates.contract.canonical import Json
from templates.distances import Metric, pairwise_distances, similarity
from templates.space.subspace import SubspaceBatch
from verify.metrics import equal_error_rate, fnmr_at_fmr, rate, resolvable

LIFTINGS = 2
"""Of the victims, and of the people that the comparer is trained on, with other decoys each."""
LEAST_MATES = 20
"""People with two photos that a comparer is trained on at least."""
MOST_PEOPLE = 60
TARGET_FMR = 1e-3
_WHITENINGS = (0.0, 0.25, 0.5)
"""Powers of the inverse second moment of faces that spans are turned by before they are compared:
axes along which faces vary less count more, and with 1/2 all count alike."""
_POWER_STEPS = 8
_TILE = 8

Array64 = NDArray[np.float64]


class PairFeatures:
    """Numbers of a pair of templates, from what the attacker knows of faces and decoys."""

    def __init__(self, system: System) -> None:
        self._count = decoy_count(system.scheme)
        self._faces, self._decoys = attacker_moments(system)
        values, axes = np.linalg.eigh(self._faces.moment)
        floored = np.maximum(values, 1e-4 * values[-1])
        self._turns = [
            np.asarray((axes * floored**-power) @ axes.T, dtype=np.float32) for power in _WHITENINGS
        ]

    def __call__(self, left: SubspaceBatch, right: SubspaceBatch) -> Array64:
        """Compare every template of one batch with every one of another, (T, U, F).

        Cosine of the nearest points and of the foot points; of the likeliest descriptors of both
        sides, to each other and to the other side's template; and for each whitening the largest
        cosine of two points of the spans, and the sum of squares of all principal cosines.
        """
        guesses = [self._guess(batch) for batch in (left, right)]
        features = [
            nearest_similarities(left, right),
            foot_cosines(left, right),
            guesses[0] @ guesses[1].T,
            _to_templates(guesses[0], right) + _to_templates(guesses[1], left).T,
        ]
        for turn in self._turns:
            features += _principal(_turned(left, turn), _turned(right, turn))
        return np.stack(features, axis=2)

    def _guess(self, batch: SubspaceBatch) -> Array64:
        return likeliest_descriptors(batch, self._faces, self._decoys, count=self._count)


def _to_templates(points: Array64, templates: SubspaceBatch) -> Array64:
    distances = pairwise_distances(points.astype(np.float32), templates, metric=Metric.SPHERICAL)
    return np.asarray(similarity(distances), dtype=np.float64)


def _turned(batch: SubspaceBatch, turn: NDArray[np.float32]) -> NDArray[np.float32]:
    """Orthonormal rows (T, m + 1, n) of the linear spans of templates, turned."""
    units = batch.feet / np.maximum(batch.foot_norms, 1e-12)[:, None].astype(np.float32)
    spans = np.concatenate([units[:, None], batch.bases], axis=1)
    turned = (spans.reshape(-1, batch.n) @ turn).reshape(spans.shape).transpose(0, 2, 1)
    return np.ascontiguousarray(np.linalg.qr(turned)[0].transpose(0, 2, 1))


def _principal(left: NDArray[np.float32], right: NDArray[np.float32]) -> list[Array64]:
    """Largest principal cosine of every two spans (T, k, n), and the sum of squares of all."""
    largest = np.empty((len(left), len(right)))
    squares = np.empty_like(largest)
    k, n = left.shape[1:]
    for start in range(0, len(left), _TILE):
        rows = slice(start, start + _TILE)
        gram = left[rows].reshape(-1, n) @ right.reshape(-1, n).T
        blocks = np.ascontiguousarray(gram.reshape(-1, k, len(right), k).transpose(0, 2, 1, 3))
        squares[rows] = np.einsum("tuij,tuij->tu", blocks, blocks)
        # A few steps of the power method: a bound from below, and near enough to tell pairs.
        vector = np.ones((*blocks.shape[:2], k, 1), dtype=np.float32)
        for _ in range(_POWER_STEPS):
            image = blocks @ vector
            vector = (image.transpose(0, 1, 3, 2) @ blocks).transpose(0, 1, 3, 2)
            vector /= np.maximum(np.linalg.norm(vector, axis=2, keepdims=True), 1e-12)
        largest[rows] = np.linalg.norm(blocks @ vector, axis=2)[:, :, 0]
    return [largest, squares]


def train_comparer(features: Array64) -> Any:
    """Fit logistic regression to pairs (L, P, P, F), of which (i, i) are mated."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    people = features.shape[1]
    mated = np.broadcast_to(np.eye(people, dtype=bool), features.shape[:3])
    comparer = make_pipeline(
        StandardScaler(), LogisticRegression(class_weight="balanced", max_iter=1_000)
    )
    return comparer.fit(features.reshape(-1, features.shape[-1]), mated.ravel())


def _lifted_pairs(
    system: System, people: Subjects, purpose: str
) -> Iterator[tuple[SubspaceBatch, SubspaceBatch]]:
    for number in range(LIFTINGS):
        yield (
            system.lift(people.enrolled, f"{purpose}, first {number}"),
            system.lift(people.fresh, f"{purpose}, second {number}"),
        )


def link_by_comparer(
    system: System, mates: Subjects, *, most_people: int = MOST_PEOPLE
) -> list[AttackOutcome]:
    """Link two templates of each victim, one of ``enrolled`` and one of the fresh photo.

    Parameters
    ----------
    mates
        The attacker's people with two photos or more, which the comparer is trained on.
    most_people
        Victims, and mates, that are used: the time grows with the square.

    Returns
    -------
    list of AttackOutcome
        Two, named ``trained-linkage``, the second of which is a control that is not judged: the
        scores of one half of the victims with the other, each said to be the mate of one. None
        where there are fewer than 20 mates.
    """
    if len(mates) < LEAST_MATES:
        return []
    features = PairFeatures(system)
    own = mates.first(most_people)
    comparer = train_comparer(
        np.stack([features(*pair) for pair in _lifted_pairs(system, own, "mates")])
    )
    victims = system.victims.first(most_people)
    scores, nearest = [], []
    for pair in _lifted_pairs(system, victims, "comparer"):
        compared = features(*pair)
        logits = comparer.decision_function(compared.reshape(-1, compared.shape[2]))
        scores.append(logits.reshape(compared.shape[:2]))
        nearest.append(compared[:, :, 0])
    trained_on: dict[str, Json] = {"people_trained_on": len(own)}
    beside = {**trained_on, "auc_of_nearest_points": separation(np.stack(nearest))["auc"]}
    # One half of the victims against the other: no true mate is among them.
    half = len(victims) // 2
    others = np.stack(scores)[:, :half, half : 2 * half]
    return [
        _outcome(system, np.stack(scores), beside, control=False),
        _outcome(system, others, trained_on, control=True),
    ]


def _outcome(
    system: System, scores: Array64, beside: dict[str, Json], *, control: bool
) -> AttackOutcome:
    """Report scores (L, V, V) whose diagonals are said to be mated."""
    return linkage_outcome(
        system,
        unlinkability(scores, seed=system.seed),
        attack="trained-linkage",
        variant="different people" if control else "keys leaked",
        leaked=Leaked.HOLDER_KEYS,
        assumption="Two templates, un-rotated: of one tenant or two, whose keys leaked; and a "
        "comparer trained on templates of the attacker's own people; success is D_sys of templates "
        + (
            "said to be of the same people, and of others (a control)"
            if control
            else "of the same people"
        ),
        unjudged=CONTROL if control else None,
        details={**beside, **separation(scores)},
    )


def separation(scores: Array64) -> dict[str, Json]:
    """AUC, EER and the share linked at FMR 1e-3 of scores (L, V, V); null where not resolvable."""
    mated = np.eye(scores.shape[1], dtype=bool)
    genuine, impostor = scores[:, mated].ravel(), np.sort(scores[:, ~mated].ravel())
    below = np.searchsorted(impostor, genuine, side="left")
    ties = np.searchsorted(impostor, genuine, side="right") - below
    linked: Json = None
    if resolvable(TARGET_FMR, impostor.size):
        missed = fnmr_at_fmr(genuine, impostor, TARGET_FMR)[1]
        linked = rate(missed.trials - missed.errors, missed.trials).to_json()
    return {
        "auc": float((below + ties / 2).mean() / impostor.size),
        "eer": equal_error_rate(genuine, impostor)[0],
        "linked_at_fmr_1e-3": linked,
    }
