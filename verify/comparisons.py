"""Genuine and impostor scores of private templates, as a service would compute them.

Templates pass through the wire format on the way, so that calibration sees the same float16
numbers as the service. They are not rotated: a rotation leaves every distance as it was.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.contract import wire
from templates.contract.levels import photos_in_words
from templates.contract.nobody import Nobody
from templates.decoys import Attributes, DecoySource
from templates.distances import (
    DEFAULT_STEPS,
    Metric,
    paired_distances,
    pairwise_distances,
    similarity,
)
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes, cohort_statistics
from verify.thresholds import Genuine, Impostors
from verify.trials import Indices, ProbeSets, TrialPlan, impostor_groups

WIRE_DTYPE: wire.WireDtype = "float16"
PROBE_TILE = 1024
"""Probes at a time: templates are laid out anew for each tile."""
PAIR_TILE_BYTES = 128 * 2**20

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Lifter:
    """Lifts as a service or a client of one contract does, through the wire format."""

    strategy: Strategy
    source: DecoySource
    contract_id: str

    def lift(self, embeddings: NDArray[np.float32], *, m: int, stream: Keystream) -> SubspaceBatch:
        """Project embeddings, lift, encode, decode; hybrid+ takes decoys of any label."""
        anybody = None
        if self.strategy is Strategy.HYBRID_PLUS:
            anybody = [Attributes()] * len(embeddings)
        lifted = lift(
            self.source.project(embeddings),
            strategy=self.strategy,
            m=m,
            source=self.source,
            stream=stream,
            attributes=anybody,
        )
        return through_wire(lifted, contract_id=self.contract_id)


def through_wire(batch: SubspaceBatch, *, contract_id: str) -> SubspaceBatch:
    """Encode and decode every template, as storing and reading it does."""
    feet, bases = np.empty_like(batch.feet), np.empty_like(batch.bases)
    for row, template in enumerate(batch):
        data = wire.encode(template, contract_id=contract_id, dtype=WIRE_DTYPE)
        back = wire.decode(data).subspace
        feet[row], bases[row] = back.foot, back.basis
    return SubspaceBatch(feet, bases)


def point_trials(
    embeddings: NDArray[np.float32],
    plan: TrialPlan,
    templates: SubspaceBatch,
    nobody: Nobody,
    sets: ProbeSets,
    *,
    metric: Metric,
    consistency: float,
    progress: Progress,
) -> tuple[Impostors, Genuine]:
    """Compare raw probes with the template of everybody who is compared."""
    people, compared = len(plan.people), len(plan.compared)
    owners = plan.person_of[sets.photos[sets.impostor, 0]]
    scores = np.empty((len(owners), compared), dtype=np.float32)
    what = f"comparing probes of {photos_in_words(sets.photos.shape[1])} with templates"
    for start in range(0, len(owners), PROBE_TILE):
        rows = slice(start, start + PROBE_TILE)
        probes = nobody.generator.project(sets.means(embeddings, sets.impostor[rows]))
        distances = pairwise_distances(probes, templates, metric=metric)
        means, spreads = nobody.statistics(probes, metric)
        scores[rows] = (similarity(distances) - means[:, None]) / spreads[:, None]
        progress(what, min(1.0, (start + PROBE_TILE) / len(owners)))
    with_template = np.flatnonzero(plan.template_of[owners] >= 0)
    scores[with_template, plan.template_of[owners[with_template]]] = -np.inf
    own = plan.person_of[sets.photos[: sets.genuine, 0]]
    probes = sets.means(embeddings, slice(sets.genuine))
    if len(probes):
        probes = nobody.generator.project(probes)
    else:
        probes = np.empty((0, templates.n), dtype=np.float32)
    means, spreads = nobody.statistics(probes, metric)
    close = pair_similarities(
        probes,
        templates,
        np.arange(len(own)),
        plan.template_of[own],
        metric=metric,
        steps=DEFAULT_STEPS,
    )
    genuine = Genuine(
        ((close - means) / spreads).astype(np.float32),
        own,
        _enrolled_photos(plan, own),
        refused=sets.disagreeing(embeddings, consistency=consistency),
    )
    probes_of = np.bincount(owners, minlength=people).astype(np.float64)

    def people_of(flat: Indices) -> Indices:
        return np.stack([owners[flat // compared], plan.compared[flat % compared]], axis=1)

    def weighted_trials(weights: NDArray[np.float64]) -> float:
        probe_weights = probes_of * weights
        others = weights[plan.compared]
        return float(probe_weights.sum() * others.sum() - probe_weights[plan.compared] @ others)

    probing = int(np.count_nonzero(probes_of))
    both = int(np.count_nonzero(probes_of[plan.compared]))
    return Impostors(
        scores=scores.reshape(-1),
        trials=len(owners) * compared - len(with_template),
        people=people,
        # Unordered: of two who both probe and are compared there are two trials, and one pair.
        person_pairs=probing * compared - both - both * (both - 1) // 2,
        people_of=people_of,
        weighted_trials=weighted_trials,
    ), genuine


def _enrolled_photos(plan: TrialPlan, people: Indices) -> Indices:
    """Return how many photos made the template of each of some people."""
    return np.array([len(photos) for photos in plan.enrolled], dtype=np.int64)[people]


def lifted_trials(
    embeddings: NDArray[np.float32],
    plan: TrialPlan,
    templates: SubspaceBatch,
    cohort: SubspaceBatch,
    lifter: Lifter,
    *,
    probe_m: int,
    metric: Metric,
    steps: int,
    most_probes: int,
    impostor_pairs: int,
    rng: np.random.Generator,
    stream: Keystream,
    progress: Progress,
) -> tuple[Impostors, Genuine, NDArray[np.float64]]:
    """Compare lifted probes with their person's template, and with a random subset of others.

    Probes are at most ``most_probes`` photos, genuine ones first. Groups of them meet groups of
    other people's templates, about ``impostor_pairs`` pairs in all. Also returns the norms of
    their foot points.
    """
    what = f"comparing lifted probes, m = {probe_m}"
    genuine_photos = plan.genuine
    if len(genuine_photos) > most_probes:
        genuine_photos = rng.choice(genuine_photos, most_probes, replace=False)
    extra = np.setdiff1d(np.arange(len(plan.person_of)), plan.genuine)
    room = min(len(extra), most_probes - len(genuine_photos))
    chosen = np.concatenate([genuine_photos, rng.choice(extra, room, replace=False)])
    owners = plan.person_of[chosen]
    probes = lifter.lift(embeddings[chosen], m=probe_m, stream=stream)
    means, spreads = np.empty(len(chosen)), np.empty(len(chosen))
    scores: list[NDArray[np.float32]] = []
    met: list[Indices] = []
    for rows, people in impostor_groups(plan, len(chosen), pairs=impostor_pairs, rng=rng):
        group = probes[rows]
        means[rows], spreads[rows] = cohort_statistics(group, cohort, metric=metric, steps=steps)
        distances = pairwise_distances(
            group, templates[plan.template_of[people]], metric=metric, steps=steps
        )
        z = ((similarity(distances) - means[rows, None]) / spreads[rows, None]).astype(np.float32)
        others = owners[rows, None] != people[None, :]
        row, column = np.nonzero(others)
        scores.append(z[others])
        met.append(np.stack([owners[rows][row], people[column]], axis=1))
        progress(what, rows.stop / len(chosen))
    pair_people = np.concatenate(met)
    own = owners[: len(genuine_photos)]
    first = np.arange(len(own), dtype=np.int64)
    close = pair_similarities(
        probes, templates, first, plan.template_of[own], metric=metric, steps=steps
    )
    keys, repeats = np.unique(pair_people, axis=0, return_counts=True)
    unordered = np.unique(np.sort(keys, axis=1), axis=0)

    def weighted_trials(weights: NDArray[np.float64]) -> float:
        return float(repeats @ (weights[keys[:, 0]] * weights[keys[:, 1]]))

    impostors = Impostors(
        scores=np.concatenate(scores),
        trials=len(pair_people),
        people=len(plan.people),
        person_pairs=len(unordered),
        people_of=lambda flat: pair_people[flat],
        weighted_trials=weighted_trials,
    )
    z = ((close - means[: len(own)]) / spreads[: len(own)]).astype(np.float32)
    genuine = Genuine(z, own, _enrolled_photos(plan, own), refused=np.zeros(len(own), np.bool_))
    return impostors, genuine, probes.foot_norms


def pair_similarities(
    probes: Probes,
    templates: SubspaceBatch,
    positions: Indices,
    numbers: Indices,
    *,
    metric: Metric,
    steps: int,
) -> NDArray[np.float32]:
    """Similarities of the pairs (probes[positions[i]], templates[numbers[i]]), by tiles."""
    dimension = templates.m + 2 + (probes.m if isinstance(probes, SubspaceBatch) else 0)
    tile = max(1, PAIR_TILE_BYTES // (4 * templates.n * dimension))
    out = np.empty(len(positions), dtype=np.float32)
    for start in range(0, len(positions), tile):
        rows = slice(start, start + tile)
        distances = paired_distances(
            probes[positions[rows]], templates[numbers[rows]], metric=metric, steps=steps
        )
        out[rows] = similarity(distances)
    return out


def honest_norms(norms: NDArray[np.float64]) -> tuple[float, float]:
    """Range of ‖p‖ that honest lifts have: what was observed, widened by half its width each way.

    ‖p‖ of honest lifts is unimodal with thin tails (a sum over many decoys). The extremes of 1,000
    or more observations lie some 3 standard deviations out, so the widened range reaches about 6,
    and an honest client is refused less than once in a million. The lower bound stays positive:
    a set through the coordinate origin is no lift of a unit vector (docs/method.md §4.7).
    """
    low, high = float(norms.min()), float(norms.max())
    margin = max((high - low) / 2, 1e-3)
    return max(low - margin, low / 2), min(high + margin, 1.0)
