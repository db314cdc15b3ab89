"""``pack.toml``: what a pack says about itself where its graph cannot (docs/models.md)."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from models.errors import PackError

FILE_NAME = "pack.toml"
_MAX_BYTES = 64 * 1024

Number = Annotated[float, Field(gt=-1e6, lt=1e6)]
ChannelOrder = Literal["rgb", "bgr"]
CropShape = Literal["box", "square"]


def _per_channel(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else (value,) * 3


def _ascending(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] >= values[1]:
        raise ValueError("the two numbers must ascend, such as [0, 1]")
    return values


Positive = Annotated[float, Field(gt=0, lt=1e6)]
Triple = tuple[float, float, float]
Mean = Annotated[tuple[Number, Number, Number], BeforeValidator(_per_channel)]
Scale = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(_per_channel)]
Range = Annotated[
    tuple[Number, Number],
    BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value),
    AfterValidator(_ascending),
]


class _Table(BaseModel):
    """A table of the file. A value is ``None`` where only the graph can tell."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class EmbedderStatement(_Table):
    """What is stated of the embedder."""

    mean: Mean | None = None
    scale: Scale | None = None
    channel_order: ChannelOrder | None = None


class DetectorStatement(_Table):
    """What is stated of the detector."""

    input_size: Annotated[int, Field(ge=32, le=2048, multiple_of=32)] | None = None


class LivenessStatement(_Table):
    """What is stated of one liveness graph; the defaults are those of MiniFASNet."""

    file: Annotated[str, Field(min_length=1)]
    crop_scale: Annotated[float, Field(ge=0.5, le=8)] | None = None
    crop: CropShape = "box"
    channel_order: ChannelOrder = "bgr"
    input_range: Range = (0.0, 255.0)
    live_class: Annotated[int, Field(ge=0, le=15)] = 1


class PackFile(_Table):
    """What is stated of a pack."""

    embedder: EmbedderStatement = EmbedderStatement()
    detector: DetectorStatement = DetectorStatement()
    liveness: list[LivenessStatement] = []

    def liveness_of(self, file: str) -> LivenessStatement | None:
        """Return what is stated of a liveness graph; ``None`` where it is not named."""
        return next((stated for stated in self.liveness if stated.file == file), None)


def read_pack_file(folder: Path) -> PackFile:
    """Read ``pack.toml`` of a folder; nothing is stated where there is none."""
    path = folder / FILE_NAME
    if not path.is_file():
        return PackFile()
    if path.stat().st_size > _MAX_BYTES:
        raise PackError(f"{path} is larger than {_MAX_BYTES} bytes: not a pack.toml.")
    try:
        stated = PackFile.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise PackError(f"{path} is not valid TOML: {error}") from error
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        wrong = "unknown key" if first["type"] == "extra_forbidden" else first["msg"]
        raise PackError(f"{path}: {place}: {wrong} (docs/models.md lists the keys).") from None
    files = [graph.file for graph in stated.liveness]
    for file in files:
        if files.count(file) > 1:
            raise PackError(f"{path}: [[liveness]] states {file} twice.")
    return stated


PREPROCESSINGS: dict[str, tuple[Triple, Triple]] = {
    "arcface": ((127.5, 127.5, 127.5), (127.5, 127.5, 127.5)),
    "imagenet": ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375)),
    "raw": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
}
"""Mean and scale of RGB pixels from 0 to 255, by the name of the convention."""


def pack_file_text(preprocessing: str) -> str:
    """Write the ``pack.toml`` of an embedder that was trained by one of ``PREPROCESSINGS``."""
    mean, scale = PREPROCESSINGS[preprocessing]
    rows = (f"mean = {list(mean)}", f"scale = {list(scale)}", 'channel_order = "rgb"')
    return "\n".join(["[embedder]", *rows]) + "\n"
