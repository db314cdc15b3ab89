"""The attribute attacks on one scheme: lift, attack, measure."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.attackers import Logistic, TrainingSet
from attacks.attributes.features import Features
from attacks.attributes.measures import InferenceMeasures, measure
from attacks.attributes.observations import (
    ByAttribute,
    Codes,
    observe_attacked,
    observe_own,
)
from attacks.attributes.plan import Setup
from attacks.attributes.rows import AttributeRow
from attacks.outcomes import POOLED, KnowledgeLevel, Scheme
from templates.distances import Metric

ByClass = Mapping[str, NDArray[np.float64]]

KNN, LOGISTIC, SECOND, STRIP = "knn", "logistic", "second moments", "strip"


def run_scheme(setup: Setup, scheme: Scheme) -> list[AttributeRow]:
    """Attack one scheme with every attacker of the plan, for every attribute.

    Parameters
    ----------
    scheme
        Raw descriptors, or a strategy with the pool of the lifting faces or the generator. hybrid+
        lifts the attacked faces by their true labels, as the paper does.

    Returns
    -------
    list of AttributeRow
        The paper's attacker by both metrics (raw: by one, as they agree), the trained attackers,
        and for pools those that hold the pool.

    Raises
    ------
    AuditError
        The scheme cannot be run on these faces.
    LiftingError, DecoyError
        There are too few decoys for the scheme.

    Notes
    -----
    The attacker lifts its own faces by the same algorithm. A secret pool it does not have: it uses
    faces of its own, each fold's as the decoys of the fold, so that neither a face nor its decoys
    had a part in the axes or in the gallery that it is judged by. The generator it has.
    Memory holds the templates of one tile at a time.
    """
    own, is_held_out = observe_own(setup, scheme)
    victims = observe_attacked(setup, scheme)
    training, validation = (
        own.take(np.flatnonzero(~is_held_out)),
        own.take(np.flatnonzero(is_held_out)),
    )
    predictions: list[_Predictions] = [
        # The vote learns from no template, so that all of the attacker's own try it.
        _Predictions(
            KNN, metric, KnowledgeLevel.ALGORITHM, victims.votes[metric], own.votes[metric]
        )
        for metric in victims.votes
    ]
    truths = training.truth, validation.truth
    features = training.features, validation.features, victims.features
    if setup.plan.trained:
        choices = _trained(setup, features, truths)
        predictions.append(_Predictions(LOGISTIC, None, KnowledgeLevel.ALGORITHM, *choices))
    if not (victims.guessed is None or training.guessed is None or validation.guessed is None):
        name, knowledge = SECOND, KnowledgeLevel.ALGORITHM
        if scheme.decoys == POOLED:
            name, knowledge = STRIP, KnowledgeLevel.DECOYS
        features = training.guessed, validation.guessed, victims.guessed
        choices = _trained(setup, features, truths, foot=True)
        predictions.append(_Predictions(name, None, knowledge, *choices))
    rows: list[AttributeRow] = []
    for prediction in predictions:
        held_out_truth = own.truth if prediction.attacker == KNN else validation.truth
        rows += _rows(setup, scheme, prediction, victims.truth, held_out_truth)
    return rows


@dataclass(frozen=True, eq=False, repr=False)
class _Predictions:
    """What one attacker says of the attacked faces, and of its own held-out ones."""

    attacker: str
    metric: Metric | None
    knowledge: KnowledgeLevel
    attacked: ByAttribute
    held: ByAttribute
    seconds: float = 0.0


def _trained(
    setup: Setup,
    features: tuple[Features, Features, Features],
    truths: tuple[ByAttribute, ByAttribute],
    *,
    foot: bool = False,
) -> tuple[ByAttribute, ByAttribute, float]:
    """Train an attacker; its predictions of the attacked and of the held-out faces, and seconds.

    ``features`` are of the training, the held-out and the attacked faces, ``truths`` of the first
    two.
    """
    start = time.perf_counter()
    training, held_out, attacked = features
    classes = {name: len(of) for name, of in setup.split.attack.classes.items()}
    model = Logistic(TrainingSet(training, truths[0], held_out, truths[1], classes), foot=foot)
    made = _chosen(model.scores(attacked)), _chosen(model.scores(held_out))
    return *made, time.perf_counter() - start


def _rows(
    setup: Setup,
    scheme: Scheme,
    predictions: _Predictions,
    truth: ByAttribute,
    held_out_truth: ByAttribute,
) -> Iterator[AttributeRow]:
    attack = setup.split.attack
    for name, predicted in predictions.attacked.items():
        classes = attack.classes[name]

        def against(predicted: Codes, truth: Codes, name: str = name) -> InferenceMeasures:
            return measure(
                predicted,
                truth,
                training=attack.labels[name],
                classes=len(attack.classes[name]),
                seed=setup.seed,
            )

        yield AttributeRow(
            scheme=scheme,
            attribute=name,
            attacker=predictions.attacker,
            metric=predictions.metric,
            knowledge=predictions.knowledge,
            classes=classes,
            measures=against(predicted, truth[name]),
            held_out=against(predictions.held[name], held_out_truth[name]).strength,
            seed=setup.seed,
            seconds=predictions.seconds,
        )


def _chosen(scores: ByClass) -> ByAttribute:
    return {name: np.argmax(values, axis=1).astype(np.int64) for name, values in scores.items()}
