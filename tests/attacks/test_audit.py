from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from attacks import audit
from attacks.audit import AuditPlan, run_audit
from attacks.further_faces import FurtherFaces
from attacks.system import System
from models.extraction import Extraction
from models.pack import ModelPack
from templates.distances.kernels.arguments import Array32
from tests.attacks.stored.systems import OWNERS, VICTIMS, M, generator, system_of
from tests.verify.synthetic import draw_people


def test_an_audit_of_two_schemes_reports_its_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """The people are real to the audit; its systems and attacks are small ones."""
    people = draw_people(900, photos=(4, 2, 3), noise=0.35, seed=3)
    faces = Extraction(people.descriptors, [Path(str(i)) for i in range(len(people.names))], [], 0)
    pack = SimpleNamespace(info=SimpleNamespace(embedder_sha256="ab" * 32, preprocessing={}))
    schemes: list[Any] = []

    def enroll(_population: object, scheme: Any, *_: object, **options: Any) -> Any:
        schemes.append((str(scheme), options["pool_of_owners"]))
        return system_of("generator")

    monkeypatch.setattr(audit, "enroll_victims", enroll)
    given: list[int] = []

    def attacks(*arguments: Any) -> list[Any]:
        given.append(len(arguments[2].attacker) - len(arguments[1].attacker))
        return [list, list, list]

    monkeypatch.setattr(audit, "_attacks", attacks)
    shares: list[float] = []
    result = run_audit(
        AuditPlan(dims=(M,), victims=VICTIMS, owners=OWNERS),
        faces,
        people.names,
        pack=cast("ModelPack", pack),
        decoys=generator(),
        aligned=True,
        start_service=None,
        further=[FurtherFaces("more", faces.descriptors[:7], people.names[:7])],
        progress=shares.append,
    )
    assert shares == sorted(shares)
    assert (len(shares), shares[0], shares[-1]) == (7, 0, 1)
    assert [name for name, compared in schemes if compared] == result.comparisons
    assert len(schemes) == len(result.schemes) == 2
    assert result.settings["victims"] == VICTIMS
    assert not result.settings["service"]
    (more,) = result.settings["further_attacker_faces"]
    assert more["faces"] + more["left_out"] == 7
    assert given == [OWNERS + more["faces"], more["faces"]]


def test_attacks_that_use_faces_have_the_further_ones(system: System, strangers: Array32) -> None:
    informed = replace(system, attacker=np.concatenate([system.attacker, strangers]))
    unused: Any = None
    plan = AuditPlan(training_seconds=0.1)
    attacks = audit._attacks(plan, system, informed, *[unused] * 4, "a test")
    outcomes = {attack.__name__: attack for attack in attacks}
    known = len(system.attacker) + len(strangers)
    assert outcomes["likelihood"]()[1].details["faces"] == known
    assert outcomes["learned"]()[0].details["faces"] == known
