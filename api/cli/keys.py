"""``veilface keys``: API keys, the rotation of a tenant, and receipts of erasure."""

from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli import flags, master_keys
from api.cli.console import message, progress
from api.cli.errors import CommandError
from api.cli.options import STORE, reports
from api.cli.results import Result, shown_facts
from api.cli.store import opened_store, read_public_key
from api.http.audit import operator
from api.http.receipts import verify_answer
from api.service.opening import open_contract, open_keyring
from api.settings import DEFAULT_TENANT, Settings
from templates.contract.canonical import parse_object
from templates.errors import StoreError
from templates.keys.private_file import create_private, read_bounded
from templates.store.api_keys import ApiKey, Right
from templates.store.identifiers import utc_now
from templates.store.receipts import key_fingerprint

MAX_JSON_BYTES = 2**20

app = typer.Typer(no_args_is_help=True)


for _command in (master_keys.rotate, master_keys.rewrap, master_keys.renew):
    app.command()(_command)


@app.command()
@reports(*STORE)
def create(
    *,
    settings: Settings,
    right: Annotated[list[Right], typer.Option(help="A right of the key; repeat for several.")],
    tenant: Annotated[str, typer.Option(help="Tenant, created if it is new.")] = DEFAULT_TENANT,
    label: Annotated[str, typer.Option(help="What the key is for, as `list` shows it.")] = "",
    days: Annotated[
        int | None, typer.Option(min=1, max=36500, help="Days until it expires. Unset: never.")
    ] = None,
    lowest_level: Annotated[
        str | None, typer.Option(help="Lowest security level that it may ask for, as `fmr-1e-4`.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="New private file for the key. Unset: stdout, once.")
    ] = None,
) -> Result:
    """Create an API key and show it once.

    The service may run meanwhile. Give a key no more rights than its user needs: `embeddings` and
    `scores` are the ones an attacker would like.

    Example: `veilface keys create --right enroll --right verify --label web-shop`
    """
    # Refused before a key is made for it.
    if out is not None and (out.exists() or not out.parent.is_dir()):
        raise CommandError(f"{out} is there already, or its folder is not: name another file")
    expires = None if days is None else utc_now() + timedelta(days=days)
    with opened_store(settings) as store:
        store.tenants.create(tenant)
        made = store.api_keys.create(
            tenant, right, label=label, expires_at=expires, lowest_level=lowest_level, by=operator()
        )
    facts = _described(made.key)
    if out is not None:
        create_private(out, f"{made.token}\n".encode())
        return Result({"out": out, **facts})
    message(f"Key {made.key.prefix} of tenant {tenant}, shown only now:")
    return Result({"token": made.token, **facts}, made.token)


@app.command("list")
@reports(*STORE)
def list_keys(
    *,
    settings: Settings,
    tenant: Annotated[str | None, typer.Option(help="Only this tenant's.")] = None,
) -> Result:
    """List API keys by prefix; the keys themselves are not kept.

    Example: `veilface keys list --tenant default`
    """
    with opened_store(settings) as store:
        keys = [_described(key) for key in store.api_keys.all(tenant=tenant)]
    none = "There are no API keys: `veilface keys create` makes one"
    return Result(keys, list(shown_facts(keys, "API keys")) if keys else none)


@app.command()
@reports(*STORE)
def revoke(
    prefix: Annotated[str, typer.Argument(help="The 12 digits after `vf_`, as in `list`.")],
    *,
    settings: Settings,
) -> Result:
    """Revoke an API key for good; exit status 1 if there is none to revoke.

    Example: `veilface keys revoke 3f9a1c0b7d2e`
    """
    with opened_store(settings) as store:
        revoked = store.api_keys.revoke(prefix, by=operator())
    error = "no key of this prefix, or it was revoked before; see `veilface keys list`"
    return Result({"prefix": prefix, "revoked": revoked}, error=None if revoked else error)


@app.command("rotate-tenant")
@reports(*STORE)
def rotate_tenant(
    *,
    settings: Settings,
    tenant: flags.Tenant = DEFAULT_TENANT,
    stolen: Annotated[
        bool, typer.Option("--stolen", help="Templates were stolen too: turn none of them.")
    ] = False,
    finish: Annotated[
        bool, typer.Option("--finish", help="Make no new key; go on with an interrupted renewal.")
    ] = False,
) -> Result:
    """Give a tenant a new rotation key, and turn its stored templates by it.

    The service may run meanwhile. Nobody has to enroll again, and the old key is dropped at the
    end. If templates were stolen too, use `--stolen`: those who must enroll again, with new photos,
    are listed. `--stolen --finish` shows who is left, and drops the old key when nobody is.

    Example: `veilface keys rotate-tenant --tenant default`
    """
    keyring = open_keyring(settings)
    binding = None if stolen else open_contract(settings, keyring).binding
    with opened_store(settings, keyring) as store:
        rotations = store.rerotation
        epoch = store.tenants.get(tenant).rotation_epoch
        if not finish:
            epoch = rotations.begin(tenant, by=operator())
        moved = 0
        if binding is not None:
            older = len(rotations.subjects_of_old_epochs(tenant))
            with progress("turning templates", older) as advance:
                moved = rotations.move(tenant, binding, by=operator(), progress=advance)
        left = rotations.subjects_of_old_epochs(tenant)
        dropped = 0 if left else rotations.retire(tenant, by=operator())
    if left:
        message(
            f"{len(left)} subjects keep an older rotation until they are enrolled again. Then run "
            f"`veilface keys rotate-tenant --tenant {tenant} --stolen --finish`."
        )
    return Result(
        {
            "tenant": tenant,
            "rotation_epoch": epoch,
            "moved": moved,
            "enroll_again": left,
            "rotations_dropped": dropped,
        }
    )


@app.command("verify-receipt")
@reports()
def verify_receipt(
    receipt: Annotated[Path, typer.Argument(help="JSON that the DELETE call returned.")],
    *,
    public_key: flags.PublicKey,
) -> Result:
    """Verify an erasure receipt; exit status 1 if it is not valid.

    Needs no service: keep `GET /v1/contract`, which names the public key, with the receipts. After
    `keys renew` an earlier receipt is no longer valid; a second DELETE answers with a new one.

    Example: `veilface keys verify-receipt receipt.json --public-key contract.json`
    """
    key = read_public_key(public_key)
    answer = parse_object(read_bounded(receipt, MAX_JSON_BYTES), what="the receipt")
    try:
        claims = verify_answer(answer, key)
    except StoreError as error:
        return Result({"valid": False, "reason": str(error)}, error=str(error))
    return Result({"valid": True, "claims": claims, "key_id": key_fingerprint(key)})


def _described(key: ApiKey) -> dict[str, Any]:
    """Facts about a key, and its state."""
    if not key.authentic:
        state = "not authentic: `veilface audit-log verify`"
    elif key.revoked_at is not None:
        state = "revoked"
    else:
        state = "valid" if key.is_valid_at(utc_now()) else "expired"
    facts = {**vars(key), "rights": sorted(key.rights), "state": state}
    return {name: value for name, value in facts.items() if name not in ("id", "authentic")}
