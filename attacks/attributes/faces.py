"""Faces with labels, and how the paper's privacy experiment divides them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import AuditError
from templates.decoys.source import Attributes, DecoySource

Array32 = NDArray[np.float32]
Codes = NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class LabelledFaces:
    """Embeddings of faces, and the labels of every one.

    Parameters
    ----------
    embeddings : (N, n) float32
        Unit rows.
    labels
        By attribute: (N,) int64, the number of each face's class.
    classes
        By attribute: the names of the classes, at least two.

    """

    embeddings: Array32
    labels: Mapping[str, Codes]
    classes: Mapping[str, tuple[str, ...]]

    def __len__(self) -> int:
        return len(self.embeddings)

    @property
    def n(self) -> int:
        """Dimension of the embeddings."""
        return int(self.embeddings.shape[1])

    @classmethod
    def of_names(
        cls,
        embeddings: Array32,
        labels: Mapping[str, Sequence[str]],
        classes: Mapping[str, Sequence[str]],
    ) -> "LabelledFaces":
        """Make codes of the names of labels, each of which is one of the attribute's classes."""
        codes: dict[str, Codes] = {}
        for attribute, names in labels.items():
            place = {name: i for i, name in enumerate(classes[attribute])}
            codes[attribute] = np.array([place[name] for name in names], dtype=np.int64)
        return cls(embeddings, codes, {name: tuple(of) for name, of in classes.items()})

    def take(self, indices: Codes) -> "LabelledFaces":
        """Return some of the faces, in the order of their positions."""
        labels = {name: codes[indices] for name, codes in self.labels.items()}
        return LabelledFaces(self.embeddings[indices], labels, self.classes)

    def along(self, source: DecoySource) -> "LabelledFaces":
        """Take the embeddings to the coordinates that templates have."""
        return LabelledFaces(source.project(self.embeddings), self.labels, self.classes)

    def decoy_attributes(self) -> list[Attributes]:
        """Gender and race of every face, as hybrid+ needs them."""
        genders, races = (
            [self.classes[name][code] for code in self.labels[name].tolist()]
            for name in ("gender", "race")
        )
        return [Attributes(gender, race) for gender, race in zip(genders, races, strict=True)]


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
    """Deal out the parts at random, as in paper §4.3.

    Parameters
    ----------
    train
        ``lifting`` of these become the lifting database (the paper: 10,000), and ``attack`` others
        the attacker's.
    attacked_most
        Most validation faces that are attacked; None for all.

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
