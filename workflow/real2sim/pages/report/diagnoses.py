"""Why simulation and measurement differ: the answers of everyone."""

from __future__ import annotations

import statistics
from collections import Counter
from html import escape

from real2sim.diagnosis.stated import answer_probability
from real2sim.pages.diagnosis import (
    answer_words,
    chi2_closed,
    chi2_per_residual,
    digest,
    shows_gap,
)
from real2sim.pages.page import folded, likely, paragraph, percent, rounded, section, table
from real2sim.pages.report.parts import DASH, MANY_PEOPLE, joined, one_by_one
from real2sim.pages.report.study import Study
from real2sim.pages.validation import withheld_check


def diagnoses_section(study: Study) -> str:
    """The answers of everyone, how often such answers are right, and each person's in short; empty without any."""
    if not study.diagnoses:
        return ""
    digests = "\n".join(
        folded(f"{d['subject']}: {answer_words(d)}", digest(d)) for d in study.diagnoses[:MANY_PEOPLE]
    )
    if len(study.diagnoses) > MANY_PEOPLE:
        digests = paragraph(f"The first {MANY_PEOPLE} of them:") + digests
    return section(
        "diagnosis",
        "Why simulation and measurement differ",
        paragraph(_answers(study)),
        one_by_one(study, _answers_table(study)),
        withheld_check(study.validation),
        digests,
    )


def _answers(study: Study) -> str:
    """The answers of everyone in one sentence."""
    counts = Counter(answer_words(d) for d in study.diagnoses).most_common()
    listed = joined([f"{name} ({n})" for name, n in counts])
    closed = [share for d in study.diagnoses if (share := chi2_closed(d)) is not None]
    one = len(study.diagnoses) == 1
    if one:
        text = f"The answer for the one person who was diagnosed: {answer_words(study.diagnoses[0])}."
    else:
        text = f"The answers for {len(study.diagnoses)} people, and how many have each: {listed}."
    if closed:
        text += (
            f" What was found, a cause or a measured law, closes {percent(statistics.median(closed))} of "
            f"chi-squared above noise{'' if one else ' (median)'}."
        )
    if any(d["verdict"] == "none" for d in study.diagnoses):
        text += (
            " None says that the plain model leaves what noise leaves; the page of each person lists from which size "
            "on an effect would have been seen."
        )
    return text


def _answers_table(study: Study) -> str:
    rows = []
    for d in study.diagnoses:
        gap, where, both = d["gap"], d["where"], chi2_per_residual(d)
        rows.append(
            [
                escape(d["subject"]),
                escape(answer_words(d)),
                likely(answer_probability(d)),
                escape(str(where["stage"]) if shows_gap(d) else DASH),
                rounded(gap["J_base"]),
                rounded(gap["J_floor"]),
                rounded(gap["J_with_effect"]),
                DASH if both is None else " to ".join(map(rounded, both)),
                percent(chi2_closed(d)),
                escape(d["next_trial"] or DASH),
            ]
        )
    head = [
        "Person",
        "Answer",
        "Probability",
        "Stage",
        "J plain",
        "J of simulated noise",
        "J with it",
        "Misfit",
        "Misfit closed",
        "Next trial",
    ]
    caption = (
        "The answer for everyone. J: cost of the held-out trial, or of the fitted one where that alone shows the gap, "
        "with the plain model, of measurement noise alone (noise as in neutral, simulated through the plant for that "
        "trial), and with the answer in the model. Misfit: chi-squared per "
        "residual of that trial without and with the answer; noise leaves 1, and chi-squared sees gaps that J does "
        "not. A sensor whose noise is below the floor to which sensors are trusted (as the phantom's robot log) counts "
        "as if it left no less than 1, so that its silence hides no misfit of the other: the misfit is then more than "
        "chi-squared over its expectation in diagnosis.json. Misfit closed: share of the misfit above noise that goes "
        "with the answer. Next trial: what would separate the likeliest causes."
    )
    return table(head, rows, caption=caption, numeric=(2, 4, 5, 6, 8))
