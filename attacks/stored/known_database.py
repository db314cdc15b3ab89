"""Known decoys: whoever holds the pool W finds a template's decoys and strips them.

See docs/method.md §4.2.

A decoy lies in the subspace, at distance 0, and no other face does. What is left of the subspace
when the decoys are known is one direction, and the hidden descriptor is where faces are likely in
it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import POOLED, AttackOutcome, Knowledge
from attacks.recovery import recovery_outcome
from attacks.stored.face_statistics import FaceStatistics
from attacks.stored.recording import RecordedLift, decoy_count, recorded_lift
from attacks.system import System
from templates.contract.canonical import Json
from templates.decoys import DecoyPool
from templates.distances import Metric, pairwise_distances
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from verify.metrics import rate

NOISES = (0.02, 0.05, 0.1, 0.3)
"""Relative perturbations of decoys that are tried against an attacker with the unperturbed W."""
DRAWN = 10_000
"""Decoys that the attacker draws from a generator, in the hope to meet one of a template's."""


@dataclass(frozen=True, eq=False, repr=False)
class DecoyMatches:
    """Entries of W that are taken for decoys.

    Parameters
    ----------
    entries
        Of every template, the numbers of the entries, nearest first.
    distances : (T, |W|) float64
        Of every entry to every template.
    """

    entries: list[NDArray[np.int64]]
    distances: NDArray[np.float64]


def find_decoys(
    database: NDArray[np.float32], templates: SubspaceBatch, *, most: int, exact: bool = True
) -> DecoyMatches:
    """Tell the decoys of templates among the entries of a database, (|W|, n).

    Parameters
    ----------
    most
        Number of decoys that the algorithm puts into one template.
    exact
        Cut at the widest of the gaps between 0 and the ``most`` + 1 smallest distances, which
        needs no constant: decoys lie within the rounding of the wire format, strangers beyond the
        distance of two faces, and where there is no decoy the widest gap is the one above 0.
        Otherwise the ``most`` nearest are taken.
    """
    distances = pairwise_distances(database, templates, metric=Metric.SPHERICAL).T
    nearest = np.argsort(distances, axis=1, kind="stable")[:, : most + 1]
    ordered = np.take_along_axis(distances, nearest, axis=1)
    cuts = np.full(len(templates), min(most, len(database)))
    if exact and most:
        gaps = np.diff(ordered, axis=1, prepend=0.0)
        cuts = np.argmax(gaps, axis=1)
    entries = [row[:cut] for row, cut in zip(nearest, cuts, strict=True)]
    return DecoyMatches(entries, np.asarray(distances, dtype=np.float64))


def remainder(
    template_foot: NDArray[np.float64], decoys: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Remove the span of decoys (k, n) from a foot point (docs/method.md §4.2); not normalised."""
    if not len(decoys):
        return template_foot
    rows = np.linalg.svd(decoys, full_matrices=False)[2]
    return np.asarray(template_foot - (rows @ template_foot) @ rows)


def likeliest(
    foot: NDArray[np.float64],
    basis: NDArray[np.float64],
    decoys: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Point of a subspace, (n,), that a descriptor is likeliest to be, given decoys in it.

    Parameters
    ----------
    foot : (n,)
    basis : (m, n)
        Orthonormal. Both in coordinates in which descriptors follow N(0, I).
    decoys : (k, n)
        Points of the subspace, at least one.

    Notes
    -----
    Let c be the point nearest 0 of the flat through the decoys, and L the directions of the
    subspace that are orthogonal to the flat, m - k + 1 of them. The descriptor is c + x + y with x
    in L and y along the flat. Among all ways to draw a descriptor, the decoys being given, those
    that lead to this subspace have density ∝ ‖x‖^(n - m) exp(-‖c + x‖²/2 - ‖y‖²/2): the power
    counts the subspaces that a descriptor far from the flat could have led to. Its mode is y = 0
    and x along the projection of -c on L, at the distance ρ with ρ² - bρ = n - m, where b is the
    length of that projection.
    """
    centre = decoys.mean(axis=0)
    spread = np.linalg.svd(decoys - centre, full_matrices=False)
    flat = spread[2][: len(decoys) - 1]
    centre = centre - (flat @ centre) @ flat
    across = basis - (basis @ flat.T) @ flat
    free = len(basis) - len(flat)
    if free < 1:
        return np.asarray(centre)
    rest = np.linalg.svd(across, full_matrices=False)[2][:free]
    toward = -(rest @ centre)
    length = float(np.linalg.norm(toward))
    if length == 0:
        return np.asarray(centre)
    distance = (length + np.sqrt(length**2 + 4 * (len(foot) - len(basis)))) / 2
    return np.asarray(centre + (distance / length) * (toward @ rest))


def strip_decoys(
    templates: SubspaceBatch,
    database: NDArray[np.float32],
    entries: list[NDArray[np.int64]],
    faces: FaceStatistics,
) -> NDArray[np.float64]:
    """Guess the descriptors of templates whose decoys were found, shape (T, n).

    Entries are first moved to the nearest point of the template: where decoys were perturbed, that
    is nearly where they were moved to. Where none was found there is no guess, and the row is 0.
    """
    feet, bases = faces.whitened_subspaces(templates)
    guesses = np.zeros((len(templates), templates.n))
    for row, chosen in enumerate(entries):
        if len(chosen):
            inside = faces.whitened(templates[row].project(database[chosen]))
            guesses[row] = faces.coloured(likeliest(feet[row], bases[row], inside))
    return guesses


def known_database_attack(system: System) -> list[AttackOutcome]:
    """Attack with the pool, exactly known and perturbed.

    With a generator: with draws of it, which everybody can make, and with the templates' own
    decoys, which nobody has. Neither is judged. Empty for a scheme without decoys.
    """
    most = decoy_count(system.scheme)
    if not most or system.source is None:
        return []
    if system.scheme.decoys != POOLED or not isinstance(system.source, DecoyPool):
        with Keystream.seeded("audit", system.seed, "decoys that the attacker draws") as stream:
            drawn = system.lifter.source.draw(1, DRAWN, stream=stream)[0]
        lift = recorded_lift(system, system.victims.enrolled, "decoys of a generator")
        return [attack_with_draws(system, lift, drawn), _told(system, lift)]
    database = system.source.entries[0]
    faces = FaceStatistics.of(np.concatenate([system.attacker, database]))
    outcomes = []
    for noise in (0.0, *NOISES):
        lift = recorded_lift(
            system, system.victims.enrolled, f"decoys moved by {noise}", noise=noise
        )
        matches = find_decoys(database, lift.templates, most=most, exact=not noise)
        guesses = strip_decoys(lift.templates, database, matches.entries, faces)
        outcomes.append(
            recovery_outcome(
                system,
                guesses,
                attack="known-database",
                variant=f"decoys perturbed by {noise:g}" if noise else "",
                knowledge=Knowledge.DECOYS,
                assumption=(
                    "The attacker holds the decoy pool, takes the entries at distance 0 for the "
                    "decoys, removes them and takes the likeliest face that is left; success is a "
                    "match with a fresh photo of the victim."
                    if not noise
                    else "The decoys were perturbed before lifting, which Veilface does not do; "
                    "the attacker holds the unperturbed pool and takes the nearest entries."
                ),
                unjudged="Veilface does not perturb decoys" if noise else None,
                details={
                    **_search_details(matches, lift, database),
                    **_remainder_details(system, lift, database, matches),
                },
            )
        )
    return outcomes


def attack_with_draws(
    system: System, lift: RecordedLift, drawn: NDArray[np.float32]
) -> AttackOutcome:
    """Look for the decoys of the victims' templates among draws of their generator.

    Parameters
    ----------
    drawn : (K, n) float32
        The draws.
    """
    matches = find_decoys(drawn, lift.templates, most=decoy_count(system.scheme))
    faces = FaceStatistics.of(system.attacker)
    return recovery_outcome(
        system,
        strip_decoys(lift.templates, drawn, matches.entries, faces),
        attack="known-database",
        variant="draws of the generator",
        knowledge=Knowledge.ALGORITHM,
        assumption=(
            f"The attacker has the decoy generator, as all clients do, draws {len(drawn):,} "
            "decoys, and takes those at distance 0 for the template's, and makes no guess where "
            "there is none; success is a match with a fresh photo of the victim."
        ),
        unjudged="no draw comes twice, so it fails by construction",
        details={"drawn": len(drawn), **_search_details(matches, lift, drawn)},
    )


def _told(system: System, lift: RecordedLift) -> AttackOutcome:
    """Give the attacker the decoys of every template: what a known pool would come to."""
    count, k, n = lift.decoys.shape
    positions = [np.arange(row * k, (row + 1) * k) for row in range(count)]
    guesses = strip_decoys(
        lift.templates, lift.decoys.reshape(-1, n), positions, FaceStatistics.of(system.attacker)
    )
    return recovery_outcome(
        system,
        guesses,
        attack="known-database",
        variant="the template's own decoys",
        knowledge=Knowledge.DECOYS,
        assumption=(
            "The attacker is told the decoys of every template, removes them and takes the "
            "likeliest face that is left; success is a match with a fresh photo of the victim, "
            "which bounds what any knowledge of decoys gives."
        ),
        unjudged="generated decoys are kept nowhere, so nobody is such an attacker",
        details={"decoys": k},
    )


def _search_details(
    matches: DecoyMatches, lift: RecordedLift, database: NDArray[np.float32]
) -> dict[str, Json]:
    """How many decoys were found, and how far decoys and strangers lie."""
    count, k, _ = lift.decoys.shape
    hits, false, whole = 0, 0, 0
    inside = np.zeros(matches.distances.shape, dtype=np.bool_)
    for row, chosen in enumerate(matches.entries):
        inside[row] = (database @ lift.decoys[row].T).max(axis=1) > 1 - 1e-6
        hit = int(np.count_nonzero(inside[row, chosen]))
        hits += hit
        false += len(chosen) - hit
        whole += int(hit == k == len(chosen))
    strangers = np.where(inside, np.inf, matches.distances)
    return {
        "decoys_found": rate(hits, count * k).to_json(),
        "templates_with_all_decoys_found": rate(whole, count).to_json(),
        "false_finds": false,
        "largest_distance_of_a_decoy": float(matches.distances[inside].max())
        if inside.any()
        else None,
        "smallest_distance_of_another_entry": float(strangers.min()),
    }


def _remainder_details(
    system: System, lift: RecordedLift, database: NDArray[np.float32], matches: DecoyMatches
) -> dict[str, Json]:
    """Return what the plain removal of docs/method.md §4.2 reaches, for comparison."""
    cosines = []
    for row, chosen in enumerate(matches.entries):
        template = lift.templates[row]
        rest = remainder(template.foot.astype(np.float64), template.project(database[chosen]))
        cosines.append(
            rest @ system.victims.enrolled[row] / max(float(np.linalg.norm(rest)), 1e-12)
        )
    return {"cosine_of_plain_remainder_mean": float(np.mean(cosines))}
