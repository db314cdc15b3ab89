"""Linking two stolen databases whose tenants rotate: what many templates tell of the rotations.

A secret rotation hides one template. Were it one for all templates of a tenant, as in version 1,
the mean and the second moments of a stolen database would tell which axes were turned where, for
the attacker knows how un-rotated templates are spread (decoys come from a generator that clients
have); and accounts of the attacker's own, in both databases, would tell more. Where each template
has a rotation of its own, no two have anything in common to estimate. Both are measured: the first
as a control that the attack is one. Who has the master key undoes the tenants' rotations, and is
left with the holders', where people keep keys, be the databases two tenants' or two halves of one.
Neither is in the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.linkage import (
    foot_lengths,
    holder_rotations_of,
    linkage_outcome,
    nearest_similarities,
    rotations_of,
    turned,
)
from attacks.outcomes import AttackOutcome, Knowledge, Leaked
from attacks.system import System
from attacks.unlinkability import unlinkability
from templates.keys.randomness import Keystream
from templates.keys.rotation import Rotation
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
        return cls._of(
            spread * batch.n / (len(batch) * batch.m),
            mean=batch.feet.mean(axis=0, dtype=np.float64),
            power=float((batch.foot_norms**2).mean()),
            templates=len(batch),
            m=batch.m,
        )

    @classmethod
    def of_both(cls, first: "Moments", second: "Moments") -> "Moments":
        """Moments of two halves of a database that are as large as each other."""
        spreads = [(half.axes * half.variances) @ half.axes.T for half in (first, second)]
        return cls._of(
            (spreads[0] + spreads[1]) / 2,
            mean=(first.mean + second.mean) / 2,
            power=(first.power + second.power) / 2,
            templates=first.templates + second.templates,
            m=first.m,
        )

    @classmethod
    def _of(
        cls, spread: Array64, *, mean: Array64, power: float, templates: int, m: int
    ) -> "Moments":
        variances, axes = np.linalg.eigh(spread)
        return cls(
            mean=mean,
            variances=np.maximum(variances[::-1], 1e-9),
            axes=axes[:, ::-1],
            power=power,
            templates=templates,
            m=m,
        )


def estimate_rotation(
    stolen: Moments,
    lifted: Moments,
    feet: NDArray[np.floating],
    descriptors: NDArray[np.floating],
    *,
    steps: int = ALIGNMENTS,
) -> Array64:
    """Estimate the rotation of a tenant that has one for all, from its database.

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
    that both sides share changes; every entry is standardised over the templates of its tenant.
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


@dataclass(frozen=True, eq=False, repr=False)
class _Tenant:
    """A tenant's templates before they are turned: of the victims, of the accounts, of others."""

    name: str
    lifted: SubspaceBatch
    victims: int
    accounts: int

    def own_rotations(self, system: System) -> list[Rotation]:
        """One of each template."""
        return rotations_of(system, f"database {self.name}", "template", len(self.lifted))

    def holders_rotations(self, system: System) -> list[Rotation]:
        """One of each template, by a key that its holder has for both tenants."""
        return holder_rotations_of(system, f"database {self.name}", len(self.lifted))

    def stolen(self, rotations: Sequence[Rotation]) -> _Database:
        """The database, each template in its rotation."""
        stored = turned(self.lifted, rotations)
        last = self.victims + self.accounts
        return _Database(stored[: self.victims], stored[self.victims : last], Moments.of(stored))


def _enrolled(
    system: System,
    tenant: str,
    people: NDArray[np.float32],
    own: NDArray[np.float32],
    strangers: int,
) -> _Tenant:
    with Keystream.seeded("audit", system.seed, "strangers", tenant) as stream:
        others = client_source(system.lifter.source).draw(strangers, 1, stream=stream)[:, 0, :]
    members = np.ascontiguousarray(np.concatenate([people, own, others]), dtype=np.float32)
    lifted = system.lift(members, f"database of the {tenant} tenant")
    return _Tenant(tenant, lifted, len(people), len(own))


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
        (whitened foot points, and nearest points), by the lengths of the foot points, which no
        rotation changes, and, where there are accounts, by signatures. Then, for the largest
        number, with the master key stolen and the holders' keys kept: two tenants, and one that is
        split in two. Last a control that is not judged: one rotation for a tenant.

    Raises
    ------
    AuditError
        There are no strangers to tell moments from.
    """
    if strangers < 1:
        raise AuditError("the moments of a database need strangers: ask for one or more")
    numbers = [number for number in sorted(set(accounts)) if number <= len(system.attacker)]
    own = system.attacker[: max(numbers, default=0)]
    tenants = [
        _enrolled(system, name, people[:most_people], own, strangers)
        for name, people in (("first", system.victims.enrolled), ("second", system.victims.fresh))
    ]
    with Keystream.seeded("audit", system.seed, "strangers", "attacker") as stream:
        drawn = client_source(system.lifter.source).draw(strangers, 1, stream=stream)[:, 0, :]
    lifted = Moments.of(system.lift(drawn, "database lifted by the attacker"))
    rotated = [tenant.own_rotations(system) for tenant in tenants]
    held = [tenant.holders_rotations(system) for tenant in tenants]
    alike = [[own_rotations[0]] * len(own_rotations) for own_rotations in rotated]
    stolen, kept, control = (
        [tenant.stolen(turns) for tenant, turns in zip(tenants, side, strict=True)]
        for side in (rotated, held, alike)
    )
    whole = Moments.of_both(*(side.moments for side in kept))
    settings = [_Setting(number, stolen, _TENANTS_KEYS) for number in numbers]
    if numbers:
        halves = [replace(side, moments=whole) for side in kept]
        settings += [
            _Setting(len(own), kept, _HOLDERS_KEYS, "holders' keys kept, "),
            _Setting(len(own), halves, _HALVES, "two halves of one tenant, holders' keys kept, "),
            _Setting(len(own), control, _TENANTS_KEYS, "one rotation a tenant, "),
        ]
    return [
        linkage_outcome(
            system,
            unlinkability(score[None], permutations=permutations, seed=system.seed),
            attack="database-linkage",
            variant=f"{setting.accounts} accounts, {setting.name}{name}",
            leaked=Leaked.MASTER_KEY,
            knowledge=Knowledge.TEMPLATES,
            assumption=f"{setting.stolen}, how templates are lifted, and {setting.accounts} "
            "accounts with both, with the descriptors enrolled there; success is D_sys of the "
            "templates of the people in both"
            + (
                " (a control: each tenant has one rotation for all)"
                if setting.sides is control
                else ""
            ),
            judged=setting.sides is not control,
            details={"accounts": setting.accounts, "strangers": strangers},
        )
        for setting in settings
        for name, score in _scores(setting.sides, lifted, own[: setting.accounts]).items()
    ]


_TENANTS_KEYS = "The whole databases of two tenants, whose keys are secret"
_HOLDERS_KEYS = (
    "The whole databases of two tenants and every secret of the deployment, but not the keys that "
    "people keep, each the same for both"
)
_HALVES = (
    "The whole database of a tenant, in which the people are twice, and every secret of the "
    "deployment, but not the keys that people keep, each the same for both"
)


@dataclass(frozen=True, eq=False, repr=False)
class _Setting:
    """Two databases as they were stolen, and how the rows about them are named."""

    accounts: int
    sides: Sequence[_Database]
    stolen: str
    name: str = ""


def _scores(
    sides: Sequence[_Database], lifted: Moments, own: NDArray[np.float32]
) -> dict[str, Array64]:
    """Scores of the victims of both tenants, with the accounts of these descriptors."""
    number = len(own)
    left, right = (
        side.victims.rotated(
            estimate_rotation(side.moments, lifted, side.accounts.feet[:number], own).T
        )
        for side in sides
    )
    scores = {
        "estimated rotations, foot points": whitened_cosines(left, right, lifted),
        "estimated rotations, nearest points": nearest_similarities(left, right),
        "foot lengths": foot_lengths(left, right),
    }
    if number:
        first, second = sides
        scores["signatures"] = signature_cosines(
            first.victims, second.victims, first.accounts[:number], second.accounts[:number]
        )
    return scores
