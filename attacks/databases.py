"""Linking two stolen databases whose tenants rotate: what many templates tell of the rotations.

A secret rotation hides one template. Were it one for all templates of a tenant, as in version 1,
the mean and the second moments of a stolen database would tell something of it, for the attacker
knows how un-rotated templates are spread (decoys come from a generator that clients have); and
some accounts in both databases, whose templates the attacker sent, would tell all of it
(``attacks.chosen_enrollment``). Where each template has a rotation of its own, no two have
anything in common to estimate. Who has the master key undoes the tenants' rotations, and is left
with the holders', where people keep keys, be the databases two tenants' or two halves of one.

Accounts that were enrolled from photos are not tried: their owner knows the descriptor, where who
sent the template knows that and the set around it, and so whatever the other could estimate.

Of as many decoys as a service uses, un-rotated templates of one person are as unlike as those of
two by every number that is compared here, so nothing follows from not linking them. The same is
done with templates of few decoys, which link once they are un-rotated: a check of the method and
of the rotations; where these hold, it is no figure of the scheme. A row proves something only where
its control links, in which each tenant has one rotation. What no rotation changes, the lengths of
foot points, ``attacks.linkage`` compares. Neither is in the paper.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.chosen_enrollment import Sides, estimate_from_sets, polar_factor, product_pairs
from attacks.errors import AuditError
from attacks.holder_keys import CONTROL_DIM
from attacks.linkage import (
    holder_rotations_of,
    linkage_outcome,
    nearest_similarities,
    rotations_of,
    turned,
)
from attacks.outcomes import CONTROL, AttackOutcome, Knowledge, Leaked, unproven
from attacks.system import System
from attacks.unlinkability import unlinkability
from templates.keys.randomness import Keystream
from templates.keys.rotation import Rotation
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch
from verify.cohort import client_source

ACCOUNTS = (0, 10, 100, 500)
"""Accounts that the attacker has with both tenants; n / (m + 1) fix a common rotation."""
FEW_DECOYS = "a check of the method on few decoys, and not of the scheme's templates"
STRANGERS = 1000
"""Further people in each tenant's database: others in each."""
ALIGNMENTS = 20
"""Steps of the estimate of a rotation: settled after some three, and with few accounts later."""
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


def estimate_rotation(stolen: Moments, lifted: Moments, pairs: Array64 | None = None) -> Array64:
    """Estimate the rotation of a tenant that has one for all, from its database.

    Parameters
    ----------
    stolen, lifted
        Moments of the tenant's database, and of templates that the attacker lifted itself.
    pairs : (n, n) float64
        What the attacker's own accounts tell, too few to fix the rotation: ``product_pairs``.

    Returns
    -------
    ndarray of float64, shape (n, n)
        Orthogonal; x of the tenant is taken back by ``estimate.T @ x``.

    Notes
    -----
    The log-likelihood of R, for directions that are Gaussian with the lifted covariance Σ, and for
    the mean, is ``−N m / 2 tr(R Σ⁻¹ Rᵀ S) + tr(Rᵀ T)``, with S the stolen covariance and T the
    outer product of the means, as often as there are templates. With ``(c I − Σ⁻¹)`` in place of
    ``−Σ⁻¹``, which adds a constant, the first term is convex in R, so it lies above its tangent,
    and the polar factor of the gradient never lowers the whole: Procrustes' solution, step by step.
    It starts at the principal axes, paired by rank, with the signs that T gives them. Pairs are
    exact but for rounding: each is added to T with the weight of the whole database.
    """
    noise = stolen.power / len(stolen.mean)
    known = stolen.templates / (2 * noise) * np.outer(stolen.mean, lifted.mean)
    precision = 1 / lifted.variances
    gain = precision.max() - precision
    weight = stolen.templates * stolen.m
    if pairs is not None:
        known += weight * precision.max() * pairs
    known = stolen.axes.T @ known @ lifted.axes
    turn = np.diag(np.where(np.diagonal(known) < 0, -1.0, 1.0))
    for _ in range(ALIGNMENTS):
        turn = polar_factor(weight * stolen.variances[:, None] * turn * gain + known)
    return np.asarray(stolen.axes @ turn @ lifted.axes.T)


def whitened_cosines(left: SubspaceBatch, right: SubspaceBatch, spread: Moments) -> Array64:
    """Cosines of foot points, less their mean, in units of what decoys vary along each axis."""
    scale = np.sqrt(spread.variances)
    sides = []
    for batch in (left, right):
        rows = batch.feet.astype(np.float64) @ spread.axes
        rows = (rows - rows.mean(axis=0)) / scale
        sides.append(normalised(rows))
    return np.asarray(sides[0] @ sides[1].T)


@dataclass(frozen=True, eq=False, repr=False)
class _Tenant:
    """A tenant's templates before they are turned: of the victims, of the accounts, of others."""

    name: str
    lifted: SubspaceBatch
    victims: int

    def strangers(self, accounts: int) -> int:
        """Number of others."""
        return len(self.lifted) - self.victims - accounts


@dataclass(frozen=True, eq=False, repr=False)
class _Side:
    """A stolen database: each template in its rotation, and the accounts' as they were sent."""

    stored: SubspaceBatch
    sent: SubspaceBatch
    victims: int

    @classmethod
    def of(cls, tenant: _Tenant, rotations: Sequence[Rotation], accounts: int) -> "_Side":
        last = tenant.victims + accounts
        sent = tenant.lifted[tenant.victims : last]
        return cls(turned(tenant.lifted, rotations), sent, tenant.victims)

    @property
    def people(self) -> SubspaceBatch:
        return self.stored[: self.victims]

    def accounts(self, number: int) -> Sides:
        """The first accounts, as they were sent and as they were stolen."""
        stolen = self.stored[self.victims : self.victims + number]
        return Sides(self.sent[:number], stolen)

    def estimate(self, number: int, lifted: Moments) -> Array64:
        """Estimate the rotation from the database and the first accounts."""
        accounts = self.accounts(number)
        if _fixes(number, lifted.m, self.stored.n):
            return estimate_from_sets(accounts)
        pairs = product_pairs(accounts) if number else None
        return estimate_rotation(Moments.of(self.stored), lifted, pairs)


def _fixes(accounts: int, m: int, n: int) -> bool:
    """Whether so many accounts fix a common rotation, so that moments add nothing."""
    return accounts * (m + 1) >= n


@dataclass(frozen=True, eq=False, repr=False)
class _Setting:
    """Two databases as they were stolen, and how the rows about them are named."""

    accounts: int
    sides: Sequence[_Side]
    stolen: str
    name: str = ""
    one_tenant: bool = False

    def scores(self, lifted: Moments) -> dict[str, Array64]:
        """Compare the people of both sides, by what is estimated of the rotations."""
        first, second = self.sides
        estimate = first.estimate(self.accounts, lifted)
        left = first.people.rotated(estimate.T)
        if not self.one_tenant:
            estimate = second.estimate(self.accounts, lifted)
        right = second.people.rotated(estimate.T)
        return {
            "foot points": whitened_cosines(left, right, lifted),
            "nearest points": nearest_similarities(left, right),
        }


_KEPT = "holders' keys kept, "
_TENANTS_KEYS = "The whole databases of two tenants, whose keys are secret"
_HOLDERS_KEYS = (
    "The whole databases of two tenants and every secret of the deployment, but not the keys that "
    "people keep, each the same for both"
)
_HALVES = (
    "The whole database of a tenant, in which the people are twice, and every secret of the "
    "deployment, but not the keys that people keep, each the same for both"
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

    Returns
    -------
    list of AttackOutcome
        Named ``database-linkage``, by what is compared once the estimated rotations are undone:
        whitened foot points, and nearest points. Of templates of few decoys for each number of
        accounts, and for the largest with the master key stolen and the holders' keys kept: two
        tenants, and, where there are accounts, one that is split in two, whose halves have no
        rotation to undo between them (without accounts that is a row of ``attacks.linkage``). Of
        the scheme's own, the same for the least number that fixes a common rotation. Beside each
        number, as a control, one rotation for all templates of a tenant. Judged are, where the
        control links, the scheme's own and those of few decoys that link as well.

    Raises
    ------
    AuditError
        There are no strangers to tell moments from, or no numbers of accounts.
    """
    if strangers < 1:
        raise AuditError("the moments of a database need strangers: ask for one or more")
    numbers = [number for number in sorted(set(accounts)) if number <= len(system.attacker)]
    if not numbers:
        raise AuditError("ask for a number of accounts that the attacker has faces for, or for 0")
    m, n = system.scheme.dim, system.templates.n
    fixing = next((number for number in numbers if _fixes(number, m, n)), numbers[-1])
    asked = {m: [fixing]} if m <= CONTROL_DIM else {CONTROL_DIM: numbers, m: [fixing]}
    outcomes = []
    for dim, some in asked.items():
        tenants, lifted = _enrolled(system, dim, some, strangers, most_people)
        controls: dict[tuple[int, str], AttackOutcome] = {}
        for setting in _settings(system, tenants, some):
            for name, score in setting.scores(lifted).items():
                row = linkage_outcome(
                    system,
                    unlinkability(score[None], permutations=permutations, seed=system.seed),
                    attack="database-linkage",
                    variant=f"m = {dim}, {setting.accounts} accounts, {setting.name}{name}",
                    leaked=Leaked.MASTER_KEY,
                    knowledge=Knowledge.TEMPLATES,
                    assumption=f"{setting.stolen}, how templates are lifted, and "
                    f"{setting.accounts} accounts with both, whose templates it sent; the "
                    f"templates are of m = {dim}; success is D_sys of those of the people in "
                    "both, once the estimated rotations are undone",
                    details={
                        "accounts": setting.accounts,
                        "strangers": tenants[0].strangers(max(some)),
                        "m": dim,
                    },
                )
                control = controls.setdefault((setting.accounts, name), row)
                outcomes.append(_judged_by(control, row, of_scheme=dim == m))
    return outcomes


def _judged_by(control: AttackOutcome, row: AttackOutcome, *, of_scheme: bool) -> AttackOutcome:
    """Say why a row is not judged, where it is not.

    A row of few decoys that links is: what failed is the rotation, which is the scheme's at any m.
    """
    if row is control:
        return replace(row, assumption=row.assumption + " (a control)", unjudged=CONTROL)
    reason = unproven(control, "one rotation for each tenant")
    return replace(row, unjudged=reason or (None if of_scheme or row.succeeds else FEW_DECOYS))


def _enrolled(
    system: System, dim: int, accounts: Sequence[int], strangers: int, most_people: int
) -> tuple[list[_Tenant], Moments]:
    """Both tenants' templates of this dimension, and the moments of the attacker's own ones.

    Strangers are among them only where something is estimated from moments.
    """
    source = client_source(system.lifter.source)
    moments = not all(_fixes(number, dim, source.n) for number in accounts)

    def others(name: str) -> NDArray[np.float32]:
        with Keystream.seeded("audit", system.seed, "strangers", name) as stream:
            return source.draw(strangers, 1, stream=stream)[:, 0, :]

    def lifted(people: Sequence[NDArray[np.float32]], name: str) -> SubspaceBatch:
        members = np.ascontiguousarray(np.concatenate(people), dtype=np.float32)
        return system.lift(members, f"database {name}, m = {dim}", m=dim)

    own = system.attacker[: max(accounts)]
    tenants = []
    for name, photos in (("first", system.victims.enrolled), ("second", system.victims.fresh)):
        people = photos[:most_people]
        strange = [others(name)] if moments else []
        tenants.append(_Tenant(name, lifted([people, own, *strange], name), len(people)))
    return tenants, Moments.of(lifted([others("attacker")], "lifted by the attacker"))


def _settings(system: System, tenants: Sequence[_Tenant], numbers: Sequence[int]) -> list[_Setting]:
    """What is stolen, with how many accounts; the first for a number of accounts is its control."""
    most = max(numbers)
    named = [(f"database {tenant.name}", len(tenant.lifted)) for tenant in tenants]
    rotated = [rotations_of(system, name, "template", count) for name, count in named]
    held = [holder_rotations_of(system, name, count) for name, count in named]
    alike = [[own[0]] * len(own) for own in rotated]
    stolen, kept, control = (
        [_Side.of(tenant, turns, most) for tenant, turns in zip(tenants, side, strict=True)]
        for side in (rotated, held, alike)
    )
    downwards = sorted(numbers, reverse=True)
    return [
        *(
            _Setting(number, control, _TENANTS_KEYS, "one rotation a tenant, ")
            for number in downwards
        ),
        *(
            [_Setting(most, kept, _HALVES, f"two halves of one tenant, {_KEPT}", one_tenant=True)]
            if most
            else []
        ),
        _Setting(most, kept, _HOLDERS_KEYS, _KEPT),
        *(_Setting(number, stolen, _TENANTS_KEYS) for number in downwards),
    ]
