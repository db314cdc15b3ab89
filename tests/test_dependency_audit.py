"""`make audit` and what CI makes of it: an audit that did not happen is no pass."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
CLEAN = {"name": "numpy", "version": "2.0", "vulns": []}
SKIPPED = {"name": "torch", "skip_reason": "not found"}
VULNERABLE = {
    "name": "pillow",
    "version": "1.0",
    "vulns": [{"id": "CVE-1", "fix_versions": ["2.0"]}, {"id": "CVE-2", "fix_versions": []}],
}
CLOSING = "==== 1 passed in 1.00s ===="


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """The Makefile and the scripts, in a folder where nothing else is touched."""
    shutil.copy(ROOT / "Makefile", tmp_path)
    shutil.copytree(ROOT / ".ci", tmp_path / ".ci")
    return tmp_path


def write_report(folder: Path, packages: list[dict[str, Any]] | None) -> Path:
    report = folder / "dist" / "audit.json"
    report.parent.mkdir(exist_ok=True)
    if packages is not None:
        report.write_text(json.dumps({"dependencies": packages, "fixes": []}))
    return report


@pytest.mark.parametrize(
    ("packages", "status", "said"),
    [
        ([CLEAN], 0, "1 of 1 packages looked up, 0 with known"),
        ([CLEAN, VULNERABLE], 1, "pillow 1.0: CVE-2, fixed in no release yet"),
        ([VULNERABLE, SKIPPED], 1, "1 of 2 packages looked up, 1 with known"),
        ([SKIPPED], 3, "skipped (not audited: no advisory service answered)"),
        ([CLEAN, SKIPPED], 3, "skipped (not audited: no answer about torch)"),
        ([], 3, "skipped (not audited: the report names no package)"),
        (None, 3, "skipped (not audited: pip-audit wrote no report)"),
    ],
)
def test_only_a_whole_audit_passes(
    checkout: Path, packages: list[dict[str, Any]] | None, status: int, said: str
) -> None:
    report = write_report(checkout, packages)
    ran = subprocess.run(
        [sys.executable, checkout / ".ci" / "audit_report.py", report],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.returncode, ran.stderr) == (status, "")
    assert said in ran.stdout


@pytest.mark.parametrize("text", ["", '{"dependencies": [', "[]", "{}"])
def test_half_a_report_is_no_audit(checkout: Path, text: str) -> None:
    write_report(checkout, []).write_text(text)
    ran = subprocess.run(
        [sys.executable, checkout / ".ci" / "audit_report.py", checkout / "dist" / "audit.json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 3
    assert "not audited" in ran.stdout


def test_make_audit_fails_where_nothing_was_audited(checkout: Path) -> None:
    write_report(checkout, [CLEAN])  # of an earlier run: it says nothing about this one
    nothing = shutil.which("false")
    assert nothing is not None
    ran = subprocess.run(
        ["make", "audit", f"UV={nothing}", f"PYTHON={sys.executable}"],
        cwd=checkout,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode != 0
    assert "skipped (not audited" in ran.stdout


@pytest.mark.parametrize(("packages", "passes"), [([SKIPPED], True), ([VULNERABLE], False)])
def test_ci_shows_a_skipped_audit_and_fails_on_a_vulnerability(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, packages: list[dict[str, Any]], passes: bool
) -> None:
    write_report(checkout, packages).rename(checkout / "report.json")
    write_report(checkout, [CLEAN])  # of an earlier run
    tools = checkout / "tools"
    tools.mkdir()
    for name, text in {
        "make": (
            'case "$1" in\n'
            "audit) cp report.json dist/audit.json; exit 2;;\n"
            f'test*) echo "{CLOSING}";;\n'
            "esac"
        ),
        "chromium": "exit 1",
        "systemd-analyze": "exit 1",
        "nginx": "exit 1",
        "unshare": 'test "$1" = --net',
        "ip": "exit 1",
    }.items():
        (tools / name).write_text(f"#!/bin/sh\n{text}\n")
        (tools / name).chmod(0o755)
    path = f"{tools}:{Path(sys.executable).parent}:/usr/bin:/bin"
    monkeypatch.setenv("PATH", path)
    ran = subprocess.run(
        [checkout / ".ci" / "run"], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert (ran.returncode == 0) is passes, ran
    assert ("skipped (not audited" in ran.stdout) is passes
    if passes:
        assert ran.stdout.splitlines()[-1] == CLOSING
