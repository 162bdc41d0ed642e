"""How often answers of the diagnosis are right: scored suites, as the report shows them beside its answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from real2sim.pages.page import folded, paragraph, percent, rounded, table

RECORD_KEYS = ("suite", "seed", "rests_on", "cases", "planned", "commit", "date", "claims")
SURE = "every answer surer than 90 %: right"
SURE_SINGLE = "right where surer than 90 %: one cause or none, neither left out nor a random law"
SINGLE = (
    "answers surer than 90 % where one cause or none acts (none taken out of the catalogue, no drawn law)"
)
_CLEAR = "one cause, visibility 0.2 and more"
_FAINT = "one cause, visibility 0.05"
_BOTH_SEEN = "two causes at once that could each be seen alone"
_SHARE = "share of J above noise closed on the held-out trial, relative to the true structure"
_PAIR = "two causes along one axis"
# Claims of a score that a reader asks first, in plain words
FIRST = {
    "cause, top-1, rho >= 0.2": f"{_CLEAR}: named first",
    "top-1, rho = 0.05": f"{_FAINT}: named first",
    "mixture: both in the top 3": "two causes at once: both among the first three",
    "form mismatch: family": "a cause with another equation than the catalogue's: named",
    "out of library: unknown": "a cause that is not in the catalogue: unknown",
    "out of library: a wrong name": "a cause that is not in the catalogue: a wrong name",
    "false alarm on null": "no cause at all: one is claimed all the same",
    SURE: "every answer surer than 90 %: right, of two causes with both named",
    SURE_SINGLE: f"{SINGLE}: right",
    "left out: unknown, or an equal law": "a cause taken out of the catalogue: unknown, or another that closes as much",
    "left out: a wrong name surer than 90 %": "a cause taken out of the catalogue: a wrong name, and sure",
    "left out: another name that closes as much, surer than 90 %": "a cause taken out of the catalogue: another that "
    "closes as much, and sure; counted as right",
    "left out, law: stage": "its measured law: in the right stage",
    "left out, law: axes": "its measured law: along the right axes",
    "left out, law: gap closed, median": "its measured law: share of J above noise that it closes, median",
    "random law: unknown, or an equal law": "a law that nobody listed: unknown, or a cause that closes as much",
    "random law: a wrong name surer than 90 %": "a law that nobody listed: a wrong name, and sure",
    "random law: another name that closes as much, surer than 90 %": "a law that nobody listed: a cause that closes as "
    "much, and sure; counted as right",
    "random law, law: stage": "the law that was measured: in the right stage",
    "random law, law: axes": "the law that was measured: along the right axes",
    "random law, law: gap closed, median": "the law that was measured: share of J above noise that it closes, median",
}
_FURTHER = {
    "ambiguity group, rho >= 0.2": f"{_CLEAR}: it or an effect that counts as the same answer named first",
    "top-3, rho >= 0.2": f"{_CLEAR}: among the first three",
    "in library, rho >= 0.2: answered": f"{_CLEAR}: a cause named, and not none or unknown",
    "right where surer than 90 %, rho = 0.05": f"{_FAINT}: right where surer than 90 %",
    "top-1, rho below 0.025: less than was asked for": "one cause, visibility below 0.025 (less than was asked for): "
    "named first",
    "misfit mark: cause of the catalogue named": "a cause of the catalogue, named rightly: misfit mark all the same",
    "misfit mark: another equation named": "a cause with another equation, named: misfit mark",
    "mixture: exact set": "two causes at once: these two named and no others",
    "mixture of two that each can be seen: both in the top 3": f"{_BOTH_SEEN}: both among the first three",
    "mixture of two that each can be seen: exact set": f"{_BOTH_SEEN}: these two named and no others",
    "pair on one axis: both in the top 3": f"{_PAIR}: both among the first three",
    "pair on one axis: exact set": f"{_PAIR}: these two named and no others",
    "pair on one axis: unknown": f"{_PAIR}: unknown",
    "pair on one axis: another set, sure and not marked": f"{_PAIR}: others named, surer than 90 % and without misfit "
    "mark",
    "where: stage": "place of the gap: right stage",
    "where: axis": "place of the gap: right axis",
    "where: regime F1": "regimes of motion with most of the gap: F1 score",
    "gap closed on the held-out regime, median": f"{_SHARE}, median",
    "gap closed, 10th percentile": f"{_SHARE}, 10th percentile",
    "made worse": "J is larger with the answer than without",
    "gap closed of what lies above the estimated floor, median": "share of J above the noise floor of the answer "
    "closed, median",
    "RMS ln-error of K, D cut by (median)": "error of stiffness and damping (RMS of ln): divided by (median)",
    "RMS ln-error of the determined K, D cut by (median)": "the same of those called determined: divided by (median)",
    "95 % intervals of the determined K, D hold the truth": "95 % intervals of determined stiffness and damping: "
    "hold the truth",
    "RMS ln-error of K, D on null, times (median)": "no cause at all: error of stiffness and damping (RMS of ln), "
    "multiplied by (median)",
    "expected calibration error": "probabilities: expected calibration error",
    "90 % sets: coverage": "smallest sets of answers with 90 % probability: hold the truth",
    "90 % sets: mean size": "smallest sets of answers with 90 % probability: mean size",
}
# Claims on cases whose law no effect of the catalogue is, by the beginning and the end of their names
_UNLISTED = {
    "left out": ("a cause taken out of the catalogue", "its measured law"),
    "random law": ("a law that nobody listed", "the law that was measured"),
}
_OF_LAWS = {
    "variables": "all variables that it depends on found",
    "these variables and no others": "exactly its variables found",
    "kind": "right kind",
    "gap closed, 10th percentile": "share of J above noise that it closes, 10th percentile",
    "made worse": "J is larger with it than without",
}


def claim_words(name: str) -> str:
    """Return a claim of a scored suite in plain words; a name without any as it is."""
    start, _, end = name.partition(", law: ")
    if name in FIRST or name in _FURTHER:
        return (FIRST | _FURTHER)[name]
    if end and start in _UNLISTED:
        return f"{_UNLISTED[start][1]}: {_OF_LAWS.get(end, end)}"
    start, _, end = name.partition(": ")
    return f"{_UNLISTED[start][0]}: {end}" if start in _UNLISTED else name


def target_words(target: str) -> str:
    """Return the target of a claim with typographic signs and the name that the documents have for rho."""
    signs = {">=": "\N{GREATER-THAN OR EQUAL TO}", "<=": "\N{LESS-THAN OR EQUAL TO}", "rho": "visibility"}
    for old, new in signs.items():
        target = target.replace(old, new)
    return target


def latest_first(records: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return records of scored suites, the latest one first."""
    return sorted(records, key=lambda r: (str(r["date"]), str(r["suite"])), reverse=True)


def latest_and_largest(records: Sequence[Mapping[str, Any]], claim: str) -> list[Mapping[str, Any]]:
    """Return the claim's row of the latest record that has a value of it, and of the one with most cases if another.

    Each row has the ``date`` of its record as well. Of two records with as many cases, the later one counts.
    """
    found = [
        {**row, "date": record["date"]}
        for record in latest_first(records)
        for row in record["claims"]
        if row["claim"] == claim and row["value"] is not None
    ]
    if not found:
        return []
    largest = max(found, key=lambda row: row["n"])
    return [found[0]] if largest is found[0] else [found[0], largest]


def withheld_check(records: Sequence[Mapping[str, Any]]) -> str:
    """Return what scored suites say of answers like these, as markup; empty without a record.

    ``records`` are files of resources/validation (`RECORD_KEYS`).
    """
    if not records:
        return ""
    latest = latest_first(records)
    parts = [
        paragraph(
            "How often is such an answer right? The diagnosis, as of the commit that the table names, answered for "
            "people whose causes were withheld from it until its answers were scored. None of them is a recording of "
            "a person: how often an answer about a real person is right is not known."
        )
    ]
    shown: set[str] = set()
    for record in latest:
        whole = _table(record, [row for row in record["claims"] if row["value"] is not None])
        first = [row for row in record["claims"] if row["claim"] in FIRST and row["value"] is not None]
        name = f"suite {record['suite']}, seed {record['seed']}"
        if record["suite"] not in shown:
            shown.add(record["suite"])
            parts.append(_table(record, sorted(first, key=lambda row: list(FIRST).index(row["claim"]))))
            parts.append(folded(f"All claims of the {name}", whole))
        else:
            parts.append(folded(f"An earlier one: {name}, {record['date']}", whole))
    return "\n".join(parts)


def _table(record: Mapping[str, Any], claims: Sequence[Mapping[str, Any]]) -> str:
    rows = [
        [
            escape(claim_words(row["claim"])),
            _value(row),
            _interval(row),
            str(row["n"]),
            escape(target_words(row["target"])),
            {True: "met", False: "missed", None: ""}[row["met"]],
        ]
        for row in claims
    ]
    note = f" {record['note']}" if record.get("note") else ""
    caption = (
        f"Suite {record['suite']}, seed {record['seed']}: {record['cases']} of {record['planned']} cases "
        f"answered.{note} Rests on the {record['rests_on']}. Code of commit {record['commit']}, {record['date']}. "
        "Interval: Wilson, 95 %. Visibility: gap of a case over its noise floor."
    )
    head = ["Claim", "Share or value", "95 % interval", "Cases", "Goal", "Goal met"]
    return table(head, rows, caption=escape(caption), numeric=(1, 2, 3))


def _value(row: Mapping[str, Any]) -> str:
    if row["wilson95"]:
        return percent(row["value"], 1)
    return percent(row["value"]) if "%" in str(row["target"]) else rounded(row["value"])


def _interval(row: Mapping[str, Any]) -> str:
    if not row["wilson95"]:
        return ""
    low, high = row["wilson95"]
    return f"{percent(low)} to {percent(high)}"
