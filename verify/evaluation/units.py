"""What is compared with what: the configurations of an evaluation, and its units of work."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from templates.distances import Metric
from templates.space.lifting import Strategy

RAW = "raw"
RAW_FLIP = "raw+flip"

Search = Literal["exact", "grid"]
Lifted = Literal["first", "second", "both"]
DecoyKind = Literal["pool", "generator"]


class Mode(StrEnum):
    """Which sides of a comparison are lifted."""

    RAW = "p2p"
    """Neither: point to point."""
    POINT = "p2s"
    """One: point to subspace."""
    SUBSPACE = "s2s"
    """Both: subspace to subspace."""


@dataclass(frozen=True)
class Cell:
    """One configuration, as a row of the results names it.

    Parameters
    ----------
    strategy
        A lifting strategy, ``raw`` or ``raw+flip``.
    decoys
        Kind of the decoy source; None without decoys.
    shared_decoys
        With a pool: whether both sides draw from all of it, or each from its own half.
    dim
        Dimension m of subspaces; 0 for raw descriptors.
    mode, metric
        How two sides are compared.
    """

    strategy: str
    decoys: DecoyKind | None
    shared_decoys: bool | None
    dim: int
    mode: Mode
    metric: str


@dataclass(frozen=True)
class RawUnit:
    """Raw descriptors, compared once: nothing is random."""

    flip: bool

    @property
    def seed(self) -> int | None:
        """None: no seed is used."""
        return None


@dataclass(frozen=True)
class LiftUnit:
    """One lifting of both sides of all pairs, compared in every mode and metric.

    Parameters
    ----------
    strategy, m
        As in :func:`templates.space.lifting.lift`.
    source
        Position of the decoy source among those of the evaluation; None for ``random``.
    shared
        Whether both sides draw from the whole pool, instead of each from its own half.
    modes, metrics, steps
        What is compared, and the steps of the spherical iteration.
    device
        Of torch, for subspace-to-subspace distances; None for the processor.
    """

    strategy: Strategy
    m: int
    source: int | None
    shared: bool
    modes: tuple[Mode, ...]
    metrics: tuple[Metric, ...]
    steps: int
    seed: int
    device: str | None = None


Unit = RawUnit | LiftUnit
