"""The graphs of the pack that clients may fetch: named by their hashes."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from api.http.errors import StartError
from api.settings import Settings
from models.pack import ModelPack


@dataclass(frozen=True)
class ServedGraph:
    """One graph: SHA-256 (hexadecimal) of its file, its input in pixels.

    Of a detector, `kind` says how its output is read.
    """

    role: Literal["detector", "embedder"]
    kind: str | None
    sha256: str
    input_size: tuple[int, int]
    path: Path = field(repr=False)


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
