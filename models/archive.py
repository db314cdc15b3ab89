"""Taking the graphs of a pack out of an archive that a stranger made."""

import errno
import stat
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
_MOST_SHOWN = 100
"""Characters of a stranger's name in a text."""


def is_archive(file: Path) -> bool:
    """Whether a file is a zip archive, or a broken one."""
    try:
        return zipfile.is_zipfile(file)
    except zipfile.BadZipFile:
        return True


def unpack(archive: Path, into: Path) -> tuple[list[Path], list[str]]:
    """Extract the ``.onnx`` files and the ``pack.toml`` of a zip archive, flat, into a folder.

    Nothing else is written, whatever the archive holds. Sizes are counted while bytes are written:
    what the archive says of them is not trusted.

    Returns
    -------
    files
        What was written.
    left_out
        Names of the entries that were not.

    Raises
    ------
    PackError
        It is no zip archive; an entry has an absolute path, leads out of the archive, has a name
        that cannot be printed, is a link, is encrypted, or compressed other than by deflation; two
        graphs have one name; it is too large; or it has no graph.
    OSError
        A file cannot be written.
    """
    written: list[Path] = []
    left_out: list[str] = []
    total = 0
    try:
        with zipfile.ZipFile(archive) as opened:
            entries = opened.infolist()
            if len(entries) > MAX_ENTRIES:
                raise PackError(f"The archive has more than {MAX_ENTRIES} entries: not a pack.")
            for entry in entries:
                name = _checked_name(entry)
                if entry.is_dir():
                    continue
                if not _is_wanted(name):
                    left_out.append(entry.filename)
                    continue
                target = into / name
                if target.exists():
                    raise PackError(f"The archive has two files of the name {name[:_MOST_SHOWN]}.")
                with opened.open(entry) as source, target.open("xb") as file:
                    total += _copied(source, file, name, most=MAX_TOTAL_BYTES - total)
                written.append(target)
    except (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError) as error:
        raise _unreadable(error) from error
    except (ValueError, OverflowError) as error:  # an offset or a name that cannot be
        raise _unreadable(error) from error
    except OSError as error:
        if error.errno not in (None, errno.EINVAL):
            raise
        raise _unreadable(error) from error
    if not any(file.suffix.lower() == ".onnx" for file in written):
        raise PackError("The archive has no .onnx file.")
    return written, left_out


def _unreadable(error: Exception) -> PackError:
    return PackError(f"The archive cannot be read ({type(error).__name__}).")


def _checked_name(entry: zipfile.ZipInfo) -> str:
    """The last part of an entry's path; refuse what no honest archive has."""
    path = PurePosixPath(entry.filename.replace("\\", "/"))
    # `filename` ends where a NUL stands in the archive.
    shown = ascii(entry.orig_filename[:_MOST_SHOWN])
    if not (entry.filename.isprintable() and entry.orig_filename.isprintable()):
        raise PackError(f"The archive has a name that cannot be printed: {shown}.")
    if path.is_absolute() or ".." in path.parts or ":" in entry.filename:
        raise PackError(f"The archive has an entry that leads out of it: {shown}.")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise PackError(f"The archive has a link: {shown}.")
    if entry.flag_bits & 0x1:
        raise PackError("The archive is encrypted; extract it yourself.")
    if entry.compress_type not in _METHODS:
        raise PackError(
            f"The archive has an entry that is neither stored nor deflated: {shown}; extract it "
            "yourself."
        )
    return path.name


def _is_wanted(name: str) -> bool:
    return not name.startswith(".") and (name.lower().endswith(".onnx") or name == FILE_NAME)


def _copied(source: IO[bytes], file: IO[bytes], name: str, *, most: int) -> int:
    count = 0
    while piece := source.read(_PIECE):
        count += len(piece)
        if count > min(MAX_FILE_BYTES, most):
            raise PackError(f"The archive is too large to be a pack, at {name[:_MOST_SHOWN]}.")
        file.write(piece)
    return count
