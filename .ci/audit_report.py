"""Read pip-audit's report: fail on a known vulnerability, and say what could not be looked up."""

import json
import sys
from pathlib import Path


def main() -> int:
    report = Path(sys.argv[1])
    if not report.is_file():
        print("dependency audit: pip-audit wrote no report; NOTHING was audited")
        return 0
    found = json.loads(report.read_text(encoding="utf-8"))["dependencies"]
    skipped = [each["name"] for each in found if "skip_reason" in each]
    vulnerable = [each for each in found if each.get("vulns")]
    for each in vulnerable:
        for vulnerability in each["vulns"]:
            fixed = ", ".join(vulnerability["fix_versions"]) or "no release yet"
            print(f"{each['name']} {each['version']}: {vulnerability['id']}, fixed in {fixed}")
    print(
        f"dependency audit: {len(found) - len(skipped)} of {len(found)} packages looked up, "
        f"{len(vulnerable)} with known vulnerabilities"
    )
    if len(skipped) == len(found):
        print("dependency audit: no advisory service answered; NOTHING was audited")
    return 1 if vulnerable else 0


if __name__ == "__main__":
    sys.exit(main())
