"""A system that answers by its own decisions: what climbers ask in place of a service."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from attacks.decisions import decide
from attacks.hill_climbing import Answer, Ask
from attacks.system import System
from templates.distances import pairwise_distances, similarity
from templates.space.subspace import SubspaceBatch


def in_process(system: System, victims: Sequence[int], *, scores: bool) -> dict[int, Ask]:
    """Return the system's own decisions on some victims, as a service would answer."""

    def answers(template: SubspaceBatch) -> Ask:
        def ask(probe: NDArray[np.float32]) -> Answer:
            points = system.points
            accepted = decide(probe[None], template, system.contract, points, system.level)
            if not scores:
                return Answer(bool(accepted[0, 0]))
            distance = pairwise_distances(
                probe[None], template, metric=points.metric, steps=points.steps
            )
            return Answer(bool(accepted[0, 0]), float(similarity(distance)[0, 0]))

        return ask

    return {number: answers(system.templates[number : number + 1]) for number in victims}
