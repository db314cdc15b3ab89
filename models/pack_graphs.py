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


class Role(StrEnum):
    """What a graph can do for a pack."""

    SCRFD = "scrfd"
    SCRFD_WITHOUT_KEYPOINTS = "scrfd-without-keypoints"
    YUNET = "yunet"
    LIVENESS = "liveness"
    EMBEDDER = "embedder"
    UNUSED = "unused"


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


def read_graphs(
    pack: Path, *, providers: Sequence[str] = ("cpu",), threads: int | None = None
) -> list[PackGraph]:
    """Load and recognise every graph of a pack, also of one that cannot be used.

    Raises
    ------
    PackError
        If there is no graph, a file that is none, or a wrong ``pack.toml``.
    """
    files = _files(pack)
    stated = read_pack_file(files[0].parent)
    return [_read_graph(file, stated, providers, threads) for file in files]


def _files(pack: Path) -> list[Path]:
    """Find the graphs of a folder, or the one that a file is."""
    if pack.is_file():
        if pack.suffix.lower() != _SUFFIX:
            raise PackError(f"{pack} is not an .onnx file; name a pack folder or an embedder.")
        return [pack]
    if not pack.is_dir():
        raise PackError(f"{pack} does not exist; name a folder of .onnx files or one embedder.")
    for folder in (pack, pack / pack.resolve().name):
        # Hidden files are leftovers of archives ("._model.onnx" of macOS).
        files = sorted(
            file
            for file in folder.glob("[!.]*")
            if file.suffix.lower() == _SUFFIX and file.is_file()
        )
        if files:
            return files
    raise PackError(f"{pack} has no .onnx files; put the weights of a pack there.")


def _read_graph(
    path: Path, stated: PackFile, providers: Sequence[str], threads: int | None
) -> PackGraph:
    try:
        model = path.read_bytes()
    except OSError as error:
        raise PackError(f"{path} cannot be read: {error.strerror}.") from error
    session = Session(model, name=path.name, providers=providers, threads=threads)
    if stated.liveness_of(path.name) is not None:
        role, reason = Role.LIVENESS, "stated in pack.toml"
    else:
        role, reason = classify(session.inputs, session.outputs)
    return PackGraph(path, session, hashlib.sha256(model).hexdigest(), role, reason)


def image_size(inputs: Sequence[Tensor]) -> tuple[int | None, int | None] | None:
    """Height and width of the only input where it is an image, else ``None``."""
    if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].shape[1] not in (3, None):
        return None
    return inputs[0].shape[2], inputs[0].shape[3]


def classify(inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> tuple[Role, str]:
    """Route a graph by its signature (docs/models.md "Packs")."""
    size = image_size(inputs)
    widths = sorted(output.shape[-1] or 0 if output.shape else 0 for output in outputs)
    if size is None:
        return Role.UNUSED, "its input is not one float32 image (batch, 3, h, w)"
    if {output.name for output in outputs}.issuperset(YUNET_OUTPUTS):
        return Role.YUNET, "outputs cls_8 ... kps_32"
    match size, widths:
        case _, [1, 1, 1, 4, 4, 4, 10, 10, 10]:
            return Role.SCRFD, "scores, boxes and five points at three strides (9 outputs)"
        case _, [1, 1, 1, 4, 4, 4]:
            return (
                Role.SCRFD_WITHOUT_KEYPOINTS,
                "scores and boxes at three strides without keypoints (6 outputs): it cannot align",
            )
        case (96, 96), [3]:
            return Role.UNUSED, "96 x 96 input and 3 output values: gender and age"
        case (80, 80), [3]:
            return Role.LIVENESS, "80 x 80 input and 3 output values (MiniFASNet)"
        case (192, 192), _:
            return Role.UNUSED, "192 x 192 input: landmarks"
    height, width = size
    reason = None
    if height is None or width is None:
        reason = "the input size is open; where this is an embedder, export it with its own size"
    elif height != width or height < 112 or height % 16:
        reason = f"the {width} x {height} input is not a square of at least 112 that 16 divides"
    elif len(outputs) != 1 or len(outputs[0].shape) != 2:
        reason = "no known detector, and not exactly one output (batch, values)"
    elif widths[0] in (2, 3):
        reason = (
            f"{widths[0]} output values are no embedding; a liveness graph is stated in pack.toml,"
            " under [[liveness]]"
        )
    if reason is not None:
        return Role.UNUSED, reason
    return Role.EMBEDDER, f"square {width} x {height} input and one 2-D output"


def pick(graphs: Sequence[PackGraph]) -> tuple[PackGraph, PackGraph | None]:
    """Choose the embedder and, where there is one, the detector."""
    folder = graphs[0].path.parent
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
