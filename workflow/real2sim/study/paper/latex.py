"""Tables and numbers as LaTeX, for a manuscript that inputs them: booktabs, and no number typed by hand."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

PHANTOM = "Phantom cohort: synthetic people. No number here is the study's."
_SPECIAL = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "\N{SUPERSCRIPT TWO}": r"\textsuperscript{2}",
        "\N{PLUS-MINUS SIGN}": r"$\pm$",
        "\N{GREEK SMALL LETTER GAMMA}": r"$\gamma$",
        "\N{GREEK SMALL LETTER SIGMA}": r"$\sigma$",
        "\N{EN DASH}": "--",
        "\N{MINUS SIGN}": "$-$",
    }
)
_DIGITS = ("Zero", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine")


def escaped(text: str) -> str:
    """Plain text for LaTeX."""
    return text.translate(_SPECIAL)


def latex_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    caption: str,
    label: str,
    phantom: bool,
    columns: str = "",
) -> str:
    """A floating table of plain text cells; ``columns`` is the column specification (first left, others right)."""
    note = f" {PHANTOM}" if phantom else ""
    lines = [
        "% generated; do not edit",
        r"\begin{table}[htbp]",
        rf"\caption{{{escaped(caption + note)}}}",
        rf"\label{{{label}}}",
        r"\centering",
        rf"\begin{{tabular}}{{{columns or 'l' + 'r' * (len(head) - 1)}}}",
        r"\toprule",
        " & ".join(map(escaped, head)) + r" \\",
        r"\midrule",
        *(" & ".join(map(escaped, row)) + r" \\" for row in rows),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def macro_name(name: str) -> str:
    """Name of a macro: letters only, as TeX has it (``loso_J`` becomes ``LosoJ``)."""
    words = re.split(r"[^A-Za-z0-9]+", name)
    return "".join(
        "".join(_DIGITS[int(c)] if c.isdigit() else c for c in word[:1].upper() + word[1:]) for word in words
    )


def macros(values: Mapping[str, float], *, phantom: bool) -> str:
    """A macro per number (Rts and its name, as RtsLosoJ), to three significant digits."""
    lines = ["% generated; do not edit"]
    if phantom:
        lines.append(f"% {PHANTOM}")
    lines += [rf"\newcommand{{\Rts{macro_name(name)}}}{{{value:.3g}}}" for name, value in values.items()]
    return "\n".join(lines) + "\n"
