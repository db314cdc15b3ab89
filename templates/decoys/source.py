"""What lifting asks of a decoy source, whichever kind it is."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from templates.errors import DecoyError
from templates.keys.randomness import Keystream

MAX_DIMENSION = 4096
"""Largest descriptor dimension a source may have; the same bound as the wire format's."""
NOISE_ENERGY = 0.1
"""Energy of the noise that a deployment's decoys and descriptors get, beside that of a unit vector:
with less, the axes along which faces hardly differ give more faces away; with more, more people
are turned away (docs/decoys.md "Noise")."""
LARGEST_NOISE = 0.1
"""Variance of noise in one number; no unit vector of more than ten numbers is left of with more."""
_SHA256_HEX = re.compile(r"[0-9a-f]{64}")


def take_made_with(fields: dict[str, object]) -> str | None:
    """Take the ``made_with`` out of the fields of a file that may be hostile; None where absent.

    Raises
    ------
    DecoyError
        It is there, and is not 64 lower-case hexadecimal digits.
    """
    return checked_made_with(fields.pop("made_with")) if "made_with" in fields else None


def checked_noise(value: object) -> float:
    """Give back a variance of noise that is one, from a file that may be hostile.

    Raises
    ------
    DecoyError
        It is no number from 0 to ``LARGEST_NOISE``, or not written as Python writes it.
    """
    try:
        noise = float(value) if isinstance(value, str) else -1.0
    except ValueError:
        noise = -1.0
    if not 0 <= noise <= LARGEST_NOISE or repr(noise) != value:
        raise DecoyError(f"the noise of decoys must be a variance from 0 to {LARGEST_NOISE}")
    return noise


def checked_made_with(value: object) -> str:
    """Give back a ``made_with`` that is one.

    Raises
    ------
    DecoyError
        It is not 64 lower-case hexadecimal digits.
    """
    if not isinstance(value, str) or not _SHA256_HEX.fullmatch(value):
        raise DecoyError("made_with must be 64 lower-case hexadecimal digits, or absent")
    return value


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
        Dimension of the descriptors.
    made_with
        `templates.contract.binding.embedding_id` of the pack whose descriptors the source was made
        of; None where the maker did not say. Part of the canonical content.
    noise
        Variance, in each number, of the noise that decoys have and that lifting gives to the
        descriptor too; 0 for none. Part of the canonical content.
    """

    source_id: str
    n: int
    made_with: str | None
    noise: float

    def draw(
        self,
        rows: int,
        k: int,
        *,
        stream: Keystream,
        unlike: Sequence[Attributes] | None = None,
        sub_databases: int | None = None,
    ) -> NDArray[np.float32]:
        """Draw ``k`` decoys for each of ``rows`` templates.

        Parameters
        ----------
        rows, k
            Number of templates, and of decoys in each.
        stream
            The only source of randomness.
        unlike
            One entry per row: that row's decoys differ from it in gender and in race (hybrid+).
        sub_databases
            Number S of disjoint parts; all decoys of a row come from one part, chosen at random.

        Returns
        -------
        float32, shape (rows, k, n)
            Unit rows, C-contiguous; no decoy twice inside one row.

        Raises
        ------
        DecoyError
            The source cannot meet the request.
        """
        ...
