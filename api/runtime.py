"""What the settings name, opened: the same objects for the service and for the command line.

::

    settings ─▶ open_keyring ─▶ open_store           keys, db, enough for a service of no pack
                     └────────▶ open_contract ┐
                                open_decoys   ├─▶ Runtime.enroller(tenant) / .verifier(tenant)
                                open_pack     ┘
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import inspect, select, table
from sqlalchemy.engine import Connection, make_url
from sqlalchemy.exc import ArgumentError

from api.errors import ApiError, StartError
from api.settings import Settings
from api.transfer import Exported, ExportKey, seal_export
from enroll import Enroller, Enrollment
from enroll.enroller import WIRE_DTYPE
from models.decoding import ImageLimits
from models.errors import ModelError
from models.pack import ModelPack
from templates import wire
from templates.contract import Contract
from templates.decoys import Attributes, DecoyGenerator, DecoyPool, load_source
from templates.errors import ContractMismatch, DecoyError, VeilfaceError
from templates.lifting import Strategy
from templates.randomness import Keystream
from templates.rotation import tenant_rotation
from templates.sealing import KeyringSealer, MasterKeyring
from templates.store import TemplateStore
from templates.store.database import Database
from templates.store.envelope import Owner, close_envelope, open_envelope
from templates.store.subjects import Source, StoredTemplate
from verify import Verifier


def database_in_use(url: str) -> bool:
    """Tell whether the database holds a row of ours; an absent SQLite file holds none.

    Raises
    ------
    StoreError
        If the database does not answer.
    """
    if url.startswith("sqlite") and not Path(make_url(url).database or "").exists():
        return False
    database = Database(url)

    def any_row(connection: Connection) -> bool:
        return any(
            connection.execute(select(1).select_from(table(name)).limit(1)).first() is not None
            for name in inspect(connection).get_table_names()
            if name != "alembic_version"
        )

    try:
        return database.read(any_row)
    finally:
        database.close()


def file_sealer(keyring: MasterKeyring) -> KeyringSealer:
    """Return what seals the files that belong to the deployment: contract, decoy pool, cache."""
    return KeyringSealer(keyring)


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
    except (OSError, ArgumentError, VeilfaceError) as error:
        raise StartError(f"the master key file {path} cannot be used: {error}") from error


def open_store(settings: Settings, keyring: MasterKeyring) -> TemplateStore:
    """Open the store; :func:`prepare_database` must have run once before.

    Raises
    ------
    StartError
        If the URL is wrong or the SQLite file cannot be made.
    """
    try:
        if settings.database_url is None:
            settings.data_dir.mkdir(parents=True, exist_ok=True)
        return TemplateStore(settings.resolved_database_url, keyring)
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the database cannot be opened: {error}") from None


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
            f"there is no contract file {path}; `veilface calibrate` writes one "
            "(setting contract_file)"
        )
    try:
        return Contract.load(path, file_sealer(keyring))
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
        source = load_source(path, file_sealer(keyring))
    except (OSError, VeilfaceError) as error:
        raise StartError(f"the decoys file {path} cannot be used: {error}") from error
    try:
        contract.binding.require_source(source_id=source.source_id)
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


def _lacking(what: str) -> ApiError:
    return ApiError(
        "model_unavailable",
        f"this service runs without a {what}: send templates, or ask its operator",
        {},
        {"Retry-After": "60"},
    )


class NoDecoys:
    """The decoy source of a service that has none: it enrolls clients' templates only."""

    def __init__(self, contract: Contract) -> None:
        self.source_id = contract.binding.decoy_source_id
        self.n = contract.binding.n

    def draw(
        self,
        rows: int,  # noqa: ARG002 - the protocol's
        k: int,  # noqa: ARG002
        *,
        stream: Keystream,  # noqa: ARG002
        unlike: Sequence[Attributes] | None = None,  # noqa: ARG002
        sub_databases: int | None = None,  # noqa: ARG002
    ) -> NDArray[np.float32]:
        """Refuse: photos cannot be lifted without decoys."""
        raise DecoyError("the service has no decoys file, so it cannot enroll photos")


@dataclass(eq=False)
class Runtime:
    """Everything that answers a request, opened once in each process."""

    settings: Settings
    keyring: MasterKeyring
    store: TemplateStore
    contract: Contract
    source: DecoyPool | DecoyGenerator | None
    pack: ModelPack | None
    export_key: ExportKey
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _rotations: dict[tuple[str, int], NDArray[np.float64]] = field(default_factory=dict, repr=False)
    _enrollers: dict[tuple[str, int], Enroller] = field(default_factory=dict, repr=False)
    _verifiers: dict[tuple[str, int], Verifier] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        owner = Owner("", "stand-in", "", self.contract.contract_id, "", 0)
        nobody = wire.encode(
            self.contract.cohort[0], contract_id=self.contract.contract_id, dtype=WIRE_DTYPE
        )
        self._stand_in = (close_envelope(nobody, owner, self.keyring), owner)

    @classmethod
    def open(cls, settings: Settings) -> "Runtime":
        """Open everything that the settings name, and run one inference where there is a pack.

        Raises
        ------
        StartError
            One sentence on the first thing that is wrong.
        """
        keyring = open_keyring(settings)
        contract = open_contract(settings, keyring)
        source = open_decoys(settings, keyring, contract)
        pack = open_pack(settings, contract)
        if pack is not None:
            try_inference(pack)
        store = open_store(settings, keyring)
        prepare_database(store)
        # Obtained now, so that no request waits for it, nor fails on it.
        store.pseudonym(settings.default_tenant, "-")
        store.receipt_public_key()
        if settings.export_key_file is not None:
            export_key = ExportKey.from_file(settings.export_key_file)
        else:
            export_key = ExportKey.from_secret(store.secrets.get("export"))
        return cls(settings, keyring, store, contract, source, pack, export_key)

    def epoch(self, tenant: str) -> int:
        """Return the epoch of the rotation that the tenant's new templates are in."""
        return self.store.tenants.get(tenant).rotation_epoch

    def rotation(self, tenant: str, epoch: int) -> NDArray[np.float64]:
        """Return a tenant's rotation of one epoch, (n, n); computed once and kept."""
        found = self._rotations.get((tenant, epoch))
        if found is None:
            key = self.store.tenants.rotation_key(tenant, epoch=epoch).key
            found = tenant_rotation(key, self.contract.binding.n)
            with self._lock:
                self._rotations[tenant, epoch] = found
        return found

    def enroller(self, tenant: str, epoch: int) -> Enroller:
        """Return the tenant's enroller for one epoch of its rotation."""
        found = self._enrollers.get((tenant, epoch))
        if found is None:
            found = Enroller(
                self.contract,
                self.source or NoDecoys(self.contract),
                rotation=self.rotation(tenant, epoch),
            )
            with self._lock:
                self._enrollers[tenant, epoch] = found
        return found

    def verifier(self, tenant: str, epoch: int) -> Verifier:
        """Return the tenant's verifier for one epoch of its rotation."""
        found = self._verifiers.get((tenant, epoch))
        if found is None:
            found = Verifier(self.contract, rotation=self.rotation(tenant, epoch))
            with self._lock:
                self._verifiers[tenant, epoch] = found
        return found

    def require_decoys(self) -> None:
        """Refuse to lift where there are no decoys and the strategy needs some.

        Raises
        ------
        ApiError
            ``model_unavailable``.
        """
        if self.source is None and self.contract.binding.strategy is not Strategy.RANDOM:
            raise _lacking("decoys file")

    @property
    def image_limits(self) -> ImageLimits:
        """What a photo may cost before it is decoded, by the settings."""
        return ImageLimits(
            max_bytes=self.settings.max_image_bytes, max_pixels=self.settings.max_image_pixels
        )

    def required_pack(self) -> ModelPack:
        """Return the pack.

        Raises
        ------
        ApiError
            ``model_unavailable``.
        """
        if self.pack is None:
            raise _lacking("model pack")
        return self.pack

    def put(
        self,
        tenant: str,
        subject: str,
        epoch: int,
        enrollment: Enrollment,
        *,
        source: Source,
        photos: int,
    ) -> StoredTemplate:
        """Store an enrollment in place of an earlier one."""
        binding = self.contract.binding
        return self.store.put(
            tenant,
            subject,
            enrollment.wire,
            contract_id=enrollment.contract_id,
            n=binding.n,
            m=binding.m,
            dtype=WIRE_DTYPE,
            source=source,
            photos=photos,
            template_id=enrollment.template_id,
            rotation_epoch=epoch,
        )

    def export(self, tenant: str, subject: str) -> bytes | None:
        """Return one subject, un-rotated and encrypted; None if there is none.

        Raises
        ------
        ContractMismatch
            If the stored template belongs to another contract: its dimension may not even fit.
        """
        found = self.store.get(tenant, subject)
        if found is None:
            return None
        binding = self.contract.binding
        binding.require_contract(found.record.contract_id, what="the stored template")
        stored = wire.decode(found.wire, max_n=binding.n, max_m=binding.m)
        # A rotation's inverse is its transpose.
        plain = stored.subspace.rotated(self.rotation(tenant, found.record.rotation_epoch).T)
        exported = Exported(
            subject_id=subject,
            contract_id=self.contract.contract_id,
            source=str(found.record.source),
            photos=found.record.photos,
            wire=wire.encode(plain, contract_id=self.contract.contract_id, dtype="float32"),
        )
        return seal_export(exported, key=self.export_key, tenant=tenant)

    def open_stand_in(self) -> bytes:
        """Decrypt a template of nobody: the work that a stored one would have cost."""
        return open_envelope(self._stand_in[0], self._stand_in[1], self.keyring)

    def close(self) -> None:
        """Let go of the database's connections."""
        self.store.close()


def bootstrap_token(store: TemplateStore, settings: Settings) -> str | None:
    """Make the first tenant and its first API key, with all rights; None if there is a key.

    The token is shown once, by whoever calls this, and kept nowhere.
    """
    made = store.api_keys.bootstrap(tenant=settings.default_tenant)
    return None if made is None else made.token


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
