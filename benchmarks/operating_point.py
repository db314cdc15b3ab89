"""What privacy costs: axes, dimension, theft and false rejections by the number of spared photos.

People of LFW are parted by chance into a sample that decoys are adapted to, people to choose axes
and dimension by, and people to judge. Decoys are fitted to FairFace, UTKFace and All-Age-Faces. The
attackers have all other photos of LFW. The last rows have nobody's photos: decoys, thresholds and
privacy of FairFace alone, and the accuracy of LFW beside. Theft is in % with its one-sided bound;
false non-matches are in % at FMR 1e-3 / 1e-4, of photos shown to photos enrolled.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from attacks.bed import Pairs
from attacks.operating_point import OperatingPoint, choose_and_judge
from attacks.setup import AttackSetup
from models.extraction import Extractor
from models.pack import ModelPack
from templates.contract.document import Binding, Contract
from templates.decoys import DecoyGenerator
from templates.distances.blas import single_threaded
from templates.errors import Uncalibrated
from templates.keys.rotation import ROTATION_VERSION
from templates.space.embedding import normalised
from templates.space.lifting import Strategy
from verify import CalibrationOptions, calibrate, labelled_folder

SETS = {"w600k_mbf": "emb_mbf", "yunet_mobilefacenet128": "emb_y1"}
FACES = ("fairface_more", "utkface", "allagefaces")
LEVELS = ("fmr-1e-3", "fmr-1e-4")
PHOTOS = 3
PROBE_M = 4

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False, repr=False)
class People:
    """Embeddings (N, n), and whose each is (N,)."""

    rows: Array
    person: NDArray[np.int64]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> "People":
        return People(self.rows[chosen], self.person[chosen])

    def of(self, people: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which rows are of some people."""
        return np.isin(self.person, people)


def stored(data: Path, name: str, pack: str) -> tuple[Array, list[str]]:
    """Read embeddings that are kept beside the photos, and the folder of each."""
    with np.load(data / "embeddings" / f"{name}.npz") as arrays:
        rows = normalised(arrays[SETS[pack]].astype(np.float64)).astype(np.float32)
        return rows, [PurePath(path).parent.name for path in arrays["paths"].tolist()]


def lfw(data: Path, pack: str, cached: Path | None) -> People:
    """Embed the aligned crops of LFW, and add the photos that are kept as embeddings."""
    if cached is not None:
        with np.load(cached) as arrays:
            rows = arrays["emb"]
            names = [PurePath(path).parent.name for path in arrays["paths"].tolist()]
    else:
        folder = labelled_folder(data / "lfw" / "aligned112")
        extractor = Extractor(ModelPack.load(data / "packs" / pack), aligned=True)
        extraction = extractor.extract(list(folder.paths))
        rows, names = extraction.embeddings, [path.parent.name for path in extraction.paths]
    more, of_more = stored(data, "lfw_rest", pack)
    person = np.unique([*names, *of_more], return_inverse=True)[1]
    return People(np.concatenate([rows, more]), person.astype(np.int64))


def split(people: People, spared: int, victims: int, rng: np.random.Generator) -> Iterator[People]:
    """Part into a sample of people with one photo, people to choose by, to judge, and others."""
    counts = np.bincount(people.person)
    single = rng.permutation(np.flatnonzero(counts == 1))[:spared]
    several = rng.permutation(np.flatnonzero(counts > 1))
    yield people[people.of(single)]
    for chosen in (several[:victims], several[victims : 2 * victims]):
        yield people[people.of(chosen)]
    yield people[~people.of(np.concatenate([single, several[: 2 * victims]]))]


def pairs(people: People, rng: np.random.Generator) -> Pairs:
    """Enroll up to three photos of each, and keep another one fresh."""
    return Pairs.of(people.rows, people.person, np.unique(people.person), photos=PHOTOS, rng=rng)


def measured(
    source: DecoyGenerator,
    by: People,
    judged: People,
    others: People,
    accuracy_of: People,
    rng: np.random.Generator,
) -> tuple[OperatingPoint, Contract]:
    """Choose by some people, judge others, and calibrate on people on whom nothing was chosen."""
    first, second = pairs(by, rng), pairs(judged, rng)
    setup = AttackSetup.of(
        Pairs(
            np.concatenate([first.enrolled, second.enrolled]),
            np.concatenate([first.fresh, second.fresh]),
        ),
        others.rows,
        source,
        owners=others.person,
        photos=PHOTOS,
    )
    point = choose_and_judge(setup, strategy=Strategy.ADVERSARIAL)
    return point, calibrated(accuracy_of, source.reduced(point.axes), point.dim)


def calibrated(people: People, source: DecoyGenerator, m: int) -> Contract:
    """Set thresholds on some people for templates of dimension m, as `veilface calibrate` does."""
    return calibrate(
        people.rows,
        [str(one) for one in people.person],
        binding=Binding(
            embedder_sha256="00" * 32,
            preprocessing={},
            n=source.n,
            axes=source.k,
            strategy=Strategy.ADVERSARIAL,
            m=m,
            decoy_source_id=source.source_id,
            rotation_version=ROTATION_VERSION,
        ),
        source=source,
        options=CalibrationOptions(probe_dims=(0, PROBE_M), probe_photos=(1, 2, 3)),
    ).contract


def rejected(contract: Contract, *, enrolled: int, shown: int, lifted: bool = False) -> str:
    """FNMR in % at both levels."""
    parts = []
    for name in LEVELS:
        try:
            calibration = (
                contract.calibration("s2s", probe_m=PROBE_M)
                if lifted
                else contract.calibration("p2s", probe_photos=shown, level=name)
            )
            rate = calibration.level(name).fnmr_by_photos[enrolled]
        except (Uncalibrated, KeyError):
            parts.append("–")
            continue
        known = calibration.probe_photos == shown
        parts.append(f"{100 * rate.value:.2g}" if known else "–")
    return " / ".join(parts)


def row_of(name: str, number: int, point: OperatingPoint, contract: Contract) -> dict[str, object]:
    """One row of the table."""
    privacy = point.privacy
    return {
        "spared": name,
        "split": number,
        "axes, m": f"{point.axes}, {point.dim}",
        "theft": f"{100 * privacy.rate.value:.2g} ({privacy.rate.errors}/{privacy.rate.trials}), "
        f"≤ {100 * (privacy.upper or 1):.2g}",
        "strongest attacker": f"{privacy.basis['attacker_faces']}, {privacy.basis['counted']}",
        "privacy": privacy.status,
        "1 to 3": rejected(contract, enrolled=3, shown=1),
        "1 to 1": rejected(contract, enrolled=1, shown=1),
        "2 to 3": rejected(contract, enrolled=3, shown=2),
        "3 to 3": rejected(contract, enrolled=3, shown=3),
        f"lifted, m = {PROBE_M}": rejected(contract, enrolled=3, shown=1, lifted=True),
        "kB": f"{2 * point.axes * (point.dim + 1) / 1000:.0f}",
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", choices=sorted(SETS), default="w600k_mbf")
    parser.add_argument("--spared", type=int, nargs="*", default=[100, 300, 600, 1200, 2400])
    parser.add_argument("--splits", type=int, nargs="*", default=[0, 1, 2], help="their numbers")
    parser.add_argument("--victims", type=int, default=400, help="to judge; as many to choose by")
    parser.add_argument("--no-alone", dest="alone", action="store_false")
    parser.add_argument("--embeddings", type=Path, help="of the crops, embedded before")


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return a row for each number of spared photos and each split."""
    people = lfw(args.data, args.pack, args.embeddings)
    sets = [stored(args.data, name, args.pack)[0] for name in FACES]
    many = np.concatenate(sets)
    rows = []
    with single_threaded():
        for spared in args.spared:
            for number in args.splits:
                rng = np.random.default_rng([spared, number])
                sample, by, judged, others = split(people, spared, args.victims, rng)
                names = [str(one) for one in sample.person]
                source = DecoyGenerator.adapt(many, sample.rows, names)
                rest = People(
                    np.concatenate([judged.rows, others.rows]),
                    np.concatenate([judged.person, others.person]),
                )
                point, contract = measured(source, by, judged, others, rest, rng)
                rows.append(row_of(f"{spared:,}", number, point, contract))
        for number in args.splits if args.alone else ():
            rng = np.random.default_rng([7, number])
            order = rng.permutation(len(sets[0]))
            strangers = People(sets[0][order[:2_400]], np.arange(2_400))
            group = np.minimum(strangers.person // args.victims, 2)
            by, judged, others = (strangers[group == part] for part in range(3))
            source = DecoyGenerator.fit(sets[0][order[2_400:7_400]])
            point, contract = measured(source, by, judged, others, people, rng)
            rows.append(row_of("FairFace alone", number, point, contract))
    return rows
