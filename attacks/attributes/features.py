"""What an attacker computes from a template, so that a classifier can learn from it.

All of it is a function of the set 𝒟 alone: of the foot point p and of the projection DᵀD, never of
the stored basis D, which is random. A template lifted from unit embeddings with k decoys is the
affine hull of k + 1 faces; p is close to their mean, so a linear score of p is the mean of the
faces' scores, and x DᵀD y measures how the scores x and y spread over them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.faces import LabelledFaces
from attacks.attributes.neighbours import Attacked, votes
from templates.distances import Metric, Neighbours
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Codes = NDArray[np.int64]

# Shrinkage of the within-class covariance towards a multiple of the identity: measured on FairFace,
# accuracies differ by less than a point from 0.1 to 0.5.
_SHRINKAGE = 0.3
SHARES_AMONG = (10, 50)
"""Neighbours whose classes' shares the trained attackers see."""
MOST_NEIGHBOURS = max(SHARES_AMONG)


@dataclass(frozen=True, eq=False, repr=False)
class Axes:
    """Directions in which classes differ, found on raw labelled faces.

    Parameters
    ----------
    discriminants : (a, n) float32
        Unit rows: the linear discriminants of all attributes, one for an attribute of two classes,
        else one a class.
    prototypes : (c, n) float32
        Unit rows: the mean face of every class of every attribute.
    """

    discriminants: Array32
    prototypes: Array32

    @classmethod
    def fit(cls, faces: LabelledFaces) -> "Axes":
        """Find them; a class without a face gets the mean face and no direction.

        Notes
        -----
        Linear discriminant analysis, Σ⁻¹(μ_c − μ) with the shrunk within-class covariance Σ, in
        float64: closed, so that equal faces give equal axes.
        """
        x = faces.embeddings.astype(np.float64)
        discriminants, prototypes = [], []
        for attribute, names in faces.classes.items():
            codes = faces.labels[attribute]
            mean = x.mean(axis=0)
            means = np.stack(
                [
                    x[codes == c].mean(axis=0) if (codes == c).any() else mean
                    for c in range(len(names))
                ]
            )
            within = x - means[codes]
            covariance = within.T @ within / len(x)
            level = np.trace(covariance) / faces.n
            covariance[np.diag_indices(faces.n)] += _SHRINKAGE * level + 1e-12
            directions = np.linalg.solve(covariance, (means - mean).T).T
            discriminants.append(directions[1:] if len(names) == 2 else directions)
            prototypes.append(means)
        return cls(
            normalised(np.vstack(discriminants)).astype(np.float32),
            normalised(np.vstack(prototypes)).astype(np.float32),
        )


def features_of(
    attacked: Attacked,
    axes: Axes,
    neighbours: Mapping[Metric, Neighbours],
    gallery: LabelledFaces,
) -> Array32:
    """Compute the features (P, f) float32 of templates, or of raw embeddings.

    Parameters
    ----------
    attacked : (P, n) float32 or SubspaceBatch of P
    axes
        Found on faces that are in none of these templates, or their scores would be too sure.
    neighbours
        Of ``attacked`` in the gallery, ``MOST_NEIGHBOURS`` or more.
    gallery
        Labelled faces that are in none of these templates.

    Notes
    -----
    For discriminants w and prototypes μ: w·p, and wᵢ DᵀD wⱼ for every pair; ‖p‖; the similarity of
    the set to every prototype, p·μ + s‖Dμ‖, and s‖Dw‖; the shares of the classes among the
    neighbours, by metric, attribute and ``SHARES_AMONG``. Of a raw embedding, which has no D, those
    that are left.
    """
    shares = [
        votes(near, gallery.labels[attribute], len(names), k=k)
        for near in neighbours.values()
        for attribute, names in gallery.classes.items()
        for k in SHARES_AMONG
    ]
    if not isinstance(attacked, SubspaceBatch):
        parts = [attacked @ axes.discriminants.T, attacked @ axes.prototypes.T]
        return np.hstack([*parts, *shares]).astype(np.float32)
    feet, radii = attacked.feet, attacked.radii[:, None]
    spread = _inside(attacked, axes.discriminants)
    moments = spread.transpose(0, 2, 1) @ spread
    upper = np.triu_indices(spread.shape[2])
    widths = np.linalg.norm(_inside(attacked, axes.prototypes), axis=1)
    parts = [
        feet @ axes.discriminants.T,
        moments[:, upper[0], upper[1]],
        attacked.foot_norms[:, None],
        feet @ axes.prototypes.T + radii * widths,
        radii * np.linalg.norm(spread, axis=1),
    ]
    return np.hstack([*parts, *shares]).astype(np.float32)


def _inside(templates: SubspaceBatch, rows: Array32) -> Array32:
    """D x for all rows x, shape (P, m, rows)."""
    return np.asarray(templates.bases @ rows.T)
