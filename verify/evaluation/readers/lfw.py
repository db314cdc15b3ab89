"""The LFW folder: ``Name/Name_0001.jpg`` and ``pairs.txt``."""

import re
from pathlib import Path

from models.extraction import Photo
from verify.datasets import DatasetError
from verify.evaluation.readers.reader import (
    Reader,
    Trial,
    assemble,
    keys_of,
    photos_named,
    read_text,
    require_plain_names,
)
from verify.evaluation.verification_set import VerificationSet
from verify.tenfold import FOLDS

PAIRS = "pairs.txt"


def read_lfw(root: Path, pictures: bool) -> list[VerificationSet]:
    """Read the ten folds of ``pairs.txt`` (view 2) and find its photos.

    The people's folders lie beside ``pairs.txt`` or in one folder beside it, such as ``lfw/``.

    References
    ----------
    Huang, Ramesh, Berg, Learned-Miller, "Labeled Faces in the Wild", UMass TR 07-49, 2007.
    """
    protocol = read_text(root / PAIRS, root=root)
    trials = parse_pairs(protocol.text)
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


def parse_pairs(text: str) -> list[Trial]:
    """Parse the text of ``pairs.txt``; keys of photos are ``Name/Name_0001``.

    The header is ``folds<TAB>pairs per class and fold``; every fold then has that many lines
    ``Name i j`` of one person and as many lines ``NameA i NameB j`` of two.
    """
    header, *lines = text.rstrip().splitlines() or [""]
    if not (match := re.fullmatch(r"(\d{1,6})\s+(\d{1,6})", header.strip())):
        raise DatasetError(f"{PAIRS} does not begin with: folds, pairs per class and fold")
    folds, per_class = map(int, match.groups())
    if folds != FOLDS or per_class < 1:
        raise DatasetError(f"{PAIRS} has {folds} folds; the protocol has {FOLDS}")
    if len(lines) != 2 * folds * per_class:
        raise DatasetError(f"{PAIRS} promises {2 * folds * per_class} pairs and holds {len(lines)}")
    trials: list[Trial] = []
    for number, line in enumerate(lines):
        fold, place = divmod(number, 2 * per_class)
        same = place < per_class
        parts = line.split("\t") if "\t" in line else line.split()
        fits = len(parts) == (3 if same else 4)
        parts[2:2] = parts[:1] if same else []
        if not fits or not all(re.fullmatch(r"\d{1,6}", part) for part in parts[1::2]):
            form = "Name i j" if same else "NameA i NameB j"
            raise DatasetError(f"{PAIRS} line {number + 2} is not of the form {form}")
        one, other = (
            f"{name}/{name}_{int(photo):04d}"
            for name, photo in zip(parts[::2], parts[1::2], strict=True)
        )
        trials.append(Trial(one, other, same, fold))
    return trials


def _photo_root(root: Path, people: set[str]) -> Path:
    inside = sorted(one for one in root.iterdir() if one.is_dir() and one.name[0] != ".")
    has_people = (one for one in (root, *inside) if any((one / who).is_dir() for who in people))
    return next(has_people, root)


READER = Reader(
    "an LFW folder (pairs.txt and Name/Name_0001.jpg)",
    lambda path: (path / PAIRS).is_file(),
    read_lfw,
)
