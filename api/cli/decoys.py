"""``veilface decoys``: the lifting database."""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from api.cli import flags
from api.cli.bulk import BULK, Bulk
from api.cli.console import demo_notice, message
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_names
from api.cli.options import reports
from api.cli.photo_folders import photos_of
from api.cli.results import Result
from api.settings import Settings
from models.extraction import Extraction
from templates.decoys import Attributes, DecoyGenerator
from templates.decoys.fitting import FACES_PER_DIMENSION
from verify.fairface_labels import label_files, read_labels
from verify.preparation import LikeSample, acquired, acquired_json, make_generator, make_pool

app = typer.Typer(no_args_is_help=True)


@app.command()
@reports(*BULK)
def build(
    photos: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE...", help="Folders of face photos, at any depth."),
    ],
    *,
    settings: Settings,
    like: flags.Like = None,
    out: Annotated[
        Path | None, typer.Option(help="The file. Unset: `decoys.veil` in `data_dir`.")
    ] = None,
    kind: Annotated[
        Literal["generator", "pool"],
        typer.Option(
            help="`generator`: decoys of nobody, drawn fresh for each template; clients may have "
            "it. `pool`: the real embeddings, sealed; for hybrid+ and to reproduce the paper."
        ),
    ] = "generator",
    exclude: flags.Exclude = None,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Take this many photos of SOURCE, spread over it.")
    ] = None,
    aligned: flags.Aligned = False,
    flip: flags.Flip = False,
    cache: flags.Cache = None,
) -> Result:
    """Make the lifting database from folders of face photos.

    Needs: a model pack, and photos of at least 100 people (better 2,000 or more) who will never be
    enrolled. A pool keeps FairFace's labels, where `fairface_label_*.csv` lies in SOURCE or beside
    it.

    Example: `veilface decoys build fairface/train utkface --like volunteers --pack buffalo_l --out
    decoys.veil`
    """
    if kind == "pool" and like:
        raise UsageError("--like adapts a generator; a pool is the photos as they are")
    bulk = Bulk(settings, aligned=aligned, flip=flip, cache_file=cache)
    pack = bulk.pack
    names = read_names(exclude)
    chosen, left_out = photos_of(photos, names)
    sample, sample_left_out = photos_of(like or [], names)
    left_out += sample_left_out
    if not chosen or (like and not sample):
        raise CommandError(f"{exclude} leaves no photo of SOURCE, or of --like")
    if limit is not None and limit < len(chosen):
        chosen = [chosen[place * len(chosen) // limit] for place in range(limit)]
    extraction = bulk.extract(chosen)
    path = out or settings.resolved_decoys_file
    facts: dict[str, Any] = {"out": path, "kind": kind, "descriptors": len(extraction.paths)}
    if kind == "generator":
        kind_of = like_sample(bulk.extract(sample), like) if like else None
        source = make_generator(extraction, pack, like=kind_of)
        source.save(path)
        facts |= {"source_id": source.source_id, "like": len(kind_of.people) if kind_of else 0}
        _note_use(source, extraction, adapted=kind_of is not None)
    else:
        files = [file for folder in photos for file in label_files(folder)]
        labels = {
            path: Attributes(gender=label["gender"], race=label["race"])
            for file in files
            for path, label in read_labels(file).items()
        }
        pool = make_pool(extraction, labels or None, pack)
        pool.save(path, bulk.sealer)
        facts |= {"source_id": pool.source_id, "labelled": pool.labelled}
        message(
            "note: people in a pool are accepted by every template that uses them as a decoy; "
            "never enroll them"
        )
    facts |= {"left_out": left_out, "failure_to_acquire": acquired_json(extraction)}
    return Result(
        {**facts, **demo_notice(pack.info)},
        [f"{path}: {kind} from {len(extraction.paths)} embeddings.", f"{acquired(extraction)}."],
    )


def like_sample(extraction: Extraction, folders: Collection[Path]) -> LikeSample:
    """Tell people by their subfolders; a photo that is in none is a person of its own."""
    people = [str(path if path.parent in folders else path.parent) for path in extraction.paths]
    return LikeSample(extraction, people)


def _note_use(source: DecoyGenerator, extraction: Extraction, *, adapted: bool) -> None:
    wanted = FACES_PER_DIMENSION * source.n
    if len(extraction.paths) < wanted:
        message(
            f"note: {len(extraction.paths)} faces are few for {source.n} numbers each: the "
            f"generator gives away who they are; use {wanted} or more"
        )
    if adapted:
        message(
            "note: never enroll the people of --like, and leave them out of the calibration: "
            "`veilface calibrate --exclude-people`"
        )
