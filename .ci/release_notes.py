"""Print the notes of a release: the section of CHANGELOG.md for the version of pyproject.toml.

One sentence and exit status 1 say why nothing can be released: the working tree is not what was
committed, the commit has the tag of another version, or CHANGELOG.md does not describe this one.
"""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def git(*arguments: str) -> list[str]:
    ran = subprocess.run(
        ["git", *arguments], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    )
    return ran.stdout.splitlines()


def section(changelog: str, version: str) -> str | None:
    """What follows the heading of a version, up to the next version."""
    heading = rf"^## \[{re.escape(version)}\] - [^\n]*\n"
    match = re.search(rf"{heading}(.*?)(?=^## |\Z)", changelog, re.M | re.S)
    return match[1].strip() or None if match else None


def main() -> int:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = project["version"]
    if changed := git("status", "--porcelain"):
        return refuse(f"{len(changed)} files are not as they were committed: commit or remove them")
    tags = [tag for tag in git("tag", "--points-at", "HEAD") if re.match(r"v\d", tag)]
    if others := [tag for tag in tags if tag != f"v{version}"]:
        return refuse(
            f"the commit is tagged {', '.join(others)}, and pyproject.toml says {version}"
        )
    notes = section((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), version)
    if notes is None:
        return refuse(f"CHANGELOG.md says nothing under a heading '## [{version}] - YYYY-MM-DD'")
    print(notes)
    return 0


def refuse(reason: str) -> int:
    print(f"no release: {reason}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
