"""Which decoy generator: told apart from real embeddings, accuracy, leakage, memorisation.

Every figure of docs/design-measurements.md §2. Generators are fitted to 3,500 FairFace training
faces and compared with faces of other people. Embeddings stay in memory; ``--embeddings`` reads an
.npz computed elsewhere instead (keys ``lfw``, ``lfw_paths``, ``fairface_train``,
``fairface_train_paths``, ``fairface_val``, ``fairface_val_paths``, optionally
``fairface_train_norm``).

Example
-------
::

    python -m benchmarks.decoy_generators --data ../shared/data --part separation
"""

import argparse
import csv
import json
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from sklearn.metrics import roc_auc_score

from benchmarks.decoy_candidates import CANDIDATES, FitData, source
from benchmarks.decoy_separation import areas
from models.extraction import Extractor
from models.pack import ModelPack
from templates.decoys import DecoyGenerator, DecoySource
from templates.distances import paired_distances, pairwise_distances, similarity
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift
from verify.datasets import read_lfw_pairs
from verify.metrics import fnmr_at_fmr
from verify.tenfold import Pair, pair_arrays, ten_fold

Rows = npt.NDArray[np.float32]
FITTED = 3500
SAME_PERSON = 0.5
"""Cosine above which two faces count as one person (FMR below 1e-5 on LFW)."""


@dataclass(frozen=True)
class Faces:
    """Embeddings of all sets, FairFace classes as gender × race."""

    lfw: Rows
    pairs: list[Pair]
    fit: FitData
    others: Rows
    others_labels: list[tuple[str, str]]
    validation: Rows
    validation_labels: list[tuple[str, str]]
    failures: int

    def unseen(self) -> Rows:
        """Faces of people who are not among the fitted, each person once."""
        rows = np.vstack([self.others, self.validation])
        return _each_once(rows[(rows @ self.fit.descriptors.T).max(axis=1) < SAME_PERSON])


def _each_once(rows: Rows) -> Rows:
    """Without the faces that resemble an earlier one."""
    first = np.tril(rows @ rows.T, -1).max(axis=1) < SAME_PERSON
    return np.ascontiguousarray(rows[first])


def load(data: Path, embeddings: Path | None) -> Faces:
    """Read or compute the embeddings; split FairFace's training faces by a fixed permutation."""
    lfw_root, fairface = data / "lfw" / "aligned112", data / "fairface"
    norms = None
    if embeddings is not None:
        with np.load(embeddings) as file:
            lfw, train, val = (file[k] for k in ("lfw", "fairface_train", "fairface_val"))
            lfw_paths = [lfw_root / p for p in file["lfw_paths"]]
            train_names = [str(p) for p in file["fairface_train_paths"]]
            val_names = [str(p) for p in file["fairface_val_paths"]]
            norms = file.get("fairface_train_norm", None)
            failures = len(file["failures"]) if "failures" in file else 0
    else:
        pack = ModelPack.load(data / "packs" / "w600k_mbf")
        crops = Extractor(pack, aligned=True).extract(sorted(lfw_root.glob("*/*.jpg")))
        lfw, lfw_paths = crops.descriptors, crops.paths
        photos = Extractor(pack)
        extractions = [
            photos.extract(sorted((fairface / s).glob("*.jpg"))) for s in ("train", "val")
        ]
        train, val = (one.descriptors for one in extractions)
        train_names, val_names = (
            [p.relative_to(fairface).as_posix() for p in one.paths] for one in extractions
        )
        failures = sum(len(one.failures) for one in extractions)
    labels = dict(_labels(fairface / "fairface_label_train.csv"))
    labels |= dict(_labels(fairface / "fairface_label_val.csv"))
    train_labels = [labels[name] for name in train_names]
    classes = np.unique(["/".join(label) for label in train_labels], return_inverse=True)[1]
    order = np.random.default_rng(0).permutation(len(train))
    fit, rest = order[:FITTED], order[FITTED:]
    return Faces(
        lfw=lfw,
        pairs=read_lfw_pairs(lfw_root / "pairs.txt", lfw_paths),
        fit=FitData(train[fit], classes[fit], None if norms is None else norms[fit]),
        others=train[rest],
        others_labels=[train_labels[i] for i in rest],
        validation=val,
        validation_labels=[labels[name] for name in val_names],
        failures=failures,
    )


def _labels(path: Path) -> Iterable[tuple[str, tuple[str, str]]]:
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            yield row["file"], (row["gender"], row["race"])


def separation(faces: Faces, names: list[str]) -> dict[str, object]:
    """AUC per generator and classifier; 0.5 is the aim.

    Two more rows. "real against real" is the null. "right model" is what the product's generator
    reaches when the truth is of its own family: the cost of estimating from 3,500 faces.
    """
    real = faces.unseen()
    report: dict[str, object] = {"real faces": len(real)}
    for name in ("real against real", "right model", *names):
        stream = Keystream.seeded("separation", name)
        started = time.perf_counter()
        if name == "real against real":
            left, right, fitted = real[::2], real[1::2], faces.fit.descriptors
        elif name == "right model":
            truth = DecoyGenerator.fit(np.vstack([faces.fit.descriptors, real]))
            fitted = truth.draw(FITTED, 1, stream=stream)[:, 0]
            left = truth.draw(len(real), 1, stream=stream)[:, 0]
            right = DecoyGenerator.fit(fitted).draw(len(real), 1, stream=stream)[:, 0]
        else:
            left, fitted = real, faces.fit.descriptors
            right = source(name, faces.fit).draw(len(real), 1, stream=stream)[:, 0]
        row = areas(left, right, fitted)
        report[name] = row
        print(json.dumps({name: row, "s": round(time.perf_counter() - started)}), flush=True)
    return report


def estimation(faces: Faces, counts: list[int]) -> dict[str, object]:
    """What more fitted faces would bring: AUCs when the truth is of the generator's own family."""
    truth = DecoyGenerator.fit(np.vstack([faces.fit.descriptors, faces.unseen()]))
    report: dict[str, object] = {}
    for count in counts:
        stream = Keystream.seeded("estimation", count)
        fitted = truth.draw(count, 1, stream=stream)[:, 0]
        left = truth.draw(2745, 1, stream=stream)[:, 0]
        right = DecoyGenerator.fit(fitted).draw(len(left), 1, stream=stream)[:, 0]
        report[str(count)] = areas(left, right, fitted)
        print(json.dumps({str(count): report[str(count)]}), flush=True)
    return report


def accuracy(
    faces: Faces, names: list[str], dims: list[int], seeds: int, mode: str
) -> dict[str, object]:
    """LFW ten-fold accuracy and FNMR at FMR 1e-2 and 1e-3, in %, spherical: mean over seeds."""
    same = np.array([pair.same for pair in faces.pairs])
    first = faces.lfw[[pair.first for pair in faces.pairs]]
    second = faces.lfw[[pair.second for pair in faces.pairs]]
    report: dict[str, object] = {}
    for name in names:
        decoys = source(name, faces.fit)
        for m in dims:
            figures = []
            for seed in range(seeds):
                scores = _scores(first, second, decoys, m, seed, mode)
                figures.append(
                    [
                        ten_fold(scores, *pair_arrays(faces.pairs)).accuracy_mean,
                        *(
                            fnmr_at_fmr(scores[same], scores[~same], t)[1].value
                            for t in (1e-2, 1e-3)
                        ),
                    ]
                )
            table = 100 * np.array(figures)
            row = {
                "accuracy, FNMR at 1e-2, at 1e-3": table.mean(axis=0).round(3).tolist(),
                "standard error": (table.std(axis=0, ddof=1) / np.sqrt(seeds)).round(3).tolist(),
            }
            report[f"{name}, m = {m}"] = row
            print(json.dumps({f"{mode}, {name}, m = {m}": row}), flush=True)
    return report


def _scores(
    first: Rows, second: Rows, decoys: DecoySource, m: int, seed: int, mode: str
) -> npt.NDArray[np.floating]:
    """Similarity of every pair, tiled so that m = 64 fits in memory."""
    stream = Keystream.seeded("accuracy", m, seed)
    scores = []
    for start in range(0, len(first), 500):
        part = slice(start, start + 500)
        templates = lift(
            second[part], strategy=Strategy.ADVERSARIAL, m=m, source=decoys, stream=stream
        )
        probes = (
            first[part]
            if mode == "p2s"
            else lift(first[part], strategy=Strategy.ADVERSARIAL, m=m, source=decoys, stream=stream)
        )
        scores.append(similarity(paired_distances(probes, templates, metric="spherical")))
    return np.concatenate(scores)


def leakage(faces: Faces, names: list[str], dims: list[int], seeds: int) -> dict[str, object]:
    """The paper's K-NN attack (K = 10, point to subspace, Euclidean): gender / race in %."""
    keep = (faces.validation @ faces.others.T).max(axis=1) < SAME_PERSON
    victims = faces.validation[keep]
    truth = [label for label, kept in zip(faces.validation_labels, keep, strict=True) if kept]

    def hits(distances: npt.NDArray[np.floating]) -> list[float]:
        nearest = np.argpartition(distances, 10, axis=0)[:10].T
        right = np.zeros(2)
        for label, votes in zip(truth, nearest, strict=True):
            for place in (0, 1):
                guess = Counter(faces.others_labels[i][place] for i in votes).most_common(1)
                right[place] += guess[0][0] == label[place]
        return list(100 * right / len(truth))

    largest = [Counter(labels).most_common(1)[0][1] for labels in zip(*truth, strict=True)]
    majority = [100 * count / len(truth) for count in largest]
    report: dict[str, object] = {
        "victims": len(truth),
        "attacker's faces": len(faces.others),
        "majority": np.round(majority, 1).tolist(),
        "raw": np.round(hits(1 - faces.others @ victims.T), 1).tolist(),
    }
    print(json.dumps(report), flush=True)
    for name in names:
        decoys = source(name, faces.fit)
        for m in dims:
            figures = []
            for seed in range(seeds):
                stream = Keystream.seeded("leakage", m, seed)
                templates = lift(
                    victims, strategy=Strategy.ADVERSARIAL, m=m, source=decoys, stream=stream
                )
                figures.append(
                    hits(pairwise_distances(faces.others, templates, metric="euclidean"))
                )
            row = np.mean(figures, axis=0).round(1).tolist()
            report[f"{name}, m = {m}"] = row
            print(json.dumps({f"K-NN, {name}, m = {m}": row}), flush=True)
    return report


def memorisation(faces: Faces, names: list[str], m: int = 16) -> dict[str, object]:
    """Whether the fitted people can be found in the decoys, or are accepted by the templates.

    - cosine of a decoy to its nearest fitted person, beside that of an unseen real face;
    - at the threshold where unseen people are accepted at 1e-3 (spherical point to subspace),
      the share of fitted people who are accepted;
    - AUC of telling fitted from unseen people by the likelihood under the covariance of the fit.
    """
    fitted, unseen = faces.fit.descriptors, faces.unseen()
    levels = [50, 99, 100]

    def nearest(rows: Rows) -> list[float]:
        values = np.percentile((rows @ fitted.T).max(axis=1), levels)
        return [float(v) for v in values.round(3)]

    victims, strangers = unseen[:400], unseen[400:]
    # Filtered as the unseen people are: blurred faces resemble many others and would be counted
    # on one side only.
    comparable = _each_once(fitted[(fitted @ unseen.T).max(axis=1) < SAME_PERSON])
    report: dict[str, object] = {"unseen faces": nearest(unseen)}
    for name in names:
        decoys = source(name, faces.fit)
        with Keystream.seeded("memorisation") as stream:
            drawn = decoys.draw(4000, 1, stream=stream)[:, 0]
            templates = lift(
                victims, strategy=Strategy.ADVERSARIAL, m=m, source=decoys, stream=stream
            )
        scores = [
            similarity(pairwise_distances(people, templates, metric="spherical"))
            for people in (strangers, comparable)
        ]
        threshold = np.quantile(scores[0], 0.999)
        report[name] = {
            "nearest fitted person (median, 99 %, most)": nearest(drawn),
            "fitted people accepted at FMR 1e-3, %": round(
                100 * float((scores[1] > threshold).mean()), 4
            ),
        }
        print(json.dumps({name: report[name]}), flush=True)
    axes = DecoyGenerator.fit(fitted).statistics
    inverse = np.linalg.inv(axes.axes.astype(np.float64))
    likelihoods = [-(((r - axes.mean) @ inverse) ** 2).sum(axis=1) for r in (unseen, fitted)]
    report["membership by the generator's covariance, AUC"] = round(
        roc_auc_score(np.repeat([0, 1], [len(unseen), len(fitted)]), np.concatenate(likelihoods)),
        3,
    )
    return report


def main() -> None:
    """Print one JSON line per result as it is found, and all together at the end."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--embeddings", type=Path)
    parser.add_argument(
        "--part",
        choices=["separation", "estimation", "accuracy", "s2s", "leakage", "memorisation"],
        required=True,
    )
    parser.add_argument("--generators", help="comma-free names separated by ';'; default: all")
    parser.add_argument("--dims", default="2,4,8,16,32,64")
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    faces = load(args.data, args.embeddings)
    names = list(CANDIDATES) if args.generators is None else args.generators.split(";")
    if faces.fit.norms is None:
        names = [name for name in names if name != "gaussian, unscaled embeddings"]
    dims = [int(m) for m in args.dims.split(",")]
    match args.part:
        case "separation":
            report = separation(faces, [name for name in names if name != "real pool"])
        case "estimation":
            report = estimation(faces, [5000, 20000, 80000])
        case "accuracy":
            report = accuracy(faces, names, dims, args.seeds, "p2s")
        case "s2s":
            report = accuracy(faces, names, dims, args.seeds, "s2s")
        case "leakage":
            report = leakage(faces, names, dims, args.seeds)
        case _:
            report = memorisation(faces, names)
    print(json.dumps({"failures to acquire": faces.failures, args.part: report}, indent=1))


if __name__ == "__main__":
    main()
