"""What an attribute audit runs: its settings, the schemes, and what all of them share."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.faces import LabelledFaces, Split
from attacks.attributes.features import MOST_NEIGHBOURS, Axes
from attacks.outcomes import GENERATED, POOLED, RAW_SCHEME, AuditError, Scheme
from attacks.second_order import Moments, decoy_moment, drawn_towards
from templates.decoys import DecoyGenerator, DecoyPool
from templates.decoys.source import DecoySource
from templates.space.lifting import Strategy

Codes = NDArray[np.int64]
Labels = Mapping[Path, Mapping[str, str]]
"""Gender, race and age by the path of a photo."""

PAPER_DIMS = (2, 4, 8, 16)
OUR_DIMS = (2, 4, 8, 16, 32, 64)
FOLDS = 4
"""Parts of the attacker's faces; a face is lifted with decoys of its own part, and judged by axes
and neighbours of the other parts."""
HELD_OUT = 0.2
"""Share of the lifted faces that the attacker chooses settings and attackers by."""
_MOST_LIFTS = 3


@dataclass(frozen=True, kw_only=True)
class AttributePlan:
    """What is inferred from the templates of which schemes, and how.

    Parameters
    ----------
    lifting
        Training faces that are the lifting database.
    attack, attacked
        Most training faces that the attacker has, and most validation faces that are attacked;
        None for all.
    axes
        That faces are projected on for generated decoys; None for all.
    training_most
        Most templates that the attacker lifts to train on. Each of its faces is lifted up to three
        times: labels are scarce, and lifting is free.
    gallery_most
        Trained attackers see the neighbours among at most so many random faces of the gallery, of
        their own templates and of the attacked ones alike. The paper's attacker searches all of the
        attacker's faces for an attacked template.
    """

    schemes: tuple[Scheme, ...]
    lifting: int
    attack: int | None = None
    attacked: int | None = None
    axes: int | None = None
    seed: int = 0
    training_most: int = 10_000
    gallery_most: int = 10_000

    def lifts_of(self, faces: int) -> int:
        """Times that each of so many own faces is lifted."""
        return min(max(self.training_most // max(faces, 1), 1), _MOST_LIFTS)

    def sample(self, train: Labels, validation: Labels) -> tuple[Labels, Labels]:
        """Choose the photos that take part, so that no others are embedded.

        A face costs a hundred times what an attack on it does.
        """
        most = None if self.attack is None else self.lifting + self.attack
        return _sample(train, most, self.seed), _sample(validation, self.attacked, self.seed)

    def attacker_faces(self, training: int) -> int:
        """Return how many of so many training faces are the attacker's, and refuse too few.

        Before anything is embedded, this refuses what would fail even if every photo had a face.

        Raises
        ------
        AuditError
            There are too few for the neighbours, for the decoys of a scheme with a pool, or to hold
            some of them out.
        """
        # Which photos give no embedding is not known beforehand.
        most = training - self.lifting
        faces = most if self.attack is None else min(self.attack, max(1, most))
        if min(self.lifting, faces) < 1 or faces > most:
            raise AuditError(
                f"{self.lifting} lifting faces and {self.attack or 'the others'} for the attacker "
                f"cannot be taken from {training} training faces: choose smaller sizes"
            )
        gallery = min(faces - -(-faces // FOLDS), self.gallery_most)
        if gallery < MOST_NEIGHBOURS:
            raise AuditError(
                f"the attacker's {faces} faces leave {gallery} in the gallery of a fold, and "
                f"{MOST_NEIGHBOURS} neighbours are searched for: give the attacker more faces"
            )
        own = min(faces, self.training_most) // FOLDS
        if not 0 < round(HELD_OUT * own) < own:
            raise AuditError(
                f"a fold of {own} faces is too small to hold some of them out: give the attacker "
                "more faces"
            )
        # The own faces of a fold are its pool. Where one of them is drawn for itself, all of its
        # decoys are drawn once more: of more than half of the pool that would hardly end.
        pool = min(self.lifting, faces // FOLDS // 2)
        for scheme in self.schemes:
            if scheme.decoys == POOLED and Strategy(scheme.strategy).decoys(scheme.dim) > pool:
                raise AuditError(
                    f"{scheme.strategy} lifting at m = {scheme.dim} takes more decoys than {pool}, "
                    "which these faces give: give more faces, or ask for smaller dimensions of the "
                    "strategies with a pool"
                )
        return faces


def _sample(labels: Labels, most: int | None, seed: int) -> Labels:
    """Choose at most so many photos at random; all where None."""
    if most is None or most >= len(labels):
        return labels
    photos = list(labels)
    chosen = np.random.default_rng([seed, 3]).permutation(len(photos))[:most]
    return {photos[index]: labels[photos[index]] for index in sorted(chosen.tolist())}


@dataclass(frozen=True, eq=False)
class Side:
    """What some faces are lifted with, and judged by.

    Parameters
    ----------
    entries, pool
        The faces that are decoys; and the same as a pool, labelled where they have gender and race.
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
        cls, entries: LabelledFaces, gallery: LabelledFaces, *, nearby: int, decoys: Moments | None
    ) -> "Side":
        """Make the pool, and find the axes and moments; ``decoys`` are the generator's."""
        pool = DecoyPool(entries.embeddings, labels=entries.decoy_attributes())
        faces = None
        if decoys is not None:
            faces = Moments.of(drawn_towards(gallery.embeddings, decoys.moment))
        near = gallery.take(np.arange(min(nearby, len(gallery))))
        return cls(entries, pool, gallery, near, Axes.fit(gallery), faces)


@dataclass(frozen=True, eq=False)
class Fold:
    """One part of the attacker's faces.

    Parameters
    ----------
    entries : (faces,) int64
        Their positions in the side's pool.
    held_out : (faces,) bool
        Those of them that the attacker chooses by, and does not learn from.
    side
        The faces of the part as a pool; the faces of all other parts as gallery.
    """

    own: LabelledFaces
    entries: Codes
    held_out: NDArray[np.bool_]
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
    side: Side
    generator: DecoyGenerator | None
    decoys: Moments | None
    folds: tuple[Fold, ...]

    def source(self, scheme: Scheme, side: Side) -> DecoySource | None:
        """Return where the decoys of a scheme come from on one side."""
        if scheme.decoys is None:
            return None
        return side.pool if scheme.decoys == POOLED else self.generator


def prepare(parts: Split, *, plan: AttributePlan, generator: DecoyGenerator | None = None) -> Setup:
    """Find what all schemes share; the generator is on the axes that the faces are projected on."""
    decoys = None if generator is None else Moments.of(decoy_moment(generator))
    side_of = partial(Side.of, nearby=plan.gallery_most, decoys=decoys)
    rng = np.random.default_rng([plan.seed, 1])
    order = rng.permutation(len(parts.attack))
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order)) % FOLDS
    chosen = np.zeros(len(order), dtype=np.bool_)
    chosen[order[: plan.training_most]] = True
    folds = []
    for fold in range(FOLDS):
        part = parts.attack.take(np.flatnonzero(number == fold))
        gallery = parts.attack.take(order[number[order] != fold])
        entries = np.flatnonzero(chosen[number == fold])
        own = part.take(entries)
        held_out = np.zeros(len(own), dtype=np.bool_)
        held_out[rng.permutation(len(own))[: round(HELD_OUT * len(own))]] = True
        folds.append(Fold(own, entries, held_out, side_of(part, gallery)))
    side = side_of(parts.lifting, parts.attack.take(order))
    return Setup(parts, plan, side, generator, decoys, tuple(folds))


def schemes_of(
    *,
    strategies: Iterable[str],
    dims: Sequence[int],
    generated_dims: Sequence[int],
    axes: int | None,
) -> tuple[Scheme, ...]:
    """Return raw embeddings, the paper's strategies with a pool, and ours with a generator.

    ``axes`` are those that ours is projected on; the paper's are not.
    """
    schemes = [RAW_SCHEME]
    for strategy in map(Strategy, strategies):
        source = POOLED if strategy.needs_decoys else None
        # Hybrid lifting takes a decoy from m = 2 on.
        schemes += [
            Scheme(str(strategy), source, m) for m in dims if strategy.decoys(m) or source is None
        ]
    ours = str(Strategy.ADVERSARIAL)
    return (*schemes, *(Scheme(ours, GENERATED, m, axes) for m in generated_dims))
