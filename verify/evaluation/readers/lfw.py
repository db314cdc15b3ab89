"""The LFW folder: ``Name/Name_0001.jpg`` and ``pairs.txt``."""

from collections.abc import Sequence
from pathlib import Path

from verify.datasets import SUFFIXES, DatasetError, NamedPair, faults_in, parse_lfw_pairs
from verify.evaluation.readers.assembly import Trial, assemble, photos_of
from verify.evaluation.readers.protocol_files import read_text
from verify.evaluation.verification_set import PictureFile, VerificationSet

PAIRS = "pairs.txt"

Photo = tuple[str, str]


def read_lfw(root: Path, *, pictures: bool = True) -> VerificationSet:
    """Read the ten folds of ``pairs.txt`` (view 2) and find its photos.

    The people's folders lie beside ``pairs.txt`` or in one folder beside it, such as ``lfw/``.

    Raises
    ------
    DatasetError
        The protocol is broken, or photos that it names are absent; all are listed.

    References
    ----------
    Huang, Ramesh, Berg, Learned-Miller, "Labeled Faces in the Wild", UMass TR 07-49, 2007.
    """
    protocol = read_text(root / PAIRS, root=root)
    pairs = parse_lfw_pairs(root / PAIRS, protocol.text)
    unsafe = sorted(
        {
            f"line {pair.line} names the person {person!a}"
            for pair in pairs
            for person in (pair.first[0], pair.second[0])
            if not person.isprintable() or "/" in person or "\\" in person or person in (".", "..")
        }
    )
    if unsafe:
        raise DatasetError(faults_in(root / PAIRS, "expected plain names", unsafe))
    trials = [Trial(_name(one.first), _name(one.second), one.same, one.fold) for one in pairs]
    files = _files(root, pairs, photos_of(trials)) if pictures else {}
    return assemble(
        "lfw",
        "lfw",
        trials,
        picture=lambda key: files.get(key) or PictureFile(f"{key}.jpg", root / f"{key}.jpg"),
        person=lambda key: key.split("/")[0],
        protocol_files=[protocol.fingerprint],
    )


def _name(photo: Photo) -> str:
    return "/".join(photo)


def _files(root: Path, pairs: Sequence[NamedPair], keys: Sequence[str]) -> dict[str, PictureFile]:
    base = _photo_root(root, {pair.first[0] for pair in pairs})
    listed: dict[str, dict[str, list[Path]]] = {}
    pictures: dict[str, PictureFile] = {}
    faults: list[str] = []
    for key in keys:
        person, stem = key.split("/")
        if person not in listed:
            listed[person] = photos_in(base / person)
        candidates = listed[person].get(stem, [])
        if len(candidates) == 1:
            name = candidates[0].relative_to(base).as_posix()
            pictures[key] = PictureFile(name, candidates[0])
        elif candidates:
            faults.append(f"{key} is there {len(candidates)} times with different suffixes")
        else:
            faults.append(f"{key} is not there")
    if faults:
        raise DatasetError(
            faults_in(base, f"expected the photos that {PAIRS} names ({suffixes()})", faults)
        )
    return pictures


def _photo_root(root: Path, people: set[str]) -> Path:
    folders = sorted(one for one in root.iterdir() if one.is_dir() and one.name[0] != ".")
    if any(one.name in people for one in folders):
        return root
    inside = [one for one in folders if any((one / person).is_dir() for person in people)]
    if len(inside) > 1:
        names = ", ".join(one.name for one in inside)
        raise DatasetError(
            f"{root}: the photos of {PAIRS} may lie in {names}; copy {PAIRS} into the one meant"
        )
    return inside[0] if inside else root


def photos_in(folder: Path) -> dict[str, list[Path]]:
    """Photos of a folder by their names without suffix; empty where there is no folder."""
    pictures: dict[str, list[Path]] = {}
    if folder.is_dir():
        for file in sorted(folder.iterdir()):
            if file.suffix.lower() in SUFFIXES and file.is_file():
                pictures.setdefault(file.stem, []).append(file)
    return pictures


def suffixes() -> str:
    """Suffixes of photos, for messages."""
    return ", ".join(sorted(SUFFIXES))
