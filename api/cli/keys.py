"""``veilface keys``: API keys, the master key, and receipts of erasure."""

from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli import master_keys, renewal
from api.cli.console import as_json_text, emit, message, progress, say, show, table
from api.cli.errors import CommandError
from api.cli.files import read_bounded
from api.cli.master_keys import FILES, opened_store
from api.cli.new_key import show_once
from api.cli.options import STORE, AsJson, Tenant, takes_settings
from api.cli.public_key import PublicKey, read_public_key
from api.http.audit import operator
from api.http.receipts import verify_answer
from api.service.opening import open_contract, open_keyring
from api.settings import Settings
from templates.contract.canonical import parse_object
from templates.errors import StoreError
from templates.store.api_keys import ApiKey, Right
from templates.store.identifiers import utc_now
from templates.store.receipts import key_fingerprint

MAX_JSON_BYTES = 2**20

app = typer.Typer(no_args_is_help=True)


@app.callback()
def keys() -> None:
    """Create, replace and revoke API keys; rotate keys; verify erasure receipts."""


@app.command()
@takes_settings(*STORE, "default_tenant")
def create(
    *,
    settings: Settings,
    right: Annotated[
        list[Right],
        typer.Option(help="A right of the key; repeat for several."),
    ],
    tenant: Annotated[
        str | None,
        typer.Option(help="Tenant, created if it is new. Unset: the setting `default_tenant`."),
    ] = None,
    label: Annotated[str, typer.Option(help="What the key is for, as `list` shows it.")] = "",
    days: Annotated[
        int | None,
        typer.Option(min=1, max=36500, help="Days until it expires. Unset: never."),
    ] = None,
    lowest_level: Annotated[
        str | None,
        typer.Option(
            help="Lowest security level that it may ask for, as `fmr-1e-4`: it verifies at none "
            "of a larger false match rate. Unset: the setting `lowest_level`."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Create an API key and show it once.

    Needs: the database and its master key; the service may run meanwhile. Give a key no more
    rights than its user needs. `embeddings` and `scores` are the ones an attacker would like.

    Example: `veilface keys create --right enroll --right verify --label web-shop`
    """
    name = tenant or settings.default_tenant
    with opened_store(settings) as store:
        store.tenants.create(name)
        expires = None if days is None else utc_now() + timedelta(days=days)
        made = store.api_keys.create(
            name,
            right,
            label=label,
            expires_at=expires,
            lowest_level=lowest_level,
            by=operator(),
        )
        if as_json:
            text = as_json_text({"token": made.token, **_described(made.key)})
        else:
            message(f"Key {made.key.prefix} of tenant {name}, shown only now:")
            text = made.token
        show_once(store, made, text)


@app.command("list")
@takes_settings(*STORE)
def list_keys(
    *,
    settings: Settings,
    tenant: Annotated[str | None, typer.Option(help="Only this tenant's.")] = None,
    as_json: AsJson = False,
) -> None:
    """List API keys by prefix; the keys themselves are not kept.

    Example: `veilface keys list --tenant default`
    """
    with opened_store(settings) as store:
        keys = store.api_keys.all(tenant=tenant)
    if as_json:
        emit([_described(key) for key in keys])
        return
    columns = ("prefix", "tenant", "rights", "lowest level", "label", "state")
    listing = table("API keys", *columns, "last used")
    for key in keys:
        listing.add_row(
            key.prefix,
            key.tenant,
            ", ".join(sorted(key.rights)),
            key.lowest_level or "any",
            key.label,
            _state(key),
            "never" if key.last_used_at is None else f"{key.last_used_at:%Y-%m-%d %H:%M}",
        )
    show(listing)


@app.command()
@takes_settings(*STORE)
def revoke(
    prefix: Annotated[
        str,
        typer.Argument(help="The 12 digits after `vf_`, as in `list`."),
    ],
    *,
    settings: Settings,
    as_json: AsJson = False,
) -> None:
    """Revoke an API key for good; exit status 1 if there is none to revoke.

    Example: `veilface keys revoke 3f9a1c0b7d2e`
    """
    with opened_store(settings) as store:
        revoked = store.api_keys.revoke(prefix, by=operator())
    if as_json:
        emit({"prefix": prefix, "revoked": revoked})
    elif revoked:
        say(f"Key {prefix} is revoked.")
    if not revoked:
        message("error: no key of this prefix, or it was revoked before; see `veilface keys list`")
        raise typer.Exit(1)


@app.command()
@takes_settings(*STORE)
def replace(
    prefix: Annotated[
        str,
        typer.Argument(help="The 12 digits after `vf_` of the old key."),
    ],
    *,
    settings: Settings,
    grace_hours: Annotated[
        float,
        typer.Option(min=0, max=8760, help="Hours for which the old key still works."),
    ] = 24.0,
    as_json: AsJson = False,
) -> None:
    """Replace a key, which then expires, by a new one with the same rights; show it once.

    The new key keeps the tenant, label and lowest level. Hand it over before the grace period ends;
    after a leak use `--grace-hours 0`. Exit status 1 if no valid key has this prefix.

    Example: `veilface keys replace 3f9a1c0b7d2e --grace-hours 48`
    """
    with opened_store(settings) as store:
        made = store.api_keys.replace(prefix, grace=timedelta(hours=grace_hours), by=operator())
        if made is None:
            raise CommandError("no valid key of this prefix; see `veilface keys list`")
        if as_json:
            text = as_json_text({"token": made.token, "replaces": prefix, **_described(made.key)})
        else:
            message(f"Key {made.key.prefix} replaces {prefix}, shown only now:")
            text = made.token
        show_once(store, made, text)


@app.command("rotate-tenant")
@takes_settings(*FILES, "default_tenant")
def rotate_tenant(
    *,
    settings: Settings,
    tenant: Tenant = None,
    stolen: Annotated[
        bool,
        typer.Option(
            "--stolen",
            help="Templates were stolen too: leave them under their old key, and list who must "
            "be enrolled again.",
        ),
    ] = False,
    finish: Annotated[
        bool,
        typer.Option(
            "--finish", help="Make no new key; go on with a renewal that was interrupted."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Give a tenant a new rotation key, and turn its stored templates by it.

    Nobody has to enroll again, and the service may run meanwhile; the old key is dropped at the
    end. That is enough if only that key may have leaked. A
    stolen template stays a credential whatever happens to ours: with `--stolen`, only people
    enrolled from now on get the new key; the others are listed, and verified as before until they
    enroll again with new photos. Run it with `--stolen --finish` to see who is left, and again when
    nobody is: `--finish` alone would turn the stolen templates too. Needs: the database, the key
    file and the contract.

    Example: `veilface keys rotate-tenant --tenant default`
    """
    name = tenant or settings.default_tenant
    keyring = open_keyring(settings)
    binding = None if stolen else open_contract(settings, keyring).binding
    with opened_store(settings, keyring) as store:
        rotations = store.rerotation
        epoch = store.tenants.get(name).rotation_epoch
        if not finish:
            epoch = rotations.begin(name, by=operator())
        moved = 0
        if binding is not None:
            with progress("turning templates", rotations.remaining(name)) as advance:
                moved = rotations.move(name, binding, by=operator(), progress=advance)
        left = list(rotations.subjects_of_old_epochs(name))
        dropped = 0 if left else rotations.retire(name, by=operator())
    if as_json:
        emit(
            {
                "tenant": name,
                "rotation_epoch": epoch,
                "moved": moved,
                "enroll_again": left,
                "rotations_dropped": dropped,
            }
        )
        return
    say(f"Tenant {name} is in rotation epoch {epoch}; {moved} templates were turned into it.")
    if left:
        say(f"{len(left)} subjects keep an older rotation until they are enrolled again:")
        for subject in left:
            say(f"  {subject}")
        say(f"Then run `veilface keys rotate-tenant --tenant {name} --stolen --finish`.")
    elif dropped:
        say(f"Dropped the keys of {dropped} older epochs.")


for _command in (master_keys.master, master_keys.rotate, master_keys.rewrap, renewal.renew):
    app.command()(_command)


@app.command("verify-receipt")
def verify_receipt(
    receipt: Annotated[Path, typer.Argument(help="JSON that the DELETE call returned.")],
    *,
    public_key: PublicKey,
    as_json: AsJson = False,
) -> None:
    """Verify an erasure receipt; exit status 1 if it is not valid.

    Needs no service and no other key: take `GET /v1/contract` once, which names the public key, and
    keep it with the receipts. After `keys renew` a receipt from before is no longer valid: a second
    DELETE answers with one under the new key.

    Example: `veilface keys verify-receipt receipt.json --public-key contract.json`
    """
    key = read_public_key(public_key)
    answer = parse_object(read_bounded(receipt, MAX_JSON_BYTES), what="the receipt")
    try:
        claims = verify_answer(answer, key)
    except StoreError as error:
        if as_json:
            emit({"valid": False, "reason": str(error)})
        message(f"error: {error}")
        raise typer.Exit(1) from None
    if as_json:
        emit({"valid": True, "claims": claims, "key_id": key_fingerprint(key)})
    else:
        _say_claims(claims)


def _say_claims(claims: dict[str, Any]) -> None:
    if "subject" not in claims:
        counts = {item["item"]: item["count"] for item in claims["erased"]}
        say(
            f"Valid: tenant {claims['tenant']} was erased on {claims['erased_at']}, with "
            f"{counts['subjects']} subjects."
        )
        return
    content = "what was held of" if claims["held"] else "that nothing was held of"
    verb = "erased" if claims["held"] else "stated"
    say(f"Valid: tenant {claims['tenant']} {verb} {content} a subject on {claims['erased_at']}.")
    say(f"The subject's pseudonym is {claims['subject']}.")


def _state(key: ApiKey) -> str:
    if not key.authentic:
        return "not authentic: `veilface audit-log verify`"
    if key.revoked_at is not None:
        return "revoked"
    if not key.is_valid_at(utc_now()):
        return "expired"
    return "valid" if key.expires_at is None else f"valid until {key.expires_at:%Y-%m-%d}"


def _iso(moment: datetime | None) -> str | None:
    return None if moment is None else moment.isoformat(timespec="seconds")


def _described(key: ApiKey) -> dict[str, Any]:
    return {
        "prefix": key.prefix,
        "tenant": key.tenant,
        "rights": sorted(key.rights),
        "lowest_level": key.lowest_level,
        "label": key.label,
        "created_at": _iso(key.created_at),
        "expires_at": _iso(key.expires_at),
        "revoked_at": _iso(key.revoked_at),
        "last_used_at": _iso(key.last_used_at),
    }
