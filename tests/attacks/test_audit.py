from pathlib import Path

import numpy as np
import pytest

from attacks.audit import run_audit
from attacks.outcomes import Scheme
from attacks.stored import attacks_on_templates
from models.extraction import Extraction
from templates.decoys import DecoyGenerator
from templates.errors import ContractError
from tests.attacks.beds import OWNERS, PACK, PEOPLE, PLAN, M, bed_of, generator, population

FACES = Extraction(PEOPLE.descriptors, [Path(str(i)) for i in range(len(PEOPLE.names))], [], 0)


@pytest.mark.long
def test_an_audit_of_two_schemes_is_on_their_axes_and_reports_its_progress() -> None:
    shares: list[float] = []
    result = run_audit(
        PLAN,
        FACES,
        PEOPLE.names,
        pack=PACK,
        decoys=generator(),
        progress=shares.append,
    )
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    ours, compared = Scheme("adversarial", "generator", M, 60), Scheme("adversarial", "pool", M)
    assert {row.scheme for row in result.outcomes} == {ours, compared}
    assert result.comparisons == [str(compared)]
    attacks = {row.attack for row in result.outcomes if row.scheme == ours}
    only_of_pools = {"known-pool", "pool-owner"}
    assert attacks == {one.name for one in attacks_on_templates()} - only_of_pools
    assert only_of_pools <= {row.attack for row in result.outcomes if row.scheme == compared}


def test_the_attacker_has_a_photo_of_everybody_but_the_victims() -> None:
    ours, pool = bed_of(), bed_of("pool")
    # Of a pool's owners two photos each are known where they are no decoys.
    assert len(ours.gallery) == len(pool.gallery) + OWNERS
    shown = (PEOPLE.descriptors @ population().victims.fresh.T).argmax(axis=0)
    victims = np.isin(PEOPLE.names, [PEOPLE.names[row] for row in shown])
    near = (ours.source.project(PEOPLE.descriptors) @ ours.gallery.T).max(axis=1) > 1 - 1e-5
    assert not near[victims].any()
    assert ours.attackers[1].faces == len(population().others) + 2 * OWNERS


def test_decoys_of_the_judged_people_are_refused() -> None:
    own = DecoyGenerator.fit(PEOPLE.descriptors)
    with pytest.raises(ContractError, match="made of the photos of these people"):
        run_audit(PLAN, FACES, PEOPLE.names, pack=PACK, decoys=own)
