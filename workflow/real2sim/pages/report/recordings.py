"""Who took part, the quality of their recordings, tightness of the strap."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from html import escape
from typing import Any

from real2sim.pages.page import folded, paragraph, rounded, section, table, verdict
from real2sim.pages.quality import warnings_of_files
from real2sim.pages.report.parts import (
    DASH,
    by_subject,
    downloads,
    figure,
    one_by_one,
    percent_cell,
    row_of,
    value_cell,
    words,
)
from real2sim.pages.report.study import Study
from real2sim.pages.report.top import verdicts_of_people
from real2sim.pages.style import signed
from real2sim.recording.quality.verdict import PASS, REFUSE, WARN, worst


def cohort_section(study: Study) -> str:
    """Everyone of the study in a row each."""
    gates, values = verdicts_of_people(study), by_subject(study.identification.identifiability.rows)
    points = {b["subject"]: b["operating_point"] for b in study.tightness.people}
    diagnosed = {d["subject"]: d for d in study.diagnoses}
    rows = []
    for name, kind in study.people.items():
        own = gates[name]
        cross, loso = (
            row_of(study.identification.cross_trial.rows, name),
            row_of(study.sharing.loso.rows, name),
        )
        verdicts = Counter(row["verdict"] for row in values.get(name, []))
        grave = worst(own)
        row = [
            escape(name),
            escape(kind),
            str(own.total()),
            verdict(grave, f"{own[grave]} {grave}" if grave != PASS else "pass"),
            rounded(points.get(name, {}).get("selected_cm"), 3),
            value_cell(cross["J_within_mean_1"]) if cross else DASH,
            value_cell(cross["J_floor_1"]) if cross else DASH,
            f"{verdicts['determined']} of {verdicts.total()}" if verdicts else DASH,
            percent_cell(loso["overhead_J_percent"]) if loso else DASH,
        ]
        if study.diagnoses:
            d = diagnosed.get(name)
            row.append(escape(words(d["verdict"])) if d else DASH)
        rows.append(row)
    head = [
        "Person",
        "Cohort",
        "Trials",
        "Gates",
        "T* [cm]",
        "J",
        "J of neutral",
        "Determined",
        "LOSO overhead",
    ]
    caption = (
        "Everyone of the study. J: mean over the dynamic trials of the best fit's cost; J of neutral: that of the "
        "neutral trial, replayed with the best fit, which is measurement noise and a little sway (the diagnosis "
        "simulates the noise of a dynamic trial instead); determined: values that their trial determines; LOSO "
        "overhead: what the prior of the others costs, in J."
    )
    head += ["Diagnosis"] if study.diagnoses else []
    markup = table(head, rows, caption=caption, numeric=(2, 4, 5, 6, 8))
    return section("cohort", "The cohort", one_by_one(study, markup))


def gates_section(study: Study) -> str:
    """Warnings and refusals of the gates, and warnings that reading the files gave."""
    counts = verdicts_of_people(study)
    rows = [
        [escape(name), *(str(counts[name][verdict]) for verdict in (PASS, WARN, REFUSE))]
        for name in study.people
    ]
    markup = table(
        ["Person", "Pass", "Warn", "Refuse"],
        rows,
        caption="Trials by the gravest verdict of their gates, before anything is fitted",
        numeric=(1, 2, 3),
    )
    summary = one_by_one(study, markup)
    found = [row for row in study.quality.rows if row["verdict"] != PASS and row["source"] == "gate"]
    files = warnings_of_files(
        [
            (f"{row['subject']} {row['trial']}", row["gate"], row["message"], row["remedy"])
            for row in study.quality.rows
            if row["source"] == "finding"
        ]
    )
    listed = [
        [
            escape(f"{row['subject']} {row['trial']}"),
            verdict(row["verdict"], row["verdict"] + (", overridden" if row["overridden"] == "true" else "")),
            escape(words(row["gate"])),
            escape(row["message"]),
            escape(row["remedy"]),
        ]
        for row in found
    ]
    if not listed:
        return section(
            "quality",
            "Quality of the recordings",
            summary,
            paragraph("No gate warns or refuses."),
            files,
            downloads(study.quality),
        )
    detail = table(
        ["Trial", "Verdict", "Gate", "What was found", "What helps"],
        listed,
        caption="Every warning and refusal. A refused trial stops its fit unless it is overridden by name",
    )
    body = folded(f"{len(listed)} warnings and refusals", detail, unfolded=len(listed) <= 12)
    return section("quality", "Quality of the recordings", summary, body, files, downloads(study.quality))


def tightness_section(study: Study) -> str:
    """Sweeps of the strap, and the level that was selected."""
    pooled = study.tightness.pooled
    rows = [
        [
            {"dphi": "Pelvic rotation", "dx": "Forward and back", "dy": "Left and right"}.get(
                name, escape(name)
            ),
            escape(about["status"]),
            _exists(about),
            rounded(about.get("breakpoint")) if about.get("exists") else DASH,
            rounded(about.get("p_value")),
            str(about.get("n_subjects", DASH)),
        ]
        for name, about in pooled.items()
    ]
    regressions = table(
        ["Motion", "Status", "Breakpoint", "At normalised tightness", "p", "People"],
        rows,
        caption="Is there a level beyond which a tighter strap takes no more motion away? Two-segment regression of "
        "all people",
        numeric=(3, 4, 5),
    )
    points = [
        [
            escape(b["subject"]),
            rounded(b["operating_point"].get("selected_cm")),
            rounded(b["operating_point"].get("knee_cm")),
            _centimetres(b["operating_point"].get("difference_cm")),
            escape(str(b["operating_point"].get("status", ""))),
        ]
        for b in study.tightness.people
    ]
    chosen = table(
        ["Person", "Selected [cm]", "Knee [cm]", "Difference [cm]", "Status"],
        points,
        caption="Operating point T*: what was selected in the lab beside the knee of the person's own sweep",
        numeric=(1, 2, 3),
    )
    doubts = [
        paragraph(f"Check subject.yaml of {b['subject']}: {b['warning']}.")
        for b in study.tightness.people
        if b.get("warning")
    ]
    return section(
        "tightness",
        "Tightness and operating point",
        *doubts,
        f'<div class="grid">{figure(study, "tightness")}<div>{regressions}{one_by_one(study, chosen)}</div></div>',
    )


def _exists(regression: Mapping[str, Any]) -> str:
    if "exists" not in regression:
        return DASH
    return verdict("determined", "yes") if regression["exists"] else "no"


def _centimetres(value: float | None) -> str:
    return DASH if value is None else signed(value, 2)
