"""Descriptors that were computed elsewhere, and the photos of a set that they belong to."""

import hashlib
import math
import zipfile
from collections import defaultdict
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from verify.datasets import SUFFIXES, DatasetError, faults_in
from verify.evaluation.verification_set import VerificationSet

MAX_DESCRIPTOR_BYTES = 2**30
MAX_PATH_BYTES = 2**29
MAX_ROWS = 1_000_000
MAX_DIMENSION = 2**16
_MAX_HEADER = 10_000
_BLOCK_BYTES = 2**22
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_SHOWN = 3
_FLOATS = (np.dtype(np.float16), np.dtype(np.float32), np.dtype(np.float64))
_KEYS = "expected arrays paths (unicode) and descriptors (float16, float32 or float64)"

# Components at the end of a name that tell the photos of a kind apart, wherever they lie.
_TELLING = {"bin": 1, "lfw": 1, "agedb": 1, "cfp": 3}


@dataclass(frozen=True, eq=False, repr=False)
class EmbeddingsFile:
    """Descriptors with the paths of their photos.

    Parameters
    ----------
    paths
        As the file has them, all different.
    descriptors : (N, n) float32
        Unit rows.
    """

    paths: tuple[str, ...]
    descriptors: NDArray[np.float32]
    sha256: str

    def __len__(self) -> int:
        return len(self.paths)


def read_embeddings(file: Path) -> EmbeddingsFile:
    """Read an ``.npz`` with ``paths`` (N unicode strings) and ``descriptors`` (N, n).

    Rows are normalised, as many tools save what the network gave. What both arrays declare is
    checked before either is unpacked, and they are unpacked a block at a time.

    Raises
    ------
    DatasetError
        The archive is broken or too large, an array has another type or shape, a row is zero or
        not finite, or a path occurs twice.
    """
    try:
        with file.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            with zipfile.ZipFile(stream) as archive:
                paths = _declared(file, archive, "paths", most=MAX_PATH_BYTES)
                rows = _declared(file, archive, "descriptors", most=MAX_DESCRIPTOR_BYTES)
                _require_shapes(file, paths.shape, rows.shape)
                names = [str(one) for block in _blocks(archive, paths) for one in block.tolist()]
                unit, lengths = _unit_rows(archive, rows)
    except DatasetError:
        raise
    except OSError as error:
        raise DatasetError(f"{file} cannot be read: {error.strerror or 'broken'}") from None
    except Exception as error:  # zipfile and NumPy raise whatever a broken archive causes
        raise DatasetError(
            f"{file} is not a readable .npz archive ({type(error).__name__}); {_KEYS}"
        ) from None
    faults = [f"{name!a} occurs twice" for name in _repeated(names)]
    for place in np.flatnonzero(~(np.isfinite(lengths) & (lengths > 0))).tolist():
        state = "zero" if lengths[place] == 0 else "not finite"
        faults.append(f"the embedding of {names[place]!a} is {state}")
    if faults:
        raise DatasetError(faults_in(file, "expected one embedding per photo", faults))
    return EmbeddingsFile(tuple(names), unit, sha256)


def match(embeddings: EmbeddingsFile, benchmark: VerificationSet) -> NDArray[np.int64]:
    """Find the descriptor of every photo of a set.

    A photo takes the row of its exact name; else of its name without suffix; else the row that
    shares the longest end of its path: all of the shorter path, or as many components as tell
    photos of the set apart (``Name_0001`` in LFW, ``001/frontal/01`` in CFP). Photos of a
    ``.bin`` are ``00000``, ``00001`` … by place.

    Returns
    -------
    positions : (len(benchmark.pictures),) int64
        Rows of ``embeddings.descriptors``; −1 for photos without one, which are failures to
        acquire.

    Raises
    ------
    DatasetError
        Several rows fit a photo equally well, or one row fits several photos.
    """
    exact = {path: row for row, path in enumerate(embeddings.paths)}
    names = [_components(picture.name) for picture in benchmark.pictures]
    ends = _Ends([_components(path) for path in embeddings.paths], {name[-1:] for name in names})
    telling = _TELLING.get(benchmark.kind)
    positions = np.full(len(benchmark.pictures), -1, dtype=np.int64)
    takers: dict[int, str] = {}
    faults: list[str] = []
    for place, (picture, wanted) in enumerate(zip(benchmark.pictures, names, strict=True)):
        same = exact.get(picture.name)
        rows = ends.longest(wanted, telling) if same is None else [same]
        if len(rows) > 1:
            shown = " and ".join(f"{embeddings.paths[row]!a}" for row in rows)
            faults.append(f"{picture.name} may be {shown}")
        elif rows and rows[0] in takers:
            path = embeddings.paths[rows[0]]
            faults.append(f"{path!a} fits both {takers[rows[0]]} and {picture.name}")
        elif rows:
            takers[rows[0]] = picture.name
            positions[place] = rows[0]
    if faults:
        raise DatasetError(
            faults_in(Path(benchmark.name), "expected one embedding for each photo", faults)
        )
    return positions


class _Ends:
    """Ends of paths: each is numbered by the end one component shorter and its own first one.

    Parameters
    ----------
    paths
        Components of each path.
    lasts
        Last components that will be asked for; paths with others are left out.
    """

    def __init__(self, paths: Sequence[tuple[str, ...]], lasts: Set[tuple[str, ...]]) -> None:
        self._number: dict[tuple[int, str], int] = {}
        self._with: defaultdict[int, list[int]] = defaultdict(list)
        self._whole: defaultdict[int, list[int]] = defaultdict(list)
        for row, pieces in enumerate(paths):
            if not pieces or pieces[-1:] not in lasts:
                continue
            end = 0
            for piece in reversed(pieces):
                end = self._number.setdefault((end, piece), len(self._number) + 1)
                # Two would do to tell that an end is shared; a message shows three.
                if len(self._with[end]) < _SHOWN:
                    self._with[end].append(row)
            if len(self._whole[end]) < _SHOWN:
                self._whole[end].append(row)

    def longest(self, wanted: tuple[str, ...], telling: int | None) -> list[int]:
        """Rows that share the longest end with a path, three of them at most."""
        best: list[int] = []
        end = 0
        for shared, piece in enumerate(reversed(wanted), start=1):
            if (end, piece) not in self._number:
                break
            end = self._number[end, piece]
            rows = self._whole.get(end, [])
            if shared == len(wanted):
                rows = rows or self._with[end]
            elif telling is not None and shared >= telling:
                rows = self._with[end]
            best = rows or best
        return best


def _components(path: str) -> tuple[str, ...]:
    """Components without the suffix of a photo; drives, roots and ``.`` are dropped."""
    pieces = [piece for piece in path.replace("\\", "/").split("/") if piece not in ("", ".")]
    if pieces:
        dot = pieces[-1].rfind(".")
        if dot > 0 and pieces[-1][dot:].lower() in SUFFIXES:
            pieces[-1] = pieces[-1][:dot]
    return tuple(pieces)


def _repeated(names: list[str]) -> list[str]:
    seen: set[str] = set()
    return [name for name in names if name in seen or seen.add(name)]  # type: ignore[func-returns-value]


@dataclass(frozen=True, repr=False)
class _Declared:
    """An array of an archive, as its header has it; ``start`` is where the numbers begin."""

    entry: zipfile.ZipInfo
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[np.generic]
    start: int


def _declared(file: Path, archive: zipfile.ZipFile, name: str, *, most: int) -> _Declared:
    """Read the header of one array, and check it against what the archive says of the entry."""
    try:
        entry = archive.getinfo(f"{name}.npy")
    except KeyError:
        there = ", ".join(sorted(archive.namelist())[:5])
        raise DatasetError(f"{file} has no array {name}, only {there!a}; {_KEYS}") from None
    if entry.compress_type not in _COMPRESSIONS:
        # zipfile unpacks others past any size that is asked for.
        raise DatasetError(
            f"{file}: {name} is compressed otherwise than NumPy does; save it with "
            "numpy.savez or numpy.savez_compressed"
        )
    if entry.file_size > most:
        raise DatasetError(f"{file}: {name} unpacks to more than {most} bytes")
    with archive.open(entry) as stream:
        shape, fortran, dtype = _header(stream)
        start = stream.tell()
    if dtype.kind != "U" if name == "paths" else dtype.newbyteorder("=") not in _FLOATS:
        raise DatasetError(f"{file}: {name} is of type {dtype.kind}{dtype.itemsize}; {_KEYS}")
    size = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or size > most:
        raise DatasetError(f"{file}: {name} declares a shape beyond {most} bytes")
    if entry.file_size != start + size:
        raise DatasetError(f"{file}: {name} is not as long as its shape {shape} says")
    return _Declared(entry, shape, fortran, dtype, start)


def _require_shapes(file: Path, paths: tuple[int, ...], rows: tuple[int, ...]) -> None:
    if len(paths) != 1 or len(rows) != 2 or paths[0] != rows[0] or 0 in rows:
        raise DatasetError(
            f"{file} has paths of shape {paths} and descriptors of shape {rows}; "
            "expected (N,) and (N, n)"
        )
    if rows[0] > MAX_ROWS or rows[1] > MAX_DIMENSION:
        raise DatasetError(
            f"{file} has {rows[0]} embeddings of {rows[1]} numbers each; at most {MAX_ROWS} of "
            f"{MAX_DIMENSION} are read"
        )


def _blocks(archive: zipfile.ZipFile, array: _Declared) -> Iterator[NDArray[np.generic]]:
    """Unpack an array some rows at a time, or some columns where it lies in Fortran order."""
    shape = array.shape[::-1] if array.fortran else array.shape
    width = math.prod(shape[1:])
    step = max(1, _BLOCK_BYTES // max(1, width * array.dtype.itemsize))
    with archive.open(array.entry) as stream:
        stream.read(array.start)
        for first in range(0, shape[0], step):
            count = min(step, shape[0] - first)
            data = stream.read(count * width * array.dtype.itemsize)
            if array.dtype.itemsize == 0:
                block: NDArray[np.generic] = np.zeros((count, *shape[1:]), "U1")
            else:
                block = np.frombuffer(data, array.dtype).reshape(count, *shape[1:])
            yield block
        if stream.read(1):
            raise ValueError("an entry is longer than it declares")


def _unit_rows(
    archive: zipfile.ZipFile, array: _Declared
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Rows over their lengths, and the lengths; rows without a length are undefined."""
    count = array.shape[0]
    unit = np.empty(array.shape, dtype=np.float32)
    lengths = np.zeros(count, dtype=np.float64)
    at = 0
    with np.errstate(all="ignore"):
        if not array.fortran:
            for block in _blocks(archive, array):
                wide = block.astype(np.float64)
                here = slice(at, at + len(wide))
                lengths[here] = np.sqrt(np.einsum("ij,ij->i", wide, wide))
                unit[here] = wide / lengths[here, None]
                at += len(wide)
            return unit, lengths
        # Columns come first here, so a row is known whole only after a first pass.
        for block in _blocks(archive, array):
            wide = block.astype(np.float64)
            lengths += np.einsum("ij,ij->j", wide, wide)
        lengths = np.sqrt(lengths)
        for block in _blocks(archive, array):
            wide = block.astype(np.float64)
            unit[:, at : at + len(wide)] = (wide / lengths).T
            at += len(wide)
    return unit, lengths


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream, max_header_size=_MAX_HEADER)
    return np.lib.format.read_array_header_2_0(stream, max_header_size=_MAX_HEADER)
