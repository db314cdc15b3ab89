"""Faces with labels, and how the paper's privacy experiment divides them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.decoys.source import Attributes
from templates.space.embedding import unit_descriptors
from verify.evaluation.attributes import resembling_rows

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
    AuditError
        Labels that do not fit the faces or the classes, or faces without attributes.
    InvalidEmbedding
        A descriptor is not a finite unit vector.
    """

    descriptors: Array32
    labels: Mapping[str, Codes]
    classes: Mapping[str, tuple[str, ...]]

    def __post_init__(self) -> None:
        rows = np.ascontiguousarray(unit_descriptors(self.descriptors), dtype=np.float32)
        object.__setattr__(self, "descriptors", rows)
        if not self.classes or set(self.labels) != set(self.classes):
            raise AuditError(
                f"faces need labels of the attributes that have classes: seen labels of "
                f"{sorted(self.labels)} and classes of {sorted(self.classes)}"
            )
        for attribute, names in self.classes.items():
            codes = np.asarray(self.labels[attribute])
            if len(names) < 2 or len(set(names)) != len(names):
                raise AuditError(f"{attribute} needs two or more classes of distinct names")
            if codes.shape != (len(rows),) or codes.dtype.kind not in "iu":
                raise AuditError(
                    f"expected a class number of {attribute} for each of {len(rows)} faces, seen "
                    f"{codes.dtype} of shape {codes.shape}"
                )
            if codes.size and not 0 <= codes.min() <= codes.max() < len(names):
                raise AuditError(f"{attribute} has class numbers outside 0 to {len(names) - 1}")

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


def split(
    train: LabelledFaces,
    attacked: LabelledFaces,
    *,
    lifting: int,
    attack: int | None = None,
    attacked_most: int | None = None,
    seed: int,
) -> Split:
    """Deal out the parts as in paper §4.3.

    Parameters
    ----------
    train
        Labelled faces: ``lifting`` random ones become the lifting database (the paper: 10,000),
        ``attack`` others the attacker's.
    attacked
        The validation faces.
    attack
        None for all the others, as in the paper.
    attacked_most
        Attack at most so many validation faces, chosen at random; None for all.
    seed
        Same seed, same parts.

    Raises
    ------
    AuditError
        There are too few faces, or the two sets do not fit each other.
    """
    if train.n != attacked.n or dict(train.classes) != dict(attacked.classes):
        raise AuditError(
            "the faces to train with and those to attack differ in the dimension of their "
            "embeddings or in their classes"
        )
    wanted = attacker_faces(len(train), lifting=lifting, attack=attack)
    if not len(attacked) or (attacked_most is not None and attacked_most < 1):
        raise AuditError("at least one face must be attacked")
    generator = np.random.default_rng([seed, 0])
    order = generator.permutation(len(train))
    victims = generator.permutation(len(attacked))[: attacked_most or len(attacked)]
    return Split(
        train.take(order[:lifting]),
        train.take(order[lifting : lifting + wanted]),
        attacked.take(np.sort(victims)),
    )


def attacker_faces(training: int, *, lifting: int, attack: int | None) -> int:
    """Return how many of so many training faces are the attacker's; see :func:`split`.

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


def near_duplicates(attacked: Array32, training: Array32, *, cosine: float) -> NDArray[np.int64]:
    """Find attacked faces of which the training faces show nearly the same photo.

    FairFace's two parts share such photos. An attacker who has the victim's own labelled face
    infers nothing: they are removed before the split.

    Parameters
    ----------
    attacked : (A, n) float32
    training : (T, n) float32
        Unit rows.
    cosine
        A pair of at least this cosine is one of near-duplicates.

    Returns
    -------
    int64
        Positions in ``attacked``, ascending.
    """
    return resembling_rows(attacked, training, cosine=cosine)
