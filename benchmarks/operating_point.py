"""What each way of lifting costs in accuracy, and what the strongest theft of one template gives.

People of LFW are enrolled, half of them calibrate. Decoys come from a generator fitted to FairFace
(another kind of photos), from one fitted to other people of LFW, or from a pool of other people of
LFW that stays secret. The rows of docs/privacy-templates.md "The operating point" are what this
prints.

Example
-------
::

    python -m benchmarks.operating_point --data ../shared/data
"""

import argparse
from pathlib import Path

from attacks.likelihood import find_least_decoy_like, likeliest_guesses
from attacks.outcomes import GENERATED, POOLED, AttackOutcome, Scheme
from attacks.population import Population, draw_population, without_decoy_people
from attacks.stored.foot_point import foot_point_attack
from attacks.stored.nearest_neighbour import nearest_neighbour_attack
from attacks.system import enroll_victims, owners_pool
from models.cache import EmbeddingCache
from models.extraction import Extractor
from models.pack import ModelPack
from templates.decoys import DecoyGenerator, DecoySource
from templates.keys.sealing import KeyringSealer, MasterKeyring
from verify import labelled_folder

VICTIMS, OWNERS = 400, 600
GRID = (
    ("random", None, (16,)),
    ("hybrid", GENERATED, (32, 64)),
    ("adversarial", GENERATED, (16, 32, 48, 64, 96)),
    ("adversarial", POOLED, (16, 32, 64)),
)


def rows_of(
    population: Population, kind: str, source: DecoySource, pack: ModelPack, seed: int
) -> list[str]:
    """Lines of the table for one source of decoys."""
    lines = []
    pooled = kind.startswith("pool")
    for strategy, decoys, dims in GRID:
        if (decoys == POOLED) != pooled or (decoys is None and kind != "FairFace"):
            continue
        for m in dims:
            system = enroll_victims(
                population,
                Scheme(strategy, decoys, m),
                None if decoys is None else source,
                embedder_sha256=pack.info.embedder_sha256,
                preprocessing=pack.info.preprocessing,
                pool_of_owners=pooled,
                lifted_probes=False,
                seed=seed,
            )
            level = system.level
            outcomes = [*foot_point_attack(system), *nearest_neighbour_attack(system)]
            outcomes += find_least_decoy_like(system, likeliest_guesses(system), kind="LFW")
            judged = [outcome for outcome in outcomes if outcome.judged]
            best = max(judged, key=lambda outcome: outcome.measured.value)
            foot = next(outcome for outcome in judged if outcome.attack == "foot-point")
            named = "none" if decoys is None else kind
            lines.append(
                f"| {strategy} | {named} | {m} | {100 * level.fnmr.value:.2f} "
                f"({level.fnmr.errors}/{level.fnmr.trials}) | {shown(foot)} | {shown(best)}, "
                f"{best.attack} |"
            )
            print(lines[-1], flush=True)
    return lines


def shown(outcome: AttackOutcome) -> str:
    """Success in per cent with its interval."""
    measured = outcome.measured
    return f"{100 * measured.value:.1f} ({100 * measured.ci_low:.1f}-{100 * measured.ci_high:.1f})"


def main() -> None:
    """Embed, split, lift, attack, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--cache", type=Path, help="folder of sealed embeddings: lfw, fair")
    parser.add_argument("--master-key", type=Path, help="the key file that the caches belong to")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    caches: dict[str, EmbeddingCache | None] = {"lfw": None, "fair": None}
    if args.cache and args.master_key:
        sealer = KeyringSealer(MasterKeyring.load(args.master_key))
        caches = {
            name: EmbeddingCache.open_file(args.cache / f"{name}.cache", sealer) for name in caches
        }
    pack = ModelPack.load(args.pack or args.data / "packs" / "w600k_mbf")
    crops = labelled_folder(args.data / "lfw" / "aligned112")
    lfw = Extractor(pack, aligned=True, cache=caches["lfw"]).extract(crops.paths).descriptors
    photos = sorted((args.data / "fairface").glob("*/*.jpg"))
    fairface = Extractor(pack, cache=caches["fair"]).extract(photos).descriptors
    population = draw_population(
        lfw, crops.identities, victims=VICTIMS, owners=OWNERS, seed=args.seed
    )
    own, calibrating = without_decoy_people(population, seed=args.seed)
    print("| strategy | decoys | m | FNMR % at FMR 1e-3 | foot point % | strongest theft % |")
    print("|---|---|---|---|---|---|")
    for kind, source in (
        ("FairFace", DecoyGenerator.fit(fairface)),
        (f"{len(own):,} photos of LFW", DecoyGenerator.fit(own)),
        (f"pool of {OWNERS} of LFW", owners_pool(population, None)),
    ):
        rows_of(calibrating, kind, source, pack, args.seed)


if __name__ == "__main__":
    main()
