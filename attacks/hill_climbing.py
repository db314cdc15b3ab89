"""Getting accepted by asking the service again and again, with its scores or its decisions only.

Every climber starts from a prior (``attacks.prior``), so that every answer counts. No
other template than the one that is asked about is used.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import decide
from attacks.errors import AuditError
from attacks.outcomes import AttackOutcome, Knowledge, Leaked, Property, Scheme
from attacks.prior import Array64, Prior, attacker_prior
from attacks.recovery import fmr_of
from attacks.system import System
from templates.contract.document import Level
from templates.space.embedding import normalised
from verify.metrics import rate

LOCKOUTS = (5, 50)
"""Consecutive failures after which a service delays, and locks (NIST SP 800-63B)."""
_ASCENT_STEPS = 40


class Answer(NamedTuple):
    """What a service says to one probe."""

    accepted: bool
    score: float | None = None
    """Similarity; None without the right to scores."""


Ask = Callable[[NDArray[np.float32]], Answer]


class Climber(StrEnum):
    """How the next probe is chosen."""

    DICTIONARY = "dictionary"
    """Decisions only: faces, in the order in which they open the most own templates that
    none before them opened."""
    GRADIENT = "gradient"
    """Scores: estimates the gradient from random steps along the principal axes of faces."""
    REGRESSION = "regression"
    """Scores: the most probable template given all scores so far; asks where that is highest."""


@dataclass(frozen=True)
class Climb:
    """One attack on one template.

    Parameters
    ----------
    attempts
        Probes sent: up to the first that was accepted, or all.
    accepted_at
        Number of the attempt that was accepted, from 1; None where none was. All before it
        failed, so a lockout after k consecutive failures ends the attack where it is above k.
    """

    attempts: int
    accepted_at: int | None


class _Asked:
    """Counts attempts, and stops at the first that is accepted or when there are no more."""

    def __init__(self, ask: Ask, most: int) -> None:
        self._ask = ask
        self._most = most
        self.attempts = 0
        self.accepted_at: int | None = None

    def over(self) -> bool:
        return self.accepted_at is not None or self.attempts >= self._most

    def __call__(self, probe: Array64) -> float:
        """Score of the direction of a probe."""
        answer = self._ask(np.ascontiguousarray(normalised(probe), dtype=np.float32))
        self.attempts += 1
        if answer.accepted:
            self.accepted_at = self.attempts
        return np.nan if answer.score is None else answer.score


def _dictionary(prior: Prior, asked: _Asked, rng: np.random.Generator) -> None:
    del rng
    for face in prior.faces:
        if asked.over():
            return
        asked(face)


def _gradient(prior: Prior, asked: _Asked, rng: np.random.Generator) -> None:
    """Evolution strategy along the faces' axes: least squares on a few steps, then a step."""
    place = prior.faces[0]
    best = asked(place)
    reach = 0.6
    while not asked.over():
        steps: list[Array64] = []
        gains: list[float] = []
        for _ in range(4):
            step = prior.axes @ rng.normal(size=len(place))
            for sign in (1.0, -1.0):
                if asked.over():
                    return
                trial = normalised(place + sign * reach * normalised(step))
                gains.append(asked(trial) - best)
                steps.append(trial - place)
        moves = np.stack(steps)
        slope = moves.T @ np.linalg.lstsq(moves @ moves.T, np.asarray(gains), rcond=1e-6)[0]
        if asked.over():
            return
        trial = normalised(place + reach * normalised(slope))
        score = asked(trial)
        index = int(np.argmax(gains))
        if gains[index] + best > max(score, best):
            place, best = place + moves[index], best + gains[index]
        elif score > best:
            place, best = trial, score
        else:
            reach *= 0.7


def _regression(prior: Prior, asked: _Asked, rng: np.random.Generator) -> None:
    """Gaussian-process regression with the prior's kernel, asked where it is highest.

    It climbs what the scores add to the mean over all templates, and not the sum: what every
    template is near to is a wolf, whose score is no higher for it.
    """
    linear, square = prior.kernel
    moment = prior.axes @ prior.axes
    probes = [prior.faces[0]]
    scores = [asked(probes[0])]
    while not asked.over():
        seen = np.stack(probes)
        turned = seen @ moment
        gram = seen @ turned.T
        trend = prior.trend[0] + prior.trend[1] * seen @ prior.mean
        trend = trend + prior.trend[2] * np.diagonal(gram)
        covariance = linear * gram + square * gram**2
        covariance[np.diag_indices_from(covariance)] += prior.noise
        weights = np.linalg.solve(covariance, np.asarray(scores) - trend)
        place = seen[int(np.argmax(scores))]
        for step in np.geomspace(0.5, 0.02, _ASCENT_STEPS):
            slope = turned.T @ (weights * (linear + 2 * square * (turned @ place)))
            slope -= (slope @ place) * place
            place = normalised(place + step * normalised(slope))
        if np.max(seen @ place) > _SAME:
            aside = prior.axes @ rng.normal(size=len(place))
            place = normalised(place + 0.3 * normalised(aside))
        scores.append(asked(place))
        probes.append(place)


_SAME = 0.999
_CLIMBERS: Mapping[Climber, Callable[[Prior, _Asked, np.random.Generator], None]] = {
    Climber.DICTIONARY: _dictionary,
    Climber.GRADIENT: _gradient,
    Climber.REGRESSION: _regression,
}


def climb(
    victims: Mapping[int, Ask],
    prior: Prior,
    climber: Climber,
    *,
    most_attempts: int,
    seed: int,
) -> list[Climb]:
    """Attack each victim on its own.

    Parameters
    ----------
    victims
        By number of the victim, what answers a unit probe, (n,) float32.

    Raises
    ------
    AuditError
        The climber needs scores, and the answers hold none.
    """
    climbs = []
    for number, ask in victims.items():
        asked = _Asked(_scored(ask) if climber is not Climber.DICTIONARY else ask, most_attempts)
        _CLIMBERS[climber](prior, asked, np.random.default_rng((seed, number)))
        climbs.append(Climb(asked.attempts, asked.accepted_at))
    return climbs


def _scored(ask: Ask) -> Ask:
    def wrapped(probe: NDArray[np.float32]) -> Answer:
        answer = ask(probe)
        if answer.score is None:
            raise AuditError("this climber needs scores: give it a key with the score right")
        return answer

    return wrapped


def climbing_outcomes(
    climber: Climber,
    climbs: Sequence[Climb],
    scheme: Scheme,
    level: Level,
    *,
    most_attempts: int,
) -> list[AttackOutcome]:
    """Report the climbs of a climber, against lockouts that are simulated here.

    All attempts before the first that is accepted have failed, so an attack is over by a number of
    consecutive failures or not at all.
    """
    scored = climber is not Climber.DICTIONARY
    reached = np.array(
        [np.inf if attack.accepted_at is None else attack.accepted_at for attack in climbs]
    )
    median = float(np.median(reached))
    fmr = fmr_of(level)
    return [
        AttackOutcome(
            attack="hill-climbing",
            variant=f"{climber}, {'scores' if scored else 'decisions only'}, {limit} attempts",
            breaks=Property.IMPERSONATION,
            leaked=Leaked.DATABASE,
            knowledge=Knowledge.RIGHT if scored else Knowledge.ALGORITHM,
            assumption="How templates are lifted, faces of other people, and "
            + (
                "the rights to send embeddings and to see scores"
                if scored
                else "decisions on those faces, which it sends as photos, or as embeddings where "
                "it has that right"
            )
            + f"; success is acceptance within {limit} attempts, none of which was accepted before",
            scheme=scheme,
            level=level.name,
            measured=rate(int(np.count_nonzero(reached <= limit)), len(reached)),
            chance=1 - (1 - fmr) ** limit,
            details={
                "limit": limit,
                "median_attempts": median if np.isfinite(median) else None,
                "attempts": sum(attack.attempts for attack in climbs),
            },
        )
        for limit in sorted(
            {*(limit for limit in LOCKOUTS if limit <= most_attempts), most_attempts}
        )
    ]


def dictionary_outcomes(system: System) -> list[AttackOutcome]:
    """Try the attacker's 50 best faces on every victim's template, seeing decisions only.

    Every service that decides at an FMR is open to this, protected or not; only a lockout bounds
    it. The order of the faces is the prior's, so it does not depend on the answers, and all victims
    can be tried at once.
    """
    faces = attacker_prior(system).faces[: LOCKOUTS[-1]].astype(np.float32)
    accepted = decide(faces, system.templates, system.contract, system.points, system.level)
    climbs = [
        Climb(
            attempts=int(np.argmax(column)) + 1 if column.any() else len(faces),
            accepted_at=int(np.argmax(column)) + 1 if column.any() else None,
        )
        for column in accepted.T
    ]
    return climbing_outcomes(
        Climber.DICTIONARY, climbs, system.scheme, system.level, most_attempts=len(faces)
    )


def climb_service(
    system: System,
    scored: Sequence[Ask],
    deciding: Sequence[Ask],
    *,
    most_attempts: int,
    seed: int,
) -> list[AttackOutcome]:
    """Climb towards the first victims, over the interface of a running service.

    Parameters
    ----------
    scored, deciding
        One a victim: what answers a probe with its score, and with the decision only.
    """
    prior = attacker_prior(system)
    outcomes: list[AttackOutcome] = []
    for climber in Climber:
        decisions_only = climber is Climber.DICTIONARY
        asks = deciding if decisions_only else scored
        most = min(most_attempts, len(prior.faces)) if decisions_only else most_attempts
        climbs = climb(dict(enumerate(asks)), prior, climber, most_attempts=most, seed=seed)
        outcomes += [
            replace(
                outcome,
                variant=f"{outcome.variant}, over REST",
                unjudged="it is judged on all victims, not on these few"
                if decisions_only
                else None,
            )
            for outcome in climbing_outcomes(
                climber, climbs, system.scheme, system.level, most_attempts=most
            )
        ]
    return outcomes
