"""``pack.toml``: what a pack says about itself where its graph cannot.

::

    [embedder]
    mean = 127.5             # or one number per channel
    scale = 127.5            # the input is (x - mean) / scale
    channel_order = "rgb"    # or "bgr"
    input_size = 112

    [detector]
    input_size = 640

Every key is optional; an unknown one is an error.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from models.errors import PackError

FILE_NAME = "pack.toml"
_MAX_BYTES = 64 * 1024
_KEYS = {
    "embedder": {"mean", "scale", "channel_order", "input_size"},
    "detector": {"input_size"},
}

Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class PackFile:
    """The stated values; ``None`` where the file is silent."""

    mean: Triple | None = None
    scale: Triple | None = None
    channel_order: str | None = None
    input_size: int | None = None
    detector_size: int | None = None


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
        if not isinstance(content, dict):
            raise PackError(f"{path}: '{table}' must be a table, written [{table}].")
        unknown = sorted(set(content) - _KEYS[table])
        if unknown:
            raise PackError(
                f"{path}: unknown key '{unknown[0]}' in [{table}]; known are"
                f" {_listed(_KEYS[table])}."
            )
    embedder, detector = document.get("embedder", {}), document.get("detector", {})
    scale = _triple(path, "scale", embedder)
    if scale is not None and min(abs(value) for value in scale) == 0:
        raise PackError(f"{path}: 'scale' divides the input and must not be 0.")
    return PackFile(
        mean=_triple(path, "mean", embedder),
        scale=scale,
        channel_order=_channel_order(path, embedder),
        input_size=_size(path, "embedder", embedder, multiple=16, least=112),
        detector_size=_size(path, "detector", detector, multiple=32, least=32),
    )


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


def _channel_order(path: Path, table: dict[str, Any]) -> str | None:
    value = table.get("channel_order")
    if value is not None and value not in ("rgb", "bgr"):
        raise PackError(f'{path}: \'channel_order\' must be "rgb" or "bgr", not {value!r}.')
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
            f"{path}: 'input_size' in [{table}] must be a multiple of {multiple} from {least} to"
            f" 2048, not {value!r}."
        )
    return value
