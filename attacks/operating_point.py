"""The axes and the dimension of templates: of the pairs that are private, the cheapest.

They are chosen on one half of the victims and judged on the other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from attacks.bed import LEAST_FACES, LEAST_VICTIMS, Pairs, Testbed
from attacks.recovery import Recovery, recoveries
from attacks.setup import AttackSetup
from attacks.stored.foot_point import foot_point
from attacks.stored.second_moments import second_moments
from templates.contract.binding import MAX_M
from templates.contract.canonical import Json
from templates.contract.document import Contract
from templates.contract.levels import GroupRates, Level, Rate
from templates.contract.nobody import Nobody
from templates.contract.verdict import Judgement, upper_bound
from templates.decoys import DecoyGenerator, DecoySource, client_source
from templates.distances import Metric, pairwise_distances, similarity
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.lifting import Strategy, lift, plain_strategy
from verify.evaluation.groups import least_of_highest
from verify.metrics import rate, threshold_at_fmr

SHARES_OF_VARIANCE = (0.76, 0.83, 0.90)
"""Of the decoys' variance on the leading axes that are tried."""
FEW_AXES = 256
"""Embeddings of no more numbers are tried whole too: they have no idle axes."""
RATIOS = (0.28, 0.41, 0.54)
"""Dimensions that are measured, as shares of the axes; theft between them is interpolated."""
MOST_BYTES = 60_000
"""Of a stored template, in half precision."""
_HEADER = 400
"""Most bytes of a template beside its numbers."""
STEP = 4
"""Between dimensions that may be chosen."""
AIM = 0.04
"""Theft to aim at when choosing: below the limit, because other people are judged by it, and the
standard error of such a share of 300 people is 1.1 %."""
PRIVACY_LIMIT = 0.05
"""Most templates, as a share, that may give the strongest attacker a match for a fresh photo."""
PRIVACY_BOUND = 0.10
"""Most that the one-sided 95 % upper bound of that share may be."""
MOST_PROBES = 600
PRICED_AT = 1e-3
"""FMR at which the price in accuracy is estimated."""
ACCURACY_LIMIT = 0.02
"""Largest false rejection rate of the default level, with the advised photos."""
LEAST_PROBES = 150
"""Genuine probes below which even none rejected does not show that limit (the rule of three)."""
GROUP_LIMIT = 2.0
"""Most that the FMR within a group of people may be, in multiples of the level's target."""
LAXEST_JUDGED = 1e-3
"""Largest target FMR of a default level at which accuracy is judged."""
ADVISED_PHOTOS = 3
"""Photos to enroll, and photos of a probe, that are advised: a camera takes them with one click."""

Advance: TypeAlias = Callable[[float], None]


@dataclass(frozen=True)
class Tried:
    """A pair of axes and dimension that was considered."""

    axes: int
    m: int
    theft: float  # share of templates that the strongest attacker is expected to open
    # Single genuine photos that are rejected at FMR 1e-3, by a quick estimate; None where that was
    # not estimated: the pair is not private, or nobody has two photos.
    rejected: Rate | None = None

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "axes": self.axes,
            "m": self.m,
            "predicted_theft": round(self.theft, 4),
            "rejected": None if self.rejected is None else self.rejected.to_json(),
        }


@dataclass(frozen=True)
class OperatingPoint:
    """The pair of axes and dimension, why it was chosen, and how private it is."""

    axes: int  # k
    dim: int  # m
    chosen: str  # why these: a few words
    tried: tuple[Tried, ...]  # what was considered, each with what it would cost
    privacy: Judgement  # of people who had no part in the choice


def choose_and_judge(
    setup: AttackSetup,
    *,
    strategy: Strategy,
    axes: int | None = None,
    m: int | None = None,
    uncovered: str | None = None,
    progress: Advance = lambda _share: None,
) -> OperatingPoint:
    """Choose axes and dimension on one half of the victims, and judge them on the other.

    ``axes`` and ``m`` are what is not to be chosen; with both, all victims are judged. For
    ``uncovered`` see :func:`judge_privacy`; ``progress`` gets the share that is done.
    """
    if axes is not None and m is not None:
        chosen, judged = "asked for", setup
        tried: tuple[Tried, ...] = ()
    else:
        choosing, judged = setup.halves()
        if not len(choosing.victims):
            choosing, judged = setup, setup
            uncovered = uncovered or (
                f"{len(setup.victims)} people are too few to choose by some of them and judge by "
                f"{LEAST_VICTIMS} others"
            )
        axes, m, chosen, tried = choose(
            choosing, strategy=strategy, axes=axes, m=m, progress=lambda one: progress(0.8 * one)
        )
    thefts = thieves(judged.bed(strategy, axes=axes, m=m))
    progress(1.0)
    judgement = judge_privacy(thefts, axes=axes, m=m, uncovered=uncovered)
    return OperatingPoint(axes, m, chosen, tried, judgement)


def thieves(bed: Testbed) -> list[Recovery]:
    """What every attacker of the verdict gets: from the victims, and without limit, from drawn."""
    return [*recoveries(foot_point, bed), *recoveries(second_moments, bed)]


def choose(
    setup: AttackSetup,
    *,
    strategy: Strategy,
    axes: int | None = None,
    m: int | None = None,
    progress: Advance = lambda _share: None,
) -> tuple[int, int, str, tuple[Tried, ...]]:
    """Choose, of the pairs that are private, the one that rejects the fewest genuine probes.

    Theft is measured on the victims and on drawn people, and the larger counts. Where nobody has
    two photos, the smallest share of directions in the axes is taken instead: at equal shares
    about as many are rejected. Returns k, m, why, and what was tried.
    """
    grid = axes_to_try(setup.source) if axes is None else (axes,)
    grid = tuple(k for k in grid if m is None or m < k) or (setup.source.k,)
    curves = []
    for number, k in enumerate(grid):
        dims = dims_to_try(k) if m is None else (m,)
        curves.append((k, dims, _predicted(setup, strategy, k, dims)))
        progress((number + 1) / (len(grid) + 1))
    private = []
    tried: list[Tried] = []
    for k, dims, predicted in curves:
        passing = [dim for dim in _between(dims) if predicted(dim) <= AIM]
        if passing:
            dim = passing[0]
            rejected = _rejected(setup, strategy, k, dim)
            private.append(Tried(k, dim, predicted(dim), rejected))
        tried += [Tried(k, dim, predicted(dim)) for dim in dims]
    if not private:
        least = min(tried, key=lambda one: one.theft)
        return least.axes, least.m, "the least theft, as nothing is private", tuple(tried)
    best = min(private, key=_price)
    why = "fewest probes rejected" if best.rejected is not None else "smallest share of directions"
    measured = {_place(one) for one in private}
    tried = [one for one in tried if _place(one) not in measured] + private
    return best.axes, best.m, f"{why} of what is private", tuple(sorted(tried, key=_place))


def axes_to_try(source: DecoySource) -> tuple[int, ...]:
    """Numbers of axes in rising order; of a pool all."""
    if not isinstance(source, DecoyGenerator):
        return (source.k,)
    grid = {_rounded(source.axes_for(share)) for share in SHARES_OF_VARIANCE}
    grid = {min(axes, source.k) for axes in grid}
    return tuple(sorted(grid | ({source.k} if source.k <= FEW_AXES else set())))


def dims_to_try(axes: int) -> tuple[int, ...]:
    """Dimensions in rising order that theft is measured at."""
    most = min(axes - 1, (MOST_BYTES - _HEADER) // (2 * axes) - 1, MAX_M)
    return tuple(sorted({max(1, min(most, _rounded(ratio * axes))) for ratio in RATIOS}))


def judge_privacy(
    thefts: Sequence[Recovery], *, axes: int, m: int, uncovered: str | None = None
) -> Judgement:
    """Hold what the strongest of :func:`thieves` gets, and its upper bound, against the limits.

    ``uncovered`` is what an attacker of such templates has and none of these had, in a sentence.
    """
    strongest = max(thefts, key=_strength).to_json()
    faces = max(theft.faces or 0 for theft in thefts)
    victims = min(theft.matched.trials for theft in thefts if theft.faces is not None)
    shortfall = uncovered
    if shortfall is None and (faces < LEAST_FACES or victims < LEAST_VICTIMS):
        shortfall = (
            f"{victims} people attacked with {faces} faces show little: calibrate on so many that "
            f"{LEAST_VICTIMS} are attacked with {LEAST_FACES:,} faces of the others"
        )
    unlimited = isinstance(strongest["faces"], str)
    return Judgement(
        max(thefts, key=_strength).matched,
        PRIVACY_LIMIT,
        {
            "axes": axes,
            "m": m,
            "attack": strongest["attack"],
            "attacker_faces": "unlimited" if unlimited else strongest["faces"],
            "counted": strongest["counted"],
            "victims": victims,
            "attacks": [theft.to_json() for theft in thefts],
        },
        shortfall,
        PRIVACY_BOUND,
    )


def _strength(theft: Recovery) -> tuple[bool, float, float]:
    """A share above the limit counts before a bound, and a bound before a share."""
    rate = theft.matched
    return rate.value > PRIVACY_LIMIT, upper_bound(rate.errors, rate.trials), rate.value


def _predicted(
    setup: AttackSetup, strategy: Strategy, axes: int, dims: Sequence[int]
) -> Callable[[int], float]:
    """Measure theft at some dimensions, and lay a curve through it.

    The logit of the share that the strongest attacker opens is taken for a line in m. Each point
    weighs by the inverse of its variance.
    """
    bed = setup.bed(strategy, axes=axes, m=dims[0], quick=True)
    by_dim = [thieves(bed), *(thieves(bed.at(m)) for m in dims[1:])]
    lines = []
    for drawn in (False, True):
        rates = [[one.matched for one in made if (one.faces is None) == drawn] for made in by_dim]
        if rates[0]:
            best = [max(one.errors for one in of_dim) for of_dim in rates]
            lines.append(_line(best, rates[0][0].trials, dims))
    return lambda m: max(float(1 / (1 + np.exp(-line[0] - line[1] * m))) for line in lines)


def _line(best: Sequence[int], trials: int, dims: Sequence[int]) -> tuple[float, float]:
    shares = (np.array(best) + 0.5) / (trials + 1)
    logits = np.log(shares / (1 - shares))
    if len(dims) == 1:
        return float(logits[0]), 0.0
    weights = shares * (1 - shares)
    slope, start = np.polyfit(dims, logits, 1, w=np.sqrt(weights))
    if slope > 0:  # theft does not rise with m: what rises is noise
        return float(np.average(logits, weights=weights)), 0.0
    return float(start), float(slope)


def _rejected(setup: AttackSetup, strategy: Strategy, axes: int, m: int) -> Rate | None:
    """Estimate how many single photos are rejected at FMR 1e-3; None where nobody has two."""
    people = Pairs(
        np.concatenate([setup.victims.enrolled, setup.mates.enrolled])[:MOST_PROBES],
        np.concatenate([setup.victims.fresh, setup.mates.fresh])[:MOST_PROBES],
    )
    if len(people) < 2 or np.allclose(people.enrolled, people.fresh, atol=1e-5):
        return None
    source = setup.source.reduced(axes)
    pairs = people.along(source)
    plain = plain_strategy(strategy)
    stream = Keystream.seeded("price", setup.seed, axes, m)
    templates = lift(pairs.enrolled, strategy=plain, m=m, source=source, stream=stream)
    nobody = Nobody(client_source(source), plain, m, bytes(KEY_BYTES))
    means, spreads = nobody.statistics(pairs.fresh, Metric.SPHERICAL)
    close = similarity(pairwise_distances(pairs.fresh, templates, metric=Metric.SPHERICAL))
    scores = (close - means[:, None]) / spreads[:, None]
    same = np.eye(len(pairs), dtype=np.bool_)
    threshold = threshold_at_fmr(scores[~same], PRICED_AT)
    return rate(int(np.count_nonzero(scores[same] < threshold)), len(pairs))


def _between(dims: Sequence[int]) -> list[int]:
    """All dimensions from the first to the last that may be chosen."""
    return sorted({*range(dims[0], dims[-1] + 1, STEP), *dims})


def _price(one: Tried) -> tuple[float, float, int]:
    return (one.m / one.axes if one.rejected is None else one.rejected.value, one.theft, -one.axes)


def _place(one: Tried) -> tuple[int, int]:
    return one.axes, one.m


def _rounded(number: float) -> int:
    return max(STEP, STEP * round(number / STEP))


def judge_accuracy(contract: Contract, *, photos: int, not_acquired: int) -> Judgement:
    """Hold the FRR of the default level, with the advised photos, against its limit.

    It counts the probes that are refused because their photos do not agree. Photos without a usable
    face are no probes: a folder's tell nothing of a camera's. The verdict says how many there were
    (``not_acquired``) among the ``photos`` of the calibration.
    """
    name = contract.default_level
    calibration = contract.calibration("p2s", probe_photos=ADVISED_PHOTOS, level=name)
    level = calibration.level(name)
    shortfall = None
    if level.target_fmr is None or level.target_fmr > LAXEST_JUDGED:
        shortfall = f"so few people resolve no level stricter than {name}"
    enrolled, rate = rejected_as_advised(level)
    if shortfall is None and rate.value <= ACCURACY_LIMIT and rate.trials < LEAST_PROBES:
        shortfall = f"{rate.trials} genuine probes are too few to show so low a rate"
    return Judgement(
        rate,
        ACCURACY_LIMIT,
        {
            "level": name,
            "enrolled_photos": enrolled,
            "probe_photos": calibration.probe_photos,
            "photos": photos,
            "photos_not_acquired": not_acquired,
        },
        shortfall,
    )


def rejected_as_advised(level: Level) -> tuple[int | None, Rate]:
    """Return the FRR of templates of the advised number of photos, or the next below it.

    The number of photos comes first; None where the level counts all templates together.
    """
    rates = level.frr_by_photos or level.fnmr_by_photos
    enrolled = max((p for p in rates if p <= ADVISED_PHOTOS), default=min(rates, default=None))
    return enrolled, level.fnmr if enrolled is None else rates[enrolled]


def judge_groups(contract: Contract) -> Judgement | None:
    """Hold the FMR within the worst group of people, at the default level, against its limit.

    The highest over raw probes of every number of photos, in groups with trials enough to judge;
    None where there is none: nobody was labelled, or all groups are small. A rate above the limit
    shows nothing where the highest of so many groups may be as high by chance.
    """
    name = contract.default_level
    judged = [
        (group, level.target_fmr, calibration)
        for calibration in contract.calibrations
        for level in calibration.levels
        if level.name == name and level.target_fmr is not None
        for group in level.groups
        if group.fmr_judged
    ]
    if not judged:
        return None
    # One that is shown to be above comes first; of equal rates the one with more trials.
    groups = len({(one.attribute, one.group) for one, _, _ in judged})

    def shown_above(group: GroupRates, target: float) -> bool:
        least = least_of_highest(group.fmr.errors, group.fmr.trials, groups=groups)
        return least > GROUP_LIMIT * target

    worst, target, calibration = max(
        judged,
        key=lambda one: (shown_above(one[0], one[1]), one[0].fmr.value, one[0].fmr.trials),
    )
    limit, highest = GROUP_LIMIT * target, worst.fmr
    shortfall = None
    if highest.value > limit and not shown_above(worst, target):
        shortfall = f"the highest of {groups} groups may be above the limit by chance"
    return Judgement(
        highest,
        limit,
        {
            "level": name,
            "attribute": worst.attribute,
            "group": worst.group,
            "probe_photos": calibration.probe_photos,
            "groups": groups,
            "groups_from": calibration.calibrated_on.get("groups_from"),
        },
        shortfall,
    )
