"""What more faces would change: for the thief who has them, and for decoys fitted to them.

``veilface calibrate`` says it where its verdict on privacy is close. Nothing of it is judged.
"""

import numpy as np
from numpy.typing import NDArray

from attacks.privacy import AttackSetup, SimulatedPeople, Theft, extrapolate, privacy_of
from attacks.second_order import without_noise_moment
from templates.contract.canonical import Json
from templates.contract.verdict import Judgement
from templates.decoys import DecoyGenerator
from templates.errors import DecoyError
from templates.space.lifting import Strategy, plain_strategy

DECOY_SHARES = (0.25, 0.5, 1.0)
"""Parts of half of the faces that decoys are fitted to instead; the thief has the other half. No
person has photos in both."""


def more_faces(
    setup: AttackSetup, judgement: Judgement, *, strategy: Strategy, m: int
) -> dict[str, Json]:
    """Give both, for the basis of a verdict on privacy; nothing where its limit is far.

    Nor where the verdict says that the data show nothing.
    """
    if judgement.shortfall is not None or not judgement.close:
        return {}
    return {
        "unlimited": unlimited(setup, strategy=strategy, m=m).to_json(),
        **decoys_of_these_people(setup, strategy=strategy, m=m),
    }


def unlimited(setup: AttackSetup, *, strategy: Strategy, m: int) -> Theft:
    """Estimate what a thief with unlimited faces gets from templates with these very decoys.

    People are drawn with the moments that all faces at hand suggest, lifted with the deployment's
    own source, and attacked by who knows these moments exactly. How far decoys and people differ is
    thus not simulated but estimated: for decoys that are adapted to a sample nobody knows it
    better. Where faces are few, the estimate leans to the decoys, and the thief gets too little.
    """
    noise = setup.source.noise
    moments = setup.attackers[-1][1].moment
    people = SimulatedPeople.draw(
        setup.faces.mean(axis=0, dtype=np.float64),
        without_noise_moment(moments, noise),
        np.einsum("ij,ij->i", setup.enrolled, setup.fresh),
        source=setup.source,
        seed=setup.seed,
    )
    return people.theft(
        plain_strategy(strategy), m, match_cosine=setup.match_cosine, seed=setup.seed
    )


def decoys_of_these_people(setup: AttackSetup, *, strategy: Strategy, m: int) -> dict[str, Json]:
    """Measure what a thief gets where decoys are fitted to people like the enrolled.

    Returns
    -------
    dict
        ``decoys_of_these_people``: rows of ``decoy_faces``, ``thief_faces`` and the templates
        ``found``; ``twice_the_decoy_faces``: the share that twice the most faces would leave, by
        :func:`attacks.privacy.extrapolate`. Empty where the faces are too few for a fit.
    """
    thief, others = _halves(setup)
    found = []
    for share in DECOY_SHARES:
        count = int(share * len(others))
        try:
            source = DecoyGenerator.fit(others[:count], noise=setup.source.noise)
        except DecoyError:
            return {}
        own = AttackSetup.of(
            setup.enrolled,
            setup.fresh,
            thief,
            source,
            match_cosine=setup.match_cosine,
            seed=setup.seed,
        )
        found.append((count, privacy_of(own, strategy=strategy, m=m).strongest.found))
    return {
        "decoys_of_these_people": [
            {"decoy_faces": count, "thief_faces": len(thief), "found": one.to_json()}
            for count, one in found
        ],
        "twice_the_decoy_faces": extrapolate(found, to=2 * found[-1][0]),
    }


def _halves(setup: AttackSetup) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Part the faces by person into a half for the thief and one for decoys, each shuffled.

    At random among people with as many photos; whoever has most is given first, each to the half
    that has fewer yet, so that one person with many photos does not make the halves uneven.
    """
    people, owner, photos = np.unique(setup.owners, return_inverse=True, return_counts=True)
    place = np.random.default_rng([setup.seed, 4]).permutation(len(people))
    is_thief = np.zeros(len(people), dtype=np.bool_)
    left = 0
    for person in np.lexsort((place, -photos)):
        is_thief[person] = left <= 0
        left += photos[person] if is_thief[person] else -photos[person]
    order = np.argsort(place[owner], kind="stable")
    thief = is_thief[owner[order]]
    return setup.faces[order[thief]], setup.faces[order[~thief]]
