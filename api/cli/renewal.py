"""``veilface keys renew``: after a theft, everything secret that the deployment made anew."""

from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import emit, say
from api.cli.errors import UsageError
from api.cli.master_keys import (
    FILES,
    add_key,
    is_from_file,
    opened_store,
    retire_older,
    rewrap_all,
)
from api.cli.options import AsJson, takes_settings
from api.http.audit import operator
from api.service.opening import open_keyring
from api.settings import Settings
from templates.store.identifiers import utc_now


@takes_settings(*FILES, "export_key_file")
def renew(
    archive: Annotated[Path, typer.Argument(help="New file for the audit log so far.")],
    *,
    settings: Settings,
    as_json: AsJson = False,
) -> None:
    """Renew every secret of the deployment, after its database and master key were stolen.

    Stop the service first, and start it again afterwards. Puts a new master key in force and drops
    the old one; moves the audit log into a signed archive and begins a new chain; draws the keys of
    receipts, exports and API keys anew, and every tenant's rotation key. Then lists what is left to
    people: who enrolls again, and which API keys are replaced. Master keys that do not come from a
    file: put a new one in front where they come from first, and drop the old one afterwards.

    Example: `veilface keys renew audit-before-theft.jsonl`
    """
    keyring = open_keyring(settings)
    if not is_from_file(settings) and len(keyring.key_ids) < 2:
        raise UsageError(
            "the master keys do not come from a file: put a new key in front where they come "
            "from, and run this again"
        )
    with opened_store(settings, keyring) as store:
        if is_from_file(settings):
            add_key(settings, store)
        rewrapped = rewrap_all(settings, keyring, store)
        renewed = store.renew_secrets(archive, by=operator())
        dropped = retire_older(settings, store, rewrapped) if is_from_file(settings) else 0
        enroll_again = {}
        for tenant in store.tenants.all():
            store.rerotation.begin(tenant.name, by=operator())
            enroll_again[tenant.name] = list(store.rerotation.subjects_of_old_epochs(tenant.name))
        replace = [key.prefix for key in store.api_keys.all() if key.is_valid_at(utc_now())]
        anchor = str(store.audit_log.head())
    if as_json:
        emit(
            {
                "key_id": rewrapped.key_id,
                "rewrapped": rewrapped.changed,
                "resealed_files": [str(file) for file in rewrapped.files],
                "retired": dropped,
                "archived_lines": renewed.archive.lines,
                "receipts_signed_again": renewed.receipts,
                "api_keys_refused": list(renewed.refused),
                "anchor": anchor,
                "enroll_again": enroll_again,
                "replace_api_keys": replace,
            }
        )
        return
    say(
        f"Master key {rewrapped.key_id} is in force: {rewrapped.changed} keys and secrets wrapped "
        f"again, {dropped} older keys dropped."
    )
    for file in rewrapped.files:
        say(f"Sealed again: {file}")
    say(
        f"Moved {renewed.archive.lines} lines of the audit log into {archive}; "
        f"{renewed.receipts} receipts signed again."
    )
    for prefix in renewed.refused:
        say(f"API key {prefix} was made up or altered: it is good for nothing.")
    say("")
    say("Left to do:")
    say(f"- Keep this anchor of the audit log elsewhere: {anchor}")
    say("- Give everybody who verifies receipts `GET /v1/contract` anew: it names the new key.")
    for name, subjects in enroll_again.items():
        if subjects:
            say(f"- Enroll these {len(subjects)} subjects of tenant {name} again, with new photos:")
        for subject in subjects:
            say(f"    {subject}")
        say(f"  Then run `veilface keys rotate-tenant --tenant {name} --stolen --finish`.")
    if replace:
        say("- Replace these API keys, and revoke those that nobody knows:")
        for prefix in replace:
            say(f"    veilface keys replace {prefix} --grace-hours 0")
    if settings.export_key_file is not None:
        say("- Make another export key file, if it was stolen too.")
    if not is_from_file(settings):
        say("- Drop the older master keys where they come from.")
    say("- Destroy copies of the old master key; backups from before can be read with it.")
