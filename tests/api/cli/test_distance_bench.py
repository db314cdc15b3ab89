"""The measurement of `veilface bench distances`: what it times, not how long that takes."""

import numpy as np
import pytest

from api.cli import distance_bench
from api.cli.distance_bench import Question, Repeat, Row, face_like, face_like_templates
from templates.distances import Metric, pairwise_distances
from templates.keys.randomness import Keystream
from verify.evaluation.units import Mode


def test_the_authors_formula_gives_the_distances():
    stream = Keystream.seeded("authors")
    templates = face_like_templates(9, 3, 64, stream=stream)
    for probes in (face_like(8, 64, stream=stream), face_like_templates(8, 2, 64, stream=stream)):
        np.testing.assert_allclose(
            distance_bench.authors_distances(probes, templates),
            pairwise_distances(probes, templates, metric="euclidean", dtype=np.float64),
            rtol=1e-4,
        )


def test_a_short_task_is_timed_at_its_second_run(monkeypatch: pytest.MonkeyPatch):
    clock = iter([0, 50_000_000, 100_000_000, 130_000_000, 0, 300_000_000])
    monkeypatch.setattr(distance_bench.time, "perf_counter_ns", lambda: next(clock))
    assert distance_bench._milliseconds(lambda: None) == 30
    assert distance_bench._milliseconds(lambda: None) == 300


def test_ratios_are_medians_of_ratios_inside_a_repeat():
    repeats = (Repeat(2, 3, 30), Repeat(20, 22, 22), Repeat(5, 40, 80))
    shown = Row(128, 2, Mode.POINT, Metric.EUCLIDEAN, repeats).to_json()
    assert [shown[f"{name}_ms"] for name in Repeat._fields] == [5, 22, 30]
    assert shown["ratio_to_product"] == 1.5
    assert (shown["ratio_to_product_low"], shown["ratio_to_product_high"]) == (1.1, 8)
    assert shown["authors_to_distances"] == 2


def test_descriptors_are_spread_like_faces():
    rows = face_like(4000, 64, stream=Keystream.seeded("spread")).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-6)
    assert np.linalg.norm(rows.mean(axis=0)) > 0.05
    spectrum = np.linalg.eigvalsh(np.cov(rows.T))
    assert spectrum[-1] > 4 * spectrum[0]


def test_templates_hold_a_descriptor_of_their_own():
    stream, again = Keystream.seeded("held"), Keystream.seeded("held")
    batch = face_like_templates(5, 3, 12, stream=stream)
    members = face_like(20, 12, stream=again).reshape(5, 4, 12)
    assert all(
        batch[i].contains(member, tol=1e-5).all()
        for i in range(5)
        for member in members[i][:, None]
    )


def test_memory_grows_with_the_lifted_probes():
    def needed(*modes: Mode) -> int:
        return distance_bench.memory_needed(Question(1000, (512,), (16,), modes=modes))

    assert needed(Mode.POINT) < needed(Mode.SUBSPACE) < 3 << 30
