"""Fits what is expected of a point's similarity to templates of nobody (docs/decision.md §1)."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from templates.contract.canonical import Json
from templates.contract.expectation import PointExpectation, point_features
from templates.contract.levels import Level
from templates.decoys import DecoySource
from templates.distances import DEFAULT_STEPS, Metric, pairwise_distances, similarity
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift_of_nobody
from templates.space.subspace import SubspaceBatch
from verify.mean_template import MeanTemplate, Templates
from verify.point_ascent import ascend_points

TEMPLATES = 1_000
"""Templates of nobody that probes are compared with. As many others give the mean projector and
foot point together with them (``verify.mean_template``)."""
CLIMBED = 300
"""Of those others, templates that wolves climb on: what is found on them is no measurement."""
CLIMBERS, CLIMBS = 24, 2
"""Probes that climb, and how often the expectation is fitted anew to where they end. Without, they
end where the fit is a tenth of a deviation too low (docs/decision.md §4). As many others climb when
all is fitted, and only tell how good the fit is."""
CLIMB_ROUNDS = 40
CLIMB_THRESHOLD = 2.7
"""Of the ascents; between what Gaussian scores pass at FMR 1e-2 and at 1e-3."""
CLIMB_WEIGHT = 9.0
"""Weight of the squared error at an end of an ascent, where that of a drawn probe has 1."""
PEOPLE, WOLVES, BETWEEN = 900, 500, 300
"""Probes of the fit: people, wolves, and mixtures of one of either."""
TESTED = 4
"""One probe in so many is not fitted, but tells how good the fit is."""
MOST_OFF = 0.1
"""Largest root mean square error of the mean, in deviations, for people; twice that for wolves.
docs/decision.md §1 has what it is on faces."""
MOST_SPREAD = 0.4
"""Largest root mean square relative error of the spread."""
AXES = 64
_TILE_BYTES = 32 * 2**20
_LIFTED, _COMPARED = 0.6, 0.8
"""Shares of the time that have passed once templates are lifted, and probes compared with them."""
_CUT = 1e-5
"""Of the largest singular value: smaller ones are left out. Where H is nearly a multiple of the
identity, as with random lifting, its forms hardly differ; on faces the smallest is 2e-4."""

Array64 = NDArray[np.float64]


@dataclass(frozen=True)
class Climbers:
    """How often templates of nobody accept probes that climbed and are in no fit.

    Parameters
    ----------
    accepted, most
        Share of the templates that accept, of all probes and of the one that most accept.
    fitted
        Whether where others climbed to is in the fit; where not, the form could not follow.
    """

    level: str
    accepted: float
    most: float
    probes: int
    templates: int
    fitted: bool

    def to_json(self) -> dict[str, Json]:
        """What a contract records."""
        return dict(asdict(self))


@dataclass(frozen=True, eq=False, repr=False)
class ExpectationFit:
    """An expectation, and how far probes get that climb against it.

    Parameters
    ----------
    climbs
        Fits that include where probes climbed to: ``CLIMBS``, or fewer where the form could not
        follow these too, so that drawn probes alone count from there on.
    climber_scores : (C, T) float64
        Scores of further probes that climbed against the expectation, and are in no fit, with the
        ``TEMPLATES`` templates of nobody that the fit compared probes with; no row where the metric
        leaves nothing to climb.
    """

    expectation: PointExpectation
    climbs: int
    climber_scores: Array64

    def climbers_at(self, level: Level) -> Climbers | None:
        """Count by the threshold of a level; None where nothing climbed."""
        if not len(self.climber_scores):
            return None
        accepted = (self.climber_scores >= level.threshold).mean(axis=1)
        probes, templates = self.climber_scores.shape
        return Climbers(
            level=level.name,
            accepted=float(accepted.mean()),
            most=float(accepted.max()),
            probes=probes,
            templates=templates,
            fitted=self.climbs == CLIMBS,
        )


def fit_expectation(
    source: DecoySource,
    hidden: DecoySource,
    *,
    strategy: Strategy,
    m: int,
    metric: Metric,
    stream: Keystream,
    templates: int = TEMPLATES,
    progress: Callable[[float], None] = lambda _share: None,
) -> ExpectationFit:
    """Fit mean and spread to probes, honest and hostile, against templates of nobody.

    Parameters
    ----------
    source
        Draws decoys of nobody: the generator that clients have.
    hidden
        Draws what templates hide, spread like the descriptors of enrolled people.
    strategy, m
        Of templates of nobody: the contract's, in the plain form.
    stream
        Nothing that is drawn is kept or secret.
    templates
        How many probes are compared with; half of those that are lifted.
    progress
        Called with the share that is done, from 0 to 1.

    Raises
    ------
    ContractError
        Where the fit does not hold on probes that it has not seen.
    """
    people = hidden.draw(PEOPLE, 1, stream=stream)[:, 0].astype(np.float64)
    wolves = draw_wolves(people, WOLVES, stream=stream)
    between = _between(people, wolves, BETWEEN, stream)
    probes = np.concatenate([people, wolves, between]).astype(np.float32)

    def lift_nobody(count: int) -> Templates:
        points = hidden.draw(count, 1, stream=stream)[:, 0]
        return lift_of_nobody(points, strategy=strategy, m=m, source=source, stream=stream)

    tile = max(1, _TILE_BYTES // (8 * m * source.n))
    mean_template = MeanTemplate.empty(source.n)

    def lift_told(count: int) -> Templates:
        progress(_LIFTED * mean_template.counts.sum() / (2 * templates))
        return lift_nobody(count)

    compared, climbed = (
        _kept(mean_template.add(half, lift_told, templates, tile=tile), kept, m=m, n=source.n)
        for half, kept in enumerate((templates, min(CLIMBED, templates)))
    )
    projector, foot = mean_template.estimate([source, hidden])
    progress(_LIFTED)
    fit = _Fit(
        metric,
        np.asarray(projector, dtype=np.float32),
        np.asarray(foot, dtype=np.float32),
        compared,
    )
    fit.add(probes, np.where(np.arange(len(probes)) % TESTED > 0, 1.0, 0.0))
    expectation = fit.expectation()
    fit.require(expectation)
    starts = np.concatenate([wolves[:: -(-WOLVES // CLIMBERS) * 2], people[: CLIMBERS // 2]])
    others = np.concatenate([wolves[1 :: -(-WOLVES // CLIMBERS) * 2], people[-(CLIMBERS // 2) :]])
    if metric is Metric.EUCLIDEAN:  # the mean is exact, and has nowhere to climb
        return ExpectationFit(expectation, 0, np.empty((0, templates)))
    climbs = 0
    while climbs < CLIMBS:
        progress(_COMPARED + (1 - _COMPARED) * climbs / (CLIMBS + 1))
        ends = _ascended(starts, climbed, expectation)
        fit.add(ends, np.full(len(ends), CLIMB_WEIGHT))
        closer = fit.expectation()
        if fit.problem(closer) is not None:  # the form cannot follow both: drawn probes count
            break
        expectation = closer
        climbs += 1
    ends = _ascended(others, climbed, expectation)
    return ExpectationFit(expectation, climbs, fit.scores(ends, expectation))


def _ascended(
    starts: Array64, climbed: SubspaceBatch, expectation: PointExpectation
) -> NDArray[np.float32]:
    """Climb as an attacker would who knows the expectation."""
    return ascend_points(
        starts.astype(np.float32),
        climbed,
        expectation,
        threshold=CLIMB_THRESHOLD,
        rounds=CLIMB_ROUNDS,
    )


def _kept(tiles: Iterator[Templates], count: int, *, m: int, n: int) -> SubspaceBatch:
    """Run through tiles of templates, and keep the first so many of them, in float32.

    They are written where they stay: to join them at the end would hold them all twice.
    """
    feet, bases = np.empty((count, n), np.float32), np.empty((count, m, n), np.float32)
    first = 0
    for tile_feet, tile_bases in tiles:
        rows = slice(first, min(first + len(tile_feet), count))
        room = rows.stop - rows.start
        feet[rows], bases[rows] = tile_feet[:room], tile_bases[:room]
        first = rows.stop
    return SubspaceBatch(feet, bases)


class _Fit:
    """Probes with mean and spread of their similarities to templates, and the fit to them.

    Parameters
    ----------
    metric, projector, foot
        As of the expectation.
    templates
        Of nobody.
    """

    def __init__(
        self,
        metric: Metric,
        projector: NDArray[np.float32],
        foot: NDArray[np.float32],
        templates: SubspaceBatch,
    ) -> None:
        self._metric, self._projector, self._foot = metric, projector, foot
        self._templates = templates
        self.probes = np.empty((0, len(foot)), dtype=np.float32)
        self.means, self.spreads, self.weights = np.empty(0), np.empty(0), np.empty(0)

    def add(self, probes: NDArray[np.float32], weights: Array64) -> None:
        """Compare probes with the templates; those of weight 0 are left out of the fit."""
        close = self._similarities(probes)
        self.probes = np.concatenate([self.probes, probes])
        self.means = np.append(self.means, close.mean(axis=1))
        self.spreads = np.append(self.spreads, close.std(axis=1, ddof=1))
        self.weights = np.append(self.weights, weights)

    def scores(self, probes: NDArray[np.float32], expectation: PointExpectation) -> Array64:
        """Return scores of probes that are not fitted with the templates, (P, T)."""
        means, spreads = expectation.statistics(probes)
        return np.asarray((self._similarities(probes) - means[:, None]) / spreads[:, None])

    def _similarities(self, probes: NDArray[np.float32]) -> Array64:
        distances = pairwise_distances(
            probes, self._templates, metric=self._metric, steps=DEFAULT_STEPS
        )
        return np.asarray(similarity(distances), dtype=np.float64)

    def expectation(self) -> PointExpectation:
        """Fit by least squares: a deviation is the unit of the mean, 1 that of the log spread."""
        fitted = self.weights > 0
        features = point_features(self.probes[fitted], self._projector, self._foot)
        roots = np.sqrt(self.weights[fitted])
        spreads = np.maximum(self.spreads[fitted], 1e-12)
        unit = roots / spreads
        return PointExpectation(
            metric=self._metric,
            projector=self._projector,
            foot=self._foot,
            mean=_least_squares(features * unit[:, None], self.means[fitted] * unit),
            log_spread=_least_squares(features * roots[:, None], np.log(spreads) * roots),
        )

    def problem(self, expectation: PointExpectation) -> str | None:
        """Say how an expectation is wrong on probes that are not fitted; None where it is right."""
        expected, deviations = expectation.statistics(self.probes)
        off = (expected - self.means) / np.maximum(self.spreads, 1e-12)
        relative = deviations / np.maximum(self.spreads, 1e-12) - 1
        honest = np.arange(len(self.probes)) < PEOPLE
        for which, most in ((honest, MOST_OFF), (~honest, 2 * MOST_OFF)):
            tested = which & (self.weights == 0)
            error = float(np.sqrt(np.mean(off[tested] ** 2)))
            uneven = float(np.sqrt(np.mean(relative[tested] ** 2)))
            # NaN is not below the limit either.
            if not (error <= most and uneven <= MOST_SPREAD):
                return f"off by {error:.2f} deviations, and the deviation by {100 * uneven:.0f} %"
        return None

    def require(self, expectation: PointExpectation) -> None:
        """Refuse an expectation that has a :meth:`problem`."""
        problem = self.problem(expectation)
        if problem is not None:
            raise ContractError(
                "the expected similarity to templates of nobody does not follow its closed form: "
                f"it is {problem}; build the decoys from more photos of faces, or choose another "
                "--strategy"
            )


def draw_wolves(people: Array64, count: int, *, stream: Keystream) -> Array64:
    """Draw unit probes (count, n) near many templates: axes of faces, the mean face, mixtures.

    Parameters
    ----------
    people : (N, n) float64
        Faces, drawn or real, whose axes are taken.
    """
    mean = people.mean(axis=0)
    length = float(np.linalg.norm(mean))
    axes = np.linalg.svd(people - mean, full_matrices=False)[2]
    lead = axes[: max(1, min(AXES, count // 8, len(axes)))]
    plain = np.concatenate([mean[None], -mean[None], lead, -lead, mean + length * lead])
    mixed = count - len(plain)
    # The widths of mixtures rise by powers of two: a few leading axes, or nearly all.
    widths = 2.0 ** stream.uniform((mixed,), 0.5, np.log2(len(axes)))
    weights = stream.normal((mixed, len(axes))) * (np.arange(len(axes)) < widths[:, None])
    along = stream.uniform((mixed, 1), -1.0, 1.0) * (mean / max(length, 1e-12))
    rows = np.concatenate([plain, normalised(weights @ axes) + along])
    return normalised(rows)


def _between(people: Array64, wolves: Array64, count: int, stream: Keystream) -> Array64:
    """Draw what an ascent from a face to a wolf, or from a wolf to a face, passes."""
    share = stream.uniform((count, 1))
    first = (stream.uniform((count,)) * len(people)).astype(np.int64)
    second = (stream.uniform((count,)) * len(wolves)).astype(np.int64)
    return normalised(share * people[first] + (1 - share) * wolves[second])


def _least_squares(features: Array64, values: Array64) -> Array64:
    return np.asarray(np.linalg.lstsq(features, values, rcond=_CUT)[0], dtype=np.float64)
