"""``veilface models``: what is in a model pack."""

from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import demo_notice, emit, say, show, table
from api.cli.options import AsJson
from models.errors import ModelError
from models.pack import ModelPack
from models.pack import inspect as inspect_pack

app = typer.Typer(no_args_is_help=True, help="Inspect model packs (the weights you supply).")


@app.callback()
def models() -> None:
    """Inspect model packs (the weights you supply)."""


@app.command()
def inspect(
    pack: Annotated[
        Path,
        typer.Argument(help="Folder of .onnx files, or one embedder file.", show_default=False),
    ],
    *,
    as_json: AsJson = False,
) -> None:
    """Show what each graph of a pack is, and whether Veilface can use the pack.

    Needs: a folder of `.onnx` files such as InsightFace's `buffalo_l`, or one `.onnx` embedder.
    Exit status 1 means that the pack cannot be used; the reason is shown.

    Example: `veilface models inspect ~/.insightface/models/buffalo_l`
    """
    graphs = inspect_pack(pack)
    try:
        info, refusal = ModelPack.load(pack).info, None
    except ModelError as error:
        info, refusal = None, str(error)
    if as_json:
        emit(
            {
                "usable": info is not None,
                "reason": refusal,
                "graphs": [
                    {
                        "file": graph.file,
                        "role": str(graph.role),
                        "reason": graph.reason,
                        "sha256": graph.sha256,
                        "inputs": graph.inputs,
                        "outputs": graph.outputs,
                    }
                    for graph in graphs
                ],
                "pack": None
                if info is None
                else {
                    "name": info.name,
                    "n": info.n,
                    "embedder": info.embedder_file,
                    "embedder_sha256": info.embedder_sha256,
                    "preprocessing": info.preprocessing,
                    "detector": None if info.detector is None else info.detector.kind,
                },
            }
        )
    else:
        listing = table(f"Graphs of {pack.name}", "file", "role", "why", "SHA-256")
        for graph in graphs:
            listing.add_row(graph.file, str(graph.role), graph.reason, graph.sha256[:16])
        show(listing)
        if info is None:
            say(f"This pack cannot be used: {refusal}")
        else:
            detector = (
                "no detector: photos must be aligned square crops"
                if info.detector is None
                else f"detector {info.detector.kind}"
            )
            say(f"Usable: {info.n} numbers per embedding, {detector}.")
    if info is None:
        raise typer.Exit(1)
    demo_notice(info.embedder_sha256, n=info.n)
