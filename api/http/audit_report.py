"""The report of a privacy audit, reduced to what the page shows beside a stored template."""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any

from api.http.errors import StartError
from api.settings import Settings
from attacks.outcomes import GENERATED, POOLED, Scheme
from attacks.report import FORMAT, VERSION
from attacks.verdict import LIMITS, WITH_KEY
from templates.contract.document import Binding, Contract
from templates.decoys import DecoyGenerator, DecoyPool

MAX_REPORT_BYTES = 64 * 1024 * 1024
MAX_HEADLINES = 40
COMMAND = "veilface audit templates PEOPLE --contract contract.json"
_CELL = (
    "property", "leaked", "knowledge", "attack", "variant", "value", "ci_low", "ci_high", "chance",
    "compared", "compared_low", "compared_high", "limit", "most", "status", "reason",
)  # fmt: skip
_TEXTS = ("property", "leaked", "knowledge", "attack")
_NUMBERS = ("value", "compared", "most")
_TEXTS_OR_NONE = ("variant", "limit", "status", "reason")
_NUMBERS_OR_NONE = ("ci_low", "ci_high", "chance", "compared_low", "compared_high")
_MEMBERS: dict[str, type | UnionType] = {
    "kind": str,
    "passed": bool | None,
    "headlines": list,
    "limits": dict,
    "verdicts": list,
    "model": dict,
    "settings": dict,
}


@dataclass(frozen=True)
class AuditReport:
    """A report as it was read; nothing of it names a person or holds a number of a descriptor."""

    document: Mapping[str, Any]

    def reduced(self, contract: Contract, decoys: str) -> dict[str, Any]:
        """Return what is told of it to whoever has a key: the part on the contract's scheme.

        Parameters
        ----------
        contract
            The contract in force.
        decoys
            The kind of its decoys, as :func:`kind_of_decoys` says.

        Notes
        -----
        ``fits`` says what the report is about: ``contract``, this one, by its id, which thresholds
        are no part of; ``scheme``, the same embedder, strategy, dimension and kind of decoys;
        ``nothing`` of it, and then no figure is told.
        """
        report, binding = self.document, contract.binding
        verdict = self._verdict(binding, decoys)
        fits = "nothing"
        if verdict is not None and report["settings"].get("contract_id") == contract.contract_id:
            fits = "contract"
        elif (
            verdict is not None
            and report["model"].get("embedder_sha256") == binding.embedder_sha256
        ):
            fits = "scheme"
        if verdict is None or fits == "nothing":
            return {**NOT_AUDITED, "audited": True, "kind": report["kind"]}
        cells = [{name: cell.get(name) for name in _CELL} for cell in verdict["cells"]]
        prefix = f"{Scheme.of(verdict)}: "
        lines = [str(line) for line in report["headlines"]]
        return {
            "audited": True,
            "fits": fits,
            "kind": report["kind"],
            "passed": verdict["passed"],
            "headlines": [line for line in lines if line.startswith(prefix)][:MAX_HEADLINES],
            "strongest": strongest(cells),
            "cells": cells,
            "limits": [
                {"name": limit.name, "most": report["limits"][limit.name], "meaning": limit.meaning}
                for limit in LIMITS
                if limit.name in report["limits"]
            ],
            "command": COMMAND,
        }

    def _verdict(self, binding: Binding, decoys: str) -> Mapping[str, Any] | None:
        """Find what was found of a contract's scheme; what was there to compare with is not it."""
        for verdict in self.document["verdicts"]:
            scheme = (verdict["strategy"], verdict["dim"], verdict.get("axes") or binding.n)
            same = scheme == (str(binding.strategy), binding.m, binding.axes)
            differs = verdict["decoys"] not in (None, decoys)
            if same and not differs and not verdict.get("comparison"):
                return dict(verdict)
        return None


def kind_of_decoys(source: DecoyPool | DecoyGenerator) -> str:
    """Name a deployment's source of decoys as a report does."""
    return POOLED if isinstance(source, DecoyPool) else GENERATED


NOT_AUDITED: dict[str, Any] = {
    "audited": False,
    "fits": "nothing",
    "kind": None,
    "passed": None,
    "headlines": [],
    "strongest": None,
    "cells": [],
    "limits": [],
    "command": COMMAND,
}


def strongest(cells: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the attack that succeeds most, but for those that no template withstands.

    Getting the face back counts before everything else; where no such attack was made, the attack
    that is furthest above its chance.
    """
    withstood = [cell for cell in cells if cell["limit"] != WITH_KEY]
    inverting = [cell for cell in withstood if cell["property"] == "irreversibility"]
    if inverting:
        return max(inverting, key=lambda cell: float(cell["value"]))
    return max(withstood, key=lambda cell: float(cell["compared"]), default=None)


def open_audit_report(settings: Settings) -> "AuditReport | None":
    """Read the report that the settings name, or raise as :func:`read_audit_report` does."""
    file = settings.audit_report_file
    return None if file is None else read_audit_report(file)


def read_audit_report(path: Path) -> AuditReport:
    """Read ``report.json`` of ``veilface audit``.

    Raises
    ------
    StartError
        One sentence: it cannot be read, or is no such report.
    """
    name = f"audit_report_file {path}"
    try:
        if path.stat().st_size > MAX_REPORT_BYTES:
            raise StartError(f"{name} has more than {MAX_REPORT_BYTES} bytes; it is not a report")
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise StartError(f"{name} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError):
        raise StartError(f"{name} is not JSON; name the report.json of `veilface audit`") from None
    if not isinstance(document, dict) or not _is_report(document):
        raise StartError(
            f"{name} is not a report of `veilface audit`, version {VERSION}; name its report.json"
        )
    return AuditReport(document)


def _is_report(document: Mapping[str, Any]) -> bool:
    if (document.get("format"), document.get("version")) != (FORMAT, VERSION):
        return False
    if not all(isinstance(document.get(name, 0), kind) for name, kind in _MEMBERS.items()):
        return False
    return all(_is_verdict(verdict) for verdict in document["verdicts"]) and all(
        _is_number(value) for value in document["limits"].values()
    )


def _is_verdict(verdict: object) -> bool:
    return (
        isinstance(verdict, dict)
        and isinstance(verdict.get("strategy"), str)
        and isinstance(verdict.get("dim"), int)
        and _is_text_or_none(verdict.get("decoys", 0))
        and isinstance(verdict.get("passed", 0), bool | None)
        and isinstance(verdict.get("cells"), list)
        and all(_is_cell(cell) for cell in verdict["cells"])
    )


def _is_cell(cell: object) -> bool:
    return (
        isinstance(cell, dict)
        and all(isinstance(cell.get(name), str) for name in _TEXTS)
        and all(_is_number(cell.get(name)) for name in _NUMBERS)
        and all(_is_text_or_none(cell.get(name)) for name in _TEXTS_OR_NONE)
        and all(cell.get(name) is None or _is_number(cell[name]) for name in _NUMBERS_OR_NONE)
    )


def _is_text_or_none(value: object) -> bool:
    return value is None or isinstance(value, str)


def _is_number(value: object) -> bool:
    # NaN and infinities are numbers to Python's JSON, and an answer cannot carry them; nor do
    # integers that no float holds, and true and false are no numbers.
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and abs(value) <= sys.float_info.max
    )
