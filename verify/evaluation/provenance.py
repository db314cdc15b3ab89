"""What figures came from: the model and the software."""

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from verify.evaluation.plan import Json

SOFTWARE = "veilface"
_LIBRARIES = ("numpy", "scipy", "onnxruntime", "opencv-python-headless")


@dataclass(frozen=True)
class Model:
    """Where embeddings came from."""

    n: int
    facts: Json  # pack and detector, or file of embeddings with its SHA-256
    embedder_sha256: str | None = None  # None where embeddings came from a file
    preprocessing: Mapping[str, Any] | None = None

    def json(self) -> Json:
        """Everything as JSON."""
        known: Json = {"n": self.n, **self.facts}
        if self.embedder_sha256 is not None:
            known["embedder_sha256"] = self.embedder_sha256
            known["preprocessing"] = dict(self.preprocessing or {})
        return known


def software() -> Json:
    """Versions that figures depend on."""
    return {
        SOFTWARE: version(SOFTWARE),
        "python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES},
    }
