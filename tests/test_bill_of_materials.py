"""`make sbom`: what the wheel has beside Python packages is in the bill of materials."""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CLIENT = ROOT / "clients" / "javascript"


def test_the_bill_names_what_private_mode_brings_into_the_wheel(tmp_path: Path) -> None:
    bill = tmp_path / "sbom.json"
    python = {"name": "numpy", "bom-ref": "requirements-L1"}
    bill.write_text(json.dumps({"components": [python], "dependencies": [{"ref": "x"}]}))
    script = ROOT / ".ci" / "sbom_of_page.py"
    subprocess.run([sys.executable, script, bill], check=True)
    written = json.loads(bill.read_text())
    first, *added = written["components"]
    assert first == python
    copied = re.findall(r"node_modules/([\w-]+)", (CLIENT / "page" / "bundle.js").read_text())
    assert set(copied) < {component["name"] for component in added}
    asked = json.loads((CLIENT / "package.json").read_text())["devDependencies"]
    for component in added:
        assert component["version"] == asked["onnxruntime-web"]
        assert component["purl"] == f"pkg:npm/{component['name']}@{component['version']}"
        assert component["licenses"][0]["license"]["id"] == "MIT"
        (digest,) = component["hashes"]
        assert len(bytes.fromhex(digest["content"])) == hashlib.sha512().digest_size
        assert {"ref": component["bom-ref"]} in written["dependencies"]
