"""From bytes to embedding: decoding, packs, detection, alignment, embedding.

Photos of strangers come in, unit vectors go out; nothing here knows of templates or of HTTP.
"""

import os

import cv2

# Before onnxruntime loads: its official builds report usage to their maker, and keep a device id
# and a database of events below the home folder. A service for faces does neither.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

from models.boxes import Face
from models.cache import CacheSealer, EmbeddingCache
from models.decoding import ImageLimits, decode_image
from models.errors import (
    CacheError,
    FaceError,
    FaceTooSmall,
    ImageError,
    LowQuality,
    ModelError,
    MultipleFaces,
    NoFace,
    PackError,
    ProviderUnavailable,
)
from models.extraction import Extraction, Extractor, Failure
from models.faces import FaceSample
from models.liveness import PassiveLiveness
from models.pack import (
    DetectorInfo,
    FacePolicy,
    ModelPack,
    PackInfo,
)
from models.pack_graphs import GraphReport, inspect
from models.quality import Quality, QualityLimits

__all__ = [
    "CacheError",
    "CacheSealer",
    "DetectorInfo",
    "EmbeddingCache",
    "Extraction",
    "Extractor",
    "Face",
    "FaceError",
    "FacePolicy",
    "FaceSample",
    "FaceTooSmall",
    "Failure",
    "GraphReport",
    "ImageError",
    "ImageLimits",
    "LowQuality",
    "ModelError",
    "ModelPack",
    "MultipleFaces",
    "NoFace",
    "PackError",
    "PackInfo",
    "PassiveLiveness",
    "ProviderUnavailable",
    "Quality",
    "QualityLimits",
    "decode_image",
    "inspect",
]

# Requests run beside each other, and OpenCV's threads would wait for each other. And a process
# that has started them cannot be forked: in the child they are missing, and waited for.
cv2.setNumThreads(0)
