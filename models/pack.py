"""Model packs: user-supplied weights that together turn a photo into an embedding."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from models.alignment import TEMPLATE_NAME, align, template
from models.boxes import Face, ranked
from models.decoding import DEFAULT_LIMITS, ImageLimits, decode_image
from models.demo import DEMO_DIMENSION, is_demo_model, require_face
from models.detection import DEFAULT_SIZE, Detector, find_faces
from models.embedding import Embedder, Preprocessing
from models.errors import ImageError, ModelError, PackError
from models.pack_file import PackFile, Triple, read_pack_file
from models.quality import DEFAULT_QUALITY, Quality, QualityLimits, check, measure, select_face
from models.scrfd import Scrfd
from models.sessions import Session
from models.signature import DETECTORS, Role, Signature, classify, read_signature
from models.yunet import YuNet

_SUFFIX = ".onnx"
# A ResNet-100 embedder has 260 MB; protobuf itself ends at 2 GiB.
_MAX_MODEL_BYTES = 2**30


class FacePolicy(StrEnum):
    """What a photo with several faces means."""

    SINGLE = "single"
    LARGEST = "largest"


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
class DetectorInfo:
    """The detector of a pack: recorded with a contract, not bound by it."""

    kind: str
    file: str
    sha256: str
    input_size: tuple[int, int]


@dataclass(frozen=True)
class PackInfo:
    """What identifies a pack.

    Attributes
    ----------
    name
        Of the folder, or of the file without its suffix.
    n
        Embedding dimension.
    embedder_file, embedder_sha256
        Name and SHA-256 (hex) of the embedder's file.
    preprocessing
        JSON-able; with the hash it decides whether embeddings are comparable.
    detector
        ``None`` where the pack takes aligned crops only.
    """

    name: str
    n: int
    embedder_file: str
    embedder_sha256: str
    preprocessing: dict[str, Any]
    detector: DetectorInfo | None


@dataclass(frozen=True, eq=False)
class FaceSample:
    """One face of a photo, embedded.

    Attributes
    ----------
    embedding
        float32, shape (n,), unit norm. Never shown by ``repr``.
    quality
        What was measured.
    box
        x1, y1, x2, y2 in pixels of the upright photo; ``None`` for crops that came aligned.
    """

    embedding: NDArray[np.float32] = field(repr=False)
    quality: Quality
    box: tuple[float, float, float, float] | None


@dataclass(frozen=True)
class _Graph:
    """One file of a pack, read once: what is hashed is what runs."""

    path: Path
    model: bytes = field(repr=False)
    sha256: str
    signature: Signature
    role: Role
    reason: str


class ModelPack:
    """An embedder with its preprocessing and, usually, a detector.

    Make one with `load`. All methods are safe from several threads at once.

    Examples
    --------
    >>> from models.demo import build_demo_pack
    >>> from models.synthetic import draw_face, encode_photo
    >>> pack = ModelPack.load(build_demo_pack(tmp_path))
    >>> one, same, other = (
    ...     pack.embed_photo(encode_photo(draw_face(*seeds))).embedding
    ...     for seeds in ((7, 0), (7, 1), (8, 0))
    ... )
    >>> bool(one @ same > one @ other)
    True
    """

    def __init__(self, info: PackInfo, *, embedder: Embedder, detector: Detector | None) -> None:
        self.info = info
        self._embedder = embedder
        self._detector = detector
        self._demo = (
            detector is None and info.n == DEMO_DIMENSION and is_demo_model(info.embedder_sha256)
        )

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        providers: Sequence[str] = ("cpu",),
        threads: int | None = None,
        flip: bool = False,
        detector_size: int | None = None,
    ) -> "ModelPack":
        """Load a pack from a folder of ``.onnx`` files, or from a single embedder file.

        Parameters
        ----------
        path
            Folder (one nested folder of the same name is tolerated) or file.
        providers
            Execution providers, best first; an absent one is an error.
        threads
            Threads inside one inference; ``None`` for all cores.
        flip
            Add the mirrored crop's raw embedding. Bound by the contract.
        detector_size
            Side of the detection canvas, a multiple of 32; default ``pack.toml``, then 640.

        Raises
        ------
        PackError
            If the pack is absent, broken, unknown or ambiguous. Names the file and the remedy.
        ProviderUnavailable
            If a requested provider is absent or does not start.
        """
        location, stated = _locate(Path(path))
        graphs = [_read(file, stated) for file in location.files]
        embedder_graph, detector_graph = _pick(graphs, location.folder)
        embedder = _embedder(embedder_graph, stated, flip, providers, threads)
        detector = detector_info = None
        if detector_graph is not None:
            size = detector_size or stated.detector_size or DEFAULT_SIZE
            detector = _detector(detector_graph, size, providers, threads)
            # A size without a common template fails here rather than at the first photo.
            template(embedder.preprocessing.size)
            detector_info = DetectorInfo(
                kind=detector.kind,
                file=detector_graph.path.name,
                sha256=detector_graph.sha256,
                input_size=detector.sizes[0],
            )
        info = PackInfo(
            name=location.name,
            n=embedder.n,
            embedder_file=embedder_graph.path.name,
            embedder_sha256=embedder_graph.sha256,
            preprocessing=embedder.preprocessing.as_dict(),
            detector=detector_info,
        )
        return cls(info, embedder=embedder, detector=detector)

    @property
    def crop_size(self) -> int:
        """Side of the aligned crops in pixels."""
        return self._embedder.preprocessing.size

    def detect(self, image: NDArray[np.uint8]) -> list[Face]:
        """Faces of an image, the one most likely meant first (`boxes.centre_rank`).

        Parameters
        ----------
        image
            RGB uint8, shape (h, w, 3).

        Raises
        ------
        PackError
            If the pack has no detector.
        """
        if self._detector is None:
            raise PackError(
                f"The pack {self.info.name} has no detector; add a SCRFD or YuNet .onnx file to"
                " its folder, or send aligned crops."
            )
        return ranked(find_faces(self._detector, image), image.shape)

    def align(self, image: NDArray[np.uint8], face: Face) -> NDArray[np.uint8]:
        """Crop of a face on the five-point template, uint8, shape (s, s, 3)."""
        return align(image, face.keypoints, size=self.crop_size)

    def embed(self, aligned: NDArray[np.uint8], *, flip: bool | None = None) -> NDArray[np.float32]:
        """Embed aligned crops.

        Parameters
        ----------
        aligned
            RGB uint8, shape (B, s, s, 3).
        flip
            Overrides the pack's own setting, for experiments.

        Returns
        -------
        ndarray of float32, shape (B, n)
            Unit rows.
        """
        chosen = self._embedder.preprocessing.flip if flip is None else flip
        return self._embedder.embed(aligned, flip=chosen)

    def embed_both(
        self, aligned: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Embed aligned crops without and with the mirror image; see :meth:`embed`."""
        return self._embedder.embed_both(aligned)

    def crop_photo(
        self,
        data: bytes,
        *,
        policy: FacePolicy = FacePolicy.SINGLE,
        quality: QualityLimits | None = DEFAULT_QUALITY,
        limits: ImageLimits = DEFAULT_LIMITS,
    ) -> tuple[NDArray[np.uint8], Quality, Face | None]:
        """Decode, find the face, align and check it: `embed_photo` without the embedding."""
        image = decode_image(data, limits=limits)
        if self._detector is None:
            crop = self.as_aligned(image)
            measured = measure(crop, None)
            face = None
        else:
            face = select_face(
                self.detect(image), single=policy is FacePolicy.SINGLE, limits=quality
            )
            crop = self.align(image, face)
            measured = measure(crop, face)
        if quality is not None:
            recommended = 0.0 if self._detector is None else self._detector.recommended_score
            check(measured, quality, recommended_score=recommended)
            if self._demo:
                require_face(crop)
        return crop, measured, face

    def embed_photo(
        self,
        data: bytes,
        *,
        policy: FacePolicy = FacePolicy.SINGLE,
        quality: QualityLimits | None = DEFAULT_QUALITY,
        limits: ImageLimits = DEFAULT_LIMITS,
    ) -> FaceSample:
        """From the bytes of a photo to the embedding of its face.

        A pack without a detector takes the photo as an aligned crop: square, resized to the
        embedder's size where it differs.

        Parameters
        ----------
        data
            JPEG, PNG or WebP.
        policy
            ``SINGLE`` refuses a photo with several faces; ``LARGEST`` takes the
            first in rank, the largest and most central one.
        quality
            Limits; ``None`` checks nothing but that there is a face.
        limits
            Of the decoder.

        Raises
        ------
        ImageError
            If the bytes are no acceptable picture.
        FaceError
            `NoFace`, `MultipleFaces`, `FaceTooSmall` or `LowQuality`.
        ModelError
            If inference fails.
        """
        crop, measured, face = self.crop_photo(data, policy=policy, quality=quality, limits=limits)
        box = None
        if face is not None:
            x1, y1, x2, y2 = (float(value) for value in face.box)
            box = (x1, y1, x2, y2)
        return FaceSample(embedding=self.embed(crop[None])[0], quality=measured, box=box)

    def as_aligned(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Take a square picture as an aligned crop, resized to the embedder's size.

        Raises
        ------
        ImageError
            If it is not square.
        """
        height, width = image.shape[:2]
        if height != width:
            raise ImageError(
                "unsupported_image",
                f"An aligned crop must be square; this picture has {width} x {height} pixels. For"
                " other photos the pack needs a detector.",
            )
        size = self.crop_size
        if height == size:
            return image
        shrink = cv2.INTER_AREA if height > size else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, (size, size), interpolation=shrink), dtype=np.uint8)


def inspect(path: str | Path) -> list[GraphReport]:
    """What every graph of a pack is, and why; unusable packs are reported, not refused.

    Raises
    ------
    PackError
        If there is no ``.onnx`` file, ``pack.toml`` is broken, or a file is no ONNX model.
    """
    location, stated = _locate(Path(path))
    return [
        GraphReport(
            file=graph.path.name,
            role=graph.role,
            reason=graph.reason,
            sha256=graph.sha256,
            inputs=_shapes(graph.signature.inputs),
            outputs=_shapes(graph.signature.outputs),
        )
        for graph in (_read(file, stated) for file in location.files)
    ]


def _shapes(tensors: Sequence[Any]) -> str:
    return ", ".join(
        f"{tensor.name}[{', '.join('?' if d is None else str(d) for d in tensor.shape)}]"
        for tensor in tensors
    )


@dataclass(frozen=True)
class _Location:
    name: str
    folder: Path
    files: list[Path]


def _locate(path: Path) -> tuple[_Location, PackFile]:
    if path.is_file():
        if path.suffix.lower() != _SUFFIX:
            raise PackError(f"{path} is not an .onnx file; name a pack folder or an embedder.")
        return _Location(path.stem, path.parent, [path]), read_pack_file(path.parent)
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
            return _Location(path.resolve().name, folder, files), read_pack_file(folder)
    raise PackError(f"{path} has no .onnx files; put the weights of a pack there.")


def _read(path: Path, stated: PackFile) -> _Graph:
    try:
        if path.stat().st_size > _MAX_MODEL_BYTES:
            raise PackError(f"{path} is larger than {_MAX_MODEL_BYTES} bytes: not a face model.")
        model = path.read_bytes()
    except OSError as error:
        raise PackError(f"{path} cannot be read: {error.strerror}.") from error
    signature = read_signature(model, name=str(path))
    role, reason = classify(signature, input_size=stated.input_size)
    digest = hashlib.sha256(model).hexdigest()
    return _Graph(path, model, digest, signature, role, reason)


def _pick(graphs: Sequence[_Graph], folder: Path) -> tuple[_Graph, _Graph | None]:
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


def _embedder(
    graph: _Graph,
    stated: PackFile,
    flip: bool,
    providers: Sequence[str],
    threads: int | None,
) -> Embedder:
    size = graph.signature.image_size
    fixed = None if size is None else size[0]
    if fixed is not None and stated.input_size not in (None, fixed):
        raise PackError(
            f"pack.toml states input_size {stated.input_size}, and {graph.path} takes {fixed}"
            " only; remove the key."
        )
    inside = graph.signature.normalises
    mean: Triple = stated.mean or ((0.0,) * 3 if inside else (127.5,) * 3)
    scale: Triple = stated.scale or ((1.0,) * 3 if inside else (127.5,) * 3)
    preprocessing = Preprocessing(
        alignment=TEMPLATE_NAME,
        size=int(fixed or stated.input_size or 0),
        channel_order=stated.channel_order or "rgb",
        mean=mean,
        scale=scale,
        flip=flip,
    )
    image = graph.signature.inputs[0]
    session = Session(graph.model, name=graph.path.name, providers=providers, threads=threads)
    session.load()
    try:
        return Embedder(
            session, input_name=image.name, preprocessing=preprocessing, batch=image.shape[0]
        )
    except ModelError as error:
        raise PackError(f"{graph.path} was routed as an embedder and fails: {error}") from error


def _detector(graph: _Graph, size: int, providers: Sequence[str], threads: int | None) -> Detector:
    if size < 32 or size % 32:
        raise PackError(f"The detector size must be a multiple of 32, not {size}.")
    image = graph.signature.inputs[0]
    height, width = image.shape[2:]
    fixed = (height, width) if height is not None and width is not None else None
    session = Session(graph.model, name=graph.path.name, providers=providers, threads=threads)
    session.load()
    kind = Scrfd if graph.role is Role.SCRFD else YuNet
    return kind(session, input_name=image.name, size=size, fixed=fixed)
