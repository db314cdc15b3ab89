"""``veilface decoys``: the lifting database."""

from collections.abc import Collection, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import demo_notice, message
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import CommandError, UsageError
from api.cli.files import is_left_out, read_names
from api.cli.photo_folders import find_photos
from api.cli.results import Result, reports
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from models.extraction import Extraction
from templates.decoys import Attributes, DecoyGenerator
from templates.decoys.fitting import FACES_PER_DIMENSION
from verify.fairface_labels import label_files, read_labels
from verify.preparation import LikeSample, acquired, acquired_json, make_generator, make_pool

app = typer.Typer(no_args_is_help=True)


class Kind(StrEnum):
    """What is made of the descriptors."""

    GENERATOR = "generator"
    POOL = "pool"


@app.callback()
def decoys() -> None:
    """Make the decoys that hide an embedding inside its private template."""


@app.command()
@reports(*BULK)
def build(
    photos: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE...", help="Folders of face photos, at any depth."),
    ],
    *,
    settings: Settings,
    like: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of 600 photos or more (at least 100 of 50 people) of further people of "
            "the kind that will be enrolled: decoys are adapted to them. May be repeated."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The file. Unset: `decoys.veil` in `data_dir`."),
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
            help="FairFace label file. Unset: `fairface_label_*.csv` in SOURCE or beside it."
        ),
    ] = None,
    exclude: Annotated[
        Path | None,
        typer.Option(
            help="People or photos to leave out: a text file with a name or a path on each line, "
            "or a folder whose subfolders are named like the people."
        ),
    ] = None,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Take this many photos of SOURCE, spread over it.")
    ] = None,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
) -> Result:
    """Make the lifting database from folders of face photos.

    Needs: a model pack, and photos of at least 100 people (better 2,000 or more) who will never be
    enrolled. FairFace labels are read if present; only a pool keeps them.

    Example: `veilface decoys build fairface/train utkface --like volunteers --pack buffalo_l --out
    decoys.veil`
    """
    if kind is Kind.POOL and like:
        raise UsageError("--like adapts a generator; a pool is the photos as they are")
    pack = bulk_pack(settings, flip=flip, why="decoys are made with a model pack")
    names = frozenset() if exclude is None else read_names(exclude)
    chosen, left_out = photos_of(photos, names)
    sample, sample_left_out = photos_of(like or [], names)
    left_out += sample_left_out
    if not chosen or (like and not sample):
        folders = ", ".join(map(str, photos if not chosen else like or []))
        raise CommandError(f"{exclude} leaves no photo of {folders}")
    if limit is not None and limit < len(chosen):
        chosen = [chosen[place * len(chosen) // limit] for place in range(limit)]
    attributes = _labels(photos, labels)
    embed = partial(extract, pack, aligned=aligned, settings=settings, cache=cache)
    extraction = embed(chosen)
    kind_of = like_sample(embed(sample), like) if like else None
    source = (
        make_generator(extraction, pack, like=kind_of)
        if kind is Kind.GENERATOR
        else make_pool(extraction, attributes, pack)
    )
    if kind is Kind.GENERATOR and len(extraction.embeddings) < FACES_PER_DIMENSION * source.n:
        message(
            f"note: {len(extraction.embeddings)} faces are few for {source.n} numbers each: the "
            f"generator gives away who they are; use {FACES_PER_DIMENSION * source.n} or more"
        )
    path = out or settings.resolved_decoys_file
    if isinstance(source, DecoyGenerator):
        source.save(path)
    else:
        source.save(path, file_sealer(open_keyring(settings)))
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    labelled = attributes is not None and kind is Kind.POOL
    if kind_of is not None:
        message(
            "note: never enroll the people of --like, and leave them out of the calibration: "
            "`veilface calibrate --exclude-people`"
        )
    if kind is Kind.POOL:
        message(
            "note: people in a pool are accepted by every template that uses them as a decoy; "
            "never enroll them"
        )
    made = f"{kind} from {len(extraction.embeddings)} embeddings"
    if kind_of is not None:
        made += f", adapted to {len(kind_of.people)} of --like"
    if labelled:
        made += ", labelled"
    excluded = f"; {left_out:,} left out by --exclude" if left_out else ""
    return Result(
        {
            "out": path,
            "kind": kind,
            "source_id": source.source_id,
            "made_with": source.made_with,
            "n": source.n,
            "descriptors": len(extraction.embeddings),
            "like": len(kind_of.people) if kind_of else 0,
            "labelled": labelled,
            "left_out": left_out,
            "failure_to_acquire": acquired_json(extraction),
            **notice,
        },
        [f"{path}: {made}, id {source.source_id[:16]}.", f"{acquired(extraction)}{excluded}."],
    )


def photos_of(folders: Sequence[Path], names: frozenset[str]) -> tuple[list[Path], int]:
    """Photos of folders without those of the names, each once; and how many were left out."""
    folder_of = {photo: folder for folder in folders for photo in find_photos(folder)}
    kept = [photo for photo, folder in folder_of.items() if not is_left_out(photo, folder, names)]
    return kept, len(folder_of) - len(kept)


def like_sample(extraction: Extraction, folders: Collection[Path]) -> LikeSample:
    """Tell people by their subfolders; a photo that is in none is a person of its own."""
    alone = {photo for folder in folders for photo in folder.iterdir()}
    people = [str(path if path in alone else path.parent) for path in extraction.paths]
    return LikeSample(extraction, people)


def _labels(folders: Sequence[Path], named: Path | None) -> dict[Path, Attributes] | None:
    files = [named] if named is not None else [f for one in folders for f in label_files(one)]
    if not files:
        return None
    return {path: label.attributes for file in files for path, label in read_labels(file).items()}
