"""A network that guesses the descriptor from its template, trained on the attacker's own faces.

The network sees the set only: its guess is an affine function of what it says about points of the
subspace, projected back onto it, so another basis of the same template changes nothing. It starts
as the foot point, the best guess of an attacker that knows nothing about faces.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.learned.extra import need
from attacks.outcomes import AttackOutcome, Knowledge
from attacks.recovery import recovery_outcome
from attacks.system import System
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

if TYPE_CHECKING:
    from torch import Tensor, nn

ROUNDS = 3
"""Times that the network looks at its own guess."""
WIDTH = 512
SECONDS = 120.0
MOST_EPOCHS = 60
PATIENCE = 6
"""Epochs without a better held-out cosine before training stops."""
LEAST_FACES = 40
_BATCH = 64
_HELD_OUT = 0.15
_RATE = 1e-3

Lift = Callable[[NDArray[np.float32], int], SubspaceBatch]


@dataclass(frozen=True, eq=False, repr=False)
class Inverter:
    """A trained network.

    Parameters
    ----------
    held_out_cosine, held_out_foot
        Mean cosine to the truth of the guesses, and of the foot points, on faces of the attacker
        that it was not trained on.
    """

    rounds: "nn.ModuleList"
    epochs: int
    held_out_cosine: float
    held_out_foot: float

    def __call__(self, batch: SubspaceBatch) -> NDArray[np.float64]:
        """Guess the descriptors, (T, n), of unit length."""
        torch = need("torch")
        out = np.empty((len(batch), batch.n))
        with torch.no_grad():
            for rows in _slices(len(batch)):
                feet, bases = (
                    torch.tensor(batch.feet[rows]),
                    torch.tensor(batch.bases[rows]),
                )
                out[rows] = _guess(self.rounds, feet, bases).double().numpy()
        return normalised(out)


def _slices(count: int) -> Iterator[slice]:
    return (slice(start, start + _BATCH) for start in range(0, count, _BATCH))


def _networks(n: int) -> "nn.ModuleList":
    from torch import nn

    rounds = nn.ModuleList()
    for _ in range(ROUNDS):
        last = nn.Linear(WIDTH, n)
        nn.init.zeros_(last.weight)  # the first guess of all is the foot point
        nn.init.zeros_(last.bias)
        rounds.append(
            nn.Sequential(
                nn.Linear(2 * n + 1, WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH), nn.SiLU(), last
            )
        )
    return rounds


def _guess(rounds: "nn.ModuleList", feet: "Tensor", bases: "Tensor") -> "Tensor":
    """Repeat x ← p + DᵀD (x + f([x, p, ‖p‖])), from x = p; (B, n), not of unit length.

    The guess may lie inside the unit sphere: the less is known, the nearer it is to the foot
    point, whose direction is the best one on average.
    """
    import torch

    n = feet.shape[1]
    scale = float(np.sqrt(n))
    norms = feet.norm(dim=1, keepdim=True)
    guess = feet
    for network in rounds:
        moved = guess + network(torch.cat([guess * scale, feet * scale, norms], dim=1)) / scale
        inside = torch.einsum("bmn,bn->bm", bases, moved)
        guess = feet + torch.einsum("bm,bmn->bn", inside, bases)
    return guess


def train(
    faces: NDArray[np.float32],
    lift: Lift,
    *,
    seconds: float = SECONDS,
    epochs: int = MOST_EPOCHS,
    seed: int,
) -> Inverter:
    """Train on faces that are lifted afresh in every epoch.

    Parameters
    ----------
    faces : (A, n) float32
        The attacker's, unit rows.
    lift
        Lifts faces as the service does, with other randomness for every number it is given.
    seconds, epochs
        Training ends with the first epoch that ends after so many seconds, after so many epochs,
        or where the held-out cosine rises no more. Figures repeat under one seed where it is not
        the time that ends it.

    Raises
    ------
    AuditError
        Too few faces, or torch is not installed.
    """
    torch = need("torch")
    if len(faces) < LEAST_FACES:
        raise AuditError(f"a trained inverter needs {LEAST_FACES} faces or more, not {len(faces)}")
    started = monotonic()
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(faces))
    count = max(1, int(_HELD_OUT * len(faces)))
    held_out, training = faces[order[:count]], faces[order[count:]]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        rounds = _networks(faces.shape[1])
    optimiser = torch.optim.AdamW(rounds.parameters(), lr=_RATE, weight_decay=1e-2)
    test = lift(held_out, 0)
    foot = float(_cosines(test.feet, held_out).mean())
    best, since, epoch = foot, 0, 0
    kept = {name: value.clone() for name, value in rounds.state_dict().items()}
    while epoch < epochs and since < PATIENCE and monotonic() - started < seconds:
        epoch += 1
        batch = lift(training, epoch)
        shuffled = rng.permutation(len(training))
        for rows in _slices(len(training)):
            chosen = shuffled[rows]
            truth = torch.tensor(training[chosen])
            guess = _guess(
                rounds, torch.tensor(batch.feet[chosen]), torch.tensor(batch.bases[chosen])
            )
            loss = 1 - torch.nn.functional.cosine_similarity(guess, truth, dim=1).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        now = float(_cosines(Inverter(rounds, epoch, 0, 0)(test), held_out).mean())
        since += 1
        if now > best:
            best, since = now, 0
            kept = {name: value.clone() for name, value in rounds.state_dict().items()}
    rounds.load_state_dict(kept)
    return Inverter(rounds, epoch, best, foot)


def _cosines(rows: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(rows, axis=1) * np.linalg.norm(truth, axis=1)
    return np.asarray(np.einsum("ij,ij->i", rows, truth) / np.maximum(lengths, 1e-12))


def invert(
    system: System, *, seconds: float = SECONDS, epochs: int = MOST_EPOCHS, seed: int
) -> tuple[Inverter, list[AttackOutcome]]:
    """Train an inverter for the system's scheme, and let it guess the victims' descriptors.

    Returns
    -------
    inverter
        For further attacks on the same templates.
    outcomes
        One, named ``inverter``. Its details hold the cosine of the foot point beside the guess's:
        the better of the two is what an attacker uses.
    """
    inverter = train(
        system.attacker,
        lambda rows, epoch: system.lift(rows, f"inverter, epoch {epoch}"),
        seconds=seconds,
        epochs=epochs,
        seed=seed,
    )
    foot = _cosines(system.templates.feet, system.victims.enrolled)
    return inverter, [
        recovery_outcome(
            system,
            inverter(system.templates),
            attack="inverter",
            knowledge=Knowledge.ALGORITHM,
            assumption="One template, how templates are lifted, and faces of other people, lifted "
            "to train a network that maps a template to its embedding; success is a match of "
            "the guess with a fresh photo",
            details={
                "faces": len(system.attacker),
                "epochs": inverter.epochs,
                "foot_point_cosine_to_truth_mean": float(foot.mean()),
                "held_out_cosine_mean": inverter.held_out_cosine,
                "held_out_foot_point_cosine_mean": inverter.held_out_foot,
            },
        )
    ]
