"""The CFP folder: Celebrities in Frontal-Profile, as the two sets FF and FP."""

import posixpath
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from verify.datasets import DatasetError, faults_in
from verify.evaluation.readers.assembly import Trial, assemble, photos_of
from verify.evaluation.readers.protocol_files import ProtocolText, read_text
from verify.evaluation.verification_set import PictureFile, VerificationSet
from verify.tenfold import FOLDS

LIST = "Protocol/Pair_list_{}.txt"
_POSES = {"F": "frontal", "P": "profile"}
_MOST_FOLDERS = 50_000
_DEEPEST = 5


@dataclass(frozen=True)
class _Photo:
    """Path relative to the root of the set, as the protocol has it."""

    path: str

    @property
    def identity(self) -> str:
        return self.path.split("/")[-3]

    @property
    def tail(self) -> str:
        return "/".join(self.path.split("/")[-2:])


_List = Mapping[int, _Photo]


def read_cfp(root: Path, *, pictures: bool = True) -> list[VerificationSet]:
    """Read both protocols: frontal with frontal (``cfp_ff``), frontal with profile (``cfp_fp``).

    ``Protocol/Pair_list_F.txt`` and ``Pair_list_P.txt`` number the photos from 1, with paths
    relative to ``Protocol/``; ``Protocol/Split/FF|FP/01 … 10/same.txt|diff.txt`` hold ``i,j``
    lines. In FP, i indexes F and j indexes P. A photo that is not at the protocol's path is
    looked for by ``identity/pose/number`` below the root, as in copies that split the identities
    into ``train/`` and ``test/``.

    Raises
    ------
    DatasetError
        Listing every broken line and every photo that is absent or found twice.

    References
    ----------
    Sengupta et al., "Frontal to Profile Face Verification in the Wild", WACV 2016.
    """
    lists: dict[str, _List] = {}
    texts: dict[str, ProtocolText] = {}
    faults: list[str] = []
    for letter in _POSES:
        texts[letter] = read_text(root / LIST.format(letter), root=root)
        lists[letter] = _photo_list(texts[letter], letter, faults)
    if faults:
        raise DatasetError(faults_in(root, "expected CFP's photo lists", faults))
    protocols = {split: _trials(root, split, lists, faults) for split in ("FF", "FP")}
    if faults:
        raise DatasetError(faults_in(root, "expected CFP's protocol", faults))
    everything = [trial for trials, _ in protocols.values() for trial in trials]
    files = _files(root, photos_of(everything)) if pictures else {}
    return [
        assemble(
            f"cfp_{split.lower()}",
            "cfp",
            trials,
            picture=lambda key: files.get(key) or PictureFile(key, root / key),
            person=lambda key: _Photo(key).identity,
            protocol_files=[
                *(texts[letter].fingerprint for letter in sorted(set(split))),
                *(text.fingerprint for text in used),
            ],
        )
        for split, (trials, used) in protocols.items()
    ]


def _photo_list(text: ProtocolText, letter: str, faults: list[str]) -> _List:
    photos: dict[int, _Photo] = {}
    for number, line in enumerate(text.text.splitlines(), start=1):
        if not line.strip():
            continue
        index, written = [*line.split(None, 1), ""][:2]
        written = written.strip()
        path = posixpath.normpath(posixpath.join("Protocol", written.replace("\\", "/")))
        parts = path.split("/")
        where = f"{text.name} line {number}"
        if not _is_index(index) or not written or not path.isprintable():
            faults.append(f"{where} is not of the form: index path")
        elif len(parts) < 3 or parts[-2] != _POSES[letter] or path[0] == "/" or parts[0] == "..":
            faults.append(f"{where} names no photo of the form identity/{_POSES[letter]}/photo")
        elif int(index) in photos:
            faults.append(f"{where} repeats the index {int(index)}")
        else:
            photos[int(index)] = _Photo(path)
    if set(photos) != set(range(1, len(photos) + 1)):
        absent = next(i for i in range(1, len(photos) + 2) if i not in photos)
        faults.append(f"{text.name} has no index {absent}; indices run from 1 without gaps")
    elif not photos:
        faults.append(f"{text.name} lists no photo")
    return photos


def _trials(
    root: Path, split: str, lists: Mapping[str, _List], faults: list[str]
) -> tuple[list[Trial], list[ProtocolText]]:
    trials: list[Trial] = []
    used: list[ProtocolText] = []
    for fold in range(FOLDS):
        for same, name in ((True, "same.txt"), (False, "diff.txt")):
            file = root / "Protocol" / "Split" / split / f"{fold + 1:02d}" / name
            try:
                text = read_text(file, root=root)
            except DatasetError as error:
                faults.append(str(error))
                continue
            used.append(text)
            for number, line in enumerate(text.text.splitlines(), start=1):
                if line.strip():
                    pair = _pair(line, split, lists, same=same)
                    if isinstance(pair, str):
                        faults.append(f"{text.name} line {number} {pair}")
                    else:
                        trials.append(Trial(pair[0].path, pair[1].path, same, fold))
    return trials, used


def _pair(
    line: str, split: str, lists: Mapping[str, _List], *, same: bool
) -> tuple[_Photo, _Photo] | str:
    """Both photos of a line, or what is wrong with it."""
    indices = [part.strip() for part in line.split(",")]
    if len(indices) != 2 or not all(map(_is_index, indices)):
        return "is not of the form i,j"
    photos: list[_Photo] = []
    for letter, index in zip(split, indices, strict=True):
        photo = lists[letter].get(int(index))
        if photo is None:
            return f"has the index {int(index)}; {letter} has 1 to {len(lists[letter])}"
        photos.append(photo)
    first, second = photos
    if (first.identity == second.identity) != same:
        both = f"{first.identity} and {second.identity}"
        return f"pairs {both} as {'one person' if same else 'two people'}"
    return first, second


def _is_index(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 8


def _files(root: Path, keys: Sequence[str]) -> dict[str, PictureFile]:
    pictures = {key: PictureFile(key, root / key) for key in keys if (root / key).is_file()}
    absent = [_Photo(key) for key in keys if key not in pictures]
    if not absent:
        return pictures
    folders = _identity_folders(root, {photo.identity for photo in absent})
    faults: list[str] = []
    for photo in absent:
        candidates = [
            folder / photo.tail
            for folder in folders.get(photo.identity, [])
            if (folder / photo.tail).is_file()
        ]
        shown = [one.relative_to(root).as_posix() for one in candidates]
        if len(candidates) == 1:
            pictures[photo.path] = PictureFile(shown[0], candidates[0])
        elif candidates:
            faults.append(f"{photo.path} may be {' or '.join(shown[:3])}")
        elif photo.identity in folders:
            faults.append(f"{photo.path} is not there")
        else:
            faults.append(f"{photo.path} is not there, nor any folder {photo.identity} of photos")
    if faults:
        raise DatasetError(
            faults_in(root, "expected each photo of the protocol once below it", faults)
        )
    return pictures


def _identity_folders(root: Path, identities: set[str]) -> dict[str, list[Path]]:
    """Folders named as an identity that hold a pose, wherever they lie below ``root``."""
    folders: dict[str, list[Path]] = {}
    level = [root]
    seen = 0
    for _ in range(_DEEPEST):
        below: list[Path] = []
        for folder in level:
            for entry in sorted(folder.iterdir()):
                if entry.name.startswith(".") or entry.is_symlink() or not entry.is_dir():
                    continue
                seen += 1
                if seen > _MOST_FOLDERS:
                    raise DatasetError(
                        f"{root} holds more than {_MOST_FOLDERS} folders: no copy of CFP"
                    )
                if any((entry / pose).is_dir() for pose in _POSES.values()):
                    if entry.name in identities:
                        folders.setdefault(entry.name, []).append(entry)
                else:
                    below.append(entry)
        level = below
    return folders
