"""Classifiers that an attacker trains on faces that it lifted itself.

Each is given the features of templates with the labels of the faces in them, and gives a score to
every class of a template that it has not seen.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.attributes.features import Features

Codes = NDArray[np.int64]
Scores = NDArray[np.float64]

# Of the logistic regression on standardised features: little for few faces, as many of the
# features say the same, more for many.
_LOGISTIC_CS = (1e-3, 1e-2, 1e-1)
_KERNEL_WIDTHS = (0.1, 0.3, 1.0)
_RIDGE = 1.0
_KERNEL_ROWS = 2048


@dataclass(frozen=True, eq=False, repr=False)
class TrainingSet:
    """What an attacker learns from, and what it chooses by.

    Parameters
    ----------
    features, labels
        Of templates that the attacker lifted itself; labels (P,) int64 by attribute.
    held_out_features, held_out_labels
        Of others that it lifted, and did not learn from: what it chooses its settings by.
    classes
        Number of classes of every attribute.
    """

    features: Features
    labels: Mapping[str, Codes]
    held_out_features: Features
    held_out_labels: Mapping[str, Codes]
    classes: Mapping[str, int]


class Logistic:
    """Multinomial logistic regression on the derived features.

    Its regularisation is chosen for each attribute by the held-out templates.
    """

    def __init__(self, training: TrainingSet) -> None:
        from sklearn.linear_model import LogisticRegression

        self._scale = _Scale(training.features.derived)
        rows = self._scale(training.features.derived)
        held_out = self._scale(training.held_out_features.derived)
        self._classes = training.classes
        self._models: dict[str, Any] = {}
        for name, codes in training.labels.items():
            if len(np.unique(codes)) < 2:
                continue
            best = -1.0
            for c in _LOGISTIC_CS:
                model = LogisticRegression(C=c, max_iter=1000).fit(rows, codes)
                score = float(model.score(held_out, training.held_out_labels[name]))
                if score > best:  # of equals the more regularised
                    best, self._models[name] = score, model

    def scores(self, features: Features) -> dict[str, Scores]:
        """Score every class, by attribute (P, classes); the highest is the prediction."""
        return _probabilities(self._models, self._scale(features.derived), self._classes)


class KernelMachine:
    """Least-squares support vector machine with a Gaussian kernel on all features.

    Notes
    -----
    The foot point and the derived features each have a mean square of 1 in the kernel's distance.
    One factorisation serves all attributes, and the width is chosen for each by the held-out
    templates.

    References
    ----------
    J. A. K. Suykens & J. Vandewalle, "Least squares support vector machine classifiers", Neural
    Processing Letters 9 (1999).
    """

    def __init__(self, training: TrainingSet) -> None:
        from sklearn.kernel_ridge import KernelRidge

        self._scale = _Scale(training.features.derived)
        self._length = float(np.sqrt(np.mean(np.sum(training.features.foot**2, axis=1)))) or 1.0
        rows, held_out = self._joined(training.features), self._joined(training.held_out_features)
        targets = np.hstack(
            [np.eye(count)[training.labels[name]] for name, count in training.classes.items()]
        )
        self._mean = targets.mean(axis=0)
        self._columns: dict[str, slice] = {}
        for name, count in training.classes.items():
            start = sum(part.stop - part.start for part in self._columns.values())
            self._columns[name] = slice(start, start + count)
        best: dict[str, float] = {}
        self._machines: dict[str, Any] = {}
        for width in _KERNEL_WIDTHS:
            # The ridge of 1 keeps the condition number below the number of rows: enough digits.
            machine = KernelRidge(alpha=_RIDGE, kernel="rbf", gamma=width)
            machine.fit(rows, (targets - self._mean).astype(np.float32))
            scores = machine.predict(held_out) + self._mean
            for name, columns in self._columns.items():
                predicted = np.argmax(scores[:, columns], axis=1)
                score = float(np.mean(predicted == training.held_out_labels[name]))
                if score > best.get(name, -1.0):
                    best[name], self._machines[name] = score, machine

    def scores(self, features: Features) -> dict[str, Scores]:
        """Score every class, by attribute (P, classes); the highest is the prediction."""
        rows = self._joined(features)
        out = {
            name: np.empty((len(rows), part.stop - part.start))
            for name, part in self._columns.items()
        }
        for start in range(0, len(rows), _KERNEL_ROWS):
            tile = slice(start, start + _KERNEL_ROWS)
            for machine in set(self._machines.values()):
                predicted = machine.predict(rows[tile]) + self._mean
                for name, columns in self._columns.items():
                    if self._machines[name] is machine:
                        out[name][tile] = predicted[:, columns]
        return out

    def _joined(self, features: Features) -> NDArray[np.float32]:
        derived = self._scale(features.derived) / np.sqrt(features.derived.shape[1])
        return np.hstack([features.foot / np.float32(self._length), derived]).astype(np.float32)


TRAINED: Mapping[str, type[Logistic | KernelMachine]] = {
    "logistic": Logistic,
    "svm": KernelMachine,
}
"""Attackers by their names in the report."""


class _Scale:
    """Standardisation learnt from some rows."""

    def __init__(self, rows: NDArray[np.float32]) -> None:
        self._mean = rows.mean(axis=0, dtype=np.float64).astype(np.float32)
        spread = rows.std(axis=0, dtype=np.float64)
        # A feature that is the same on all rows says nothing, and divided by itself would be noise.
        self._spread = np.where(spread > 1e-6, spread, np.inf).astype(np.float32)

    def __call__(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray((rows - self._mean) / self._spread, dtype=np.float32)


def _probabilities(
    models: Mapping[str, Any], rows: NDArray[np.float32], classes: Mapping[str, int]
) -> dict[str, Scores]:
    """Class probabilities; 0 of a class that was not among the training labels."""
    out = {name: np.zeros((len(rows), count)) for name, count in classes.items()}
    for name, model in models.items():
        out[name][:, model.classes_] = model.predict_proba(rows)
    return out
