"""What figures came from: the model and the software."""

import platform
from importlib.metadata import version

from models.pack import PackInfo
from verify.evaluation.plan import Json

SOFTWARE = "veilface"
_LIBRARIES = ("numpy", "scipy", "onnxruntime", "opencv-python-headless")


def model_facts(info: PackInfo, recorded: Json) -> Json:
    """Where embeddings came from: what a contract binds of a pack, and the recorded facts."""
    return {
        "n": info.n,
        **recorded,
        "embedder_sha256": info.embedder_sha256,
        "preprocessing": dict(info.preprocessing),
    }


def software() -> Json:
    """Versions that figures depend on."""
    return {
        SOFTWARE: version(SOFTWARE),
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
    }
