"""Photos, or the frames of a challenge, to one probe, and whether a living person made them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from models.errors import FaceError, ModelError, PackError, PhotoRejected
from models.faces import FaceCrop
from models.head_pose import HeadPose, head_pose
from models.pack import ModelPack
from models.quality import DEFAULT_QUALITY, QualityLimits
from models.relief import details_of, shows_relief
from models.selection import FacePolicy
from templates.contract.document import Contract
from templates.errors import Uncalibrated
from templates.space.agreement import InconsistentImages, distinct_rows, mean_embedding
from templates.space.embedding import unit_rows
from verify.challenge import (
    LivenessFailure,
    Movement,
    frontal_frames,
    movement_of,
    movements_failure,
)

MAX_PROBE_PHOTOS = 5
"""Photos, or embeddings, that one probe may be the mean of."""

MOVING = QualityLimits(
    min_score=0.0,
    min_sharpness=0.0,
    min_brightness=0.0,
    max_brightness=255.0,
    min_exposure=0.0,
    max_yaw=90.0,
    max_pitch=90.0,
    max_roll=180.0,
)
"""What every frame must reach; those that are compared must reach the limits of photos too."""

MOVING_SHARPNESS = 0.4
"""Sharpness of a frame that moves over that of the first: blur would hide that a face is flat."""


@dataclass(frozen=True, eq=False)
class PhotoProbe:
    """What photos or frames come to."""

    embedding: NDArray[np.float32] = field(repr=False)  # (n,) unit mean; of frames that look ahead
    photos: int  # how many these are; one that was given twice counts once
    failure: LivenessFailure | None  # why they are not taken for a living person's
    clear: bool  # nothing seems to cover the face in any of them


def probe_of_photos(
    pack: ModelPack,
    contract: Contract,
    photos: Sequence[bytes],
    *,
    passive: bool,
    policy: FacePolicy = FacePolicy.DOMINANT,
) -> PhotoProbe:
    """Average photos of one person; with `passive`, say whether they look live on average.

    Raises
    ------
    PhotoRejected
        Where one photo has no usable face.
    InconsistentImages
        Where the photos do not show one person.
    """
    samples = pack.embed_photos(photos, policy=policy, liveness=passive)
    rows = np.stack([sample.embedding for sample in samples])
    mean = mean_embedding(rows, consistency=contract.probe_consistency)
    distinct = [samples[place] for place in distinct_rows(rows)]
    scores = [sample.liveness for sample in distinct if sample.liveness is not None]
    failure = passive_failure(contract, scores) if passive else None
    clear = all(pack.is_clear(sample.quality) for sample in distinct)
    return PhotoProbe(mean, len(distinct), failure, clear)


def probe_of_embeddings(contract: Contract, embeddings: NDArray[np.floating]) -> PhotoProbe:
    """Average 1 to 5 unit embeddings of one person, (k, n), that a client made of photos."""
    rows = unit_rows(embeddings, n=contract.binding.n, most=MAX_PROBE_PHOTOS)
    mean = mean_embedding(rows, consistency=contract.probe_consistency)
    return PhotoProbe(mean, len(distinct_rows(rows)), failure=None, clear=True)


def probe_of_frames(
    pack: ModelPack,
    contract: Contract,
    frames: Sequence[bytes],
    movements: Sequence[Movement],
    *,
    passive: bool,
    policy: FacePolicy = FacePolicy.DOMINANT,
) -> PhotoProbe:
    """Make one probe of the frames of a challenge, and hold them against it.

    The first frames that look ahead are averaged; every frame must show the same person, by the
    limit for photos of one probe. A failure is no error: the probe is compared all the same, so
    that both take the same time.

    Raises
    ------
    PhotoRejected
        Where a frame has no usable face, or the first one is not good enough to be compared.
    """
    read = [
        _read(pack, frame, place, len(frames), passive=passive, policy=policy)
        for place, frame in enumerate(frames)
    ]
    poses = [pose for _, pose in read]
    faces = [face for face, _ in read]
    ahead = [
        place for place in frontal_frames(poses) if place == 0 or _is_good(pack, faces[place])
    ][:MAX_PROBE_PHOTOS]
    # All before they are joined: the time would tell which one failed.
    flat = _flat_frames(faces, poses)
    failures: list[LivenessFailure | None] = [movements_failure(poses, movements, flat=flat)]
    if passive:
        scores = [faces[place].liveness for place in ahead]
        failures.append(passive_failure(contract, [s for s in scores if s is not None]))
    embeddings = pack.embed(np.stack([face.crop for face in faces]))
    consistency = contract.probe_consistency
    try:
        mean = mean_embedding(embeddings[ahead], consistency=consistency)
        photos = len(distinct_rows(embeddings[ahead]))
        one_person = float((embeddings @ mean).min()) >= consistency
    except InconsistentImages:
        mean, photos, one_person = embeddings[0], 1, False
    # First: of two people's faces no details match, so that none seems to move.
    failures.insert(0, None if one_person else LivenessFailure.ANOTHER_PERSON)
    failure = next((why for why in failures if why is not None), None)
    return PhotoProbe(mean, photos, failure, all(pack.is_clear(faces[i].quality) for i in ahead))


def passive_failure(contract: Contract, scores: Sequence[float]) -> LivenessFailure | None:
    """Say whether photos fall below the contract's liveness threshold, by their mean score."""
    if contract.liveness is None or not scores:
        raise Uncalibrated("the contract has no liveness threshold")
    live = contract.liveness.is_live(float(np.mean(scores)))
    return None if live else LivenessFailure.PASSIVE


def _read(
    pack: ModelPack,
    data: bytes,
    place: int,
    count: int,
    *,
    passive: bool,
    policy: FacePolicy,
) -> tuple[FaceCrop, HeadPose]:
    """Read one frame, and drop its picture; the first one must be good enough to be compared."""
    quality = DEFAULT_QUALITY if place == 0 else MOVING
    try:
        taken = pack.crop_photo(data, policy=policy, quality=quality, liveness=passive)
        if taken.face is None:
            raise PackError("A challenge needs a pack with a detector.")
        return taken, head_pose(taken.face.keypoints)
    except ModelError as error:
        raise PhotoRejected(place, error, count=count) from error


def _flat_frames(faces: Sequence[FaceCrop], poses: Sequence[HeadPose]) -> set[int]:
    """Places of the frames that turn by their points, and whose faces a flat picture may be.

    So is every face that is too blurred to tell.
    """
    first, sharp = details_of(faces[0].crop), MOVING_SHARPNESS * faces[0].quality.sharpness
    return {
        place
        for place, (face, pose) in enumerate(zip(faces, poses, strict=True))
        if movement_of(pose, poses[0], near=True) is not None
        and (face.quality.sharpness < sharp or not shows_relief(first, details_of(face.crop)))
    }


def _is_good(pack: ModelPack, face: FaceCrop) -> bool:
    """Whether the face of a frame is good enough to be compared, as one of a photo must be."""
    try:
        pack.require_quality(face)
    except FaceError:
        return False
    return True
