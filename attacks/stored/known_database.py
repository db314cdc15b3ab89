"""Known decoys: whoever holds the pool finds a template's decoys and strips them.

See docs/method.md §4.2. A decoy lies in the subspace, at distance 0, and no other face does. What
is left of the foot point outside the decoys' span points to the hidden embedding.
"""

import numpy as np

from attacks.attributes.known_decoys import find_decoys, strip
from attacks.outcomes import AttackOutcome, Knowledge
from attacks.recovery import recovery_outcome
from attacks.system import System, of_pool


def known_database_attack(system: System) -> list[AttackOutcome]:
    """Attack with the pool; empty for a scheme without one."""
    pool = of_pool(system)
    if pool is None:
        return []
    entries = pool.entries[0]
    decoys = find_decoys(system.templates, entries, most=system.decoys)
    return [
        recovery_outcome(
            system,
            strip(system.templates, entries, decoys),
            attack="known-database",
            knowledge=Knowledge.DECOYS,
            assumption="The attacker holds the decoy pool, takes the entries at distance 0 for the "
            "decoys, and removes their span from the foot point; success is a match of what is "
            "left with a fresh photo of the victim.",
            details={
                "decoys_in_a_template": system.decoys,
                "decoys_found_mean": float(np.count_nonzero(decoys.found, axis=1).mean()),
            },
        )
    ]
