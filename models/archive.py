"""Taking the graphs of a pack out of an archive that a stranger made."""

import errno
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from models.errors import PackError
from models.pack_file import FILE_NAME

MAX_ENTRIES = 100
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


def unpack(archive: Path, into: Path) -> int:
    """Extract the ``.onnx`` files and the ``pack.toml`` of a zip archive, flat, into a folder.

    Nothing else is written, whatever the archive holds: a file gets the last part of its entry's
    path as its name. Sizes are counted while bytes are written: what the archive says of them is
    not trusted. Returns how many entries were left out.
    """
    written: list[Path] = []
    left_out = 0
    room = MAX_TOTAL_BYTES
    try:
        with zipfile.ZipFile(archive) as opened:
            if len(opened.infolist()) > MAX_ENTRIES:
                raise PackError(f"The archive has more than {MAX_ENTRIES} entries.")
            for entry in opened.infolist():
                if entry.is_dir():
                    continue
                name = PurePosixPath(entry.filename.replace("\\", "/")).name
                if name[:1] == "." or not (name.lower().endswith(".onnx") or name == FILE_NAME):
                    left_out += 1
                    continue
                # Other methods unpack to any size at once.
                if not name.isprintable() or entry.compress_type not in _METHODS:
                    raise PackError(
                        "The archive has an entry that is neither stored nor deflated, or whose "
                        f"name cannot be printed: {name[:100]!a}; extract it yourself."
                    )
                target = into / name
                if target.exists():
                    raise PackError("The archive has two files of the same name.")
                written.append(target)
                room -= _copy(opened, entry, target, most=min(MAX_FILE_BYTES, room))
    except (*_BROKEN, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise
        raise PackError(
            f"The archive is damaged or encrypted ({type(error).__name__}): fetch it again, or "
            "extract it yourself."
        ) from error
    if not any(file.suffix.lower() == ".onnx" for file in written):
        raise PackError("The archive has no .onnx file.")
    return left_out


def _copy(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path, *, most: int) -> int:
    count = 0
    with archive.open(entry) as source, target.open("xb") as file:
        while piece := source.read(_PIECE):
            count += len(piece)
            if count > most:
                raise PackError("The archive is too large to be a pack.")
            file.write(piece)
    return count
