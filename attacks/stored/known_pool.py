"""A pool of real decoys: the attacker who holds it, and the people who are in it.

See docs/method.md §4.2 and §4.3. A decoy lies in the subspace, at distance 0, and no other face
does.
"""

from collections.abc import Iterator

import numpy as np

from attacks.attributes.known_decoys import find_decoys, strip
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from attacks.runner import Guesses, Probes, attack


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge(pool=True))
def known_pool(bed: Testbed) -> Iterator[Guesses]:
    """What is left of the foot point outside the span of the pool's entries in the template."""
    if bed.pool is None:
        return
    entries = bed.pool.entries[0]
    decoys = find_decoys(bed.templates, entries, most=bed.strategy.decoys(bed.m))
    yield Guesses(
        strip(bed.templates, entries, decoys),
        details={
            "decoys_in_a_template": bed.strategy.decoys(bed.m),
            "decoys_found_mean": float(np.count_nonzero(decoys.found, axis=1).mean()),
        },
    )


@attack(breaks=Property.IMPERSONATION, needs=Knowledge(template=False))
def pool_owner(bed: Testbed) -> Iterator[Probes]:
    """A new photo of a real person who is a decoy of the template; nothing needs to be stolen."""
    if bed.pool is None or bed.owners is None:
        return
    decoys = find_decoys(bed.templates, bed.pool.entries[0], most=1)
    yield Probes(np.ascontiguousarray(bed.owners.fresh[decoys.entries[:, 0]]))
