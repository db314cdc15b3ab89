"""How one score decides: honest people, wolves, what a thief can do, and what it costs.

Templates of LFW people, made of one photo and of three, meet their owners' other photos and hostile
probes: principal axes of faces, mixtures of them, and gradient ascents on the decision itself by an
attacker who knows the algorithm, the thresholds and what is expected of a point. The attacker
learns from FairFace, the contract is calibrated on LFW people who are not attacked. The input
checks of the service are switched off here, so that the figures are those of the decision alone.

The rule before this one (similarity and cohort score both above thresholds at one marginal
quantile) is computed beside it, on the same trials.

Example
-------
::

    python -m benchmarks.hostile_probes --data ../shared/data --dims 64
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from attacks.decisions import decide
from attacks.stored.wolf_ascent import Ground, ascend_subspaces
from attacks.stored.wolves import axis_wolves
from enroll import Enrollment
from models.extraction import Extractor
from models.pack import ModelPack
from templates.contract import wire
from templates.contract.document import Binding, Calibration, Contract
from templates.contract.nobody import COHORT_SIZE
from templates.decoys import DecoyGenerator
from templates.distances import Metric, pairwise_distances, similarity
from templates.keys.randomness import Keystream
from templates.keys.rotation import HAAR_VERSION, ROTATION_VERSION, TenantRotation
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify import CalibrationOptions, Verifier, calibrate, labelled_folder
from verify.cohort import Probes, people_like
from verify.expectation import draw_wolves
from verify.metrics import most_errors, threshold_at_fmr
from verify.point_ascent import ascend_points, climb_once, step_lengths

ATTACKED = 600
CLIMBED = 300
"""Templates that an attacker lifts to climb on."""
STRONG_CLIMBED, STRONG_ROUNDS = 2_100, 80
"""Templates that a stronger attacker lifts, and steps of the ascent."""
Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Faces:
    """Unit embeddings with the names of their people."""

    descriptors: Floats
    names: npt.NDArray[np.str_]

    def only(self, keep: npt.NDArray[np.bool_]) -> "Faces":
        """Rows where ``keep`` holds."""
        return Faces(self.descriptors[keep], self.names[keep])

    def split(self, photos: int) -> tuple[Floats, Floats, npt.NDArray[np.int64]]:
        """Means of each person's first photos, further photos, and whose they are."""
        means: list[npt.NDArray[np.floating]] = []
        probes: list[Floats] = []
        owners: list[int] = []
        for name in np.unique(self.names):
            rows = np.flatnonzero(self.names == name)
            if len(rows) >= photos:
                probes.append(self.descriptors[rows[photos : photos + 5]])
                owners += [len(means)] * len(probes[-1])
                means.append(self.descriptors[rows[:photos]].mean(axis=0))
        return (
            normalised(np.array(means)).astype(np.float32),
            np.concatenate(probes),
            np.array(owners),
        )


def percent(accepted: npt.NDArray[np.bool_]) -> dict[str, object]:
    """Share of accepted trials, with its counts."""
    return {
        "accepted": int(accepted.sum()),
        "trials": int(accepted.size),
        "percent": round(100 * float(accepted.mean()), 3),
    }


def contract_of(
    faces: Faces, source: DecoyGenerator, m: int, probe_dims: Sequence[int]
) -> Contract:
    """Calibrate a contract for adversarial templates of dimension m."""
    binding = Binding(
        embedder_sha256="00" * 32,
        preprocessing={},
        n=source.n,
        strategy=Strategy.ADVERSARIAL,
        m=m,
        decoy_source_id=source.source_id,
        rotation_version=ROTATION_VERSION,
    )
    return calibrate(
        faces.descriptors,
        [str(name) for name in faces.names],
        binding=binding,
        source=source,
        options=CalibrationOptions(
            probe_dims=tuple(probe_dims),
            probe_photos=(1,),
            targets=(1e-2, 1e-3, 1e-4),
            lifted_probes=800,
            lifted_impostor_pairs=110_000,
        ),
    ).contract


def lifted(rows: Floats, source: DecoyGenerator, m: int, purpose: str) -> SubspaceBatch:
    """Lift as the service does, with randomness of this purpose."""
    with Keystream.seeded(purpose, m) as stream:
        return lift(rows, strategy=Strategy.ADVERSARIAL, m=m, source=source, stream=stream)


def near(probes: Floats, templates: SubspaceBatch) -> Doubles:
    """Similarities of every probe to every template, (P, T)."""
    distances = pairwise_distances(probes, templates, metric=Metric.SPHERICAL)
    return np.asarray(similarity(distances), dtype=np.float64)


def both_thresholds(similarities: Doubles, scores: Doubles, target: float) -> tuple[float, float]:
    """Return thresholds at the largest common rank whose joint FMR is at most the target."""
    allowed = most_errors(target, similarities.size)
    ordered = [np.sort(values)[::-1] for values in (similarities, scores)]
    low, high = allowed, similarities.size - 1
    while high - low > 1:
        rank = (low + high) // 2
        joint = (similarities > ordered[0][rank]) & (scores > ordered[1][rank])
        low, high = (rank, high) if np.count_nonzero(joint) <= allowed else (low, rank)
    return float(ordered[0][low]), float(ordered[1][low])


def rules_table(contract: Contract, source: DecoyGenerator, faces: Faces) -> dict[str, object]:
    """FNMR by one score, by its cohort form, and by both thresholds, on the same trials."""
    table: dict[str, object] = {}
    cohort = contract.cohort.restored()
    for photos in (1, 3):
        enrolled, probes, owners = faces.split(photos)
        templates = lifted(enrolled, source, contract.binding.m, f"genuine {photos}")
        close, crowd = near(probes, templates), near(probes, cohort)
        means, spreads = contract.expectation.statistics(probes)
        forms = {
            "similarity alone": close,
            "score of a cohort": (close - crowd.mean(axis=1)[:, None])
            / crowd.std(axis=1, ddof=1)[:, None],
            "score": (close - means[:, None]) / spreads[:, None],
        }
        own = (np.arange(len(probes)), owners)
        others = np.ones(close.shape, dtype=np.bool_)
        others[own] = False
        rows: dict[str, object] = {"templates": len(templates), "genuine trials": len(probes)}
        for target in (1e-3, 1e-4):
            for name, values in forms.items():
                missed = values[own] < threshold_at_fmr(values[others], target)
                rows[f"{name}, FNMR % at FMR {target:g}"] = round(100 * float(missed.mean()), 2)
            first, second = forms["similarity alone"], forms["score of a cohort"]
            one, other = both_thresholds(first[others], second[others], target)
            missed = ~((first[own] > one) & (second[own] > other))
            rows[f"both thresholds, FNMR % at FMR {target:g}"] = round(
                100 * float(missed.mean()), 2
            )
        table[f"{photos} photos enrolled"] = rows
    return table


def shares(
    probes: Probes, templates: SubspaceBatch, contract: Contract, calibration: Calibration
) -> dict[str, object]:
    """Share of the templates that accept each probe, by level: the worst, and on average."""
    table: dict[str, object] = {"probes": len(probes), "templates": len(templates)}
    for level in calibration.levels:
        accepted = decide(probes, templates, contract, calibration, level).mean(axis=1)
        table[level.name] = {
            "worst_percent": round(100 * float(accepted.max()), 2),
            "mean_percent": round(100 * float(accepted.mean()), 3),
            "above_twice_the_target": int(np.sum(accepted > 2 * (level.target_fmr or 1))),
        }
    return table


def strong_climbers(
    contract: Contract, source: DecoyGenerator, enrolled: Floats, attacked: Faces, starts: Floats
) -> dict[str, object]:
    """Acceptance of embeddings that climb longer, on many templates of people like the enrolled.

    Their templates are another 300 of 2,100 at each step, so that little of what is found is
    theirs. Thresholds are those of the cross-identity pairs of the attacked.
    """
    m, expectation = contract.binding.m, contract.expectation
    with Keystream.seeded("strong climbers", m) as stream:
        people = people_like(source, enrolled).draw(STRONG_CLIMBED, 1, stream=stream)[:, 0]
    own = lifted(people, source, m, "climbed long")
    table: dict[str, object] = {}
    for photos in (1, 3):
        hidden, probes, owners = attacked.split(photos)
        templates = lifted(hidden, source, m, f"genuine {photos}")
        means, spreads = expectation.statistics(probes)
        scores = (near(probes, templates) - means[:, None]) / spreads[:, None]
        others = np.ones(scores.shape, dtype=np.bool_)
        others[np.arange(len(probes)), owners] = False
        for target in (1e-2, 1e-3):
            threshold = threshold_at_fmr(scores[others], target)
            rng = np.random.default_rng(photos)
            points = starts
            for step in step_lengths(STRONG_ROUNDS):
                seen = own[np.sort(rng.choice(len(own), CLIMBED, replace=False))]
                _, points = climb_once(points, seen, expectation, threshold=threshold, step=step)
            means, spreads = expectation.statistics(points)
            reached = (near(points, templates) - means[:, None]) / spreads[:, None]
            share = (reached >= threshold).mean(axis=1)
            table[f"{photos} photos, FMR {target:g}"] = {
                "probes": len(points),
                "templates": len(templates),
                "mean_in_targets": round(float(share.mean()) / target, 2),
                "worst_percent": round(100 * float(share.max()), 2),
                "above_twice_the_target": int(np.sum(share > 2 * target)),
            }
    return table


def chosen(
    candidates: Probes, own: SubspaceBatch, contract: Contract, calibration: Calibration, name: str
) -> Probes:
    """Return the probe that most of the attacker's own templates accept."""
    accepted = decide(candidates, own, contract, calibration, calibration.level(name)).mean(axis=1)
    return candidates[np.array([int(np.argmax(accepted))])]


def point_wolves(
    contract: Contract, source: DecoyGenerator, attacker: Floats, victims: dict[str, SubspaceBatch]
) -> dict[str, object]:
    """Acceptance of raw wolves: drawn ones, and ascents at every level, all and the best one."""
    calibration, m = contract.calibration("p2s"), contract.binding.m
    with Keystream.seeded("wolves") as stream:
        drawn = draw_wolves(attacker.astype(np.float64), 400, stream=stream).astype(np.float32)
    own = lifted(attacker[:CLIMBED], source, m, "climbed")
    held_out = lifted(attacker[CLIMBED : 3 * CLIMBED], source, m, "held out")
    kinds: dict[str, Probes] = {"axes and mixtures": drawn}
    starts = np.concatenate([drawn[::20], attacker[-20:]])
    for level in calibration.levels:
        ends = ascend_points(starts, own, contract.expectation, threshold=level.threshold)
        kinds[f"ascents to {level.name}"] = ends
        kinds[f"best ascent to {level.name}"] = chosen(
            ends, held_out, contract, calibration, level.name
        )
    return {
        f"{kind}, {who}": shares(probes, templates, contract, calibration)
        for kind, probes in kinds.items()
        for who, templates in victims.items()
    }


def lifted_wolves(
    contract: Contract,
    source: DecoyGenerator,
    attacker: Floats,
    victims: dict[str, SubspaceBatch],
    probe_m: int,
) -> dict[str, object]:
    """Acceptance of lifted wolves: 44 of axes, and ascents from the six best of them."""
    calibration, m = contract.calibration("s2s", probe_m=probe_m), contract.binding.m
    low, high = calibration.foot_point_norm or (0.0, 1.0)
    pack = axis_wolves(attacker, probe_m, foot_norm=(low + high) / 2, seed=probe_m)
    axes = SubspaceBatch.of([wolf.subspace for wolf in pack])
    own = lifted(attacker[: CLIMBED // 2], source, m, "climbed")
    crowd = lifted(attacker[CLIMBED : CLIMBED + COHORT_SIZE // 2], source, m, "own cohort")
    level = calibration.level("fmr-1e-2")
    order = np.argsort(-decide(axes, own, contract, calibration, level).mean(axis=1))
    ends = ascend_subspaces(axes[order[:6]], Ground.of(own, crowd, level))
    return {
        f"{kind}, {who}": shares(probes, templates, contract, calibration)
        for kind, probes in (("axes", axes), ("ascents to fmr-1e-2", ends))
        for who, templates in victims.items()
    }


def cost_table(contract: Contract, template: SubspaceBatch, probe: Floats) -> dict[str, object]:
    """CPU of a decision by embedding, and of its parts; a cohort and a matrix for comparison."""
    rotation = TenantRotation(bytes(range(32)), template.n)
    verifier = Verifier(contract, rotation=rotation)
    data = wire.encode(template[0], contract_id=contract.contract_id)
    stored = Enrollment(data, "0" * 32, contract.contract_id, ())
    cohort = contract.cohort.restored()

    def milliseconds(run: object, repeats: int = 60) -> float:
        assert callable(run)
        run()
        times = []
        for _ in range(repeats):
            start = time.process_time()
            run()
            times.append(time.process_time() - start)
        return round(1e3 * float(np.median(times)), 3)

    return {
        "decision_ms": milliseconds(lambda: verifier.decide_embedding(probe, stored)),
        "rotation_ms": milliseconds(lambda: rotation.of(stored.template_id).turned(probe[None])),
        "matrix_rotation_ms": milliseconds(
            lambda: rotation.of("", HAAR_VERSION).turned(probe[None])
        ),
        "expectation_ms": milliseconds(lambda: contract.expectation.statistics(probe[None])),
        "cohort_in_float32_ms": milliseconds(lambda: near(probe[None], cohort)),
    }


def thief_table(
    contract: Contract, templates: SubspaceBatch, victims: npt.NDArray[np.float32], level_name: str
) -> dict[str, object]:
    """What one stolen template opens, for what else the thief has.

    Without the right to send embeddings the thief has no call to make: a template holds no photo.
    """
    calibration = contract.calibration("p2s")
    level = calibration.level(level_name)
    feet = templates.feet.astype(np.float64)
    norms = np.linalg.norm(feet, axis=1, keepdims=True)
    inside = feet + np.sqrt(1 - norms**2) * templates.bases[:, 0]
    foot_points = feet / norms
    rotation = TenantRotation(bytes(range(32)), templates.n)
    turned = np.concatenate(
        [rotation.of(str(number)).turned(point[None]) for number, point in enumerate(inside)]
    )

    def tried(probes: npt.NDArray[np.float64]) -> dict[str, object]:
        rows = np.ascontiguousarray(probes, dtype=np.float32)
        return percent(decide(rows, templates, contract, calibration, level, paired=True))

    return {
        "level": level_name,
        "without_embeddings_right": "HTTP 403 forbidden, whatever the probe",
        "with_right_and_rotation_key": tried(inside),
        "with_right_without_rotation_key": tried(turned),
        "foot_point_as_probe_with_right_and_rotation_key": tried(foot_points),
        "cosine_of_foot_point_to_victim_mean": round(
            float(np.mean(np.sum(foot_points * victims, axis=1))), 4
        ),
    }


def read_npz(file: Path) -> Faces:
    """Read ``paths`` (``Name/photo.jpg``) and ``emb_mbf``."""
    with np.load(file) as data:
        names = np.array([str(path).split("/")[0] for path in data["paths"]])
        return Faces(normalised(data["emb_mbf"].astype(np.float64)).astype(np.float32), names)


def main() -> None:
    """Calibrate, attack, print the tables as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--lfw", type=Path, help="embeddings of the crops, instead of the pack's")
    parser.add_argument("--dims", default="64", help="template dimensions")
    parser.add_argument("--people", type=int, default=1500, help="to calibrate on, at most")
    parser.add_argument("--probe-dim", type=int, default=8, help="of lifted probes; 0: none")
    args = parser.parse_args()
    if args.lfw:
        lfw = read_npz(args.lfw)
    else:
        pack = ModelPack.load(args.data / "packs" / "w600k_mbf")
        crops = labelled_folder(args.data / "lfw" / "aligned112")
        found = Extractor(pack, aligned=True).extract(crops.paths)
        lfw = Faces(found.descriptors, np.array(crops.identities))
    fairface = read_npz(args.data / "embeddings" / "fairface_more.npz").descriptors
    source = DecoyGenerator.fit(fairface[:5000])
    attacker = fairface[-5000:]
    people, photos = np.unique(lfw.names, return_counts=True)
    several = np.random.default_rng(0).permutation(people[photos >= 3])[:ATTACKED]
    calibrating = np.setdiff1d(people, several)
    calibrating = np.random.default_rng(1).permutation(calibrating)[: args.people]
    attacked, others = (lfw.only(np.isin(lfw.names, who)) for who in (several, calibrating))
    report: dict[str, object] = {"attacked": len(several), "calibrating": len(calibrating)}
    for m in map(int, args.dims.split(",")):
        contract = contract_of(
            others, source, m, [0, *([args.probe_dim] if args.probe_dim else [])]
        )
        victims = {
            f"{count} photos": lifted(attacked.split(count)[0], source, m, f"victims {count}")
            for count in (1, 3)
        }
        report[f"rules, m = {m}"] = rules_table(contract, source, attacked)
        report[f"point wolves, m = {m}"] = point_wolves(contract, source, attacker, victims)
        with Keystream.seeded("starts of strong climbers") as stream:
            wolves = draw_wolves(attacker.astype(np.float64), 400, stream=stream)[10::20]
        starts = np.concatenate([wolves, attacker[:20]]).astype(np.float32)
        report[f"strong climbers, m = {m}"] = strong_climbers(
            contract, source, others.split(1)[0], attacked, starts
        )
        if args.probe_dim:
            report[f"lifted wolves, m = {m}"] = lifted_wolves(
                contract, source, attacker, victims, args.probe_dim
            )
        first = attacked.split(1)[0]
        report[f"stolen template, m = {m}"] = thief_table(
            contract, victims["1 photos"], first, "fmr-1e-3"
        )
        report[f"cost, m = {m}"] = cost_table(contract, victims["1 photos"], first[0])
        print(json.dumps(report, indent=2), flush=True)


if __name__ == "__main__":
    main()
