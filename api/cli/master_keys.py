"""``veilface keys master``, ``rotate``, ``rewrap``, ``renew``: what everything is sealed under."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import progress
from api.cli.errors import CommandError, UsageError
from api.cli.options import STORE
from api.cli.results import Result, reports
from api.http.audit import operator
from api.service.opening import file_sealer, open_keyring, open_store, prepare_database
from api.settings import Settings
from templates.contract.document import Contract
from templates.decoys import DecoyPool, load_source
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.identifiers import utc_now


@reports("data_dir", "master_key_file")
def master(*, settings: Settings) -> Result:
    """Create the master key file; an existing one is never touched.

    `serve` and `calibrate` create it on their first run. Keep a copy in a safe place, apart from
    the database backups: without it nothing stored can be read, and with it everything.

    Example: `veilface keys master --master-key-file /etc/veilface/master.key`
    """
    path = settings.resolved_master_key_file
    keyring = MasterKeyring.create(path)
    return Result(
        {"file": path, "key_id": keyring.current},
        f"{path}: master key {keyring.current}, readable by you only. Keep a copy elsewhere.",
    )


Retire = Annotated[
    bool,
    typer.Option("--retire", help="Drop the older keys from the file when nothing needs them."),
]


@reports(*STORE)
def rotate(*, settings: Settings, retire: Retire = False) -> Result:
    """Put a new master key in force and rewrap everything under it.

    Needs: the database, the key file, and the contract and decoys files that it sealed. The
    service may run meanwhile; it rereads the key file. Templates are not touched, only the keys
    that wrap them. Earlier backups need the old keys: keep those with them.

    Example: `veilface keys rotate --retire`
    """
    _require_file(settings, "put a new key in front where they come from, then `keys rewrap`")
    keyring = open_keyring(settings)
    with opened_store(settings, keyring) as store:
        add_key(settings, store)
        return _rewrap(settings, keyring, store, retire=retire)


@reports(*STORE)
def rewrap(*, settings: Settings, retire: Retire = False) -> Result:
    """Finish a rotation: rewrap whatever an older master key still wraps.

    Safe to run again, and after an interrupted `rotate`.

    Example: `veilface keys rewrap --retire`
    """
    if retire:
        _require_file(settings, "drop the old key where they come from")
    keyring = open_keyring(settings)
    with opened_store(settings, keyring) as store:
        return _rewrap(settings, keyring, store, retire=retire)


@reports(*STORE, "export_key_file")
def renew(
    archive: Annotated[Path, typer.Argument(help="New file for the audit log so far.")],
    *,
    settings: Settings,
) -> Result:
    """Renew every secret of the deployment, after its database and master key were stolen.

    Stop the service first, and start it again afterwards. Puts a new master key in force and drops
    the old one; moves the audit log into a signed archive; renews the keys of receipts, exports,
    API keys and the audit log, and every tenant's rotation key. Then lists who must enroll again,
    and which API keys to make anew. If the master keys do not come from a file, put a new one in
    front at their source first, and drop the old one afterwards.

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
        done = rewrap_all(settings, keyring, store)
        renewed = store.renew_secrets(archive, by=operator())
        if is_from_file(settings):
            done = retire_older(settings, store, done)
        enroll_again = {}
        for tenant in store.tenants.all():
            store.rerotation.begin(tenant.name, by=operator())
            enroll_again[tenant.name] = store.rerotation.subjects_of_old_epochs(tenant.name)
        api_keys = [key.prefix for key in store.api_keys.all() if key.is_valid_at(utc_now())]
        anchor = str(store.audit_log.head())
    text = [
        *done.text(),
        f"Moved {renewed.archive.lines} lines of the audit log into {archive}; "
        f"{renewed.receipts} receipts signed again.",
        *(
            f"API key {prefix} was made up or altered: it is good for nothing."
            for prefix in renewed.refused
        ),
        "\nLeft to do:",
        f"- Keep this anchor of the audit log elsewhere: {anchor}",
        "- Give everybody who verifies receipts `GET /v1/contract` anew: it names the new key.",
    ]
    for name, subjects in enroll_again.items():
        if subjects:
            text.append(f"- Enroll these subjects of tenant {name} again, with new photos:")
        text += [f"    {subject}" for subject in subjects]
        text.append(f"  Then run `veilface keys rotate-tenant --tenant {name} --stolen --finish`.")
    if api_keys:
        text.append(
            "- Make a new key for each of these (`veilface keys create`), hand it over, then "
            "revoke the old one:"
        )
    text += [f"    veilface keys revoke {prefix}" for prefix in api_keys]
    if settings.export_key_file is not None:
        text.append("- Make another export key file, if it was stolen too.")
    if not is_from_file(settings):
        text.append("- Drop the older master keys where they come from.")
    text.append("- Destroy copies of the old master key; backups from before can be read with it.")
    facts = {
        **asdict(done),
        "archived_lines": renewed.archive.lines,
        "receipts_signed_again": renewed.receipts,
        "api_keys_refused": list(renewed.refused),
        "anchor": anchor,
        "enroll_again": enroll_again,
        "replace_api_keys": api_keys,
    }
    return Result(facts, text)


@contextmanager
def opened_store(
    settings: Settings, keyring: MasterKeyring | None = None
) -> Iterator[TemplateStore]:
    """Open the store at its newest schema; close it in the end."""
    store = open_store(settings, keyring or open_keyring(settings))
    try:
        prepare_database(store)
        yield store
    finally:
        store.close()


def _require_file(settings: Settings, remedy: str) -> None:
    if not is_from_file(settings):
        raise UsageError(f"the master keys do not come from a file: {remedy}")


def is_from_file(settings: Settings) -> bool:
    """Whether the master keys are in a file, which commands may change."""
    return settings.master_key_variable is None


def add_key(settings: Settings, store: TemplateStore) -> None:
    """Put a new key in front of the key file's keys.

    In a write, so that of two rotations at once neither takes the other's key out of the file.
    """
    path = settings.resolved_master_key_file
    with store.database.write():
        MasterKeyring.add_current(path)


@dataclass(frozen=True)
class Rewrapped:
    """What was brought under the current master key: keys and secrets, and sealed files."""

    key_id: str
    rewrapped: int
    resealed_files: list[Path]
    retired: int = 0

    def text(self) -> list[str]:
        """Say it in lines."""
        return [
            f"Master key {self.key_id} is in force: {self.rewrapped} keys and secrets wrapped "
            f"again, {self.retired} older keys dropped.",
            *(f"Sealed again: {file}" for file in self.resealed_files),
        ]


def rewrap_all(settings: Settings, keyring: MasterKeyring, store: TemplateStore) -> Rewrapped:
    """Bring the database, and the files that are sealed, under the current master key."""
    total = sum(n for key, n in store.wrapped_keys.count().items() if key != keyring.current)
    with progress("wrapping keys again", total) as advance:
        changed = store.wrapped_keys.rewrap(progress=advance)
    return Rewrapped(keyring.current, changed, _seal_files_again(settings, keyring))


def retire_older(settings: Settings, store: TemplateStore, done: Rewrapped) -> Rewrapped:
    """Drop the older keys from the key file."""
    if set(store.wrapped_keys.count()) - {done.key_id}:
        raise CommandError(
            "something is still wrapped by an older master key; run `veilface keys rewrap` "
            "again before retiring it"
        )
    path = settings.resolved_master_key_file
    with store.database.write():
        dropped = MasterKeyring.drop_retired(path, keep=done.key_id)
    return replace(done, retired=dropped)


def _rewrap(
    settings: Settings, keyring: MasterKeyring, store: TemplateStore, *, retire: bool
) -> Result:
    done = rewrap_all(settings, keyring, store)
    if retire:
        done = retire_older(settings, store, done)
    older = not retire and len(keyring.key_ids) > 1
    hint = ["The older keys are still in the file; `--retire` drops them."] if older else []
    return Result(done, [*done.text(), *hint])


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
