"""The attacks of ``veilface audit templates`` on one scheme, in the order of the report."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from api.cli.attacked_service import attacked_service
from attacks.cast import Cast
from attacks.chosen_enrollment import chosen_enrollment
from attacks.databases import link_databases
from attacks.dictionary import dictionary_outcomes
from attacks.hill_climbing import Climber, climb, climbing_outcomes
from attacks.learned import invert, reconstruct
from attacks.learned.inverter import SECONDS, Inverter
from attacks.likelihood import find_least_decoy_like, likeliest_guesses
from attacks.linkage import link
from attacks.outcomes import Outcome
from attacks.rehearsal import rehearse_scene
from attacks.renewability import renew
from attacks.scene import Scene
from attacks.stored import template_attacks
from models.decoding import decode_image
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract import wire

PARTS = 10
"""Steps of the progress bar for each scheme."""
LINKED = 120
"""Victims whose templates are linked across tenants: every two of them are compared."""


class Drawings:
    """Aligned faces, for the decoder that draws faces from descriptors."""

    def __init__(self, pack: ModelPack, faces: Extraction, *, aligned: bool) -> None:
        self._pack = pack
        self._faces = faces
        self._aligned = aligned

    def crops(self, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Crops of some rows of the folder, uint8 (B, s, s, 3)."""
        size = int(self._pack.info.preprocessing["size"])
        crops = []
        for row in rows.tolist():
            image = decode_image(self._faces.paths[row].read_bytes())
            if self._aligned:
                crops.append(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA))
            else:
                crops.append(self._pack.align(image, self._pack.detect(image)[0]))
        return np.stack(crops)

    def descriptors(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Descriptors of the same rows."""
        return self._faces.descriptors[rows]

    def embed(self, crops: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Embed drawn faces as the service would."""
        return self._pack.embed(crops)


def operating(scene: Scene) -> dict[str, Any]:
    """What the scheme costs: the error rates of the calibration, and the size of a template."""
    return {
        "default_level": scene.level.name,
        "levels": [level.to_json() for level in scene.points.levels],
        "raw_thresholds": dict(scene.raw_thresholds),
        "template_bytes": wire.encoded_size(scene.templates.n, scene.templates.m),
    }


def attacks_on(
    scene: Scene,
    cast: Cast,
    known: NDArray[np.float32],
    *,
    seconds: float | None,
    attempts: int | None,
    climbed: int,
    drawings: Drawings | None,
    seed: int,
) -> list[Callable[[], list[Outcome]]]:
    """All attacks on a scheme, ``PARTS`` of them, in the order of the report."""
    inverter: dict[str, Inverter] = {}
    likeliest = cache(lambda: likeliest_guesses(scene, known))

    def learned() -> list[Outcome]:
        if seconds is None:
            return []
        found, outcomes = invert(scene, known, seconds=seconds, seed=seed)
        inverter["inverter"] = found
        return outcomes

    def drawn() -> list[Outcome]:
        if drawings is None:
            return []
        guesses = {name: found(scene.templates) for name, found in inverter.items()}
        guesses |= likeliest()
        return reconstruct(
            scene,
            drawings.crops(cast.rows),
            drawings.descriptors(cast.rows),
            drawings.crops(scene.victims.shown),
            embed=drawings.embed,
            guesses=guesses,
            seconds=SECONDS if seconds is None else seconds,
            seed=seed,
        )

    def over_rest() -> list[Outcome]:
        return [] if attempts is None else _climbs(scene, climbed, attempts, seed=seed)

    return [
        lambda: find_least_decoy_like(scene, known, guesses=likeliest()),
        lambda: template_attacks(scene, photos=cast.albums),
        learned,
        drawn,
        lambda: link(scene, liftings=3, most_people=LINKED),
        lambda: link_databases(scene, most_people=LINKED),
        lambda: renew(scene, photos=cast.albums, guesses=likeliest()),
        lambda: chosen_enrollment(scene),
        lambda: dictionary_outcomes(scene),
        over_rest,
    ]


def _climbs(scene: Scene, climbed: int, attempts: int, *, seed: int) -> list[Outcome]:
    """Climb towards the first victims over the REST interface of the real service."""
    prior = rehearse_scene(scene)
    wires = [
        wire.encode(scene.templates[number], contract_id=scene.contract.contract_id)
        for number in range(min(climbed, len(scene.templates)))
    ]
    outcomes: list[Outcome] = []
    with attacked_service(scene.contract, scene.source, wires) as (scored, deciding):
        for climber in Climber:
            asks = deciding if climber is Climber.DICTIONARY else scored
            most = min(attempts, len(prior.faces)) if climber is Climber.DICTIONARY else attempts
            climbs = climb(dict(enumerate(asks)), prior, climber, most_attempts=most, seed=seed)
            outcomes += [
                # Decisions alone are judged on all victims, and not on these few.
                replace(
                    each,
                    variant=f"{each.variant}, over REST",
                    judged=climber is not Climber.DICTIONARY,
                )
                for each in climbing_outcomes(climbs, scene.scheme, scene.level, most_attempts=most)
            ]
    return outcomes
