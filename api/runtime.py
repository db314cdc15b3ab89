"""What the settings name, opened: the same objects for the service and for the command line.

::

    settings ─▶ open_keyring ─▶ open_store           keys, db, enough for a service of no pack
                     └────────▶ open_contract ┐
                                open_decoys   ├─▶ Runtime.enroller(tenant) / .verifier(tenant)
                                open_pack     ┘
"""

import threading
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from models.errors import ModelError
from models.pack import ModelPack
from numpy.typing import NDArray
from sqlalchemy import create_engine, inspect, select, table
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import NullPool
from templates.contract import Contract
from templates.decoys import DecoyGenerator, DecoyPool, load_source
from templates.rotation import tenant_rotation
from templates.sealing import MasterKeyring

from api.errors import StartError
from api.settings import Settings
from enroll import Enroller
from templates.errors import VeilfaceError
from templates.store import TemplateStore
from verify import Verifier


def database_in_use(url: str) -> bool:
    """Tell whether the database holds a row of ours; an absent SQLite file holds none.

    Raises
    ------
    StartError
        If the database does not answer. The sentence never repeats the URL's password.
    """
    shown = "the database"
    try:
        parsed = make_url(url)
        shown = f"the database {parsed.render_as_string(hide_password=True)}"
        if parsed.get_backend_name() == "sqlite" and not _sqlite_file_exists(parsed.database):
            return False
        engine = create_engine(parsed, poolclass=NullPool)
        with engine.connect() as connection:
            names = [
                name
                for name in inspect(connection).get_table_names()
                if name not in {"alembic_version"}
            ]
            return any(
                connection.execute(select(1).select_from(table(name)).limit(1)).first() is not None
                for name in names
            )
    except (SQLAlchemyError, ImportError, OSError) as error:
        raise StartError(f"{shown} does not answer: {type(error).__name__}") from None


def _sqlite_file_exists(database: str | None) -> bool:
    return bool(database) and database != ":memory:" and Path(str(database)).exists()


def open_keyring(settings: Settings) -> MasterKeyring:
    """Load the master keys, or create the first one while nothing is stored yet.

    Raises
    ------
    StartError
        If the file is absent although the database holds something, or cannot be used.
    """
    path = settings.resolved_master_key_file
    try:
        if path.exists():
            return MasterKeyring.load(path)
        if database_in_use(settings.resolved_database_url):
            raise StartError(
                f"the master key file {path} is missing, but the database holds data sealed "
                "with it; put the file back from its copy"
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        return MasterKeyring.create(path)
    except StartError:
        raise
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the master key file {path} cannot be used: {error}") from error


def open_store(settings: Settings, keyring: MasterKeyring) -> TemplateStore:
    """Open the store; :func:`prepare_database` must have run once before.

    Raises
    ------
    StartError
        If the database does not answer.
    """
    if settings.database_url is None:
        settings.data_dir.mkdir(parents=True, exist_ok=True)
    try:
        return TemplateStore(settings.resolved_database_url, keyring)
    except (SQLAlchemyError, ImportError, VeilfaceError) as error:
        raise StartError(f"the database cannot be opened: {_cause(error)}") from None


def prepare_database(store: TemplateStore) -> None:
    """Bring the schema up to date; run once, before the workers start."""
    try:
        store.migrate()
    except (SQLAlchemyError, VeilfaceError) as error:
        raise StartError(f"the database cannot be migrated: {_cause(error)}") from None


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
            f"there is no contract file {path}; `veilface calibrate` writes one "
            "(setting contract_file)"
        )
    try:
        return Contract.load(path, keyring)
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the contract file {path} cannot be used: {error}") from error


def open_decoys(
    settings: Settings, keyring: MasterKeyring, contract: Contract
) -> DecoyPool | DecoyGenerator | None:
    """Load the decoy source that the contract is bound to; None when none is set.

    Raises
    ------
    StartError
        If a named file is absent or broken, or is another source than the contract's.
    """
    path = settings.resolved_decoys_file
    if not path.is_file():
        if settings.decoys_file is None:
            return None
        raise StartError(f"there is no decoys file {path} (setting decoys_file)")
    try:
        source = load_source(path, keyring)
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the decoys file {path} cannot be used: {error}") from error
    bound = contract.binding.decoy_source_id
    if source.source_id != bound:
        raise StartError(
            f"the decoys file {path} is source {source.source_id[:16]}, but the contract is bound "
            f"to source {str(bound)[:16]}; set decoys_file to the file that the contract was "
            "calibrated with"
        )
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
            settings.pack, providers=settings.providers, threads=settings.onnx_threads
        )
    except (OSError, ModelError) as error:
        raise StartError(f"the model pack {settings.pack} cannot be used: {error}") from error
    if contract is not None:
        bound, seen = contract.binding.embedder_sha256, pack.info.embedder_sha256
        if bound != seen:
            raise StartError(
                f"the pack {settings.pack} has embedder {seen[:16]}, but the contract "
                f"{settings.resolved_contract_file} is bound to embedder {bound[:16]}; use the "
                "pack that the contract was calibrated with, or calibrate this one"
            )
    return pack


def _cause(error: Exception) -> str:
    """Name the cause without the SQL, its parameters or the URL."""
    return str(error) if isinstance(error, VeilfaceError) else type(error).__name__


@dataclass(eq=False)
class Runtime:
    """Everything that answers a request, opened once in each process."""

    settings: Settings
    keyring: MasterKeyring
    store: TemplateStore
    contract: Contract
    source: DecoyPool | DecoyGenerator | None
    pack: ModelPack | None
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _enrollers: dict[str, Enroller] = field(default_factory=dict, repr=False)
    _verifiers: dict[str, Verifier] = field(default_factory=dict, repr=False)

    @classmethod
    def open(cls, settings: Settings) -> "Runtime":
        """Open everything that the settings name.

        Raises
        ------
        StartError
            One sentence on the first thing that is wrong.
        """
        keyring = open_keyring(settings)
        contract = open_contract(settings, keyring)
        source = open_decoys(settings, keyring, contract)
        pack = open_pack(settings, contract)
        store = open_store(settings, keyring)
        prepare_database(store)
        return cls(settings, keyring, store, contract, source, pack)

    def enroller(self, tenant: str) -> Enroller:
        """Return the tenant's enroller."""
        with self._lock:
            if tenant not in self._enrollers:
                self._enrollers[tenant] = Enroller(
                    self.contract, self.source, rotation=self._rotation(tenant)
                )
            return self._enrollers[tenant]

    def verifier(self, tenant: str) -> Verifier:
        """Return the tenant's verifier."""
        with self._lock:
            if tenant not in self._verifiers:
                self._verifiers[tenant] = Verifier(self.contract, rotation=self._rotation(tenant))
            return self._verifiers[tenant]

    def _rotation(self, tenant: str) -> NDArray[np.float64]:
        return tenant_rotation(self.store.rotation_key(tenant), self.contract.binding.n)

    def close(self) -> None:
        """Let go of the database's connections."""
        self.store.close()
