"""The short corpus: what was found once, and some hundred generated cases of every reader."""

from pathlib import Path

import pytest

from tests.fuzz.reading import run
from tests.fuzz.targets import TARGETS

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(
        not Path("/proc/self/clear_refs").exists(),
        reason="the memory of a process is read from /proc, which is absent",
    ),
]
CASES = 200


@pytest.mark.parametrize("name", TARGETS)
def test_readers_refuse_or_accept_within_their_limits(name: str, tmp_path: Path) -> None:
    tally = run(name, tmp_path, cases=CASES)
    assert tally.finding is None, f"case {tally.case}, which is in {tmp_path}: {tally.finding}"
    assert tally.outcomes.total() == CASES
    # Cases that are all refused, or all for one reason, would not get far into the reader.
    assert tally.outcomes["accepted"] > 0
    assert len(tally.reasons) >= 4


@pytest.mark.parametrize("name", ["image", "template", "body"])
def test_what_was_found_stays_mended(name: str, tmp_path: Path) -> None:
    tally = run(name, tmp_path)
    assert tally.finding is None, f"case {tally.case}: {tally.finding}"
    assert tally.outcomes.total() > 0
