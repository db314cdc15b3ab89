"""``veilface keys master``, ``rotate`` and ``rewrap``: the keys that everything is sealed under."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import emit, progress, say
from api.cli.errors import CommandError, UsageError
from api.cli.options import STORE, AsJson, takes_settings
from api.service.opening import file_sealer, open_keyring, open_store, prepare_database
from api.settings import Settings
from templates.contract.document import Contract
from templates.decoys import DecoyPool, load_source
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore

FILES = (*STORE, "contract_file", "decoys_file")


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


@takes_settings(*FILES)
def rotate(*, settings: Settings, retire: Retire = False, as_json: AsJson = False) -> None:
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
        _rewrap(settings, keyring, store, retire=retire, as_json=as_json)


@takes_settings(*FILES)
def rewrap(*, settings: Settings, retire: Retire = False, as_json: AsJson = False) -> None:
    """Finish a rotation: rewrap whatever an older master key still wraps.

    Safe to run again, and after an interrupted `rotate`.

    Example: `veilface keys rewrap --retire`
    """
    if retire:
        _require_file(settings, "drop the old key where they come from")
    keyring = open_keyring(settings)
    with opened_store(settings, keyring) as store:
        _rewrap(settings, keyring, store, retire=retire, as_json=as_json)


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
    store.database.write(lambda _: MasterKeyring.add_current(path))


@dataclass(frozen=True)
class Rewrapped:
    """What was brought under the current master key.

    Attributes
    ----------
    changed
        Number of keys and secrets that were wrapped again.
    files
        Files that were sealed again.
    is_complete
        Whether no older key wraps anything any more.
    """

    key_id: str
    changed: int
    files: list[Path]
    is_complete: bool


def rewrap_all(settings: Settings, keyring: MasterKeyring, store: TemplateStore) -> Rewrapped:
    """Bring the database, and the files that are sealed, under the current master key."""
    total = sum(n for key, n in store.wrapped_keys.count().items() if key != keyring.current)
    with progress("wrapping keys again", total) as advance:
        changed = store.wrapped_keys.rewrap(progress=advance)
    current = keyring.current
    left = set(store.wrapped_keys.count()) - {current}
    return Rewrapped(current, changed, _seal_files_again(settings, keyring), not left)


def retire_older(settings: Settings, store: TemplateStore, rewrapped: Rewrapped) -> int:
    """Drop the older keys from the key file; returns how many."""
    if not rewrapped.is_complete:
        raise CommandError(
            "something is still wrapped by an older master key; run `veilface keys rewrap` "
            "again before retiring it"
        )
    path = settings.resolved_master_key_file
    return store.database.write(lambda _: MasterKeyring.drop_retired(path, keep=rewrapped.key_id))


def _rewrap(
    settings: Settings,
    keyring: MasterKeyring,
    store: TemplateStore,
    *,
    retire: bool,
    as_json: bool,
) -> None:
    rewrapped = rewrap_all(settings, keyring, store)
    current, changed, files = rewrapped.key_id, rewrapped.changed, rewrapped.files
    dropped = retire_older(settings, store, rewrapped) if retire else 0
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
