"""Genuine and impostor scores of private templates, as a service would compute them.

Templates pass through the wire format on the way, so that calibration sees the same float16
numbers as the service. They are not rotated: a rotation leaves every distance as it was.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.contract import wire
from templates.contract.nobody import Nobody
from templates.decoys import Attributes, DecoySource
from templates.distances import (
    Metric,
    paired_distances,
    pairwise_distances,
    similarity,
)
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes, expected_similarity
from verify.thresholds import Genuine, Impostors, Indices
from verify.trials import TrialPlan

WIRE_DTYPE: wire.WireDtype = "float16"
PROBE_TILE = 1024
"""Probes at a time: templates are laid out anew for each tile."""
PAIR_TILE_BYTES = 128 * 2**20

Progress = Callable[[str, float], None]
Advance = Callable[[float], None]
Expected = tuple[NDArray[np.float64], NDArray[np.float64]]


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


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """How probes are scored against the templates of a calibration."""

    plan: TrialPlan
    templates: SubspaceBatch  # of ``plan.compared``
    nobody: Nobody
    metric: Metric
    steps: int

    def expected(self, probes: Probes) -> Expected:
        """Similarity that is expected of every probe, and its spread, each (P,)."""
        return expected_similarity(probes, self.nobody, metric=self.metric, steps=self.steps)

    def impostors(
        self,
        probes: Probes,
        expected: Expected,
        owners: Indices,
        met: Indices,
        *,
        size: int,
        progress: Advance,
    ) -> Impostors:
        """Compare each group of ``size`` probes with the people whom it meets, (groups, W)."""
        means, spreads = expected
        cells = np.empty((len(owners), met.shape[1]), dtype=np.float32)
        for group, people in enumerate(met):
            templates = self.templates
            if len(people) < len(templates):
                templates = templates[self.plan.template_of[people]]
            last = min((group + 1) * size, len(cells))
            for start in range(group * size, last, PROBE_TILE):
                rows = slice(start, min(start + PROBE_TILE, last))
                distances = pairwise_distances(
                    probes[rows], templates, metric=self.metric, steps=self.steps
                )
                cells[rows] = (similarity(distances) - means[rows, None]) / spreads[rows, None]
                cells[rows][owners[rows, None] == people] = -np.inf
                progress(rows.stop / len(cells))
        return Impostors(cells, owners, met, size, len(self.plan.people))

    def genuine(
        self, probes: Probes, expected: Expected, own: Indices, refused: NDArray[np.bool_]
    ) -> Genuine:
        """Compare the first probes, as many as ``own``, with the templates of their people."""
        means, spreads = (part[: len(own)] for part in expected)
        close = pair_similarities(
            probes, self.templates, np.arange(len(own)), self.plan.template_of[own],
            metric=self.metric, steps=self.steps,
        )  # fmt: skip
        scores = ((close - means) / spreads).astype(np.float32)
        enrolled = np.array([len(photos) for photos in self.plan.enrolled], dtype=np.int64)[own]
        return Genuine(scores, own, enrolled, refused)


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
