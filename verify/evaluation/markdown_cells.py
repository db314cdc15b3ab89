"""Cells of a Markdown table: digits that the data carries, and text that cannot break the table."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

MISSING = "-"


def plain(value: Any) -> str:
    """Return text without line breaks, pipes or markup: file names and reasons are foreign."""
    if value is None or value == "":
        return MISSING
    text = _one_line(value).replace("&", "&amp;").replace("<", "&lt;")
    return text.replace("|", "&#124;").replace("[", "&#91;").replace("`", "'")


def code(value: Any) -> str:
    """Return text as a code span, for a list or a paragraph: a table would split at its pipes."""
    text = _one_line(value).replace("`", "'")
    return f"`{text}`" if text else MISSING


def _one_line(value: Any) -> str:
    return re.sub(r"[\s\x00-\x1f\x7f]+", " ", "" if value is None else str(value)).strip()


def fixed(value: float | None, digits: int) -> str:
    """Return a number with a fixed number of decimals."""
    return MISSING if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def percent(fraction: float | None) -> str:
    """Return a fraction in per cent: two decimals, two significant digits below 0.1 %.

    What is above 0 and below 1e-4 % is given as that bound.
    """
    if fraction is None or not math.isfinite(fraction):
        return MISSING
    value = 100 * fraction
    # The fraction is compared: a hundredfold 1e-6 is not quite 1e-4.
    if 0 < fraction < 1e-6:
        return "<0.0001"
    return f"{value:.2g}" if 0 < value < 0.1 else f"{value:.2f}"


def significant(value: float | None) -> str:
    """Return a number with three significant digits, never in exponents."""
    if value is None or not math.isfinite(value):
        return MISSING
    if value == 0:
        return "0"
    rounded = float(f"{value:.2e}")
    decimals = 2 - math.floor(math.log10(abs(rounded)))
    return f"{rounded:,.{max(0, decimals)}f}"


def count(value: float | None) -> str:
    """Return a whole number with separated thousands."""
    return MISSING if value is None else f"{round(value):,}"


def power(target: str | float) -> str:
    """Return a target rate as it is quoted: 1e-3, 5e-4."""
    mantissa, exponent = f"{float(target):e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def accuracy(row: Mapping[str, Any]) -> str:
    """Return ``mean ± folds (± seeds)`` in per cent; seeds where there are several."""
    mean = row.get("accuracy_mean")
    if mean is None:
        return MISSING
    text = fixed(100 * mean, 2)
    if row.get("accuracy_std") is not None:
        text += f" ± {fixed(100 * row['accuracy_std'], 2)}"
    if row.get("accuracy_std_seeds") is not None:
        text += f" (± {fixed(100 * row['accuracy_std_seeds'], 2)})"
    return text


def interval_cell(rate: Mapping[str, Any] | None) -> str:
    """Return ``value [low, high] (errors/trials)``, the rates in per cent."""
    if not rate or rate.get("value") is None:
        return MISSING
    text = percent(rate["value"])
    if rate.get("ci_low") is not None and rate.get("ci_high") is not None:
        text += f" [{percent(rate['ci_low'])}, {percent(rate['ci_high'])}]"
    errors = rate.get("errors", rate.get("errors_mean"))
    if errors is not None and rate.get("trials") is not None:
        text += f" ({errors:.1f}".removesuffix(".0") + f"/{rate['trials']})"
    return text


def table(titles: Sequence[str], lines: Sequence[Sequence[str]], left: Sequence[bool]) -> str:
    """Return a Markdown table, padded so that it also reads as plain text."""
    widths = [max(3, *(len(line[i]) for line in [titles, *lines])) for i in range(len(titles))]

    def padded(cells: Sequence[str]) -> str:
        done = [
            cell.ljust(width) if to_left else cell.rjust(width)
            for cell, width, to_left in zip(cells, widths, left, strict=True)
        ]
        return f"| {' | '.join(done)} |"

    rules = [
        "-" * width if to_left else "-" * (width - 1) + ":"
        for width, to_left in zip(widths, left, strict=True)
    ]
    return "\n".join([padded(titles), padded(rules), *(padded(line) for line in lines)])
