"""What decisions alone, and a trained comparer of two templates, tell about people of LFW.

Decoys are FairFace's, UTKFace's and All-Age-Faces', adapted to 600 photos of LFW, with the noise
that `decoys build` writes. Victims, the people of that sample, those who calibrate and the
attacker's are different people; the attacker also has LFW's photos that are not among the crops,
without the victims' and the sample's. Templates of m = 2 and 4 are there to show that the attacks
work.

Example
-------
::

    python -m benchmarks.asked_and_linked --data ../shared/data
"""

import argparse
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray

from attacks.comparer import link_by_comparer
from attacks.decision_walk import reconstruct_from_decisions
from attacks.outcomes import GENERATED, AttackOutcome, Scheme
from attacks.population import Population, Subjects, draw_population
from attacks.system import System, enroll_victims
from benchmarks.strongest_theft import crops, stored
from models.pack import ModelPack
from templates.contract.binding import embedding_id
from templates.decoys import NOISE_ENERGY, DecoyGenerator

SAMPLE_PEOPLE = 300


def shown(outcome: AttackOutcome) -> str:
    """One line: the measure with its interval, and what the details hold beside it."""
    measured = outcome.measured
    beside = {
        name: outcome.details[name]
        for name in (
            "accepted",
            "found_an_accepted_probe",
            "median_first_accepted",
            "accepted_probes_sent_again_mean",
            "cosine_to_truth_mean",
            "auc",
            "auc_of_nearest_points",
            "eer",
            "linked_at_fmr_1e-3",
            "null_95_percent",
        )
        if outcome.details.get(name) is not None
    }
    for name, value in beside.items():
        if isinstance(value, dict) and "errors" in value:
            beside[name] = f"{value['errors']}/{value['trials']}"
    return (
        f"{outcome.scheme} | {outcome.attack}, {outcome.variant} | {measured.value:.3f} "
        f"({measured.ci_low:.3f}-{measured.ci_high:.3f}) of {measured.trials} | {beside}"
    )


def attacks_on(system: System, mates: Subjects, args: argparse.Namespace) -> None:
    """Make the attacks that were asked for; print what they find, and what they take."""
    for name in args.attacks:
        started = process_time()
        outcomes = (
            reconstruct_from_decisions(system, counts=args.questions)
            if name == "walk"
            else link_by_comparer(system, mates, most_people=args.people)
        )
        for outcome in outcomes:
            print(shown(outcome), flush=True)
        print(f"{process_time() - started:.0f} s of the processor", flush=True)


def adapted_deployment(
    data: Path, descriptors: Path | None, *, victims: int, seed: int
) -> tuple[Population, DecoyGenerator, NDArray[np.float32]]:
    """People of LFW, decoys adapted to 600 photos of some of them, and the attacker's faces."""
    rows, names = crops(data, descriptors)
    population = draw_population(
        rows, names.tolist(), victims=victims, owners=SAMPLE_PEOPLE, seed=seed
    )
    owners, attacked = population.owners, population.victims
    faces = data / "embeddings"
    rest, rest_names = stored(faces / "lfw_rest.npz")
    kept = ~np.isin(rest_names, names[np.concatenate([attacked.shown, owners.shown])])
    info = ModelPack.load(data / "packs" / "w600k_mbf").info
    source = DecoyGenerator.adapt(
        np.concatenate(
            [
                stored(faces / f"{kind}.npz")[0]
                for kind in ("fairface_more", "utkface", "allagefaces")
            ]
        ),
        np.concatenate([owners.enrolled, owners.fresh]),
        [str(number) for _ in range(2) for number in range(SAMPLE_PEOPLE)],
        made_with=embedding_id(
            embedder_sha256=info.embedder_sha256, preprocessing=info.preprocessing
        ),
        noise=NOISE_ENERGY / info.n,
    )
    return population, source, np.concatenate([rest[kept], population.attacker])


def enrolled_deployment(
    population: Population,
    source: DecoyGenerator,
    attacker: NDArray[np.float32],
    *,
    data: Path,
    dim: int,
    level: str,
    seed: int,
) -> System:
    """Enroll the victims of :func:`adapted_deployment`; the service decides at this level."""
    info = ModelPack.load(data / "packs" / "w600k_mbf").info
    system = enroll_victims(
        population,
        Scheme("adversarial", GENERATED, dim),
        source,
        embedder_sha256=info.embedder_sha256,
        preprocessing=info.preprocessing,
        pool_of_owners=False,
        lifted_probes=False,
        seed=seed,
    )
    contract = replace(system.contract, default_level=level)
    return replace(system, attacker=attacker, contract=contract)


def main() -> None:
    """Embed, split, lift, attack, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--descriptors", type=Path, help=".npz of the crops: paths, descriptors")
    parser.add_argument("--victims", type=int, default=100)
    parser.add_argument("--questions", type=int, nargs="+", default=[1_000, 10_000])
    parser.add_argument("--people", type=int, default=100, help="linked, and trained on")
    parser.add_argument("--attacks", nargs="+", default=["walk", "link"])
    parser.add_argument("--dims", type=int, nargs="+", default=[2, 4, 64, 160])
    parser.add_argument("--level", default="fmr-1e-3", help="that the service decides at")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    population, source, attacker = adapted_deployment(
        args.data, args.descriptors, victims=args.victims, seed=args.seed
    )
    print(
        f"{len(population.victims)} victims; {len(attacker)} faces, {len(population.mates)} mates"
    )
    for dim in args.dims:
        system = enrolled_deployment(
            population,
            source,
            attacker,
            data=args.data,
            dim=dim,
            level=args.level,
            seed=args.seed,
        )
        attacks_on(system, population.mates, args)


if __name__ == "__main__":
    main()
