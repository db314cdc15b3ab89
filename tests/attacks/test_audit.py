from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from attacks import audit
from attacks.audit import AuditPlan, run_audit
from attacks.further_faces import FurtherFaces
from attacks.outcomes import Scheme
from models.extraction import Extraction
from models.pack import ModelPack
from templates.decoys import DecoyGenerator
from templates.errors import ContractError
from tests.attacks.stored.systems import OWNERS, VICTIMS, M, generator
from tests.verify.synthetic import draw_people

PEOPLE = draw_people(900, photos=(4, 2, 3), noise=0.35, seed=3)
FACES = Extraction(PEOPLE.descriptors, [Path(str(i)) for i in range(len(PEOPLE.names))], [], 0)
PACK = cast(
    "ModelPack", SimpleNamespace(info=SimpleNamespace(embedder_sha256="ab" * 32, preprocessing={}))
)
PLAN = AuditPlan(
    dims=(M,),
    axes=60,
    victims=VICTIMS,
    owners=OWNERS,
    climbed=2,
    attempts=50,
    training_seconds=None,
)


@pytest.mark.long
def test_an_audit_of_two_schemes_is_on_their_axes_and_reports_its_progress() -> None:
    shares: list[float] = []
    result = run_audit(
        PLAN,
        FACES,
        PEOPLE.names,
        pack=PACK,
        decoys=generator(),
        further=[FurtherFaces("more", FACES.descriptors[:7], tuple(PEOPLE.names[:7]))],
        progress=shares.append,
    )
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    ours, compared = Scheme("adversarial", "generator", M, 60), Scheme("adversarial", "pool", M)
    assert {row.scheme for row in result.outcomes} == {ours, compared}
    assert result.comparisons == [str(compared)]
    attacks = {row.attack for row in result.outcomes if row.scheme == ours}
    assert attacks == {
        "foot-point", "hill-climbing", "linkage", "nearest-neighbour", "oracle", "presentation",
        "renewal-replay", "second-moments", "several-templates",
    }  # fmt: skip
    (more,) = result.settings["further_attacker_faces"]
    assert more["faces"] + more["left_out"] == 7


def test_the_attacker_knows_everybody_but_the_victims(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def attacks(*arguments: Any) -> list[Any]:
        given.append(arguments[2])
        return [list]

    monkeypatch.setattr(audit, "_attacks", attacks)
    run_audit(PLAN, FACES, PEOPLE.names, pack=PACK, decoys=generator())
    ours, pool = given
    shown = np.isclose(PEOPLE.descriptors @ ours.victims.fresh.T, 1.0, atol=1e-5).any(axis=1)
    victims = np.isin(PEOPLE.names, np.asarray(PEOPLE.names)[shown])
    # Of a pool's owners two photos each are known where they are no decoys.
    assert len(ours.faces) == len(pool.faces) + 2 * OWNERS
    assert not np.isclose(PEOPLE.descriptors[victims] @ ours.faces.T, 1.0, atol=1e-5).any()


def test_decoys_of_the_judged_people_are_refused() -> None:
    own = DecoyGenerator.fit(PEOPLE.descriptors)
    with pytest.raises(ContractError, match="made of the photos of these people"):
        run_audit(PLAN, FACES, PEOPLE.names, pack=PACK, decoys=own)
