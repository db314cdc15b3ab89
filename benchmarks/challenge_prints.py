"""What printed photos that are moved before a camera show of the movements of a challenge.

NUAA has webcam frames of people who were not asked to move, and of printed photos of them that were
moved, turned, tilted and bent. Frames of one sitting, or of one print, are paired: how many pairs
show a movement? How many sets of five? Then ten frames of one person at a time, in random order,
answer a random challenge.

Example
-------
::

    python -m benchmarks.challenge_prints --data ../shared/data
"""

import argparse
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from models.decoding import decode_image
from models.errors import FaceError
from models.head_pose import HeadPose, head_pose
from models.pack import ModelPack
from verify.challenge import FRONT_PITCH, FRONT_YAW, draw_movements, movement_of, movements_failure

FRAMES = 10
STILL = 5
ANSWERS = 200


Poses = dict[str, list[HeadPose]]
PERSON, SITTING = slice(4), slice(18)
"""Of a file's name: who it shows, and when, or on which print."""


def poses_of(pack: ModelPack, folder: Path) -> list[tuple[str, HeadPose]]:
    """Name and pose of the large central face of each frame."""
    poses = []
    for file in sorted(folder.iterdir()):
        faces = pack.detect(decode_image(file.read_bytes()))
        try:
            poses += [(file.name, head_pose(face.keypoints)) for face in faces[:1]]
        except FaceError:
            continue
    return poses


def grouped(poses: list[tuple[str, HeadPose]], by: slice) -> list[list[HeadPose]]:
    """Poses of the frames whose names agree in a part."""
    groups: Poses = defaultdict(list)
    for name, pose in poses:
        groups[name[by]].append(pose)
    return list(groups.values())


def looks_ahead(pose: HeadPose) -> bool:
    """Whether it may be the first frame of an answer."""
    return abs(pose.yaw) <= FRONT_YAW and abs(pose.pitch) <= FRONT_PITCH


def main() -> None:
    """Print one line for live frames and one for prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    pack = ModelPack.load(arguments.data / "packs" / "w600k_mbf", threads=1)
    nuaa = arguments.data / "liveness" / "nuaa"
    rng = np.random.default_rng(0)
    for kind, folder in (("live", nuaa / "live"), ("print", nuaa / "spoof" / "print")):
        poses = poses_of(pack, folder)
        sittings, people = grouped(poses, SITTING), grouped(poses, PERSON)
        shown = Counter(
            str(movement_of(pose, first))
            for own in sittings
            for first in filter(looks_ahead, own)
            for pose in own
            if pose is not first
        )
        pairs = shown.total()
        still = [
            any(movement_of(own[i], own[order[0]]) for i in order[1:])
            for own in sittings
            if len(own) >= STILL
            for _ in range(ANSWERS)
            for order in [rng.permutation(len(own))[:STILL]]
        ]
        answers = Counter(
            str(movements_failure([own[i] for i in rng.permutation(len(own))[:FRAMES]], asked))
            for own in people
            for _ in range(ANSWERS)
            for asked in [draw_movements()]
        )
        print(f"{kind}: {len(poses)} frames, {len(sittings)} sittings, {len(people)} people")
        print(f"  {pairs} pairs that show", {k: f"{n / pairs:.4f}" for k, n in shown.items()})
        print(f"  {len(still)} sets of {STILL} that show any: {np.mean(still):.3f}")
        print("  answers", dict(answers))


if __name__ == "__main__":
    main()
