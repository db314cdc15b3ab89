"""Writing a file that only its owner may read, so that a crash leaves the old one or the new."""

import os
import tempfile
from pathlib import Path


def replace_private(path: Path, data: bytes) -> None:
    """Replace ``path`` at once by a file of mode 0600 that holds ``data``.

    The bytes are written beside the target and flushed to disk before the name changes, and the
    folder is flushed after.

    Raises
    ------
    OSError
        The file cannot be written; nothing is left beside the target.
    """
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
