"""Score of causes that the catalogue does not hold when they are diagnosed: strata `left_out` and `random_law`.

The right answer is `unknown` with the law measured (``free_form`` in diagnosis.json), or a listed law that is as good:
one of the true one's ambiguity group, or that the suite states as its kin, that closes at least 95 % of what could be
closed. Rules of the single claims stand with the functions that judge them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from real2sim.diagnosis.decide import NONE, UNKNOWN
from real2sim.effects.catalogue import EFFECTS, GROUPS, are_confusable
from real2sim.verification.claims import Row, claim, figure
from real2sim.verification.suite.true_laws import library_law

STRATA = {"left_out": "left out", "random_law": "random law"}
# An answer is sure above this probability
SURE = 0.9
# Share of what could be closed that a listed law closes which is as good as the true one
AS_MUCH = 0.95
_STAGE_OF = {effect.name: effect.stage for effect in EFFECTS}
_ALL_POSTURES = ("tilt", "list", "heading")


def score_unlisted(rows: Sequence[Row]) -> list[Row]:
    """Return the lines of the target table for the strata that the rows have, first all answers, then their laws.

    A row holds ``case`` (sealed truth) and ``answer`` (diagnosis.json).
    """
    out: list[Row] = []
    for stratum, words in STRATA.items():
        own = [row for row in rows if row["case"]["stratum"] == stratum]
        if own:
            out += [*_score_answers(own, words), *_score_laws(own, words), *_score_closed(own, words)]
    return out


def unlisted_by_form(rows: Sequence[Row]) -> list[Row]:
    """Return one entry per form of the two strata: how many answers are right, and how much of the laws is."""
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        if row["case"]["stratum"] in STRATA:
            groups[row["case"]["stratum"], row["case"]["effects"][0]["form"]].append(row)
    return [
        {"stratum": stratum, "form": form, "n": len(own), "right": sum(map(answers_rightly, own))}
        | _laws_of(own)
        for (stratum, form), own in sorted(groups.items())
    ]


def _laws_of(rows: list[Row]) -> Row:
    judged = [judge_law(row) for row in rows if row["answer"].get("free_form")]
    closed = [j["closed"] for j in judged if j["closed"] is not None]
    counts = {key: _count([j[key] for j in judged]) for key in ("stage", "axes", "variables", "kind")}
    return {"laws": len(judged), **counts, "closed": float(np.median(closed)) if closed else None}


def _count(verdicts: list[bool | None]) -> list[int]:
    judged = [v for v in verdicts if v is not None]
    return [sum(judged), len(judged)]


# -------------------- answers


def answers_rightly(row: Row) -> bool:
    """Return whether the verdict is `unknown` or a listed law that is as good as the true one."""
    return row["answer"]["verdict"] == UNKNOWN or is_as_good(row)


def is_as_good(row: Row) -> bool:
    """Return whether the verdict names a law of the true one's group, or kin of it, that closes as much.

    It has to close it by both measures. J of the trial that shows the gap: from the plain fit to the best set that the
    search refitted, or to the upper end of the noise floor's 95 % interval where that is lower. Chi-squared of both
    trials: from the plain fit to its expectation. J alone knows its floor to some 10 %, and passes laws that leave
    hundreds of standard deviations.
    """
    answer = row["answer"]
    if answer["verdict"] in (NONE, UNKNOWN) or answer["verdict"] not in accepted(row["case"]):
        return False
    gap = answer["gap"]
    highest_floor = answer.get("noise_floor", {}).get("ci95", [gap["J_floor"]])[-1]
    least = min([highest_floor, *(h["J"] for h in answer.get("considered", []) if h["effects"])])
    plain, best, expected = (sum(gap[f"chi2_{key}"]) for key in ("plain", "best", "expected"))
    by_cost = gap["J_base"] - gap["J_with_effect"] >= AS_MUCH * (gap["J_base"] - least)
    return bool(by_cost and plain - best >= AS_MUCH * (plain - expected))


def accepted(case: Row) -> set[str]:
    """Return the names of the catalogue whose law may be as good as the true one."""
    effect = case["effects"][0]
    if case["stratum"] == "random_law":
        return set(effect["law"]["kin"])
    name = effect["effect"]
    grouped = {other for members in GROUPS.values() if name in members for other in members}
    return (grouped | {other for other in _STAGE_OF if are_confusable(name, other)}) - {name}


def is_wrongly_sure(row: Row) -> bool:
    """Return whether a name that is not as good as the true law has a probability above 0.9."""
    return _is_surely_named(row) and not is_as_good(row)


def _is_surely_named(row: Row) -> bool:
    answer = row["answer"]
    named = answer["verdict"] not in (NONE, UNKNOWN)
    return bool(named and answer["probabilities"][answer["verdict"]] > SURE)


def _score_answers(rows: list[Row], words: str) -> list[Row]:
    unknown = [row for row in rows if row["answer"]["verdict"] == UNKNOWN]
    return [
        claim(
            f"{words}: a wrong name surer than 90 %",
            [is_wrongly_sure(r) for r in rows],
            "<= 3 %",
            lambda v: v <= 0.03,
        ),
        claim(
            f"{words}: another name that closes as much, surer than 90 %",
            [_is_surely_named(r) and is_as_good(r) for r in rows],
            "none: counted as right",
            None,
        ),
        claim(
            f"{words}: unknown, or an equal law",
            [answers_rightly(r) for r in rows],
            ">= 90 %",
            lambda v: v >= 0.90,
        ),
        claim(
            f"{words}: none", [r["answer"]["verdict"] == NONE for r in rows], "none: part of the above", None
        ),
        claim(
            f"{words}: unknown with a law measured",
            [bool(r["answer"].get("free_form")) for r in unknown],
            "none: the claims below are of these",
            None,
        ),
    ]


# -------------------- laws


def judge_law(row: Row) -> dict[str, Any]:
    """Judge a free-form answer: stage, axes, variables, exact variables and kind right, None where nothing is to tell.

    ``closed`` is the share of the gap that it closes on the held-out trial, ``curve`` as of `judge_curve`. An effect of
    `left_out` that cannot be told from one of another stage (timing, rest poses, drifts) counts for either.
    """
    answer, laws = row["answer"]["free_form"], _equivalent(row["case"])
    axes = {axis for law in laws for axis in law["axes"]}
    kinds = {kind for law in laws for kind in law["kinds"]}
    sets = [set(variables) for law in laws for variables in law["depends_on"]]
    named = set(answer["depends_on"])
    return {
        "stage": answer["stage"] in {law["stage"] for law in laws},
        "axes": bool(answer["axes"]) and set(answer["axes"]) <= axes if axes else None,
        "variables": any(holds_variables(true, named) for true in sets) if sets else None,
        "exact": any(holds_variables(true, named) and len(named) <= len(true) for true in sets)
        if sets
        else None,
        "kind": answer["kind"] in kinds if kinds else None,
        "closed": answer["gap_closed"],
        "curve": judge_curve(laws[0]["curves"], answer.get("curve")),
    }


def _equivalent(case: Row) -> list[Row]:
    effect = case["effects"][0]
    if case["stratum"] == "random_law":
        return [effect["law"]]
    others = [
        library_law(other, stage, effect["axes"]).to_dict()
        for other, stage in _STAGE_OF.items()
        if stage != effect["stage"] and are_confusable(effect["effect"], other)
    ]
    return [effect["law"], *others]


def holds_variables(true: set[str], named: set[str]) -> bool:
    """Return whether the named variables contain the true ones.

    Of a law with memory, coordinate, rate and history of one axis are the same variable; so are the orientations of
    pelvis and interface, which turn together.
    """
    return all(_meanings(variable) & named for variable in true)


def _meanings(variable: str) -> set[str]:
    history = "history of " if variable.startswith("history of ") else ""
    plain = variable.removeprefix("history of ")
    turn = plain.partition("_")[2]
    if turn in _ALL_POSTURES:
        return {f"{history}{other}_{turn}" for other in ("pelvis", "interface")}
    return {variable, f"q_{turn}", f"v_{turn}"} if history else {variable}


def judge_curve(curves: Sequence[Row], answer: Row | None) -> dict[str, float] | None:
    """Compare a measured curve with the true one, both without their best straight line over the range they share.

    ``curves`` are those of the true law, of which the one over the answer's variable along its axis counts.

    Stiffness and damping of the plain plant absorb the straight line. ``inside``: share of the visited range (2.5th to
    97.5th percentile of the variable) over which the true curve lies in the 95 % band; what the answer's grid does not
    cover lies outside. ``error``: RMS error of the mean over the RMS of the true curve. None where the answer has no
    curve, or the true law none over that variable along that axis.
    """
    if not answer:
        return None
    same = [curve for curve in curves if curve["variable"] == answer["variable"]]
    true = next((curve for curve in same if curve["along"] in answer["quantity"]), None)
    if true is None:
        return None
    grid, mean, low, high = (np.asarray(answer[key], float) for key in ("grid", "mean", "low", "high"))
    first, last = true["visited"]
    x = np.linspace(first, last, 401)
    covered = (x >= grid[0]) & (x <= grid[-1])
    if np.count_nonzero(covered) < 10:
        return {"inside": 0.0, "error": 1.0}
    x = x[covered]
    line = np.polyfit(x, np.interp(x, grid, mean), 1)
    measured, lower, upper = (np.interp(x, grid, y) - np.polyval(line, x) for y in (mean, low, high))
    exact = np.interp(x, true["grid"], true["force"])
    exact = exact - np.polyval(np.polyfit(x, exact, 1), x)
    inside = float(np.mean((exact >= lower) & (exact <= upper))) * float(covered.mean())
    error = np.sqrt(np.mean((measured - exact) ** 2) / max(float(np.mean(exact**2)), 1e-30))
    return {"inside": inside, "error": float(error)}


def _score_laws(rows: list[Row], words: str) -> list[Row]:
    judged = [judge_law(row) for row in rows if row["answer"].get("free_form")]

    def right(key: str) -> list[bool]:
        return [j[key] for j in judged if j[key] is not None]

    return [
        claim(f"{words}, law: stage", right("stage"), ">= 92 %", lambda v: v >= 0.92),
        claim(f"{words}, law: axes", right("axes"), ">= 88 %", lambda v: v >= 0.88),
        claim(f"{words}, law: variables", right("variables"), ">= 80 %", lambda v: v >= 0.80),
        claim(f"{words}, law: these variables and no others", right("exact"), "none", None),
        claim(f"{words}, law: kind", right("kind"), ">= 80 %", lambda v: v >= 0.80),
    ]


def _score_closed(rows: list[Row], words: str) -> list[Row]:
    judged = [judge_law(row) for row in rows if row["answer"].get("free_form")]
    closed = [j["closed"] for j in judged if j["closed"] is not None]
    curves = [j["curve"] for j in judged if j["curve"] is not None]
    n, m = len(closed), len(curves)
    median = float(np.median(closed)) if n else None
    tenth = float(np.quantile(closed, 0.1)) if n else None
    inside = float(np.mean([c["inside"] for c in curves])) if m else None
    error = float(np.median([c["error"] for c in curves])) if m else None
    return [
        figure(f"{words}, law: gap closed, median", median, n, ">= 90 %", lambda v: v >= 0.90),
        figure(f"{words}, law: gap closed, 10th percentile", tenth, n, ">= 60 %", lambda v: v >= 0.60),
        claim(f"{words}, law: made worse", [c < 0 for c in closed], "<= 2 %", lambda v: v <= 0.02),
        figure(
            f"{words}, law: visited range with the true curve in the 95 % band, mean",
            inside,
            m,
            ">= 90 %",
            lambda v: v >= 0.90,
        ),
        figure(
            f"{words}, law: relative error of the curve, median", error, m, "<= 15 %", lambda v: v <= 0.15
        ),
    ]
