"""Whether two templates of one person, of two tenants or of one, can be told from two people's.

Without a secret, templates link by what they are for (docs/method.md §4.9). A rotation of each,
drawn by the Haar measure, leaves of a template nothing but its foot point's length: two affine
subspaces of one dimension are images of each other under a rotation exactly if their feet are
equally long. So the lengths are all that an attacker without a tenant's key can compare. With the
key every rotation is derived, and undone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import CONTROL, AttackOutcome, Knowledge, Leaked, Property, unproven
from attacks.second_order import Moments, decoy_moment
from attacks.system import System
from attacks.unlinkability import Unlinkability, unlinkability
from templates.contract.canonical import Json
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import SignedCosineRotation, TenantRotation, holder_rotation
from templates.space.subspace import SubspaceBatch, Turn

Array64 = NDArray[np.float64]
Score = Callable[[SubspaceBatch, SubspaceBatch], Array64]


def span_overlaps(left: SubspaceBatch, right: SubspaceBatch, decoys: Moments) -> Array64:
    """How much the linear spans of templates have in common, (T, U): more where they share a face.

    The sum of squared cosines of the principal angles, in coordinates in which decoys are spread
    evenly, less the average over templates. Nearest points tell nothing where two templates have
    more dimensions than the axes are: they meet then, whosesoever they are.
    """
    white = decoys.whitening.astype(np.float64)

    def projectors(batch: SubspaceBatch) -> Array64:
        rows = []
        for foot, basis in zip(batch.feet, batch.bases, strict=True):
            span = np.concatenate([foot[None], basis]).astype(np.float64) @ white
            axes = np.linalg.qr(span.T)[0]
            rows.append((axes @ axes.T).ravel())
        return np.asarray(np.stack(rows) - np.mean(rows, axis=0))

    return np.asarray(projectors(left) @ projectors(right).T)


def foot_lengths(left: SubspaceBatch, right: SubspaceBatch) -> Array64:
    """−|‖p‖ − ‖q‖|, (T, U): the only score of two templates that no rotation changes."""
    return -np.abs(left.foot_norms[:, None] - right.foot_norms)


LENGTHS, SPANS = "foot lengths", "overlap of spans"


@dataclass(frozen=True)
class _Setting:
    name: str
    leaked: Leaked
    assumption: str
    score: str = LENGTHS


_SUCCESS = "; success is D_sys of the templates of the same people"
_OPEN, _ONE_SET = "keys leaked", "one set for both"
_SETTINGS = (
    _Setting(
        "secret rotations",
        Leaked.MASTER_KEY,
        assumption="One rotated template of each of two tenants, and how templates are lifted, "
        "but not the tenants' keys" + _SUCCESS,
    ),
    _Setting(
        "one tenant",
        Leaked.MASTER_KEY,
        assumption="Two rotated templates of one tenant, and how templates are lifted, but not the "
        "tenant's key" + _SUCCESS,
    ),
    _Setting(
        "holder's key kept",
        Leaked.MASTER_KEY,
        assumption="Two templates that each person has enrolled under one key of their own, and "
        "every secret of the deployment, but not that key" + _SUCCESS,
    ),
    _Setting(
        _OPEN,
        Leaked.HOLDER_KEYS,
        assumption="One rotated template of each of two tenants, and the rotation keys of both"
        + _SUCCESS,
        score=SPANS,
    ),
    _Setting(
        _ONE_SET,
        Leaked.MASTER_KEY,
        assumption="One template of each of two tenants, the same set in two rotations, which its "
        "length must tell (a control)" + _SUCCESS,
    ),
)


def rotations_of(
    system: System, tenant: str, templates: str, count: int
) -> list[SignedCosineRotation]:
    """Return the rotations of some templates of a tenant of the experiment, one for each."""
    with Keystream.seeded("audit", system.seed, "tenant key", tenant) as stream:
        rotation = TenantRotation(stream.token(KEY_BYTES), system.templates.n)
    return [rotation.of(f"{templates} {number}") for number in range(count)]


def holder_rotations_of(system: System, enrollment: str, count: int) -> list[SignedCosineRotation]:
    """Return the rotations of an enrollment of some people, each under a key of their own."""
    with Keystream.seeded("audit", system.seed, "holder keys") as stream:
        keys = [stream.token(KEY_BYTES) for _ in range(count)]
    return [
        holder_rotation(key, f"{enrollment} {number}", system.templates.n)
        for number, key in enumerate(keys)
    ]


def turned(batch: SubspaceBatch, rotations: Sequence[SignedCosineRotation]) -> SubspaceBatch:
    """Turn each template by its rotation."""
    return _each_turned(batch, [rotation.turned for rotation in rotations])


def turned_back(batch: SubspaceBatch, rotations: Sequence[SignedCosineRotation]) -> SubspaceBatch:
    """Undo :func:`turned`."""
    return _each_turned(batch, [rotation.turned_back for rotation in rotations])


def _each_turned(batch: SubspaceBatch, turns: Sequence[Turn]) -> SubspaceBatch:
    pairs = zip(batch, turns, strict=True)
    return SubspaceBatch.of([template.turned_by(turn) for template, turn in pairs])


def turned_points(
    points: NDArray[np.floating], rotations: Sequence[SignedCosineRotation]
) -> Array64:
    """Turn each point, (V, n), by its rotation."""
    pairs = zip(points, rotations, strict=True)
    return np.concatenate([rotation.turned(point[None]) for point, rotation in pairs])


def linkage_outcome(
    system: System,
    measured: Unlinkability,
    *,
    attack: str,
    variant: str,
    leaked: Leaked,
    knowledge: Knowledge = Knowledge.ALGORITHM,
    assumption: str,
    unjudged: str | None = None,
    details: Mapping[str, Json] | None = None,
) -> AttackOutcome:
    """Report D_sys, with the mean of its null as chance."""
    return AttackOutcome(
        attack=attack,
        variant=variant,
        breaks=Property.UNLINKABILITY,
        leaked=leaked,
        knowledge=knowledge,
        assumption=assumption,
        scheme=system.scheme,
        measured=measured.d_sys,
        chance=measured.null_mean,
        unjudged=unjudged,
        details={**measured.details(), **(details or {})},
    )


def link(system: System, *, liftings: int, most_people: int = 400) -> list[AttackOutcome]:
    """Link two templates of each victim, one by one.

    One tenant has enrolled each victim from ``system.victims.enrolled``, the other, or the same
    one again, from the fresh photo. All pairs of two victims are impostor pairs.

    Parameters
    ----------
    liftings
        Times that every victim is lifted for both tenants, with other decoys and other keys, which
        makes the histograms finer.
    most_people
        Victims that are used: the time grows with the square.

    Returns
    -------
    list of AttackOutcome
        A row for each setting, named ``linkage``. Those in secret rotations are judged where
        lengths link one set in two rotations, a control that is the last row.
    """
    enrolled = system.victims.enrolled[:most_people]
    fresh = system.victims.fresh[:most_people]
    decoys = Moments.of(decoy_moment(system.source))
    by_name: Mapping[str, Score] = {
        LENGTHS: foot_lengths,
        SPANS: lambda left, right: span_overlaps(left, right, decoys),
    }
    scores: dict[str, list[Array64]] = {setting.name: [] for setting in _SETTINGS}
    for number in range(liftings):
        sides = _sides(system, enrolled, fresh, number)
        for setting in _SETTINGS:
            scores[setting.name].append(by_name[setting.score](*sides[setting.name]))
    rows = {
        setting.name: linkage_outcome(
            system,
            unlinkability(np.stack(scores[setting.name]), seed=system.seed),
            attack="linkage",
            variant=f"{setting.name}, {setting.score}",
            leaked=setting.leaked,
            assumption=setting.assumption,
            unjudged=CONTROL if setting.name == _ONE_SET else None,
            details={"liftings": liftings},
        )
        for setting in _SETTINGS
    }
    proven = unproven(rows[_ONE_SET], "one set in two rotations")
    return [
        row if name in (_OPEN, _ONE_SET) else replace(row, unjudged=proven)
        for name, row in rows.items()
    ]


def _sides(
    system: System, enrolled: NDArray[np.float32], fresh: NDArray[np.float32], number: int
) -> dict[str, tuple[SubspaceBatch, SubspaceBatch]]:
    """Return both templates of every person as each setting has them, in one lifting."""
    first = system.lift(enrolled, f"linkage, first tenant {number}")
    second = system.lift(fresh, f"linkage, second tenant {number}")
    count = len(first)
    left = rotations_of(system, f"first {number}", "template", count)
    right = rotations_of(system, f"second {number}", "template", count)
    again = rotations_of(system, f"first {number}", "another template", count)
    hidden = turned(first, left), turned(second, right)
    return {
        "secret rotations": hidden,
        "one tenant": (hidden[0], turned(second, again)),
        "holder's key kept": (
            turned(first, holder_rotations_of(system, f"first {number}", count)),
            turned(second, holder_rotations_of(system, f"second {number}", count)),
        ),
        _OPEN: (turned_back(hidden[0], left), turned_back(hidden[1], right)),
        _ONE_SET: (hidden[0], turned(first, right)),
    }
