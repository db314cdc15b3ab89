"""Flags that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from models.selection import FacePolicy

Tenant = Annotated[str, typer.Option(help="Tenant.")]
Device = Annotated[
    str, typer.Option(help="Where distances are computed: `cpu`, or a device of torch as `cuda`.")
]
Face = Annotated[
    FacePolicy,
    typer.Option(
        help="Which face counts in a photo of several: `dominant`, the largest if it covers the "
        "middle and has twice the area of every other; `largest`, wherever it is; `single`, none."
    ),
]
PublicKey = Annotated[
    str, typer.Option(help="The receipt key in base64, or a file with `GET /v1/contract`.")
]
Aligned = Annotated[bool, typer.Option("--aligned", help="The photos are aligned square crops.")]
Flip = Annotated[
    bool,
    typer.Option(
        "--flip",
        help="Add the embedding of the mirrored face; decoys and contract must agree on it.",
    ),
]
Cache = Annotated[
    Path | None, typer.Option(help="Sealed file of embeddings, so that the next run is quick.")
]
Decoys = Annotated[
    Path | None, typer.Option(help="The file of `decoys build`. Unset: that in `data_dir`.")
]
Exclude = Annotated[
    Path | None,
    typer.Option(
        help="People or photos to leave out: a text file with a name or a path on each line, or a "
        "folder whose subfolders are named like the people."
    ),
]
Labels = Annotated[
    Path | None, typer.Option(help="A CSV `path,gender,race,age,...` of photos or people.")
]
Like = Annotated[
    list[Path] | None,
    typer.Option(
        help="Folder of 600 photos or more (at least 100 of 50 people) of further people of the "
        "kind that will be enrolled: decoys are adapted to them."
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed for the random choices.")]
