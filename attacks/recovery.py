"""How good a guess of the hidden descriptor is: against a fresh photo, and against the truth."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import score
from attacks.outcomes import AttackOutcome, Knowledge, Leaked, Property
from attacks.population import Subjects
from attacks.system import System
from templates.contract.canonical import Json
from templates.contract.document import Level, Rate
from verify.metrics import rate


@dataclass(frozen=True, eq=False, repr=False)
class Recovery:
    """Guesses of the descriptors that templates hide, scored.

    Parameters
    ----------
    to_truth, to_fresh : (V,) float64
        Cosines to the descriptor that was lifted, and to a fresh photo of the victim.
    matched
        By level: guesses that reach the raw threshold on the fresh photo. In any system without
        protection, the guess is then taken for the person.
    accepted
        By level: guesses that the service accepts against a template lifted anew from the fresh
        photo: a service that has replaced the stolen template.
    """

    to_truth: NDArray[np.float64]
    to_fresh: NDArray[np.float64]
    matched: Mapping[str, Rate]
    accepted: Mapping[str, Rate]

    def details(self) -> dict[str, Json]:
        """Return the figures beside the success rate."""
        return {
            "cosine_to_truth_mean": float(self.to_truth.mean()),
            "cosine_to_truth_5_percent": float(np.quantile(self.to_truth, 0.05)),
            "cosine_to_truth_95_percent": float(np.quantile(self.to_truth, 0.95)),
            "cosine_to_fresh_mean": float(self.to_fresh.mean()),
            "matched_by_level": {name: share.to_json() for name, share in self.matched.items()},
            "accepted_when_renewed": {
                name: share.to_json() for name, share in self.accepted.items()
            },
        }


def score_guesses(
    system: System, guesses: NDArray[np.floating], *, people: Subjects | None = None
) -> Recovery:
    """Score one guess a victim.

    Parameters
    ----------
    guesses : (V, n) floating
        In the order of ``system.victims``; their length does not matter. A zero row is a failure.
    people
        Who was attacked instead of ``system.victims``.
    """
    attacked = people or system.victims
    lengths = np.linalg.norm(guesses.astype(np.float64), axis=1, keepdims=True)
    unit = guesses / np.maximum(lengths, np.finfo(np.float64).tiny)
    truth = attacked.enrolled.astype(np.float64)
    fresh = attacked.fresh.astype(np.float64)
    to_fresh = np.einsum("ij,ij->i", unit, fresh)
    renewed = (
        system.renewed
        if people is None
        else system.lift(attacked.fresh, "renewed from the fresh photo")
    )
    probes = np.ascontiguousarray(unit, dtype=np.float32)
    matched: dict[str, Rate] = {}
    accepted: dict[str, Rate] = {}
    scores = score(probes, renewed, system.nobody, system.points, paired=True)
    for level in system.levels:
        hits = to_fresh >= system.raw_thresholds[level.name]
        matched[level.name] = rate(int(np.count_nonzero(hits)), len(hits))
        opened = scores.at(level) & (lengths[:, 0] > 0)
        accepted[level.name] = rate(int(np.count_nonzero(opened)), len(opened))
    return Recovery(
        to_truth=np.einsum("ij,ij->i", unit, truth),
        to_fresh=to_fresh,
        matched=matched,
        accepted=accepted,
    )


def fmr_of(level: Level) -> float:
    """Return what a stranger reaches at a level: its FMR."""
    return level.fmr.value if level.target_fmr is None else level.target_fmr


def recovery_outcome(
    system: System,
    guesses: NDArray[np.floating],
    *,
    attack: str,
    leaked: Leaked = Leaked.HOLDER_KEYS,
    knowledge: Knowledge,
    assumption: str,
    variant: str = "",
    unjudged: str | None = None,
    people: Subjects | None = None,
    details: Mapping[str, Json] | None = None,
) -> AttackOutcome:
    """Report guesses: success is a match with the fresh photo at the default level, raw."""
    recovery = score_guesses(system, guesses, people=people)
    return AttackOutcome(
        attack=attack,
        variant=variant,
        breaks=Property.IRREVERSIBILITY,
        leaked=leaked,
        knowledge=knowledge,
        assumption=assumption,
        scheme=system.scheme,
        level=system.level.name,
        measured=recovery.matched[system.level.name],
        chance=fmr_of(system.level),
        unjudged=unjudged,
        details={**recovery.details(), **(details or {})},
    )
