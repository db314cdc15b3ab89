"""Who plays in the demo: drawn people, or real ones from a folder."""

from dataclasses import dataclass
from pathlib import Path

from api.http.errors import StartError
from api.http.routes.drawn_people import ENROLLED, ENROLLED_PHOTOS, SHOTS, STRANGERS
from models.synthetic import draw_face, encode_photo
from verify import LabelledFolder, labelled_folder


@dataclass(frozen=True)
class Scale:
    """How many people and photos the demo uses."""

    enrolled: int = len(ENROLLED)
    strangers: int = len(STRANGERS)
    decoy_people: int = 600
    calibration_people: int = 100
    calibration_photos: int = 4


@dataclass(frozen=True)
class Cast:
    """Photo files of those who are enrolled, of strangers, for decoys and for the calibration.

    ``face`` is what a photo with several faces means: labelled photos of the press show
    bystanders, so real ones are taken as showing the largest.
    """

    enrolled: dict[str, list[Path]]
    strangers: list[Path]
    decoys: list[Path]
    calibration: LabelledFolder
    face: str = "dominant"

    def probes(self, name: str) -> list[Path]:
        """Photos of an enrolled person that the enrollment does not use."""
        return self.enrolled[name][ENROLLED_PHOTOS:SHOTS]


def drawn_cast(folder: Path, scratch: Path, size: Scale) -> Cast:
    """Draw everybody; the seeds of the four groups are disjoint."""

    def draw(root: Path, first: int, people: int, photos: int) -> dict[str, list[Path]]:
        drawn: dict[str, list[Path]] = {}
        for seed in range(first, first + people):
            name = f"person-{seed}"
            (root / name).mkdir(parents=True)
            drawn[name] = [root / name / f"{photo}.png" for photo in range(photos)]
            for photo, path in enumerate(drawn[name]):
                path.write_bytes(encode_photo(draw_face(seed, photo)))
        return drawn

    draw(scratch / "faces", 200_000, size.calibration_people, size.calibration_photos)
    strangers = draw(folder, STRANGERS.start, size.strangers, 1)
    decoys = draw(scratch / "decoys", 100_000, size.decoy_people, 1)
    return Cast(
        draw(folder, ENROLLED.start, size.enrolled, SHOTS),
        [photos[0] for photos in strangers.values()],
        [photos[0] for photos in decoys.values()],
        labelled_folder(scratch / "faces"),
    )


def found_cast(faces: Path, size: Scale) -> Cast:
    """Share out real people: enrolled, strangers, then half for decoys, half for calibration."""
    labelled = labelled_folder(faces)
    photos_of: dict[str, list[Path]] = {}
    for path, name in zip(labelled.paths, labelled.identities, strict=True):
        photos_of.setdefault(name, []).append(path)
    able = [name for name, photos in photos_of.items() if len(photos) >= SHOTS][: size.enrolled]
    rest = [name for name in photos_of if name not in able]
    strangers, rest = rest[: size.strangers], rest[size.strangers :]
    calibrated = [(path, name) for name in rest[1::2] for path in photos_of[name]]
    if len(able) < size.enrolled or not calibrated:
        raise StartError(
            f"{faces} has too few people: {size.enrolled} with {SHOTS} photos or more are enrolled "
            "in the demo, and it calibrates on others, of whom 80 or more are good"
        )
    paths, names = zip(*calibrated, strict=True)
    return Cast(
        {name: photos_of[name][:SHOTS] for name in able},
        [photos_of[name][0] for name in strangers],
        [path for name in rest[::2] for path in photos_of[name]],
        LabelledFolder(labelled.root, paths, names, labelled.ignored),
        face="largest",
    )
