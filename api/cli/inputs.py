"""Lists, files and decoys that bulk commands are given."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from api.cli.errors import CommandError, UsageError
from models.pack import ModelPack
from templates.contract.canonical import Json
from templates.decoys import DecoySource, load_source
from templates.keys.sealing import Sealer
from verify.fairface_labels import Label, read_labels
from verify.preparation import require_made_with

T = TypeVar("T")


def listed(text: str, kind: Callable[[str], T], option: str, *, expected: str) -> tuple[T, ...]:
    """Read a list with commas, each entry once.

    Parameters
    ----------
    expected
        Said where something is not of the kind.

    Raises
    ------
    UsageError
        Something in it is not of the kind, or it is empty.
    """
    parts = [part.strip() for part in text.split(",") if part.strip()]
    try:
        values = tuple(dict.fromkeys(kind(part) for part in parts))
    except ValueError:
        raise UsageError(f"{option} takes {expected}, not {text!r}") from None
    if not values:
        raise UsageError(f"{option} takes {expected}, and is empty")
    return values


def fairface_labels(root: Path, part: str) -> dict[Path, Label]:
    """Read the labels of a part of FairFace, ``train`` or ``val``, by the path of the photo.

    Raises
    ------
    CommandError
        The folder has no such label file.
    DatasetError
        The file has faults.
    """
    file = root / f"fairface_label_{part}.csv"
    if not file.is_file():
        raise CommandError(
            f"{root} has no {file.name}; give the folder of FairFace, with its two label files"
        )
    return read_labels(file)


def listed_dims(text: str, option: str, *, n: int, example: str) -> tuple[int, ...]:
    """Read dimensions m of subspaces of Rⁿ, each once."""
    dims = listed(text, int, option, expected=f"whole numbers such as {example}")
    wrong = [m for m in dims if not 1 <= m < n]
    if wrong:
        raise UsageError(f"{option} takes dimensions from 1 to {n - 1}, not {wrong[0]}")
    return dims


def listed_numbers(
    text: str, option: str, *, least: int, most: int | None = None
) -> tuple[int, ...]:
    """Read whole numbers within bounds, each once."""
    numbers = listed(text, int, option, expected="whole numbers such as 8,16")
    for number in numbers:
        if number < least or (most is not None and number > most):
            taken = f"from {least}" + ("" if most is None else f" to {most}")
            raise UsageError(f"{option} takes numbers {taken}, not {number}")
    return numbers


def named_file(file: Path | None) -> dict[str, Json] | None:
    """Name and SHA-256 of a file that figures depend on."""
    if file is None:
        return None
    with file.open("rb") as stream:
        return {"file": file.name, "sha256": hashlib.file_digest(stream, "sha256").hexdigest()}


def load_decoys(file: Path, sealer: Sealer, pack: ModelPack) -> DecoySource:
    """Load a file of `decoys build` that was made with this pack.

    Raises
    ------
    CommandError
        Its decoys have another dimension.
    ContractMismatch
        It was made with another model or another preprocessing.
    """
    source = load_source(file, sealer)
    if source.n != pack.info.n:
        raise CommandError(
            f"the decoys have {source.n} numbers each, the pack gives {pack.info.n}; build the "
            "decoys with this pack"
        )
    require_made_with(source, pack)
    return source
