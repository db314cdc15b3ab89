"""Lifting with a note of which decoys were drawn: the truth that an attack is held against."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import Scheme
from attacks.system import System
from templates.decoys import Attributes, DecoySource
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy
from templates.space.subspace import SubspaceBatch


class RecordingSource:
    """A decoy source that remembers its last draw, and may perturb what it hands out.

    Parameters
    ----------
    noise
        Length of the random vector that is added to every decoy, which has length 1, before it is
        normalised again; what is remembered is the decoy without it.
    """

    def __init__(self, inner: DecoySource, *, noise: float = 0.0) -> None:
        self.source_id: str = inner.source_id
        self.n: int = inner.n
        self.made_with: str | None = inner.made_with
        self.noise = inner.noise
        self._inner = inner
        self._noise = noise
        self.last: NDArray[np.float32] = np.empty((0, 0, inner.n), dtype=np.float32)

    def draw(
        self,
        rows: int,
        k: int,
        *,
        stream: Keystream,
        unlike: Sequence[Attributes] | None = None,
        sub_databases: int | None = None,
    ) -> NDArray[np.float32]:
        """Draw as the inner source does; see ``DecoySource.draw``."""
        self.last = self._inner.draw(
            rows, k, stream=stream, unlike=unlike, sub_databases=sub_databases
        )
        if not self._noise:
            return self.last
        shift = stream.normal(self.last.shape)
        moved = self.last + self._noise * shift / np.linalg.norm(shift, axis=2, keepdims=True)
        return np.asarray(moved / np.linalg.norm(moved, axis=2, keepdims=True), dtype=np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class RecordedLift:
    """Templates of N descriptors, and the decoys in them.

    Parameters
    ----------
    templates : SubspaceBatch of N
        As the service stores them, through the wire format.
    decoys : (N, k, n) float32
        As they were drawn, before any perturbation.
    """

    templates: SubspaceBatch
    decoys: NDArray[np.float32]


def recorded_lift(
    system: System,
    descriptors: NDArray[np.float32],
    purpose: str,
    *,
    source: DecoySource | None = None,
    noise: float = 0.0,
) -> RecordedLift:
    """Lift (N, n) descriptors as the system's service does, and record the decoys.

    One descriptor at a time: lifting draws again where a decoy comes twice, and only then is the
    last draw the one that was used.

    Parameters
    ----------
    source
        Instead of the system's.
    """
    recording = RecordingSource(source or system.lifter.source, noise=noise)
    lifter = replace(system.lifter, source=recording)
    feet = np.empty_like(descriptors)
    bases = np.empty((len(descriptors), system.scheme.dim, recording.n), dtype=np.float32)
    decoys = np.empty((len(descriptors), decoy_count(system.scheme), recording.n), dtype=np.float32)
    with Keystream.seeded("audit", system.seed, str(system.scheme), purpose) as stream:
        for row in range(len(descriptors)):
            one = slice(row, row + 1)
            lifted = lifter.lift(descriptors[one], m=system.scheme.dim, stream=stream)
            feet[one], bases[one] = lifted.feet, lifted.bases
            if decoys.shape[1]:
                decoys[one] = recording.last
    return RecordedLift(SubspaceBatch(feet, bases), decoys)


def decoy_count(scheme: Scheme) -> int:
    """Number of decoys in one template."""
    return Strategy(scheme.strategy).decoys(scheme.dim)
