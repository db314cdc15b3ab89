"""``veilface models``: fetching model packs, and what is in one."""

import re
import tempfile
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from api.cli.console import demo_notice, message
from api.cli.errors import CommandError, UsageError
from api.cli.options import reports
from api.cli.pack_download import obtained, shown
from api.cli.results import Result
from models.errors import ModelError
from models.known_packs import KNOWN_PACKS
from models.pack import ModelPack, PackInfo
from models.pack_file import FILE_NAME, pack_file_text
from models.pack_graphs import read_graphs
from templates.keys.private_file import replace_public

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}")

app = typer.Typer(no_args_is_help=True)


@app.command()
@reports()
def fetch(
    name: Annotated[
        str,
        typer.Argument(help=f"Name of the pack and its folder. Known: {', '.join(KNOWN_PACKS)}."),
    ],
    *,
    sources: Annotated[
        list[str] | None,
        typer.Option(
            "--from",
            metavar="URL",
            help="Address or path of a zip archive or an .onnx file; repeat for several.",
        ),
    ] = None,
    sha256: Annotated[
        list[str] | None, typer.Option(help="What it must hash to, in hex; once for each --from.")
    ] = None,
    into: Annotated[Path, typer.Option(help="Folder of the packs.")] = Path("packs"),
    preprocessing: Annotated[
        Literal["arcface", "imagenet", "raw"] | None,
        typer.Option(
            help="What the embedder was trained on, where its graph does not tell: `arcface` is "
            "(x - 127.5) / 127.5, `imagenet` mean and deviation of each channel, `raw` 0 to 255. "
            "Written to `pack.toml`."
        ),
    ] = None,
    accept_licence: Annotated[
        bool,
        typer.Option("--accept-licence", help="You have read the licence and may use the weights."),
    ] = False,
) -> Result:
    """Fetch a pack from an address that you name, and check that it can be used.

    Of an archive only `.onnx` files and `pack.toml` are unpacked. Exit status 1: the pack cannot be
    fetched or used, and nothing of it is left.

    Example: `veilface models fetch buffalo_sc --from https://example.org/buffalo_sc.zip`
    """
    if not NAME.fullmatch(name):
        raise UsageError("a pack's name has letters, digits, and . _ - inside, 64 at most")
    target = into / name
    if known := KNOWN_PACKS.get(name.lower()):
        message(f"{name}: {known.contents}; licence: {known.licence}.")
    else:
        message(f"{name}: not a pack that Veilface knows; its licence is yours to read.")
    if not sources:
        raise UsageError(
            f"name an address or a file with --from; or put the .onnx files into {target} yourself"
        )
    if sha256 and len(sha256) != len(sources):
        raise UsageError("give --sha256 once for each --from, in the same order, or never")
    if target.exists():
        raise CommandError(f"{target} is there already; remove it, or take another name")
    if not accept_licence:
        raise UsageError("say --accept-licence once you have read the licence of the weights")
    into.mkdir(parents=True, exist_ok=True)
    digests = {}
    with tempfile.TemporaryDirectory(prefix=".fetch-", dir=into) as scratch:
        # Of the pack's own name, which what is wrong with it names.
        folder = Path(scratch) / name
        folder.mkdir()
        for source, pin in zip_longest(sources, sha256 or []):
            digest, left_out = obtained(source, folder, sha256=pin)
            digests[shown(source)] = digest
            message(f"{shown(source)}: SHA-256 {digest}")
            if left_out:
                message(f"Left in the archive: {left_out} files.")
        if preprocessing is not None:
            if (folder / FILE_NAME).exists():
                raise UsageError(f"the archive has a {FILE_NAME}: leave out --preprocessing")
            replace_public(folder / FILE_NAME, pack_file_text(preprocessing).encode())
        pack = ModelPack.load(folder)
        folder.rename(target)
    facts = {"out": target, "sha256": digests, "pack": _described(pack)}
    return Result(facts, f"{target}: {usable(pack.info)}")


@app.command()
@reports()
def inspect(
    pack: Annotated[Path, typer.Argument(help="Folder of .onnx files, or one embedder file.")],
) -> Result:
    """Show what each graph of a pack is, and whether Veilface can use the pack.

    Exit status 1 means that the pack cannot be used; the reason is shown.

    Example: `veilface models inspect ~/.insightface/models/buffalo_l`
    """
    names = ("file", "role", "reason", "sha256")
    graphs = [{name: getattr(graph, name) for name in names} for graph in read_graphs(pack)]
    facts: dict[str, Any] = {"usable": True, "reason": None, "graphs": graphs, "pack": None}
    try:
        loaded = ModelPack.load(pack)
    except ModelError as error:
        return Result(facts | {"usable": False, "reason": str(error)}, status=1)
    demo_notice(loaded.info)
    return Result(facts | {"pack": _described(loaded)})


def usable(info: PackInfo) -> str:
    """Say what a pack gives, and what it takes."""
    if info.detector is None:
        return f"{info.n} numbers per embedding, no detector: photos must be aligned square crops."
    return f"{info.n} numbers per embedding, detector {info.detector.kind}."


def _described(pack: ModelPack) -> dict[str, Any]:
    info = pack.info
    graphs = () if pack.liveness is None else pack.liveness.members
    return {
        "name": info.name,
        "n": info.n,
        "embedder": info.embedder_file.name,
        "embedder_sha256": info.embedder_sha256,
        "preprocessing": info.preprocessing,
        "detector": None if info.detector is None else info.detector.kind,
        "liveness": [graph.as_dict() for graph in graphs],
    }
