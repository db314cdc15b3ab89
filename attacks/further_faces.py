"""Faces that an attacker brings beside those of the audited set, without the victims' own."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.contract.canonical import Json

SAME_PHOTO = 0.999
"""Cosine from which two embeddings are of one photo."""
_TILE = 4096


@dataclass(frozen=True, eq=False, repr=False)
class FurtherFaces:
    """Descriptors of one source.

    Parameters
    ----------
    name
        Of the folder or file that they are from.
    embeddings : (A, n) float32
        Unit rows.
    people
        A names; the empty name where it is not known who is shown.
    left_out
        How many more there were that show a victim.
    """

    name: str
    embeddings: NDArray[np.float32]
    people: tuple[str, ...]
    left_out: int = 0

    def to_json(self) -> dict[str, Json]:
        """Return an entry of ``further_attacker_faces`` of the report's settings."""
        return {"name": self.name, "faces": len(self.embeddings), "left_out": self.left_out}


def strangers_among(
    further: FurtherFaces,
    embeddings: NDArray[np.float32],
    identities: Sequence[str],
    attacked: Collection[str],
) -> FurtherFaces:
    """Leave out the photos of victims, and those of people who are named like them.

    Parameters
    ----------
    embeddings, identities : (N, n) float32, N names
        The audited set.
    attacked
        Names of the victims, all of whose photos are compared.

    Raises
    ------
    AuditError
        Embeddings of another dimension.
    """
    if further.embeddings.shape[1] != embeddings.shape[1]:
        raise AuditError(
            f"{further.name} has embeddings of {further.embeddings.shape[1]} numbers, and the "
            f"audited pack's have {embeddings.shape[1]}: embed it with the same pack"
        )
    names = np.asarray(identities, dtype=np.str_)
    photos = embeddings[np.isin(names, list(attacked))]
    stranger = np.array([name not in attacked for name in further.people], dtype=np.bool_)
    for start in range(0, len(stranger), _TILE):
        rows = slice(start, start + _TILE)
        nearest = (further.embeddings[rows] @ photos.T).max(axis=1, initial=-1.0)
        stranger[rows] &= nearest < SAME_PHOTO
    return replace(
        further,
        embeddings=further.embeddings[stranger],
        people=tuple(np.asarray(further.people, dtype=np.str_)[stranger].tolist()),
        left_out=int(np.count_nonzero(~stranger)),
    )
