"""Faces drawn from templates: how like the person they are, to the eye and to the service."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.learned.decoder import MOST_EPOCHS, SIZE, Images, resized, train_decoder
from attacks.learned.extra import need
from attacks.outcomes import (
    CONTROL,
    RAW_SCHEME,
    AttackOutcome,
    Knowledge,
    Leaked,
    Property,
    unproven,
)
from attacks.recovery import fmr_of
from attacks.system import System
from templates.contract.canonical import Json
from verify.metrics import rate

Embed = Callable[[Images], NDArray[np.float32]]
"""uint8 (B, s, s, 3) RGB crops of the embedder's size → (B, n) unit rows."""

RAW, FOOT, NOISE = "raw embedding", "foot point", "noise"
LEAST_CONTROL = 0.5
"""Share of raw descriptors that must be drawn well enough to match, for a failure to mean much."""


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction:
    """Drawn faces, scored.

    Parameters
    ----------
    ssim, psnr : (V,) float64
        Structural similarity, and peak signal to noise ratio in dB, to a photo of the person, both
        at the size of the drawing.
    cosines : (V,) float64
        Of the drawn face's descriptor and a fresh photo's.
    """

    ssim: NDArray[np.float64]
    psnr: NDArray[np.float64]
    cosines: NDArray[np.float64]

    def details(self) -> dict[str, Json]:
        """Means over the people."""
        return {
            "ssim_mean": float(self.ssim.mean()),
            "psnr_mean_db": float(self.psnr.mean()),
            "cosine_to_fresh_mean": float(self.cosines.mean()),
        }


def score_images(
    drawn: Images, photos: Images, fresh: NDArray[np.floating], *, embed: Embed
) -> Reconstruction:
    """Score one drawn face a person.

    Parameters
    ----------
    drawn : (V, d, d, 3) uint8
    photos : (V, s, s, 3) uint8
        Aligned, of the embedder's size.
    fresh : (V, n) floating
        Unit descriptors of other photos of the same people.
    """
    similarity = need("skimage.metrics").structural_similarity
    small = resized(photos, drawn.shape[1])
    errors = ((drawn.astype(np.float64) - small) ** 2).mean(axis=(1, 2, 3))
    rows = embed(resized(drawn, photos.shape[1])).astype(np.float64)
    return Reconstruction(
        ssim=np.array(
            [
                similarity(one_drawn, one_photo, channel_axis=2, data_range=255)
                for one_drawn, one_photo in zip(drawn, small, strict=True)
            ]
        ),
        psnr=10 * np.log10(255.0**2 / np.maximum(errors, 1e-9)),
        cosines=np.einsum("ij,ij->i", rows, fresh),
    )


def reconstruct(
    system: System,
    images: Images,
    descriptors: NDArray[np.floating],
    photos: Images,
    *,
    embed: Embed,
    guesses: Mapping[str, NDArray[np.floating]],
    seconds: float,
    epochs: int = MOST_EPOCHS,
    seed: int,
) -> list[AttackOutcome]:
    """Train a decoder on the auditor's images, and draw the victims from their templates.

    Parameters
    ----------
    images, descriptors : (A, s, s, 3) uint8, (A, n) floating
        Aligned faces of people who are not victims.
    photos : (V, s, s, 3) uint8
        An aligned photo of each victim, of the embedder's size, to compare with: not the fresh
        one.
    guesses
        Further guesses of the victims' descriptors, by name, (V, n): such as an inverter's.

    Returns
    -------
    list of AttackOutcome
        Named ``reconstruction``: from the raw descriptor (a control, which must succeed), the
        foot point, every further guess, and noise (a control, which must not). No image is kept.

    Raises
    ------
    AuditError
        Arrays that do not fit, or the ``torch`` extra is not installed.
    """
    count = len(system.victims)
    if len(photos) != count or any(len(rows) != count for rows in guesses.values()):
        raise AuditError(f"{count} victims need a photo and a guess each")
    need("skimage.metrics")  # before the training rather than after it
    decoder = train_decoder(images, descriptors, seconds=seconds, epochs=epochs, seed=seed)
    noise = np.random.default_rng(seed).normal(size=system.victims.enrolled.shape)
    inputs: dict[str, NDArray[np.floating]] = {
        RAW: system.victims.enrolled,
        FOOT: system.templates.feet,
        **guesses,
        NOISE: noise,
    }
    outcomes = []
    reason: str | None = None
    for name, rows in inputs.items():
        scored = score_images(decoder(rows), photos, system.victims.fresh, embed=embed)
        hits = scored.cosines >= system.raw_thresholds[system.level.name]
        control = name in (RAW, NOISE)
        outcomes.append(
            AttackOutcome(
                attack="reconstruction",
                variant=name,
                breaks=Property.IRREVERSIBILITY,
                leaked=Leaked.HOLDER_KEYS,
                knowledge=Knowledge.ALGORITHM,
                assumption=f"A decoder trained on {len(images)} faces of other people draws the "
                f"face from the {name}; success is a raw match of the drawn face with a fresh "
                "photo" + (" (a control)" if control else ""),
                scheme=RAW_SCHEME if name == RAW else system.scheme,
                level=system.level.name,
                measured=rate(int(np.count_nonzero(hits)), count),
                chance=fmr_of(system.level),
                unjudged=CONTROL if control else reason,
                details={
                    **scored.details(),
                    "epochs": decoder.epochs,
                    "images": len(images),
                    "size": SIZE,
                },
            )
        )
        if name == RAW:  # the first
            drawn = "half of the raw embeddings drawn well enough to match"
            reason = unproven(outcomes[0], drawn, least=LEAST_CONTROL)
    return outcomes
