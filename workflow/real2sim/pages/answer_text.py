"""Fits and diagnoses as plain text, for a terminal or a notebook."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import fill
from typing import Any

from real2sim.diagnosis.stated import answer_probability
from real2sim.pages.law import law_sentence
from real2sim.pages.page import percent

# Causes that are less likely are left out
_LEAST = 0.01
_WIDTH = 100  # of a line of prose


def lines_of(rows: Iterable[Sequence[str]]) -> list[str]:
    """Return rows of cells as lines, their columns below each other."""
    table = [list(row) for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(*table, strict=True)]
    return ["  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in table]


def parameter_lines(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return one line per parameter: name, value, unit, 95 % interval and verdict, as far as each has them."""
    rows = []
    for name, entry in parameters.items():
        low, high = entry.get("ci95") or (None, None)
        interval = "" if low is None else f"{low:.4g} to {high:.4g}"
        value = entry["value"] if "value" in entry else entry["with_effect"]
        rows.append([f"  {name}", f"{value:.4g} {entry['unit']}", interval, entry.get("verdict") or ""])
    return lines_of(rows)


def answer_text(name: str, content: Mapping[str, Any], recordings: tuple[str, str]) -> str:
    """Return what a diagnosis of the system or person ``name`` says; ``content`` is that of diagnosis.json.

    ``recordings`` are the names of the one that effects were fitted to and of the one that was held out.
    """
    lines = [f"{name}: {_verdict(content)}", *_otherwise(content), *_left_lines(content["gap"], recordings)]
    for cause in content["causes"]:
        if cause["probability"] >= _LEAST:
            lines += _cause_lines(cause)
    if content["misfit"] and content["misfit"]["marked"]:
        worst = max(content["misfit"]["left_sd"])
        lines.append(f"Its form may not be right: it leaves up to {worst:.0f} standard deviations of noise.")
    if content["free_form"] is not None:
        lines.append(_wrapped(law_sentence(content["free_form"])))
    if content["parameters"]:
        lines += ["Parameters of the model:", *parameter_lines(content["parameters"])]
    lines += _limit_lines(content.get("could_show") or ())
    if content["next_trial"]:
        lines.append(_wrapped(f"To be recorded next: {content['next_trial']}"))
    lines += [
        _wrapped(f"{f['severity'].capitalize()}: {f['file']}, {f['place']}: {f['message']}. {f['action']}")
        for f in content.get("findings") or ()
        if f["severity"] != "info"
    ]
    return "\n".join(lines)


def _verdict(content: Mapping[str, Any]) -> str:
    """Return the verdict with its probability."""
    names = content["verdict_set"]
    named = f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else content["verdict"]
    return f"{named}, probability {answer_probability(content):.3f}"


def _wrapped(text: str) -> str:
    return fill(text, _WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def _otherwise(content: Mapping[str, Any]) -> list[str]:
    """Return the line of what the answer may be instead, beside the causes: nothing, or something unlisted."""
    rest = {n: content["probabilities"].get(n, 0.0) for n in ("none", "unknown") if n != content["verdict"]}
    said = [f"{name} {p:.3f}" for name, p in rest.items() if p >= _LEAST]
    return [f"Otherwise: {', '.join(said)}"] if said else []


def _left_lines(gap: Mapping[str, Any], recordings: tuple[str, str]) -> list[str]:
    """Return what is left of both recordings, in units of what noise leaves of them."""
    rows = []
    for i, role in enumerate(("fitted", "held out")):
        plain, best = (gap[key][i] / gap["chi2_expected"][i] for key in ("chi2_plain", "chi2_best"))
        rows.append(
            [
                f"  {recordings[i]}, {role}",
                f"{plain:.3g} by the plain model",
                f"{best:.3g} with what was found",
            ]
        )
    return ["Left of each recording, in units of noise (1: noise alone):", *lines_of(rows)]


def _limit_lines(could_show: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return from which size on effects would have been seen, where none was."""
    rows = [
        [f"  {e['effect']} {' '.join(e['axes'])}".rstrip(), e["parameter"], f"{e['from']:.2g} {e['unit']}"]
        for e in could_show
        if e["from"] is not None
    ]
    hidden = [f"{e['effect']} {' '.join(e['axes'])}".rstrip() for e in could_show if e["from"] is None]
    lines = ["Would have been seen from:", *lines_of(rows)] if rows else []
    if hidden:
        lines.append(_wrapped(f"Does not show at any size that is searched: {', '.join(hidden)}"))
    return lines


def _cause_lines(cause: Mapping[str, Any]) -> list[str]:
    where = f" along {' and '.join(cause['axes'])}" if cause["axes"] else ""
    beside = f", with {' and '.join(cause['with'])}" if cause["with"] else ""
    share = cause.get("gap_closed")
    closes = "" if share is None else f", takes away {percent(share)} of J above noise"
    head = f"{cause['effect']}{where}: probability {cause['probability']:.3f}{closes}{beside}"
    return [head, *parameter_lines(cause["parameters"])]
