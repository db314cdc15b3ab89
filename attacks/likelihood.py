"""The point of a template that is least like a decoy and most like an enrolled face.

Decoys hide a descriptor only if they are spread as descriptors are. All unit points of a template
are mixtures of the descriptor and the decoys; along axes in which decoys vary less than faces do,
only the descriptor has anything to contribute, and the mixture that holds most of it is found in
closed form. Clients have the generator, so everybody can know its covariance. Not in the paper,
whose decoys are real, nor in the measurements of docs/design-measurements.md §1.2, whose decoys and
people are of one set.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import CONTROL, GENERATED, AttackOutcome, Knowledge, Leaked, Property
from attacks.population import Subjects
from attacks.privacy import DRAWS, SimulatedPeople, decoy_moments, extrapolate, face_counts
from attacks.recovery import fmr_of, recovery_outcome
from attacks.second_order import (
    Moments,
    drawn_towards,
    likeliest_descriptors,
    second_moment,
    without_noise_moment,
)
from attacks.stored.recording import decoy_count
from attacks.system import System
from templates.contract.document import Rate
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, plain_strategy
from templates.space.subspace import SubspaceBatch
from verify.cohort import client_source

SHRINKAGE = 1e-3
"""Share of the largest variance that is added to all: axes below it count alike."""
_TILE = 64

Array64 = NDArray[np.float64]


def precision(rows: NDArray[np.floating], *, shrinkage: float = SHRINKAGE) -> Array64:
    """Inverse of the covariance of (K, n) rows, with a share of its largest variance added."""
    variances, axes = np.linalg.eigh(np.cov(np.asarray(rows, dtype=np.float64).T))
    return np.asarray((axes / (variances + shrinkage * variances[-1])) @ axes.T)


def likeliest_points(templates: SubspaceBatch, form: Array64) -> Array64:
    """Unit vector x of each template's linear span that maximises xᵀ form x; (T, n) float64.

    Of the two signs the one that lies on the side of the foot point.

    Notes
    -----
    With ``form = Σ_decoys⁻¹ − Σ_faces⁻¹``, twice the logarithm of the ratio of the Gaussian
    likelihoods that x is a face and that it is a decoy, less a constant; means are left out, as
    they are small beside the spread. The maximum is the leading eigenvector of a matrix of size
    m + 1. To keep to the unit points of the template itself succeeded less often on faces (95 %
    for 97.5 % at m = 16), as it may end at a point in which the descriptor's share is negative.
    """
    out = np.empty((len(templates), templates.n))
    norms = np.maximum(templates.foot_norms, 1e-300)[:, None]
    for start in range(0, len(templates), _TILE):
        rows = slice(start, start + _TILE)
        feet = templates.feet[rows].astype(np.float64)
        span = np.concatenate([(feet / norms[rows])[:, None], templates.bases[rows]], axis=1)
        inside = (span @ form) @ span.transpose(0, 2, 1)
        points = np.einsum("ta,tan->tn", np.linalg.eigh(inside)[1][:, :, -1], span)
        towards = np.einsum("tn,tn->t", points, feet)
        out[rows] = points * np.where(towards < 0, -1.0, 1.0)[:, None]
    return out


GENERATOR = "generator"


def likeliest_guesses(system: System) -> dict[str, Array64]:
    """Guess the victims' descriptors from the decoys' statistics, and from faces too.

    Returns
    -------
    dict of ndarray of float64, shape (V, n)
        By what they rest on; unit rows. ``generator``: the point that is least like a decoy,
        where the scheme takes decoys only; of a pool, like one of the generator that clients have
        for it. ``1160 faces`` and other numbers: of ``attacks.second_order``, with so many faces;
        the last one has them all.
    """
    count = decoy_count(system.scheme)
    guesses: dict[str, Array64] = {}
    decoys: Moments | None = None
    if system.source is not None and count:
        with Keystream.seeded("audit", system.seed, "decoys that the attacker draws") as stream:
            drawn = client_source(system.source).draw(DRAWS, 1, stream=stream)[:, 0, :]
        decoys = Moments.of(second_moment(drawn))
        if count == system.scheme.dim:
            guesses[GENERATOR] = likeliest_points(system.templates, precision(drawn))
    shuffled = np.random.default_rng(system.seed).permutation(system.attacker)
    for number in face_counts(len(system.attacker)):
        some = shuffled[:number]
        prior = np.eye(system.templates.n) / system.templates.n if decoys is None else decoys.moment
        noise = 0.0 if decoys is None or system.source is None else system.source.noise
        moments = Moments.of(drawn_towards(some, prior, noise=noise))
        guesses[f"{number} faces"] = likeliest_descriptors(
            system.templates, moments, decoys, count=count
        )
    return guesses


def find_least_decoy_like(
    system: System, guesses: Mapping[str, Array64], *, kind: str
) -> list[AttackOutcome]:
    """Report the guesses of :func:`likeliest_guesses`.

    Parameters
    ----------
    kind
        Where the attacker's faces are from, in words.

    Returns
    -------
    list of AttackOutcome
        Named ``decoy-likelihood``, one for each guess, and a control that is not judged: the guess
        with all faces, scored against fresh photos of other victims.
    """

    def outcome(name: str, people: Subjects | None = None) -> AttackOutcome:
        number = 0 if name == GENERATOR else int(name.split()[0])
        control = people is not None
        return recovery_outcome(
            system,
            guesses[name],
            attack="decoy-likelihood",
            variant="photos of other people" if control else name,
            knowledge=Knowledge.ALGORITHM,
            assumption=f"One template, the decoy generator and {number} faces of {kind}: the guess "
            "is the point of the template that is least like a decoy"
            + (" and most like a face, given what decoys do" if number else "")
            + "; success is a match of the guess with a fresh photo"
            + (" of another victim (a control)" if control else ""),
            people=people,
            unjudged=CONTROL if control else None,
            details={"draws": DRAWS, "faces": number, "faces_from": kind},
        )

    outcomes = [outcome(name) for name in guesses]
    return [*outcomes, outcome(list(guesses)[-1], system.victims.mismatched())]


def likeliest_guess(system: System) -> Callable[[SubspaceBatch], Array64]:
    """Return the guess with all faces of :func:`likeliest_guesses`, for templates of any people."""
    moments, decoys = attacker_moments(system)
    count = decoy_count(system.scheme)
    return lambda templates: likeliest_descriptors(templates, moments, decoys, count=count)


def attacker_moments(system: System) -> tuple[Moments, Moments | None]:
    """Second moments of faces, as far as the system's attacker can tell them, and of decoys.

    None for those of a scheme without decoys; the prior of faces is isotropic then.
    """
    if system.source is None or not decoy_count(system.scheme):
        n = system.templates.n
        return Moments.of(drawn_towards(system.attacker, np.eye(n) / n)), None
    decoys = decoy_moments(system.source, seed=system.seed)
    faces = drawn_towards(system.attacker, decoys.moment, noise=system.source.noise)
    return Moments.of(faces), decoys


def simulate_unlimited(
    system: System,
    *,
    kind: str,
    fitted_to: int | None,
    measured: Sequence[AttackOutcome],
) -> list[AttackOutcome]:
    """Report the attacker who knows the people's second moments exactly, on simulated people.

    Parameters
    ----------
    fitted_to
        Number of faces that the generator was fitted to: as many draws are fitted to anew. None
        where that is not known, or decoys are adapted to a sample: the people are lifted with the
        generator itself then, and differ from its draws as far as the faces tell. That is an
        estimate, and not judged.
    measured
        Outcomes of :func:`find_least_decoy_like`, which ``details`` extrapolates beside.

    Returns
    -------
    list of AttackOutcome
        One, named ``decoy-likelihood``; none for decoys of a pool and without decoys.
    """
    if system.scheme.decoys != GENERATED or system.source is None:
        return []
    known = system.attacker
    strategy = plain_strategy(Strategy(system.scheme.strategy))
    decoys = decoy_moments(system.source, seed=system.seed)
    people = SimulatedPeople.draw(
        known.mean(axis=0, dtype=np.float64),
        without_noise_moment(
            drawn_towards(known, decoys.moment, noise=system.source.noise), system.source.noise
        ),
        np.einsum("ij,ij->i", system.victims.enrolled, system.victims.fresh),
        fitted_to=fitted_to,
        source=system.source if fitted_to is None else None,
        noise=system.source.noise,
        seed=system.seed,
    )
    level = system.level
    theft = people.theft(
        strategy,
        system.scheme.dim,
        match_cosine=system.raw_thresholds[level.name],
        seed=system.seed,
    )
    points = [
        (int(str(row.details["faces"])), row.measured)
        for row in measured
        if row.judged and row.details["faces"] and isinstance(row.measured, Rate)
    ]
    return [
        AttackOutcome(
            attack="decoy-likelihood",
            variant="unlimited faces, simulated",
            breaks=Property.IRREVERSIBILITY,
            leaked=Leaked.HOLDER_KEYS,
            knowledge=Knowledge.ALGORITHM,
            assumption="One template, the decoy generator and the exact second moments of the "
            f"people: simulated with people drawn with the moments of {len(known)} faces of "
            f"{kind}, and "
            + (
                "the decoy generator as it is"
                if fitted_to is None
                else f"a generator fitted to {fitted_to} of them"
            )
            + "; success is a match of the guess with a fresh photo, which is drawn as near as "
            "real ones are",
            scheme=system.scheme,
            level=level.name,
            measured=theft.found,
            chance=fmr_of(level),
            unjudged=None
            if fitted_to is not None
            else "an estimate, for nobody knows how far decoys and people differ",
            details={
                "faces": "unlimited",
                "photos_of_other_people": theft.control.to_json(),
                "faces_from": kind,
                "generator_fitted_to": fitted_to,
                "extrapolated_from_finite": extrapolate(points),
            },
        )
    ]
