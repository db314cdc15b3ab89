"""What is to be evaluated, and the units of work that it takes."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from templates.contract.binding import MAX_M
from templates.decoys import DecoyGenerator, DecoyPool
from templates.distances import DEFAULT_STEPS, Metric
from templates.errors import VeilfaceError
from templates.space.lifting import Strategy

Json = dict[str, Any]
Source = DecoyPool | DecoyGenerator

RAW = "raw"
STRATEGIES = (RAW, *(strategy.value for strategy in Strategy))
DIMS = (2, 4, 8, 16)
TARGETS = (1e-2, 1e-3, 1e-4)


def decoy_kind(source: Source) -> str:
    """Name the kind of a source, as rows do."""
    return "pool" if isinstance(source, DecoyPool) else "generator"


class Mode(StrEnum):
    """Which sides of a comparison are lifted."""

    RAW = "p2p"
    """Neither: point to point."""
    POINT = "p2s"
    """One: point to subspace."""
    SUBSPACE = "s2s"
    """Both: subspace to subspace."""


class EvaluationError(VeilfaceError):
    """What was asked for cannot be evaluated."""


@dataclass(frozen=True)
class EvaluationPlan:
    """What is to be evaluated; everything random is repeated with the seeds from ``seed`` on."""

    strategies: tuple[str, ...]  # of STRATEGIES
    dims: tuple[int, ...] = DIMS
    modes: tuple[Mode, ...] = (Mode.POINT, Mode.SUBSPACE)  # of lifted comparisons, as metrics
    metrics: tuple[Metric, ...] = (Metric.EUCLIDEAN, Metric.SPHERICAL)
    shared_decoys: bool = False  # both sides draw from the whole pool, not each from its own half
    repeats: int = 5
    seed: int = 0
    targets: tuple[float, ...] = TARGETS
    steps: int = DEFAULT_STEPS  # of the spherical iteration

    def __post_init__(self) -> None:
        unknown = [name for name in self.strategies if name not in STRATEGIES]
        if unknown or not self.strategies:
            raise EvaluationError(
                f"unknown strategy {', '.join(unknown) or '(none)'}: choose of "
                f"{', '.join(STRATEGIES)}"
            )
        if not all(0 < target < 1 for target in self.targets):
            raise EvaluationError("FMR targets lie between 0 and 1, such as 1e-2")


@dataclass(frozen=True)
class Unit:
    """One lifting of both sides of all pairs, compared in every mode and metric of the plan."""

    strategy: str
    m: int = 0  # 0 for raw embeddings, which have no seed either
    source: int | None = None  # position among the decoy sources
    seed: int | None = None

    @property
    def raw(self) -> bool:
        """Whether embeddings are compared as they are."""
        return self.strategy == RAW


def default_strategies(sources: Sequence[Source]) -> tuple[str, ...]:
    """All strategies that the decoys allow but the sub- ones."""
    able = {RAW} | {strategy.value for strategy in Strategy if not strategy.needs_decoys}
    if sources:
        able |= {Strategy.ADVERSARIAL, Strategy.HYBRID}
    if any(isinstance(source, DecoyPool) and source.labelled for source in sources):
        able |= {Strategy.HYBRID_PLUS}
    return tuple(name for name in STRATEGIES if name in able)


def units_of(plan: EvaluationPlan, sources: Sequence[Source], *, n: int) -> list[Unit]:
    """List the units of work, long ones first."""
    units: list[Unit] = []
    for name in plan.strategies:
        if name == RAW:
            units.append(Unit(name))
            continue
        strategy = Strategy(name)
        _check_dims(strategy, plan.dims, n)
        for place in _fitting(strategy, sources):
            if place is not None:
                _check_dims(strategy, plan.dims, sources[place].k)
                _check_size(strategy, sources[place], plan)
            units += [
                Unit(name, m, place, seed)
                for m in plan.dims
                for seed in range(plan.seed, plan.seed + plan.repeats)
            ]
    # A long unit that starts last would leave the other workers idle.
    return sorted(units, key=lambda unit: -unit.m)


def _check_dims(strategy: Strategy, dims: Sequence[int], n: int) -> None:
    least = 2 if strategy.needs_decoys and strategy.decoys(1) == 0 else 1
    most = min(n - 1, MAX_M)
    wrong = [m for m in dims if not least <= m <= most]
    if wrong or not dims:
        raise EvaluationError(
            f"{strategy} takes dimensions from {least} to {most}, not "
            f"{', '.join(map(str, wrong)) or 'none'}"
        )


def _fitting(strategy: Strategy, sources: Sequence[Source]) -> list[int | None]:
    """Positions of the sources that the strategy can draw from."""
    if not strategy.needs_decoys:
        return [None]
    labelled = strategy is Strategy.HYBRID_PLUS
    pools_only = labelled or strategy.sub_databases is not None
    places: list[int | None] = [
        place
        for place, source in enumerate(sources)
        if (source.labelled or not labelled if isinstance(source, DecoyPool) else not pools_only)
    ]
    if not places:
        what = "a pool" if pools_only else "decoys"
        raise EvaluationError(
            f"{strategy} lifting needs {what}{' with gender and race labels' if labelled else ''}: "
            "make one with `veilface decoys build`, or leave the strategy out"
        )
    return places


def _check_size(strategy: Strategy, source: Source, plan: EvaluationPlan) -> None:
    if not isinstance(source, DecoyPool):
        return
    needed = strategy.decoys(max(plan.dims))
    parts = (1 if plan.shared_decoys else 2) * (strategy.sub_databases or 1)
    if len(source) // parts < needed:
        where = "the pool" if parts == 1 else f"one of {parts} parts of the pool"
        raise EvaluationError(
            f"{strategy} lifting with m = {max(plan.dims)} draws {needed} decoys, and {where} has "
            f"{len(source) // parts} entries: make a larger pool, take smaller dimensions"
            + ("" if plan.shared_decoys else ", or share the decoys")
        )
