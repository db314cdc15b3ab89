"""Labelled face folders, ``root/Person/photo.jpg`` as LFW is laid out, and tables as CSV."""

import csv
import hashlib
import io
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from templates.errors import VeilfaceError
from templates.keys.private_file import read_bounded

SUFFIXES = frozenset({".jpg", ".jpeg", ".jfif", ".png", ".webp", ".bmp"})
MAX_PAIRS_BYTES = 16 * 2**20


class DatasetError(VeilfaceError):
    """A data set that is not laid out as its reader expects; the message names the first fault."""


@dataclass(frozen=True)
class LabelledFolder:
    """Photos with the names of the people on them."""

    root: Path
    paths: tuple[Path, ...]
    identities: tuple[str, ...]
    ignored: tuple[str, ...]
    excluded: int = 0  # photos, by `without`

    def __len__(self) -> int:
        return len(self.paths)

    def without(self, names: Collection[str]) -> "LabelledFolder":
        """Leave people out by their names, and photos by their paths below ``root``."""
        albums = {
            name: [path for path in album if not is_named(path, self.root, names)]
            for name, album in self.albums.items()
        }
        kept = self.with_albums(albums)
        return replace(kept, excluded=len(self) - len(kept))

    @property
    def people(self) -> int:
        """Number of different names."""
        return len(set(self.identities))

    @property
    def albums(self) -> dict[str, list[Path]]:
        """Photos by the name of their person."""
        albums: dict[str, list[Path]] = {}
        for path, name in zip(self.paths, self.identities, strict=True):
            albums.setdefault(name, []).append(path)
        return albums

    def with_albums(self, albums: Mapping[str, Sequence[Path]]) -> "LabelledFolder":
        """Return the folder with these photos of these people."""
        pairs = [(path, name) for name, album in albums.items() for path in album]
        return replace(
            self, paths=tuple(p for p, _ in pairs), identities=tuple(n for _, n in pairs)
        )


def visible(folder: Path) -> list[Path]:
    """Return what lies in a folder, sorted; hidden entries and those of file servers are left out.

    A NAS puts its thumbnails into ``@eaDir``, an archive of macOS its attributes into ``__MACOSX``.
    """
    return sorted(
        entry
        for entry in folder.iterdir()
        if not entry.name.startswith(".") and entry.name not in ("@eaDir", "__MACOSX")
    )


def is_named(photo: Path, folder: Path, names: Collection[str]) -> bool:
    """Whether a photo of the folder, or a person whose folder it is in, has one of the names."""
    relative = photo.relative_to(folder)
    return not {relative.as_posix(), *relative.parts[:-1]}.isdisjoint(names)


def is_photo(file: Path) -> bool:
    """Whether a file has the suffix of a picture that is read."""
    return file.suffix.lower() in SUFFIXES and file.is_file()


def labelled_folder(root: Path | str) -> LabelledFolder:
    """List ``root/Person/photo.jpg``; photos are not opened here.

    What else is :func:`visible`, such as ``pairs.txt`` or a photo beside the people's folders, is
    listed in ``ignored``.
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


def read_whole(file: Path, *, most: int) -> bytes:
    """Read a file of at most ``most`` bytes."""
    try:
        if not file.is_file():
            raise DatasetError(f"{file} is not there")
        return read_bounded(file, most)
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror}") from None
    except MemoryError:
        raise DatasetError(f"{file} is larger than the memory of this machine") from None


def decoded(data: bytes, *, file: Path) -> str:
    """Decode UTF-8, with or without a byte-order mark; ``file`` is for messages only."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{file} is not UTF-8 text; save it as UTF-8") from None


def csv_rows(
    file: Path,
    text: str,
    *,
    required: Collection[str],
    optional: Collection[str] | None = None,
) -> list[tuple[str, dict[str, str]]]:
    """Read a table whose columns go by their names, in any case and order."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows = []
    try:
        header = [cell.strip().lower() for cell in next(reader, [])]
        if fault := _fault_of_header(header, required, optional):
            raise DatasetError(f"{file}: line 1 {fault}")
        for cells in reader:
            if any(cell.strip() for cell in cells):
                where = f"{file}: line {reader.line_num}"
                if len(cells) != len(header):
                    raise DatasetError(f"{where} has {len(cells)} cells, not {len(header)}")
                row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
                rows.append((where, row))
    except csv.Error as error:
        raise DatasetError(f"{file}: line {reader.line_num} is not CSV ({error})") from None
    return rows


def _fault_of_header(
    header: Sequence[str], required: Collection[str], optional: Collection[str] | None
) -> str | None:
    expected = ",".join([*required, *(f"[{name}]" for name in optional or ())])
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        return "separates its cells by semicolons or tabs; save it with commas"
    if absent := [name for name in required if name not in header]:
        return f"has no column {absent[0]}; expected {expected}"
    unknown = [name for name in header if name not in (*required, *(optional or ()))]
    if optional is not None and unknown:
        return f"has the unknown column {unknown[0]!a}; expected {expected}"
    if len(set(header)) < len(header) or "" in header:
        return "names a column twice, or not at all"
    return None
