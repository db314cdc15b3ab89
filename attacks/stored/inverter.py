"""A network that guesses the embedding from its template, trained on the attacker's own faces.

The network sees the set only: its guess is an affine function of what it says about points of the
subspace, projected back onto it, so another basis of the same template changes nothing. It starts
at the guess by second moments, so that it finds what is left beyond these. It needs the extra
``torch``.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from time import monotonic
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Guesses, attack
from attacks.bed import Testbed
from attacks.errors import AuditError
from attacks.outcomes import Knowledge, Property
from attacks.stored.second_moments import likeliest
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

if TYPE_CHECKING:
    from torch import Tensor, nn

ROUNDS = 3
"""Times that the network looks at its own guess."""
WIDTH = 512
MOST_EPOCHS = 60
PATIENCE = 6
"""Epochs without a better held-out cosine before training stops."""
LEAST_FACES, MOST_FACES = 40, 2_000
_BATCH = 64
_HELD_OUT = 0.15
_RATE = 1e-3

Lift = Callable[[NDArray[np.float32], int], SubspaceBatch]
Start = Callable[[SubspaceBatch], NDArray[np.floating]]


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge(generator=True, faces=True, lifting=True))
def inverter(bed: Testbed) -> Iterator[Guesses]:
    """What a trained network makes of the guess by second moments; it learnt on lifted faces."""
    if bed.effort.training_seconds is None:
        return
    network = bed.memory.get(("inverter", bed.m)) or train(
        bed.gallery[:MOST_FACES],
        lambda rows, epoch: bed.lift(rows, f"inverter, epoch {epoch}"),
        lambda batch: likeliest(bed, batch),
        seconds=bed.effort.training_seconds,
        seed=bed.seed,
    )
    bed.memory["inverter", bed.m] = network
    yield Guesses(
        network(bed.templates),
        details={
            "faces": min(len(bed.gallery), MOST_FACES),
            "epochs": network.epochs,
            "held_out_cosine_mean": network.held_out_cosine,
            "held_out_cosine_mean_at_the_start": network.held_out_start,
        },
    )


def need(module: str) -> ModuleType:
    """Import a module of the ``torch`` extra.

    Raises
    ------
    AuditError
        It is not installed; the message names the remedy.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise AuditError(
            f"a trained attack needs the package {error.name}, which is not installed: "
            'pip install "veilface[torch]"'
        ) from error


@dataclass(frozen=True, eq=False, repr=False)
class Inverter:
    """A trained network.

    Parameters
    ----------
    held_out_cosine, held_out_start
        Mean cosine to the truth of the guesses, and of what they start at, on faces of the attacker
        that it was not trained on.
    """

    rounds: "nn.ModuleList"
    start: Start
    epochs: int
    held_out_cosine: float
    held_out_start: float

    def __call__(self, batch: SubspaceBatch) -> NDArray[np.float64]:
        """Guess the embeddings, (T, k), of unit length."""
        torch = need("torch")
        starts = self.start(batch).astype(np.float32)
        out = np.empty((len(batch), batch.n))
        with torch.no_grad():
            for rows in _slices(len(batch)):
                parts = batch.feet[rows], batch.bases[rows], starts[rows]
                out[rows] = _guess(self.rounds, *map(torch.tensor, parts)).double().numpy()
        return normalised(out)


def _slices(count: int) -> Iterator[slice]:
    return (slice(start, start + _BATCH) for start in range(0, count, _BATCH))


def _networks(n: int) -> "nn.ModuleList":
    from torch import nn

    rounds = nn.ModuleList()
    for _ in range(ROUNDS):
        last = nn.Linear(WIDTH, n)
        nn.init.zeros_(last.weight)  # the first guess of all is the start
        nn.init.zeros_(last.bias)
        rounds.append(
            nn.Sequential(
                nn.Linear(3 * n + 1, WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH), nn.SiLU(), last
            )
        )
    return rounds


def _guess(rounds: "nn.ModuleList", feet: "Tensor", bases: "Tensor", starts: "Tensor") -> "Tensor":
    """Repeat x ← p + DᵀD (x + f([x, start, p, ‖p‖])), from the start; (B, k), of any length.

    The guess may lie inside the unit sphere: the less is known, the nearer it is to the foot
    point, whose direction is the best one on average.
    """
    import torch

    scale = float(np.sqrt(feet.shape[1]))
    norms = feet.norm(dim=1, keepdim=True)
    guess = starts
    for network in rounds:
        seen = torch.cat([guess * scale, starts * scale, feet * scale, norms], dim=1)
        moved = guess + network(seen) / scale
        inside = torch.einsum("bmn,bn->bm", bases, moved)
        guess = feet + torch.einsum("bm,bmn->bn", inside, bases)
    return guess


def train(
    faces: NDArray[np.float32],
    lift: Lift,
    start: Start,
    *,
    seconds: float,
    epochs: int = MOST_EPOCHS,
    seed: int,
) -> Inverter:
    """Train on faces that are lifted afresh in every epoch.

    Parameters
    ----------
    faces : (A, k) float32
        The attacker's, unit rows.
    lift
        Lifts faces as the service does, with other randomness for every number it is given.
    start
        Guesses of unit length that the network improves on.
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
    begun = float(np.einsum("ij,ij->i", start(test), held_out).mean())
    best, since, epoch = begun, 0, 0
    kept = {name: value.clone() for name, value in rounds.state_dict().items()}
    while epoch < epochs and since < PATIENCE and monotonic() - started < seconds:
        epoch += 1
        batch = lift(training, epoch)
        starts = start(batch).astype(np.float32)
        shuffled = rng.permutation(len(training))
        for rows in _slices(len(training)):
            chosen = shuffled[rows]
            parts = batch.feet[chosen], batch.bases[chosen], starts[chosen]
            guess = _guess(rounds, *map(torch.tensor, parts))
            truth = torch.tensor(training[chosen])
            loss = 1 - torch.nn.functional.cosine_similarity(guess, truth, dim=1).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        trained = Inverter(rounds, start, epoch, 0, 0)
        now = float(np.einsum("ij,ij->i", trained(test), held_out).mean())
        since += 1
        if now > best:
            best, since = now, 0
            kept = {name: value.clone() for name, value in rounds.state_dict().items()}
    rounds.load_state_dict(kept)
    return Inverter(rounds, start, epoch, best, begun)
