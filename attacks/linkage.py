"""Whether templates of one person, held by two tenants, can be told from those of two people.

Without a secret, templates link by what they are for (docs/method.md §4.9). A secret rotation of
each tenant leaves of a single template nothing but its foot point's length: two affine subspaces of
one dimension are images of each other under a rotation exactly if their feet are equally long. So
``foot-length`` is all that an attacker with one template of each side can compare. An attacker with
both whole databases has more: see ``attacks.databases``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import AttackOutcome, Knowledge, Property
from attacks.system import System
from attacks.unlinkability import Unlinkability, unlinkability
from templates.contract.canonical import Json
from templates.distances import Metric, pairwise_distances, similarity
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import tenant_rotation
from templates.space.subspace import SubspaceBatch

LIFTINGS = 4
"""Times that every victim is lifted for both tenants, with other decoys and other keys."""

Array64 = NDArray[np.float64]
Score = Callable[[SubspaceBatch, SubspaceBatch], Array64]


def nearest_similarities(left: SubspaceBatch, right: SubspaceBatch) -> Array64:
    """Spherical subspace-to-subspace similarities, (T, U): what a service would match with."""
    distances = pairwise_distances(left, right, metric=Metric.SPHERICAL)
    return np.asarray(similarity(distances), dtype=np.float64)


def foot_cosines(left: SubspaceBatch, right: SubspaceBatch) -> Array64:
    """Cosines of the foot points, (T, U)."""
    first, second = (
        batch.feet.astype(np.float64) / np.maximum(batch.foot_norms, 1e-300)[:, None]
        for batch in (left, right)
    )
    return np.asarray(first @ second.T)


def foot_lengths(left: SubspaceBatch, right: SubspaceBatch) -> Array64:
    """−|‖p‖ − ‖q‖|, (T, U): the only score of two templates that no rotation changes."""
    return -np.abs(left.foot_norms[:, None] - right.foot_norms)


SCORES: Mapping[str, Score] = {
    "nearest points": nearest_similarities,
    "foot points": foot_cosines,
    "foot lengths": foot_lengths,
}


@dataclass(frozen=True)
class _Setting:
    name: str
    knowledge: Knowledge
    rotated: bool
    leaked: bool
    judged: bool
    assumption: str


_SUCCESS = "; success is D_sys of the two tenants' templates of the same people"
_SETTINGS = (
    _Setting(
        "no rotation",
        Knowledge.TEMPLATE,
        rotated=False,
        leaked=False,
        judged=False,
        assumption="One template of each of two tenants that use no rotation, which the service "
        "never does" + _SUCCESS + " (a control: here templates link by design)",
    ),
    _Setting(
        "secret rotations",
        Knowledge.ALGORITHM,
        rotated=True,
        leaked=False,
        judged=True,
        assumption="One rotated template of each of two tenants, and how templates are lifted, "
        "but not the tenants' keys" + _SUCCESS,
    ),
    _Setting(
        "keys leaked",
        Knowledge.KEY,
        rotated=True,
        leaked=True,
        judged=True,
        assumption="One rotated template of each of two tenants, and the rotation keys of both"
        + _SUCCESS,
    ),
)


def secret_rotation(system: System, *tenant: str | int) -> Array64:
    """Return the rotation of a tenant of the experiment."""
    with Keystream.seeded("audit", system.seed, "tenant key", *tenant) as stream:
        return tenant_rotation(stream.token(KEY_BYTES), system.templates.n)


def linkage_outcome(
    system: System,
    measured: Unlinkability,
    *,
    attack: str,
    variant: str,
    knowledge: Knowledge,
    assumption: str,
    judged: bool,
    details: Mapping[str, Json] | None = None,
) -> AttackOutcome:
    """Report D_sys, with the mean of its null as chance."""
    return AttackOutcome(
        attack=attack,
        variant=variant,
        breaks=Property.UNLINKABILITY,
        knowledge=knowledge,
        assumption=assumption,
        scheme=system.scheme,
        measured=measured.d_sys,
        chance=measured.null_mean,
        judged=judged,
        details={**measured.details(), **(details or {})},
    )


def link(
    system: System,
    *,
    liftings: int = LIFTINGS,
    permutations: int = 500,
    most_people: int = 400,
) -> list[AttackOutcome]:
    """Link two tenants' templates of the victims, one by one.

    One tenant has enrolled each victim from ``system.victims.enrolled``, the other from the fresh
    photo. All pairs of two victims are impostor pairs.

    Parameters
    ----------
    liftings
        Independent repetitions, which make the histograms finer.
    permutations
        Of the null.
    most_people
        Victims that are used: the time grows with the square.

    Returns
    -------
    list of AttackOutcome
        A row for each setting and score, named ``linkage``.
    """
    enrolled = system.victims.enrolled[:most_people]
    fresh = system.victims.fresh[:most_people]
    scores: dict[tuple[str, str], list[Array64]] = {}
    for number in range(liftings):
        first = system.lift(enrolled, f"linkage, first tenant {number}")
        second = system.lift(fresh, f"linkage, second tenant {number}")
        keys = secret_rotation(system, "first", number), secret_rotation(system, "second", number)
        hidden = first.rotated(keys[0]), second.rotated(keys[1])
        opened = hidden[0].rotated(keys[0].T), hidden[1].rotated(keys[1].T)
        for setting in _SETTINGS:
            sides = (first, second)
            if setting.rotated:
                sides = opened if setting.leaked else hidden
            for name, score in SCORES.items():
                scores.setdefault((setting.name, name), []).append(score(*sides))
    return [
        linkage_outcome(
            system,
            unlinkability(
                np.stack(scores[setting.name, name]), permutations=permutations, seed=system.seed
            ),
            attack="linkage",
            variant=f"{setting.name}, {name}",
            knowledge=setting.knowledge,
            assumption=setting.assumption,
            judged=setting.judged,
            details={"liftings": liftings},
        )
        for setting in _SETTINGS
        for name in SCORES
    ]
