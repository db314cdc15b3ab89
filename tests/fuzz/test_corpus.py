"""The short corpus: what was found once, and some hundred generated cases of every reader."""

import json
import re
from pathlib import Path

import pytest

from tests.fuzz.__main__ import main
from tests.fuzz.child import case_of
from tests.fuzz.faulty import FAULTY
from tests.fuzz.runner import Runner
from tests.fuzz.targets import SHARES, TARGETS, target_of

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
    tally = Runner(name, seed=0, out=tmp_path).run(cases=CASES)
    assert not tally.findings, f"{tally.findings}; inputs are in {tmp_path}"
    assert tally.cases == CASES
    # Cases that are all refused, or all for one reason, would not get far into the reader.
    assert tally.outcomes["accepted"] > 0
    assert len(tally.reasons) >= 4


@pytest.mark.parametrize("name", ["image", "template", "bin", "contract", "body"])
def test_what_was_found_stays_mended(name: str, tmp_path: Path) -> None:
    count = len(target_of(name)(tmp_path).regressions)
    assert count > 0
    tally = Runner(name, out=tmp_path).run(cases=count, regression=True)
    assert not tally.findings
    assert tally.cases == count


@pytest.mark.parametrize(
    ("fault", "seen"),
    [
        ("raises", r"IndexError at tests/fuzz/faulty.py:\d+: pop from empty list"),
        ("waits", r"hang: more than 0.5 s"),
        ("computes", r"hang: more than 0.5 s"),
        ("crashes", r"crash: SIGSEGV"),
        ("leaves", r"crash: exit status 3"),
        ("takes memory", r"memory: above 32 MiB and 5 times the input"),
        ("hides that memory ran out", r"memory: ran out at tests/fuzz/faulty.py:\d+"),
        ("runs a command", r"Executed at .+: os.system"),
    ],
)
def test_the_runner_sees_every_fault_and_goes_on(
    fault: str, seen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.fuzz.runner.SECONDS", 0.5)
    tally = Runner(fault, out=tmp_path).run(cases=8)
    ((finding, times),) = tally.findings.items()
    assert re.fullmatch(seen, finding)
    assert times == 1
    assert tally.cases == 8
    assert tally.outcomes["accepted"] + tally.outcomes["Refused"] >= 7
    (told,) = tmp_path.glob("*.json")
    assert json.loads(told.read_text())["case"] == 4
    assert told.with_suffix(".bin").read_bytes() in (b"", b"long")


def test_time_is_kept() -> None:
    runner = Runner("no fault")
    for seconds in (1.5, 30, 600):  # on a busy machine the child may take longer to start
        tally = runner.run(seconds=seconds)
        if tally.cases:
            break
    assert not tally.findings
    assert tally.cases > 0
    assert tally.seconds >= 1.5


@pytest.mark.parametrize("name", ["image", "template", "export", "bin", "contract", "body"])
def test_equal_seeds_give_equal_cases(name: str, tmp_path: Path) -> None:
    one, same = target_of(name)(tmp_path), target_of(name)(tmp_path)
    first, again = (
        [case_of(target, name, 5, number, regression=False) for number in range(12)]
        for target in (one, same)
    )
    assert first == again
    assert first != [case_of(one, name, 6, number, regression=False) for number in range(12)]


def test_a_run_prints_a_row_for_each_target_and_fails_on_a_finding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("no fault", "raises"):
        monkeypatch.setitem(TARGETS, name, FAULTY[name])
        monkeypatch.setitem(SHARES, name, 1)
    common = ["--cases", "9", "--out", str(tmp_path)]
    assert main(["--target", "no fault", *common]) == 0
    assert main(["--target", "no fault", "--target", "raises", *common]) == 1
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()]
    head, _, quiet, loud = rows[3:]
    assert head[:4] == ["| target", "cases", "CPU, s", "cases/s"]
    assert (quiet[0], quiet[1], quiet[-1]) == ("| no fault", "9", "0 |")
    assert (loud[0], loud[1], loud[-1]) == ("| raises", "9", "1 |")
    refused, accepted = (quiet[head.index(name)] for name in ("refused", "accepted"))
    assert int(refused.removeprefix("Refused ")) + int(accepted) == 9
