"""What liveness graphs detect on sets that they were not calibrated on, and what they cost.

Usage::

    python -m benchmarks.liveness SET [SET ...] --pack PACK [--pack PACK ...]
        [--contract FILE --decoys FILE --data-dir DIR]

Each threshold is set at a BPCER of 5 % on one set, and applied to all. The packs share a detector:
a photo is decoded, detected and embedded once, by the first, and scored by the graphs of all. Times
are of one thread's processor in milliseconds, medians, with one thread in every inference: they do
not count what other processes take. With a contract, attacks go through the whole verification.
Numbers of photos only are printed; no score or embedding is kept.
"""

import argparse
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from api.service.opening import file_sealer, open_keyring
from api.settings import load_settings
from attacks.impostor_presentations import verify_presentations
from models.decoding import decode_image
from models.errors import FaceError, ImageError
from models.extraction import Failure
from models.pack import ModelPack
from templates.contract.document import Contract, Rate
from templates.decoys import load_source
from verify.evaluation.liveness.presentations import PresentationSet, read_presentations
from verify.evaluation.liveness.rates import apcer, bpcer, non_response, threshold_at_bpcer
from verify.evaluation.liveness.scores import ScoredSet
from verify.metrics import equal_error_rate

TARGET = 0.05


@dataclass
class Times:
    """Seconds of the processor for each photo: all but liveness, and liveness of each pack."""

    without: list[float] = field(default_factory=list)
    liveness: dict[str, list[float]] = field(default_factory=dict)


def main() -> None:
    """Score all sets with all packs, and print what follows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sets", type=Path, nargs="+", metavar="SET")
    parser.add_argument("--pack", type=Path, action="append", required=True)
    parser.add_argument("--contract", type=Path)
    parser.add_argument("--decoys", type=Path)
    parser.add_argument("--data-dir", type=Path)
    arguments = parser.parse_args()

    packs = [ModelPack.load(path, threads=1) for path in arguments.pack]
    if (
        len({None if pack.info.detector is None else pack.info.detector.sha256 for pack in packs})
        > 1
    ):
        raise SystemExit("the packs have different detectors, and their boxes differ")
    times = Times()
    scored = {
        presented.name: score(presented, packs, times)
        for presented in (read_presentations(path, attacks=True) for path in arguments.sets)
    }
    print_times(times)
    contract = source = None
    if arguments.contract is not None:
        sealer = file_sealer(open_keyring(load_settings(data_dir=arguments.data_dir)))
        contract = Contract.load(arguments.contract, sealer)
        source = load_source(arguments.decoys, sealer)
    for pack in packs:
        print(f"\n## {pack.info.name}\n")
        own = {name: sets[pack.info.name] for name, sets in scored.items()}
        print_rates(own)
        for one in own.values():
            if contract is None or source is None or one.presented.subjects is None:
                continue
            verified = verify_presentations(one, pack.info, contract, source)
            print(
                f"\n{one.presented.name}, level {verified.level}: {verified.enrolled} enrolled, "
                f"left out {', '.join(verified.left_out) or 'none'}; FRR without liveness "
                f"{shown(verified.false_rejections(None))}"
            )
            for place, other in own.items():
                threshold = threshold_at_bpcer(other.scored(None)[0], TARGET)
                for name in one.presented.species:
                    print(
                        f"- threshold of {place}, {name}: IAPMR without liveness "
                        f"{shown(verified.iapmr(name, None))}, with "
                        f"{shown(verified.iapmr(name, threshold))}; FRR "
                        f"{shown(verified.false_rejections(threshold))}"
                    )


def score(presented: PresentationSet, packs: list[ModelPack], times: Times) -> dict[str, ScoredSet]:
    """Score a set by the graphs of every pack."""
    count, n = len(presented.presentations), packs[0].info.n
    scores = {pack.info.name: np.full(count, np.nan) for pack in packs}
    embeddings = np.zeros((count, n), np.float32)
    failures = []
    for row, presentation in enumerate(presented.presentations):
        data = presentation.path.read_bytes()
        start = time.thread_time()
        try:
            sample = packs[0].embed_photo(data, policy=None, quality=None)
        except (FaceError, ImageError) as error:
            failures.append(Failure(presentation.path, error.code, str(error)))
            continue
        times.without.append(time.thread_time() - start)
        embeddings[row] = sample.embedding
        picture = decode_image(data)
        for pack in packs:
            if pack.liveness is None or sample.box is None:
                raise SystemExit(f"{pack.info.name} has no liveness graph")
            start = time.thread_time()
            scores[pack.info.name][row] = pack.liveness.score(picture, sample.box)
            spent = times.liveness.setdefault(pack.info.name, [])
            spent.append(time.thread_time() - start)
    return {
        name: ScoredSet(presented, values, embeddings, tuple(failures))
        for name, values in scores.items()
    }


def print_times(times: Times) -> None:
    """Medians and quartiles in milliseconds."""
    without = np.array(times.without) * 1e3
    print(f"{len(without)} photos, ms of one processor, median (quartiles)\n")
    print(f"- without liveness {spread(without)}")
    for name, seconds in times.liveness.items():
        added = np.array(seconds) * 1e3
        share = np.median(added) / np.median(without)
        print(f"- {name} adds {spread(added)}: {100 * share:.0f} %")


def spread(values: np.ndarray) -> str:
    """Median and quartiles."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"{middle:.1f} ({low:.1f}-{high:.1f})"


def print_rates(own: dict[str, ScoredSet]) -> None:
    """Rates of every set at the threshold of every set."""
    print("| threshold set on | | rates on | BPCER % | species | APCER % | D-EER % |")
    print("|---|---|---|---|---|---|---|")
    for place, other in own.items():
        threshold = threshold_at_bpcer(other.scored(None)[0], TARGET)
        for name, one in own.items():
            for species in one.presented.species:
                equal = equal_error_rate(one.scored(None)[0], one.scored(species)[0])[0]
                print(
                    f"| {place} | {threshold:.3g} | {name} | {shown(bpcer(one, threshold))} | "
                    f"{species} | {shown(apcer(one, species, threshold))} | {100 * equal:.1f} |"
                )
    for name, one in own.items():
        responses = [f"live {shown(non_response(one, None))}"]
        responses += [f"{kind} {shown(non_response(one, kind))}" for kind in one.presented.species]
        print(f"\nWithout a face, {name}: {', '.join(responses)}")


def shown(rate: Rate) -> str:
    """Per cent with the interval and the counts."""
    return (
        f"{100 * rate.value:.1f} [{100 * rate.ci_low:.1f}, {100 * rate.ci_high:.1f}] "
        f"({rate.errors}/{rate.trials})"
    )


if __name__ == "__main__":
    main()
