"""Impersonation: a decoy's owner tries to log in where they are a decoy (docs/method.md §4.3)."""

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import Scores, score
from attacks.outcomes import POOLED, AttackOutcome, Knowledge, Leaked, Property
from attacks.recovery import fmr_of
from attacks.stored.recording import decoy_count, recorded_lift
from attacks.system import System
from templates.contract.canonical import Json
from templates.contract.document import Rate
from templates.decoys import DecoyGenerator, DecoyPool
from templates.decoys.fitting import FACES_PER_DIMENSION
from templates.space.subspace import SubspaceBatch
from verify.metrics import rate, subject_bootstrap

Pairs = NDArray[np.int64]
"""(P, 2): person who comes, template they come to."""


def impersonation_attack(system: System) -> list[AttackOutcome]:
    """Owners of decoys against the templates that hold them.

    With a pool they come with another photo of themselves, where there is one, else with the photo
    in the pool. With a generator they are the first half of the attacker's faces, which a generator
    is fitted to here, and come to every template that was lifted with it; the others are strangers
    to it. A generator that is fitted to few people lets them in, and a service's is fitted to
    thousands: with fewer than ``FACES_PER_DIMENSION`` for each number the outcome is not judged.
    Empty for a scheme without decoys.
    """
    if not decoy_count(system.scheme) or system.source is None:
        return []
    if system.scheme.decoys == POOLED and isinstance(system.source, DecoyPool):
        return [_pooled(system, system.source)]
    return [_generated(system)]


def _pooled(system: System, pool: DecoyPool) -> AttackOutcome:
    entries = pool.entries[0]
    lift = recorded_lift(system, system.victims.enrolled, "templates that hold owners")
    drawn = lift.decoys.reshape(-1, pool.n)
    owners = np.argmax(drawn @ entries.T, axis=1)
    pairs = np.stack([owners, np.arange(len(drawn)) // lift.decoys.shape[1]], axis=1)
    photo = entries if system.owners is None else system.owners.fresh
    same = "the photo of the pool" if system.owners is None else "another photo of themselves"
    return _outcome(
        system,
        photo,
        lift.templates,
        pairs,
        variant="",
        chance=fmr_of(system.level),
        assumption=(
            f"The owner of a decoy comes with {same} to a template that holds their decoy; "
            "success is acceptance."
        ),
        unjudged=None,
        details={"with_the_photo_of_the_pool": _rate(system, entries, lift.templates, pairs)},
    )


def _generated(system: System) -> AttackOutcome:
    faces = system.attacker
    half = len(faces) // 2
    enough = half >= FACES_PER_DIMENSION * faces.shape[1]
    fitted, strangers = faces[:half], faces[half:]
    noise = 0.0 if system.source is None else system.source.noise
    generator = DecoyGenerator.fit(fitted, noise=noise)
    lift = recorded_lift(
        system, system.victims.enrolled, "decoys of a fitted generator", source=generator
    )
    scores = score(strangers, lift.templates, system.contract, system.points)
    accepted = scores.at(system.level)
    control = rate(int(np.count_nonzero(accepted)), accepted.size)
    pairs = np.argwhere(np.ones((len(fitted), len(lift.templates)), dtype=np.bool_))
    return _outcome(
        system,
        fitted,
        lift.templates,
        pairs,
        variant="people of the generator",
        chance=control.value,
        assumption=(
            "A generator is fitted to half of some people, who come with the very photos "
            "of the fit to every template that was lifted with it; success is acceptance, and "
            "chance is how often the other half is accepted there: "
            "the contract was calibrated with the scheme's own generator."
        ),
        unjudged=None
        if enough
        else f"the attacker's generator was fitted to {half} faces for {generator.n} numbers, a "
        f"service's to {FACES_PER_DIMENSION} or more for each",
        details={"strangers": control.to_json(), "fitted_to": half},
    )


def _outcome(
    system: System,
    photos: NDArray[np.float32],
    templates: SubspaceBatch,
    pairs: Pairs,
    *,
    variant: str,
    chance: float,
    assumption: str,
    unjudged: str | None,
    details: dict[str, Json],
) -> AttackOutcome:
    by_level: dict[str, Json] = {}
    scores = _scored(system, photos, templates, pairs)
    for level in system.levels:
        by_level[level.name] = _counted(
            scores.at(level), pairs, len(photos), len(templates)
        ).to_json()
    accepted = scores.at(system.level)
    return AttackOutcome(
        attack="impersonation",
        variant=variant,
        breaks=Property.IMPERSONATION,
        leaked=Leaked.DATABASE,
        knowledge=Knowledge.ALGORITHM,
        assumption=assumption,
        scheme=system.scheme,
        level=system.level.name,
        measured=_counted(accepted, pairs, len(photos), len(templates)),
        chance=chance,
        unjudged=unjudged,
        details={"people": len(np.unique(pairs[:, 0])), "by_level": by_level, **details},
    )


def _rate(
    system: System, photos: NDArray[np.float32], templates: SubspaceBatch, pairs: Pairs
) -> dict[str, Json]:
    accepted = _scored(system, photos, templates, pairs).at(system.level)
    return rate(int(np.count_nonzero(accepted)), len(accepted)).to_json()


def _scored(
    system: System, photos: NDArray[np.float32], templates: SubspaceBatch, pairs: Pairs
) -> Scores:
    """Scores of the pairs, (P,)."""
    every = score(photos, templates, system.contract, system.points)
    row, column = pairs.T
    return Scores(every.similarities[row, column], every.scores[row, column])


def _counted(accepted: NDArray[np.bool_], pairs: Pairs, owners: int, victims: int) -> Rate:
    """Count acceptances, with an interval that resamples people: trials share them."""
    people = pairs + np.array([0, owners])
    met = np.zeros((owners, victims))
    np.add.at(met, (pairs[:, 0], pairs[:, 1]), 1)

    def weighted_trials(weights: NDArray[np.float64]) -> float:
        return float(weights[:owners] @ met @ weights[owners:])

    return subject_bootstrap(
        people[accepted],
        people=owners + victims,
        trials=len(pairs),
        weighted_trials=weighted_trials,
    )
