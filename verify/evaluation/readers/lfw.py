"""The LFW folder: ``Name/Name_0001.jpg`` and ``pairs.txt``."""

from pathlib import Path

from models.extraction import Photo
from verify.datasets import parse_lfw_pairs
from verify.evaluation.readers.reader import (
    Reader,
    assemble,
    keys_of,
    photos_named,
    read_text,
    require_plain_names,
)
from verify.evaluation.verification_set import VerificationSet

PAIRS = "pairs.txt"


def read_lfw(root: Path, pictures: bool) -> list[VerificationSet]:
    """Read the ten folds of ``pairs.txt`` (view 2) and find its photos.

    The people's folders lie beside ``pairs.txt`` or in one folder beside it, such as ``lfw/``.

    References
    ----------
    Huang, Ramesh, Berg, Learned-Miller, "Labeled Faces in the Wild", UMass TR 07-49, 2007.
    """
    protocol = read_text(root / PAIRS, root=root)
    trials = parse_lfw_pairs(root / PAIRS, protocol.text)
    keys = keys_of(trials)
    require_plain_names(root / PAIRS, (part for key in keys for part in key.split("/")))
    people = {key.split("/")[0] for key in keys}
    files = {key: Photo(f"{key}.jpg", root / f"{key}.jpg") for key in keys}
    if pictures:
        base = _photo_root(root, people)
        photos = photos_named(base, keys, protocol=PAIRS)
        files = {
            key: Photo(photo.relative_to(base).as_posix(), photo) for key, photo in photos.items()
        }
    return [
        assemble(
            "lfw",
            "lfw",
            trials,
            pictures=files,
            person=lambda key: key.split("/")[0],
            protocol_files=[protocol.fingerprint],
        )
    ]


def _photo_root(root: Path, people: set[str]) -> Path:
    inside = sorted(one for one in root.iterdir() if one.is_dir() and one.name[0] != ".")
    has_people = (one for one in (root, *inside) if any((one / who).is_dir() for who in people))
    return next(has_people, root)


READER = Reader(
    "an LFW folder (pairs.txt and Name/Name_0001.jpg)",
    lambda path: (path / PAIRS).is_file(),
    read_lfw,
)
