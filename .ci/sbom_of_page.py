"""Add to a bill of materials (CycloneDX) what private mode brings into the wheel."""

import base64
import json
import sys
from pathlib import Path

LOCK = Path(__file__).resolve().parent.parent / "clients/javascript/package-lock.json"
# clients/javascript/page/bundle.js takes files of the first; those hold the second.
PACKAGES = ("onnxruntime-web", "onnxruntime-common")


def main() -> None:
    file = Path(sys.argv[1])
    bill = json.loads(file.read_text(encoding="utf-8"))
    locked = json.loads(LOCK.read_text(encoding="utf-8"))["packages"]
    for name in PACKAGES:
        package = locked[f"node_modules/{name}"]
        purl = f"pkg:npm/{name}@{package['version']}"
        digest = base64.b64decode(package["integrity"].removeprefix("sha512-"), validate=True)
        component = {
            "bom-ref": purl,
            "hashes": [{"alg": "SHA-512", "content": digest.hex()}],
            "licenses": [{"license": {"acknowledgement": "declared", "id": package["license"]}}],
            "name": name,
            "purl": purl,
            "type": "library",
            "version": package["version"],
        }
        bill["components"].append(component)
        bill["dependencies"].append({"ref": purl})
    file.write_text(json.dumps(bill, indent=2) + "\n", encoding="utf-8")


main()
