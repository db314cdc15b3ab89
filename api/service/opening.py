"""From settings to opened things: keys, database, contract, decoys, pack.

Each function raises :class:`api.http.errors.StartError` with one sentence: which file or setting,
what is wrong with it, and what to do.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import numpy as np
from sqlalchemy import inspect, select
from sqlalchemy.engine import make_url

from api.http.errors import StartError
from api.settings import Settings
from models.errors import ModelError
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoyPool, load_source
from templates.errors import SealError, VeilfaceError
from templates.keys.sealing import MasterKeyring, Sealer
from templates.store import TemplateStore
from templates.store.database import Database
from templates.store.lockout import LockoutPolicy
from templates.store.retention import Retention
from templates.store.schema import SecretRow

LOCKOUT = LockoutPolicy()


@contextmanager
def _start_error(sentence: str) -> Iterator[None]:
    """Say, before what goes wrong in the block, which thing it is about."""
    try:
        yield
    except StartError:
        raise
    except (OSError, VeilfaceError, ModelError) as error:
        raise StartError(f"{sentence}: {error}") from None


@dataclass(eq=False)
class Deployment:
    """What the files and the database of a deployment hold, without models."""

    settings: Settings
    keyring: MasterKeyring
    store: TemplateStore
    contract: Contract
    source: DecoyPool | DecoyGenerator

    def close(self) -> None:
        """Let go of the database's connections."""
        self.store.close()


def open_deployment(settings: Settings, *, contract: Contract | None = None) -> Deployment:
    """Open what the settings name; no query is sent to the database yet.

    ``contract`` is given where the process that started this one has read the file.
    """
    keyring = open_keyring(settings)
    contract = contract or open_contract(settings, keyring)
    if settings.require_private and (why := weak_privacy(contract)) is not None:
        raise StartError(
            f"privacy is not proven, and require_private asks for it: {why}. Build decoys that are "
            "like your people (`veilface decoys build --like`) and calibrate again"
        )
    source = open_decoys(settings, keyring, contract)
    return Deployment(settings, keyring, open_store(settings, keyring), contract, source)


def file_sealer(keyring: MasterKeyring) -> Sealer:
    """Return what seals the files that belong to the deployment: contract, decoy pool, cache."""
    return Sealer(keyring)


def open_keyring(settings: Settings) -> MasterKeyring:
    """Load the master keys, or create the first one while nothing is stored yet.

    They come from an environment variable or a file, whichever the settings name;
    only the file is ever created: never while the database holds something or does not answer.
    """
    if settings.master_key_variable is not None:
        with _start_error("the master keys cannot be used"):
            return MasterKeyring.from_environment(settings.master_key_variable)
    path = settings.resolved_master_key_file
    with _start_error(f"the master key file {path} cannot be used"):
        if not path.exists():
            _require_unused(settings.resolved_database_url, path)
            try:
                return MasterKeyring.create(path)
            except SealError:
                if not path.exists():
                    raise
                # Another process made it since we looked: its key is everybody's.
        return MasterKeyring.load(path)


def _require_unused(url: str, path: Path) -> None:
    with _start_error(
        f"there is no master key file {path}, and none is made while the database cannot be asked "
        "whether it holds data under an earlier one"
    ):
        if database_in_use(url):
            raise StartError(
                f"the master key file {path} is missing, but the database holds data sealed "
                "with it; put the file back from its copy"
            )


def database_in_use(url: str) -> bool:
    """Tell whether a master key left its mark in the database; an absent SQLite file has none.

    Tables of other applications in the same database are not looked at.
    """
    if url.startswith("sqlite") and not Path(make_url(url).database or "").exists():
        return False
    database = Database(url)
    try:
        with database.read() as session:
            has_table = inspect(session.connection()).has_table(SecretRow.__tablename__)
            return has_table and session.scalar(select(SecretRow.name).limit(1)) is not None
    finally:
        database.close()


def key_beside_database(settings: Settings) -> str | None:
    """Say that the master key lies in the folder of an SQLite database, or None."""
    url, path = make_url(settings.resolved_database_url), settings.resolved_master_key_file
    if url.get_backend_name() != "sqlite" or settings.master_key_variable is not None:
        return None
    if Path(url.database or "").resolve().parent != path.resolve().parent:
        return None
    return (
        f"the master key file {path} lies in the folder of the database, and so in every copy of "
        "that folder: move it elsewhere, and name the place in the setting master_key_file"
    )


def open_store(settings: Settings, keyring: MasterKeyring) -> TemplateStore:
    """Open the store; :func:`prepare_database` must have run once before."""
    with _start_error("the database cannot be opened"):
        if settings.database_url is None:
            settings.data_dir.mkdir(parents=True, exist_ok=True)
        return TemplateStore(
            settings.resolved_database_url,
            keyring,
            lockout=replace(LOCKOUT, after=settings.lockout_after),
        )


@contextmanager
def checked_store(settings: Settings) -> Iterator[TemplateStore]:
    """Open the store for the block; schema and master key must be the right ones."""
    store = open_store(settings, open_keyring(settings))
    try:
        store.check()
        yield store
    finally:
        store.close()


def prepare_database(store: TemplateStore) -> None:
    """Bring the schema up to date, and hold the master key against it.

    Several processes may do so at once; the command line does it before it starts workers.
    """
    with _start_error("the database cannot be used"):
        store.upgrade()


def retention_of(settings: Settings) -> Retention:
    """Return how long subjects are kept, by the settings."""

    def days(number: int | None) -> timedelta | None:
        return None if number is None else timedelta(days=number)

    return Retention(days(settings.retention_days), days(settings.retention_disuse_days))


def open_contract(settings: Settings, keyring: MasterKeyring) -> Contract:
    """Load the contract file."""
    path = settings.resolved_contract_file
    if not path.is_file():
        raise StartError(
            f"there is no contract file {path}; `veilface calibrate` writes one (setting data_dir)"
        )
    with _start_error(f"the contract file {path} cannot be used"):
        return Contract.load(path, file_sealer(keyring))


def weak_privacy(contract: Contract) -> str | None:
    """Say in one sentence why a contract's templates are not to be trusted, or None."""
    if contract.verdict is None:
        return "nobody measured what a thief of a template gets out of it"
    privacy = contract.verdict.privacy
    rate = privacy.rate
    if privacy.status == "PASS":
        return None
    if rate.value > privacy.limit:
        return (
            f"a thief of a template gets a match for the face from {100 * rate.value:.3g} % of "
            f"them ({rate.errors} of {rate.trials}), and {100 * privacy.limit:.3g} % is the most "
            "that passes"
        )
    return privacy.shortfall or f"{rate.trials} templates are too few to show it"


def open_decoys(
    settings: Settings, keyring: MasterKeyring, contract: Contract
) -> DecoyPool | DecoyGenerator:
    """Load the decoy source that the contract is bound to, reduced to the contract's axes."""
    path = settings.resolved_decoys_file
    if not path.is_file():
        raise StartError(
            f"there is no decoys file {path}; `veilface decoys build` writes one (setting data_dir)"
        )
    with _start_error(f"the decoys file {path} cannot be used"):
        source = load_source(path, file_sealer(keyring)).reduced(contract.binding.axes)
    with _start_error(f"the decoys file {path} is not the contract's"):
        contract.binding.require_source(source)
    return source


def open_pack(settings: Settings, contract: Contract) -> ModelPack | None:
    """Load the model pack, hold it against the contract, and try it; None when none is set."""
    if settings.pack is None:
        return None
    with _start_error(f"the model pack {settings.pack} cannot be used"):
        pack = ModelPack.load(
            settings.pack,
            providers=settings.providers,
            threads=settings.onnx_threads,
            flip=bool(contract.binding.preprocessing.get("flip")),
        )
    with _start_error(
        f"the pack {settings.pack} does not belong to the contract "
        f"{settings.resolved_contract_file}"
    ):
        contract.binding.require_embedder(
            embedder_sha256=pack.info.embedder_sha256,
            preprocessing=pack.info.preprocessing,
            n=pack.info.n,
        )
    try_inference(pack)
    return pack


def try_inference(pack: ModelPack) -> None:
    """Run the whole pack once, on grey noise, so that a broken graph stops the start."""
    size = pack.crop_size
    noise = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
    with _start_error(f"the pack {pack.info.name} fails on its first picture"):
        if pack.info.detector is not None:
            pack.detect(noise)
        norm = float(np.linalg.norm(pack.embed(noise[None])))
    if not abs(norm - 1.0) < 1e-3:
        raise StartError(f"the pack {pack.info.name} does not give a unit vector")
