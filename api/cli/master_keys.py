"""``veilface keys rotate``, ``rewrap``, ``renew``: the master key that all is sealed under."""

from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import message, progress
from api.cli.errors import CommandError, UsageError
from api.cli.options import STORE, reports
from api.cli.results import Result
from api.cli.store import opened_store
from api.http.audit import operator
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from templates.contract.document import Contract
from templates.decoys import DecoyPool, load_source
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore, count_wrapped, renew_secrets, rewrap_keys
from templates.store.identifiers import utc_now

Retire = Annotated[bool, typer.Option("--retire", help="Drop the older keys from the file.")]


@reports(*STORE)
def rotate(*, settings: Settings, retire: Retire = False) -> Result:
    """Put a new master key in force and rewrap everything under it.

    The service may run meanwhile; it rereads the key file. Templates are not touched, only the keys
    that wrap them, and contract and decoys files. Earlier backups need the old keys.

    Example: `veilface keys rotate --retire`
    """
    _require_file(settings, "put a new key in front where they come from, then `keys rewrap`")
    with opened_store(settings) as store:
        add_key(settings, store)
        return _rewrapped(settings, store, retire=retire)


@reports(*STORE)
def rewrap(*, settings: Settings, retire: Retire = False) -> Result:
    """Finish a rotation: rewrap whatever an older master key still wraps.

    Safe to run again, and after an interrupted `rotate`.

    Example: `veilface keys rewrap --retire`
    """
    if retire:
        _require_file(settings, "drop the old key where they come from")
    with opened_store(settings) as store:
        return _rewrapped(settings, store, retire=retire)


@reports(*STORE, "export_key_file")
def renew(
    archive: Annotated[Path, typer.Argument(help="New file for the audit log so far.")],
    *,
    settings: Settings,
) -> Result:
    """Renew every secret of the deployment, after its database and master key were stolen.

    Stop the service first, and start it again afterwards. Renews the master key, the keys of
    receipts, exports, API keys and the audit log, and every tenant's rotation key; moves the audit
    log into a signed archive. Then lists who must enroll again, and which API keys to make anew. If
    the master keys do not come from a file, put a new one in front at their source first.

    Example: `veilface keys renew audit-before-theft.jsonl`
    """
    in_file = settings.master_key_variable is None
    if not in_file and len(open_keyring(settings).key_ids) < 2:
        _require_file(settings, "put a new key in front where they come from, and run this again")
    with opened_store(settings) as store:
        if in_file:
            add_key(settings, store)
        done = rewrap_all(settings, store)
        renewed = renew_secrets(store, archive, by=operator())
        if in_file:
            done["retired"] = retire_older(settings, store)
        enroll_again = {}
        for tenant in store.tenants.all():
            store.rerotation.begin(tenant.name, by=operator())
            enroll_again[tenant.name] = store.rerotation.subjects_of_old_epochs(tenant.name)
        facts = {
            **done,
            "archived_lines": renewed.archive.lines,
            "receipts_signed_again": renewed.receipts,
            "api_keys_refused": list(renewed.refused),
            "anchor": str(store.audit_log.head()),
            "enroll_again": enroll_again,
            "replace_api_keys": [
                key.prefix for key in store.api_keys.all() if key.is_valid_at(utc_now())
            ],
        }
    message(
        'Left to do: docs/deploy.md, "Renewing every secret". Keep the anchor elsewhere, give '
        "`GET /v1/contract` anew to all who verify receipts, replace the API keys above, and "
        "enroll those subjects again with new photos; then, for each tenant, `veilface keys "
        "rotate-tenant --stolen --finish`. Destroy copies of the old master key."
    )
    return Result(facts)


def _require_file(settings: Settings, remedy: str) -> None:
    if settings.master_key_variable is not None:
        raise UsageError(f"the master keys do not come from a file: {remedy}")


def add_key(settings: Settings, store: TemplateStore) -> None:
    """Put a new key in front of the key file's keys.

    In a write, so that of two rotations at once neither takes the other's key out of the file.
    """
    path = settings.resolved_master_key_file
    with store.database.write():
        MasterKeyring.add_current(path)


def rewrap_all(settings: Settings, store: TemplateStore) -> dict[str, Any]:
    """Bring the database, and the files that are sealed, under the current master key."""
    keyring = open_keyring(settings)
    total = sum(n for key, n in count_wrapped(store).items() if key != keyring.current)
    with progress("wrapping keys again", total) as advance:
        changed = rewrap_keys(store, progress=advance)
    return {
        "key_id": keyring.current,
        "rewrapped": changed,
        "resealed_files": _seal_files_again(settings, keyring),
        "retired": 0,
    }


def retire_older(settings: Settings, store: TemplateStore) -> int:
    """Drop the older keys from the key file; return how many."""
    path, current = settings.resolved_master_key_file, open_keyring(settings).current
    if set(count_wrapped(store)) - {current}:
        raise CommandError(
            "something is still wrapped by an older master key; run `veilface keys rewrap` "
            "again before retiring it"
        )
    with store.database.write():
        return MasterKeyring.drop_retired(path, keep=current)


def _rewrapped(settings: Settings, store: TemplateStore, *, retire: bool) -> Result:
    done = rewrap_all(settings, store)
    if retire:
        done["retired"] = retire_older(settings, store)
    return Result({**done, "keys_in_force": len(open_keyring(settings).key_ids)})


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
