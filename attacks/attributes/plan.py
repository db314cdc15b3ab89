"""What an attribute audit runs: its settings, the schemes, and what all of them share."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.faces import LabelledFaces, Split
from attacks.attributes.features import Axes
from attacks.errors import AuditError
from attacks.outcomes import GENERATED, POOLED, RAW_SCHEME, Scheme
from attacks.second_order import Moments, decoy_moment, drawn_towards
from templates.decoys import DecoyGenerator, DecoyPool
from templates.decoys.source import DecoySource
from templates.space.lifting import Strategy
from verify.fairface_labels import Label

Codes = NDArray[np.int64]

PAPER_DIMS = (2, 4, 8, 16)
OUR_DIMS = (2, 4, 8, 16, 32, 64)
_MOST_LIFTS = 3


@dataclass(frozen=True, kw_only=True)
class AttributePlan:
    """Settings of the attackers.

    Parameters
    ----------
    trained
        Train attackers beside the paper's.
    lifts
        Times that the attacker lifts each of its own faces to train on. None for as many as
        ``training_most`` allows, 1 to 3: labels are scarce, and lifting is free.
    gallery_most
        Trained attackers see the neighbours among at most so many random faces of the gallery, of
        their own templates and of the attacked ones alike. The paper's attacker searches all of the
        attacker's faces for an attacked template.
    folds
        Parts of the attacker's faces; a face is lifted with decoys of its own part and judged by
        axes and neighbours of the other parts.
    held_out
        Share of the lifted faces that the attacker chooses settings and attackers by.

    Raises
    ------
    AuditError
        The gallery is smaller than the neighbours that are searched for.
    """

    k: int = 10
    feature_ks: tuple[int, ...] = (10, 50)
    trained: bool = True
    lifts: int | None = None
    training_most: int = 10_000
    gallery_most: int = 10_000
    folds: int = 4
    held_out: float = 0.2
    threads: int = 2

    def __post_init__(self) -> None:
        if self.gallery_most < self.neighbours:
            raise AuditError(f"{self.neighbours} neighbours need a gallery of as many faces")

    @property
    def neighbours(self) -> int:
        """How many are searched for."""
        return max(self.k, *self.feature_ks)

    def lifts_of(self, faces: int) -> int:
        """Times that each of so many own faces is lifted."""
        if self.lifts is not None:
            return self.lifts
        return min(max(self.training_most // max(faces, 1), 1), _MOST_LIFTS)


@dataclass(frozen=True, eq=False)
class Side:
    """What some faces are lifted with, and judged by.

    Parameters
    ----------
    pool
        The same as decoys, labelled where they have gender and race.
    gallery
        Labelled faces to search for neighbours, in random order.
    nearby
        The first of them, at most as many as the plan says.
    faces
        Second moments of the gallery's faces, as far as so many tell them; None without a
        generator.
    """

    entries: LabelledFaces
    pool: DecoyPool
    gallery: LabelledFaces
    nearby: LabelledFaces
    axes: Axes
    faces: Moments | None

    @classmethod
    def of(
        cls,
        entries: LabelledFaces,
        gallery: LabelledFaces,
        *,
        nearby: int,
        decoys: Moments | None,
    ) -> "Side":
        """Make the pool, and find the axes and moments; ``decoys`` are the generator's."""
        labelled = {"gender", "race"} <= set(entries.attributes)
        labels = entries.decoy_attributes() if labelled else None
        pool = DecoyPool(entries.descriptors, labels=labels)
        faces = None
        if decoys is not None:
            faces = Moments.of(drawn_towards(gallery.descriptors, decoys.moment))
        near = gallery.take(np.arange(min(nearby, len(gallery))))
        return cls(entries, pool, gallery, near, Axes.fit(gallery), faces)


@dataclass(frozen=True, eq=False)
class Fold:
    """One part of the attacker's faces.

    Parameters
    ----------
    entries : (faces,) int64
        Their positions in the side's pool.
    held : (faces,) bool
        Those of them that it chooses by, and does not learn from.
    side
        The faces of the part as a pool; the faces of all other parts as gallery.
    """

    own: LabelledFaces
    entries: Codes
    held: NDArray[np.bool_]
    side: Side


@dataclass(frozen=True, eq=False)
class Setup:
    """What all schemes share; made once by :func:`prepare`.

    Parameters
    ----------
    side
        Of the attacked faces: the lifting database as pool, all of the attacker's as gallery.
    """

    split: Split
    plan: AttributePlan
    seed: int
    side: Side
    generator: DecoyGenerator | None
    decoys: Moments | None
    folds: tuple[Fold, ...]

    def source(self, scheme: Scheme, side: Side) -> DecoySource | None:
        """Return where the decoys of a scheme come from on one side."""
        if scheme.decoys is None:
            return None
        if scheme.decoys == POOLED:
            return side.pool
        if self.generator is None:
            raise AuditError("schemes with generated decoys need a decoy generator")
        return self.generator


def prepare(
    parts: Split,
    *,
    plan: AttributePlan,
    seed: int,
    generator: DecoyGenerator | None = None,
) -> Setup:
    """Find what all schemes share.

    Parameters
    ----------
    generator
        The one of the deployment that is audited, which clients have, on the axes that the faces
        are projected on. Without one, schemes with generated decoys cannot be run.

    Raises
    ------
    AuditError
        The attacker has too few faces for the plan.
    """
    decoys = None if generator is None else Moments.of(decoy_moment(generator))
    side_of = partial(Side.of, nearby=plan.gallery_most, decoys=decoys)
    require_folds(len(parts.attack), plan)
    rng = np.random.default_rng([seed, 1])
    order = rng.permutation(len(parts.attack))
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order)) % plan.folds
    chosen = np.zeros(len(order), dtype=np.bool_)
    chosen[order[: plan.training_most]] = True
    folds = []
    for fold in range(plan.folds):
        part = parts.attack.take(np.flatnonzero(number == fold))
        gallery = parts.attack.take(order[number[order] != fold])
        entries = np.flatnonzero(chosen[number == fold])
        own = part.take(entries)
        held_out = np.zeros(len(own), dtype=np.bool_)
        held_out[rng.permutation(len(own))[: round(plan.held_out * len(own))]] = True
        folds.append(Fold(own, entries, held_out, side_of(part, gallery)))
    side = side_of(parts.lifting, parts.attack.take(order))
    return Setup(parts, plan, seed, side, generator, decoys, tuple(folds))


def require_folds(faces: int, plan: AttributePlan) -> None:
    """Check that so many faces of the attacker's can be dealt into the plan's folds.

    Raises
    ------
    AuditError
        Too few are in the gallery of a fold for the neighbours that are asked for, or in a fold to
        hold some of them out.
    """
    least = faces - -(-faces // plan.folds)
    if least < plan.neighbours:
        raise AuditError(
            f"the attacker's {faces} faces leave {least} in the gallery of a fold, and "
            f"{plan.neighbours} neighbours are asked for: give the attacker more faces"
        )
    own = min(faces, plan.training_most) // plan.folds
    if not 0 < round(plan.held_out * own) < own:
        raise AuditError(
            f"a fold of {own} faces is too small to hold some of them out: give the attacker more "
            "faces"
        )


def require_decoys(
    schemes: Sequence[Scheme], labels: Sequence[Label], *, lifting: int, fold: int
) -> None:
    """Check that pools of so many faces give the decoys that the schemes take.

    Of a fold, which is the pool of its own faces, half: where a face is drawn for itself, all its
    decoys are drawn again, and of more than half that would hardly end.

    Parameters
    ----------
    labels
        Of the faces that the pools are drawn from; hybrid+ takes decoys of another gender and race.
    lifting, fold
        Faces of the lifting database, and of the attacker's smallest fold.

    Raises
    ------
    AuditError
        They do not; for hybrid+, which lifts a face with none like it, on average.
    """
    unlike = _least_unlike(labels)
    for scheme in schemes:
        if scheme.decoys != POOLED:
            continue
        strategy = Strategy(scheme.strategy)
        plus = strategy is Strategy.HYBRID_PLUS
        for pool, faces, share in (
            ("the lifting database", lifting, unlike if plus else 1.0),
            ("a fold of the attacker's", fold, unlike if plus else 0.5),
        ):
            if (k := strategy.decoys(scheme.dim)) > share * faces:
                raise AuditError(
                    f"{strategy} lifting at m = {scheme.dim} takes {k} decoys, and {pool}, "
                    f"{faces} faces, gives {int(share * faces)}"
                    f"{' of another gender and race' if plus else ''}: give more faces, or ask for "
                    "smaller dimensions of the strategies with a pool"
                )


def _least_unlike(labels: Sequence[Label]) -> float:
    """Share of faces of another gender and race than a face has, where they are fewest."""
    both = Counter((label.gender, label.race) for label in labels)
    genders, races = (
        Counter(label.gender for label in labels),
        Counter(label.race for label in labels),
    )
    return min(
        1 - (genders[gender] + races[race] - count) / len(labels)
        for (gender, race), count in both.items()
    )


def schemes_of(
    *,
    dims: Sequence[int] = PAPER_DIMS,
    generated_dims: Sequence[int] = OUR_DIMS,
    axes: int | None = None,
) -> list[Scheme]:
    """Return the default grid: raw, the paper's strategies with a pool, ours with a generator.

    ``axes`` are those that ours is projected on; the paper's are not.

    hybrid+ needs labels of gender and race, and m ≥ 2 as hybrid does.
    """
    schemes = [RAW_SCHEME]
    for strategy in (
        Strategy.RANDOM,
        Strategy.ADVERSARIAL,
        Strategy.HYBRID,
        Strategy.HYBRID_PLUS,
    ):
        for m in dims:
            if strategy.decoys(m) or not strategy.needs_decoys:
                source = POOLED if strategy.needs_decoys else None
                schemes.append(Scheme(str(strategy), source, m))
    schemes += [Scheme(str(Strategy.ADVERSARIAL), GENERATED, m, axes) for m in generated_dims]
    return schemes
