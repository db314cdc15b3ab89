"""Templates as an earlier version stored them: one rotation for all that a tenant has."""

from collections.abc import Mapping
from dataclasses import replace

from api.process.runtime import Runtime
from enroll import Enroller
from templates.contract.document import Binding
from templates.keys.rotation import HAAR_VERSION, TenantRotation
from templates.store import Source
from templates.store.audit_log import By
from tests.api.deployment import photo


def earlier(binding: Binding) -> Binding:
    return replace(binding, rotation_version=HAAR_VERSION)


def enroll_earlier(runtime: Runtime, people: Mapping[str, int]) -> None:
    """Enroll subjects of the default tenant, each on one photo of a person."""
    assert runtime.pack is not None
    assert runtime.source is not None
    contract = replace(
        runtime.contract,
        binding=earlier(runtime.contract.binding),
        calibrations=tuple(
            replace(calibration, calibration_id="") for calibration in runtime.contract.calibrations
        ),
    )
    key = runtime.store.tenants.rotation_key("default").key
    rotation = TenantRotation(key, contract.binding.n)
    enroller = Enroller(contract, runtime.source, rotation=rotation, lift_secret=bytes(32))
    for name, person in people.items():
        enrollment = enroller.from_photos(runtime.pack, [photo(person)])
        assert enrollment.contract_id == contract.contract_id
        runtime.put(
            "default",
            name,
            1,
            enrollment,
            source=Source.PHOTOS,
            photos=1,
            by=By("an earlier version"),
        )
