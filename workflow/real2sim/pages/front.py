"""The front of a study's report: question, cause, place, how far the gap closes, trust, and what to record next."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from real2sim.diagnosis.stated import answer_probability
from real2sim.pages.diagnosis import (
    STAGES,
    answer_words,
    chi2_closed,
    chi2_per_residual,
    is_shown_by_fitted,
    shows_gap,
)
from real2sim.pages.page import likely, listed, percent, rounded
from real2sim.pages.validation import SINGLE, SURE, SURE_SINGLE, latest_and_largest

# Names of a person each up to so many, else their number
_NAMED = 6

Diagnosis = Mapping[str, Any]


def front(diagnoses: Sequence[Diagnosis], records: Sequence[Mapping[str, Any]]) -> str:
    """Return the question and its answer for this cohort as markup; empty where nobody was diagnosed.

    ``diagnoses`` are contents of diagnosis.json, ``records`` scored suites (resources/validation).
    """
    if not diagnoses:
        return ""
    told = {
        "The question": "Why do simulation and measurement of these people differ, and how much of the difference goes "
        "once its cause is in the simulation?",
        "Which cause": escape(_which(diagnoses)),
        "Where": _where(diagnoses),
        "How far it closes": escape(_how_far(diagnoses)),
        "Can it be trusted?": _trust(diagnoses, records),
        "What to record next": escape(_next(diagnoses)),
    }
    rows = "\n".join(f"<dt>{escape(k)}</dt><dd>{markup}</dd>" for k, markup in told.items() if markup)
    return f'<dl class="front">\n{rows}\n</dl>'


def _people(names: Sequence[str], of: int) -> str:
    if len(names) == of:
        return "everyone" if of > 1 else names[0]
    if len(names) > _NAMED:
        return f"{len(names)} of {of} people"
    return listed(names)


def _grouped(pairs: Sequence[tuple[str, str]]) -> list[tuple[str, list[str]]]:
    """Names of people by what they have in common, the commonest first."""
    common = Counter(what for what, _ in pairs)
    return [(what, [name for other, name in pairs if other == what]) for what, _ in common.most_common()]


def _which(diagnoses: Sequence[Diagnosis]) -> str:
    groups = _grouped([(answer_words(d), str(d["subject"])) for d in diagnoses])
    sure = {str(d["subject"]): answer_probability(d) for d in diagnoses}
    words = "; ".join(
        f"{what}: {_people(names, len(diagnoses))} ({_between([sure[name] for name in names])})"
        for what, names in groups
    )
    return f"{words}. In brackets: the probability of the answer."


def _between(shares: Sequence[float]) -> str:
    low, high = likely(min(shares)), likely(max(shares))
    return low if low == high else f"{low} to {high}"


def _where(diagnoses: Sequence[Diagnosis]) -> str:
    """The stages of the simulation with the people whose gap lies in each, as markup."""
    shown = [d for d in diagnoses if shows_gap(d)]
    if not shown:
        return "Nowhere that these recordings show."
    people = dict(_grouped([(str(d["where"]["stage"]), str(d["subject"])) for d in shown]))
    unusual = {stage: stage for stage in people if stage not in STAGES}
    items = "".join(
        _stage(words, people.get(stage, []), len(diagnoses)) for stage, words in (STAGES | unusual).items()
    )
    return f'<ul class="stages">{items}</ul>'


def _stage(words: str, names: Sequence[str], of: int) -> str:
    """A stage of the simulation with the people whose gap lies there, of so many."""
    name, _, about = words.rstrip(")").partition(" (")
    note = f' <span class="small">{escape(about)}</span>' if about else ""
    who = f"<strong>{escape(_people(names, of))}</strong>" if names else '<span class="small">nobody</span>'
    mark = ' class="here"' if names else ""
    return f"<li{mark}><span>{escape(name)}</span>{note} {who}</li>"


def _how_far(diagnoses: Sequence[Diagnosis]) -> str:
    named = [
        (d, both, closed)
        for d in diagnoses
        if (both := chi2_per_residual(d)) is not None and (closed := chi2_closed(d)) is not None
    ]
    if not named:
        return ""
    before, after = (statistics.median(both[i] for _, both, _ in named) for i in (0, 1))
    least, shares = min(named, key=lambda one: one[2]), [closed for *_, closed in named]
    change = "falls" if after < before else "goes"
    text = (
        f"On {_shown_trial([d for d, *_ in named])} the misfit {change} from {rounded(before, 2)} to "
        f"{rounded(after, 2)} times what noise leaves{f' (medians of {len(named)})' * (len(named) > 1)}. That closes "
        f"{percent(statistics.median(shares))} of chi-squared above noise"
    )
    if len(named) > 1 and percent(least[2]) != percent(statistics.median(shares)):
        text += f", for {least[0]['subject']} {percent(least[2])}"
    return f"{text}."


def _shown_trial(diagnoses: Sequence[Diagnosis]) -> str:
    """Return the words for the trial that shows the gap of these people."""
    fitted = [str(d["subject"]) for d in diagnoses if is_shown_by_fitted(d)]
    if len(fitted) == len(diagnoses):
        return "the fitted trial, which alone shows the gap,"
    if not fitted:
        return "the trial that was not fitted"
    who = _people(fitted, len(diagnoses))
    return f"the trial that was not fitted ({who}: on the fitted one, which alone shows the gap)"


def _trust(diagnoses: Sequence[Diagnosis], records: Sequence[Mapping[str, Any]]) -> str:
    """Doubt about the answers here, and how often such answers were right in scored suites, as markup."""
    marked = [str(d["subject"]) for d in diagnoses if d.get("misfit") and d["misfit"]["marked"]]
    parts = []
    if marked:
        text = f"More than noise is left beside what is named for {_people(marked, len(diagnoses))} (misfit mark)."
        parts.append(escape(text))
    scored = [text for claim, words in _CLAIMS.items() if (text := _scored(records, claim, words))]
    if not latest_and_largest(records, SURE):
        scored = [*filter(None, [_scored(records, SURE_SINGLE, _SINGLE)]), *scored]
    if scored:
        parts.append(
            "How often it is right about real people is not known. On synthetic people whose cause was withheld, in "
            "the latest suite that asked each question and, where that is another one, in the largest (by the code "
            "of its day; 95 % intervals in brackets):"
        )
        parts.append("<ul>" + "".join(f"<li>{escape(text)}</li>" for text in scored) + "</ul>")
    return "\n".join(parts)


def _scored(records: Sequence[Mapping[str, Any]], claim: str, words: str) -> str:
    """Return a claim of the latest suite that asked it and of the largest one; empty where none did."""
    rows = latest_and_largest(records, claim)
    if not rows:
        return ""
    shares = [f"{percent(row['value'])} {_interval(row)} of {row['n']}" for row in rows]
    dates = [str(row["date"])[:10] for row in rows]
    larger = f"; largest suite, of {dates[1]}: {shares[1]}" if len(rows) > 1 else ""
    return f"{words.format(share=shares[0])} ({dates[0]}){larger}"


def _interval(row: Mapping[str, Any]) -> str:
    low, high = (percent(end) for end in row["wilson95"])
    return f"[{low}, {high}]"


# What a reader asks of a scored suite before they trust an answer
_CLAIMS = {
    SURE: "answers surer than 90 %, whatever the cause (right: exactly the cause, of two both): {share} right",
    "false alarm on null": "no cause there: {share} people given one",
    "left out: a wrong name surer than 90 %": "the cause taken out of the catalogue (a name of the same group that "
    "closes as much counts as right): {share} answers a wrong name surer than 90 %",
    "left out: another name that closes as much, surer than 90 %": "the cause taken out of the catalogue: {share} "
    "answers such a name of the same group, surer than 90 %",
    "random law: unknown, or an equal law": "a law that nobody listed: {share} answers unknown, or a cause that closes "
    "as much",
}
# Asked where no suite has counted all answers
_SINGLE = f"{SINGLE}: {{share}} right"


def _next(diagnoses: Sequence[Diagnosis]) -> str:
    asked = _grouped([(str(d["next_trial"]), str(d["subject"])) for d in diagnoses if d["next_trial"]])
    if not asked:
        return "Nothing more: no answer is split."
    words = " ".join(f"{_people(names, len(diagnoses))}: {trial}." for trial, names in asked[:_NAMED])
    rest = len(diagnoses) - sum(len(names) for _, names in asked)
    more = f" {len(asked) - _NAMED} more stand in the table." if len(asked) > _NAMED else ""
    return words + more + (" Of the others nothing more." if rest else "")
