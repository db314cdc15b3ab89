"""The graphs of the pack that clients may fetch: named by their hashes."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from api.http.errors import ApiError, StartError
from api.settings import Settings
from models.pack import ModelPack


@dataclass
class ServedGraph:
    """One graph: SHA-256 (hexadecimal) of its file, its input in pixels.

    Of a detector, `kind` says how its output is read. `size` (bytes) and `modified_ns` are those of
    the file at the start of the service.
    """

    role: Literal["detector", "embedder"]
    kind: str | None
    sha256: str
    input_size: tuple[int, int]
    path: Path = field(repr=False)
    size: int = field(init=False)
    modified_ns: int = field(init=False)

    def __post_init__(self) -> None:
        stat = self.path.stat()
        self.size, self.modified_ns = stat.st_size, stat.st_mtime_ns

    def require_unchanged(self) -> None:
        """Refuse to give a file that is another one than at the start."""
        try:
            now = self.path.stat()
        except OSError:
            now = None
        if now is None or (now.st_size, now.st_mtime_ns) != (self.size, self.modified_ns):
            raise ApiError(
                "model_unavailable",
                "the pack's files were changed since the service started: it must start again",
                {},
                {"Retry-After": "60"},
            )


def served_graphs(settings: Settings, pack: ModelPack | None) -> dict[str, ServedGraph]:
    """Return the graphs by their hashes, the detector first; none where the setting is off."""
    if not settings.serve_pack:
        return {}
    if pack is None:
        raise StartError("setting serve_pack: there is no pack to serve; set pack as well")
    info, size = pack.info, (pack.crop_size, pack.crop_size)
    graphs = [ServedGraph("embedder", None, info.embedder_sha256, size, info.embedder_file)]
    if (found := info.detector) is not None:
        graphs.insert(
            0, ServedGraph("detector", found.kind, found.sha256, found.input_size, found.file)
        )
    return {graph.sha256: graph for graph in graphs}
