"""The liveness graphs of a pack: what each is fed, as stated or as its name says, and its session.

MiniFASNet is known by its signature; how far its crop reaches is in no graph, so it is told from
the name that its authors give the file, ``2.7_80x80_…``, or stated in ``pack.toml``.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from models.errors import ModelError, PackError
from models.liveness import LivenessGraph, LivenessInput, PassiveLiveness
from models.pack_file import LivenessStatement, PackFile
from models.pack_graphs import PackGraph
from models.sessions import Session

# "2.7_80x80_MiniFASNetV2", "4_0_0_80x80_MiniFASNetV1SE", "minifasnet_v1se_4.0_80x80".
_SCALE_IN_NAME = re.compile(r"(?:^|[_-])(\d(?:\.\d+)?)(?:_0_0)?_80x80(?![0-9x])")
_NOTHING_STATED = LivenessStatement()


def open_liveness(
    graphs: Sequence[PackGraph],
    stated: PackFile,
    folder: Path,
    *,
    detects: bool,
    providers: Sequence[str],
    threads: int | None,
) -> PassiveLiveness | None:
    """Load the liveness graphs of a pack; None where there is none.

    Raises
    ------
    PackError
        If ``pack.toml`` states a file that is not there, a graph does not do what is stated,
        nothing says how far its crop reaches, or the pack has no detector.
    """
    absent = sorted(name for name in stated.liveness if not (folder / name).is_file())
    if absent:
        raise PackError(f"pack.toml states the liveness graph {absent[0]}; {folder} has none.")
    if graphs and not detects:
        raise PackError(
            f"{folder} has a liveness graph and no detector; liveness is seen on the whole frame:"
            " add a SCRFD or YuNet .onnx file."
        )
    members = []
    for graph in graphs:
        session = Session(graph.model, name=graph.path.name, providers=providers, threads=threads)
        expects = expected_input(graph, stated.liveness.get(graph.path.name, _NOTHING_STATED))
        session.load()
        try:
            member = LivenessGraph(
                session,
                input_name=graph.signature.inputs[0].name,
                sha256=graph.sha256,
                expects=expects,
                normalised=graph.signature.output_node == "Softmax",
            )
        except ModelError as error:
            raise PackError(f"{graph.path}, as a liveness graph: {error}") from error
        members.append(member)
    if not members:
        return None
    try:
        return PassiveLiveness(members)
    except ModelError as error:
        raise PackError(f"{folder}: {error}") from error


def expected_input(graph: PackGraph, statement: LivenessStatement) -> LivenessInput:
    """What a graph is fed: as stated, else as MiniFASNet is.

    Raises
    ------
    PackError
        If the size or the scale of the crop is not known, or not what the graph takes.
    """
    height, width = graph.signature.image_size or (None, None)
    size = height or statement.input_size
    if height != width or size is None or statement.input_size not in (None, size):
        raise PackError(
            f"{graph.path} takes {width or 'any'} x {height or 'any'} pixels; a liveness graph"
            f" takes a square, and input_size in pack.toml states the side where it is open."
        )
    named = _SCALE_IN_NAME.search(graph.path.stem)
    scale = statement.crop_scale or (float(named[1]) if named else None)
    if scale is None:
        raise PackError(
            f"{graph.path} is a liveness graph, and nothing says how far around the face it looks:"
            " state crop_scale in pack.toml, under [[liveness]], or give the file back the name"
            " that its authors gave it, such as 2.7_80x80_MiniFASNetV2.onnx."
        )
    live = statement.live_class
    return LivenessInput(
        crop_scale=scale,
        crop=statement.crop or "box",
        size=size,
        channel_order=statement.channel_order or "bgr",
        input_range=statement.input_range or (0.0, 255.0),
        live_class=1 if live is None else live,
        score=statement.score or "softmax",
    )
