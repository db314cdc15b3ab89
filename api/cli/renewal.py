"""``veilface keys renew``: after a theft, everything secret that the deployment made anew."""

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from api.cli.console import emit, message, say
from api.cli.errors import CommandError, UsageError
from api.cli.master_keys import (
    FILES,
    Rewrapped,
    alone,
    is_from_file,
    opened_store,
    retire_older,
    rewrap_all,
)
from api.cli.options import AsJson, takes_settings
from api.http.audit import operator
from api.process.opening import open_keyring
from api.settings import Settings
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.identifiers import utc_now
from templates.store.renewal import Renewed


@dataclass(frozen=True)
class _Tenant:
    name: str
    rotation_epoch: int
    enroll_again: list[str]


@takes_settings(*FILES, "export_key_file")
def renew(
    *,
    settings: Settings,
    finish: Annotated[
        bool,
        typer.Option(
            "--finish",
            help="Go on with a renewal that was interrupted, and list again what is left to do; "
            "what it renewed already stays.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Renew every secret of the deployment, after its database and master key were stolen.

    Puts a new master key in force and drops the old one, draws the keys of the audit log, of
    receipts, pseudonyms, exports and stand-ins anew, gives every tenant a new
    rotation key, and lists what people must do: who enrolls again, which API keys are replaced,
    which anchor of the audit log is kept. The service may run meanwhile; writes wait for one
    transaction. Receipts and audit lines from before still verify. Killed at any moment nothing is
    lost: run it again with `--finish`. Master keys that do not come from a file: put a new one in
    front where they come from first, and drop the old one afterwards.

    Example: `veilface keys renew`
    """
    with alone(settings):
        keyring = open_keyring(settings)
        with opened_store(settings, keyring) as store:
            was_done = finish and store.renewal.is_done()
            if not was_done:
                _put_new_key_in_force(settings, keyring, finish=finish)
            rewrapped = rewrap_all(settings, keyring, store)
            renewed = None if was_done else store.renewal.renew(by=operator())
            if renewed is not None:
                # At once: a run that is killed later has said it.
                message(f"The audit log has a new key. Keep this elsewhere: {renewed.anchor}")
            dropped = retire_older(settings, rewrapped) if is_from_file(settings) else 0
            tenants = _renew_rotations(store)
            anchor = str(store.audit_log.head())
            api_keys = _keys_of_before(store)
    if as_json:
        emit(_described(rewrapped, dropped, renewed, anchor, tenants, api_keys))
    else:
        _say_what_was_done(rewrapped, dropped, renewed)
        _say_what_to_do(settings, anchor, tenants, api_keys)


def _put_new_key_in_force(settings: Settings, keyring: MasterKeyring, *, finish: bool) -> None:
    has_new_key = len(keyring.key_ids) > 1
    if is_from_file(settings):
        if finish and not has_new_key:
            raise CommandError("no renewal was interrupted: run it without --finish to begin one")
        if not finish:
            MasterKeyring.add_current(settings.resolved_master_key_file)
    elif not has_new_key:
        raise UsageError(
            "the master keys do not come from a file: put a new key in front where they come "
            "from, restart a service that has them in a variable, and run this again"
        )


def _renew_rotations(store: TemplateStore) -> list[_Tenant]:
    """Give each tenant a new rotation key, and list who is still enrolled under an older one."""
    for name in store.renewal.tenants_left():
        store.rerotation.begin(name, by=operator())
    tenants = []
    for tenant in store.tenants.all():
        left = list(store.rerotation.subjects_of_old_epochs(tenant.name))
        if not left:
            store.rerotation.retire(tenant.name, by=operator())
        tenants.append(_Tenant(tenant.name, tenant.rotation_epoch, left))
    return tenants


def _keys_of_before(store: TemplateStore) -> list[str]:
    """Prefixes of the valid API keys that are older than the renewal."""
    at = store.renewal.last()
    return [
        key.prefix
        for key in store.api_keys.all()
        if at is not None and key.created_at <= at and key.is_valid_at(utc_now())
    ]


def _described(
    rewrapped: Rewrapped,
    dropped: int,
    renewed: Renewed | None,
    anchor: str,
    tenants: list[_Tenant],
    api_keys: list[str],
) -> dict[str, Any]:
    return {
        "key_id": rewrapped.key_id,
        "rewrapped": rewrapped.changed,
        "resealed_files": [str(file) for file in rewrapped.files],
        "retired": dropped,
        "secrets": [] if renewed is None else [str(name) for name in renewed.names],
        "rows": 0 if renewed is None else renewed.rows,
        "receipts_signed_again": 0 if renewed is None else renewed.receipts,
        "api_keys_refused": [] if renewed is None else list(renewed.refused),
        "anchor": anchor,
        "tenants": [
            {
                "tenant": tenant.name,
                "rotation_epoch": tenant.rotation_epoch,
                "enroll_again": tenant.enroll_again,
            }
            for tenant in tenants
        ],
        "replace_api_keys": api_keys,
    }


def _say_what_was_done(rewrapped: Rewrapped, dropped: int, renewed: Renewed | None) -> None:
    say(
        f"Master key {rewrapped.key_id} is in force: {rewrapped.changed} keys and secrets wrapped "
        f"again, {dropped} older keys dropped."
    )
    for file in rewrapped.files:
        say(f"Sealed again: {file}")
    if renewed is None:
        say("The secrets were renewed before.")
        return
    say(f"Renewed: {', '.join(renewed.names)}.")
    say(
        f"The audit log goes on under its new key after line {renewed.ended}; {renewed.rows} rows "
        f"were authenticated and {renewed.receipts} receipts signed again."
    )
    for prefix in renewed.refused:
        say(f"The audit log contradicts API key {prefix}: it is good for nothing now.")


def _say_what_to_do(
    settings: Settings, anchor: str, tenants: list[_Tenant], api_keys: list[str]
) -> None:
    say("")
    say("Left to do:")
    say(f"- Keep this anchor of the audit log elsewhere: {anchor}")
    say("- Give whoever verifies receipts `GET /v1/contract` anew: it names the new key.")
    for tenant in (tenant for tenant in tenants if tenant.enroll_again):
        say(
            f"- Enroll these {len(tenant.enroll_again)} subjects of tenant {tenant.name} again, "
            "with new photos:"
        )
        for subject in tenant.enroll_again:
            say(f"    {subject}")
        say(f"  Then run `veilface keys rotate-tenant --tenant {tenant.name} --stolen --finish`.")
    if api_keys:
        say("- Replace these API keys, and revoke those that nobody knows:")
        for prefix in api_keys:
            say(f"    veilface keys replace {prefix} --grace-hours 0")
    if settings.export_key_file is not None:
        say("- Make another export key file, if it was stolen too.")
    if not is_from_file(settings):
        say("- Drop the older master keys where they come from.")
    say("- Destroy copies of the old master key; backups from before can be read with it.")
