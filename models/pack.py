"""Model packs: user-supplied weights that together turn a photo into an embedding."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import cv2
import numpy as np
from numpy.typing import NDArray

from models.alignment import TEMPLATE_NAME, align, template
from models.boxes import Face, ranked
from models.decoding import decode_image, picture_digest
from models.demo import DEMO_DIMENSION, is_demo_model, require_face
from models.detection import DEFAULT_SIZE, Detector, find_faces, require_upright
from models.detectors import Scrfd, YuNet
from models.embedding import Embedder, Preprocessing, Rows, normalises_inside
from models.errors import ImageError, ModelError, PackError, PhotoRejected
from models.faces import FaceCrop, FaceSample
from models.liveness import PassiveLiveness, open_liveness
from models.pack_file import PackFile, read_pack_file
from models.pack_graphs import PackGraph, Role, image_size, pick, read_graphs
from models.quality import DEFAULT_QUALITY, Quality, QualityLimits, check, measure
from models.selection import FacePolicy, select_face


@dataclass(frozen=True)
class DetectorInfo:
    """The detector of a pack: recorded with a contract, not bound by it."""

    kind: str
    file: Path
    sha256: str
    input_size: tuple[int, int]


@dataclass(frozen=True)
class PackInfo:
    """What identifies a pack; embedder and preprocessing decide which embeddings compare."""

    name: str
    n: int
    embedder_file: Path
    embedder_sha256: str
    preprocessing: dict[str, Any]
    detector: DetectorInfo | None  # None where the pack takes aligned crops only


class PhotoOptions(TypedDict, total=False):
    """How a photo becomes a face."""

    policy: FacePolicy | None  # which of several faces is meant; None: the most central one
    quality: QualityLimits | None  # None checks nothing but that there is an upright face
    liveness: bool  # also say how live the face looks; the pack needs a liveness graph
    digested: bool  # also give the digest of the decoded photo


class ModelPack:
    """An embedder with its preprocessing and, usually, a detector; perhaps liveness graphs.

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

    def __init__(
        self,
        info: PackInfo,
        *,
        embedder: Embedder,
        detector: Detector | None,
        liveness: PassiveLiveness | None = None,
    ) -> None:
        self.info = info
        self.liveness = liveness
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
    ) -> "ModelPack":
        """Load a pack from a folder of ``.onnx`` files, or from a single embedder file.

        Parameters
        ----------
        providers
            Execution providers, best first; an absent one is an error.
        threads
            Threads inside one inference; ``None`` for all cores.
        flip
            Add the mirrored crop's raw embedding. Bound by the contract.

        Raises
        ------
        PackError
            If the pack is absent, broken, unknown or ambiguous. Names the file and the remedy.
        ProviderUnavailable
            If a requested provider is absent or does not start.
        """
        path = Path(path)
        graphs = read_graphs(path, providers=providers, threads=threads)
        folder = graphs[0].path.parent
        stated = read_pack_file(folder)
        embedder_graph, detector_graph = pick(graphs)
        embedder = _embedder(embedder_graph, stated, flip)
        detector = detector_info = None
        if detector_graph is not None:
            # A size without a common template fails here rather than at the first photo.
            template(embedder.preprocessing.size)
            detector = _detector(detector_graph, stated)
            detector_info = DetectorInfo(
                kind=detector.kind,
                file=detector_graph.path,
                sha256=detector_graph.sha256,
                input_size=detector.sizes[0],
            )
        info = PackInfo(
            name=path.stem if path.is_file() else path.resolve().name,
            n=embedder.n,
            embedder_file=embedder_graph.path,
            embedder_sha256=embedder_graph.sha256,
            preprocessing=embedder.preprocessing.as_dict(),
            detector=detector_info,
        )
        liveness = open_liveness(
            [graph for graph in graphs if graph.role is Role.LIVENESS],
            stated,
            folder,
            detects=detector is not None,
        )
        return cls(info, embedder=embedder, detector=detector, liveness=liveness)

    @property
    def crop_size(self) -> int:
        """Side of the aligned crops in pixels."""
        return self._embedder.preprocessing.size

    def detect(self, image: NDArray[np.uint8]) -> list[Face]:
        """Faces of an RGB image, the one most likely meant first (`boxes.ranked`)."""
        if self._detector is None:
            raise PackError(
                f"The pack {self.info.name} has no detector; add a SCRFD or YuNet .onnx file to"
                " its folder, or send aligned crops."
            )
        return ranked(find_faces(self._detector, image), image.shape)

    def align(self, image: NDArray[np.uint8], face: Face) -> NDArray[np.uint8]:
        """Crop of a face on the five-point template, uint8, shape (s, s, 3)."""
        return align(image, face.keypoints, size=self.crop_size)

    def embed(self, aligned: NDArray[np.uint8]) -> Rows:
        """Embed aligned crops, RGB uint8 (B, s, s, 3), to unit rows, float32 (B, n)."""
        return self._embedder.embed(aligned, flip=self._embedder.preprocessing.flip)

    def crop_photo(
        self,
        data: bytes,
        *,
        policy: FacePolicy | None = FacePolicy.DOMINANT,
        quality: QualityLimits | None = DEFAULT_QUALITY,
        liveness: bool = False,
        digested: bool = False,
    ) -> FaceCrop:
        """Decode, find the face, align and check it: `embed_photo` without the embedding.

        The whole picture is dropped; what `liveness` and `digested` ask for is taken of it before.
        """
        if liveness and self.liveness is None:
            raise PackError(
                f"The pack {self.info.name} has no liveness graph; add one to its folder"
                " (docs/liveness.md)."
            )
        image = decode_image(data)
        face = score = None
        if self._detector is None:
            crop = self.as_aligned(image)
        else:
            face = select_face(
                self.detect(image),
                policy,
                shape=image.shape,
                min_size=0.0 if quality is None else quality.min_face_size,
            )
            crop = self.align(image, face)
            require_upright(self._detector, face, crop)
        taken = FaceCrop(crop=crop, quality=measure(crop, face, image), face=face)
        if quality is not None:
            self.require_quality(taken, quality)
        if liveness and self.liveness is not None and taken.box is not None:
            score = self.liveness.score(image, taken.box)
        return replace(taken, liveness=score, picture=picture_digest(image) if digested else None)

    def require_quality(self, taken: FaceCrop, limits: QualityLimits = DEFAULT_QUALITY) -> None:
        """Refuse a face that fails a limit, by what this pack's detector recommends."""
        recommended = 0.0 if self._detector is None else self._detector.recommended_score
        check(taken.quality, limits, recommended_score=recommended)
        if self._demo:
            require_face(taken.crop)

    def is_clear(self, quality: Quality) -> bool:
        """Whether the detector was as sure of a face as it is of one that nothing covers."""
        if quality.score is None or self._detector is None:
            return True
        return quality.score >= self._detector.clear_score

    def embed_photo(self, data: bytes, **options: Unpack[PhotoOptions]) -> FaceSample:
        """From the bytes of a photo to the embedding of its face.

        A pack without a detector takes the photo as an aligned crop: square, resized to the
        embedder's size where it differs.

        Raises
        ------
        PackError
            If liveness is asked of a pack that has no graph for it.
        ImageError
            If the bytes are no acceptable picture.
        FaceError
            `NoFace`, `MultipleFaces`, `FaceTooSmall` or `LowQuality`.
        ModelError
            If inference fails.
        """
        taken = self.crop_photo(data, **options)
        return FaceSample(**vars(taken), embedding=self.embed(taken.crop[None])[0])

    def embed_photos(
        self, photos: Sequence[bytes], **options: Unpack[PhotoOptions]
    ) -> list[FaceSample]:
        """Embed photo files in their order; all or none. A file given twice is embedded once.

        Raises
        ------
        PhotoRejected
            Where one of them has no usable face, by its position.
        """
        samples: dict[bytes, FaceSample] = {}
        for index, photo in enumerate(photos):
            if photo in samples:
                continue
            try:
                samples[photo] = self.embed_photo(photo, **options)
            except ModelError as error:
                raise PhotoRejected(index, error, count=len(photos)) from error
        return [samples[photo] for photo in photos]

    def as_aligned(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Take a square picture as an aligned crop, resized to the embedder's size."""
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


def _embedder(graph: PackGraph, pack_file: PackFile, flip: bool) -> Embedder:
    stated = pack_file.embedder
    side = (image_size(graph.session.inputs) or (None, None))[0] or 0
    try:
        is_inside = None in (stated.mean, stated.scale) and normalises_inside(graph.session, side)
        mean, scale = (0.0, 1.0) if is_inside else (127.5, 127.5)
        preprocessing = Preprocessing(
            alignment=TEMPLATE_NAME,
            size=side,
            channel_order=stated.channel_order or "rgb",
            mean=stated.mean or (mean,) * 3,
            scale=stated.scale or (scale,) * 3,
            flip=flip,
        )
        return Embedder(graph.session, preprocessing)
    except ModelError as error:
        raise PackError(f"{graph.path} was routed as an embedder and fails: {error}") from error


def _detector(graph: PackGraph, stated: PackFile) -> Detector:
    kind = Scrfd if graph.role is Role.SCRFD else YuNet
    return kind(graph.session, size=stated.detector.input_size or DEFAULT_SIZE)
