"""The top of the report: notices and the study in one paragraph."""

from __future__ import annotations

import statistics
from collections import Counter
from html import escape

from real2sim.artefacts import number
from real2sim.pages.page import paragraph, rounded
from real2sim.pages.report.parts import row_of, value_cell
from real2sim.pages.report.study import Study
from real2sim.recording.quality.verdict import REFUSE, WARN, worst
from real2sim.study.paper.claims import SEARCH_TOLERANCE_PERCENT


def notices(study: Study) -> list[str]:
    """Return the notices that a reader needs before any number."""
    found = []
    for name, rows in (
        ("Shareability", study.sharing.icc.rows),
        ("Leave one subject out", study.sharing.loso.rows),
        ("Cross-trial", study.identification.cross_trial.rows),
    ):
        wanting = {row["status"] for row in rows if row.get("status", "").startswith(("needs", "only"))}
        found += [f"{name}: {status}." for status in sorted(wanting)]
    refused = {
        trial
        for rows in (
            study.sharing.icc.rows,
            study.sharing.loso.rows,
            study.identification.identifiability.rows,
            study.identification.cross_trial.rows,
            study.sharing.priors.rows,
        )
        for row in rows
        for trial in row.get("overridden", "").split()
    }
    of_refined = {trial for record in study.sharing.refined for trial in record.get("overridden_gates", {})}
    for trials, what in (
        (refused, "Fitted although a gate refuses it (quality.override): {}. All results rest on it."),
        (
            of_refined - refused,
            "Refined although a gate refuses it (quality.override): {}. What is said of that person rests on it.",
        ),
    ):
        if trials:
            found.append(what.format(", ".join(sorted(trials))))
    found += _not_converged(study)
    return [f'<p class="notice">{escape(text)}</p>' for text in found]


def _not_converged(study: Study) -> list[str]:
    """Return a notice where parameters that were not fitted to a trial cost less than those that were."""
    worse = [
        f"{row['subject']} ({what} {value_cell(row[key])} %)"
        for rows, key, what in (
            (study.sharing.loso.rows, "overhead_J_percent", "prior of the others"),
            (study.identification.cross_trial.rows, "overhead_percent", "other trial"),
        )
        for row in rows
        if row.get(key) and row["subject"] in study.people and number(row[key]) < -SEARCH_TOLERANCE_PERCENT
    ]
    refined = [
        (record["subject"], trial, 100 * (found["against_full"]["J_ratio"] - 1))
        for record in study.sharing.refined
        for trial, found in record["trials"].items()
        if found["against_full"]
    ]
    worse += [
        f"{name} ({trial} from the priors {rounded(change, 3)} %)"
        for name, trial, change in refined
        if change < -SEARCH_TOLERANCE_PERCENT
    ]
    if not worse:
        return []
    return [
        f"Searches have not converged: parameters from elsewhere cost less than a person's own fit for "
        f"{', '.join(worse)}. Give more evaluations or restarts (identification) before numbers are used."
    ]


def _trials(study: Study) -> dict[tuple[str, str], str]:
    """Gravest verdict of the gates on each trial."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in study.quality.rows:
        if row["source"] != "gate":
            continue
        found.setdefault((row["subject"], row["trial"]), []).append(row["verdict"])
    return {key: worst(verdicts) for key, verdicts in found.items()}


def verdicts_of_people(study: Study) -> dict[str, Counter[str]]:
    """Count the trials of each person that pass, are warned about, are refused."""
    counts: dict[str, Counter[str]] = {name: Counter() for name in study.people}
    for (person, _), gravest in _trials(study).items():
        if person in counts:
            counts[person][gravest] += 1
    return counts


def _over_floor(study: Study, name: str) -> float | None:
    row = row_of(study.identification.cross_trial.rows, name)
    if row is None or not row["J_within_mean_1"] or not row["J_floor_1"]:
        return None
    return number(row["J_within_mean_1"]) / number(row["J_floor_1"])


def lead(study: Study) -> str:
    """The study in one paragraph: people, trials, cost of the fits."""
    kinds = Counter(study.people.values())
    gates = Counter(_trials(study).values())
    calibrated = kinds["calibration"]
    text = (
        f"{calibrated} {'person is' if calibrated == 1 else 'people are'} calibrated"
        + (f" and {kinds['validation']} kept for validation" if kinds["validation"] else "")
        + f"; of {gates.total()} trials {gates[WARN]} are warned about and {gates[REFUSE]} refused."
    )
    over = [value for value in (_over_floor(study, name) for name in study.people) if value is not None]
    if over:
        times = rounded(statistics.median(over))
        text += f" The best fits cost {times} times what noise alone costs (median of people)."
    verdicts = Counter(row["verdict"] for row in study.identification.identifiability.rows)
    if verdicts:
        text += f" {verdicts['determined']} of {verdicts.total()} values are determined by their trial."
    return paragraph(text, "" if study.diagnoses else "lead")
