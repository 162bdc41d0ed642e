"""What a person reads of a diagnosis: one page per person, one row per person in the table of the cohort."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from real2sim.artefacts import read_json, write_table
from real2sim.diagnosis.evidence import CONFIGURED
from real2sim.diagnosis.sensors import above
from real2sim.diagnosis.stated import answer_probability, other_robot
from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.pages import style
from real2sim.pages.law import law_section, law_sentence, law_words, misfit_sentence
from real2sim.pages.page import (
    bar,
    document,
    likely,
    listed,
    page_style,
    paragraph,
    percent,
    picture,
    rounded,
    section,
    table,
)
from real2sim.pages.visible import visible_section

STAGES = {
    "input": "input chain (pelvis markers to the replayed pelvis)",
    "interface": "interface law (the strap)",
    "robot": "robot side",
    "output": "output chain (interface markers)",
}
COLUMNS = (
    "subject",
    "verdict",
    "verdict_set",
    "law",
    "probability",
    "robot",
    "stage",
    "axes",
    "J_base",
    "J_floor",
    "J_with_effect",
    "gap_closed",
    "misfit_sd",
    "next_trial",
    "train",
    "held_out",
    "refused_gates",
    "phantom",
)
_KEYS = (
    "subject",
    "phantom",
    "refused_gates",
    "robot_holds",
    "otherwise",
    "pelvis_markers_jumped_s",
    "limits_crossed",
    "fitted_the_other_way",
    "train",
    "held_out",
    "noise_floor",
    "gap",
    "where",
    "causes",
    "probabilities",
    "verdict",
    "ambiguity_group",
    "next_trial",
    "parameters",
    "provenance",
)
_NOT_EFFECTS = ("none", "unknown")
_HELD = {"start pose": "let go at its start pose", "balance": "at rest against the strap"}
_AXIS_WORDS = {"tx": "forward", "ty": "left", "tz": "up", "rx": "roll", "ry": "pitch", "rz": "yaw"}
_DEGREES = 180 / math.pi
# SI units that are told in another one: factor and name
_SHOWN = {
    "m": (1e3, "mm"),
    "m/s": (1e3, "mm/s"),
    "m/rad": (1e3, "mm/rad"),
    "rad": (_DEGREES, "deg"),
    "rad/s": (_DEGREES, "deg/s"),
}
_CLEARLY = 0.8  # share of the gap that the named axes carry together
_DASH = "\N{EN DASH}"


def diagnosis_page(*, diagnosis: Path, traces: Path, out: Path) -> None:
    """Write the page of one person's diagnosis: verdict, where, causes, what is left, parameters, next trial.

    ``diagnosis`` is diagnosis.json, ``traces`` the table of the trial that shows the gap [m]. The page holds its
    figures and loads nothing. Raises InputError where either file lacks what it needs.
    """
    d = read_json(diagnosis, _KEYS)
    body = [
        *_lead(d),
        _where(d),
        _which(d),
        *law_section(d.get("free_form"), phantom=d["phantom"]),
        *visible_section(d.get("could_show"), _SHOWN),
        _how_far(d, _traces(traces)),
        _parameters(d),
        _next(d),
        *([_model(d)] if "model" in d else []),
        _foot(d),
    ]
    write_text(out, document(f"Diagnosis of {d['subject']}", body, phantom=d["phantom"]))


def diagnosis_table(*, diagnoses: list[Path], out: Path) -> None:
    """Write one row per person: verdict, probability, stage, axes, J with and without the effect, next trial.

    Costs J, probability and gap_closed (share of J above its floor) have no unit. ``stage`` and ``axes`` are empty
    where the verdict is none, ``gap_closed`` also where it is unknown and no law was measured, and where J is less
    above its floor than ``diagnosis.report.smallest_gap``. ``law`` is the kind and
    the place of that law, and ``J_with_effect`` then the cost with it. ``misfit_sd`` is what a named cause leaves of
    the held-out trial, in standard deviations of noise, where its form is not right.
    """
    rows = []
    for path in diagnoses:
        d = read_json(path, _KEYS)
        named, gap, law = is_explained(d), d["gap"], _law(d)
        rows.append(
            {
                "subject": d["subject"],
                "verdict": d["verdict"],
                "verdict_set": " ".join(_set(d)),
                "law": None if law is None else law_words(law),
                "probability": d["probabilities"][d["verdict"]],
                "robot": None if d.get("machine") is None else d["machine"]["name"],
                "stage": None if not shows_gap(d) else d["where"]["stage"],
                "axes": None if not shows_gap(d) else " ".join(_main_axes(d)),
                "J_base": gap["J_base"],
                "J_floor": gap["J_floor"],
                "J_with_effect": gap["J_with_effect"],
                "gap_closed": _closed(d) if named else None,
                "misfit_sd": _misfit_sd(d),
                "next_trial": d["next_trial"],
                "train": " ".join(d["train"]),
                "held_out": " ".join(d["held_out"]),
                "refused_gates": " ".join(
                    f"{trial}:{','.join(g)}" for trial, g in d["refused_gates"].items()
                ),
                "phantom": d["phantom"],
            }
        )
    write_table(out, COLUMNS, rows)


def _misfit_sd(d: Mapping[str, Any]) -> float | None:
    misfit = d.get("misfit")
    return float(misfit["left_sd"][1]) if misfit is not None and misfit["marked"] else None


def _remedy(d: Mapping[str, Any]) -> str:
    """Word for what closes the gap: another robot where no effect is named beside it, the measured law for unknown."""
    if _law(d) is not None:
        return "measured law"
    return "other robot" if d["verdict"] == "none" and other_robot(d) else "effect"


def _law(d: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The measured law that an unknown cause is told by; None where a name or nothing is."""
    law: Mapping[str, Any] | None = d.get("free_form") if d["verdict"] == "unknown" else None
    return law


def shows_gap(d: Mapping[str, Any]) -> bool:
    """Return whether diagnosis.json finds something that the configured model lacks."""
    return d["verdict"] != "none" or other_robot(d) is not None


def is_explained(d: Mapping[str, Any]) -> bool:
    """Return whether diagnosis.json finds what explains the gap: effects, a measured law, or another robot alone."""
    if d["verdict"] == "unknown":
        return _law(d) is not None
    return shows_gap(d)


def answer_words(d: Mapping[str, Any]) -> str:
    """Effects that diagnosis.json names together, none, or unknown with its law; first another robot, if it is one."""
    names, robot, law = _set(d), other_robot(d), _law(d)
    about = "" if law is None else f": {law_words(law)}"
    if robot is None:
        return " + ".join(_words(name) for name in names) + about
    return (
        " + ".join([f"another robot, {robot}", *(_words(name) for name in names if name != "none")]) + about
    )


def chi2_per_residual(d: Mapping[str, Any]) -> tuple[float, float] | None:
    """Chi-squared per residual on the trial that shows the gap, plain and with effect or law; None in old answers.

    A sensor on its floor counts for no less than one per residual, as where the diagnosis asks what stands above noise.
    """
    gap = d["gap"]
    if not gap.get("chi2_expected"):
        return None
    i = [d["train"], d["held_out"]].index(_shown(d))
    n, parts = gap["chi2_expected"][i], gap.get("by_sensor")
    if parts is None:
        return gap["chi2_plain"][i] / n, gap["chi2_best"][i] / n
    expected, on_floor = parts["chi2_expected"][i], parts["on_floor"]
    plain, best = (1 + above(parts[key][i], expected, on_floor) / n for key in ("chi2_plain", "chi2_best"))
    return plain, best


def chi2_closed(d: Mapping[str, Any]) -> float | None:
    """Share of chi-squared above noise that goes with effect or law; None where neither is or nothing stood there.

    What fits better than noise closes all.
    """
    both = chi2_per_residual(d)
    if both is None or not is_explained(d) or both[0] <= 1:
        return None
    return (both[0] - max(both[1], 1.0)) / (both[0] - 1)


def digest(d: Mapping[str, Any]) -> str:
    """The answer of diagnosis.json on a page of the whole study: verdict, place, causes or law, next trial."""
    ranked = sorted(d["probabilities"].items(), key=lambda item: -item[1])
    law = _law(d)
    closed = {cause["effect"]: cause.get("gap_closed") for cause in d["causes"]}
    closed["unknown"] = None if law is None else law["gap_closed"]
    rows = [
        [escape(_words(name)), _probability(p), percent(closed.get(name))]
        for name, p in ranked[:5]
        if p > 5e-4
    ]
    causes = table(
        ["Cause", "Probability", "J closed"],
        rows,
        caption=f"Likeliest causes for {d['subject']}; J closed: share of J above noise that goes with it on "
        f"{_trials(_shown(d))}, a dash where J is no more than noise alone costs",
        numeric=(2,),
    )
    told = [] if law is None else [paragraph(law_sentence(law))]
    return "\n".join([*_lead(d), paragraph(_place(d)), *told, causes])


# ---- words


def _words(name: str) -> str:
    return name.replace("_", " ")


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _listed(names: Sequence[str], joint: str = "and") -> str:
    """Names in a sentence."""
    return listed([_words(name) for name in names], joint)


def _trials(names: Sequence[str]) -> str:
    return " and ".join(names)


def _set(d: Mapping[str, Any]) -> list[str]:
    return d.get("verdict_set") or [d["verdict"]]


def _interval(ci: Sequence[float], digits: int = 3) -> str:
    return f"[{rounded(ci[0], digits)}, {rounded(ci[1], digits)}]"


def _main_axes(d: Mapping[str, Any]) -> list[str]:
    """Fewest axes that carry most of the gap together, largest first."""
    out: list[str] = []
    carried = 0.0
    for axis, share in sorted(d["where"]["axes"].items(), key=lambda item: -item[1]):
        if carried >= _CLEARLY or share <= 0:
            break
        out.append(axis)
        carried += share
    return out


def _closed(d: Mapping[str, Any]) -> float | None:
    """Share of J above its floor that goes with the effect; None where the answer has no such share of its causes.

    That is where J is above its floor by less than the share ``smallest_gap`` of it that the diagnosis was made with.
    """
    gap, closable = d["gap"], d["gap"]["J_base"] - d["gap"]["J_floor"]
    report = d.get("settings", {}).get("diagnosis", {}).get("report", {})
    # answers without settings are older than that one
    if closable <= 0 or closable < report.get("smallest_gap", 0.0) * gap["J_floor"]:
        return None
    return float((gap["J_base"] - gap["J_with_effect"]) / closable)


def _lead(d: Mapping[str, Any]) -> list[str]:
    parts = [paragraph(_verdict(d), "lead")]
    misfit = misfit_sentence(d.get("misfit"))
    parts += [paragraph(text) for text in (_robot(d), misfit, _exchanged(d), _hold(d))]
    parts.append(f"<p><strong>Next trial:</strong> {escape(_sentence(_trial(d)))}.</p>")
    for trial, gates in d["refused_gates"].items():
        what = (
            f"{trial} is refused by its gates ({', '.join(gates)}): the answer rests on a recording in doubt."
        )
        parts.append(paragraph(what))
    for trial, markers in d["pelvis_markers_jumped_s"].items():
        which = ", ".join(f"{marker} for {rounded(s)} s" for marker, s in markers.items())
        what = f"In {trial} pelvis markers jump ({which}): there the pelvis is taken from the others. Label them again."
        parts.append(paragraph(what))
    for trial, sides in d["limits_crossed"].items():
        what = (
            f"{trial} is beyond joint limits of the sweeps ({', '.join(sides)}): the simulation has no stop there. "
            "Has the strap moved since neutral and the sweeps?"
        )
        parts.append(paragraph(what))
    if chi2_per_residual(d) is not None:
        summary = "The same in cost J, which the study minimises: another measure with other shares"
        parts.append(
            f"<details><summary>{summary}</summary>\n{paragraph(_sentence(_as_cost(d)) + '.')}\n</details>"
        )
    return [part for part in parts if part != "<p></p>"]


def _trial(d: Mapping[str, Any]) -> str:
    """The next trial, or why there is none."""
    if d["next_trial"]:
        return str(d["next_trial"])
    if _hangs_on_hold(d):
        return "the same trials, begun where the strap pulls at nothing, in the pose of neutral"
    if _law(d) is not None:
        return "one that goes beyond the range of what the measured law depends on, and comes back to rest in between"
    if d["verdict"] == "unknown":
        return "the catalogue has none for a cause that it does not hold; start from where the gap lies"
    return "none is needed to tell causes apart"


def _shown(d: Mapping[str, Any]) -> list[str]:
    """Trial that shows the gap: the held-out one, unless it shows none and is what the fitted one is checked by."""
    trials: list[str] = d.get("shown_on", d["held_out"])
    return trials


def is_shown_by_fitted(d: Mapping[str, Any]) -> bool:
    """Return whether the gap of diagnosis.json is that of the fitted trial, which alone shows it."""
    return bool(_shown(d) != d["held_out"])


def _exchanged(d: Mapping[str, Any]) -> str:
    """Return the reason for fitting the other trial, where that is so."""
    fitted, other = _trials(d["train"]), _trials(d["held_out"])
    if d["fitted_the_other_way"]:
        return (
            f"Nothing that was fitted to {other} explains {fitted}. Effects were fitted to {fitted} instead, and had "
            f"to predict {other}: the gap is told of that one."
        )
    if not is_shown_by_fitted(d):
        return ""
    return (
        f"Only {fitted} leaves more than noise: effects were fitted on it and had to leave {other} as it is. How far a "
        "gap shrinks is told of the trial that was fitted; one more of its kind would check it."
    )


def _hangs_on_hold(d: Mapping[str, Any]) -> bool:
    """Return whether another answer was found for a robot that is held otherwise."""
    return d["otherwise"] is not None and d["otherwise"]["verdict_set"] != d["verdict_set"]


def _hold(d: Mapping[str, Any]) -> str:
    """Return the sentence about the initial state of the robot, and the answer under the other one."""
    taken = {
        "start pose": "",
        "balance": "The robot is taken to have come to rest against the strap before the trials began: its controller "
        "holds where that balances what pulls at the start, not at the start pose. A constant force (preload, tilt) "
        "does not show in such trials. ",
    }[d["robot_holds"]]
    other = d["otherwise"]
    if not _hangs_on_hold(d):
        return taken
    left, noise = (rounded(sum(other[key]), 3) for key in ("chi2_best", "chi2_expected"))
    answer = f"{_listed(other['verdict_set'])} ({likely(other['probability'])})"
    return taken + (
        f"Had the robot been {_HELD[other['robot_holds']]} when the trials began, the answer would be {answer}, which "
        f"leaves {left} of chi-squared where noise leaves {noise}. If you know how it was, set diagnosis.robot_holds."
    )


def _robot(d: Mapping[str, Any]) -> str:
    """Return which of the compared robots held the strap, in two sentences; empty where none were compared."""
    machine = d.get("machine")
    if machine is None:
        return ""
    rows = {row["name"]: row for row in machine["compared"]}
    first, rest = machine["name"], [name for name in rows if name != machine["name"]]
    certain, least = machine["probability"], f"with a probability of {likely(machine['probability'])}"
    if certain < _CLEARLY:
        each = ", ".join(f"{_robot_words(name)} {likely(row['probability'])}" for name, row in rows.items())
        verdict = f"These trials do not tell which robot held the strap ({each}); the answer is that with the first."
    elif first == CONFIGURED:
        verdict = f"The configured robot held the strap, {least}, and not {_listed(rest, 'or')}."
    else:
        verdict = f"Not the configured robot held the strap but {first} ({machine['model']}), {least}."
    trial = _shown(d)[0]
    left = ", ".join(
        f"{rounded(row['chi2_plain'][trial] / row['chi2_expected'][trial])} with {_robot_words(name)}"
        for name, row in rows.items()
    )
    return f"{verdict} Without any effect, the misfit of {trial} in units of what noise leaves is {left}."


def _robot_words(name: str) -> str:
    return "the configured one" if name == CONFIGURED else name


def _verdict(d: Mapping[str, Any]) -> str:
    """Cause, probability and what is left above noise, in one sentence; in J where an old answer has nothing else."""
    p, left = d["probabilities"], _beyond_noise(d) or _as_cost(d)
    if d["verdict"] == "none" and other_robot(d):
        claim = "The plain model with another robot explains the gap"
    elif d["verdict"] == "none":
        sure = f"with a probability of {likely(p['none'])}"
        claim = f"No cause is named: {sure} the plain model is all that the data ask for"
    elif d["verdict"] == "unknown":
        sure = f"with a probability of {likely(p['unknown'])}"
        claim = f"The cause is unknown: {sure} it is none that the catalogue holds"
    else:
        names = _set(d)
        claim = f"{_sentence(_words(names[0]))} causes the gap with a probability of {likely(p[names[0]])}"
        if len(names) > 1:
            sure = likely(answer_probability(d))
            claim = f"{_sentence(_listed(names))} together cause the gap with a probability of {sure}"
    return f"{claim}; {left}."


def _shown_words(d: Mapping[str, Any]) -> str:
    return f"{'' if is_shown_by_fitted(d) else 'the held-out trial '}{_trials(_shown(d))}"


def _beyond_noise(d: Mapping[str, Any]) -> str:
    """The misfit without and with the answer, in units of what noise leaves; empty where an old answer lacks it."""
    both = chi2_per_residual(d)
    if both is None:
        return ""
    plain, best = (rounded(value, 2) for value in both)
    if not is_explained(d):
        return f"the misfit (chi-squared) of {_shown_words(d)} is {plain} times what noise leaves"
    change = (
        f"the misfit (chi-squared) of {_shown_words(d)} {{}} from {plain} to {best} times what noise leaves"
    )
    if both[1] >= both[0]:
        return f"with the {_remedy(d)} in the model {change.format('goes')}: it does not help"
    text = f"with the {_remedy(d)} in the model {change.format('falls')}"
    closed = chi2_closed(d)
    if closed is None or closed >= 1:
        return f"{text}, so that no chi-squared is left above noise"
    return f"{text}, so that {percent(1 - closed, 1)} of chi-squared above noise is left"


def _as_cost(d: Mapping[str, Any]) -> str:
    """The same in J, the cost that the study minimises."""
    gap = d["gap"]
    base, floor, after = (rounded(gap[key], 4) for key in ("J_base", "J_floor", "J_with_effect"))
    if d["verdict"] == "none" and not other_robot(d):
        interval = _interval(d["noise_floor"]["ci95"])
        text = f"the plain model costs J = {base}, and noise alone {floor} {interval}"
    elif d["verdict"] == "unknown":
        best = max((c["gap_closed"] for c in d["causes"] if c.get("gap_closed") is not None), default=None)
        tried = (
            ""
            if best is None
            else f", and the best of the catalogue takes away {percent(best)} of J above noise"
        )
        with_law = "" if _law(d) is None else f" and the model with the measured law {after}"
        text = f"the plain model costs J = {base}{with_law} where noise alone costs {floor}{tried}"
    else:
        text = _left(d, base, floor, after)
    return f"on {_shown_words(d)}, {text}"


def _left(d: Mapping[str, Any], base: str, floor: str, after: str) -> str:
    share = _closed(d)
    if share is None:
        return f"J is {base} without and {after} with it where noise alone costs {floor}: J does not show this gap"
    if share <= 0:
        return f"it does not help: J goes from {base} to {after}, noise alone costs {floor}"
    drop = f"J falls from {base} to {after} with it"
    if share >= 1:
        return f"{drop}, which leaves nothing of J above what noise alone costs ({floor})"
    ci = next(
        (c["gap_closed_ci95"] for c in d["causes"] if _same_set(c, d) and c.get("gap_closed_ci95")), None
    )
    between = (
        f" [{percent(max(1 - ci[1], 0)).removesuffix(' %')}, {percent(1 - ci[0]).removesuffix(' %')}]"
        if ci
        else ""
    )
    return f"{drop}, which leaves {percent(1 - share)}{between} of J above what noise alone costs ({floor})"


def _same_set(cause: Mapping[str, Any], d: Mapping[str, Any]) -> bool:
    """Return whether the cause was refitted together with just the others of the verdict's set."""
    return {cause["effect"], *cause.get("with", [])} == set(_set(d))


# ---- where


def _bars(axes: Axes, rows: Mapping[str, float], title: str) -> None:
    """Horizontal bars of shares with their numbers."""
    names, shares = list(rows), list(rows.values())
    axes.barh(range(len(names)), shares, color=style.BLUE, height=0.65)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.3)
    axes.set_xticks([])
    axes.spines["bottom"].set_visible(False)
    axes.tick_params(length=0)
    for i, share in enumerate(shares):
        axes.text(share + 0.015, i, likely(share), va="center")
    axes.set_title(title, loc="left")


def _groups(d: Mapping[str, Any]) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Shares by title: those of place, those of regime."""
    where = d["where"]
    place = {
        "Stage: probability of its effects and laws": where.get("stages", {}),
        "Interface axis": {f"{a} ({_AXIS_WORDS.get(a, a)})": s for a, s in where["axes"].items()},
        "World axis": where.get("world_axes", {}),
        "Side": {{"L": "left", "R": "right"}.get(k, k): v for k, v in where["sides"].items()},
        "Term of J": where["terms"],
    }
    regime = {
        "Regime": {r["bin"]: r["share"] for r in where["regimes"]},
        "Frequency": {
            f"{b['from_hz']:g}{_DASH}{b['to_hz']:g} Hz": b["share"] for b in where.get("bands_hz", [])
        },
        "Time": {f"{t['from_s']:.1f}{_DASH}{t['to_s']:.1f} s": t["share"] for t in where.get("times", [])},
    }
    return {k: v for k, v in place.items() if v}, {k: v for k, v in regime.items() if v}


def _panels(d: Mapping[str, Any], groups: Mapping[str, Mapping[str, float]], name: str, caption: str) -> str:
    with page_style():
        sizes = [len(rows) + 1.2 for rows in groups.values()]
        figure = style.new_figure(0.3 + 0.155 * sum(sizes), phantom=d["phantom"])
        panels = figure.subplots(len(groups), 1, height_ratios=sizes, squeeze=False)[:, 0]
        for axes, (title, rows) in zip(panels, groups.items(), strict=True):
            _bars(axes, rows, title)
        top = "; ".join(
            f"{title}: {max(rows, key=lambda k: rows[k])} {likely(max(rows.values()))}"
            for title, rows in groups.items()
        )
        return picture(figure, name, f"Bars of shares. Largest by group. {top}.", caption)


def _place(d: Mapping[str, Any]) -> str:
    """Return the place of the gap, in a sentence."""
    stage = STAGES.get(d["where"]["stage"], d["where"]["stage"])
    axes = _listed(_main_axes(d) or ["no axis"])
    if other_robot(d) and d["verdict"] == "none":
        return f"The gap lies in the model of the robot; it shows along {axes}."
    if d["verdict"] == "none":
        hardly = sum(p for name, p in d["probabilities"].items() if name not in _NOT_EFFECTS) < 0.02
        of = "with next to no probability" if hardly else "that share the probability"
        return (
            "There is no gap to place: the shares below only say where chance put the small excess over noise, and the "
            f"stage is that of effects {of}."
        )
    # shares are of what J has above noise, which is next to nothing where a gap shows in chi-squared alone
    chance = (
        ""
        if _j_shows(d)
        else " J of this trial is no more than noise alone costs: axes and shares are chance."
    )
    if d["verdict"] == "unknown" and _law(d) is None:
        return (
            f"The gap shows along {axes}. What the catalogue would explain best lies in the {stage}.{chance}"
        )
    return f"The gap lies most likely in the {stage}, along {axes}.{chance}"


def _j_shows(d: Mapping[str, Any]) -> bool:
    """Return whether J of the plain model lies above the interval of what noise alone costs."""
    return bool(d["gap"]["J_base"] > d["noise_floor"]["ci95"][1])


def _where(d: Mapping[str, Any]) -> str:
    place, regime = _groups(d)
    text = _place(d)
    rows = [
        [escape(key), escape(title), likely(share, 1)]
        for title, group in (place | regime).items()
        for key, share in group.items()
    ]
    numbers = table(["Where", "Of", "Share"], rows, caption="All shares", numeric=(2,))
    trial = _trials(_shown(d))
    return section(
        "where",
        "Where the gap lies",
        paragraph(text),
        '<div class="grid">',
        _panels(
            d,
            place,
            "place",
            f"Shares of the plain model's J above noise on {trial}, by place. Stages show the probability of their "
            "effects and of laws measured there; the rest to 100 % is none, and unknown without a measured law.",
        ),
        _panels(
            d,
            regime,
            "regime",
            f"Shares of the same by regime of the motion, frequency and time of {trial}. Amplitude and speed "
            "are split at their medians; outward is away from the rest pose.",
        ),
        "</div>",
        f"<details><summary>The same in numbers</summary>\n{numbers}\n</details>",
    )


# ---- which


def _which(d: Mapping[str, Any]) -> str:
    causes = sorted(d["causes"], key=lambda cause: -cause["probability"])
    known = {cause["effect"]: cause for cause in causes}
    listed = [*known, *_NOT_EFFECTS]
    listed.sort(key=lambda name: -d["probabilities"].get(name, 0.0))
    rows = [_cause_row(name, d["probabilities"].get(name, 0.0), known.get(name), _law(d)) for name in listed]
    rest = 1 - sum(d["probabilities"].get(name, 0.0) for name in listed)
    if rest > 5e-4:
        rows.append(["all others together", _probability(rest), _DASH, _DASH])
    cards = "\n".join(
        _card(cause, open_=i == 0 and d["verdict"] not in _NOT_EFFECTS) for i, cause in enumerate(causes)
    )
    note = "" if causes else "No effect of the catalogue was refitted: there was nothing to explain."
    ranked = table(
        ["Cause", "Probability", "J closed", "J held out"],
        rows,
        caption="Ranked causes. Each was refitted on the training trial together with the parameters and judged on "
        "the held-out trial. Effects refitted together share the probability of their set. J closed: share of J above "
        "the noise floor that goes with it, with its 95 % interval; more than 100 % is J below the mean of noise.",
        numeric=(2, 3),
    )
    return section(
        "which",
        "Which effect causes it",
        paragraph(note) if note else "",
        f'<div class="grid wide">\n{ranked}\n<div>\n{cards}\n</div>\n</div>',
    )


def _probability(p: float) -> str:
    return f'<span class="nowrap">{bar(p)}{likely(p, 1)}</span>'


def _cause_row(
    name: str, probability: float, cause: Mapping[str, Any] | None, law: Mapping[str, Any] | None
) -> list[str]:
    if cause is None:
        about = {"none": "the plain model suffices", "unknown": "none of the catalogue"}[name]
        if name == "unknown" and law is not None:
            return [
                _titled(name, f"{about}: {law_words(law)}"),
                _probability(probability),
                _share(law),
                _DASH,
            ]
        return [_titled(name, about), _probability(probability), _DASH, _DASH]
    about = ", ".join(
        part for part in (_listed(cause["axes"]) if cause["axes"] else "", _stage(cause)) if part
    )
    return [
        _titled(name, about),
        _probability(probability),
        _share(cause),
        rounded(cause.get("J_held_out"), 4),
    ]


def _share(closing: Mapping[str, Any]) -> str:
    """Return the share of J above noise that goes with a cause or a law, with its interval."""
    closed, ci = closing.get("gap_closed"), closing.get("gap_closed_ci95")
    between = f"<br>[{percent(ci[0]).removesuffix(' %')}, {percent(ci[1]).removesuffix(' %')}]" if ci else ""
    return _DASH if closed is None else percent(closed) + between


def _stage(cause: Mapping[str, Any]) -> str:
    """First words of the stage's name, and how the robot was held where the cause is of the other hold."""
    stage = cause.get("stage", "")
    words = STAGES.get(stage, stage).split(" (")[0]
    return f"{words}, with the robot {_HELD[cause['robot_holds']]}" if "robot_holds" in cause else words


def _titled(name: str, about: str) -> str:
    return f'{escape(_words(name))}<br><span class="small">{escape(about)}</span>'


def _card(cause: Mapping[str, Any], *, open_: bool) -> str:
    """Return the card of a cause with the values of its parameters."""
    where = f"{_stage(cause)}, {_listed(cause['axes'])}" if cause["axes"] else _stage(cause)
    together = f" Refitted together with {_listed(cause['with'])}." if cause.get("with") else ""
    rows = [_parameter_row(name, about) for name, about in cause["parameters"].items()]
    name = _words(cause["effect"])
    values = (
        table(
            ["Parameter", "Value", "95 % interval"],
            rows,
            caption=f"Parameters of {name}",
            numeric=(1, 2),
        )
        if rows
        else paragraph("It has no parameters.")
    )
    return (
        f"<details{' open' if open_ else ''}><summary><strong>{escape(_sentence(name))}</strong> "
        f"({escape(where)}, {likely(cause['probability'], 1)})</summary>\n"
        f"<p>Equation: {escape(cause.get('equation', 'not written down'))}.{escape(together)}</p>\n{values}\n</details>"
    )


def _parameter_row(name: str, about: Mapping[str, Any]) -> list[str]:
    si = about.get("unit", "")
    suffix = "_" + si.replace("/", "_per_").replace("^", "").replace(" ", "_")
    factor, unit = _SHOWN.get(si, (1.0, {"1": ""}.get(si, si)))
    ci = about.get("ci95")
    between = _interval([factor * ci[0], factor * ci[1]]) if ci else _DASH
    label = _words(name.removesuffix(suffix) if si else name)
    return [escape(label), f"{rounded(factor * about['value'])} {escape(unit)}".strip(), between]


# ---- how far


def _traces(path: Path) -> dict[str, np.ndarray]:
    """Columns of the table of traces."""
    columns = {name: c.to_numpy() for name, c in zip(*_columns(path), strict=True)}
    pairs = [name.removeprefix("plain_") for name in columns if name.startswith("plain_")]
    needed = ["time_s", *(f"{kind}_{pair}" for pair in pairs for kind in ("measured", "with_effect"))]
    missing = [name for name in needed if name not in columns]
    if missing or not pairs:
        raise InputError(
            path,
            "columns",
            ", ".join(columns),
            ", ".join(missing) or "plain_<marker>_<axis>",
            "Delete the file and run the diagnosis again.",
        )
    return columns


def _columns(path: Path) -> tuple[list[str], list[Any]]:
    content = pq.read_table(path)
    return content.column_names, content.columns


def _largest(traces: Mapping[str, np.ndarray]) -> str:
    """Marker and axis whose plain residual has the largest RMS: ``IF_L_y``."""
    rms = {}
    for name, plain in traces.items():
        if name.startswith("plain_"):
            pair = name.removeprefix("plain_")
            error = plain - traces[f"measured_{pair}"]
            rms[pair] = np.sqrt(np.nanmean(error**2)) if np.isfinite(error).any() else 0.0
    return max(rms, key=lambda pair: rms[pair])


def _how_far(d: Mapping[str, Any], traces: Mapping[str, np.ndarray]) -> str:
    return section(
        "far",
        "How far the gap shrinks",
        '<div class="grid">',
        _gap_bar(d),
        _trace_figure(d, traces),
        "</div>",
    )


def _stack(axes: Axes, base: float, after: float, floor: float) -> None:
    """One bar: floor, unexplained, explained; what an effect makes worse is hatched."""
    bottom = min(floor, base)
    left, worse = min(max(after, bottom), max(base, bottom)), max(after - max(base, floor), 0.0)
    for start, end, colour, label in (
        (0.0, bottom, style.GREY, "noise floor"),
        (bottom, left, style.VERMILION, "unexplained"),
        (left, max(base, left), style.BLUE, "explained"),
    ):
        if end > start:
            axes.barh(0, end - start, left=start, color=colour, height=0.5, label=label)
    if worse:
        axes.barh(
            0, worse, left=max(base, floor), color="none", edgecolor=style.VERMILION, hatch="///", height=0.5
        )
    axes.set_yticks([])
    axes.set_ylim(-0.3, 0.36)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.spines["left"].set_visible(False)
    axes.axvline(floor, color=style.BLACK, linewidth=0.8, linestyle=":")
    axes.set_xlim(0, 1.06 * max(base, after, floor))


def _gap_bar(d: Mapping[str, Any]) -> str:
    gap, floor = d["gap"], d["noise_floor"]
    both = chi2_per_residual(d)
    named = is_explained(d)
    words = f"J: noise floor {rounded(gap['J_floor'], 4)}, plain {rounded(gap['J_base'], 4)}"
    words += f", with {_remedy(d)} {rounded(gap['J_with_effect'], 4)}" if named else ""
    with page_style():
        figure = style.new_figure(0.75 + 0.85 * (2 if both else 1), phantom=d["phantom"])
        panels = figure.subplots(2 if both else 1, 1, squeeze=False)[:, 0]
        _stack(panels[0], gap["J_base"], gap["J_with_effect"], gap["J_floor"])
        low, high = floor["ci95"]
        panels[0].errorbar(
            gap["J_floor"],
            0.3,
            xerr=[[max(gap["J_floor"] - low, 0)], [max(high - gap["J_floor"], 0)]],
            color=style.BLACK,
            capsize=2,
            marker="|",
        )
        panels[0].set_xlabel("cost J")
        if both:
            _stack(panels[1], both[0], both[1], 1.0)
            panels[1].set_xlabel("chi-squared per residual")
            words += f". Chi-squared per residual: noise 1, plain {rounded(both[0])}, best {rounded(both[1])}"
        found: dict[str, Any] = {}
        for axes in panels:
            handles, labels = axes.get_legend_handles_labels()
            found |= dict(zip(labels, handles, strict=True))
        figure.legend(list(found.values()), list(found), loc="outside lower center", ncols=3)
        return picture(
            figure,
            "gap",
            f"Bars of floor, unexplained and explained. {words}.",
            f"The gap on {_trials(_shown(d))}: noise floor (line, with its 95 % interval; "
            f"{floor['source']}), what the {_remedy(d)} explains, what is left. No unit.",
        )


def _trace_figure(d: Mapping[str, Any], traces: Mapping[str, np.ndarray]) -> str:
    pair = _largest(traces)
    marker, axis = pair.rsplit("_", 1)
    time = traces["time_s"]
    measured, plain, after = (1e3 * traces[f"{kind}_{pair}"] for kind in ("measured", "plain", "with_effect"))
    same = bool(np.array_equal(plain, after, equal_nan=True))
    sd = d["noise_floor"].get("residual_sd_m", {}).get(pair)
    rms = [float(np.sqrt(np.nanmean((path - measured) ** 2))) for path in (plain, after)]
    middle = np.nanmean(measured)
    with page_style():
        figure = style.new_figure(3.1, phantom=d["phantom"])
        top, bottom = figure.subplots(2, 1, sharex=True)
        top.plot(time, measured - middle, color=style.BLACK, linewidth=1.2, label="measured")
        top.plot(time, plain - middle, color=style.VERMILION, linewidth=0.8, linestyle="--", label="plain")
        bottom.plot(time, plain - measured, color=style.VERMILION, linewidth=0.8, linestyle="--")
        if not same:
            top.plot(time, after - middle, color=style.BLUE, linewidth=0.7, label=f"with {_remedy(d)}")
            bottom.plot(time, after - measured, color=style.BLUE, linewidth=0.7)
        if sd is not None:
            bottom.axhspan(
                -2e3 * sd, 2e3 * sd, color=style.GREY, alpha=0.35, linewidth=0, label="noise (2 SD)"
            )
            bottom.legend(loc="best")
        top.set_ylabel("position [mm]")
        bottom.set_ylabel("residual [mm]")
        bottom.set_xlabel("time [s]")
        bottom.axhline(0, color=style.GREY, linewidth=0.5)
        figure.legend(*top.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        change = f"RMS {rounded(rms[0])} mm plain" + (
            "" if same else f", {rounded(rms[1])} mm with the {_remedy(d)}"
        )
        noise = (
            ""
            if sd is None
            else f"; grey, two standard deviations of what noise alone gives (SD {rounded(1e3 * sd)} mm)"
        )
        nothing = " Nothing was found that explains it, so there is no second curve." if same else ""
        return picture(
            figure,
            "traces",
            f"Position and residual of {marker} along world {axis} over time. {change}.",
            f"Marker {marker} along world {axis} of {_trials(_shown(d))}, the largest plain residual. Top: about "
            f"its mean. Bottom: simulated less measured, {change}{noise}.{nothing}",
        )


# ---- parameters


def _parameters(d: Mapping[str, Any]) -> str:
    rows_of, law = d["parameters"], _law(d)
    if law is not None and law["model"] is not None:
        return _parameters_with_law(d, law["model"]["parameters"])
    same = all(about["base"] == about["with_effect"] for about in rows_of.values())
    rows = []
    for name, about in rows_of.items():
        change = style.signed(100 * (about["with_effect"] / about["base"] - 1), 1) + " %"
        value = rounded(about["with_effect"], 4)
        known = [_interval(about["ci95"]), escape(about["verdict"]), escape(about["unit"])]
        moved = [rounded(about["base"], 4), value, change]
        rows.append([escape(name), *([value] if same else moved), *known])
    values = table(
        [
            "Parameter",
            *(["Plain"] if same else ["Plain", f"With {_remedy(d)}", "Change"]),
            "95 %",
            "Verdict",
            "Unit",
        ],
        rows,
        caption="The parameters of the interface, fitted on the training trial, less what noise of the replayed pelvis "
        "adds where that stands out; the intervals are those of the values after that correction",
        numeric=(1, 2) if same else (1, 2, 3, 4),
    )
    if same:
        return section(
            "parameters",
            "The parameters",
            paragraph("No effect was added, so none of them moves."),
            values,
        )
    return section(
        "parameters",
        "How the parameters move",
        '<div class="grid wide">',
        _ratio_figure(d, {name: about["with_effect"] / about["base"] for name, about in rows_of.items()}),
        values,
        "</div>",
    )


def _parameters_with_law(d: Mapping[str, Any], fitted: Mapping[str, Any]) -> str:
    """Return the section of the parameters where they were fitted once more, beside a measured law."""
    rows = [
        [
            escape(name),
            rounded(about["base"], 4),
            rounded(fitted[name]["value"], 4),
            style.signed(100 * (fitted[name]["value"] / about["base"] - 1), 1) + " %",
            escape(about["unit"]),
        ]
        for name, about in d["parameters"].items()
    ]
    values = table(
        ["Parameter", "Plain", "With measured law", "Change", "Unit"],
        rows,
        caption="The parameters of the interface, fitted on the training trial without the law and beside it. A law "
        "may hold a straight part, which stiffness or damping of its axis then lack",
        numeric=(1, 2, 3),
    )
    ratio = {name: fitted[name]["value"] / about["base"] for name, about in d["parameters"].items()}
    parts = ['<div class="grid wide">', _ratio_figure(d, ratio), values, "</div>"]
    return section("parameters", "How the parameters move", *parts)


def _ratio_figure(d: Mapping[str, Any], ratios: Mapping[str, float]) -> str:
    names, ratio = list(ratios), list(ratios.values())
    reach = max(1.2, *(max(r, 1 / r) for r in ratio)) ** 1.05
    most = max(zip(ratio, names, strict=True), key=lambda item: abs(math.log(item[0])))
    with page_style():
        figure = style.new_figure(0.6 + 0.17 * len(names), phantom=d["phantom"])
        axes = figure.subplots()
        axes.axvline(1, color=style.GREY, linewidth=0.8)
        axes.hlines(
            range(len(names)), [min(r, 1) for r in ratio], [max(r, 1) for r in ratio], color=style.BLUE
        )
        axes.plot(ratio, range(len(names)), "o", color=style.BLUE, markersize=4)
        axes.set_xscale("log")
        axes.set_xlim(1 / reach, reach)
        style.log_axis(axes.xaxis, 1 / reach, reach)
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.set_xlabel(f"with {_remedy(d)} / plain (logarithmic)")
        return picture(
            figure,
            "ratios",
            f"Ratio of each parameter with the {_remedy(d)} to its plain value. Largest change: {most[1]}, "
            f"{rounded(most[0])} times.",
            f"Each parameter with the {_remedy(d)} in the model over its value in the plain model, which mimics the "
            "gap by wrong parameters as far as it can.",
        )


# ---- what next


def _next(d: Mapping[str, Any]) -> str:
    others = [name for name in d["ambiguity_group"] if name != d["verdict"]]
    if d["verdict"] in _NOT_EFFECTS:
        group = f"The verdict {d['verdict']} stands alone."
    elif others:
        group = (
            f"These data do not tell {_words(d['verdict'])} from {_listed(others, 'or')}: they leave the same "
            "trace in the markers."
        )
    else:
        group = f"No other effect that leaves the same trace as {_words(d['verdict'])} is still likely."
    trial = f"The next trial: {_trial(d)}."
    return section("next", "What cannot be told apart, and the next trial", paragraph(f"{group} {trial}"))


def _model(d: Mapping[str, Any]) -> str:
    """Return the pointer to the model for the next simulation."""
    names, law = dict.fromkeys(entry["effect"] for entry in d["model"]["effects"]), _law(d)
    what = "without an effect: the plain plant with the plain fit"
    if names:
        what = f"with {_listed(list(names))}"
    elif law is not None and law["model"] is not None:
        what = "with the measured law, its forces on motors of their own (planned_*)"
    return section(
        "model",
        "The model for the next simulation",
        f'<p><a href="model.xml">model.xml</a> is robot and interface {escape(what)}, in a file of its own that MuJoCo '
        'loads; <a href="model.json">model.json</a> says what of the diagnosis is no part of a model and what to do '
        'about it; <a href="model_replay.csv">model_replay.csv</a> replays a trial with it.</p>',
    )


def _foot(d: Mapping[str, Any]) -> str:
    p = d["provenance"]
    rows = [
        [
            f"<code>{escape(Path(path).name)}</code> <span class='small'>{escape(path)}</span>",
            f"<code>{digest[:16]}</code>",
        ]
        for path, digest in p.get("inputs_sha256", {}).items()
    ]
    packages = ", ".join(f"{name} {version}" for name, version in p.get("packages", {}).items())
    judged = _trials([*d["held_out"], *d.get("further", [])])
    facts = [
        f"Person {d['subject']}; fitted on {_trials(d['train'])}, judged on {judged}.",
        f"Format {d.get('schema', 1)}; code {p.get('code_fingerprint', 'not recorded')}; Python {p.get('python', '?')}"
        f"{'; ' + packages if packages else ''}.",
    ]
    inputs = table(["Input", "SHA-256 (first 16)"], rows, caption="Files that this rests on") if rows else ""
    settings = json.dumps(d.get("settings", {}).get("diagnosis", {}), indent=1, ensure_ascii=False)
    return (
        '<footer>\n<h2 id="provenance">Provenance</h2>\n'
        + "\n".join(paragraph(text) for text in facts)
        + (f"\n<details><summary>Input files</summary>\n{inputs}\n</details>" if inputs else "")
        + f"\n<details><summary>Settings of the diagnosis</summary>\n<pre>{escape(settings)}</pre>\n</details>"
        + "\n</footer>"
    )
