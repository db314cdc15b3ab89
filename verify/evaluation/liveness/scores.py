"""Liveness scores of a set of presentations, and the error rates that they give.

Terms of ISO/IEC 30107-3. A presentation is taken for live where its score is at or above the
threshold. APCER is of one attack species at a time, and the worst is the headline: an attacker
chooses. Photos in which no face was found have no score; they are counted apart, as non-responses.
"""

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
from templates.contract.levels import Rate
from verify.evaluation.liveness.presentations import Presentation, PresentationSet
from verify.metrics import rate, subject_bootstrap

Array64 = NDArray[np.float64]
Flags = NDArray[np.bool_]

LEAST_PEOPLE = 5
"""Fewer say nothing by being resampled."""


def share(errors: Flags, subjects: Sequence[str | None]) -> Rate:
    """Rate of errors; its interval resamples people where they are known, as photos share them."""
    people, codes = np.unique([name or "" for name in subjects], return_inverse=True)
    if None in subjects or len(people) < LEAST_PEOPLE:
        return rate(int(np.count_nonzero(errors)), len(errors))
    photos = np.bincount(codes, minlength=len(people)).astype(np.float64)
    wrong = codes[errors]
    return subject_bootstrap(
        np.stack([wrong, wrong], axis=1),
        people=len(people),
        trials=len(errors),
        weighted_trials=lambda weights: float(weights @ photos),
    )


@dataclass(frozen=True, eq=False)
class ScoredSet:
    """A set of presentations with their scores."""

    presented: PresentationSet
    scores: Array64 = field(repr=False)  # (k,); NaN where no face was acquired
    embeddings: NDArray[np.float32] = field(repr=False)  # (k, n)
    failures: tuple[Failure, ...]

    @property
    def presentations(self) -> tuple[Presentation, ...]:
        """Of the set, in its order."""
        return self.presented.presentations

    @property
    def acquired(self) -> Flags:
        """Whether a face was found, (k,)."""
        return np.isfinite(self.scores)

    def rows(self, species: str | None) -> NDArray[np.intp]:
        """Places of the presentations of one species, or of the live ones, without a face too."""
        return np.flatnonzero([one.species == species for one in self.presentations])

    def scored(self, species: str | None) -> Array64:
        """Scores of one species, or of the live ones."""
        scores = self.scores[self.rows(species)]
        return scores[np.isfinite(scores)]

    def bpcer(self, threshold: float) -> Rate:
        """Share of the live photos with a face that are taken for attacks."""
        return self.rate(None, self.scores < threshold, among=self.acquired)

    def apcer(self, species: str, threshold: float) -> Rate:
        """Share of the attack photos of one species with a face that are taken for live."""
        return self.rate(species, self.scores >= threshold, among=self.acquired)

    def non_response(self, species: str | None) -> Rate:
        """Share of the photos of one species (APNRR), or the live ones (BPNRR), without a face."""
        return self.rate(species, ~self.acquired, among=np.ones_like(self.acquired))

    def rate(self, species: str | None, wrong: Flags, *, among: Flags) -> Rate:
        """Share of one species that went wrong, among those that are asked about; both (k,)."""
        rows = [row for row in self.rows(species) if among[row]]
        return share(wrong[rows], [self.presentations[row].subject for row in rows])


@dataclass(frozen=True, eq=False)
class VerifiedSet:
    """Decisions on photos whose subject is enrolled, each against that subject's template."""

    scored: ScoredSet
    matched: Flags = field(repr=False)  # (k,)
    # (k,): photos of enrolled people, with or without a face, but not those of the enrollment.
    tried: Flags = field(repr=False)
    level: str
    target_fmr: float | None
    enrolled_photos: int
    enrolled: int
    left_out: tuple[str, ...]  # subjects of too few live photos, or of some that do not agree

    def accepted(self, threshold: float | None) -> Flags:
        """Whether the whole verification accepts, (k,); by the comparison alone where None."""
        if threshold is None:
            return self.matched
        return self.matched & (self.scored.scores >= threshold)

    def iapmr(self, species: str, threshold: float | None) -> Rate:
        """Share of the attacks of one species on their own subject's template that succeed."""
        return self.scored.rate(species, self.accepted(threshold), among=self.tried)

    def false_rejections(self, threshold: float | None) -> Rate:
        """Share of the live photos that are rejected, by the comparison or as an attack."""
        return self.scored.rate(None, ~self.accepted(threshold), among=self.tried)


def score_set(
    pack: ModelPack,
    presented: PresentationSet,
    *,
    progress: Callable[[int], None] = lambda _: None,
) -> ScoredSet:
    """Score every photo: the large central face of the frame, without the photo gate."""

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

    scores = np.full(len(presented.presentations), np.nan)
    embeddings = np.zeros((len(scores), pack.info.n), np.float32)
    failures = []
    with ThreadPoolExecutor(default_workers()) as pool:
        for row, result in enumerate(pool.map(sample, presented.presentations)):
            if isinstance(result, Failure):
                failures.append(result)
            elif result.liveness is not None:
                scores[row] = result.liveness
                embeddings[row] = result.embedding
            progress(1)
    return ScoredSet(presented, scores, embeddings, tuple(failures))
