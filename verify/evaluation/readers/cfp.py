"""The CFP folder: Celebrities in Frontal-Profile, as the two sets FF and FP."""

import posixpath
from collections.abc import Sequence
from pathlib import Path

from models.extraction import Photo
from verify.datasets import DatasetError
from verify.evaluation.readers.reader import (
    ProtocolText,
    Reader,
    Trial,
    assemble,
    keys_of,
    read_text,
)
from verify.evaluation.verification_set import VerificationSet
from verify.tenfold import FOLDS

LIST = "Protocol/Pair_list_{}.txt"
_POSES = {"F": "frontal", "P": "profile"}


def read_cfp(root: Path, pictures: bool) -> list[VerificationSet]:
    """Read both protocols: frontal with frontal (``cfp_ff``), frontal with profile (``cfp_fp``).

    ``Protocol/Pair_list_F.txt`` and ``Pair_list_P.txt`` number the photos from 1, with paths
    relative to ``Protocol/``; ``Protocol/Split/FF|FP/01 … 10/same.txt|diff.txt`` hold ``i,j``
    lines. In FP, i indexes F and j indexes P.

    References
    ----------
    Sengupta et al., "Frontal to Profile Face Verification in the Wild", WACV 2016.
    """
    texts = {letter: read_text(root / LIST.format(letter), root=root) for letter in _POSES}
    lists = {letter: _photo_list(text, letter) for letter, text in texts.items()}
    protocols = {split: _trials(root, split, lists) for split in ("FF", "FP")}
    keys = keys_of(trial for trials, _ in protocols.values() for trial in trials)
    for key in keys if pictures else ():
        if not (root / key).is_file():
            raise DatasetError(f"{root}: the photo {key} of the protocol is not there")
    return [
        assemble(
            f"cfp_{split.lower()}",
            "cfp",
            trials,
            pictures=lambda key: Photo(key, root / key),
            person=_identity,
            protocol_files=[
                *(texts[letter].fingerprint for letter in sorted(set(split))),
                *(text.fingerprint for text in used),
            ],
        )
        for split, (trials, used) in protocols.items()
    ]


def _identity(key: str) -> str:
    return key.split("/")[-3]


def _photo_list(text: ProtocolText, letter: str) -> list[str]:
    """Paths of the photos of one pose, relative to the root, in the order of their numbers."""
    photos: list[str] = []
    for number, line in enumerate(text.text.splitlines(), start=1):
        if not line.strip():
            continue
        index, written = (*line.split(None, 1), "")[:2]
        path = posixpath.normpath(posixpath.join("Protocol", written.strip().replace("\\", "/")))
        parts = path.split("/")
        is_photo = len(parts) > 2 and parts[-2] == _POSES[letter] and parts[0] not in ("", "..")
        if index != str(len(photos) + 1) or not is_photo or not path.isprintable():
            raise DatasetError(
                f"{text.name} line {number} is not of the form: {len(photos) + 1} "
                f"…/identity/{_POSES[letter]}/photo"
            )
        photos.append(path)
    if not photos:
        raise DatasetError(f"{text.name} lists no photo")
    return photos


def _trials(
    root: Path, split: str, lists: dict[str, list[str]]
) -> tuple[list[Trial], list[ProtocolText]]:
    trials: list[Trial] = []
    used: list[ProtocolText] = []
    for fold in range(FOLDS):
        for same, name in ((True, "same.txt"), (False, "diff.txt")):
            folder = root / "Protocol" / "Split" / split / f"{fold + 1:02d}"
            used.append(read_text(folder / name, root=root))
            for number, line in enumerate(used[-1].text.splitlines(), start=1):
                if line.strip():
                    where = f"{used[-1].name} line {number}"
                    first, second = _pair(where, line, [lists[letter] for letter in split])
                    if (_identity(first) == _identity(second)) != same:
                        people = "one person" if same else "two people"
                        both = f"{_identity(first)} and {_identity(second)}"
                        raise DatasetError(f"{where} pairs {both} as {people}")
                    trials.append(Trial(first, second, same, fold))
    return trials, used


def _pair(where: str, line: str, photos: Sequence[Sequence[str]]) -> list[str]:
    indices = [part.strip() for part in line.split(",")]
    if len(indices) != 2 or not all(index.isdecimal() and len(index) < 8 for index in indices):
        raise DatasetError(f"{where} is not of the form i,j")
    for index, side in zip(indices, photos, strict=True):
        if not 1 <= int(index) <= len(side):
            raise DatasetError(f"{where} has the index {index}; its list has 1 to {len(side)}")
    return [side[int(index) - 1] for index, side in zip(indices, photos, strict=True)]


READER = Reader(
    "a CFP folder (Protocol/ and Data/: name the folder that holds `Protocol/`)",
    lambda path: (path / LIST.format("F")).is_file(),
    read_cfp,
)
