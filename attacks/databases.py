"""Linking two stolen databases whose tenants rotate: what many templates tell of the rotation.

A secret rotation hides one template, but it is one for all templates of a tenant. The attacker
knows how un-rotated templates are spread (decoys come from a generator that clients have), so the
mean and the second moments of a stolen database tell which axes were turned where, and accounts
of the attacker's own, in both databases, tell more. Neither is in the paper.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.linkage import linkage_outcome, nearest_similarities, secret_rotation
from attacks.outcomes import AttackOutcome, Knowledge
from attacks.system import System
from attacks.unlinkability import unlinkability
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from verify.cohort import client_source

ACCOUNTS = (0, 10, 30, 100)
"""Accounts that the attacker has with both tenants."""
STRANGERS = 1000
"""Further people in each tenant's database: others in each."""
ALIGNMENTS = 6
"""Steps of the estimate of a rotation; it is settled after some three."""
_TILE = 64

Array64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Moments:
    """How the templates of a database are spread.

    Parameters
    ----------
    mean : (n,) float64
        Of the foot points.
    variances : (n,) float64
        Along the principal axes of the bases, largest first; their mean is 1.
    axes : (n, n) float64
        Those axes, as columns.
    power
        Mean ‖p‖².
    templates, m
        How many templates, of which dimension.
    """

    mean: Array64
    variances: Array64
    axes: Array64
    power: float
    templates: int
    m: int

    @classmethod
    def of(cls, batch: SubspaceBatch) -> "Moments":
        """Moments of a database."""
        spread = np.zeros((batch.n, batch.n))
        for start in range(0, len(batch), _TILE):
            rows = batch.bases[start : start + _TILE].reshape(-1, batch.n).astype(np.float64)
            spread += rows.T @ rows
        variances, axes = np.linalg.eigh(spread * batch.n / (len(batch) * batch.m))
        return cls(
            mean=batch.feet.mean(axis=0, dtype=np.float64),
            variances=np.maximum(variances[::-1], 1e-9),
            axes=axes[:, ::-1],
            power=float((batch.foot_norms**2).mean()),
            templates=len(batch),
            m=batch.m,
        )


def estimate_rotation(
    stolen: Moments,
    lifted: Moments,
    feet: NDArray[np.floating],
    descriptors: NDArray[np.floating],
    *,
    steps: int = ALIGNMENTS,
) -> Array64:
    """Estimate the rotation of a tenant from its database.

    Parameters
    ----------
    stolen, lifted
        Moments of the tenant's database, and of templates that the attacker lifted itself.
    feet, descriptors : (S, n) floating
        Foot points of the attacker's own accounts in the database, and what was lifted there.
        S may be 0.

    Returns
    -------
    ndarray of float64, shape (n, n)
        Orthogonal; x of the tenant is taken back by ``estimate.T @ x``.

    Notes
    -----
    The log-likelihood of R, for directions that are Gaussian with the lifted covariance Σ, for
    feet p = ‖p‖² R d + noise, and for the mean, is
    ``−N m / 2 tr(R Σ⁻¹ Rᵀ S) + tr(Rᵀ T)``, with S the stolen covariance and T the sum of the outer
    products of what is known on both sides. With ``(c I − Σ⁻¹)`` in place of ``−Σ⁻¹``, which adds
    a constant, the first term is convex in R, so it lies above its tangent, and the polar factor
    of the gradient never lowers the whole: Procrustes' solution, step by step. It starts at the
    principal axes, paired by rank, with the signs that T gives them.
    """
    n = len(stolen.mean)
    noise = stolen.power / n
    known = feet.T.astype(np.float64) @ descriptors.astype(np.float64) * (stolen.power / noise)
    known += stolen.templates / (2 * noise) * np.outer(stolen.mean, lifted.mean)
    known = stolen.axes.T @ known @ lifted.axes
    precision = 1 / lifted.variances
    gain = precision.max() - precision
    weight = stolen.templates * stolen.m
    turn = np.diag(np.where(np.diagonal(known) < 0, -1.0, 1.0))
    for _ in range(steps):
        left, _values, right = np.linalg.svd(
            weight * stolen.variances[:, None] * turn * gain + known
        )
        turn = left @ right
    return np.asarray(stolen.axes @ turn @ lifted.axes.T)


def whitened_cosines(left: SubspaceBatch, right: SubspaceBatch, spread: Moments) -> Array64:
    """Cosines of foot points, less their mean, in units of what decoys vary along each axis."""
    scale = np.sqrt(spread.variances)
    sides = []
    for batch in (left, right):
        rows = batch.feet.astype(np.float64) @ spread.axes
        rows = (rows - rows.mean(axis=0)) / scale
        sides.append(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))
    return np.asarray(sides[0] @ sides[1].T)


def signature_cosines(
    left: SubspaceBatch,
    right: SubspaceBatch,
    left_accounts: SubspaceBatch,
    right_accounts: SubspaceBatch,
) -> Array64:
    """Cosines of signatures: similarities to the accounts inside each tenant, (T, U).

    A signature holds inner products of foot points and spherical similarities, which no rotation
    changes; every entry is standardised over the templates of its tenant.
    """
    sides = []
    for batch, accounts in ((left, left_accounts), (right, right_accounts)):
        centre = batch.feet.mean(axis=0)
        feet = (batch.feet - centre) @ (accounts.feet - centre).T
        rows = np.concatenate([feet, nearest_similarities(batch, accounts)], axis=1).astype(
            np.float64
        )
        rows = (rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1e-12)
        sides.append(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))
    return np.asarray(sides[0] @ sides[1].T)


@dataclass(frozen=True, eq=False, repr=False)
class _Database:
    """A tenant's templates: of the victims, of the attacker's accounts, and all its moments."""

    victims: SubspaceBatch
    accounts: SubspaceBatch
    moments: Moments


def _steal(
    system: System,
    tenant: str,
    people: NDArray[np.float32],
    own: NDArray[np.float32],
    strangers: int,
) -> _Database:
    with Keystream.seeded("audit", system.seed, "strangers", tenant) as stream:
        others = client_source(system.lifter.source).draw(strangers, 1, stream=stream)[:, 0, :]
    members = np.ascontiguousarray(np.concatenate([people, own, others]), dtype=np.float32)
    lifted = system.lift(members, f"database of the {tenant} tenant")
    stolen = lifted.rotated(secret_rotation(system, tenant, "database"))
    return _Database(
        victims=stolen[: len(people)],
        accounts=stolen[len(people) : len(people) + len(own)],
        moments=Moments.of(stolen),
    )


def link_databases(
    system: System,
    *,
    accounts: tuple[int, ...] = ACCOUNTS,
    strangers: int = STRANGERS,
    permutations: int = 500,
    most_people: int = 400,
) -> list[AttackOutcome]:
    """Link the victims between two stolen databases, keys unknown.

    Parameters
    ----------
    accounts
        Numbers of the attacker's own accounts with both tenants; those beyond its faces are left
        out. With 0 it has the two databases only.
    strangers
        Further templates in each database.

    Returns
    -------
    list of AttackOutcome
        Named ``database-linkage``: for each number of accounts, by the estimated rotation
        (whitened foot points, and nearest points) and, where there are accounts, by signatures.

    Raises
    ------
    AuditError
        There are no strangers to tell moments from.
    """
    if strangers < 1:
        raise AuditError("the moments of a database need strangers: ask for one or more")
    numbers = [number for number in sorted(set(accounts)) if number <= len(system.attacker)]
    own = system.attacker[: max(numbers, default=0)]
    first = _steal(system, "first", system.victims.enrolled[:most_people], own, strangers)
    second = _steal(system, "second", system.victims.fresh[:most_people], own, strangers)
    with Keystream.seeded("audit", system.seed, "strangers", "attacker") as stream:
        drawn = client_source(system.lifter.source).draw(strangers, 1, stream=stream)[:, 0, :]
    lifted = Moments.of(system.lift(drawn, "database lifted by the attacker"))
    outcomes = []
    for number in numbers:
        left, right = (
            side.victims.rotated(
                estimate_rotation(side.moments, lifted, side.accounts.feet[:number], own[:number]).T
            )
            for side in (first, second)
        )
        scores = {
            "estimated rotations, foot points": whitened_cosines(left, right, lifted),
            "estimated rotations, nearest points": nearest_similarities(left, right),
        }
        if number:
            scores["signatures"] = signature_cosines(
                first.victims, second.victims, first.accounts[:number], second.accounts[:number]
            )
        outcomes += [
            linkage_outcome(
                system,
                unlinkability(score[None], permutations=permutations, seed=system.seed),
                attack="database-linkage",
                variant=f"{number} accounts, {name}",
                knowledge=Knowledge.TEMPLATES,
                assumption=f"The whole databases of two tenants, whose keys are secret, how "
                f"templates are lifted, and {number} accounts with both, with the descriptors "
                "enrolled there; success is D_sys of the templates of the people in both",
                judged=True,
                details={"accounts": number, "strangers": strangers},
            )
            for name, score in scores.items()
        ]
    return outcomes
