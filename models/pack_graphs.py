"""The graphs of a model pack: found in a folder, loaded once, and recognised by their signatures.

A graph's signature is what onnxruntime says of its inputs and outputs; its name does not matter.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from models.detectors import YUNET_OUTPUTS
from models.errors import PackError
from models.pack_file import PackFile, read_pack_file
from models.sessions import Session, Tensor

_SUFFIX = ".onnx"
# A ResNet-100 embedder has 260 MB; protobuf itself ends at 2 GiB.
_MAX_MODEL_BYTES = 2**30


class Role(StrEnum):
    """What a graph can do for a pack."""

    SCRFD = "scrfd"
    SCRFD_WITHOUT_KEYPOINTS = "scrfd-without-keypoints"
    YUNET = "yunet"
    GENDER_AGE = "gender-age"
    LANDMARKS = "landmarks"
    LIVENESS = "liveness"
    EMBEDDER = "embedder"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class PackGraph:
    """One file of a pack, read once: what is hashed is what runs."""

    path: Path
    session: Session = field(repr=False)
    sha256: str
    role: Role
    reason: str

    @property
    def file(self) -> str:
        """Name of the file."""
        return self.path.name

    @property
    def inputs(self) -> str:
        """Names and shapes of the inputs."""
        return ", ".join(map(str, self.session.inputs))

    @property
    def outputs(self) -> str:
        """Names and shapes of the outputs."""
        return ", ".join(map(str, self.session.outputs))


@dataclass(frozen=True)
class Location:
    """Where a pack was found: its name, its folder, and its ``.onnx`` files."""

    name: str
    folder: Path
    files: list[Path]


def inspect(path: str | Path) -> list[PackGraph]:
    """What every graph of a pack is, and why; unusable packs are reported, not refused."""
    location, stated = locate(Path(path))
    return [read_graph(file, stated) for file in location.files]


def locate(path: Path) -> tuple[Location, PackFile]:
    """Find the graphs of a folder, or the one that a file is, and what ``pack.toml`` states."""
    if path.is_file():
        if path.suffix.lower() != _SUFFIX:
            raise PackError(f"{path} is not an .onnx file; name a pack folder or an embedder.")
        return Location(path.stem, path.parent, [path]), read_pack_file(path.parent)
    if not path.is_dir():
        raise PackError(f"{path} does not exist; name a folder of .onnx files or one embedder.")
    for folder in (path, path / path.resolve().name):
        # Hidden files are leftovers of archives ("._model.onnx" of macOS).
        files = sorted(
            file
            for file in folder.glob("[!.]*")
            if file.suffix.lower() == _SUFFIX and file.is_file()
        )
        if files:
            return Location(path.resolve().name, folder, files), read_pack_file(folder)
    raise PackError(f"{path} has no .onnx files; put the weights of a pack there.")


def read_graph(
    path: Path,
    stated: PackFile,
    *,
    providers: Sequence[str] = ("cpu",),
    threads: int | None = None,
) -> PackGraph:
    """Load and recognise one graph."""
    try:
        if path.stat().st_size > _MAX_MODEL_BYTES:
            raise PackError(f"{path} is larger than {_MAX_MODEL_BYTES} bytes: not a face model.")
        model = path.read_bytes()
    except OSError as error:
        raise PackError(f"{path} cannot be read: {error.strerror}.") from error
    session = Session(model, name=path.name, providers=providers, threads=threads)
    if stated.liveness_of(path.name) is not None:
        role, reason = Role.LIVENESS, "stated in pack.toml"
    else:
        role, reason = classify(
            session.inputs, session.outputs, input_size=stated.embedder.input_size
        )
    return PackGraph(path, session, hashlib.sha256(model).hexdigest(), role, reason)


def image_size(inputs: Sequence[Tensor]) -> tuple[int | None, int | None] | None:
    """Height and width of the only input where it is an image, else ``None``."""
    if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].shape[1] not in (3, None):
        return None
    return inputs[0].shape[2], inputs[0].shape[3]


def classify(
    inputs: Sequence[Tensor], outputs: Sequence[Tensor], *, input_size: int | None = None
) -> tuple[Role, str]:
    """Route a graph by its signature (docs/models.md "Packs")."""
    size = image_size(inputs)
    last = [output.shape[-1] if output.shape else None for output in outputs]
    if size is None:
        return Role.UNKNOWN, "its input is not one float32 image (batch, 3, h, w)"
    if {output.name for output in outputs}.issuperset(YUNET_OUTPUTS):
        return Role.YUNET, "outputs cls_8 ... kps_32"
    match sorted(width or 0 for width in last):
        case [1, 1, 1, 4, 4, 4, 10, 10, 10]:
            return Role.SCRFD, "scores, boxes and five points at three strides (9 outputs)"
        case [1, 1, 1, 4, 4, 4]:
            return (
                Role.SCRFD_WITHOUT_KEYPOINTS,
                "scores and boxes at three strides without keypoints (6 outputs): it cannot align",
            )
    if size == (96, 96) and last == [3]:
        return Role.GENDER_AGE, "96 x 96 input and 3 output values; ignored"
    if size == (80, 80) and last == [3]:
        return Role.LIVENESS, "80 x 80 input and 3 output values (MiniFASNet)"
    if size == (192, 192):
        return Role.LANDMARKS, "192 x 192 input; ignored"
    height, width = (input_size if side is None else side for side in size)
    if height is None or width is None:
        return (
            Role.UNKNOWN,
            "the input size is open; where this is an embedder, state input_size in pack.toml",
        )
    if height != width or height < 112 or height % 16:
        return (
            Role.UNKNOWN,
            f"the {width} x {height} input is not a square of at least 112 that 16 divides",
        )
    if len(outputs) != 1 or len(outputs[0].shape) != 2:
        return Role.UNKNOWN, "no known detector, and not exactly one output (batch, values)"
    if last[0] in (2, 3):
        return (
            Role.UNKNOWN,
            f"{last[0]} output values are no embedding; a liveness graph is stated in pack.toml,"
            " under [[liveness]]",
        )
    return Role.EMBEDDER, f"square {width} x {height} input and one 2-D output"


def pick(graphs: Sequence[PackGraph], folder: Path) -> tuple[PackGraph, PackGraph | None]:
    """Choose the embedder and, where there is one, the detector."""
    embedders = [graph for graph in graphs if graph.role is Role.EMBEDDER]
    detectors = [graph for graph in graphs if graph.role in (Role.SCRFD, Role.YUNET)]
    for kind, several in (("embedders", embedders), ("detectors", detectors)):
        if len(several) > 1:
            names = " and ".join(graph.file for graph in several)
            raise PackError(
                f"{folder} has {len(several)} {kind}: {names}; leave one of them there."
            )
    blind = [graph for graph in graphs if graph.role is Role.SCRFD_WITHOUT_KEYPOINTS]
    if blind and not detectors:
        raise PackError(
            f"{blind[0].path} is a SCRFD detector without keypoints and cannot align faces; use"
            " the variant with keypoints (its name mostly ends in kps or bnkps)."
        )
    if not embedders:
        seen = "; ".join(f"{graph.file}: {graph.reason}" for graph in graphs)
        raise PackError(f"{folder} has no embedder. Seen: {seen}.")
    return embedders[0], detectors[0] if detectors else None
