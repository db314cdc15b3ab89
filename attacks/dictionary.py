"""Trying face after face: what an attacker reaches who sees decisions only.

Every service that decides at an FMR is open to this, protected or not; only a lockout bounds it.
The order of the faces is the one of ``attacks.rehearsal``, so it does not depend on the answers,
and all victims can be tried at once.
"""

import numpy as np

from attacks.decisions import decide
from attacks.hill_climbing import LOCKOUTS, Climb, Climber, climbing_outcomes
from attacks.outcomes import Outcome
from attacks.rehearsal import rehearse_scene
from attacks.scene import Scene


def dictionary_outcomes(scene: Scene, *, most_attempts: int = LOCKOUTS[-1]) -> list[Outcome]:
    """Try the attacker's best faces on every victim's template.

    Parameters
    ----------
    most_attempts
        Faces that are tried on each.

    Returns
    -------
    list of Outcome
        As of :func:`attacks.hill_climbing.climbing_outcomes`.
    """
    faces = rehearse_scene(scene).faces[:most_attempts].astype(np.float32)
    accepted = decide(faces, scene.templates, scene.contract, scene.points, scene.level).accepted
    climbs = [
        Climb(
            Climber.DICTIONARY,
            attempts=int(np.argmax(column)) + 1 if column.any() else len(faces),
            accepted_at=int(np.argmax(column)) + 1 if column.any() else None,
        )
        for column in accepted.T
    ]
    return climbing_outcomes(climbs, scene.scheme, scene.level, most_attempts=len(faces))
