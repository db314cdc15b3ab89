"""What lifting asks of a decoy source, whichever kind it is."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.errors import DecoyError
from templates.keys.randomness import Keystream

MAX_DIMENSION = 4096
"""Largest descriptor dimension a source may have; the same bound as the wire format's."""
_SHA256_HEX = re.compile(r"[0-9a-f]{64}")


def checked_made_with(value: object) -> str | None:
    """Return a valid ``made_with`` or None; refuse anything else."""
    if value is None or (isinstance(value, str) and _SHA256_HEX.fullmatch(value)):
        return value
    raise DecoyError("made_with must be 64 lower-case hexadecimal digits, or absent")


@dataclass(frozen=True)
class Attributes:
    """Labels of a person or of a pool entry, as FairFace names them.

    Attributes
    ----------
    gender, race
        The label, or None where it is not known or must not matter.
    """

    gender: str | None = None
    race: str | None = None


@runtime_checkable
class DecoySource(Protocol):
    """Where the decoys of a template come from.

    Attributes
    ----------
    source_id
        SHA-256, in hex, of the canonical content. Part of the contract.
    n
        Numbers of an embedding.
    k
        Axes of faces that embeddings are projected on: numbers of what is lifted, and of a decoy.
        Of a pool, n.
    made_with
        `templates.contract.binding.embedding_id` of the pack whose descriptors the source was made
        of; None where the maker did not say. Part of the canonical content.
    """

    source_id: str
    n: int
    k: int
    made_with: str | None

    def reduced(self, k: int) -> Self:
        """Return the source of the leading ``k`` axes."""
        ...

    def project(self, descriptors: ArrayLike) -> NDArray[np.float32]:
        """Take embeddings, unit rows (N, n), to the coordinates that templates have, (N, k)."""
        ...

    def draw(
        self,
        rows: int,
        k: int,
        *,
        stream: Keystream,
        unlike: Sequence[Attributes] | None = None,
        sub_databases: int | None = None,
    ) -> NDArray[np.float32]:
        """Draw ``k`` decoys for each of ``rows`` templates, from a stream.

        With ``unlike``, one entry per row, that row's decoys differ from it in gender and in race
        (hybrid+). With ``sub_databases`` S all decoys of a row come from one of S disjoint parts,
        chosen at random.

        Returns
        -------
        float32, shape (rows, k, number of axes)
            Unit rows, C-contiguous; no decoy twice inside one row.
        """
        ...
