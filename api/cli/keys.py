"""``veilface keys``: API keys, the master key, and receipts of erasure."""

import base64
import binascii
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import emit, message, progress, say, show, table
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_bounded
from api.cli.options import STORE, AsJson, Tenant, takes_settings
from api.http.audit import operator
from api.http.receipts import verify_answer
from api.process.opening import file_sealer, open_keyring, open_store, prepare_database
from api.settings import Settings
from templates.contract.canonical import parse_object
from templates.contract.document import Contract
from templates.decoys import DecoyPool, load_source
from templates.errors import StoreError
from templates.keys.key_file import locked
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.api_keys import ApiKey, Right
from templates.store.identifiers import utc_now

MAX_JSON_BYTES = 2**20
FILES = (*STORE, "contract_file", "decoys_file")

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
        typer.Option(help="A right of the key; repeat for several.", show_default=False),
    ],
    tenant: Annotated[
        str | None,
        typer.Option(
            help="Tenant, created if it is new. Unset: the setting `default_tenant`.",
            show_default=False,
        ),
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
            "of a larger false match rate. Unset: the setting `lowest_level`.",
            show_default=False,
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
    with _store(settings) as store:
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
        emit({"token": made.token, **_described(made.key)})
    else:
        message(f"Key {made.key.prefix} of tenant {name}, shown only now:")
        say(made.token)


@app.command("list")
@takes_settings(*STORE)
def list_keys(
    *,
    settings: Settings,
    tenant: Annotated[
        str | None, typer.Option(help="Only this tenant's.", show_default=False)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List API keys by prefix; the keys themselves are not kept.

    Example: `veilface keys list --tenant default`
    """
    with _store(settings) as store:
        found = store.api_keys.all(tenant=tenant)
    if as_json:
        emit([_described(key) for key in found])
        return
    columns = ("prefix", "tenant", "rights", "lowest level", "label", "state", "last used")
    listing = table("API keys", *columns)
    for key in found:
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
        typer.Argument(help="The 12 digits after `vf_`, as in `list`.", show_default=False),
    ],
    *,
    settings: Settings,
    as_json: AsJson = False,
) -> None:
    """Revoke an API key for good; exit status 1 if there is none to revoke.

    Example: `veilface keys revoke 3f9a1c0b7d2e`
    """
    with _store(settings) as store:
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
        typer.Argument(help="The 12 digits after `vf_` of the old key.", show_default=False),
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
    with _store(settings) as store:
        made = store.api_keys.replace(prefix, grace=timedelta(hours=grace_hours), by=operator())
    if made is None:
        raise CommandError("no valid key of this prefix; see `veilface keys list`")
    if as_json:
        emit({"token": made.token, "replaces": prefix, **_described(made.key)})
    else:
        message(f"Key {made.key.prefix} replaces {prefix}, shown only now:")
        say(made.token)


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
            help="Templates were stolen too: leave them in their old rotation, and list who must "
            "be enrolled again.",
        ),
    ] = False,
    finish: Annotated[
        bool,
        typer.Option(
            "--finish", help="Begin no new rotation; go on with one that was interrupted."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Give a tenant a new secret rotation, and move its stored templates to it.

    Nobody has to enroll again, and the service may run meanwhile; the key of the old rotation is
    dropped at the end. That is enough if only that key may have leaked. A stolen template stays a
    credential whatever happens to ours: with `--stolen`, only people enrolled from now on get the
    new rotation; the others are listed, and verified as before until they enroll again with new
    photos. Run it with `--stolen --finish` to see who is left, and again when nobody is: `--finish`
    alone would move the stolen templates too.

    Example: `veilface keys rotate-tenant --tenant default`
    """
    name = tenant or settings.default_tenant
    with _store(settings) as store:
        rotations = store.rerotation
        epoch = store.tenants.get(name).rotation_epoch
        if not finish:
            epoch = rotations.begin(name, by=operator())
        moved = 0
        if not stolen:
            with progress("turning templates", rotations.remaining(name)) as advance:
                moved = rotations.move(name, by=operator(), progress=advance)
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
    say(f"Tenant {name} is in rotation {epoch}; {moved} templates were turned into it.")
    if left:
        say(f"{len(left)} subjects keep an older rotation until they are enrolled again:")
        for subject in left:
            say(f"  {subject}")
        say(f"Then run `veilface keys rotate-tenant --tenant {name} --stolen --finish`.")
    elif dropped:
        say(f"Dropped the keys of {dropped} older rotations.")


@app.command()
@takes_settings("data_dir", "master_key_file")
def master(*, settings: Settings, as_json: AsJson = False) -> None:
    """Create the master key file; an existing one is never touched.

    `serve` and `calibrate` create it on their first run. Keep a copy in a safe place, apart from
    the database backups: without it nothing stored can be read, and with it everything.

    Example: `veilface keys master --master-key-file /etc/veilface/master.key`
    """
    path = settings.resolved_master_key_file
    keyring = MasterKeyring.create(path)
    if as_json:
        emit({"file": str(path), "key_id": keyring.current})
    else:
        say(f"{path}: master key {keyring.current}, readable by you only. Keep a copy elsewhere.")


Retire = Annotated[
    bool,
    typer.Option("--retire", help="Drop the older keys from the file when nothing needs them."),
]


@app.command()
@takes_settings(*FILES)
def rotate(*, settings: Settings, retire: Retire = False, as_json: AsJson = False) -> None:
    """Put a new master key in force and rewrap everything under it.

    Needs: the database, the key file, and the contract and decoys files that it sealed. The
    service may run meanwhile; it rereads the key file. Templates are not touched, only the keys
    that wrap them. Earlier backups need the old keys: keep those with them.

    Example: `veilface keys rotate --retire`
    """
    _require_file(settings, "put a new key in front where they come from, then `keys rewrap`")
    path = settings.resolved_master_key_file
    with _alone(settings):
        MasterKeyring.add_current(path)
        _rewrap(settings, retire=retire, as_json=as_json)


@app.command()
@takes_settings(*FILES)
def rewrap(*, settings: Settings, retire: Retire = False, as_json: AsJson = False) -> None:
    """Finish a rotation: rewrap whatever an older master key still wraps.

    Safe to run again, and after an interrupted `rotate`.

    Example: `veilface keys rewrap --retire`
    """
    if retire:
        _require_file(settings, "drop the old key where they come from")
    with _alone(settings):
        _rewrap(settings, retire=retire, as_json=as_json)


@app.command("verify-receipt")
def verify_receipt(
    receipt: Annotated[
        Path, typer.Argument(help="JSON that the DELETE call returned.", show_default=False)
    ],
    *,
    public_key: Annotated[
        str,
        typer.Option(
            help="The service's receipt key in base64, or a file with the JSON of "
            "`GET /v1/contract`.",
            show_default=False,
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Verify an erasure receipt; exit status 1 if it is not valid.

    Needs no service and no other key: take the public key once from `receipt_key` in
    `GET /v1/contract`, and keep it with the receipts.

    Example: `veilface keys verify-receipt receipt.json --public-key contract.json`
    """
    key = _public_key(public_key)
    answer = parse_object(read_bounded(receipt, MAX_JSON_BYTES), what="the receipt")
    try:
        claims = verify_answer(answer, key)
    except StoreError as error:
        if as_json:
            emit({"valid": False, "reason": str(error)})
        message(f"error: {error}")
        raise typer.Exit(1) from None
    if as_json:
        emit({"valid": True, "claims": claims})
        return
    if "subject" not in claims:
        counts = {each["item"]: each["count"] for each in claims["erased"]}
        say(
            f"Valid: tenant {claims['tenant']} was erased on {claims['erased_at']}, with "
            f"{counts['subjects']} subjects."
        )
        return
    held = "what was held of" if claims["held"] else "that nothing was held of"
    verb = "erased" if claims["held"] else "stated"
    say(f"Valid: tenant {claims['tenant']} {verb} {held} a subject on {claims['erased_at']}.")
    say(f"The subject's pseudonym is {claims['subject']}.")


def _require_file(settings: Settings, remedy: str) -> None:
    if not _from_file(settings):
        raise UsageError(f"the master keys do not come from a file: {remedy}")


def _from_file(settings: Settings) -> bool:
    return settings.master_key_variable is None and settings.master_key_command is None


@contextmanager
def _alone(settings: Settings) -> Iterator[None]:
    """Keep other rotations of the same key file out."""
    if not _from_file(settings):
        yield
        return
    open_keyring(settings)  # it makes the file of a deployment that has none yet
    with locked(settings.resolved_master_key_file):
        yield


def _rewrap(settings: Settings, *, retire: bool, as_json: bool) -> None:
    path = settings.resolved_master_key_file
    keyring = open_keyring(settings)
    with _store(settings, keyring) as store:
        total = sum(n for key, n in store.wrapped_keys.count().items() if key != keyring.current)
        with progress("wrapping keys again", total) as advance:
            changed = store.wrapped_keys.rewrap(progress=advance)
        current = keyring.current
        left = set(store.wrapped_keys.count()) - {current}
    files = _seal_files_again(settings, keyring)
    dropped = 0
    if retire:
        if left:
            raise CommandError(
                "something is still wrapped by an older master key; run `veilface keys rewrap` "
                "again before retiring it"
            )
        dropped = MasterKeyring.drop_retired(path, keep=current)
    if as_json:
        emit(
            {
                "key_id": current,
                "rewrapped": changed,
                "resealed_files": [str(file) for file in files],
                "retired": dropped,
            }
        )
        return
    say(f"Master key {current} is in force: {changed} keys and secrets wrapped again.")
    for file in files:
        say(f"Sealed again: {file}")
    if dropped:
        say(f"Retired {dropped} older keys.")
    elif len(keyring.key_ids) > 1:
        say("The older keys are still in the file; `--retire` drops them.")


def _seal_files_again(settings: Settings, keyring: MasterKeyring) -> list[Path]:
    """Seal contract and decoy pool under the current key, where they are there."""
    sealer, done = file_sealer(keyring), []
    contract, decoys = settings.resolved_contract_file, settings.resolved_decoys_file
    if contract.is_file():
        Contract.load(contract, sealer).save(contract, sealer)
        done.append(contract)
    if decoys.is_file():
        source = load_source(decoys, sealer)
        if isinstance(source, DecoyPool):
            source.save(decoys, sealer)
            done.append(decoys)
    return done


def _public_key(text: str) -> bytes:
    """Read base64, or the file of a contract."""
    path = Path(text)
    if path.is_file():
        document = parse_object(read_bounded(path, 256 * MAX_JSON_BYTES), what="the contract")
        entry = document.get("receipt_key")
        text = str(entry.get("public_key")) if isinstance(entry, dict) else ""
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise UsageError(
            "--public-key takes base64, or a file with the JSON of GET /v1/contract"
        ) from None


@contextmanager
def _store(settings: Settings, keyring: MasterKeyring | None = None) -> Iterator[TemplateStore]:
    store = open_store(settings, keyring or open_keyring(settings))
    try:
        prepare_database(store)
        yield store
    finally:
        store.close()


def _state(key: ApiKey) -> str:
    if not key.authentic:
        return "not authentic: `veilface audit-log verify`"
    if key.revoked_at is not None:
        return "revoked"
    if not key.is_valid_at(utc_now()):
        return "expired"
    return "valid" if key.expires_at is None else f"valid until {key.expires_at:%Y-%m-%d}"


def _described(key: ApiKey) -> dict[str, Any]:
    def iso(moment: Any) -> str | None:
        return None if moment is None else moment.isoformat(timespec="seconds")

    return {
        "prefix": key.prefix,
        "tenant": key.tenant,
        "rights": sorted(key.rights),
        "lowest_level": key.lowest_level,
        "label": key.label,
        "created_at": iso(key.created_at),
        "expires_at": iso(key.expires_at),
        "revoked_at": iso(key.revoked_at),
        "last_used_at": iso(key.last_used_at),
    }
