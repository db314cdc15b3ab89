"""The graphs of the pack that clients may fetch: named by their hashes, found out at the start."""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from api.http.errors import ApiError, StartError
from api.settings import Settings
from models.known_packs import KNOWN_PACKS
from models.pack import ModelPack


@dataclass(frozen=True)
class ServedGraph:
    """One graph: name, SHA-256 (hexadecimal) and bytes of its file, its input in pixels.

    Of a detector, `kind` says how its output is read. `modified_ns` is when the file was changed
    last.
    """

    role: Literal["detector", "embedder"]
    kind: str | None
    file: str
    sha256: str
    size: int
    input_size: tuple[int, int]
    path: Path = field(repr=False)
    modified_ns: int = field(repr=False)

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
    info, side = pack.info, pack.crop_size
    graphs = [_read(info.embedder_file, "embedder", None, info.embedder_sha256, (side, side))]
    if (found := info.detector) is not None:
        graphs.insert(0, _read(found.file, "detector", found.kind, found.sha256, found.input_size))
    return {graph.sha256: graph for graph in graphs}


def licence_of(pack: ModelPack) -> str | None:
    """Return what is known of the licence of a pack of this name."""
    known = KNOWN_PACKS.get(pack.info.name.lower())
    return None if known is None else known.licence


def _read(
    path: Path,
    role: Literal["detector", "embedder"],
    kind: str | None,
    sha256: str,
    input_size: tuple[int, int],
) -> ServedGraph:
    try:
        before = path.stat()
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise StartError(f"setting serve_pack: {path} cannot be read: {error.strerror}") from None
    if digest != sha256:
        raise StartError(f"setting serve_pack: {path} was changed while the service started")
    return ServedGraph(
        role, kind, path.name, sha256, before.st_size, input_size, path, before.st_mtime_ns
    )
