"""``veilface lift``: a client makes its own private template; no face leaves its machine."""

import base64
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from api.cli import flags
from api.cli.console import demo_notice
from api.cli.errors import CommandError, UsageError
from api.cli.files import MAX_CONTRACT_BYTES, naming_photo, read_photos
from api.cli.options import reports
from api.cli.results import Result, as_json
from enroll.enroller import MAX_PHOTOS
from enroll.public_contract import PublicContract
from models.errors import ModelError
from models.selection import FacePolicy
from templates.contract.canonical import parse_object
from templates.decoys import DecoyGenerator
from templates.keys.private_file import read_bounded, replace_private


@reports()
def lift(
    photos: Annotated[
        list[Path],
        typer.Argument(help=f"1 to {MAX_PHOTOS} photos of one person, which are averaged."),
    ],
    *,
    pack: Annotated[Path, typer.Option(help="The model pack of the contract.")],
    generator: Annotated[
        Path, typer.Option(help="The decoy generator: `GET /v1/contract/generator`, or the file.")
    ],
    contract: Annotated[
        Path, typer.Option(help="The JSON of `GET /v1/contract`, or the contract file.")
    ],
    out: Annotated[
        Path, typer.Option(help="File for the template; `-` writes a JSON body to stdout.")
    ],
    probe: Annotated[
        bool, typer.Option("--probe", help="Make a probe for verify, not an enrollment.")
    ] = False,
    level: Annotated[
        str | None, typer.Option(help="With `--probe --out -`: security level to ask for.")
    ] = None,
    dim: Annotated[
        int | None,
        typer.Option(help="Dimension of a probe. Unset: the largest that the contract takes."),
    ] = None,
    face: flags.Face = FacePolicy.DOMINANT,
) -> Result:
    """Make a private template from photos on this machine, without any secret of the service.

    Send the result as `{"template": …}` with a key that has the right `embeddings`; to enroll it,
    the tenant must allow templates (`veilface db template-enrollment`). Never lift the same photo
    twice for an enrollment: two templates of one embedding give it away.

    Example: `veilface lift me-1.jpg me-2.jpg --pack buffalo_l --generator generator.bin
    --contract contract.json --out me.veil`
    """
    if level is not None and not (probe and str(out) == "-"):
        raise UsageError("--level goes with --probe --out -")
    document = parse_object(read_bounded(contract, MAX_CONTRACT_BYTES), what="the contract")
    public = PublicContract.read(document)
    m = public.probe_dimension(dim) if probe else public.binding.m
    if dim not in (None, m):
        raise UsageError(
            f"an enrollment under this contract has dimension {m}; add --probe to make a probe of "
            "another one"
        )
    decoys = public.require_decoys(DecoyGenerator.load(generator))
    models = public.load_pack(pack)
    rows = []
    for photo, data in zip(photos, read_photos(photos, most=MAX_PHOTOS), strict=True):
        try:
            rows.append(models.embed_photo(data, policy=face).embedding)
        except ModelError as error:
            raise CommandError(f"{photo.name}: {error}") from None
    with naming_photo(photos):
        template = public.lift(np.stack(rows), decoys, m=m, probe=probe)
    notice = demo_notice(models.info)
    if str(out) == "-":
        body = {"template": base64.b64encode(template).decode("ascii")}
        body |= {} if level is None else {"level": level}
        return Result(body, as_json(body))
    replace_private(out, template)
    facts = {"out": out, "bytes": len(template), "kind": "probe" if probe else "enrollment", "m": m}
    return Result({**facts, "photos": len(rows), "contract_id": public.contract_id, **notice})
