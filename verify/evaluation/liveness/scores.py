"""Liveness scores of a set of presentations, and what gave none."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from models.errors import FaceError, ImageError
from models.extraction import Failure
from models.faces import FaceSample
from models.pack import ModelPack
from models.sessions import default_workers
from verify.evaluation.liveness.presentations import Presentation, PresentationSet

Array64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ScoredSet:
    """A set of presentations with their scores.

    Parameters
    ----------
    scores : (k,) float64
        NaN where no face was acquired.
    embeddings : (k, n) float32
        Of the same faces; undefined where no face was acquired.
    """

    presented: PresentationSet
    scores: Array64 = field(repr=False)
    embeddings: NDArray[np.float32] = field(repr=False)
    failures: tuple[Failure, ...]

    @property
    def presentations(self) -> tuple[Presentation, ...]:
        """Of the set, in its order."""
        return self.presented.presentations

    @property
    def acquired(self) -> NDArray[np.bool_]:
        """Whether a face was found, (k,)."""
        return np.isfinite(self.scores)

    def rows(self, species: str | None) -> NDArray[np.intp]:
        """Places of the presentations of one species, or of the live ones, without a face too."""
        return np.flatnonzero([one.species == species for one in self.presentations])

    def scored(self, species: str | None) -> tuple[Array64, list[str | None]]:
        """Scores of one species, or of the live ones, and whose faces they are."""
        rows = [row for row in self.rows(species) if self.acquired[row]]
        return self.scores[rows], [self.presentations[row].subject for row in rows]


def score_set(
    pack: ModelPack,
    presented: PresentationSet,
    *,
    progress: Callable[[int], None] = lambda _: None,
) -> ScoredSet:
    """Score every photo: the large central face of the frame, without the photo gate.

    Raises
    ------
    PackError
        If the pack has no liveness graph.
    """

    def sample(presentation: Presentation) -> FaceSample | Failure:
        try:
            return pack.embed_photo(
                presentation.path.read_bytes(),
                policy=None,
                quality=None,
                liveness=True,
            )
        except (ImageError, FaceError) as error:
            return Failure(presentation.path, error.code, str(error))
        except OSError as error:
            reason = f"The file cannot be read: {error.strerror}."
            return Failure(presentation.path, "unreadable_file", reason)

    results: list[FaceSample | Failure] = []
    with ThreadPoolExecutor(default_workers()) as pool:
        for result in pool.map(sample, presented.presentations):
            results.append(result)
            progress(1)
    return _scored(presented, results, n=pack.info.n)


def _scored(
    presented: PresentationSet, results: Sequence[FaceSample | Failure], *, n: int
) -> ScoredSet:
    scores = np.full(len(results), np.nan)
    embeddings = np.zeros((len(results), n), np.float32)
    failures = []
    for row, result in enumerate(results):
        if isinstance(result, Failure):
            failures.append(result)
        elif result.liveness is not None:
            scores[row] = result.liveness
            embeddings[row] = result.embedding
    return ScoredSet(presented, scores, embeddings, tuple(failures))
