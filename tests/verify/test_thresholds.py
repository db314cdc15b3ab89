import numpy as np
import pytest
from numpy.typing import NDArray

from templates.errors import ContractError
from verify import CalibrationOptions
from verify.thresholds import (
    Genuine,
    Impostors,
    bound_when_set_anew,
    level_name,
    make_level,
    resolved_targets,
)


def impostors_of(scores: NDArray[np.floating]) -> Impostors:
    """Of one person's probes, a row each, with everybody else."""
    cells = np.atleast_2d(scores).astype(np.float32)
    met = np.arange(1, cells.shape[1] + 1)[None]
    owners = np.zeros(len(cells), dtype=np.int64)
    return Impostors(cells, owners, met, len(cells), people=met.size + 1)


def all_of(people: int) -> Impostors:
    """One probe of each person with everybody else, by chance."""
    everybody = np.arange(people)
    cells = np.random.default_rng(0).normal(size=(people, people)).astype(np.float32)
    np.fill_diagonal(cells, -np.inf)
    return Impostors(cells, everybody, everybody[None], people, people)


def test_levels_are_refused_that_the_data_cannot_resolve() -> None:
    kept, refused = resolved_targets(all_of(100), [1e-3, 1e-2])
    assert kept == [1e-2]
    assert "FMR 0.001 is not resolved by 9900 impostor trials of 4950 pairs" in refused[0]
    few_pairs = impostors_of(np.zeros((400, 2_999)))
    assert (few_pairs.trials, few_pairs.person_pairs) == (400 * 2_999, 2_999)
    assert "of 2999 pairs of people" in resolved_targets(few_pairs, [1e-3])[1][0]


def test_a_threshold_that_one_person_decides_does_not_hold_when_set_anew() -> None:
    """Of 50 people, one near everybody: a third of the resamples have another threshold."""
    impostors = all_of(50)
    assert 0.02 < bound_when_set_anew(impostors, 0.02) < 0.04
    impostors.cells[0] += 9
    impostors.cells[:, 0] += 9
    assert bound_when_set_anew(impostors, 0.02) > 0.04


def test_probes_that_are_refused_count_for_the_frr_only() -> None:
    impostors = impostors_of(np.array([3.0, 1.0, 3.0, -np.inf, 2.0]))
    genuine = Genuine(
        np.array([4.0, 1.0, 4.0, 1.9, 4.0, 1.0], dtype=np.float32),
        np.arange(6) % 4,
        np.array([1, 1, 3, 3, 3, 3]),
        refused=np.array([False, False, False, False, True, True]),
    )
    level = make_level("fmr-1e-2", 1e-2, 2.0, impostors, genuine, seed=0)
    assert (level.fnmr.errors, level.fnmr.trials) == (2, 4)
    fnmr = {k: (rate.errors, rate.trials) for k, rate in level.fnmr_by_photos.items()}
    assert fnmr == {1: (1, 2), 3: (1, 2)}
    frr = {k: (rate.errors, rate.trials) for k, rate in level.frr_by_photos.items()}
    assert frr == {1: (1, 2), 3: (3, 4)}


def test_level_names() -> None:
    assert [level_name(10.0**-k) for k in (2, 3, 6)] == ["fmr-1e-2", "fmr-1e-3", "fmr-1e-6"]
    # Rounded to a power of ten, 3e-3 would carry the name of the stricter 1e-3.
    for target in (3e-3, 1.001e-3, 1.0, 10.0, 0.0, -1e-3, float("nan")):
        with pytest.raises(ContractError, match="powers of ten"):
            level_name(target)
        with pytest.raises(ContractError, match="powers of ten"):
            CalibrationOptions(targets=(1e-2, target))
