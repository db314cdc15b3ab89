"""Taking the graphs of a pack out of an archive that a stranger made."""

import errno
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import IO

from models.errors import PackError
from models.pack_file import FILE_NAME

MAX_ENTRIES = 1_000
MAX_FILE_BYTES = 2**30
MAX_TOTAL_BYTES = 2 * 2**30
_PIECE = 2**20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# What `zipfile` raises on archives that are damaged, encrypted, or lie about themselves.
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, struct.error),
    *(EOFError, RuntimeError, ValueError, OverflowError),
)


def is_archive(file: Path) -> bool:
    """Whether a file is a zip archive, or a broken one."""
    try:
        return zipfile.is_zipfile(file)
    except zipfile.BadZipFile:
        return True


def unpack(archive: Path, into: Path) -> tuple[list[Path], list[str]]:
    """Extract the ``.onnx`` files and the ``pack.toml`` of a zip archive, flat, into a folder.

    Nothing else is written, whatever the archive holds: a file gets the last part of its entry's
    path as its name. Sizes are counted while bytes are written: what the archive says of them is
    not trusted.

    Returns
    -------
    files
        What was written.
    left_out
        Names of the entries that were not.

    Raises
    ------
    PackError
        It is no zip archive, is encrypted, or compressed other than by deflation; two graphs have
        one name, or one that cannot be printed; it is too large; or it has no graph.
    OSError
        A file cannot be written.
    """
    written: list[Path] = []
    left_out: list[str] = []
    total = 0
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = [entry for entry in opened.infolist() if not entry.is_dir()]
            if len(entries) > MAX_ENTRIES:
                raise PackError(f"The archive has more than {MAX_ENTRIES} entries: not a pack.")
            for entry in entries:
                name = PurePosixPath(entry.filename.replace("\\", "/")).name
                if not _is_wanted(name):
                    left_out.append(entry.filename)
                    continue
                _require_plain(entry, name)
                target = into / name
                with opened.open(entry) as source, target.open("xb") as file:
                    most = min(MAX_FILE_BYTES, MAX_TOTAL_BYTES - total)
                    total += _copied(source, file, most=most)
                written.append(target)
    except FileExistsError:
        raise PackError("The archive has two files of the same name.") from None
    except (*_BROKEN, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise
        raise PackError(f"The archive cannot be read ({type(error).__name__}).") from error
    if not any(file.suffix.lower() == ".onnx" for file in written):
        raise PackError("The archive has no .onnx file.")
    return written, left_out


def _is_wanted(name: str) -> bool:
    return not name.startswith(".") and (name.lower().endswith(".onnx") or name == FILE_NAME)


def _require_plain(entry: zipfile.ZipInfo, name: str) -> None:
    if not name.isprintable():
        raise PackError(f"The archive has a name that cannot be printed: {name[:100]!a}.")
    if entry.flag_bits & 0x1:
        raise PackError("The archive is encrypted; extract it yourself.")
    if entry.compress_type not in _METHODS:
        raise PackError(
            f"The archive has an entry that is neither stored nor deflated: {name[:100]}; extract"
            " it yourself."
        )


def _copied(source: IO[bytes], file: IO[bytes], *, most: int) -> int:
    count = 0
    while piece := source.read(_PIECE):
        count += len(piece)
        if count > most:
            raise PackError("The archive is too large to be a pack.")
        file.write(piece)
    return count
