"""Write the tables of how often the diagnosis is right into the documents, from the records of scored suites.

python docs/make_validation_tables.py [--check]

Reads resources/validation/*.json; writes into docs/diagnosis.md and docs/measured-law.md, the latest suite first.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.pages.validation import SURE, SURE_SINGLE, latest_first

START, END = "<!-- suites: made by docs/make_validation_tables.py -->\n", "<!-- end of suites -->\n"
STRATA = {"left out": "a cause taken out of the catalogue", "random law": "a random law"}
# Claims of the score by the words of their row in docs/diagnosis.md
CLAIMS = {
    "every answer surer than 90 %: right; one of two causes named first counted, too": (
        SURE,
        "every answer surer than 90 %: right, or one of two causes named first",
    ),
    "right where surer than 90 %, one cause or none (no pair, cause taken out or random law)": (SURE_SINGLE,),
    "cause named first, visibility 0.2 and more; 0.05": ("cause, top-1, rho >= 0.2", "top-1, rho = 0.05"),
    "a cause named, or `unknown`, where there is none": ("false alarm on null",),
    "cause outside the catalogue: `unknown`; a wrong name": (
        "out of library: unknown",
        "out of library: a wrong name",
    ),
    "another equation of a known effect: family right": ("form mismatch: family",),
    "two causes: both among the first three; exactly both": (
        "mixture: both in the top 3",
        "mixture: exact set",
    ),
    "two along one axis: both among the first three; exactly both": (
        "pair on one axis: both in the top 3",
        "pair on one axis: exact set",
    ),
} | {
    f"{words}: {asked}": tuple(f"{stratum}: {claim}" for claim in claims)
    for stratum, words in STRATA.items()
    for asked, claims in {
        "`unknown`, or a cause that closes as much": ("unknown, or an equal law",),
        "a wrong name surer than 90 %": ("a wrong name surer than 90 %",),
        "another name that closes as much, surer than 90 % (counted as right)": (
            "another name that closes as much, surer than 90 %",
        ),
    }.items()
}
# Claims on answers and on their measured laws, by the columns of docs/measured-law.md
LAW = {
    "`unknown`, or as good": "{}: unknown, or an equal law",
    "a wrong name surer than 90 %": "{}: a wrong name surer than 90 %",
    "law: stage": "{}, law: stage",
    "axes": "{}, law: axes",
    "all variables": "{}, law: variables",
    "kind": "{}, law: kind",
    "gap closed (median)": "{}, law: gap closed, median",
    "made worse": "{}, law: made worse",
}


def share(row: Mapping[str, Any] | None) -> str:
    """Return a claim's share with its interval and count; bold where it misses its target, a dash where none asked."""
    if row is None or row["value"] is None:
        return "-"
    value = 100 * row["value"]
    target = re.search(r"\d+\.?\d*", row["target"])
    # a decimal where rounding would hide on which side of the target it is
    digits = 1 if target and round(value) == float(target[0]) and value != round(value) else 0
    text = f"{value:.{digits}f} %"
    if row["wilson95"]:
        text += " ({:.0f}-{:.0f})".format(*(abs(100 * end) for end in row["wilson95"]))
    return (f"**{text}**" if row["met"] is False else text) + f" of {row['n']}"


def people(record: Mapping[str, Any]) -> str:
    """Return the words for the people of a record: how many, seed, day and code."""
    asked = "" if record["cases"] == record["planned"] else f" of {record['planned']}"
    return f"{record['cases']}{asked}, seed {record['seed']} ({record['date'][:10]}, {record['commit']})"


def suites(records: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table in docs/diagnosis.md."""
    yield "| people | claim | result |\n|---|---|---|\n"
    for record in records:
        rows = {row["claim"]: row for row in record["claims"]}
        name = people(record)
        for words, claims in CLAIMS.items():
            found = [share(rows.get(claim)) for claim in claims]
            if set(found) != {"-"}:
                yield f"| {name} | {words} | {'; '.join(found)} |\n"
                name = "the same"


def laws(records: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table in docs/measured-law.md."""
    yield f"| people | cause | {' | '.join(LAW)} |\n|---|---|{'---|' * len(LAW)}\n"
    for record in records:
        rows = {row["claim"]: row for row in record["claims"]}
        for stratum, words in STRATA.items():
            found = [share(rows.get(claim.format(stratum))) for claim in LAW.values()]
            if set(found) != {"-"}:
                yield f"| {people(record)} | {words} | {' | '.join(found)} |\n"


def page(path: Path, lines: Iterator[str]) -> str:
    """Return a document with the lines between its two marks."""
    before, _, rest = path.read_text(encoding="utf-8").partition(START)
    after = rest.partition(END)[2]
    if not rest or not after:
        sys.exit(f"{path}: without the marks {START.strip()} and {END.strip()}")
    return before + START + "".join(lines) + END + after


def main() -> int:
    """Write the tables, or with --check say whether they are current."""
    folder = ROOT / "resources" / "validation"
    records = latest_first([json.loads(p.read_text(encoding="utf-8")) for p in sorted(folder.glob("*.json"))])
    made = {
        path: page(path, lines(records))
        for path, lines in (
            (ROOT / "docs" / "diagnosis.md", suites),
            (ROOT / "docs" / "measured-law.md", laws),
        )
    }
    if "--check" in sys.argv:
        return int(any(path.read_text(encoding="utf-8") != text for path, text in made.items()))
    for path, text in made.items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
