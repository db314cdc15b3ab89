"""The graphs of a model pack: found in a folder, read once, and recognised by their signatures."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from models.errors import PackError
from models.pack_file import PackFile, read_pack_file
from models.signature import DETECTORS, Role, Signature, classify, read_signature

_SUFFIX = ".onnx"
# A ResNet-100 embedder has 260 MB; protobuf itself ends at 2 GiB.
_MAX_MODEL_BYTES = 2**30


@dataclass(frozen=True)
class GraphReport:
    """What one ``.onnx`` file of a pack is, and why."""

    file: str
    role: Role
    reason: str
    sha256: str
    inputs: str
    outputs: str


@dataclass(frozen=True)
class PackGraph:
    """One file of a pack, read once: what is hashed is what runs."""

    path: Path
    model: bytes = field(repr=False)
    sha256: str
    signature: Signature
    role: Role
    reason: str


def inspect(path: str | Path) -> list[GraphReport]:
    """What every graph of a pack is, and why; unusable packs are reported, not refused.

    Raises
    ------
    PackError
        If there is no ``.onnx`` file, ``pack.toml`` is broken, or a file is no ONNX model.
    """
    location, stated = locate(Path(path))
    return [
        GraphReport(
            file=graph.path.name,
            role=graph.role,
            reason=graph.reason,
            sha256=graph.sha256,
            inputs=_shapes(graph.signature.inputs),
            outputs=_shapes(graph.signature.outputs),
        )
        for graph in (read_graph(file, stated) for file in location.files)
    ]


def _shapes(tensors: Sequence[Any]) -> str:
    return ", ".join(
        f"{tensor.name}[{', '.join('?' if d is None else str(d) for d in tensor.shape)}]"
        for tensor in tensors
    )


@dataclass(frozen=True)
class Location:
    """Where a pack was found: its name, its folder, and its ``.onnx`` files."""

    name: str
    folder: Path
    files: list[Path]


def locate(path: Path) -> tuple[Location, PackFile]:
    """Find the graphs of a folder, or the one that a file is, and what ``pack.toml`` states.

    Raises
    ------
    PackError
        If there is none, or ``pack.toml`` is broken.
    """
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


def read_graph(path: Path, stated: PackFile) -> PackGraph:
    """Read and recognise one graph.

    Raises
    ------
    PackError
        If the file cannot be read, is too large, or is no ONNX model.
    """
    try:
        if path.stat().st_size > _MAX_MODEL_BYTES:
            raise PackError(f"{path} is larger than {_MAX_MODEL_BYTES} bytes: not a face model.")
        model = path.read_bytes()
    except OSError as error:
        raise PackError(f"{path} cannot be read: {error.strerror}.") from error
    signature = read_signature(model, name=str(path))
    if path.name in stated.liveness:
        role, reason = Role.LIVENESS, "stated in pack.toml"
    else:
        role, reason = classify(signature, input_size=stated.input_size)
    digest = hashlib.sha256(model).hexdigest()
    return PackGraph(path, model, digest, signature, role, reason)


def pick(graphs: Sequence[PackGraph], folder: Path) -> tuple[PackGraph, PackGraph | None]:
    """Choose the embedder and, where there is one, the detector.

    Raises
    ------
    PackError
        If there is no embedder, more than one of a kind, or only a detector without keypoints.
    """
    embedders = [graph for graph in graphs if graph.role is Role.EMBEDDER]
    detectors = [graph for graph in graphs if graph.role in DETECTORS]
    for kind, several in (("embedders", embedders), ("detectors", detectors)):
        if len(several) > 1:
            names = " and ".join(graph.path.name for graph in several)
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
        seen = "; ".join(f"{graph.path.name}: {graph.reason}" for graph in graphs)
        raise PackError(f"{folder} has no embedder. Seen: {seen}.")
    return embedders[0], detectors[0] if detectors else None
