"""What attackers with 1,000, 5,000, all and unlimited faces get from one stolen template.

People of LFW are enrolled on up to three photos; decoys are fitted to other people of LFW, or to
FairFace; every other photo of LFW is the attacker's. The rows of docs/privacy-templates.md "The
strongest attacker" are what this prints. With ``--like`` decoys are fitted to FairFace, UTKFace and
All-Age-Faces, adapted to so many photos of further people of LFW, and have noise, as ``veilface
decoys build --like`` makes them.

Example
-------
::

    python -m benchmarks.strongest_theft --data ../shared/data
    python -m benchmarks.strongest_theft --like 300 600 --victims 400
"""

import argparse
from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from attacks.more_faces import unlimited
from attacks.privacy import AttackSetup, SimulatedPeople, Theft, privacy_of
from attacks.second_order import without_noise_moment
from models.extraction import Extractor
from models.pack import ModelPack
from templates.decoys import NOISE_ENERGY, DecoyGenerator
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, plain_strategy
from verify import labelled_folder
from verify.evaluation.embeddings_file import read_embeddings

MATCH_COSINE = 0.247
"""Raw FMR 1e-3 on the cross-identity pairs of LFW, with w600k_mbf."""
OF_LFW, OF_FAIRFACE = 2_672, 6_500
VICTIMS = 300
GRID = (
    *((Strategy.ADVERSARIAL, m) for m in (64, 96, 128)),
    (Strategy.HYBRID, 64),
)

Array = NDArray[np.float32]
Named = tuple[Array, NDArray[np.str_]]


def stored(file: Path) -> Named:
    """Read descriptors of w600k_mbf, and the folder that each photo is from."""
    with np.load(file) as arrays:
        names = [PurePath(path).parent.name for path in arrays["paths"].tolist()]
        rows = normalised(arrays["emb_mbf"].astype(np.float64))
        return rows.astype(np.float32), np.asarray(names)


def crops(data: Path, descriptors: Path | None) -> Named:
    """Embed the aligned crops of LFW, or read what was embedded before."""
    if descriptors is not None:
        rows = read_embeddings(descriptors)
        return rows.descriptors, np.asarray([PurePath(path).parent.name for path in rows.paths])
    pack = ModelPack.load(data / "packs" / "w600k_mbf")
    folder = labelled_folder(data / "lfw" / "aligned112")
    faces = Extractor(pack, aligned=True).extract(folder.paths)
    return faces.descriptors, np.asarray([path.parent.name for path in faces.paths])


def shown(theft: Theft) -> str:
    """Share in per cent with its interval, and how many photos of other people matched."""
    found = theft.found
    return (
        f"{100 * found.value:.1f} ({100 * found.ci_low:.1f}-{100 * found.ci_high:.1f}; "
        f"{theft.control.errors}/{theft.control.trials})"
    )


def adapted(
    data: Path,
    sample: Array,
    names: Sequence[str],
    *,
    victims: tuple[Array, Array],
    faces: Array,
    dims: Sequence[int],
    seed: int,
) -> None:
    """Attack templates with decoys adapted to a sample; the last cell is of unlimited faces."""
    base = [
        stored(data / "embeddings" / f"{kind}.npz")[0]
        for kind in ("fairface_more", "utkface", "allagefaces")
    ]
    noise = NOISE_ENERGY / sample.shape[1]
    source = DecoyGenerator.adapt(np.concatenate(base), sample, names, noise=noise)
    enrolled, fresh = victims
    setup = AttackSetup.of(
        enrolled,
        fresh,
        faces,
        source,
        match_cosine=MATCH_COSINE,
        most=len(enrolled),
        seed=seed,
    )
    for m in dims:
        privacy = privacy_of(setup, strategy=Strategy.ADVERSARIAL, m=m)
        found = [*privacy.thefts, unlimited(setup, strategy=Strategy.ADVERSARIAL, m=m)]
        cells = " | ".join(f"{theft.faces}: {shown(theft)}" for theft in found)
        print(f"| adapted to {len(sample)} | {m} | {cells} |", flush=True)


def main() -> None:
    """Split, fit, lift, attack, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--descriptors", type=Path, help=".npz of the crops: paths, descriptors")
    parser.add_argument("--victims", type=int, default=VICTIMS)
    parser.add_argument("--like", type=int, nargs="+", help="photos to adapt decoys to")
    parser.add_argument("--dims", type=int, nargs="+", default=[160, 192], help="with --like")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    rows, names = crops(args.data, args.descriptors)
    rest, rest_names = stored(args.data / "embeddings" / "lfw_rest.npz")
    people, person, counts = np.unique(names, return_inverse=True, return_counts=True)
    attacked = rng.permutation(np.flatnonzero(counts > 1))[: args.victims]
    albums = [rng.permutation(np.flatnonzero(person == one)) for one in attacked]
    enrolled = normalised(np.stack([rows[album[1:4]].mean(axis=0) for album in albums]))
    fresh = rows[[album[0] for album in albums]]
    others = rng.permutation(np.setdiff1d(np.arange(len(people)), attacked))
    by_person = np.concatenate([np.flatnonzero(person == one) for one in others])
    stranger = ~np.isin(rest_names, people[attacked])
    attacker = np.concatenate([rows[by_person[OF_LFW:]], rest[stranger]])
    if args.like:
        single = np.flatnonzero(np.isin(person, others) & (counts[person] == 1))
        sample = rng.permutation(single)[: max(args.like)]
        kept = np.setdiff1d(by_person, sample)
        rest = rest[stranger & ~np.isin(rest_names, names[sample])]
        for size in args.like:
            adapted(
                args.data,
                rows[sample[:size]],
                names[sample[:size]].tolist(),
                victims=(enrolled.astype(np.float32), fresh),
                faces=np.concatenate([rows[kept], rest]),
                dims=args.dims,
                seed=args.seed,
            )
        return
    fairface = stored(args.data / "embeddings" / "fairface_more.npz")[0][:OF_FAIRFACE]
    print(f"{len(enrolled)} victims; the attacker has {len(attacker)} faces of LFW")
    for kind, fitted in (("LFW", rows[by_person[:OF_LFW]]), ("FairFace", fairface)):
        setup = AttackSetup.of(
            enrolled,
            fresh,
            attacker,
            DecoyGenerator.fit(fitted),
            match_cosine=MATCH_COSINE,
            most=args.victims,
            seed=args.seed,
        )
        without_limit = SimulatedPeople.draw(
            setup.faces.mean(axis=0, dtype=np.float64),
            without_noise_moment(setup.attackers[-1][1].moment, setup.source.noise),
            np.einsum("ij,ij->i", setup.enrolled, setup.fresh),
            fitted_to=len(fitted),
            noise=setup.source.noise,
            seed=args.seed,
        )
        for strategy, m in GRID:
            privacy = privacy_of(setup, strategy=strategy, m=m)
            simulated = without_limit.theft(
                plain_strategy(strategy), m, match_cosine=MATCH_COSINE, seed=args.seed
            )
            cells = " | ".join(shown(theft) for theft in (*privacy.thefts, simulated))
            extrapolated = 100 * (privacy.extrapolated or 0.0)
            print(
                f"| {strategy} | {kind}, {len(fitted):,} | {m} | {cells} | {extrapolated:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
