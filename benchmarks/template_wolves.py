"""What strangers a template accepts that was made to be accepted by as many as possible.

A contract is calibrated as `veilface calibrate` does. The attacker has faces of other people, the
decoy generator, and knows thresholds and limits; all that the contract seals is unknown to them.
Their templates climb on the share of their own faces that they accept, while the score that the
service holds a template against, computed on faces of their own, stays below a limit of their
choice; of those that the service takes, the one that most strangers pass counts. Figures are in
docs/threat-model.md.

Example
-------
::

    python -m benchmarks.template_wolves --data ../shared/data --cache lfw.npz --people 80
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from attacks.stored.wolves import canonical
from models.cache import EmbeddingCache
from models.extraction import Extractor
from models.pack import ModelPack
from templates.contract.document import Binding, Contract
from templates.contract.nobody import TILT
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift
from templates.space.subspace import AffineSubspace, SubspaceBatch
from verify import CalibrationOptions, calibrate, labelled_folder

Floats = NDArray[np.float32]

LEVEL = "fmr-1e-3"
ROUNDS = 160
BATCH = 1024
MARGINS = {"faces and decoys": (-1.5, -0.75, 0.0), "decoys": (0.5, 1.0)}
"""By how much the score on what the attacker has stays below the contract's limit. It is higher on
real faces than on the sealed strangers, and lower on decoys; who may try again finds out by how
much."""
HONEST = 600


@dataclass(frozen=True, eq=False, repr=False)
class Faces:
    """Embeddings (N, n), and what the contract expects of each, (N,)."""

    points: Floats
    means: Floats
    spreads: Floats

    @classmethod
    def of(cls, points: Floats, contract: Contract) -> "Faces":
        """Ask the contract what it expects of faces."""
        means, spreads = contract.expectation.statistics(points)
        return cls(points, means.astype(np.float32), spreads.astype(np.float32))

    def accepted(self, template: AffineSubspace, contract: Contract) -> dict[str, float]:
        """Share of the faces that each level accepts as the template's owner, in %."""
        near = self.points @ template.foot
        near = near + template.radius * np.linalg.norm(self.points @ template.basis.T, axis=1)
        z = (near - self.means) / self.spreads
        return {
            level.name: round(100 * float(np.mean(z >= level.threshold)), 2)
            for level in contract.calibrations[0].levels
        }


def ascend(
    start: AffineSubspace, climbed: Faces, watched: Faces, contract: Contract, limit: float | None
) -> AffineSubspace | None:
    """Climb on the share of ``climbed`` faces, while the score on ``watched`` ones is below."""
    rule = contract.calibrations[0].level(LEVEL)
    low, high = contract.template_foot_point_norm
    foot = torch.tensor(np.array(start.foot), requires_grad=True)
    basis = torch.tensor(np.array(start.basis), requires_grad=True)
    points, means, spreads = (
        torch.from_numpy(a) for a in (climbed.points, climbed.means, climbed.spreads)
    )
    others, other_means, other_spreads = (
        torch.from_numpy(a) for a in (watched.points, watched.means, watched.spreads)
    )
    optimiser = torch.optim.Adam([foot, basis], lr=0.01)
    best: tuple[float, AffineSubspace | None] = (-1.0, None)
    for number in range(ROUNDS):
        optimiser.param_groups[0]["lr"] = 0.01 * (1 - number / ROUNDS) + 0.0005
        span = torch.linalg.qr(basis.T)[0].T
        across = foot - span.T @ (span @ foot)
        length = torch.linalg.norm(across)
        p = across * (torch.clamp(length, low, high) / length)
        radius = torch.sqrt(1 - p @ p)
        rows = torch.randint(0, len(points), (BATCH,))
        near = points[rows] @ p + radius * torch.linalg.norm(points[rows] @ span.T, dim=1)
        z = (near - means[rows]) / spreads[rows]
        share = torch.sigmoid(z - rule.threshold).mean()
        loss, score = -torch.log(share + 1e-6), 0.0
        if limit is not None:
            similarities = others @ p + radius * torch.linalg.norm(others @ span.T, dim=1)
            tilted = TILT * (similarities - other_means) / other_spreads
            reached = (torch.logsumexp(tilted, 0) - np.log(len(others))) / TILT
            loss, score = loss + 30 * torch.relu(reached - limit + 0.02), reached.item()
        if (
            number > ROUNDS * 2 // 3
            and (limit is None or score <= limit)
            and share.item() > best[0] - 0.002
        ):
            subspace = AffineSubspace(
                p.detach().numpy(), np.ascontiguousarray(span.detach().numpy())
            )
            best = (share.item(), subspace)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    return best[1]


def starts(faces: Floats, honest: AffineSubspace, m: int) -> dict[str, AffineSubspace]:
    """Leading axes of faces, and an honest template."""
    mean = faces.mean(axis=0, dtype=np.float64)
    axes = np.linalg.svd(faces - mean, full_matrices=False)[2].astype(np.float64)
    return {"axes": canonical(mean, axes[:m]), "honest": honest}


def crops(data: Path, cache: Path) -> tuple[Floats, NDArray[np.str_]]:
    """Embeddings and names of LFW's aligned crops; ``cache`` saves a second extraction."""
    if not cache.exists():
        pack = ModelPack.load(data / "packs" / "w600k_mbf")
        folder = labelled_folder(data / "lfw" / "aligned112")
        extraction = Extractor(pack, cache=EmbeddingCache(), aligned=True).extract(folder.paths)
        np.savez(
            cache, emb=extraction.descriptors, names=[path.parent.name for path in extraction.paths]
        )
    stored = np.load(cache)
    return stored["emb"], stored["names"]


def stored(data: Path, name: str) -> tuple[Floats, NDArray[np.str_]]:
    """Embeddings and names of one file of embeddings."""
    file = np.load(data / "embeddings" / f"{name}.npz")
    names = [str(path).split("/")[0] for path in file["paths"]]
    return normalised(file["emb_mbf"].astype(np.float32)), np.array(names)


def main() -> None:
    """Print, as JSON lines, what each template accepts and whether the service takes it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, required=True, help="embeddings; made if absent")
    parser.add_argument("--decoys", choices=["lfw", "fairface"], default="lfw")
    parser.add_argument("--people", type=int, default=0, help="calibrate on so many; 0: half")
    parser.add_argument("--dim", type=int, default=64)
    args = parser.parse_args()

    descriptors, names = crops(args.data, args.cache)
    rest, rest_names = stored(args.data, "lfw_rest")
    own = rest[~np.isin(rest_names, names)]
    fairface = stored(args.data, "fairface_more")[0]
    people = np.random.default_rng(0).permutation(np.unique(names))
    half = people[: len(people) // 2]
    if args.people:
        many = np.unique(names[np.isin(names, half)], return_counts=True)
        half = many[0][many[1] >= 4][: args.people]
    calibrated = np.isin(names, half)
    enrolled = ~np.isin(names, people[: len(people) // 2])
    source = DecoyGenerator.fit(own if args.decoys == "lfw" else fairface)
    contract = calibrate(
        descriptors[calibrated],
        list(names[calibrated]),
        binding=Binding("00" * 32, {}, 512, Strategy.ADVERSARIAL, args.dim, source.source_id,
                        ROTATION_VERSION),
        source=source,
        options=CalibrationOptions(most_cells=4_000_000),
    ).contract  # fmt: skip
    limit = contract.template_stranger_score

    def score(template: AffineSubspace) -> float:
        return contract.nobody.score(template, contract.expectation)

    def lifted(rows: Floats, seed: str) -> SubspaceBatch:
        with Keystream.seeded(seed) as stream:
            return lift(
                rows, strategy=Strategy.ADVERSARIAL, m=args.dim, source=source, stream=stream
            )

    victims, first = np.unique(names[enrolled], return_index=True)
    means = normalised(
        np.stack(
            [descriptors[enrolled][names[enrolled] == victim][:3].mean(0) for victim in victims]
        )
    )
    strangers = Faces.of(descriptors[enrolled][first], contract)
    for kind, rows in (("lfw", means[:HONEST]), ("fairface", fairface[-HONEST:])):
        scores = np.array([score(template) for template in lifted(rows, kind)])
        report(honest=kind, mean=scores.mean(), spread=scores.std(), largest=scores.max(),
               limit=limit, refused=int((scores > limit).sum()), of=len(scores))  # fmt: skip
    rng = np.random.default_rng(1)
    with Keystream.seeded("attacker") as stream:
        drawn = source.draw(1000, 1, stream=stream)[:, 0]
    watched = {
        "faces and decoys": Faces.of(np.concatenate([own, drawn]), contract),
        "decoys": Faces.of(drawn, contract),
    }
    climbed = Faces.of(np.concatenate([own, own, fairface[:3000]]), contract)

    def tell(name: str, template: AffineSubspace | None) -> None:
        if template is not None:
            reached = score(template)
            report(template=name, score=reached, taken=reached <= limit,
                   accepted=strangers.accepted(template, contract))  # fmt: skip

    for number in range(2):
        for share in (1.0, 0.5):
            count = int((args.dim + 1) * share)
            chosen = own[rng.permutation(len(own))[:count]]
            points = np.concatenate([chosen, drawn[: args.dim + 1 - count]]).astype(np.float64)
            tell(f"{count} people, {number}", canonical(points[0], points[1:] - points[0]))
    for name, start in starts(climbed.points, lifted(means[:1], "start")[0], args.dim).items():
        tell(name, start)
        tell(f"{name}, climbed", ascend(start, climbed, strangers, contract, None))
        for kind, faces in watched.items():
            for margin in MARGINS[kind]:
                made = ascend(start, climbed, faces, contract, limit - margin)
                tell(f"{name}, climbed, own {kind} below the limit by {margin}", made)


def report(**facts: Any) -> None:
    """Print one line."""
    rounded = {k: round(float(v), 3) if isinstance(v, np.floating) else v for k, v in facts.items()}
    print(json.dumps(rounded), flush=True)


if __name__ == "__main__":
    main()
