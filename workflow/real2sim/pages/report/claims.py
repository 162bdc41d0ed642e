"""What the paper claims beside what is found here, and which gap would have made its numbers."""

from __future__ import annotations

from collections import Counter
from html import escape

from real2sim.artefacts import read_json
from real2sim.pages.page import download, paragraph, section, table
from real2sim.pages.paper_gap import RECORD_KEYS as PAPER_GAP_KEYS
from real2sim.pages.paper_gap import told
from real2sim.pages.report.parts import downloads, figure, value_cell
from real2sim.pages.report.study import Row, Study
from real2sim.study.paper.claims import SET

_JUDGED = {
    "reproduced": "met",
    "holds": "met",
    "not reproduced": "missed",
    "inconsistent": "missed",
    "does not": "missed",
}
# unit of a claim whose number here is that of a test
_P_VALUE = "p-value"


def claims_section(study: Study) -> str:
    """Every claim of the paper with its verdict."""
    counts = Counter(row["verdict"] for row in study.claims.rows if row["verdict"] != SET)
    made = sum(row["verdict"] == SET for row in study.claims.rows)
    others = _claims_of_the_diagnosed(study)
    head = ["The paper says", "Published", "Here", *others, "Unit", "Verdict", "Reason"]
    rows = []
    for row in study.claims.rows:
        kind = next((k for start, k in _JUDGED.items() if row["verdict"].startswith(start)), "warned")
        rows.append(
            [
                f"<span class='said'>{escape(row['says'])} <span class='small'>{escape(row['place'])}<br>"
                f"Criterion: {escape(row['criterion'])}</span></span>",
                value_cell(row["published"], 4),
                _here(row),
                *(cells[row["claim"]] for cells in others.values()),
                escape(row["unit"]) if row["unit"] not in ("1", _P_VALUE) else "",
                f'<span class="{kind} wrapped">{escape(row["verdict"])}</span>',
                escape(row["reason"]),
            ]
        )
    summary = "; ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
    caption = "Every quantitative claim of the paper, judged by the criterion below it"
    plain = "Here"
    if _SAME_TRIALS in others:
        plain = _SAME_TRIALS
        caption += (
            f". {_SAME_TRIALS}: the value, where it differs from Here, by the plain fits of the diagnosed people's "
            "first two dynamic trials, which the fits with causes rest on"
        )
    if others:
        caption += (
            f". With causes: the value, where it differs from {plain}, once the diagnosed causes are in the model, "
            f"fitted by {study.sharing.explained[0].rows[0]['search_with_effects']}"
        )
    return section(
        "claims",
        "What the paper claims, and what is found here",
        paragraph(f"{counts.total()} claims are tested: {summary}.{_untested(made)}"),
        table(head, rows, caption=caption, numeric=(1, 2, *range(3, 3 + len(others)))),
        downloads(study.claims),
    )


def _untested(made: int) -> str:
    """Return the sentence on claims whose numbers were put in; empty where there are none."""
    return (
        f" {made} more are not tested: the phantom or the model was made with their numbers." if made else ""
    )


def _here(row: Row) -> str:
    """Return the number found here as a cell; that of a test says so."""
    test = "p = " if row["unit"] == _P_VALUE and row["here"] else ""
    return test + value_cell(row["here"])


_SAME_TRIALS = "Same trials"


def _claims_of_the_diagnosed(study: Study) -> dict[str, dict[str, str]]:
    """Return further columns of the claims as cells by claim; none where nobody was diagnosed.

    ``Same trials`` is there where the study holds calibration people or trials that the fits with causes do not.
    """
    if not study.sharing.explained:
        return {}
    causes, same = ({row["claim"]: row for row in found.rows} for found in study.sharing.explained[2:])
    out = {
        _SAME_TRIALS: {row["claim"]: _other_value(row, same[row["claim"]]) for row in study.claims.rows},
        "With causes": {name: _other_value(row, causes[name]) for name, row in same.items()},
    }
    if not any(out[_SAME_TRIALS].values()):
        del out[_SAME_TRIALS]
    return out


def _other_value(row: Row, other: Row) -> str:
    """Return the value of a claim by another analysis, and its verdict where that is another one; or nothing."""
    if other["here"] == row["here"]:
        return ""
    verdict = other["verdict"]
    judged = f" <span class='small'>{escape(verdict)}</span>" if verdict != row["verdict"] else ""
    return f"{_here(other)}{judged}"


def paper_gap_section(study: Study) -> str:
    """The causes whose cohorts come nearest to the paper's numbers."""
    if study.paper_gap is None:
        return ""
    return section(
        "paper-gap",
        "Which gap would have made the paper's numbers?",
        told(read_json(study.paper_gap, PAPER_GAP_KEYS), figure(study, "paper_gap")),
        '<p class="small tools">All numbers: '
        f"{download(study.paper_gap.name, study.paper_gap.read_bytes(), 'application/json')}</p>",
    )
