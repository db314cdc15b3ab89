"""What `make audit` says of a report: an audit that did not happen is no pass."""

import json
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


def audited(folder: Path, text: str | None) -> "subprocess.CompletedProcess[str]":
    """Judge a report with this text; None: there is none."""
    report = folder / "audit.json"
    if text is not None:
        report.write_text(text)
    command = [sys.executable, ROOT / ".ci" / "audit_report.py", report]
    return subprocess.run(command, capture_output=True, text=True, check=False)


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
    tmp_path: Path, packages: list[dict[str, Any]] | None, status: int, said: str
) -> None:
    report = None if packages is None else json.dumps({"dependencies": packages, "fixes": []})
    ran = audited(tmp_path, report)
    assert (ran.returncode, ran.stderr) == (status, "")
    assert said in ran.stdout
