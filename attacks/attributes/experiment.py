"""The attribute attacks on one scheme: lift, attack, measure."""

import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.attackers import TRAINED, KernelMachine, Lesson
from attacks.attributes.features import Features
from attacks.attributes.known_decoys import Flags
from attacks.attributes.measures import Measures, measure
from attacks.attributes.plan import Bench
from attacks.attributes.rows import AttributeRow
from attacks.attributes.seen import (
    ByAttribute,
    Codes,
    Progress,
    Seen,
    own_templates,
    search_work,
    see_own,
    see_victims,
)
from attacks.outcomes import POOLED, Knowledge, Scheme
from templates.distances import Metric

_KNN, _LIKELIHOOD, _STRIP, _RULE = "knn", "likelihood", "strip", "rule"
# Products of two descriptors that take as long as one attacker's training on one template: of the
# order of a millisecond, and of the progress only.
_TRAINING_WORK = 30_000


def run_scheme(
    bench: Bench, scheme: Scheme, *, progress: Progress | None = None
) -> list[AttributeRow]:
    """Attack one scheme with every attacker of the plan, for every attribute.

    Parameters
    ----------
    bench
        From `prepare`.
    scheme
        Raw descriptors, or a strategy with the pool of the lifting faces or the generator. hybrid+
        lifts the attacked faces by their true labels, as the paper does.
    progress
        Called with the work that was just done; `work_of` says how much there is. Never called by
        two threads at once.

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
    advance = None if progress is None else _one_at_a_time(progress)
    training = _TRAINING_WORK * own_templates(bench, scheme)
    own, held = see_own(bench, scheme, advance)
    victims = see_victims(bench, scheme, advance)
    taught, kept = own.take(np.flatnonzero(~held)), own.take(np.flatnonzero(held))
    predictions: list[_Predictions] = [
        # The vote learns from no template, so that all of the attacker's own try it.
        _Predictions(_KNN, metric, Knowledge.ALGORITHM, victims.votes[metric], own.votes[metric])
        for metric in victims.votes
    ]
    for name in bench.plan.attackers:
        begun = time.perf_counter()
        model = TRAINED[name](_lesson(bench, name, taught.features, kept.features, taught, kept))
        found, tried = _chosen(model.scores(victims.features)), _chosen(model.scores(kept.features))
        spent = time.perf_counter() - begun
        predictions.append(_Predictions(name, None, Knowledge.ALGORITHM, found, tried, spent))
        if advance is not None:
            advance(training)
    if not (victims.guessed is None or taught.guessed is None or kept.guessed is None):
        begun = time.perf_counter()
        pooled = scheme.decoys == POOLED
        knowledge = Knowledge.DECOYS if pooled else Knowledge.ALGORITHM
        machine = KernelMachine(_lesson(bench, "svm", taught.guessed, kept.guessed, taught, kept))
        scores, own_scores = machine.scores(victims.guessed), machine.scores(kept.guessed)
        spent = time.perf_counter() - begun
        found, tried = _chosen(scores), _chosen(own_scores)
        name = _STRIP if pooled else _LIKELIHOOD
        predictions.append(_Predictions(name, None, knowledge, found, tried, spent))
        if victims.absent:
            found = _chosen({a: _among(scores[a], flags) for a, flags in victims.absent.items()})
            tried = _chosen({a: _among(own_scores[a], flags) for a, flags in kept.absent.items()})
            predictions.append(_Predictions(_RULE, None, knowledge, found, tried, spent))
        if advance is not None:
            advance(training)
    rows: list[AttributeRow] = []
    for each in predictions:
        tried_on = own.truth if each.attacker == _KNN else kept.truth
        rows += _rows(bench, scheme, each, victims.truth, tried_on)
    return rows


def work_of(bench: Bench, scheme: Scheme) -> int:
    """Work that `run_scheme` reports as progress, in products of two descriptors."""
    trained = len(bench.plan.attackers) + (scheme.decoys is not None)
    return search_work(bench, scheme) + trained * _TRAINING_WORK * own_templates(bench, scheme)


def _one_at_a_time(progress: Progress) -> Progress:
    lock = threading.Lock()

    def advance(work: int) -> None:
        with lock:
            progress(work)

    return advance


@dataclass(frozen=True, eq=False, repr=False)
class _Predictions:
    """What one attacker says of the attacked faces, and of its own held-out ones."""

    attacker: str
    metric: Metric | None
    knowledge: Knowledge
    attacked: ByAttribute
    held: ByAttribute
    seconds: float = 0.0


def _lesson(
    bench: Bench, attacker: str, features: Features, held: Features, taught: Seen, kept: Seen
) -> Lesson:
    rows = np.arange(len(features))
    if attacker == "svm" and len(rows) > bench.plan.kernel_most:
        chance = np.random.default_rng([bench.seed, 2])
        rows = np.sort(chance.permutation(len(rows))[: bench.plan.kernel_most])
    return Lesson(
        features.take(rows),
        {name: codes[rows] for name, codes in taught.truth.items()},
        held,
        kept.truth,
        {name: len(classes) for name, classes in bench.split.attack.classes.items()},
        bench.seed,
    )


def _rows(
    bench: Bench, scheme: Scheme, found: _Predictions, truth: ByAttribute, held: ByAttribute
) -> Iterator[AttributeRow]:
    attack = bench.split.attack
    for name, predicted in found.attacked.items():
        classes = attack.classes[name]

        def against(predicted: Codes, truth: Codes, name: str = name) -> Measures:
            return measure(
                predicted,
                truth,
                training=attack.labels[name],
                classes=len(attack.classes[name]),
                seed=bench.seed,
            )

        yield AttributeRow(
            scheme=scheme,
            attribute=name,
            attacker=found.attacker,
            metric=found.metric,
            knowledge=found.knowledge,
            classes=classes,
            measures=against(predicted, truth[name]),
            held_out=against(found.held[name], held[name]).strength,
            seed=bench.seed,
            seconds=found.seconds,
        )


def _chosen(scores: Mapping[str, NDArray[np.float64]]) -> ByAttribute:
    return {name: np.argmax(each, axis=1).astype(np.int64) for name, each in scores.items()}


def _among(scores: NDArray[np.float64], allowed: Flags) -> NDArray[np.float64]:
    return np.where(allowed, scores, -np.inf)
