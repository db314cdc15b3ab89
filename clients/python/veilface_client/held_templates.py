"""Sealed templates that a subject's holder keeps, in memory or in a file that only they can read.

The file has the base64 text that the service answered, as ``veilface enroll`` writes it.
"""

import base64
import os
from pathlib import Path

HeldTemplate = bytes | str | os.PathLike[str]
"""The sealed template, or the path of the file that has it."""

MAX_CHARS = 4 * 2**20
"""The most that is read of a file: what the service takes."""


def save_held_template(held_template: bytes, path: str | os.PathLike[str]) -> None:
    """Write a held template to a new file of mode 0600.

    Raises
    ------
    FileExistsError
        There is a file already: it may be the only copy of another template.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(base64.b64encode(held_template))


def held_template_text(held_template: HeldTemplate) -> str:
    """Return what is sent of a held template.

    Raises
    ------
    ValueError
        The file is too large to be one, or no text.
    """
    if isinstance(held_template, bytes):
        return base64.b64encode(held_template).decode("ascii")
    with Path(held_template).open("rb") as file:
        data = file.read(MAX_CHARS + 1)
    if len(data) > MAX_CHARS or not data.isascii():
        raise ValueError(f"a held template is base64 of at most {MAX_CHARS} characters")
    return data.decode("ascii").strip()
