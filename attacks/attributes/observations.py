"""What attackers compute from the templates of faces: lifted, searched, guessed, tile by tile.

A tile's templates live no longer than the tile; as many tiles are in memory as cores work, and one
that waits. Every tile is worked on by one core.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.faces import LabelledFaces
from attacks.attributes.features import Features, features_of
from attacks.attributes.known_decoys import find_decoys, strip
from attacks.attributes.neighbours import METRICS, Attacked, merged, nearest_neighbours, vote
from attacks.attributes.plan import Setup, Side
from attacks.errors import AuditError
from attacks.outcomes import GENERATED, RAW_SCHEME, Scheme
from attacks.second_order import likeliest_embeddings
from templates.distances import Metric
from templates.distances.blas import single_threaded
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

Codes = NDArray[np.int64]
ByAttribute = dict[str, Codes]

_TILE_BYTES = 64 << 20
_TILE_ROWS = 256


@dataclass(frozen=True, eq=False, repr=False)
class Observations:
    """What the attackers compute from the templates of some faces, and the truth of these."""

    features: Features
    votes: dict[Metric, ByAttribute]
    """Predictions of the paper's attacker."""
    guessed: Features | None
    """Features of the guesses at the embeddings, of attackers who know the decoys: the foot points
    without the pool's, or the points likeliest by second moments; None where there are none."""
    truth: ByAttribute

    def take(self, rows: Codes) -> "Observations":
        """Return some of the rows."""
        return Observations(
            self.features.take(rows),
            {m: {a: codes[rows] for a, codes in by.items()} for m, by in self.votes.items()},
            None if self.guessed is None else self.guessed.take(rows),
            {a: codes[rows] for a, codes in self.truth.items()},
        )

    @classmethod
    def stack(cls, parts: "list[Observations]") -> "Observations":
        """Put the rows of all parts under each other."""
        first = parts[0]
        guessed = [part.guessed for part in parts if part.guessed is not None]
        return cls(
            Features.stack([part.features for part in parts]),
            {
                m: {a: np.concatenate([part.votes[m][a] for part in parts]) for a in by}
                for m, by in first.votes.items()
            },
            Features.stack(guessed) if guessed else None,
            {a: np.concatenate([part.truth[a] for part in parts]) for a in first.truth},
        )


def observe_attacked(setup: Setup, scheme: Scheme) -> Observations:
    """Lift the attacked faces with the deployment's decoys, and look at their templates."""
    stream = Keystream.seeded("attributes", setup.seed, "attacked", *_parts(scheme))
    observer = _Observer(setup, scheme, setup.side, True)
    return _observe(observer, setup.split.attacked, stream)


def observe_own(setup: Setup, scheme: Scheme) -> tuple[Observations, NDArray[np.bool_]]:
    """Lift the attacker's own faces, fold by fold; which of them are held out.

    They are searched among the nearby faces only.
    """
    parts, held_out = [], []
    for number, fold in enumerate(setup.folds):
        observer = _Observer(setup, scheme, fold.side, False)
        for turn in range(_lifts(setup, scheme)):
            stream = Keystream.seeded(
                "attributes", setup.seed, "own", number, turn, *_parts(scheme)
            )
            parts.append(_observe(observer, fold.own, stream, entries=fold.entries))
            held_out.append(fold.held)
    return Observations.stack(parts), np.concatenate(held_out)


def _lifts(setup: Setup, scheme: Scheme) -> int:
    return 1 if scheme == RAW_SCHEME else setup.plan.lifts_of(len(setup.split.attack))


@dataclass(frozen=True, eq=False, repr=False)
class _Observer:
    """How templates of one side are looked at; ``whole`` is whether all of the gallery votes."""

    setup: Setup
    scheme: Scheme
    side: Side
    whole: bool


def _observe(
    observer: _Observer, faces: LabelledFaces, stream: Keystream, *, entries: Codes | None = None
) -> Observations:
    """Lift faces and compute all that attackers need of the templates.

    ``entries`` are the faces' own positions in the side's pool, where they are in it.
    """
    tiles = (
        (attacked, faces.take(rows), None if entries is None else entries[rows])
        for rows, attacked in _lifted(observer.setup, observer.scheme, faces, observer.side, stream)
    )
    work = (partial(_observe_tile, observer, *tile) for tile in tiles)
    return Observations.stack(list(_in_order(work, observer.setup.plan.threads)))


def _in_order(work: Iterable[Callable[[], Observations]], threads: int) -> Iterator[Observations]:
    """Do the work on so many cores; one piece more than there are cores is made ahead.

    A piece runs in a copy of this context, which says where distances are computed.
    """
    waiting: deque[Future[Observations]] = deque()
    with single_threaded(), ThreadPoolExecutor(threads) as pool:
        for piece in work:
            waiting.append(pool.submit(copy_context().run, piece))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _observe_tile(
    observer: _Observer, attacked: Attacked, faces: LabelledFaces, own: Codes | None
) -> Observations:
    plan, side = observer.setup.plan, observer.side
    metrics = METRICS if observer.scheme != RAW_SCHEME else METRICS[:1]
    near = nearest_neighbours(
        attacked,
        side.nearby.descriptors,
        k=plan.neighbours,
        metrics=metrics,
    )
    features = features_of(attacked, side.axes, near, side.nearby, ks=plan.feature_ks)
    after = len(side.nearby)
    if observer.whole and after < len(side.gallery):
        beyond = nearest_neighbours(
            attacked,
            side.gallery.descriptors[after:],
            k=min(plan.k, len(side.gallery) - after),
            metrics=metrics,
        )
        near = {m: merged(near[m], beyond[m], after=after, k=plan.k) for m in metrics}
    votes = {
        metric: {
            name: vote(neighbours, side.gallery.labels[name], len(classes), k=plan.k)
            for name, classes in side.gallery.classes.items()
        }
        for metric, neighbours in near.items()
    }
    guessed = _guessed(observer, attacked, features, own)
    return Observations(features, votes, guessed, dict(faces.labels))


def _lifted(
    setup: Setup, scheme: Scheme, faces: LabelledFaces, side: Side, stream: Keystream
) -> Iterator[tuple[Codes, Attacked]]:
    """Yield positions of faces and their templates, a tile at a time."""
    rows = _TILE_BYTES // (4 * faces.n * max(1, scheme.dim))
    step = int(np.clip(rows, 1, _TILE_ROWS))
    for start in range(0, len(faces), step):
        chosen = np.arange(start, min(start + step, len(faces)))
        tile = faces.take(chosen)
        if scheme == RAW_SCHEME:
            yield chosen, tile.descriptors
            continue
        plus = scheme.strategy == Strategy.HYBRID_PLUS
        if plus and not {"gender", "race"} <= set(faces.attributes):
            raise AuditError("hybrid+ chooses decoys by gender and race: give labels of both")
        yield (
            chosen,
            lift(
                tile.descriptors,
                strategy=scheme.strategy,
                m=scheme.dim,
                source=setup.source(scheme, side),
                stream=stream,
                attributes=tile.decoy_attributes() if plus else None,
            ),
        )


def _guessed(
    observer: _Observer, attacked: Attacked, features: Features, own: Codes | None
) -> Features | None:
    """Guess the embeddings, with the pool or with the generator."""
    scheme, side = observer.scheme, observer.side
    if scheme.decoys is None or not isinstance(attacked, SubspaceBatch):
        return None
    if scheme.decoys == GENERATED:
        known = observer.setup.decoys
        if side.faces is None or known is None:
            raise AuditError("schemes with generated decoys need a decoy generator")
        points = likeliest_embeddings(attacked, side.faces, known).astype(np.float32)
        point_features = _features_of_points(observer, points)
        return Features(points, np.hstack([point_features.derived, features.derived]))
    entries = side.entries.descriptors
    most = Strategy(scheme.strategy).decoys(scheme.dim)
    decoys = find_decoys(attacked, entries, most=most, skip=own)
    return _features_of_points(observer, strip(attacked, entries, decoys))


def _features_of_points(observer: _Observer, points: NDArray[np.float32]) -> Features:
    ks, side = observer.setup.plan.feature_ks, observer.side
    near = nearest_neighbours(
        points,
        side.nearby.descriptors,
        k=max(ks),
        metrics=METRICS[:1],
    )
    return features_of(points, side.axes, near, side.nearby, ks=ks)


def _parts(scheme: Scheme) -> tuple[str | int, ...]:
    """Name a scheme in a seed, so that each has randomness of its own."""
    return scheme.strategy, scheme.decoys or "", scheme.dim
