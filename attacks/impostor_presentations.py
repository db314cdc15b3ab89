"""Impostor attack presentations: a photo of an enrolled person before the camera.

The whole verification is attacked: people are enrolled by their live photos, and the attacker
shows what a set holds of the same person (ISO/IEC 30107-3, IAPMR).
"""

import numpy as np

from enroll.enroller import Enroller
from models.pack import PackInfo
from templates.contract.document import Contract
from templates.decoys import DecoySource
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.keys.rotation import TenantRotation
from templates.space.agreement import InconsistentImages
from verify.evaluation.liveness.scores import ScoredSet, VerifiedSet
from verify.verifier import Verifier

ENROLLED_PHOTOS = 3


def verify_presentations(
    scored: ScoredSet,
    info: PackInfo,
    contract: Contract,
    source: DecoySource,
    *,
    level: str | None = None,
) -> VerifiedSet:
    """Enroll each subject by three live photos, and verify all other photos of theirs, one by one.

    The three are spread evenly over the subject's live photos in the order of their names.

    Parameters
    ----------
    info
        Of the pack that embedded the photos.

    Raises
    ------
    ContractMismatch
        If the pack or the decoys are not the contract's.
    Uncalibrated
        If the contract has no such level.
    """
    contract.binding.require_embedder(
        embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing, n=info.n
    )
    stream = Keystream.seeded("impostor presentations", 0)
    rotation = TenantRotation(stream.token(KEY_BYTES), source.k)
    lift_secret = stream.token(KEY_BYTES)
    enroller = Enroller(contract, source, rotation=rotation, lift_secret=lift_secret)
    verifier = Verifier(contract, source, rotation=rotation)
    name = level or contract.default_level
    operating = contract.calibration("p2s", level=name).level(name)

    people = [one.subject for one in scored.presentations]
    live = np.array([one.species is None for one in scored.presentations])
    matched = np.zeros(len(people), np.bool_)
    tried = np.zeros(len(people), np.bool_)
    left_out: list[str] = []
    enrolled = 0
    for subject in sorted({person for person in people if person is not None}):
        of_subject = np.array([person == subject for person in people])
        usable = np.flatnonzero(of_subject & live & scored.acquired)
        if len(usable) < ENROLLED_PHOTOS:
            left_out.append(subject)
            continue
        chosen = usable[np.linspace(0, len(usable) - 1, ENROLLED_PHOTOS).round().astype(int)]
        try:
            template = enroller.from_embeddings(scored.embeddings[chosen])
        except InconsistentImages:
            left_out.append(subject)
            continue
        enrolled += 1
        for row in np.setdiff1d(np.flatnonzero(of_subject), chosen):
            tried[row] = True
            if scored.acquired[row]:
                embedding = scored.embeddings[row]
                matched[row] = verifier.decide_embedding(embedding, template, level=name).accepted
    return VerifiedSet(
        scored=scored,
        matched=matched,
        tried=tried,
        level=name,
        target_fmr=operating.target_fmr,
        enrolled_photos=ENROLLED_PHOTOS,
        enrolled=enrolled,
        left_out=tuple(left_out),
    )
