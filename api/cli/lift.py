"""``veilface lift``: a client makes its own private template; no face leaves its machine."""

import base64
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from api.cli.console import counted, demo_notice
from api.cli.errors import CommandError, UsageError
from api.cli.files import MAX_CONTRACT_BYTES, read_bounded, read_photo
from api.cli.results import Result, as_json, reports
from enroll.enroller import MAX_PHOTOS
from enroll.public_contract import PublicContract
from models.errors import ModelError
from models.pack import ModelPack
from models.selection import FacePolicy
from templates.contract.canonical import parse_object
from templates.decoys import DecoyGenerator
from templates.keys.private_file import replace_private
from templates.space.agreement import InconsistentImages


@reports()
def lift(
    photos: Annotated[
        list[Path],
        typer.Argument(help=f"1 to {MAX_PHOTOS} photos of one person, which are averaged."),
    ],
    *,
    pack: Annotated[Path, typer.Option(help="The model pack of the contract.")],
    generator: Annotated[
        Path,
        typer.Option(
            help="The decoy generator: the bytes of `GET /v1/contract/generator`, or the file "
            "that `decoys build` wrote."
        ),
    ],
    contract: Annotated[
        Path,
        typer.Option(
            help="The JSON of `GET /v1/contract`, or the contract file. Only its public part is "
            "read."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Where the template's bytes go. `-` writes a JSON body for REST to stdout."
        ),
    ],
    probe: Annotated[
        bool, typer.Option("--probe", help="Make a probe for verify, not an enrollment.")
    ] = False,
    level: Annotated[
        str | None,
        typer.Option(
            help="With `--probe --out -`: security level to ask for. Unset: the contract's."
        ),
    ] = None,
    dim: Annotated[
        int | None,
        typer.Option(
            help="Dimension of a probe, one that the contract is calibrated for. Unset: the "
            "largest of these. An enrollment always has the contract's own."
        ),
    ] = None,
    face: Annotated[
        FacePolicy,
        typer.Option(
            help="Which face counts in a photo of several: `dominant`, the largest if it covers "
            "the middle and has twice the area of every other; `largest`, wherever it is; "
            "`single`, none."
        ),
    ] = FacePolicy.DOMINANT,
) -> Result:
    """Make a private template from photos on this machine, without any secret of the service.

    Needs: the service's model pack, and `GET /v1/contract` and `GET /v1/contract/generator` saved
    to files. Send the result as `{"template": …}` with a key that has the right `embeddings`; to
    enroll it, the tenant must allow templates (`veilface db template-enrollment`). Never lift the
    same photo twice for an enrollment: two templates of one embedding give it away. Keep the file
    like a password.

    Example: `veilface lift me-1.jpg me-2.jpg --pack buffalo_l --generator generator.bin
    --contract contract.json --out me.veil`
    """
    if len(photos) > MAX_PHOTOS:
        raise UsageError(f"a template is made from 1 to {MAX_PHOTOS} photos, not {len(photos)}")
    if level is not None and not (probe and str(out) == "-"):
        raise UsageError("--level goes with --probe --out -")
    public = read_contract(contract)
    if probe:
        m = public.probe_dimension(dim)
    elif dim not in (None, public.binding.m):
        raise UsageError(
            f"an enrollment under this contract has dimension {public.binding.m}; add --probe to "
            "make a probe of another one"
        )
    else:
        m = public.binding.m
    decoys = public.require_decoys(DecoyGenerator.load(generator))
    models = public.load_pack(pack)
    info = models.info
    rows = np.stack([embed_file(models, photo, policy=face) for photo in photos])
    try:
        data = public.lift(rows, decoys, m=m, probe=probe)
    except InconsistentImages as error:
        raise CommandError(error.sentence([photo.name for photo in photos])) from None
    notice = demo_notice(info.embedder_sha256, n=info.n)
    if str(out) == "-":
        asked = {} if level is None else {"level": level}
        body = {"template": base64.b64encode(data).decode("ascii"), **asked}
        return Result(body, as_json(body))
    replace_private(out, data)
    kind = "probe" if probe else "enrollment"
    return Result(
        {
            "out": out,
            "bytes": len(data),
            "kind": kind,
            "m": m,
            "photos": len(photos),
            "contract_id": public.contract_id,
            **notice,
        },
        f"{out}: {kind} template of {counted(len(photos), 'photo')}, m = {m}, {len(data)} bytes.",
    )


def embed_file(pack: ModelPack, photo: Path, *, policy: FacePolicy) -> np.ndarray[Any, Any]:
    """Embed one photo file; an error names the file. Returns float32 (n,), unit norm."""
    data = read_photo(photo)
    try:
        return pack.embed_photo(data, policy=policy).embedding
    except ModelError as error:
        raise CommandError(f"{photo.name}: {error}") from None


def read_contract(path: Path) -> PublicContract:
    """Read the public part of a contract from a file."""
    document = parse_object(read_bounded(path, MAX_CONTRACT_BYTES), what="the contract")
    return PublicContract.read(document)
