"""What the whole verification does with live and attack photos of enrolled people."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from templates.contract.levels import Rate
from verify.evaluation.liveness.rates import share
from verify.evaluation.liveness.scores import ScoredSet


@dataclass(frozen=True, eq=False)
class VerifiedSet:
    """Decisions on photos whose subject is enrolled, each against that subject's template.

    Parameters
    ----------
    matched, tried : (k,) bool
        Whether a photo was accepted, and whether it was shown at all: photos of people who are
        not enrolled, and those that people were enrolled by, are not. One without a face is
        shown, and not accepted.
    left_out
        Subjects who were not enrolled: too few live photos with a face, or they do not agree.
    """

    scored: ScoredSet
    matched: NDArray[np.bool_] = field(repr=False)
    tried: NDArray[np.bool_] = field(repr=False)
    level: str
    target_fmr: float | None
    enrolled_photos: int
    enrolled: int
    left_out: tuple[str, ...]

    def iapmr(self, species: str, threshold: float | None) -> Rate:
        """Share of the attacks of one species on their own subject's template that succeed.

        Parameters
        ----------
        threshold
            Of liveness, which must be reached as well; None for the comparison alone.
        """
        return self._share(species, threshold, lambda accepted: accepted)

    def false_rejections(self, threshold: float | None) -> Rate:
        """Share of the live photos that are rejected, by the comparison or as an attack."""
        return self._share(None, threshold, np.logical_not)

    def _share(
        self,
        species: str | None,
        threshold: float | None,
        error: Callable[[NDArray[np.bool_]], NDArray[np.bool_]],
    ) -> Rate:
        rows = [row for row in self.scored.rows(species) if self.tried[row]]
        accepted = self.matched[rows]
        if threshold is not None:
            accepted = accepted & (self.scored.scores[rows] >= threshold)
        return share(error(accepted), [self.scored.presentations[row].subject for row in rows])
