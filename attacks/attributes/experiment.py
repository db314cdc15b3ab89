"""The attribute attacks on one scheme: lift, look at the templates, guess, measure.

The attacker lifts its own faces by the same algorithm. A secret pool it does not have: it uses
faces of its own, each fold's as the decoys of the fold, so that neither a face nor its decoys had a
part in the axes or in the gallery that it is judged by. The generator it has.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.faces import LabelledFaces
from attacks.attributes.features import MOST_NEIGHBOURS, features_of
from attacks.attributes.neighbours import METRICS, Attacked, K, nearest_neighbours, vote
from attacks.attributes.plan import Setup, Side
from attacks.attributes.rows import AttributeRow, measure
from attacks.outcomes import GENERATED, POOLED, RAW_SCHEME, KnowledgeLevel, Scheme
from attacks.second_order import likeliest_embeddings
from attacks.stored.known_pool import find_decoys, strip
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch

Codes = NDArray[np.int64]
Observed = dict[tuple[str, ...], NDArray[Any]]
"""What attackers compute from the templates of some faces, a row for each: ``("features",)``;
``("vote", metric, attribute)``, what the paper's attacker says; ``("truth", attribute)``; and of
attackers who know the decoys ``("points",)``, guesses of the embeddings, and ``("guessed",)``,
features of these."""

KNN, LOGISTIC, SECOND, STRIP = "knn", "logistic", "second moments", "strip"
_TILE_BYTES = 64 << 20
_TILE_ROWS = 256
# Of the logistic regression on standardised features: little for few faces, as many of the
# features say the same, more for many.
_LOGISTIC_CS = (1e-4, 1e-3, 1e-2, 1e-1)


def run_scheme(setup: Setup, scheme: Scheme) -> list[AttributeRow]:
    """Attack one scheme with every attacker, for every attribute.

    These are the paper's attacker by both metrics (of raw embeddings by one, as they agree), the
    trained attackers, and for pools those that hold the pool. hybrid+ lifts the attacked faces by
    their true labels, as the paper does.

    Raises
    ------
    LiftingError, DecoyError
        There are too few decoys for the scheme.
    """
    attack = setup.split.attack
    own, held_out = observe_own(setup, scheme)
    attacked = observe_attacked(setup, scheme)
    training = {key: part[~held_out] for key, part in own.items()}
    choosing = {key: part[held_out] for key, part in own.items()}

    def row(
        attribute: str, said: Codes, at_home: Codes, truth_at_home: Codes, **names: Any
    ) -> AttributeRow:
        names |= {"scheme": scheme, "attribute": attribute, "seed": setup.plan.seed}
        names["classes"] = attack.classes[attribute]
        strength = measure(at_home, truth_at_home, **names).strength
        return replace(measure(said, attacked["truth", attribute], **names), held_out=strength)

    rows: list[AttributeRow] = []
    for name, metric, attribute in (key for key in attacked if key[0] == "vote"):
        # The vote learns from no template, so that all of the attacker's own try it.
        key, truth = (name, metric, attribute), own["truth", attribute]
        names = {"attacker": KNN, "metric": metric, "knowledge": KnowledgeLevel.ALGORITHM}
        rows.append(row(attribute, attacked[key], own[key], truth, **names))
    trained: list[tuple[str, KnowledgeLevel, list[tuple[str, ...]]]] = [
        (LOGISTIC, KnowledgeLevel.ALGORITHM, [("features",)])
    ]
    if ("points",) in attacked:
        name, known = SECOND, KnowledgeLevel.ALGORITHM
        if scheme.decoys == POOLED:
            name, known = STRIP, KnowledgeLevel.DECOYS
        trained.append((name, known, [("guessed",), ("points", "guessed")]))
    for name, known, alternatives in trained:
        for attribute in attack.classes:
            said = trained_on(training, choosing, attacked, attribute, alternatives)
            truth = choosing["truth", attribute]
            rows.append(row(attribute, *said, truth, attacker=name, metric=None, knowledge=known))
    return rows


def trained_on(
    training: Observed,
    choosing: Observed,
    attacked: Observed,
    attribute: str,
    alternatives: Sequence[tuple[str, ...]],
) -> tuple[Codes, Codes]:
    """Train a logistic regression on templates that the attacker lifted itself.

    It chooses the regularisation, and one of the ``alternatives`` of parts to learn from, by
    templates that it does not learn from (``choosing``). Returns predictions of the attacked faces,
    and of those that were chosen by.
    """
    # Imported here: only an audit of attributes needs the library.
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    truth = training["truth", attribute]
    if len(only := np.unique(truth)) == 1:
        return np.full(_count(attacked), only[0]), np.full(_count(choosing), only[0])
    best = -1.0
    for names in alternatives:
        rows, at_home, away = (
            np.hstack([part[name,] for name in names]).astype(np.float64)
            for part in (training, choosing, attacked)
        )
        for c in _LOGISTIC_CS:
            model = make_pipeline(StandardScaler(), LogisticRegression(C=c, max_iter=1000))
            model.fit(rows, truth)
            said = model.predict(at_home)
            score = float(np.mean(said == choosing["truth", attribute]))
            if score > best:  # of equals the more regularised
                best, chosen = score, (model.predict(away), said)
    return chosen


def _count(observed: Observed) -> int:
    return len(next(iter(observed.values())))


def observe_attacked(setup: Setup, scheme: Scheme) -> Observed:
    """Lift the attacked faces with the deployment's decoys, and look at their templates."""
    stream = Keystream.seeded("attributes", setup.plan.seed, "attacked", *_purpose(scheme))
    side = setup.side
    return _observe(setup, scheme, side, setup.split.attacked, stream, voters=side.gallery)


def observe_own(setup: Setup, scheme: Scheme) -> tuple[Observed, NDArray[np.bool_]]:
    """Lift the attacker's own faces, fold by fold; which of them are held out.

    They are searched among the nearby faces only.
    """
    parts, held_out = [], []
    lifts = 1 if scheme == RAW_SCHEME else setup.plan.lifts_of(len(setup.split.attack))
    for number, fold in enumerate(setup.folds):
        for turn in range(lifts):
            stream = Keystream.seeded(
                "attributes", setup.plan.seed, "own", number, turn, *_purpose(scheme)
            )
            parts.append(
                _observe(
                    setup, scheme, fold.side, fold.own, stream,
                    voters=fold.side.nearby, entries=fold.entries,
                )
            )  # fmt: skip
            held_out.append(fold.held_out)
    return _stacked(parts), np.concatenate(held_out)


def _stacked(parts: Sequence[Observed]) -> Observed:
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _observe(
    setup: Setup,
    scheme: Scheme,
    side: Side,
    faces: LabelledFaces,
    stream: Keystream,
    *,
    voters: LabelledFaces,
    entries: Codes | None = None,
) -> Observed:
    """Lift faces, a tile at a time, and compute what attackers need of the templates.

    Memory holds the templates of one tile. ``entries`` are the faces' own positions in the side's
    pool, where they are in it.
    """
    rows = _TILE_BYTES // (4 * faces.n * max(1, scheme.dim))
    step = int(np.clip(rows, 1, _TILE_ROWS))
    tiles = []
    for start in range(0, len(faces), step):
        chosen = np.arange(start, min(start + step, len(faces)))
        tile = faces.take(chosen)
        attacked = _lifted(setup, scheme, side, tile, stream)
        own = None if entries is None else entries[chosen]
        tiles.append(_look(setup, scheme, side, attacked, voters, own))
        tiles[-1] |= {("truth", name): codes for name, codes in tile.labels.items()}
    return _stacked(tiles)


def _lifted(
    setup: Setup, scheme: Scheme, side: Side, faces: LabelledFaces, stream: Keystream
) -> Attacked:
    if scheme == RAW_SCHEME:
        return faces.embeddings
    attributes = faces.decoy_attributes() if scheme.strategy == Strategy.HYBRID_PLUS else None
    return lift(
        faces.embeddings,
        strategy=scheme.strategy,
        m=scheme.dim,
        source=setup.source(scheme, side),
        stream=stream,
        attributes=attributes,
    )


def _look(
    setup: Setup,
    scheme: Scheme,
    side: Side,
    attacked: Attacked,
    voters: LabelledFaces,
    own: Codes | None,
) -> Observed:
    metrics = METRICS if scheme != RAW_SCHEME else METRICS[:1]
    near = nearest_neighbours(attacked, side.nearby.embeddings, k=MOST_NEIGHBOURS, metrics=metrics)
    features = features_of(attacked, side.axes, near, side.nearby)
    if len(voters) > len(side.nearby):
        near = nearest_neighbours(attacked, voters.embeddings, k=K, metrics=metrics)
    seen: Observed = {("features",): features}
    seen |= {
        ("vote", str(metric), name): vote(near[metric], voters.labels[name], len(of), k=K)
        for metric in metrics
        for name, of in voters.classes.items()
    }
    if scheme.decoys is None or not isinstance(attacked, SubspaceBatch):
        return seen
    points = _guess(setup, scheme, side, attacked, own)
    near = nearest_neighbours(
        points, side.nearby.embeddings, k=MOST_NEIGHBOURS, metrics=METRICS[:1]
    )
    guessed = features_of(points, side.axes, near, side.nearby)
    if scheme.decoys == GENERATED:
        guessed = np.hstack([guessed, features])
    return seen | {("points",): points, ("guessed",): guessed}


def _guess(
    setup: Setup, scheme: Scheme, side: Side, templates: SubspaceBatch, own: Codes | None
) -> NDArray[np.float32]:
    """Guess the embeddings, (P, n): with the pool, or by second moments with the generator."""
    if side.faces is not None and setup.decoys is not None and scheme.decoys == GENERATED:
        return likeliest_embeddings(templates, side.faces, setup.decoys).astype(np.float32)
    entries = side.entries.embeddings
    most = Strategy(scheme.strategy).decoys(scheme.dim)
    return strip(templates, entries, find_decoys(templates, entries, most=most, own=own))


def _purpose(scheme: Scheme) -> tuple[str | int, ...]:
    """Name a scheme in a seed, so that each has randomness of its own."""
    return scheme.strategy, scheme.decoys or "", scheme.dim
