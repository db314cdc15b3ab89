"""A small network that draws a face from a descriptor: the paper's direct inversion, for faces.

Trained on images that the auditor gives, and kept in memory only.
"""

from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.learned.extra import need
from templates.space.embedding import normalised

if TYPE_CHECKING:
    from torch import nn

SIZE = 64
"""Side of the drawn images, pixels."""
SECONDS = 180.0
MOST_EPOCHS = 80
LEAST_IMAGES = 32
_CHANNELS = (192, 96, 48, 24)
_BATCH = 32
_RATE = 2e-3

Images = NDArray[np.uint8]


@dataclass(frozen=True, eq=False, repr=False)
class Decoder:
    """A trained network, from n numbers to an RGB image.

    Parameters
    ----------
    network
        (B, n) → (B, 3, SIZE, SIZE), values in [0, 1].
    """

    network: "nn.Sequential"
    epochs: int

    def __call__(self, descriptors: NDArray[np.floating]) -> Images:
        """Draw a face for every direction, (B, SIZE, SIZE, 3)."""
        torch = need("torch")
        rows = _directions(descriptors)
        drawn = []
        with torch.no_grad():
            for start in range(0, len(rows), _BATCH):
                faces = self.network(torch.tensor(rows[start : start + _BATCH]))
                drawn.append(faces.permute(0, 2, 3, 1).numpy())
        shown = np.concatenate(drawn) if drawn else np.empty((0, SIZE, SIZE, 3))
        return np.asarray(np.rint(shown * 255), dtype=np.uint8)


def _directions(descriptors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rows of length √n, so that their entries are of order one."""
    rows = normalised(np.asarray(descriptors, dtype=np.float64))
    return np.ascontiguousarray(rows * np.sqrt(rows.shape[1]), dtype=np.float32)


def resized(images: Images, size: int) -> Images:
    """Images (B, size, size, 3), by area where they shrink."""
    if images.shape[1:3] == (size, size):
        return images
    import cv2

    how = cv2.INTER_AREA if images.shape[1] > size else cv2.INTER_CUBIC
    return np.stack([cv2.resize(image, (size, size), interpolation=how) for image in images])


def _network(n: int) -> "nn.Sequential":
    from torch import nn

    first, *others = _CHANNELS
    layers: list[nn.Module] = [
        nn.Linear(n, first * 16),
        nn.Unflatten(1, (first, 4, 4)),
        nn.BatchNorm2d(first),
        nn.SiLU(),
    ]
    before = first
    for channels in others:
        layers += [
            nn.ConvTranspose2d(before, channels, 4, stride=2, padding=1),
            nn.BatchNorm2d(channels),
            nn.SiLU(),
        ]
        before = channels
    layers += [nn.ConvTranspose2d(before, 3, 4, stride=2, padding=1), nn.Sigmoid()]
    return nn.Sequential(*layers)


def train_decoder(
    images: Images,
    descriptors: NDArray[np.floating],
    *,
    seconds: float = SECONDS,
    epochs: int = MOST_EPOCHS,
    seed: int,
) -> Decoder:
    """Train on aligned faces and their descriptors.

    Parameters
    ----------
    images : (A, s, s, 3) uint8
        RGB, aligned.
    descriptors : (A, n) floating
        Of the same faces.
    seconds, epochs
        Training ends with whichever is used up first. Figures repeat under one seed where it is
        not the time.

    Raises
    ------
    AuditError
        Too few images, descriptors that do not fit, or torch is not installed.
    """
    torch = need("torch")
    if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
        raise AuditError("a decoder is trained on RGB images, uint8 of shape (A, s, s, 3)")
    if len(images) != len(descriptors) or len(images) < LEAST_IMAGES:
        raise AuditError(
            f"a decoder needs {LEAST_IMAGES} images or more and an embedding of each, seen "
            f"{len(images)} and {len(descriptors)}"
        )
    started = monotonic()
    rng = np.random.default_rng(seed)
    small = torch.tensor(np.ascontiguousarray(resized(images, SIZE).transpose(0, 3, 1, 2)))
    rows = torch.tensor(_directions(descriptors))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network(rows.shape[1])
    steps = -(-len(images) // _BATCH)
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=1e-3)
    epoch = 0
    network.train()
    while epoch < epochs and (epoch == 0 or monotonic() - started < seconds):
        # The rate falls with the share of the budget that is used, whichever budget it is.
        used = max(epoch / epochs, (monotonic() - started) / seconds)
        for group in optimiser.param_groups:
            group["lr"] = _RATE * (0.02 + 0.98 * (1 - min(used, 1.0)))
        for chosen in np.array_split(rng.permutation(len(images)), steps):
            index = torch.tensor(chosen)
            truth = small[index].float() / 255
            if rng.random() < 0.5:
                truth = truth.flip(3)  # ArcFace descriptors hardly change with the mirror image
            drawn = network(rows[index])
            loss = torch.nn.functional.l1_loss(drawn, truth)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        epoch += 1
    network.eval()
    return Decoder(network, epoch)
