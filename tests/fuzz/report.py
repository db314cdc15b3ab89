"""The table of a run."""

from collections.abc import Sequence

from tests.fuzz.runner import Tally

HEADS = (
    "target",
    "cases",
    "CPU, s",
    "cases/s",
    "largest, KiB",
    "refused",
    "accepted",
    "reasons",
    "slowest, ms",
    "peak, MiB",
    "findings",
)


def table(tallies: Sequence[Tally]) -> str:
    """A Markdown table, a row for each target."""
    rows = [HEADS, ["---"] * len(HEADS), *map(_row, tallies)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def _row(tally: Tally) -> Sequence[str]:
    refused = [
        f"{name} {count:,}"
        for name, count in tally.outcomes.most_common()
        if name != "accepted" and any(name == outcome for outcome, _ in tally.reasons)
    ]
    return (
        tally.target,
        f"{tally.cases:,}",
        f"{tally.cpu_seconds:,.0f}",
        f"{tally.cases / max(tally.seconds, 1e-9):,.0f}",
        f"{tally.largest / 1024:,.0f}",
        ", ".join(refused) or "none",
        f"{tally.outcomes['accepted']:,}",
        str(len(tally.reasons)),
        f"{tally.slowest_ms:,.0f}",
        f"{tally.peak / 2**20:,.0f}",
        str(tally.findings.total()),
    )
