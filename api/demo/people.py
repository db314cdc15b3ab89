"""Who plays in the demo: drawn people, or real ones from a folder."""

from dataclasses import dataclass
from pathlib import Path

from api.http.errors import StartError
from api.http.routes.drawn_people import ENROLLED, ENROLLED_PHOTOS, PROBE_PHOTOS, STRANGERS
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
    """Who plays which part: photo files, by person.

    ``face`` is what a photo with several faces means: labelled photos of the press show
    bystanders, so real ones are taken as showing the largest.
    """

    enrolled: dict[str, list[Path]]
    strangers: dict[str, Path]
    face: str = "dominant"


def drawn_cast(folder: Path, scratch: Path, size: Scale) -> tuple[Cast, list[Path], LabelledFolder]:
    """Draw everybody; the seeds of those four groups are disjoint."""

    def draw(root: Path, first: int, people: int, photos: int) -> dict[str, list[Path]]:
        drawn: dict[str, list[Path]] = {}
        for seed in range(first, first + people):
            name = f"person-{seed}"
            (root / name).mkdir(parents=True)
            drawn[name] = [root / name / f"{photo}.png" for photo in range(photos)]
            for photo, path in enumerate(drawn[name]):
                path.write_bytes(encode_photo(draw_face(seed, photo)))
        return drawn

    enrolled = draw(folder, ENROLLED.start, size.enrolled, ENROLLED_PHOTOS + PROBE_PHOTOS)
    strangers = draw(folder, STRANGERS.start, size.strangers, 1)
    decoys = draw(scratch / "decoys", 100_000, size.decoy_people, 1)
    draw(scratch / "faces", 200_000, size.calibration_people, size.calibration_photos)
    return (
        Cast(enrolled, {name: photos[0] for name, photos in strangers.items()}),
        [photos[0] for photos in decoys.values()],
        labelled_folder(scratch / "faces"),
    )


def found_cast(faces: Path, size: Scale) -> tuple[Cast, list[Path], LabelledFolder]:
    """Share out real people: enrolled, strangers, then half for decoys, half for calibration."""
    labelled = labelled_folder(faces)
    photos_of: dict[str, list[Path]] = {}
    for path, name in zip(labelled.paths, labelled.identities, strict=True):
        photos_of.setdefault(name, []).append(path)
    needed = ENROLLED_PHOTOS + PROBE_PHOTOS
    able = [name for name, photos in photos_of.items() if len(photos) >= needed][: size.enrolled]
    if len(able) < size.enrolled:
        raise StartError(
            f"{faces} has {len(able)} people with {needed} photos or more; the demo enrolls "
            f"{size.enrolled}"
        )
    rest = [name for name in photos_of if name not in set(able)]
    strangers, rest = rest[: size.strangers], rest[size.strangers :]
    for_decoys, for_calibration = set(rest[::2]), set(rest[1::2])
    kept = [
        (path, name)
        for path, name in zip(labelled.paths, labelled.identities, strict=True)
        if name in for_calibration
    ]
    if not kept:
        raise StartError(f"{faces} has too few people to calibrate on; 80 or more are good")
    return (
        Cast(
            {name: photos_of[name][:needed] for name in able},
            {name: photos_of[name][0] for name in strangers},
            face="largest",
        ),
        [path for name in rest if name in for_decoys for path in photos_of[name]],
        LabelledFolder(
            labelled.root,
            tuple(path for path, _ in kept),
            tuple(name for _, name in kept),
            labelled.ignored,
        ),
    )
