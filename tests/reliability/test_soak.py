import pytest

from benchmarks.soak import GROWTH_LIMIT, failures, growth


def test_memory_that_grows_after_the_first_ten_minutes_is_seen() -> None:
    steady = [200.0 + 30 * minute for minute in range(10)] + [500.0] * 50
    assert growth(steady) == pytest.approx(0)
    leaking = [500.0 + minute for minute in range(60)]
    grown = growth(leaking)
    assert grown is not None
    assert grown > GROWTH_LIMIT
    assert growth(steady[:29]) is None


def test_an_answer_that_was_not_asked_for_is_a_failure() -> None:
    assert not failures({"photo: accept": 9, "burst: reject": 1, "erase: done": 2})
    assert failures({"photo: overloaded": 1, "erase: done": 2}) == {"photo: overloaded": 1}
