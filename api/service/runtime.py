"""What answers a request, opened once in each process, for the service and the command line.

::

    settings ─▶ open_keyring ─▶ open_store    ┐ enough for keys and db
                     └────────▶ open_contract ├─▶ Deployment ┐
                                open_decoys   ┘              ├─▶ Runtime
                                open_pack ───────────────────┘     .epoch: enroller, verifier
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, Self

from api.http.errors import ApiError
from api.http.policy import Levels, LivenessRules
from api.http.transfer import Exported, ExportKey, seal_export
from api.service.allocator import keep_few_arenas
from api.service.opening import Deployment, open_deployment, open_pack
from api.service.served_graphs import served_graphs
from api.service.stand_in import SealedStandIn
from api.settings import Settings
from enroll import Enroller, Enrollment
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.document import Contract
from templates.keys.rotation import TenantRotation
from templates.store.audit_log import By
from templates.store.schema import Source
from templates.store.secrets import SecretName
from templates.store.subjects import Precondition, SubjectTemplate
from verify import Verifier

TENANTS_KEPT = 64
"""Tenants and epochs whose rotations a process keeps."""


@dataclass(frozen=True, eq=False)
class Epoch:
    """One epoch of a tenant's rotations, and what works with them."""

    number: int
    rotation: TenantRotation
    enroller: Enroller
    verifier: Verifier


@dataclass(eq=False)
class Runtime(Deployment):
    """Everything that answers a request, opened once in each process."""

    pack: ModelPack | None

    def __post_init__(self) -> None:
        file = self.settings.export_key_file
        self._operators_export_key = None if file is None else ExportKey.from_file(file)
        self.levels = Levels(self.contract, lowest=self.settings.lowest_level)
        self.liveness = LivenessRules(self.settings.liveness, self.contract, self.pack)
        self.graphs = served_graphs(self.settings, self.pack)
        self.nobody = self.contract.nobody(self.source)
        self.stand_in = SealedStandIn(
            self.nobody, self.keyring, contract_id=self.contract.contract_id
        )
        self.epoch = lru_cache(TENANTS_KEPT)(self._epoch)

    @classmethod
    def open(cls, settings: Settings, *, contract: Contract | None = None) -> Self:
        """Open the deployment and its models (:func:`open_deployment`)."""
        keep_few_arenas(settings.resolved_compute_slots)
        deployment = open_deployment(settings, contract=contract)
        return cls(**vars(deployment), pack=open_pack(settings, deployment.contract))

    @property
    def export_key(self) -> ExportKey:
        """The operator's key of exports, or else the deployment's own, as it is in force now."""
        return self._operators_export_key or ExportKey.from_secret(
            self.store.secrets.get(SecretName.EXPORT)
        )

    def current_epoch(self, tenant: str) -> Epoch:
        """Return the epoch that the tenant's new templates are in."""
        return self.epoch(tenant, self.store.tenants.get(tenant).rotation_epoch)

    def read(self, tenant: str, subject: str) -> tuple[SubjectTemplate, Epoch] | None:
        """Return a subject's template and the epoch that it is in; None if there is none."""
        template = self.store.subjects.get(tenant, subject)
        if template is None:
            return None
        return template, self.epoch(tenant, template.record.rotation_epoch)

    def _epoch(self, tenant: str, number: int) -> Epoch:
        key = self.store.tenants.rotation_key(tenant, number)
        rotation = TenantRotation(key, self.contract.binding.axes)
        lift_secret = self.store.secrets.get(SecretName.LIFTS)
        return Epoch(
            number,
            rotation,
            Enroller(self.contract, self.source, rotation=rotation, lift_secret=lift_secret),
            Verifier(self.contract, self.source, rotation=rotation),
        )

    def require_template_enrollment(self, tenant: str) -> None:
        """Refuse a template that a client made, unless the operator lets the tenant enroll them.

        Asked of the database every time, so that a change counts at once in all workers.
        """
        if not self.store.tenants.get(tenant).template_enrollment:
            raise ApiError(
                "forbidden",
                "this tenant does not take templates that clients made: enroll photos, or ask the "
                "operator to allow it (`veilface db template-enrollment --allow`)",
                {"tenant_setting": "template_enrollment"},
            )

    def required_pack(self) -> ModelPack:
        """Return the pack, or refuse what needs one."""
        if self.pack is None:
            raise ApiError(
                "model_unavailable",
                "this service runs without a model pack: send templates, or ask its operator",
                {},
                {"Retry-After": "60"},
            )
        return self.pack

    def put(
        self,
        tenant: str,
        subject: str,
        epoch: Epoch,
        enrollment: Enrollment,
        *,
        source: Source,
        photos: int,
        precondition: Precondition | None = None,
        token: str | None = None,
        action: Literal["enroll", "import"] = "enroll",
        by: By,
    ) -> bool:
        """Store an enrollment; returns whether it replaced an earlier one.

        `precondition`, `token` and `action` are those of ``Subjects.put``.
        """
        return self.store.subjects.put(
            tenant,
            subject,
            enrollment.wire,
            contract_id=enrollment.contract_id,
            source=source,
            photos=photos,
            template_id=enrollment.template_id,
            holder_salt=enrollment.holder_salt,
            rotation_epoch=epoch.number,
            precondition=precondition,
            action=action,
            token=token,
            by=by,
        )

    def export(self, tenant: str, subject: str, *, by: By) -> bytes | None:
        """Return one subject, encrypted, without the tenant's rotation; None if there is none.

        It stays turned by the holder's, whose key is not here. Its line stands in the audit log
        before it is returned.
        """
        read = self.read(tenant, subject)
        if read is None:
            return None
        template, epoch = read
        binding = self.contract.binding
        contract_id = self.contract.contract_id
        binding.require_contract(template.record.contract_id, what="the stored template")
        stored = wire.decode(template.wire)
        rotation = epoch.rotation.of(template.template_id)
        plain = stored.subspace.turned_by(rotation.turned_back)
        exported = Exported(
            subject_id=subject,
            source=template.record.source,
            photos=template.record.photos,
            wire=wire.encode(plain, contract_id=contract_id, dtype="float32"),
            holder_salt=template.holder_salt,
        )
        template_id = template.record.template_id
        self.store.subjects.record_export(tenant, subject, template_id=template_id, by=by)
        return seal_export(exported, key=self.export_key, contract_id=contract_id, tenant=tenant)
