"""Key points, crops and embeddings beside those of the `insightface` package, at an equal canvas.

The package is no dependency, not even of development: it asks for `opencv-python`, which replaces
the headless OpenCV in place and needs a display's libraries. Install it in an environment of its
own beside this one (`pip install --no-deps insightface requests tqdm`).

Every photo is taken as it is, squeezed across, and squeezed downward. The package finds faces on
one canvas; this program is compared by the same single pass, and by the whole way from the bytes
of a photo, which differs where a face fills the picture.
"""

import argparse
import importlib
import io
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from models.boxes import ranked
from models.decoding import decode_image
from models.pack import ModelPack

SQUEEZES = ((1.0, 1.0), (0.6, 1.0), (1.0, 0.55))  # across, downward


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the args."""
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--pack", type=Path, required=True, help="SCRFD and an embedder")
    parser.add_argument("--size", type=int, default=640)
    parser.add_argument("--every", type=int, default=1, help="take every n-th photo")


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return the worst and the median difference of each kind."""
    try:
        package = importlib.import_module("insightface")
    except ImportError:
        sys.exit("insightface is not installed in this environment: nothing was compared")
    pack = ModelPack.load(args.pack, threads=1, detector_size=args.size)
    detector, embedder = theirs(args.pack, pack, args.size)
    align = importlib.import_module("insightface.utils.face_align").norm_crop
    points: list[float] = []
    grey: list[int] = []
    cosines: dict[str, list[float]] = {"one pass": [], "whole way": []}
    missed = pictures = 0
    for path in sorted(args.photos.glob("*/*.jpg"))[:: args.every]:
        photo = decode_image(path.read_bytes())
        for across, down in SQUEEZES:
            image = squeezed(photo, across, down)
            pictures += 1
            bgr = np.ascontiguousarray(image[:, :, ::-1])
            boxes, keypoints = detector.detect(bgr, max_num=1)
            assert pack._detector is not None
            faces = ranked(pack._detector.detect_once(image, pack._detector.sizes[0]), image.shape)
            if not faces or not len(boxes):
                assert not faces
                assert not len(boxes)
                missed += 1
                continue
            crop, ours = align(bgr, keypoints[0]), pack.align(image, faces[0])
            points.append(float(np.abs(keypoints[0] - faces[0].keypoints).max()))
            grey.append(int(np.abs(crop[:, :, ::-1].astype(int) - ours).max()))
            right = embedder.get_feat(crop).ravel()
            right /= np.linalg.norm(right)
            cosines["one pass"].append(float(right @ pack.embed(ours[None])[0]))
            sample = pack.embed_photo(png(image), policy=None, quality=None)
            cosines["whole way"].append(float(right @ sample.embedding))
    return [
        {
            "insightface": package.__version__,
            "canvas": args.size,
            "pictures": pictures,
            "no face, by both": missed,
            "key points, at most, pixels": f"{max(points):.2g}",
            "crops, at most, grey levels": max(grey),
            "embeddings by": name,
            "least cosine": f"{min(values):.7f}",
            "median": f"{np.median(values):.7f}",
            "below 0.9999": sum(value < 0.9999 for value in values),
        }
        for name, values in cosines.items()
    ]


def theirs(folder: Path, pack: ModelPack, size: int) -> tuple[Any, Any]:
    """Open the package's detector and embedder on the graphs of the pack."""
    assert pack.info.detector is not None
    zoo = importlib.import_module("insightface.model_zoo.scrfd")
    detector = zoo.SCRFD(str(folder / pack.info.detector.file))
    detector.prepare(-1, input_size=(size, size), det_thresh=0.5)
    arcface = importlib.import_module("insightface.model_zoo.arcface_onnx")
    return detector, arcface.ArcFaceONNX(str(folder / pack.info.embedder_file))


def squeezed(photo: NDArray[np.uint8], across: float, down: float) -> NDArray[np.uint8]:
    """Scale a photo by two factors."""
    height, width = photo.shape[:2]
    size = (round(width * across), round(height * down))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def png(image: NDArray[np.uint8]) -> bytes:
    """Encode without loss."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG", compress_level=1)
    return file.getvalue()
