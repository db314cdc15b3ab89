"""How well generated embeddings are told from real ones, by an attacker who has the generator."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import StratifiedKFold
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVC

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.float32]
Classifier = tuple[Callable[[Array], Array], Callable[[], object]]


@dataclass(frozen=True)
class Coordinates:
    """What a well-informed attacker looks at: the generator's own principal axes."""

    mean: Array
    axes: Array
    deviations: Array

    @classmethod
    def of(cls, rows: Rows) -> "Coordinates":
        """Moments of the fitted embeddings, which the generator gives away."""
        x = rows.astype(np.float64)
        values, vectors = np.linalg.eigh(np.cov(x, rowvar=False))
        return cls(x.mean(axis=0), vectors[:, ::-1].T, np.sqrt(np.maximum(values[::-1], 1e-12)))

    def whitened(self, rows: npt.NDArray[np.floating]) -> Array:
        """Coordinates of unit variance, shape (N, n)."""
        return (rows - self.mean) @ self.axes.T / self.deviations


def classifiers(
    frame: Coordinates,
) -> dict[str, tuple[Callable[[Array], Array], Callable[[], object]]]:
    """Name → (features of embeddings, classifier)."""

    def scaled(estimator: object) -> object:
        return make_pipeline(StandardScaler(), estimator)

    def with_squares(x: Array) -> Array:
        z = frame.whitened(x)
        return np.hstack([z, np.minimum(z**2, 30.0)])

    def energies(x: Array) -> Array:
        z = frame.whitened(x).reshape(len(x), -1, 16)
        return np.hstack(
            [
                0.5 * np.log((z**2).mean(axis=2)),
                np.abs(z).mean(axis=2),
                np.minimum(z**4, 300).mean(axis=2),
                z.reshape(len(x), -1)[:, :64],
            ]
        )

    def mlp() -> object:
        return scaled(
            MLPClassifier((128,), alpha=3.0, max_iter=40, early_stopping=True, random_state=0)
        )

    def boosting() -> object:
        return HistGradientBoostingClassifier(
            max_iter=120, learning_rate=0.07, max_leaf_nodes=8, random_state=0
        )

    def as_given(x: Array) -> Array:
        return x

    return {
        "logistic": (as_given, lambda: scaled(LogisticRegression(C=1e-3, max_iter=300))),
        "svm": (lambda x: x * np.sqrt(x.shape[1]), lambda: SVC(C=3.0)),
        "mlp": (as_given, mlp),
        "boosting, energies": (energies, boosting),
        "logistic, squares": (
            with_squares,
            lambda: scaled(LogisticRegression(C=1e-3, max_iter=300)),
        ),
        "svm, 8 axes": (lambda x: frame.whitened(x)[:, :8], lambda: scaled(SVC(C=1.0))),
        "svm, whitened": (frame.whitened, lambda: scaled(SVC(C=3.0))),
        "mlp, whitened": (frame.whitened, mlp),
        "quadratic, whitened": (
            frame.whitened,
            lambda: QuadraticDiscriminantAnalysis(reg_param=0.3),
        ),
    }


def area(
    real: Rows, generated: Rows, features: Callable[[Array], Array], make: Callable[[], object]
) -> tuple[float, float, float]:
    """AUC of three-fold cross-validated scores, with a 95 % bootstrap interval."""
    x = features(np.vstack([real, generated]).astype(np.float64))
    y = np.repeat([0, 1], [len(real), len(generated)])
    scores = np.empty(len(y))
    for train, test in StratifiedKFold(3, shuffle=True, random_state=0).split(x, y):
        model = make().fit(x[train], y[train])  # type: ignore[attr-defined]
        if hasattr(model, "decision_function"):
            scores[test] = model.decision_function(x[test])
        else:
            scores[test] = model.predict_proba(x[test])[:, 1]
    rng = np.random.default_rng(0)
    picks = [rng.integers(len(y), size=len(y)) for _ in range(200)]
    spread = [roc_auc_score(y[p], scores[p]) for p in picks]
    low, high = np.percentile(spread, [2.5, 97.5])
    return float(roc_auc_score(y, scores)), float(low), float(high)


def areas(real: Rows, generated: Rows, fitted: Rows) -> dict[str, list[float]]:
    """AUC and its interval for every classifier; ``fitted`` is what the generator was fitted to."""
    return {
        name: [round(v, 3) for v in area(real, generated, *pair)]
        for name, pair in classifiers(Coordinates.of(fitted)).items()
    }
