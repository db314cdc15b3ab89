from typing import Any

import pytest

from attacks.errors import AuditError
from attacks.frontier import frontier, verification_accuracy
from attacks.outcomes import Scheme


def evaluated(strategy: str, decoys: str | None, dim: int, accuracy: float) -> dict[str, Any]:
    return {
        "dataset": "lfw",
        "strategy": strategy,
        "decoys": decoys,
        "dim": dim,
        "mode": "p2p" if strategy == "raw" else "p2s",
        "metric": "euclidean" if strategy == "raw" else "spherical",
        "threshold_search": "exact",
        "accuracy_mean": accuracy,
    }


def attacked(
    strategy: str, decoys: str | None, dim: int, accuracy: float, **more: Any
) -> dict[str, Any]:
    row = {
        "strategy": strategy,
        "decoys": decoys,
        "dim": dim,
        "attribute": "gender",
        "attacker": "logistic",
        "knowledge": "algorithm",
        "accuracy": accuracy,
        "chance": 0.6,
        "chance_of_predictions": 0.5,
        "ci_low": accuracy - 0.02,
        "ci_high": accuracy + 0.02,
        "held_out_strength": 0.1,
    }
    return row | more


RESULTS = {
    "rows": [
        evaluated("raw", None, 0, 0.995),
        evaluated("random", None, 16, 0.995),
        evaluated("adversarial", "generator", 16, 0.992),
        evaluated("adversarial", "generator", 32, 0.991),
        evaluated("adversarial", "generator", 64, 0.97),
    ]
}
ROWS = [
    attacked("raw", None, 0, 0.9),
    attacked("random", None, 16, 0.88),
    attacked("adversarial", "generator", 16, 0.6),
    attacked("adversarial", "generator", 32, 0.55),
    attacked("adversarial", "generator", 64, 0.5),
]


def recommended(rows: list[dict[str, Any]], *, most_lost: float = 0.005) -> list[tuple[Any, ...]]:
    points = frontier(RESULTS, rows, most_lost=most_lost)["points"]
    assert isinstance(points, list)
    return [(each["strategy"], each["dim"]) for each in points if each["recommended"]]


def test_the_least_leakage_within_the_loss_is_recommended() -> None:
    assert recommended(ROWS) == [("adversarial", 32)]
    assert recommended(ROWS, most_lost=0.05) == [("adversarial", 64)]


def test_within_the_interval_the_more_accurate_is_recommended() -> None:
    close = [*ROWS[:2], attacked("adversarial", "generator", 16, 0.565), *ROWS[3:]]
    assert recommended(close) == [("adversarial", 16)]


def test_no_scheme_is_recommended_where_all_lose_too_much() -> None:
    joined = frontier(
        {"rows": [RESULTS["rows"][0], evaluated("adversarial", "generator", 64, 0.9)]},
        ROWS,
        most_lost=0.005,
    )
    assert "No scheme loses" in str(joined["statement"])


def test_leakage_below_chance_counts() -> None:
    below = [*ROWS[:3], attacked("adversarial", "generator", 32, 0.1), ROWS[4]]
    assert recommended(below) == [("adversarial", 16)]


def test_who_knows_the_decoys_is_left_out_and_the_strongest_is_taken() -> None:
    rows = [
        *ROWS,
        attacked("adversarial", "generator", 32, 0.99, knowledge="decoys", attacker="strip"),
        attacked("adversarial", "generator", 32, 0.57, attacker="knn", held_out_strength=0.01),
    ]
    joined = frontier(RESULTS, rows, most_lost=0.005)
    points = joined["points"]
    assert isinstance(points, list)
    (point,) = (each for each in points if each["dim"] == 32)
    assert point["leaks"]["gender"]["attacker"] == "logistic"


def test_a_pool_is_not_recommended() -> None:
    results = {"rows": [*RESULTS["rows"], evaluated("hybrid", "pool", 2, 0.995)]}
    rows = [*ROWS, attacked("hybrid", "pool", 2, 0.5)]
    points = frontier(results, rows, most_lost=0.005)["points"]
    assert isinstance(points, list)
    assert [each["dim"] for each in points if each["recommended"]] == [32]
    assert any(each["decoys"] == "pool" for each in points)


@pytest.mark.parametrize("broken", [{}, {"rows": [{}]}, {"rows": [{"dataset": "lfw"}]}])
def test_a_broken_evaluation_is_said_before_anything_is_attacked(broken: dict[str, Any]) -> None:
    with pytest.raises(AuditError, match="results"):
        verification_accuracy(broken, [Scheme("adversarial", "generator", 16)])


def test_nothing_in_common_is_said() -> None:
    with pytest.raises(AuditError, match="no scheme in common"):
        frontier(RESULTS, [attacked("hybrid", "pool", 2, 0.6)], most_lost=0.005)
