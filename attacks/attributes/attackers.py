"""The classifier that an attacker trains on faces that it lifted itself.

It is given the features of templates with the labels of the faces in them, and gives a score to
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
_LOGISTIC_CS = (1e-4, 1e-3, 1e-2, 1e-1)


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
    """Multinomial logistic regression on standardised features, one for each attribute.

    Its regularisation is chosen for each attribute by the held-out templates.

    Parameters
    ----------
    foot
        Learn from the foot points, or the guesses of the embeddings, as well where that is better
        on the held-out templates.
    """

    def __init__(self, training: TrainingSet, *, foot: bool = False) -> None:
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        self._classes = training.classes
        self._models: dict[str, tuple[bool, Any]] = {}
        best = dict.fromkeys(training.labels, -1.0)
        for with_foot in (False, True) if foot else (False,):
            rows = _rows(training.features, with_foot)
            held_out = _rows(training.held_out_features, with_foot)
            for name, codes in training.labels.items():
                for c in _LOGISTIC_CS if len(np.unique(codes)) > 1 else ():
                    model = make_pipeline(StandardScaler(), LogisticRegression(C=c, max_iter=1000))
                    model.fit(rows, codes)
                    score = float(model.score(held_out, training.held_out_labels[name]))
                    if score > best[name]:  # of equals the more regularised
                        best[name], self._models[name] = score, (with_foot, model)

    def scores(self, features: Features) -> dict[str, Scores]:
        """Score every class, by attribute (P, classes); the highest is the prediction.

        0 of a class that was not among the training labels.
        """
        out = {name: np.zeros((len(features), count)) for name, count in self._classes.items()}
        for name, (foot, model) in self._models.items():
            out[name][:, model.classes_] = model.predict_proba(_rows(features, foot))
        return out


def _rows(features: Features, foot: bool) -> NDArray[np.float64]:
    parts = [features.foot] if foot else []
    return np.hstack([*parts, features.derived]).astype(np.float64)
