"""Score of a suite: the only code that opens the seal. It compares answers with the truth and judges nothing else."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from statsmodels.stats.proportion import proportion_confint

from real2sim.artefacts import read_json, write_json
from real2sim.diagnosis.decide import NONE, UNKNOWN
from real2sim.diagnosis.stated import answer_probability
from real2sim.effects.catalogue import EFFECT_NAMES, GROUPS
from real2sim.inference.identifiability import DETERMINED
from real2sim.verification.claims import Row, claim, figure, print_table
from real2sim.verification.score_laws import STRATA as UNLISTED
from real2sim.verification.score_laws import SURE, answers_rightly, score_unlisted, unlisted_by_form
from real2sim.verification.score_sizes import held_sizes
from real2sim.verification.suite.plan import STRATA

# Family of each effect: where another equation of the same family is the truth, its name is right
LABELS = (*EFFECT_NAMES, NONE, UNKNOWN)
# Visibilities from which a case counts as one of 0.2 and more, and as one of 0.05: half-way on a logarithmic scale
CLEAR, FAINT = 0.1, 0.025
# A regime of four holds the gap where it holds more than it would if the gap were everywhere alike
_REGIME_SHARE = 0.25
# Share of the floor below which J shows no gap that could be closed
_SMALLEST_GAP = 0.02
# An effect is diagnosable at a visibility at which so many of its cases are named first
_DIAGNOSABLE = 0.8


def _truth_names(case: Row) -> list[str]:
    """Library names that are right for a case: none or unknown where no effect of the library is in it."""
    if case["stratum"].startswith("null"):
        return [NONE]
    if case["stratum"] in ("out_of_library", *UNLISTED):
        return [UNKNOWN]
    return [effect.get("family") or effect["effect"] for effect in case["effects"]]


def _rows(answers: Sequence[Path], truths: Sequence[Path]) -> list[Row]:
    sealed = {case["id"]: case for path in truths for case in read_json(path, ("cases",))["cases"]}
    rows = []
    for listed in answers:
        for name in read_json(listed, ("answers",))["answers"]:
            answer = read_json(Path(name), ("subject", "verdict", "probabilities"))
            case = sealed[answer["subject"]]
            seconds = read_json(Path(name).with_name("seconds.json"), ("seconds",))["seconds"]
            rows.append({"case": case, "answer": answer, "names": _truth_names(case), "seconds": seconds})
    return rows


def _failed(answers: Sequence[Path]) -> list[Row]:
    """Return the cases that failed, with their errors."""
    return [row for listed in answers for row in read_json(listed, ("answers",)).get("failed", [])]


def _group_of(name: str) -> tuple[str, ...]:
    return next((members for members in GROUPS.values() if name in members), (name,))


def _ranked(row: Row) -> list[str]:
    p = row["answer"]["probabilities"]
    return sorted(p, key=lambda name: -p[name])


def score_diagnosis(*, answers: list[Path], truths: list[Path], suite: str, out: Path) -> None:
    """Write the score of a suite: its answers compared with its sealed truth, and each target met or missed.

    ``answers`` are the lists that `answers.diagnose_cases` wrote, ``truths`` the sealed files of the same shards,
    ``out`` a JSON file. The target table is printed. Raises InputError where one of them is broken.
    """
    rows, failed = _rows(answers, truths), _failed(answers)
    by = {
        stratum: [r for r in rows if r["case"]["stratum"] == stratum]
        for stratum in STRATA
        if stratum not in UNLISTED
    }
    listed = [row for own in by.values() for row in own]
    answered = [True] * len(rows) + [False] * len(failed)
    targets = [
        claim("cases that could be answered at all", answered, "100 %", lambda v: v >= 1.0),
        *_score_sure(rows),
        *(_targets(by, by["null"] + by["null_hard"]) if listed else []),
        *score_unlisted(rows),
    ]
    print_table(targets)
    write_json(
        out,
        {
            "schema": 1,
            "suite": suite,
            "phantom": True,
            "cases": len(rows) + len(failed),
            "failed": failed,
            "targets": targets,
            "confusion": _confusion(rows),
            "power": _power(by["in_library"]),
            "per_effect": _per_effect(by["in_library"]),
            "calibration": _calibration(listed or rows),
            "unlisted": unlisted_by_form(rows),
            "gap_closed": [g for r in by["in_library"] if (g := _gap_closed(r)) is not None],
            "baselines": _baselines(listed, by),
            "time_s": {
                "median": float(np.median([r["seconds"] for r in rows])),
                "max": float(np.max([r["seconds"] for r in rows])),
            },
            "wrong": [_wrong(r) for r in rows if not _is_right(r)],
        },
    )


def _is_right(row: Row) -> bool:
    if row["case"]["stratum"] in UNLISTED:
        return answers_rightly(row)
    return row["answer"]["verdict"] in row["names"]


def _score_sure(rows: list[Row]) -> list[Row]:
    """Score every answer whose probability is above 0.9, of all strata."""
    # the probability of a set is that these effects act and no others, and so the set has to be the true one
    sure = [r for r in rows if answer_probability(r["answer"]) > SURE]
    partly = [_is_wholly_right(r) or (len(r["names"]) > 1 and _is_right(r)) for r in sure]
    return [
        claim(
            "every answer surer than 90 %: right",
            [_is_wholly_right(r) for r in sure],
            ">= 97 %",
            lambda v: v >= 0.97,
        ),
        claim("every answer surer than 90 %: right, or one of two causes named first", partly, "none", None),
    ]


def _is_wholly_right(row: Row) -> bool:
    """Return whether the answer is the cause and no other, both of two, `none`, or right as an unlisted cause's is."""
    if row["case"]["stratum"] in UNLISTED:
        return answers_rightly(row)
    return set(row["answer"]["verdict_set"]) == set(row["names"])


def _targets(by: dict[str, list[Row]], nulls: list[Row]) -> list[Row]:
    library = by["in_library"]
    clear = [r for r in library if _reached(r) >= CLEAR]
    return [
        *_score_names(library, clear),
        *_score_refusals(nulls, by["out_of_library"]),
        claim("in library, rho >= 0.2: answered", _named(clear), ">= 90 %", lambda v: v >= 0.90),
        claim("form mismatch: family", _right(by["form_mismatch"]), ">= 85 %", lambda v: v >= 0.85),
        *_score_misfit(library, by["form_mismatch"]),
        *_score_mixtures(by["mixture"]),
        *_score_shared(by["shared_axis"]),
        *_score_location(library),
        *_score_gap(library),
        *_score_parameters(library, nulls),
        *_score_calibration([r for rows in by.values() for r in rows], len(library)),
    ]


def _right(rows: list[Row]) -> list[bool]:
    return [r["answer"]["verdict"] in r["names"] for r in rows]


def _named(rows: list[Row]) -> list[bool]:
    return [r["answer"]["verdict"] not in (NONE, UNKNOWN) for r in rows]


def _among(rows: list[Row], k: int) -> list[bool]:
    return [set(r["names"]) <= set(_ranked(r)[:k]) for r in rows]


def _score_names(library: list[Row], clear: list[Row]) -> list[Row]:
    """Score the effect named first, by the visibility that the case reached, of which ``clear`` have enough."""
    # some effects cannot be made as visible as was asked for
    faint = [r for r in library if FAINT <= _reached(r) < CLEAR]
    hidden = [r for r in library if _reached(r) < FAINT]
    sure = [r for r in faint if max(r["answer"]["probabilities"].values()) > SURE]
    grouped = [r["answer"]["verdict"] in _group_of(r["names"][0]) for r in clear]
    return [
        claim("cause, top-1, rho >= 0.2", _right(clear), ">= 95 %", lambda v: v >= 0.95),
        claim("ambiguity group, rho >= 0.2", grouped, ">= 97 %", lambda v: v >= 0.97),
        claim("top-3, rho >= 0.2", _among(clear, 3), ">= 98 %", lambda v: v >= 0.98),
        claim("top-1, rho = 0.05", _right(faint), ">= 80 %", lambda v: v >= 0.80),
        claim(
            "right where surer than 90 %, rho = 0.05",
            _right(sure),
            ">= 95 %",
            lambda v: v >= 0.95,
        ),
        claim("top-1, rho below 0.025: less than was asked for", _right(hidden), "none", None),
    ]


def _score_refusals(nulls: list[Row], strange: list[Row]) -> list[Row]:
    """Score the verdicts on cases without an effect and on cases whose effect is not in the library."""
    alarms = [r["answer"]["verdict"] != NONE for r in nulls]
    unknown = [r["answer"]["verdict"] == UNKNOWN for r in strange]
    return [
        claim("false alarm on null", alarms, "<= 1.3 %", lambda v: v <= 2 / 150),
        claim("out of library: unknown", unknown, ">= 85 %", lambda v: v >= 0.85),
        claim("out of library: a wrong name", _named(strange), "<= 10 %", lambda v: v <= 0.10),
    ]


def _score_misfit(library: list[Row], mismatched: list[Row]) -> list[Row]:
    """Score the mark of a named cause whose form is not right, of causes that are named rightly.

    Of another equation the share has no target: of many of them a form of the catalogue is the true one.
    """
    return [
        claim(
            "misfit mark: cause of the catalogue named",
            [_is_marked(r) for r in library if r["answer"]["verdict"] in r["names"]],
            "<= 5 %",
            lambda v: v <= 0.05,
        ),
        claim(
            "misfit mark: another equation named",
            [_is_marked(r) for r in mismatched if r["answer"]["verdict"] in r["names"]],
            "none: the catalogue has many of these equations as forms",
            None,
        ),
    ]


def _is_marked(row: Row) -> bool:
    return bool((row["answer"].get("misfit") or {}).get("marked"))


def _exact(rows: list[Row]) -> list[bool]:
    return [_is_wholly_right(r) for r in rows]


def _score_mixtures(mixed: list[Row]) -> list[Row]:
    """Score cases with two effects, also those alone in which each of the two is visible by itself."""
    # creep of a short trial is swallowed by the refit however strong it is, and leaves nothing to name
    seen = [r for r in mixed if min(_alone(r)) >= FAINT]
    untargeted = "none: rho of each alone is 0.025 and more"
    return [
        claim("mixture: both in the top 3", _among(mixed, 3), ">= 90 %", lambda v: v >= 0.90),
        claim("mixture: exact set", _exact(mixed), ">= 65 %", lambda v: v >= 0.65),
        claim("mixture of two that each can be seen: both in the top 3", _among(seen, 3), untargeted, None),
        claim("mixture of two that each can be seen: exact set", _exact(seen), untargeted, None),
    ]


def _score_shared(pairs: list[Row]) -> list[Row]:
    """Score cases with two effects along one axis: what they do together may be another pair, or one law."""
    # a name with a mark of misfit says itself that its form is not right
    wrong = [
        is_named and not exact and max(r["answer"]["probabilities"].values()) > SURE and not _is_marked(r)
        for r, is_named, exact in zip(pairs, _named(pairs), _exact(pairs), strict=True)
    ]
    unknown = [r["answer"]["verdict"] == UNKNOWN for r in pairs]
    return [
        claim("pair on one axis: both in the top 3", _among(pairs, 3), "none", None),
        claim("pair on one axis: exact set", _exact(pairs), "none", None),
        claim("pair on one axis: unknown", unknown, "none", None),
        claim("pair on one axis: another set, sure and not marked", wrong, "none", None),
    ]


def _score_location(library: list[Row]) -> list[Row]:
    """Score where the answer places the effect: stage, axis and regime of the motion."""
    stages = [
        r["answer"]["where"]["stage"] == r["case"]["effects"][0]["stage"]
        for r in library
        if r["case"]["effects"][0].get("stage")
    ]
    axes = [_axis_right(r) for r in library if r["case"]["effects"][0]["axes"]]
    regime = [r for r in library if r["case"].get("regimes") and r["answer"]["where"].get("regimes")]
    return [
        claim("where: stage", stages, ">= 97 %", lambda v: v >= 0.97),
        claim("where: axis", axes, ">= 95 %", lambda v: v >= 0.95),
        figure("where: regime F1", _regime_f1(regime), len(regime), ">= 0.85", lambda v: v >= 0.85),
    ]


def _score_gap(library: list[Row]) -> list[Row]:
    """Score the share of the gap that the answers close."""
    gaps = [g for r in library if (g := _gap_closed(r)) is not None]
    floored = [g for r in library if (g := _gap_closed_of_floor(r)) is not None]
    tenth = float(np.quantile(gaps, 0.1)) if gaps else None
    return [
        figure(
            "gap closed on the held-out regime, median",
            _median(gaps),
            len(gaps),
            ">= 95 %",
            lambda v: v >= 0.95,
        ),
        figure("gap closed, 10th percentile", tenth, len(gaps), ">= 75 %", lambda v: v >= 0.75),
        claim("made worse", [g < 0 for g in gaps], "<= 2 %", lambda v: v <= 0.02),
        figure(
            "gap closed of what lies above the estimated floor, median",
            _median(floored),
            len(floored),
            "none: the floor is known to 10 %",
            None,
        ),
    ]


def _score_parameters(library: list[Row], nulls: list[Row]) -> list[Row]:
    """Score how much nearer to the truth the answers bring stiffness and damping."""
    cut = [c for r in library if (c := _parameter_cut(r)) is not None]
    determined = [c for r in library if (c := _parameter_cut(r, determined=True)) is not None]
    kept = [1 / c for r in nulls if (c := _parameter_cut(r)) is not None]
    held = [hit for r in library + nulls if r["answer"]["verdict"] in r["names"] for hit in _held(r)]
    return [
        figure("RMS ln-error of K, D cut by (median)", _median(cut), len(cut), ">= 4 x", lambda v: v >= 4),
        figure(
            "RMS ln-error of the determined K, D cut by (median)",
            _median(determined),
            len(determined),
            "none: what the answer calls determined",
            None,
        ),
        claim("95 % intervals of the determined K, D hold the truth", held, "none: 95 % were right", None),
        claim(
            "95 % intervals of an effect's parameters hold the truth",
            [hit for r in library for hit in held_sizes(r)],
            "none: 95 % were right",
            None,
        ),
        figure(
            "RMS ln-error of K, D on null, times (median)",
            _median(kept),
            len(kept),
            "<= 1.05 x",
            lambda v: v <= 1.05,
        ),
    ]


def _score_calibration(rows: list[Row], n: int) -> list[Row]:
    """Score the probabilities of cases with one cause or none; ``n`` is the count that the table names."""
    found = _calibration(rows)
    coverage = found["set90_coverage"]
    single = [r for r in rows if len(r["names"]) == 1]
    sure = [r for r in single if r["answer"]["probabilities"][r["answer"]["verdict"]] > SURE]
    return [
        claim(
            "right where surer than 90 %: one cause or none, neither left out nor a random law",
            _right(sure),
            ">= 97 %",
            lambda v: v >= 0.97,
        ),
        figure("expected calibration error", found["ece"], n, "<= 0.04", lambda v: v <= 0.04),
        figure("90 % sets: coverage", coverage, n, "88-93 %", lambda v: 0.88 <= v <= 0.93),
        figure("90 % sets: mean size", found["set90_mean_size"], n, "<= 2", lambda v: v <= 2),
    ]


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def _axis_right(row: Row) -> bool:
    axes = row["answer"]["where"]["axes"]
    return max(axes, key=lambda a: axes[a]) in row["case"]["effects"][0]["axes"]


def _regime_f1(rows: list[Row]) -> float | None:
    """F1 of the regimes (amplitude by speed) that hold the gap, all cases together."""
    right = claimed = true = 0
    for row in rows:
        shares: dict[str, float] = {}
        for entry in row["answer"]["where"]["regimes"]:
            # the answer parts each regime by phase, too
            name = ", ".join(entry["bin"].split(", ")[:2])
            shares[name] = shares.get(name, 0.0) + entry["share"]
        said = {name for name, share in shares.items() if share >= _REGIME_SHARE}
        is_so = {name for name, share in row["case"]["regimes"].items() if share >= _REGIME_SHARE}
        right, claimed, true = right + len(said & is_so), claimed + len(said), true + len(is_so)
    return 2 * right / (claimed + true) if claimed + true else None


def _gap_closed(row: Row) -> float | None:
    """Share of the gap on the trial that shows it that the answer closes, of what the oracle closes on the same data.

    That is the held-out trial, unless it shows none. The oracle knows the true structure: the best there of all refits
    that hold the true effects and no others. Where the truth was never refitted, the estimated floor stands for it. The
    oracle is fitted by the same search, so a right answer closes all of it: what this counts is wrong answers, and fits
    worse than another.
    """
    truth = set(row["names"])
    oracle = [h["J"] for h in row["answer"]["considered"] if set(h["effects"]) == truth]
    return _closed(row, min(oracle, default=row["answer"]["gap"]["J_floor"]))


def _gap_closed_of_floor(row: Row) -> float | None:
    """As `_gap_closed`, of what lies above the noise floor that the diagnosis estimates."""
    return _closed(row, row["answer"]["gap"]["J_floor"])


def _closed(row: Row, least: float) -> float | None:
    """Share of the way from the plain J to ``least`` that the answer goes; None where J hardly has a gap."""
    gap = row["answer"]["gap"]
    closable = gap["J_base"] - least
    if closable <= _SMALLEST_GAP * gap["J_floor"]:
        return None
    return float((gap["J_base"] - gap["J_with_effect"]) / closable)


def _value(entry: Any) -> float:
    """A true parameter, with or without its unit."""
    return float(entry["value"] if isinstance(entry, dict) else entry)


def _held(row: Row) -> list[bool]:
    """Return whether the interval of each parameter that the answer calls determined holds the truth."""
    truth = row["case"].get("parameters") or {}
    known = row["answer"]["parameters"]
    return [
        known[name]["ci95"][0] <= _value(value) <= known[name]["ci95"][1]
        for name, value in truth.items()
        if known.get(name, {}).get("verdict") == DETERMINED
    ]


def _parameter_cut(row: Row, determined: bool = False) -> float | None:
    """RMS ln-error of the parameters of the plain fit over that of the answer; of all 12, or of the determined ones."""
    truth = row["case"].get("parameters")
    if not truth:
        return None
    names = row["answer"]["parameters"]
    if determined:
        names = {name: p for name, p in names.items() if p.get("verdict") == DETERMINED}
    if not names:
        return None
    errors = {
        kind: np.sqrt(np.mean([np.log(p[kind] / _value(truth[name])) ** 2 for name, p in names.items()]))
        for kind in ("base", "with_effect")
    }
    return float(errors["base"] / max(errors["with_effect"], 1e-9))


def _confusion(rows: list[Row]) -> dict[str, Any]:
    counts = np.zeros((len(LABELS), len(LABELS)), dtype=int)
    for row in rows:
        if len(row["names"]) == 1:
            counts[LABELS.index(row["names"][0]), LABELS.index(row["answer"]["verdict"])] += 1
    return {"labels": list(LABELS), "counts": counts.tolist()}


def _power(rows: list[Row]) -> list[Row]:
    out = []
    for rho in sorted({r["case"]["visibility"]["target"] for r in rows}):
        hits = [
            r["answer"]["verdict"] in r["names"] for r in rows if r["case"]["visibility"]["target"] == rho
        ]
        low, high = proportion_confint(sum(hits), len(hits), method="wilson")
        out.append(
            {"rho": rho, "n": len(hits), "top1": float(np.mean(hits)), "wilson95": [float(low), float(high)]}
        )
    return out


def _per_effect(rows: list[Row]) -> list[Row]:
    """Power by effect against visibility, and the smallest visibility and severity at which it is diagnosed."""
    targets = sorted({r["case"]["visibility"]["target"] for r in rows})
    edges = [np.sqrt(a * b) for a, b in itertools.pairwise(targets)]
    out = []
    for effect in EFFECT_NAMES:
        own = [r for r in rows if r["names"] == [effect]]
        if not own:
            continue
        bins = [_power_bin([r for r in own if _bin_of(r, edges) == i], effect) for i in range(len(edges) + 1)]
        bins = [b for b in bins if b["n"]]
        enough = [b for b in bins if b["top1"] >= _DIAGNOSABLE]
        out.append(
            {
                "effect": effect,
                "n": len(own),
                "top1": sum(r["answer"]["verdict"] == effect for r in own),
                "smallest_rho": enough[0]["rho"] if enough else None,
                "smallest_severity": enough[0]["severity"] if enough else None,
                "bins": bins,
            }
        )
    return out


def _reached(row: Row) -> float:
    """Visibility of a case as the phantom has it, as asked for where it does not know."""
    visibility = row["case"]["visibility"]
    return float((visibility["target"] if visibility["predicted"] is None else visibility["predicted"]) or 0)


def _alone(row: Row) -> list[float]:
    """Visibility that each effect of a case makes by itself, that of the case where the phantom does not know."""
    return [float(e.get("visibility", {}).get("alone", _reached(row))) for e in row["case"]["effects"]]


def _bin_of(row: Row, edges: Sequence[float]) -> int:
    return int(np.searchsorted(edges, _reached(row)))


def _power_bin(rows: list[Row], effect: str) -> Row:
    """Cases of one effect at about one visibility: medians of visibility and severity, share named first.

    Severity is the share of the largest magnitude that the suite draws.
    """
    reached = [v for r in rows if (v := r["case"]["visibility"]["predicted"]) is not None]
    severity = [v for r in rows if (v := r["case"]["effects"][0].get("severity")) is not None]
    return {
        "rho": float(np.median(reached)) if reached else None,
        "severity": float(np.median(severity)) if severity else None,
        "n": len(rows),
        "top1": float(np.mean([r["answer"]["verdict"] == effect for r in rows])) if rows else None,
    }


def _calibration(rows: list[Row]) -> dict[str, Any]:
    """Reliability of the verdicts' probabilities, and of sets that hold 90 % of the probability."""
    rows = [r for r in rows if len(r["names"]) == 1]
    p = np.array([r["answer"]["probabilities"][r["answer"]["verdict"]] for r in rows])
    right = np.array([r["answer"]["verdict"] in r["names"] for r in rows], dtype=float)
    bins, ece = [], 0.0
    for low in np.arange(0.0, 1.0, 0.1):
        inside = (p > low) & (p <= low + 0.1)
        if inside.any():
            mean, fraction = float(p[inside].mean()), float(right[inside].mean())
            ece += inside.mean() * abs(mean - fraction)
            bins.append(
                {
                    "from": float(low),
                    "to": float(low + 0.1),
                    "n": int(inside.sum()),
                    "mean_probability": mean,
                    "fraction_true": fraction,
                }
            )
    sizes, covered = [], []
    for row in rows:
        total, members = 0.0, []
        for name in _ranked(row):
            members.append(name)
            total += row["answer"]["probabilities"][name]
            if total >= 0.9:
                break
        sizes.append(len(members))
        covered.append(row["names"][0] in members)
    return {
        "bins": bins,
        "ece": float(ece),
        "set90_coverage": float(np.mean(covered)) if covered else 0.0,
        "set90_mean_size": float(np.mean(sizes)) if sizes else 0.0,
    }


def _baseline(name: str) -> Callable[[Row], str]:
    return lambda row: str(row["answer"].get("baselines", {}).get(name, NONE))


def _baselines(rows: list[Row], by: dict[str, list[Row]]) -> list[Row]:
    """Score simpler rules on the same fits, which are stored with every answer, beside the diagnosis itself."""
    names = sorted({name for r in rows for name in r["answer"].get("baselines", {})})
    rules: dict[str, Callable[[Row], str]] = {
        "this diagnosis": lambda r: r["answer"]["verdict"],
        "always none": lambda r: NONE,
        **{name: _baseline(name) for name in names},
    }
    strange = by["out_of_library"]
    single = [r for r in rows if len(r["names"]) == 1]

    def share(hits: list[bool]) -> float:
        return float(np.mean(hits)) if hits else 0.0

    return [
        {
            "name": name,
            "top1": share([rule(r) in r["names"] for r in by["in_library"]]),
            "false_alarm": share([rule(r) != NONE for r in by["null"] + by["null_hard"]]),
            "wrong_name_out_of_library": share([rule(r) not in (NONE, UNKNOWN) for r in strange]),
            "right_of_all": share([rule(r) in r["names"] for r in single]),
        }
        for name, rule in rules.items()
    ]


def _wrong(row: Row) -> Row:
    answer = row["answer"]
    return {
        "case": row["case"]["id"],
        "stratum": row["case"]["stratum"],
        "truth": row["names"],
        "forms": [effect.get("form") for effect in row["case"]["effects"]],
        "verdict": answer["verdict"],
        "probabilities": {k: round(v, 3) for k, v in answer["probabilities"].items() if v > 0.02},
        "visibility": row["case"]["visibility"],
    }
