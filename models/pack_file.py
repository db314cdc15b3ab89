"""``pack.toml``: what a pack says about itself where its graph cannot.

::

    [embedder]
    mean = 127.5             # or one number per channel
    scale = 127.5            # the input is (x - mean) / scale
    channel_order = "rgb"    # or "bgr"
    input_size = 112

    [detector]
    input_size = 640

    [[liveness]]             # one for each liveness graph, by its file
    file = "liveness.onnx"
    crop_scale = 2.7         # sides of the crop over those of the face's box
    crop = "box"             # or "square"
    input_size = 80
    channel_order = "bgr"    # or "rgb"
    input_range = [0, 255]   # what the pixel values 0 and 255 become
    live_class = 1
    score = "softmax"        # or "difference", of two logits

Every key but ``file`` is optional; an unknown one is an error.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from models.errors import PackError

FILE_NAME = "pack.toml"
_MAX_BYTES = 64 * 1024
_KEYS = {
    "embedder": {"mean", "scale", "channel_order", "input_size"},
    "detector": {"input_size"},
    "liveness": {
        "file",
        "crop_scale",
        "crop",
        "input_size",
        "channel_order",
        "input_range",
        "live_class",
        "score",
    },
}

Triple = tuple[float, float, float]
Word = TypeVar("Word", bound=str)


@dataclass(frozen=True, kw_only=True)
class LivenessStatement:
    """What is stated of one liveness graph; ``None`` where the file is silent."""

    crop_scale: float | None = None
    crop: Literal["box", "square"] | None = None
    input_size: int | None = None
    channel_order: str | None = None
    input_range: tuple[float, float] | None = None
    live_class: int | None = None
    score: Literal["softmax", "difference"] | None = None


PREPROCESSINGS: dict[str, tuple[Triple, Triple]] = {
    "arcface": ((127.5, 127.5, 127.5), (127.5, 127.5, 127.5)),
    "imagenet": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
    "raw": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
}
"""Mean and scale of RGB pixels from 0 to 255, by the name of the convention."""


@dataclass(frozen=True, kw_only=True)
class PackFile:
    """The stated values; ``None`` where the file is silent. Liveness graphs by their file."""

    mean: Triple | None = None
    scale: Triple | None = None
    channel_order: str | None = None
    input_size: int | None = None
    detector_size: int | None = None
    liveness: Mapping[str, LivenessStatement] = field(default_factory=dict)


def read_pack_file(folder: Path) -> PackFile:
    """Read ``pack.toml`` of a folder; all-``None`` where there is none.

    Raises
    ------
    PackError
        If the file is not TOML, has an unknown key, or a value of the wrong kind.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return PackFile()
    if path.stat().st_size > _MAX_BYTES:
        raise PackError(f"{path} is larger than {_MAX_BYTES} bytes: not a pack.toml.")
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise PackError(f"{path} is not valid TOML: {error}") from error
    for table, content in document.items():
        if table not in _KEYS:
            raise PackError(f"{path}: unknown table or key '{table}'; known are {_listed(_KEYS)}.")
        written = f"[[{table}]]" if table == "liveness" else f"[{table}]"
        for part in content if table == "liveness" and isinstance(content, list) else [content]:
            if not isinstance(part, dict) or (table == "liveness" and part is content):
                raise PackError(f"{path}: '{table}' must be a table, written {written}.")
            unknown = sorted(set(part) - _KEYS[table])
            if unknown:
                raise PackError(
                    f"{path}: unknown key '{unknown[0]}' in {written}; known are"
                    f" {_listed(_KEYS[table])}."
                )
    embedder, detector = document.get("embedder", {}), document.get("detector", {})
    scale = _triple(path, "scale", embedder)
    if scale is not None and min(abs(value) for value in scale) == 0:
        raise PackError(f"{path}: 'scale' divides the input and must not be 0.")
    return PackFile(
        mean=_triple(path, "mean", embedder),
        scale=scale,
        channel_order=_choice(path, "channel_order", embedder, "rgb", "bgr"),
        input_size=_size(path, "[embedder]", embedder, multiple=16, least=112),
        detector_size=_size(path, "[detector]", detector, multiple=32, least=32),
        liveness=_liveness(path, document.get("liveness", [])),
    )


def _liveness(path: Path, tables: list[dict[str, Any]]) -> dict[str, LivenessStatement]:
    stated: dict[str, LivenessStatement] = {}
    for table in tables:
        file = table.get("file")
        if not isinstance(file, str) or not file:
            raise PackError(f"{path}: [[liveness]] needs 'file', the name of its .onnx file.")
        if file in stated:
            raise PackError(f"{path}: [[liveness]] states {file} twice.")
        stated[file] = LivenessStatement(
            crop_scale=_number(path, "crop_scale", table, least=0.5, most=8),
            crop=_choice(path, "crop", table, "box", "square"),
            input_size=_size(path, "[[liveness]]", table, multiple=1, least=16),
            channel_order=_choice(path, "channel_order", table, "rgb", "bgr"),
            input_range=_range(path, table),
            live_class=_live_class(path, table),
            score=_choice(path, "score", table, "softmax", "difference"),
        )
    return stated


def _number(
    path: Path, key: str, table: dict[str, Any], *, least: float, most: float
) -> float | None:
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise PackError(f"{path}: '{key}' must be a number from {least:g} to {most:g}.")
    return float(value)


def _range(path: Path, table: dict[str, Any]) -> tuple[float, float] | None:
    value = table.get("input_range")
    if value is None:
        return None
    if (
        not isinstance(value, list)
        or len(value) != 2
        or not all(
            isinstance(number, int | float) and not isinstance(number, bool) and abs(number) < 1e6
            for number in value
        )
        or value[0] >= value[1]
    ):
        raise PackError(f"{path}: 'input_range' must be two numbers that ascend, such as [0, 1].")
    return float(value[0]), float(value[1])


def _live_class(path: Path, table: dict[str, Any]) -> int | None:
    value = table.get("live_class")
    if value is not None and (
        isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 16
    ):
        raise PackError(f"{path}: 'live_class' must be a whole number from 0 to 15.")
    return value


def pack_file_text(preprocessing: str) -> str:
    """Write the ``pack.toml`` of an embedder that was trained by one of ``PREPROCESSINGS``."""
    mean, scale = PREPROCESSINGS[preprocessing]
    rows = (f"mean = {list(mean)}", f"scale = {list(scale)}", 'channel_order = "rgb"')
    return "\n".join(["[embedder]", *rows]) + "\n"


def _listed(names: Any) -> str:
    return ", ".join(sorted(names))


def _triple(path: Path, key: str, table: dict[str, Any]) -> Triple | None:
    value = table.get(key)
    if value is None:
        return None
    numbers = value if isinstance(value, list) else [value] * 3
    if len(numbers) != 3 or not all(
        isinstance(number, int | float) and not isinstance(number, bool) and abs(number) < 1e6
        for number in numbers
    ):
        raise PackError(f"{path}: '{key}' must be a number or a list of three numbers.")
    return (float(numbers[0]), float(numbers[1]), float(numbers[2]))


def _choice(path: Path, key: str, table: dict[str, Any], *values: Word) -> Word | None:
    value = table.get(key)
    if value is not None and value not in values:
        expected = " or ".join(f'"{word}"' for word in values)
        raise PackError(f"{path}: '{key}' must be {expected}, not {value!r}.")
    return value


def _size(
    path: Path, table: str, content: dict[str, Any], *, multiple: int, least: int
) -> int | None:
    value = content.get("input_size")
    if value is None:
        return None
    if (
        not isinstance(value, int)
        or isinstance(value, bool)
        or not least <= value <= 2048
        or value % multiple
    ):
        raise PackError(
            f"{path}: 'input_size' in {table} must be a multiple of {multiple} from {least} to"
            f" 2048, not {value!r}."
        )
    return value
