"""How many templates a wolf probe opens, with and without the cohort test, and what a thief can do.

Templates of LFW people are attacked with lifted probes that lie near every face: principal axes of
face embeddings through the origin, and the same axes with a plausible foot point along the mean
face. The attacker learns them from FairFace, the contract is calibrated on LFW people who are not
attacked. The input checks of the service are switched off here, so that the figures are those of
the decision alone; how many wolves the checks would refuse is counted beside them.

Example
-------
::

    python -m benchmarks.hostile_probes --data ../shared/data --dims 4,8
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from attacks.decisions import decide
from attacks.stored.wolves import axis_wolves
from models.cache import EmbeddingCache
from models.extraction import Extractor
from models.pack import ModelPack
from templates.contract.document import Binding, Contract
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION, tenant_rotation
from templates.keys.sealing import KeyringSealer, MasterKeyring
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from verify import CalibrationOptions, calibrate, labelled_folder

ATTACKED = 700


@dataclass(frozen=True)
class Faces:
    """Unit embeddings with the names of their people."""

    descriptors: npt.NDArray[np.float32]
    names: npt.NDArray[np.str_]

    def only(self, keep: npt.NDArray[np.bool_]) -> "Faces":
        """Rows where ``keep`` holds."""
        return Faces(self.descriptors[keep], self.names[keep])


def percent(accepted: npt.NDArray[np.bool_]) -> dict[str, object]:
    """Share of accepted trials, with its counts."""
    return {
        "accepted": int(accepted.sum()),
        "trials": int(accepted.size),
        "percent": round(100 * float(accepted.mean()), 3),
    }


def contract_of(
    pack: ModelPack, faces: Faces, source: DecoyGenerator, m: int, probe_dims: Sequence[int]
) -> Contract:
    """Calibrate a contract for adversarial templates of dimension m."""
    info = pack.info
    binding = Binding(
        embedder_sha256=info.embedder_sha256,
        preprocessing=info.preprocessing,
        n=info.n,
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
        options=CalibrationOptions(probe_dims=tuple(probe_dims)),
    ).contract


def wolf_table(
    contract: Contract,
    attacked: SubspaceBatch,
    attacker_faces: npt.NDArray[np.float32],
    m: int,
    level_name: str,
) -> dict[str, object]:
    """Acceptance of every wolf by the attacked templates, by family."""
    calibration = contract.calibration("s2s", probe_m=m)
    level = calibration.level(level_name)
    low, high = calibration.foot_point_norm or (0.0, 1.0)
    pack = axis_wolves(attacker_faces, m, foot_norm=(low + high) / 2, seed=m)
    near, accepted = decide(
        SubspaceBatch.of([wolf.subspace for wolf in pack]), attacked, contract, calibration, level
    )
    table: dict[str, object] = {"wolves": len(pack), "templates": len(attacked)}
    for family in sorted({wolf.family for wolf in pack}):
        rows = np.array([wolf.family == family for wolf in pack])
        norms = [wolf.subspace.foot_norm for wolf in pack if wolf.family == family]
        table[family] = {
            "variants": int(rows.sum()),
            "refused_by_the_input_checks": sum(not low <= norm <= high for norm in norms),
            "worst_threshold_only_percent": round(100 * float(near[rows].mean(axis=1).max()), 2),
            "worst_with_cohort_percent": round(100 * float(accepted[rows].mean(axis=1).max()), 2),
            "mean_threshold_only_percent": round(100 * float(near[rows].mean()), 2),
            "mean_with_cohort_percent": round(100 * float(accepted[rows].mean()), 2),
        }
    return table


def genuine_table(
    contract: Contract, source: DecoyGenerator, faces: Faces, m: int, level_name: str, seed: int
) -> dict[str, object]:
    """FNMR of lifted genuine probes, by the threshold alone and with the cohort test."""
    calibration = contract.calibration("s2s", probe_m=m)
    level = calibration.level(level_name)
    first, second = [], []
    for name in np.unique(faces.names):
        rows = np.flatnonzero(faces.names == name)
        if len(rows) > 1:
            first.append(rows[0])
            second.append(rows[1])
    with Keystream.seeded("genuine", m, seed) as stream:
        templates = lift(
            faces.descriptors[first], strategy=Strategy.ADVERSARIAL, m=contract.binding.m,
            source=source, stream=stream,
        )  # fmt: skip
        probes = lift(
            faces.descriptors[second], strategy=Strategy.ADVERSARIAL, m=m,
            source=source, stream=stream,
        )  # fmt: skip
    near, accepted = decide(probes, templates, contract, calibration, level, paired=True)
    return {"threshold_only_rejected": percent(~near), "with_cohort_rejected": percent(~accepted)}


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
    turned = inside @ tenant_rotation(bytes(range(32)), templates.n).T

    def tried(probes: npt.NDArray[np.float64]) -> dict[str, object]:
        rows = np.ascontiguousarray(probes, dtype=np.float32)
        return percent(decide(rows, templates, contract, calibration, level, paired=True).accepted)

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


def main() -> None:
    """Calibrate, attack, print the tables as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--dims", default="4,8", help="template and probe dimensions, s-to-s")
    parser.add_argument("--thief-dims", default="16,32", help="template dimensions, p-to-s")
    parser.add_argument("--level", default="fmr-1e-2")
    parser.add_argument("--cache", type=Path, help="sealed embeddings of an earlier run")
    parser.add_argument("--master-key", type=Path, help="the key file that the cache belongs to")
    args = parser.parse_args()
    cache = None
    if args.cache and args.master_key:
        keyring = MasterKeyring.load(args.master_key)
        cache = EmbeddingCache.open_file(args.cache, KeyringSealer(keyring))
    pack = ModelPack.load(args.pack or args.data / "packs" / "w600k_mbf")
    crops = labelled_folder(args.data / "lfw" / "aligned112")
    lfw = Faces(
        Extractor(pack, aligned=True, cache=cache).extract(crops.paths).descriptors,
        np.array(crops.identities),
    )
    fairface = (
        Extractor(pack, cache=cache)
        .extract(sorted((args.data / "fairface" / "train").glob("*.jpg")))
        .descriptors
    )
    half = len(fairface) // 2
    source = DecoyGenerator.fit(fairface)
    people = np.unique(lfw.names)
    attacked_people = np.random.default_rng(0).permutation(people)[:ATTACKED]
    is_attacked = np.isin(lfw.names, attacked_people)
    attacked, others = lfw.only(is_attacked), lfw.only(~is_attacked)
    victims = attacked.descriptors[np.unique(attacked.names, return_index=True)[1]]
    report: dict[str, object] = {"level": args.level}
    for m in map(int, args.dims.split(",")):
        contract = contract_of(pack, others, source, m, [m])
        with Keystream.seeded("attacked", m) as stream:
            templates = lift(
                victims, strategy=Strategy.ADVERSARIAL, m=m, source=source, stream=stream
            )
        report[f"wolves, m = {m}"] = wolf_table(contract, templates, fairface[half:], m, args.level)
        report[f"genuine, m = {m}"] = genuine_table(contract, source, attacked, m, args.level, 0)
    for m in map(int, args.thief_dims.split(",")):
        contract = contract_of(pack, others, source, m, [0])
        with Keystream.seeded("stolen", m) as stream:
            templates = lift(
                victims, strategy=Strategy.ADVERSARIAL, m=m, source=source, stream=stream
            )
        report[f"stolen template, m = {m}"] = thief_table(contract, templates, victims, "fmr-1e-3")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
