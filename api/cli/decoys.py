"""``veilface decoys``: the lifting database."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from api.cli.console import demo_notice, emit, message, say
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import CommandError, require_extra
from api.cli.files import find_photos, is_left_out, read_names
from api.cli.options import AsJson, takes_settings
from api.process.opening import file_sealer, open_keyring
from api.process.preparation import acquired, acquired_json, make_generator, make_pool
from api.settings import Settings
from templates.decoys import Attributes, DecoyGenerator
from verify.fairface_labels import label_files, read_labels

FACES_PER_DIMENSION = 4
"""Below that many fitted faces, membership of the fit shows in the statistics (docs/decoys.md)."""

app = typer.Typer(no_args_is_help=True)


class Kind(StrEnum):
    """What is made of the descriptors."""

    GENERATOR = "generator"
    POOL = "pool"


@app.callback()
def decoys() -> None:
    """Make the decoys that hide an embedding inside its private template."""


@app.command()
@takes_settings(*BULK)
def build(
    photos: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE", help="Folder of face photos, at any depth.", show_default=False
        ),
    ],
    *,
    settings: Settings,
    out: Annotated[
        Path | None,
        typer.Option(help="The file. Unset: `decoys.veil` in `data_dir`.", show_default=False),
    ] = None,
    kind: Annotated[
        Kind,
        typer.Option(
            help="`generator`: decoys of nobody, drawn fresh for each template; clients may have "
            "it. `pool`: the real embeddings, sealed; for hybrid+ and to reproduce the paper."
        ),
    ] = Kind.GENERATOR,
    labels: Annotated[
        Path | None,
        typer.Option(
            help="FairFace label file. Unset: `fairface_label_*.csv` in SOURCE or beside it.",
            show_default=False,
        ),
    ] = None,
    exclude: Annotated[
        Path | None,
        typer.Option(
            help="People or photos to leave out: a text file with a name or a path on each line, "
            "or a folder whose subfolders are named like the people.",
            show_default=False,
        ),
    ] = None,
    limit: Annotated[
        int | None,
        typer.Option(min=1, help="Take this many photos, chosen at random.", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of that choice.")] = 0,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
    as_json: AsJson = False,
) -> None:
    """Make the lifting database from a folder of face photos.

    Needs: a model pack, and photos of at least 100 people (better 2,000 or more) who will never be
    enrolled. FairFace labels are read if present; only a pool keeps them.

    Example: `veilface decoys build fairface/train --pack buffalo_l --out decoys.veil`
    """
    if kind is Kind.GENERATOR:
        require_extra("decoys")
    pack = bulk_pack(settings, flip=flip, why="decoys are made with a model pack")
    chosen = find_photos(photos)
    found = len(chosen)
    if exclude is not None:
        names = read_names(exclude)
        chosen = [photo for photo in chosen if not is_left_out(photo, photos, names)]
    left_out = found - len(chosen)
    if not chosen:
        raise CommandError(f"{exclude} leaves no photo of {photos}")
    if limit is not None and limit < len(chosen):
        picked = np.random.default_rng(seed).choice(len(chosen), limit, replace=False)
        chosen = [chosen[index] for index in sorted(picked.tolist())]
    attributes = _labels(photos, labels)
    extraction = extract(pack, chosen, aligned=aligned, settings=settings, cache=cache)
    source = (
        make_generator(extraction, pack)
        if kind is Kind.GENERATOR
        else make_pool(extraction, attributes, pack)
    )
    if kind is Kind.GENERATOR and len(extraction.descriptors) < FACES_PER_DIMENSION * source.n:
        message(
            f"note: {len(extraction.descriptors)} faces are few for {source.n} numbers each: the "
            f"generator gives away who they are; use {FACES_PER_DIMENSION * source.n} or more"
        )
    path = out or settings.resolved_decoys_file
    if isinstance(source, DecoyGenerator):
        source.save(path)
    else:
        source.save(path, file_sealer(open_keyring(settings)))
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    labelled = attributes is not None and kind is Kind.POOL
    if as_json:
        emit(
            {
                "out": str(path),
                "kind": str(kind),
                "source_id": source.source_id,
                "made_with": source.made_with,
                "n": source.n,
                "descriptors": len(extraction.descriptors),
                "labelled": labelled,
                "left_out": left_out,
                "failure_to_acquire": acquired_json(extraction),
                **notice,
            }
        )
        return
    made = f"{kind} from {len(extraction.descriptors)} embeddings"
    say(f"{path}: {made}{', labelled' if labelled else ''}, id {source.source_id[:16]}.")
    say(f"{acquired(extraction)}{f'; {left_out:,} left out by --exclude' if left_out else ''}.")
    if kind is Kind.POOL:
        message(
            "note: people in a pool are accepted by every template that uses them as a decoy; "
            "never enroll them"
        )


def _labels(photos: Path, named: Path | None) -> dict[Path, Attributes] | None:
    files = [named] if named is not None else label_files(photos)
    if not files:
        return None
    merged: dict[Path, Attributes] = {}
    for file in files:
        for path, label in read_labels(file).items():
            merged[path] = label.attributes
    return merged
