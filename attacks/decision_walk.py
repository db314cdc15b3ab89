"""Reconstruction from accepted and rejected probes alone: a walk along the border between them.

The attacker may send embeddings, and is told decisions only. A first accepted face is found by
trying. From an accepted probe the border towards a rejected one is bisected, and there the
similarity to the template is known: what the public contract expects of the probe, plus the
threshold in deviations (docs/decision.md §1). So each border point is worth a score, and the
template follows by regression on them. It tells no more than the template itself does to a thief.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from attacks.decisions import decide
from attacks.hill_climbing import LOCKOUTS
from attacks.likelihood import attacker_moments
from attacks.outcomes import CONTROL, AttackOutcome, Knowledge, Leaked
from attacks.population import Subjects
from attacks.prior import Prior, attacker_prior
from attacks.recovery import recovery_outcome
from attacks.second_order import likeliest_descriptors
from attacks.stored.recording import decoy_count
from attacks.system import System
from templates.contract.expectation import PointExpectation
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch
from verify.metrics import rate

QUESTIONS = (1_000, 10_000)
"""Numbers of probes after which the attacker guesses."""
VICTIMS = 100
"""Victims that are asked about, whose time grows with their number and that of the questions."""
BISECTIONS = 7
"""Halvings of the way to the border: it is then known to a hundredth of the way."""
_FIRST = 24
"""Border points before the first regression; each later one rests on about twice as many."""
_ASCENT_STEPS = 60
_BOLDNESS = (1.0, 0.7, 0.5, 0.3, 0.15)
"""Shares of the way to the regression's best point that are tried until one is accepted."""
_DRAWN = 1_000
_NOISE = 1e-5
"""Variance of a similarity that is known by bisection."""

FOOT, LIKELIEST = "foot point", "likeliest point"

Array64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Walk:
    """What one attack on one template came to.

    Parameters
    ----------
    first_accepted
        Number of the first probe that was accepted, from 1; None where none was.
    guesses
        By number of questions and what is guessed, (n,) unit rows; zero before the first accept.
    answers
        To all probes, in order.
    """

    first_accepted: int | None
    guesses: Mapping[tuple[int, str], Array64]
    answers: NDArray[np.bool_]

    def withstands(self, limit: int) -> bool:
        """Whether the first accept came before a lockout after ``limit`` failures in a row."""
        return self.first_accepted is not None and self.first_accepted <= limit

    def repeats(self, limit: int) -> int:
        """Times that an accepted probe is sent again to stay below ``limit`` failures in a row."""
        if self.first_accepted is None:
            return 0
        accepted = np.flatnonzero(self.answers[self.first_accepted - 1 :])
        rest = len(self.answers) - self.first_accepted + 1
        runs = np.diff(np.append(accepted, rest)) - 1
        return int((runs // (limit - 1)).sum())


class _Questions:
    """Answers to probes about one template, and their number."""

    def __init__(self, system: System, victim: int) -> None:
        self._system = system
        self._template = system.templates[victim : victim + 1]
        self.answers = np.empty(0, dtype=np.bool_)

    def __len__(self) -> int:
        return len(self.answers)

    def ask(self, probes: Array64) -> NDArray[np.bool_]:
        """Ask all probes, (P, n)."""
        given = self._answer(probes)
        self.answers = np.append(self.answers, given)
        return given

    def ask_until_accepted(self, probes: Array64) -> Array64 | None:
        """Ask one after the other, up to the first that is accepted."""
        given = self._answer(probes)
        asked = int(np.argmax(given)) + 1 if given.any() else len(given)
        self.answers = np.append(self.answers, given[:asked])
        return probes[asked - 1] if given.any() else None

    def _answer(self, probes: Array64) -> NDArray[np.bool_]:
        sent = np.ascontiguousarray(probes, dtype=np.float32)
        system = self._system
        return decide(sent, self._template, system.contract, system.points, system.level)[:, 0]


@dataclass(frozen=True, eq=False, repr=False)
class _Posterior:
    """The template as far as border points tell it: a Gaussian process with the prior's kernel.

    Parameters
    ----------
    turned : (N, n) float64
        Border points times the second moment of faces.
    weights : (N,) float64
    """

    prior: Prior
    turned: Array64
    weights: Array64

    @classmethod
    def of(cls, prior: Prior, border: Array64, excess: Array64) -> "_Posterior":
        """Regress the similarity in excess of what is expected, (N,), on border points (N, n)."""
        linear, square = prior.kernel
        turned = border @ (prior.axes @ prior.axes)
        gram = turned @ border.T
        covariance = linear * gram + square * gram**2
        covariance[np.diag_indices_from(covariance)] += _NOISE
        factor = cho_factor(covariance, overwrite_a=True, check_finite=False)
        return cls(prior, turned, np.asarray(cho_solve(factor, excess)))

    def slopes(self, points: Array64) -> Array64:
        """Gradient of the excess at (P, n) points: it leads to the template's nearest point."""
        linear, square = self.prior.kernel
        return np.asarray(
            (self.weights * (linear + 2 * square * points @ self.turned.T)) @ self.turned
        )

    def highest(self, start: Array64) -> Array64:
        """Ascend the excess from a unit point (n,)."""
        place = start
        for step in np.geomspace(0.5, 0.01, _ASCENT_STEPS):
            slope = self.slopes(place[None])[0]
            slope -= (slope @ place) * place
            place = normalised(place + step * normalised(slope))
        return place

    def template(self, expected: PointExpectation, m: int) -> SubspaceBatch:
        """Guess the template: its foot point, and the m axes on which most of its points lie.

        The excess of ‖Dx‖ is about xᵀ(DᵀD − H)x / 2√(xᵀHx), and xᵀHx about m / n.
        """
        linear, square = self.prior.kernel
        n = len(expected.foot)
        form = square * (self.turned.T * self.weights) @ self.turned
        projector = expected.projector + 2 * np.sqrt(m / n) * form
        basis = np.linalg.eigh(projector)[1][:, -m:].T
        foot = expected.foot + linear * self.weights @ self.turned
        foot -= basis.T @ (basis @ foot)
        return SubspaceBatch(foot[None].astype(np.float32), basis[None].astype(np.float32))

    def foot(self, expected: PointExpectation) -> Array64:
        """Guess the direction of the foot point, (n,)."""
        return normalised(expected.foot + self.prior.kernel[0] * self.weights @ self.turned)


class _Guesser:
    """Turns what was learnt about a template into guesses, as a thief of the template would."""

    def __init__(self, system: System) -> None:
        self._expected = system.contract.expectation
        self._m = system.scheme.dim
        self._count = decoy_count(system.scheme)
        self._faces, self._decoys = attacker_moments(system)

    @property
    def kinds(self) -> tuple[str, ...]:
        return (FOOT,) if self._decoys is None else (FOOT, LIKELIEST)

    def __call__(self, posterior: _Posterior) -> dict[str, Array64]:
        guesses = {FOOT: posterior.foot(self._expected)}
        if self._decoys is not None:
            template = posterior.template(self._expected, self._m)
            (guesses[LIKELIEST],) = likeliest_descriptors(
                template, self._faces, self._decoys, count=self._count
            )
        return guesses


def _draw(prior: Prior, count: int, rng: np.random.Generator) -> Array64:
    """Unit rows spread as faces are about the origin, (count, n)."""
    return normalised(rng.normal(size=(count, len(prior.axes))) @ prior.axes)


def _first_accepted(
    questions: _Questions,
    prior: Prior,
    faces: NDArray[np.float32],
    most: int,
    rng: np.random.Generator,
) -> Array64 | None:
    """Try the faces of the dictionary, then the attacker's others, then drawn ones."""
    others = faces[len(prior.faces) :].astype(np.float64)
    place = questions.ask_until_accepted(np.concatenate([prior.faces, others])[:most])
    while place is None and len(questions) < most:
        place = questions.ask_until_accepted(_draw(prior, min(_DRAWN, most - len(questions)), rng))
    return place


def _border(questions: _Questions, inside: Array64, outside: Array64) -> Array64:
    """Bisect the ways from accepted probes (P, n) to others; leave out where all are accepted."""
    low, high = np.zeros((len(inside), 1)), np.ones((len(inside), 1))
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        accepted = questions.ask(normalised(inside + middle * (outside - inside)))[:, None]
        low, high = np.where(accepted, middle, low), np.where(accepted, high, middle)
    found = normalised(inside + (low + high) / 2 * (outside - inside))
    return found[high[:, 0] < 1]


def _posteriors(
    system: System,
    questions: _Questions,
    prior: Prior,
    place: Array64,
    counts: Sequence[int],
    rng: np.random.Generator,
) -> Iterator[tuple[int, _Posterior | None]]:
    """Walk from an accepted probe; for every count of questions what is known by then."""
    threshold = system.level.threshold
    border, excess = np.empty((0, len(place))), np.empty(0)
    posterior: _Posterior | None = None
    size = _FIRST
    each = BISECTIONS
    for count in counts:
        while (points := min(size, (count - len(questions) - len(_BOLDNESS)) // each)) > 0:
            outside = _draw(prior, points, rng)
            inside = np.repeat(place[None], points, axis=0)
            if posterior is not None:
                # Many ways in, so that the border is met in all directions of the template.
                pulled = normalised(posterior.slopes(outside))
                accepted = questions.ask(pulled)
                inside[accepted] = pulled[accepted]
            reached = _border(questions, inside, outside)
            spreads = system.contract.expectation.statistics(reached)[1]
            border = np.concatenate([border, reached])
            excess = np.append(excess, threshold * spreads)
            posterior = _Posterior.of(prior, border, excess)
            best = posterior.highest(place)
            for share in _BOLDNESS:
                trial = normalised(place + share * (best - place))
                if questions.ask(trial[None])[0]:
                    place = trial
                    break
            size, each = 2 * size, BISECTIONS + 1
        yield count, posterior


def walk(
    system: System,
    victim: int,
    prior: Prior,
    guesser: _Guesser,
    *,
    counts: Sequence[int],
) -> Walk:
    """Attack one template.

    Parameters
    ----------
    victim
        Row of the template.
    counts
        Numbers of questions after which to guess, in ascending order.
    """
    rng = np.random.default_rng([system.seed, victim])
    questions = _Questions(system, victim)
    nothing = np.zeros(system.templates.n)
    guesses = {(count, kind): nothing for count in counts for kind in guesser.kinds}
    place = _first_accepted(questions, prior, system.attacker, counts[-1], rng)
    first = len(questions)
    if place is not None:
        later = [count for count in counts if count > first]
        for count, posterior in _posteriors(system, questions, prior, place, later, rng):
            if posterior is not None:
                for kind, guess in guesser(posterior).items():
                    guesses[count, kind] = guess
    return Walk(first if place is not None else None, guesses, questions.answers)


def reconstruct_from_decisions(
    system: System, *, counts: Sequence[int] = QUESTIONS
) -> list[AttackOutcome]:
    """Reconstruct every victim's descriptor from accepted and rejected probes.

    A lockout ends only the search for the first accept: an accepted probe sets the count of
    failures back, and the attacker sends that one again wherever the next would be one too many.

    Parameters
    ----------
    counts
        Numbers of questions after which the attacker guesses, in ascending order.

    Returns
    -------
    list of AttackOutcome
        Named ``decision-walk``: the foot point after each number of questions, and within each
        lockout after the most; where the scheme has decoys the likeliest point too; and a control
        that is not judged, the foot point after the most against fresh photos of other victims.
    """
    prior, guesser = attacker_prior(system), _Guesser(system)
    walks = [
        walk(system, victim, prior, guesser, counts=counts) for victim in range(len(system.victims))
    ]
    most = counts[-1]
    outcomes = [_outcome(system, walks, count, FOOT) for count in counts]
    outcomes += [_outcome(system, walks, most, FOOT, limit=limit) for limit in LOCKOUTS]
    if LIKELIEST in guesser.kinds:
        outcomes.append(_outcome(system, walks, most, LIKELIEST))
    control = _outcome(system, walks, most, FOOT, people=system.victims.mismatched())
    return [*outcomes, control]


def _outcome(
    system: System,
    walks: Sequence[Walk],
    count: int,
    kind: str,
    *,
    limit: int | None = None,
    people: Subjects | None = None,
) -> AttackOutcome:
    guesses = np.stack(
        [
            attack.guesses[count, kind] * (limit is None or attack.withstands(limit))
            for attack in walks
        ]
    )
    opened = decide(
        guesses.astype(np.float32),
        system.templates,
        system.contract,
        system.points,
        system.level,
        paired=True,
    ) & guesses.any(axis=1)
    reached = [attack.first_accepted for attack in walks if attack.first_accepted is not None]
    withstood = [attack for attack in walks if limit and attack.withstands(limit)]
    repeats = [attack.repeats(limit) for attack in walks if limit and attack.first_accepted]
    bound = "" if limit is None else f", lockout after {limit} failures"
    return recovery_outcome(
        system,
        guesses,
        attack="decision-walk",
        variant=f"{kind}, {count} questions{bound}"
        + (", photos of other people" if people is not None else ""),
        leaked=Leaked.DATABASE,
        knowledge=Knowledge.RIGHT,
        assumption="How templates are lifted, the contract, faces of other people, and the right "
        f"to send embeddings: {count} probes, of which it sees only which were accepted"
        + (
            ""
            if limit is None
            else f", and never {limit} failures in a row, which it avoids by an accepted probe "
            "once it has one"
        )
        + f"; the guess is the {kind} of the template that they tell, and success is a match of "
        "the guess with a fresh photo"
        + (" of another victim (a control)" if people is not None else ""),
        people=people,
        unjudged=None if people is None else CONTROL,
        details={
            "questions": count,
            "lockout": limit,
            "accepted": rate(int(np.count_nonzero(opened)), len(opened)).to_json(),
            "found_an_accepted_probe": len(reached if limit is None else withstood),
            "median_first_accepted": float(np.median(reached)) if reached else None,
            "accepted_probes_sent_again_mean": float(np.mean(repeats)) if repeats else None,
        },
    )
