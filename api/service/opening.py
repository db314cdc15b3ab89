"""From settings to opened things: keys, database, contract, decoys, pack.

Each function raises :class:`api.http.errors.StartError` with one sentence: which file or setting,
what is wrong with it, and what to do.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Self

import numpy as np
from sqlalchemy import inspect, select
from sqlalchemy.engine import Connection, make_url

from api.http.errors import DatabaseAway, StartError
from api.settings import Settings
from models.errors import ModelError
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoyPool, load_source
from templates.errors import ContractMismatch, SealError, StoreUnavailable, VeilfaceError
from templates.keys.sealing import KeyringSealer, MasterKeyring
from templates.store import TemplateStore
from templates.store.database import Database
from templates.store.lockout import LockoutPolicy
from templates.store.retention import Retention
from templates.store.schema import SecretRow

LOCKOUT = LockoutPolicy()


def database_in_use(url: str) -> bool:
    """Tell whether a master key left its mark in the database; an absent SQLite file has none.

    Tables of other applications in the same database are not looked at.

    Raises
    ------
    StoreError
        If the database does not answer.
    """
    if url.startswith("sqlite") and not Path(make_url(url).database or "").exists():
        return False
    database = Database(url)

    def marked(connection: Connection) -> bool:
        if not inspect(connection).has_table(SecretRow.__tablename__):
            return False
        return connection.execute(select(SecretRow.name).limit(1)).first() is not None

    try:
        return database.read(marked)
    finally:
        database.close()


@dataclass(eq=False)
class Deployment:
    """What the files and the database of a deployment hold, without models.

    Attributes
    ----------
    settings
        What named them.
    keyring
        The master keys.
    store, contract, source
        The database, at this program's schema; the contract; the decoys of its axes.
    """

    settings: Settings
    keyring: MasterKeyring
    store: TemplateStore
    contract: Contract
    source: DecoyPool | DecoyGenerator

    @classmethod
    def open(cls, settings: Settings, *, contract: Contract | None = None) -> Self:
        """Open what the settings name.

        Parameters
        ----------
        settings
            What is opened.
        contract
            The settings' contract, if it is open already.

        Raises
        ------
        StartError
            One sentence on the first thing that is wrong.
        """
        keyring = open_keyring(settings)
        contract = contract or open_contract(settings, keyring)
        source = open_decoys(settings, keyring, contract)
        store = open_store(settings, keyring)
        prepare_database(store)
        return cls(settings, keyring, store, contract, source)

    def close(self) -> None:
        """Let go of the database's connections."""
        self.store.close()


def file_sealer(keyring: MasterKeyring) -> KeyringSealer:
    """Return what seals the files that belong to the deployment: contract, decoy pool, cache."""
    return KeyringSealer(keyring)


def open_keyring(settings: Settings) -> MasterKeyring:
    """Load the master keys, or create the first one while nothing is stored yet.

    They come from an environment variable or a file, whichever the settings name;
    only the file is ever created.

    Raises
    ------
    StartError
        If they cannot be used; or the file is absent, and the database holds something or does
        not answer.
    """
    try:
        if settings.master_key_variable is not None:
            return MasterKeyring.from_environment(settings.master_key_variable)
    except SealError as error:
        raise StartError(f"the master keys cannot be used: {error}") from None
    path = settings.resolved_master_key_file
    try:
        if path.exists():
            return MasterKeyring.load(path)
        _require_unused(settings.resolved_database_url, path)
        return _create_or_load(path)
    except StartError:
        raise
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the master key file {path} cannot be used: {error}") from error


def key_beside_database(settings: Settings) -> str | None:
    """Say that the master key lies in the folder of an SQLite database, or None."""
    if settings.master_key_variable is not None:
        return None
    url = make_url(settings.resolved_database_url)
    if url.get_backend_name() != "sqlite" or not url.database:
        return None
    path = settings.resolved_master_key_file
    if Path(url.database).resolve().parent != path.resolve().parent:
        return None
    return (
        f"the master key file {path} lies in the folder of the database, and so in every copy of "
        "that folder: move it elsewhere, and name the place in the setting master_key_file"
    )


def _require_unused(url: str, path: Path) -> None:
    try:
        in_use = database_in_use(url)
    except (OSError, VeilfaceError) as error:
        raise StartError(
            f"there is no master key file {path}, and none is made while the database cannot be "
            f"asked whether it holds data under an earlier one: {error}"
        ) from error
    if in_use:
        raise StartError(
            f"the master key file {path} is missing, but the database holds data sealed "
            "with it; put the file back from its copy"
        )


def _create_or_load(path: Path) -> MasterKeyring:
    try:
        return MasterKeyring.create(path)
    except SealError:
        if not path.exists():
            raise
        # Another process made it since we looked: its key is everybody's.
        return MasterKeyring.load(path)


def open_store(settings: Settings, keyring: MasterKeyring) -> TemplateStore:
    """Open the store; :func:`prepare_database` must have run once before.

    Raises
    ------
    StartError
        If the URL is wrong, or the SQLite file cannot be made.
    """
    try:
        if settings.database_url is None:
            settings.data_dir.mkdir(parents=True, exist_ok=True)
        return TemplateStore(
            settings.resolved_database_url,
            keyring,
            lockout=replace(LOCKOUT, after=settings.lockout_after),
        )
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the database cannot be opened: {error}") from None


@contextmanager
def checked_store(settings: Settings) -> Iterator[TemplateStore]:
    """Open the store for the block; schema and master key must be the right ones."""
    store = open_store(settings, open_keyring(settings))
    try:
        store.check()
        yield store
    finally:
        store.close()


def retention_of(settings: Settings) -> Retention:
    """Return how long subjects are kept, by the settings."""

    def days(number: int | None) -> timedelta | None:
        return None if number is None else timedelta(days=number)

    return Retention(days(settings.retention_days), days(settings.retention_disuse_days))


def prepare_database(store: TemplateStore) -> None:
    """Bring the schema up to date, and hold the master key against it.

    Several processes may do so at once; the command line does it before it starts workers.

    Raises
    ------
    StartError
        If the database does not answer, or belongs to another master key or a newer program.
    """
    try:
        store.upgrade()
    except StoreUnavailable as error:
        raise DatabaseAway(f"the database cannot be used: {error}") from None
    except VeilfaceError as error:
        raise StartError(f"the database cannot be used: {error}") from None


def open_contract(settings: Settings, keyring: MasterKeyring) -> Contract:
    """Load the contract file.

    Raises
    ------
    StartError
        If the file is absent, broken, or sealed with another master key.
    """
    path = settings.resolved_contract_file
    if not path.is_file():
        raise StartError(
            f"there is no contract file {path}; `veilface calibrate` writes one (setting data_dir)"
        )
    try:
        contract = Contract.load(path, file_sealer(keyring))
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the contract file {path} cannot be used: {error}") from error
    return contract


def weak_privacy(contract: Contract) -> str | None:
    """Say in one sentence why a contract's templates are not to be trusted, or None."""
    if contract.verdict is None:
        return "nobody measured what a thief of a template gets out of it"
    privacy = contract.verdict.privacy
    if privacy.status == "PASS":
        return None
    within = privacy.rate.value <= privacy.limit
    if within and privacy.shortfall is not None:
        return privacy.shortfall
    return (
        f"a thief of a template gets a match for the face from {100 * privacy.rate.value:.3g} % of "
        f"them ({privacy.rate.errors} of {privacy.rate.trials}), "
        + (
            f"which shows no more than that it is below {100 * (privacy.upper or 1.0):.3g} %"
            if within
            else f"and {100 * privacy.limit:.3g} % is the most that passes"
        )
    )


def require_privacy(contract: Contract, settings: Settings) -> str | None:
    """Return why privacy is not proven, or None; refuse the contract where the settings say so.

    Raises
    ------
    StartError
        Privacy is not proven, and ``require_private`` is set.
    """
    why = weak_privacy(contract)
    if why is not None and settings.require_private:
        raise StartError(
            f"privacy is not proven, and require_private asks for it: {why}. Build decoys that are "
            "like your people (`veilface decoys build --like`) and calibrate again"
        )
    return why


def open_decoys(
    settings: Settings, keyring: MasterKeyring, contract: Contract
) -> DecoyPool | DecoyGenerator:
    """Load the decoy source that the contract is bound to, reduced to the contract's axes.

    Raises
    ------
    StartError
        If the file is absent or broken, is another source than the contract's, or was made
        with another model or preprocessing.
    """
    path = settings.resolved_decoys_file
    if not path.is_file():
        raise StartError(
            f"there is no decoys file {path}; `veilface decoys build` writes one (setting data_dir)"
        )
    try:
        source = load_source(path, file_sealer(keyring)).reduced(contract.binding.axes)
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the decoys file {path} cannot be used: {error}") from error
    try:
        contract.binding.require_source(source_id=source.source_id, made_with=source.made_with)
    except ContractMismatch as error:
        raise StartError(f"the decoys file {path} is not the contract's: {error}") from error
    return source


def open_pack(settings: Settings, contract: Contract | None = None) -> ModelPack | None:
    """Load the model pack and hold it against the contract; None when none is set.

    Raises
    ------
    StartError
        If the pack is broken, or its embedder is not the contract's.
    """
    if settings.pack is None:
        return None
    try:
        pack = ModelPack.load(
            settings.pack,
            providers=settings.providers,
            threads=settings.onnx_threads,
            flip=contract is not None and bool(contract.binding.preprocessing.get("flip")),
        )
    except (OSError, ModelError) as error:
        raise StartError(f"the model pack {settings.pack} cannot be used: {error}") from error
    if contract is not None:
        try:
            contract.binding.require_embedder(
                embedder_sha256=pack.info.embedder_sha256,
                preprocessing=pack.info.preprocessing,
                n=pack.info.n,
            )
        except ContractMismatch as error:
            raise StartError(
                f"the pack {settings.pack} does not belong to the contract "
                f"{settings.resolved_contract_file}: {error}"
            ) from error
    return pack


def try_inference(pack: ModelPack) -> None:
    """Run the whole pack once, on grey noise, so that a broken graph stops the start.

    Raises
    ------
    StartError
        If it fails, or gives something else than one finite unit vector.
    """
    size = pack.crop_size
    noise = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
    try:
        if pack.info.detector is not None:
            pack.detect(noise)
        embedding = pack.embed(noise[None])
    except ModelError as error:
        raise StartError(
            f"the pack {pack.info.name} fails on its first picture: {error}"
        ) from error
    norm = float(np.linalg.norm(embedding))
    if embedding.shape != (1, pack.info.n) or not abs(norm - 1.0) < 1e-3:
        raise StartError(f"the pack {pack.info.name} does not give a unit vector")
