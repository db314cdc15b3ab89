"""Faces with labels, and how the paper's privacy experiment divides them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.decoys.source import Attributes, DecoySource
from templates.space.embedding import unit_descriptors

Array32 = NDArray[np.float32]
Codes = NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class LabelledFaces:
    """Descriptors of faces, and the labels of every one.

    Parameters
    ----------
    descriptors : (N, n) float32
        Unit rows.
    labels
        By attribute: (N,) int64, the number of each face's class.
    classes
        By attribute: the names of the classes, at least two.

    Raises
    ------
    InvalidEmbedding
        A descriptor is not a finite unit vector.
    """

    descriptors: Array32
    labels: Mapping[str, Codes]
    classes: Mapping[str, tuple[str, ...]]

    def __post_init__(self) -> None:
        rows = np.ascontiguousarray(unit_descriptors(self.descriptors), dtype=np.float32)
        object.__setattr__(self, "descriptors", rows)

    def __len__(self) -> int:
        return len(self.descriptors)

    def __repr__(self) -> str:
        return f"LabelledFaces({len(self)} faces, n={self.n}, {', '.join(self.classes)})"

    @property
    def n(self) -> int:
        """Descriptor dimension."""
        return int(self.descriptors.shape[1])

    @property
    def attributes(self) -> tuple[str, ...]:
        """Names of the attributes."""
        return tuple(self.classes)

    @classmethod
    def of_names(
        cls,
        descriptors: Array32,
        labels: Mapping[str, Sequence[str]],
        classes: Mapping[str, Sequence[str]],
    ) -> "LabelledFaces":
        """Make codes of the names of labels.

        Raises
        ------
        AuditError
            A label is none of its classes.
        """
        codes: dict[str, Codes] = {}
        for attribute, names in labels.items():
            place = {name: i for i, name in enumerate(classes.get(attribute, ()))}
            unknown = sum(name not in place for name in names)
            if unknown:
                raise AuditError(
                    f"{unknown} of {len(names)} labels of {attribute} are no class of it"
                )
            codes[attribute] = np.array([place[name] for name in names], dtype=np.int64)
        return cls(descriptors, codes, {name: tuple(of) for name, of in classes.items()})

    def take(self, indices: NDArray[np.int64]) -> "LabelledFaces":
        """Return some of the faces, in the order of their positions."""
        labels = {name: codes[indices] for name, codes in self.labels.items()}
        return LabelledFaces(self.descriptors[indices], labels, self.classes)

    def along(self, source: DecoySource) -> "LabelledFaces":
        """Take the embeddings to the coordinates that templates have."""
        return LabelledFaces(source.project(self.descriptors), self.labels, self.classes)

    def names(self, attribute: str) -> list[str]:
        """Return the class of every face."""
        classes = self.classes[attribute]
        return [classes[code] for code in self.labels[attribute].tolist()]

    def decoy_attributes(self) -> list[Attributes]:
        """Gender and race of every face, as hybrid+ needs them; None where they have no label."""
        known = [
            self.names(name) if name in self.classes else [None] * len(self)
            for name in ("gender", "race")
        ]
        return [Attributes(gender, race) for gender, race in zip(*known, strict=True)]


@dataclass(frozen=True, eq=False)
class Split:
    """The faces of each part; the three have no face in common.

    Parameters
    ----------
    lifting
        The decoy pool W, a secret of the deployment; decoy generators are fitted to it too.
    attack
        The attacker's own faces, whose labels are known.
    attacked
        The faces whose templates are attacked; their labels are the truth.
    """

    lifting: LabelledFaces
    attack: LabelledFaces
    attacked: LabelledFaces

    def along(self, source: DecoySource) -> "Split":
        """Take all faces to the coordinates that templates have."""
        return Split(*(part.along(source) for part in (self.lifting, self.attack, self.attacked)))


def split(
    train: LabelledFaces,
    attacked: LabelledFaces,
    *,
    lifting: int,
    attack: int,
    attacked_most: int | None,
    seed: int,
) -> Split:
    """Deal out the parts as in paper §4.3.

    Parameters
    ----------
    train
        Labelled faces: ``lifting`` random ones become the lifting database (the paper: 10,000),
        ``attack`` others the attacker's (:func:`attacker_faces`).
    attacked_most
        Attack at most so many validation faces, chosen at random; None for all.

    Raises
    ------
    AuditError
        There is no face to attack.
    """
    if not len(attacked):
        raise AuditError("at least one face must be attacked")
    generator = np.random.default_rng([seed, 0])
    order = generator.permutation(len(train))
    victims = generator.permutation(len(attacked))[: attacked_most or len(attacked)]
    return Split(
        train.take(order[:lifting]),
        train.take(order[lifting : lifting + attack]),
        attacked.take(np.sort(victims)),
    )


def attacker_faces(training: int, *, lifting: int, attack: int | None) -> int:
    """Return how many of so many training faces are the attacker's: ``attack``, or all others.

    Raises
    ------
    AuditError
        There are too few training faces.
    """
    left = training - lifting
    wanted = left if attack is None else attack
    if lifting < 1 or wanted < 1 or wanted > left:
        raise AuditError(
            f"{lifting} lifting faces and {'the others' if attack is None else attack} for the "
            f"attacker cannot be taken from {training} training faces: both must be 1 or more; "
            "choose smaller sizes"
        )
    return wanted
