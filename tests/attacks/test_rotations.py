"""Rotations: each template has its own, and nothing but a length survives one."""

import numpy as np

from attacks.rotations import rotations_of, turned
from attacks.stored.foot_point import foot_points
from enroll import Enroller, Holder
from templates.contract import wire
from templates.keys.rotation import Rotation, TenantRotation
from templates.space.embedding import normalised
from tests.attacks.beds import bed_of, population


def test_of_who_keeps_a_key_no_length_tells_what_two_tenants_have() -> None:
    """By the service's enroller: the very same photos at two tenants, and twice at one."""
    bed = bed_of()
    keys = [bytes([i] * 32) for i in range(40)]
    embeddings = population().victims.enrolled

    def lengths(tenant: str, *, kept: bool) -> np.ndarray:
        rotation = TenantRotation(tenant.encode().ljust(32), bed.source.k)
        enroller = Enroller(bed.service, bed.source, rotation=rotation, lift_secret=bytes(32))
        stored = [
            enroller.from_embeddings(
                row[None], holder=Holder(key, tenant, f"person {number}") if kept else None
            )
            for number, (key, row) in enumerate(zip(keys, embeddings, strict=True))
        ]
        return np.array([wire.decode(one.wire).subspace.foot_norm for one in stored])

    def linked(first: np.ndarray, second: np.ndarray) -> int:
        nearest = np.abs(first[:, None] - second).argmin(axis=1)
        return int(np.count_nonzero(nearest == np.arange(len(first))))

    assert linked(lengths("bank", kept=True), lengths("shop", kept=True)) <= 8  # by chance 1
    assert linked(lengths("bank", kept=True), lengths("bank", kept=True)) >= 30
    # Where no key is kept the master key opens both, whatever their lengths.
    assert linked(lengths("bank", kept=False), lengths("shop", kept=False)) >= 30


def test_templates_of_ones_own_tell_no_other_rotation() -> None:
    """They tell the rotation that all templates of a tenant would have in common."""
    bed = bed_of()
    accounts, victims = bed.lift(bed.gallery[:90], "accounts"), bed.templates
    own = rotations_of(bed, "first", "account", len(accounts))
    others = rotations_of(bed, "first", "victim", len(victims))

    def found(of_accounts: list[Rotation], of_victims: list[Rotation]) -> float:
        stolen = turned(accounts, of_accounts)
        left, _, right = np.linalg.svd(stolen.feet.T.astype(float) @ accounts.feet)
        opened = turned(victims, of_victims).feet @ (left @ right)
        return float(np.einsum("ij,ij->i", normalised(opened), foot_points(victims)).mean())

    assert found(own[:1] * len(accounts), own[:1] * len(victims)) > 0.99
    assert abs(found(own, others)) < 0.1
