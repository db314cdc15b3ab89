"""The short corpus: what was found once, and some hundred generated cases of every reader."""

import re
from pathlib import Path

import pytest

from tests.fuzz.__main__ import main
from tests.fuzz.reading import cases_of, run
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


@pytest.mark.parametrize("name", ["image", "template", "bin", "contract", "body"])
def test_what_was_found_stays_mended(name: str, tmp_path: Path) -> None:
    tally = run(name, tmp_path)
    assert tally.finding is None, f"case {tally.case}: {tally.finding}"
    assert tally.outcomes.total() > 0


@pytest.mark.parametrize(
    ("fault", "seen"),
    [
        ("raises", r"IndexError: pop from empty list"),
        ("waits", r"^hang: SIGALRM"),
        ("computes", r"^hang: SIGPROF"),
        ("crashes", r"^crash: SIGSEGV"),
        ("leaves", r"^crash: exit status 3"),
        ("takes memory", r"^memory: above 32 MiB and 5 times the input"),
        ("hides that memory ran out", r"^memory: ran out"),
        ("runs a command", r"Executed: os.system"),
    ],
)
def test_every_fault_of_a_reader_is_seen(
    fault: str, seen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FUZZ_SECONDS", "0.5")
    tally = run(fault, tmp_path, cases=8)
    assert tally.case == 4
    assert re.search(seen, tally.finding or "")
    assert (tmp_path / "case").read_bytes() in (b"", b"long")


@pytest.mark.parametrize("name", ["image", "template", "export", "bin", "contract", "body"])
def test_equal_seeds_give_equal_cases(name: str, tmp_path: Path) -> None:
    first, same, other = (
        [cases_of(name, tmp_path, seed=seed, regressions=False)[1](n) for n in range(12)]
        for seed in (5, 5, 6)
    )
    assert first == same != other


def test_a_run_prints_a_row_and_fails_on_a_finding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.fuzz.faulty import FAULTY

    for name, status in (("no fault", 0), ("raises", 1)):
        monkeypatch.setitem(TARGETS, name, FAULTY[name])
        common = ["--minutes", "0.02", "--out", str(tmp_path)]
        assert main(["--target", name, *common]) == status
        assert f"| {name} | " in capsys.readouterr().out
