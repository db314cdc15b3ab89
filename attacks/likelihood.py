"""The point of a template that is least like a decoy and most like an enrolled face.

Decoys hide a descriptor only if they are spread as descriptors are. All unit points of a template
are mixtures of the descriptor and the decoys; along axes in which decoys vary less than faces do,
only the descriptor has anything to contribute, and the mixture that holds most of it is found in
closed form. Clients have the generator, so everybody can know its covariance. Not in the paper,
whose decoys are real, nor in the measurements of docs/method.md §7.2, whose decoys and people are
of one set.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.outcomes import AttackOutcome, Knowledge
from attacks.recovery import recovery_outcome
from attacks.stored.face_statistics import FaceStatistics
from attacks.system import System
from templates.contract.document import Rate
from templates.decoys import DecoySource
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify.cohort import client_source, plain_strategy
from verify.metrics import rate

DRAWS = 6000
SHRINKAGE = 1e-3
"""Share of the largest variance that is added to all: axes below it count alike."""
MOST_LIFTED = 300
_TILE = 64

Array64 = NDArray[np.float64]


def precision(rows: NDArray[np.floating], *, shrinkage: float = SHRINKAGE) -> Array64:
    """Inverse of the covariance of (K, n) rows, with a share of its largest variance added."""
    variances, axes = np.linalg.eigh(np.cov(np.asarray(rows, dtype=np.float64).T))
    return np.asarray((axes / (variances + shrinkage * variances[-1])) @ axes.T)


def face_precision(faces: NDArray[np.floating]) -> Array64:
    """Inverse of the covariance of an attacker's faces, (A, n).

    With as many faces as dimensions, :func:`precision`, as for decoys: what the two are compared
    by is the tail of small variances, which the shrinkage of Ledoit and Wolf levels. On LFW with
    1,160 faces and n = 512, its use gave fewer people away: 67 for 82 % at m = 64 with decoys of
    FairFace, 15 for 48 % at m = 16 with decoys of LFW. With fewer faces the tail is 0, and theirs,
    as in ``attacks.stored``, is the better: with 400 it gave 59 for 40 % at m = 64.
    """
    if len(faces) >= faces.shape[1]:
        return precision(faces)
    whitening = FaceStatistics.of(faces).whitening
    return np.asarray(whitening @ whitening)


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


def share_found(
    descriptors: NDArray[np.floating],
    identities: Sequence[str],
    source: DecoySource,
    *,
    strategy: Strategy,
    m: int,
    cosine: float,
    draws: int = DRAWS,
    most: int = MOST_LIFTED,
    seed: int = 0,
) -> Rate:
    """Share of people's templates whose descriptor the decoys' statistics give away.

    For a calibration, to tell an operator whose decoys are spread unlike the people. Half of the
    people stand for the attacker's faces, the means of the others are lifted and guessed; the
    better of the two forms of :func:`find_least_decoy_like` counts.

    Parameters
    ----------
    descriptors, identities : (N, n), N names
        Of the calibration.
    source, strategy, m
        How they are lifted.
    cosine
        A guess succeeds that is as near as this to the descriptor that was lifted.
    most
        Most people who are lifted.
    """
    names, person = np.unique(np.asarray(identities), return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    hidden = order[: min(most, len(order) // 2)]
    faces = np.asarray(descriptors)[~np.isin(person, hidden)]
    means = np.stack([np.asarray(descriptors)[person == one].mean(axis=0) for one in hidden])
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    nobody = client_source(source)
    with Keystream.seeded("decoy likelihood", seed) as stream:
        lifted = lift(means, strategy=plain_strategy(strategy), m=m, source=source, stream=stream)
        decoys = nobody.draw(draws, 1, stream=stream)[:, 0, :]
    against = precision(decoys)
    most_found = 0
    for form in (against, against - face_precision(faces)):
        guesses = likeliest_points(lifted, form)
        hits = np.einsum("ij,ij->i", guesses, means) >= cosine
        most_found = max(most_found, int(np.count_nonzero(hits)))
    return rate(most_found, len(means))


GENERATOR, GENERATOR_AND_FACES = "generator", "generator and faces"


def likeliest_guesses(
    system: System, faces: NDArray[np.float32] | None = None, *, draws: int = DRAWS
) -> dict[str, Array64]:
    """Guess the victims' descriptors from the decoys' statistics, and from faces too.

    Parameters
    ----------
    faces : (A, n) float32
        Faces that the attacker has beside the system's.
    draws
        Decoys that the attacker draws. For a pool, of the generator that is fitted to it and given
        to clients.

    Returns
    -------
    dict of ndarray of float64, shape (V, n)
        By what they rest on, ``generator`` and ``generator and faces``; unit rows. Empty where the
        scheme takes no decoys.

    Raises
    ------
    AuditError
        There are no more draws than dimensions.
    """
    if system.source is None:
        return {}
    if draws <= system.templates.n:
        raise AuditError("a covariance needs more draws than the embedding has dimensions")
    with Keystream.seeded("audit", system.seed, "decoys that the attacker draws") as stream:
        decoys = client_source(system.source).draw(draws, 1, stream=stream)[:, 0, :]
    against = precision(decoys)
    forms = {
        GENERATOR: against,
        GENERATOR_AND_FACES: against - face_precision(_known(system, faces)),
    }
    return {name: likeliest_points(system.templates, form) for name, form in forms.items()}


def _known(system: System, faces: NDArray[np.float32] | None) -> NDArray[np.float32]:
    return system.attacker if faces is None else np.concatenate([system.attacker, faces])


def find_least_decoy_like(
    system: System,
    faces: NDArray[np.float32] | None = None,
    *,
    draws: int = DRAWS,
    guesses: Mapping[str, Array64] | None = None,
) -> list[AttackOutcome]:
    """Report the guesses of :func:`likeliest_guesses`, which takes the same parameters.

    Parameters
    ----------
    guesses
        What that function returned for them, where it was called before.

    Returns
    -------
    list of AttackOutcome
        Named ``decoy-likelihood``, one for each guess.
    """
    if guesses is None:
        guesses = likeliest_guesses(system, faces, draws=draws)
    counts = {GENERATOR: 0, GENERATOR_AND_FACES: len(_known(system, faces))}
    return [
        recovery_outcome(
            system,
            guess,
            attack="decoy-likelihood",
            variant=name,
            knowledge=Knowledge.ALGORITHM,
            assumption=f"One template and the {name}: the guess is the point of the template that "
            "is least like a decoy"
            + (" and most like a face" if counts[name] else "")
            + "; success is a match of the guess with a fresh photo",
            details={"draws": draws, "faces": counts[name]},
        )
        for name, guess in guesses.items()
    ]
