"""Readers of labelled face folders: ``root/Person/photo.jpg``, as LFW is laid out."""

import hashlib
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from templates.errors import VeilfaceError
from templates.keys.private_file import read_at_most
from verify.tenfold import FOLDS, Pair

SUFFIXES = frozenset({".jpg", ".jpeg", ".jfif", ".png", ".webp", ".bmp"})
MAX_PAIRS_BYTES = 16 * 2**20
_MOST_SHOWN = 20


class DatasetError(VeilfaceError):
    """A data set that is not laid out as its reader expects; the message lists what is wrong."""


@dataclass(frozen=True)
class LabelledFolder:
    """Photos with the names of the people on them.

    Parameters
    ----------
    paths, identities
        Equal lengths, sorted by person and file name.
    ignored
        What lay beside and was no photo, relative to ``root``.
    """

    root: Path
    paths: tuple[Path, ...]
    identities: tuple[str, ...]
    ignored: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def people(self) -> int:
        """Number of different names."""
        return len(set(self.identities))


def visible(folder: Path) -> list[Path]:
    """Return what lies in a folder, sorted; hidden entries and those of file servers are left out.

    A NAS puts its thumbnails into ``@eaDir``, an archive of macOS its attributes into ``__MACOSX``.
    """
    return sorted(
        entry
        for entry in folder.iterdir()
        if not entry.name.startswith(".") and entry.name not in ("@eaDir", "__MACOSX")
    )


def is_photo(file: Path) -> bool:
    """Whether a file has the suffix of a picture that is read."""
    return file.suffix.lower() in SUFFIXES and file.is_file()


def labelled_folder(root: Path | str) -> LabelledFolder:
    """List ``root/Person/photo.jpg``; photos are not opened here.

    What else is :func:`visible`, such as ``pairs.txt`` or a photo beside the people's folders, is
    listed in ``ignored``.

    Raises
    ------
    DatasetError
        There is no folder, or no photo in a person's folder.
    """
    folder = Path(root)
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder; expected root/Person/photo.jpg")
    paths: list[Path] = []
    identities: list[str] = []
    ignored: list[str] = []
    for entry in visible(folder):
        if not entry.is_dir():
            ignored.append(entry.name)
            continue
        content = visible(entry)
        photos = [file for file in content if is_photo(file)]
        paths += photos
        identities += [entry.name] * len(photos)
        others = [f"{entry.name}/{file.name}" for file in content if file not in photos]
        ignored += others if content else [f"{entry.name} (empty)"]
    if not paths:
        inner = [entry for entry in visible(folder) if entry.is_dir() and _has_people(entry)]
        remedy = f"give {inner[0]}" if inner else f"a photo ends in {', '.join(sorted(SUFFIXES))}"
        raise DatasetError(
            f"{folder} has no photo in a person's folder, expected root/Person/photo.jpg: {remedy}"
        )
    return LabelledFolder(folder, tuple(paths), tuple(identities), tuple(ignored))


def photos_alone(root: Path, photos: Sequence[Path]) -> LabelledFolder:
    """Take each of some photos for a person of its own: of faces that nobody labelled."""
    paths = tuple(sorted(photos))
    return LabelledFolder(root, paths, tuple(str(path.relative_to(root)) for path in paths), ())


def _has_people(folder: Path) -> bool:
    return any(
        is_photo(file) for entry in visible(folder) if entry.is_dir() for file in visible(entry)
    )


def distinct_files(files: Sequence[Path]) -> list[Path]:
    """Return the files without those whose content an earlier one has.

    Only files of one size are read.
    """
    sizes = [file.stat().st_size for file in files]
    shared = {size for size, count in Counter(sizes).items() if count > 1}
    distinct: dict[tuple[int, str], Path] = {}
    for file, size in zip(files, sizes, strict=True):
        content = ""
        if size in shared:
            with file.open("rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
        distinct.setdefault((size, content), file)
    return list(distinct.values())


@dataclass(frozen=True)
class NamedPair:
    """One line of LFW's ``pairs.txt``: person and file stem of both photos."""

    first: tuple[str, str]
    second: tuple[str, str]
    same: bool
    fold: int
    line: int


def read_lfw_pairs(
    file: Path | str, paths: Sequence[Path], *, missing: Collection[Path] = ()
) -> list[Pair]:
    """Read LFW's ``pairs.txt`` into positions in ``paths``.

    Parameters
    ----------
    paths
        Photos with a descriptor, in its order; ``Name/Name_0001.jpg``.
    missing
        Photos of the same folder without a descriptor; pairs that need one are left out. The
        caller reports them as failures to acquire.

    Raises
    ------
    DatasetError
        Listing every faulty line.
    """
    path = Path(file)
    text = decoded(read_whole(path, most=MAX_PAIRS_BYTES), file=path)
    index = {(entry.parent.name, entry.stem): number for number, entry in enumerate(paths)}
    gone = {(entry.parent.name, entry.stem) for entry in missing}
    pairs: list[Pair] = []
    faults: list[str] = []
    for named in parse_lfw_pairs(path, text):
        keys = (named.first, named.second)
        if any(key in gone for key in keys):
            continue
        if all(key in index for key in keys):
            pairs.append(Pair(index[keys[0]], index[keys[1]], named.same, named.fold))
        else:
            absent = next(key for key in keys if key not in index)
            faults.append(f"line {named.line} names {absent[0]}/{absent[1]}, which is not there")
    if faults:
        raise DatasetError(faults_in(path, "expected LFW's pairs format", faults))
    return pairs


def parse_lfw_pairs(path: Path, text: str) -> list[NamedPair]:
    """Parse the text of LFW's ``pairs.txt``; ``path`` is for messages only.

    The header is ``folds<TAB>pairs per class and fold``; every fold then has that many lines
    ``Name i j`` of one person and as many lines ``NameA i NameB j`` of two.

    Raises
    ------
    DatasetError
        Listing every faulty line.
    """
    lines = text.splitlines()
    folds, per_class = _header(path, lines)
    promised = 2 * folds * per_class
    while lines and not lines[-1].strip():
        lines.pop()
    if len(lines) - 1 != promised:
        raise DatasetError(f"{path.name} promises {promised} pairs and holds {len(lines) - 1}")
    pairs: list[NamedPair] = []
    faults: list[str] = []
    for number, line in enumerate(lines[1:]):
        fold, place = divmod(number, 2 * per_class)
        same = place < per_class
        keys = _photo_keys(line, same=same)
        if keys is None:
            form = "Name i j" if same else "NameA i NameB j"
            faults.append(f"line {number + 2} is not of the form {form}")
        else:
            pairs.append(NamedPair(*keys, same=same, fold=fold, line=number + 2))
    if faults:
        raise DatasetError(faults_in(path, "expected LFW's pairs format", faults))
    return pairs


def _header(path: Path, lines: Sequence[str]) -> tuple[int, int]:
    numbers = lines[0].split() if lines else []
    if len(numbers) != 2 or not all(number.isdecimal() and len(number) < 7 for number in numbers):
        raise DatasetError(f"{path.name} does not begin with: folds, pairs per class and fold")
    folds, per_class = map(int, numbers)
    if folds != FOLDS or per_class < 1:
        raise DatasetError(f"{path.name} has {folds} folds; the protocol has {FOLDS}")
    return folds, per_class


def _photo_keys(line: str, *, same: bool) -> tuple[tuple[str, str], tuple[str, str]] | None:
    """Person and file stem of both photos, or None where the line has another form."""
    parts = line.split("\t") if "\t" in line else line.split()
    if len(parts) != (3 if same else 4):
        return None
    first, i, *rest = parts
    second, j = (first, rest[0]) if same else (rest[0], rest[1])
    if not all(number.isdecimal() and len(number) < 7 for number in (i, j)):
        return None
    return (first, f"{first}_{int(i):04d}"), (second, f"{second}_{int(j):04d}")


def read_whole(file: Path, *, most: int) -> bytes:
    """Read a file of at most ``most`` bytes.

    Raises
    ------
    DatasetError
        The file is larger, or cannot be read.
    """
    try:
        if not file.is_file():
            raise DatasetError(f"{file} is not there")
        with file.open("rb") as stream:
            data = read_at_most(stream, most)
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror}") from None
    except MemoryError:
        raise DatasetError(f"{file} is larger than the memory of this machine") from None
    if len(data) > most:
        raise DatasetError(f"{file} is larger than {most} bytes")
    return data


def decoded(data: bytes, *, file: Path) -> str:
    """Decode UTF-8, with or without a byte-order mark; ``file`` is for messages only.

    Raises
    ------
    DatasetError
        It is other text, or none.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{file} is not UTF-8 text; save it as UTF-8") from None


def faults_in(where: Path, expected: str, faults: Sequence[str]) -> str:
    """Word the message of a :class:`DatasetError`: the first faults, and how many more."""
    shown = "; ".join(faults[:_MOST_SHOWN])
    more = f"; and {len(faults) - _MOST_SHOWN} more" if len(faults) > _MOST_SHOWN else ""
    count = f"{len(faults)} fault{'s' if len(faults) > 1 else ''}"
    return f"{where} has {count}, {expected}: {shown}{more}"
