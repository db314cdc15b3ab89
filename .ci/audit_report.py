"""Read pip-audit's report: exit status 0 audited, 1 known vulnerabilities, 3 not audited.

Not audited is every run in which an advisory service was not asked about each package. That is no
pass: nobody looked.
"""

import json
import sys
from pathlib import Path

VULNERABLE = 1
NOT_AUDITED = 3


def main() -> int:
    try:
        packages = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["dependencies"]
    except FileNotFoundError:
        return not_audited("pip-audit wrote no report")
    except (ValueError, TypeError, KeyError):
        return not_audited("the report of pip-audit is not whole")
    vulnerable = [package for package in packages if package.get("vulns")]
    for package in vulnerable:
        for vulnerability in package["vulns"]:
            fixed = ", ".join(vulnerability["fix_versions"]) or "no release yet"
            print(
                f"{package['name']} {package['version']}: {vulnerability['id']}, fixed in {fixed}"
            )
    skipped = [package for package in packages if "skip_reason" in package]
    print(
        f"dependency audit: {len(packages) - len(skipped)} of {len(packages)} packages looked up, "
        f"{len(vulnerable)} with known vulnerabilities"
    )
    if vulnerable:
        return VULNERABLE
    if not packages:
        return not_audited("the report names no package")
    if len(skipped) == len(packages):
        return not_audited("no advisory service answered")
    if skipped:
        return not_audited(f"no answer about {', '.join(package['name'] for package in skipped)}")
    return 0


def not_audited(reason: str) -> int:
    print(f"dependency audit: skipped (not audited: {reason})")
    return NOT_AUDITED


if __name__ == "__main__":
    sys.exit(main())
