"""What is to be evaluated, and the units of work that it takes."""

from collections.abc import Sequence
from dataclasses import dataclass

from templates.contract.binding import MAX_M
from templates.decoys import DecoyPool
from templates.distances import DEFAULT_STEPS, Metric
from templates.errors import VeilfaceError
from templates.space.lifting import Strategy
from verify.evaluation.material import Source
from verify.evaluation.units import RAW, RAW_FLIP, LiftUnit, Mode, RawUnit, Unit

STRATEGIES = (RAW, RAW_FLIP, *(strategy.value for strategy in Strategy))
WITHOUT_DECOYS = (
    RAW,
    RAW_FLIP,
    *(strategy.value for strategy in Strategy if not strategy.needs_decoys),
)
DIMS = (2, 4, 8, 16)
TARGETS = (1e-2, 1e-3, 1e-4)


class EvaluationError(VeilfaceError):
    """What was asked for cannot be evaluated."""


@dataclass(frozen=True)
class EvaluationPlan:
    """What is to be evaluated.

    Parameters
    ----------
    strategies
        Of ``STRATEGIES``.
    modes, metrics
        Of lifted comparisons.
    shared_decoys
        Whether both sides of subspace-to-subspace comparisons draw from the whole pool.
    repeats, seed
        Everything random is repeated with the seeds ``seed … seed + repeats − 1``.
    device
        Of torch, for subspace-to-subspace distances; None for the processor.

    Raises
    ------
    EvaluationError
        A name, a dimension or a target that there is not; or nothing to evaluate.
    """

    strategies: tuple[str, ...]
    dims: tuple[int, ...] = DIMS
    modes: tuple[Mode, ...] = (Mode.POINT, Mode.SUBSPACE)
    metrics: tuple[Metric, ...] = (Metric.EUCLIDEAN, Metric.SPHERICAL)
    shared_decoys: bool = False
    repeats: int = 5
    seed: int = 0
    targets: tuple[float, ...] = TARGETS
    steps: int = DEFAULT_STEPS
    device: str | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.strategies if name not in STRATEGIES]
        if unknown or not self.strategies:
            raise EvaluationError(
                f"unknown strategy {', '.join(unknown) or '(none)'}: choose of "
                f"{', '.join(STRATEGIES)}"
            )
        for name, values in (
            ("strategy", self.strategies),
            ("dimension", self.dims),
            ("mode", self.modes),
            ("metric", self.metrics),
            ("FMR target", self.targets),
        ):
            if len(set(values)) != len(values):
                raise EvaluationError(f"a {name} is named twice")
        if not all(0 < target < 1 for target in self.targets):
            raise EvaluationError("FMR targets lie between 0 and 1, such as 1e-2")
        if self.repeats < 1:
            raise EvaluationError("at least one repeat is needed")


def default_strategies(sources: Sequence[Source], *, raw_flip: bool) -> tuple[str, ...]:
    """All strategies that the decoys allow but the sub- ones."""
    able = set(WITHOUT_DECOYS) - (set() if raw_flip else {RAW_FLIP})
    if sources:
        able |= {Strategy.ADVERSARIAL, Strategy.HYBRID}
    if any(isinstance(source, DecoyPool) and source.labelled for source in sources):
        able |= {Strategy.HYBRID_PLUS}
    return tuple(name for name in STRATEGIES if name in able)


def units_of(plan: EvaluationPlan, sources: Sequence[Source], *, n: int) -> list[Unit]:
    """List the units of work, long ones first.

    Raises
    ------
    EvaluationError
        A strategy lacks the decoys that it needs, or a dimension does not fit.
    """
    seeds = range(plan.seed, plan.seed + plan.repeats)
    units: list[Unit] = []
    for name in plan.strategies:
        if name in (RAW, RAW_FLIP):
            units.append(RawUnit(flip=name == RAW_FLIP))
        else:
            strategy = Strategy(name)
            _check_dims(strategy, plan.dims, n)
            places = _fitting(strategy, sources, plan)
            for place in places:
                _check_dims(strategy, plan.dims, n if place is None else sources[place].k)
            units += [
                LiftUnit(
                    strategy=strategy,
                    m=m,
                    source=source,
                    shared=plan.shared_decoys,
                    modes=plan.modes,
                    metrics=plan.metrics,
                    steps=plan.steps,
                    device=plan.device,
                    seed=seed,
                )
                for source in places
                for m in plan.dims
                for seed in seeds
            ]
    # A long unit that starts last would leave the other processes idle.
    return sorted(units, key=lambda unit: -unit.m if isinstance(unit, LiftUnit) else 0)


def _check_dims(strategy: Strategy, dims: Sequence[int], n: int) -> None:
    least = 2 if strategy.needs_decoys and strategy.decoys(1) == 0 else 1
    most = min(n - 1, MAX_M)
    wrong = [m for m in dims if not least <= m <= most]
    if wrong or not dims:
        raise EvaluationError(
            f"{strategy} takes dimensions from {least} to {most}, not "
            f"{', '.join(map(str, wrong)) or 'none'}"
        )


def _fitting(
    strategy: Strategy, sources: Sequence[Source], plan: EvaluationPlan
) -> list[int | None]:
    """Positions of the sources that the strategy can draw from."""
    if not strategy.needs_decoys:
        return [None]
    pools_only = strategy is Strategy.HYBRID_PLUS or strategy.sub_databases is not None
    places: list[int | None] = [
        place
        for place, source in enumerate(sources)
        if (
            isinstance(source, DecoyPool)
            and (source.labelled or strategy is not Strategy.HYBRID_PLUS)
        )
        or not (pools_only or isinstance(source, DecoyPool))
    ]
    if not places:
        what = (
            "a pool with gender and race labels"
            if strategy is Strategy.HYBRID_PLUS
            else "a pool"
            if pools_only
            else "decoys"
        )
        raise EvaluationError(
            f"{strategy} lifting needs {what}: make one with `veilface decoys build`, or "
            "leave the strategy out"
        )
    for place in places:
        if place is not None:
            _check_size(strategy, sources[place], plan)
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
