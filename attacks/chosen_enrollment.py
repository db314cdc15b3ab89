"""A tenant's rotations from accounts whose templates the attacker sent itself.

Who may send templates knows what it enrolled: not the descriptor only, as of an account that was
enrolled from photos, but the whole set. The service stores the set's image under R in a basis of
its own drawing, so no row of it is known to be the image of another. What no
basis changes is the foot point, and the orthogonal projection on the directions: so every product
of projections, applied to a foot point, gives a pair (x, R x), and some N² pairs of N accounts fix
an R that they have in common. Templates of version 1 did, and it was the victims' too: a control
shows that it opens them. Since then each template has a rotation of its own, and what the attacker
finds out of its own ones is nobody else's. Not in the paper, which has no rotation;
docs/method.md §4.9 has the measure without accounts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import svd

from attacks.decisions import decide
from attacks.errors import AuditError
from attacks.linkage import holder_rotations_of, rotations_of, turned, turned_back
from attacks.outcomes import CONTROL, AttackOutcome, Knowledge, Leaked, Property, unproven
from attacks.recovery import fmr_of
from attacks.stored.honest_probes import honest_embedding, points_inside
from attacks.stored.nearest_neighbour import nearest_points
from attacks.system import System
from templates.contract.canonical import Json
from templates.keys.randomness import Keystream
from templates.keys.rotation import Rotation
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch
from verify.comparisons import through_wire
from verify.metrics import rate

ACCOUNTS = (5, 50, 500)
"""Accounts that the attacker enrolls: n / (m + 1) fix a common rotation, half of them nearly."""
ALIGNMENTS, FEW_ALIGNMENTS = 30, 6
"""Most steps of the estimate; the fewer with twice the accounts that fix a common rotation, with
which two settle it. What is no common rotation never settles."""
_ENOUGH_PAIRS, _MOST_PAIRS = 2, 64
"""Pairs for each dimension, from which on longer products of projections are left out, and from
which on every other pair is: the refinement, which takes every account, is more exact anyhow."""
_LEAST = 1e-3
"""Of a unit vector, how much a projection must leave, and take, to count."""
_SPANNED = 0.02
"""Singular values below this share of the largest are the rounding of float16, or as unsure."""
_CLIMB = 30

Array64 = NDArray[np.float64]


class Sides(NamedTuple):
    """The attacker's own templates: as it sent them, and as they were stolen."""

    sent: SubspaceBatch
    stolen: SubspaceBatch


def estimate_from_sets(sides: Sides) -> Array64:
    """Estimate R from S sets and their images; (n, n) orthogonal, undone by ``estimate.T @ x``.

    Parameters
    ----------
    sides
        Template i of ``stolen`` is the image of template i of ``sent``, in another basis.

    Notes
    -----
    First Procrustes' solution for the pairs that need no basis: P_k … P_i p_j and their images,
    scaled to length 1. Then the bases themselves: given R, the basis E_i that was stolen is U_i
    D_i Rᵀ with an orthogonal U_i, which is Procrustes' problem of size m; given all U_i, R is
    Procrustes' problem with S (m + 1) pairs, which use all that is known. The two alternate,
    and none ever lowers the fit.
    """
    sent, stolen = (_Stacked.of(side) for side in sides)
    estimate = polar_factor(product_pairs(sides))
    settled = 0.0
    enough = sent.bases.shape[0] * (sent.bases.shape[1] + 1) >= 2 * sent.feet.shape[1]
    for _ in range(FEW_ALIGNMENTS if enough else ALIGNMENTS):
        turned = sent.bases @ estimate.T
        left, values, right = np.linalg.svd(stolen.bases @ turned.transpose(0, 2, 1))
        fit = float(values.sum())
        matched = (left @ right) @ sent.bases
        rows = stolen.bases.reshape(-1, stolen.bases.shape[2])
        estimate = polar_factor(rows.T @ matched.reshape(rows.shape) + stolen.feet.T @ sent.feet)
        if fit - settled <= 1e-6 * values.size:
            break
        settled = fit
    return estimate


class _Stacked(NamedTuple):
    """Templates in float64, their foot points scaled to length 1."""

    feet: Array64
    bases: Array64

    @classmethod
    def of(cls, batch: SubspaceBatch) -> "_Stacked":
        feet = batch.feet.astype(np.float64)
        return cls(normalised(feet), batch.bases.astype(np.float64))

    def project(self, number: int, points: Array64) -> Array64:
        """Orthogonal projection of (K, n) points on the directions of one template."""
        basis = self.bases[number]
        return np.asarray((points @ basis.T) @ basis)


def product_pairs(sides: Sides) -> Array64:
    """Σ y xᵀ over unit pairs y = R x of products of projections of foot points, (n, n).

    Products of two projections are taken only where those of one are too few: they are shorter,
    and rounding counts more in them.
    """
    sent, stolen = (_Stacked.of(side) for side in sides)
    count, n = sent.feet.shape
    points, images = sent.feet, stolen.feet
    moment = images.T @ points
    pairs = count
    for _ in range(2):
        if count < 2 or pairs >= _ENOUGH_PAIRS * n:
            break
        products: tuple[list[Array64], list[Array64]] = [], []
        for number in range(count):
            if pairs >= _MOST_PAIRS * n:
                break
            here, there = sent.project(number, points), stolen.project(number, images)
            # A foot point is orthogonal to its own directions, and P P = P: both give no new pair.
            lengths = np.linalg.norm(here, axis=1)
            new = (lengths > _LEAST) & (lengths < 1 - _LEAST)
            products[0].append(normalised(here[new]))
            products[1].append(there[new] / lengths[new, None])
            moment += products[1][-1].T @ products[0][-1]
            pairs += len(products[0][-1])
        points, images = np.concatenate(products[0]), np.concatenate(products[1])
    return np.asarray(moment)


def polar_factor(moment: Array64) -> Array64:
    """Return the orthogonal matrix that is nearest to a square one; of several, any."""
    try:
        left, _values, right = np.linalg.svd(moment)
    except np.linalg.LinAlgError:
        # With few accounts the moment has hundreds of zero singular values, at which LAPACK's
        # divide and conquer may not converge; QR iteration does, several times slower.
        left, _values, right = svd(moment, lapack_driver="gesvd")
    return np.asarray(left @ right)


def best_known_points(stolen: SubspaceBatch, accounts: SubspaceBatch, *, seed: int) -> Array64:
    """Unit point of each stolen template that lies most in the span of the accounts' sets, (V, n).

    Where the accounts do not span everything, R is known on their span only. ‖P x‖² is convex, so
    going to the unit point nearest P x never lowers it.
    """
    rows = np.concatenate([_Stacked.of(accounts).feet, *accounts.bases.astype(np.float64)])
    # Squares of the singular values, of a matrix of size n instead of thousands of rows.
    values, axes = np.linalg.eigh(rows.T @ rows)
    span = axes[:, values > _SPANNED**2 * values[-1]].T
    points = points_inside(stolen, seed=seed).astype(np.float64)
    if len(span) < stolen.n:
        for _ in range(_CLIMB):
            points = nearest_points((points @ span.T) @ span, stolen)
    return points


def chosen_enrollment(
    system: System, *, accounts: tuple[int, ...] = ACCOUNTS
) -> list[AttackOutcome]:
    """Steal a tenant's database in which the attacker has accounts that it sent as templates.

    Parameters
    ----------
    accounts
        Numbers of accounts; those beyond the attacker's faces are left out.

    Returns
    -------
    list of AttackOutcome
        Named ``chosen-enrollment``, one for each number of accounts; ``alignment`` in ``details``
        is the largest tr(R̂ᵀR) / n of a victim's R, 1 where it is known. Then the same against
        victims who keep keys, with the tenant's stolen. Then the controls, which are not judged:
        each number with one rotation for all templates, by which both others are judged; and last
        the tenant's key.

    Raises
    ------
    AuditError
        The attacker has fewer faces than the least number of accounts.
    """
    numbers = [number for number in sorted(set(accounts)) if 1 <= number <= len(system.attacker)]
    if not numbers:
        raise AuditError("an attacker that enrolls templates of its own needs faces to lift")
    most, people = max(numbers), len(system.templates)
    tenant = "chosen enrollment"
    of_accounts = rotations_of(system, tenant, "account", most)
    of_victims = rotations_of(system, tenant, "victim", people)
    sent = system.lift(system.attacker[:most], "templates that the attacker enrolls")
    outcomes: dict[tuple[str, int], AttackOutcome] = {}
    common = of_accounts[:1]
    # Keys of other people: the attacker's own would open no more than its own templates.
    holders = holder_rotations_of(system, tenant, people + most)
    kept, own = holders[:people], holders[people:]
    for number, enrolled, rotations, setting in (
        *((number, of_accounts[:number], of_victims, _SECRET) for number in numbers),
        *((number, own[:number], kept, _KEPT) for number in numbers),
        *((number, common * number, common * people, _COMMON) for number in numbers),
    ):
        sides = Sides(sent[:number], _as_stored(system, sent[:number], enrolled))
        estimate = estimate_from_sets(sides)
        victims = _through_wire(system, turned(system.templates, rotations))
        points = best_known_points(victims, sides.stolen, seed=system.seed) @ estimate
        outcomes[setting.name, number] = _outcome(
            system,
            points,
            variant=f"{number} accounts" + setting.name,
            leaked=Leaked.MASTER_KEY,
            assumption=f"The right to send templates and embeddings, with which the attacker "
            f"has enrolled {number} templates of its own lifting, and the tenant's whole "
            f"stolen database, {setting.stolen}; it estimates a rotation from the "
            "templates that it sent and what became of them, and sends a unit point of every "
            f"victim's template, turned back, as an embedding; success is {setting.success}",
            unjudged=CONTROL if setting is _COMMON else None,
            details={"accounts": number, "alignment": _alignment(estimate, rotations)},
        )
    reasons = {
        number: unproven(outcomes[_COMMON.name, number], "one rotation for all templates")
        for number in numbers
    }
    stolen = _through_wire(system, turned(system.templates, of_victims))
    return [
        *(
            replace(row, unjudged=row.unjudged or reasons[number])
            for (_setting, number), row in outcomes.items()
        ),
        _outcome(
            system,
            points_inside(turned_back(stolen, of_victims), seed=system.seed),
            variant="the tenant's key",
            leaked=Leaked.HOLDER_KEYS,
            assumption="The right to send embeddings, the tenant's whole stolen database, and its "
            "key, which gives every template's rotation; success is acceptance of a unit point of "
            "the template (a control)",
            unjudged=CONTROL,
            details={},
        ),
    ]


class _Setting(NamedTuple):
    name: str
    stolen: str
    success: str


_SECRET = _Setting("", "whose key is secret", "acceptance")
_KEPT = _Setting(
    ", holders' keys kept",
    "its key, and all but the keys that the victims keep",
    "acceptance as with the victim's key. To choose a key, and send what its rotation turns into "
    'the template, needs no account (docs/threat-model.md "A key that the person keeps")',
)
_COMMON = _Setting(
    ", one rotation for all",
    "whose key is secret",
    "acceptance (a control: all templates are turned alike)",
)


def _outcome(
    system: System,
    points: NDArray[np.floating],
    *,
    variant: str,
    leaked: Leaked,
    assumption: str,
    unjudged: str | None,
    details: Mapping[str, Json],
) -> AttackOutcome:
    """Send one point for each victim; report acceptance."""
    probes = np.ascontiguousarray(points, dtype=np.float32)
    decided = decide(
        probes, system.templates, system.contract, system.points, system.level, paired=True
    )
    accepted = decided & honest_embedding(probes)
    return AttackOutcome(
        attack="chosen-enrollment",
        variant=variant,
        breaks=Property.IMPERSONATION,
        leaked=leaked,
        knowledge=Knowledge.TEMPLATES,
        assumption=assumption,
        scheme=system.scheme,
        level=system.level.name,
        measured=rate(int(np.count_nonzero(accepted)), len(accepted)),
        chance=fmr_of(system.level),
        unjudged=unjudged,
        details=details,
    )


def _alignment(estimate: Array64, rotations: Sequence[Rotation]) -> float:
    """Largest tr(R̂ᵀR) / n of the rotations R."""
    n = len(estimate)
    # tr(R̂ᵀR) is the sum of the products of the columns of R̂, and of R, which are R e.
    columns = np.ascontiguousarray(estimate.T)
    eye = np.eye(n)
    return max(float(np.vdot(columns, one.turned(eye))) / n for one in set(rotations))


def _as_stored(system: System, sent: SubspaceBatch, rotations: Sequence[Rotation]) -> SubspaceBatch:
    """Turn and store templates as the service does: in a fresh basis, and in float16."""
    with Keystream.seeded("audit", system.seed, "bases of the service") as stream:
        spanned = SubspaceBatch.through(sent.feet, sent.bases, stream=stream)
    return _through_wire(system, turned(spanned, rotations))


def _through_wire(system: System, batch: SubspaceBatch) -> SubspaceBatch:
    return through_wire(batch, contract_id=system.contract.contract_id)
