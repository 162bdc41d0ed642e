"""The page of one person who is set up from the priors: one file with everything that a simulation of them needs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import read_json
from real2sim.configuration import read_yaml
from real2sim.diagnosis.stated import answer_probability, other_robot
from real2sim.files import write_text
from real2sim.inference.identifiability import DETERMINED
from real2sim.inference.parameters import PARAMETERS
from real2sim.pages import style
from real2sim.pages.diagnosis import digest, shows_gap
from real2sim.pages.page import (
    document,
    download,
    folded,
    likely,
    listed,
    page_style,
    paragraph,
    percent,
    picture,
    rounded,
    section,
    table,
    verdict,
)
from real2sim.pages.quality import warnings_of_files
from real2sim.recording.quality.verdict import PASS, REFUSE, WARN, worst
from real2sim.study.refinement import OK
from real2sim.study.step_study import BY_HAND

_DASH = "\N{EN DASH}"
_AXES = {
    "tx": "forward (mm)",
    "ty": "left (mm)",
    "tz": "up (mm)",
    "rx": "roll (deg)",
    "ry": "pitch (deg)",
    "rz": "yaw (deg)",
}
_WHO = (
    ("Cohort", "cohort", ""),
    ("Sex", "sex", ""),
    ("Age", "age_years", "years"),
    ("Mass", "mass_kg", "kg"),
    ("Height", "height_m", "m"),
    ("Waist", "waist_m", "m"),
)


@dataclass
class Person:
    """Content of the page; None where there is none."""

    about: dict[str, Any]
    gates: dict[str, Any]
    refined: dict[str, Any]
    notes: dict[str, Any]
    files: dict[str, tuple[Path, str]]
    breakpoints: dict[str, Any] | None
    limits: dict[str, Any] | None
    step: dict[str, Any] | None
    diagnosis: dict[str, Any] | None


def person_page(
    *,
    person: Path,
    gates: Path,
    refined: Path,
    interface: Path,
    notes: Path,
    out: Path,
    breakpoints: Path | None = None,
    limits: Path | None = None,
    step: Path | None = None,
    diagnosis: Path | None = None,
    model: Path | None = None,
) -> None:
    """Write the page of one person: who, recordings, limits, parameters, J, diagnosis, files, provenance.

    Parameters
    ----------
    person
        subject.yaml.
    gates, refined, interface, notes
        gates.json, results/refined/<SUBJECT>.json, and MJCF and JSON of the interface.
    breakpoints, limits, step, diagnosis, model
        Of the person, where sweeps, limits, step study and two dynamic trials are there; ``model`` is model.xml of the
        diagnosis.
    """
    study = Person(
        about=read_yaml(person),
        gates=read_json(gates, ("trials",)),
        refined=read_json(refined, ("subject", "status", "parameters", "trials")),
        notes=read_json(notes, ("trial", "timestep_s", "replay_difference_m")),
        files={
            "interface.xml": (interface, "application/xml"),
            "interface.json": (notes, "application/json"),
            "refined.json": (refined, "application/json"),
        },
        breakpoints=read_json(breakpoints, ("operating_point",)) if breakpoints else None,
        limits=read_json(limits, ("q_min", "q_max", "axes")) if limits else None,
        step=read_json(step, ("timestep_s", "status")) if step else None,
        diagnosis=read_json(diagnosis, ("subject", "verdict")) if diagnosis else None,
    )
    if model and _cause_model(study.diagnosis):
        study.files["model.xml"] = (model, "application/xml")
    body = [
        *_notices(study),
        paragraph(_lead(study), "lead"),
        _diagnosis(study),
        _who(study),
        _quality(study),
        _tightness(study),
        _parameters(study),
        _costs(study),
        _files(study),
        _provenance(study),
    ]
    name = study.refined["subject"]
    write_text(out, document(f"Interface of {name}", body, phantom=study.refined["phantom"]))


def _words(name: str) -> str:
    return name.replace("_", " ")


def _interval(low: float | None, high: float | None) -> str:
    return _DASH if low is None and high is None else f"[{rounded(low)}, {rounded(high)}]"


def _mean(refined: Mapping[str, Any], kind: str) -> float:
    return float(np.mean([trial[kind]["J"] for trial in refined["trials"].values()]))


# -------------------- the top


def _notices(study: Person) -> list[str]:
    """Return the notices that a reader needs before any number."""
    refined, out = study.refined, []
    if refined["status"] != OK:
        out.append(f"Nothing was refined: {refined['status']}.")
    for trial, gates in refined["refused_gates"].items():
        out.append(f"{trial} is refused by its gates ({', '.join(gates)}) and left out.")
    if refined["overridden_gates"]:
        listed = ", ".join(refined["overridden_gates"])
        out.append(f"Used although a gate refuses it (quality.override): {listed}.")
    if refined["priors_rest_on_refused"]:
        listed = ", ".join(refined["priors_rest_on_refused"])
        out.append(f"The priors rest on trials that a gate refuses (quality.override): {listed}.")
    if refined["prior_rests_on_person"]:
        out.append("This person's own fits are among those behind the priors: no test on someone unseen.")
    out += [f"{name} stands {row['end']}." for name, row in refined["parameters"].items() if row["end"]]
    return [f'<p class="notice">{escape(text)}</p>' for text in out]


def _lead(study: Person) -> str:
    refined = study.refined
    if refined["status"] != OK:
        return f"All {len(PARAMETERS)} parameters are the point prior."
    n, trials = len(refined["free"]), len(refined["trials"])
    pooled = refined["pooled"]
    # the values are those of all trials together, and each trial's own refinement has a smaller J
    before, after = _mean(refined, "prior"), pooled["J"] if pooled else _mean(refined, "refined")
    floor = refined["noise_floor"]["J"]
    on = f"{trials} dynamic trials together" if pooled else "1 dynamic trial"
    quantity = "Mean J of these trials" if pooled else "J"
    return (
        f"{n} of {len(PARAMETERS)} parameters are refined on {on}, the"
        f" others are the prior's. {quantity} falls from {rounded(before)} at the prior to {rounded(after)},"
        f" {rounded(after / floor)} times what noise alone costs ({rounded(floor)})."
    )


# -------------------- sections


def _who(study: Person) -> str:
    rows = [
        [escape(label), escape(f"{study.about[key]} {unit}".strip())]
        for label, key, unit in _WHO
        if study.about.get(key) is not None
    ]
    return section("who", "Who", table(["About", "Value"], rows, caption="From subject.yaml"))


def _quality(study: Person) -> str:
    trials = study.gates["trials"]
    counts = Counter(about["verdict"] for about in trials.values())
    text = f"{len(trials)} trials: {counts[PASS]} pass, {counts[WARN]} are warned about, {counts[REFUSE]} refused."
    rows = [
        [
            escape(name),
            verdict(gate["verdict"], gate["verdict"] + (", overridden" if about["override"] else "")),
            escape(_words(gate["gate"])),
            escape(gate["message"]),
            escape(gate["remedy"]),
        ]
        for name, about in trials.items()
        for gate in about["gates"]
        if gate["verdict"] != PASS
    ]
    found = "No gate warns or refuses." if not rows else ""
    caption = "Every warning and refusal; a refused trial is not fitted unless it is overridden by name"
    detail = (
        folded(
            f"{len(rows)} warnings and refusals",
            table(["Trial", "Verdict", "Gate", "What was found", "What helps"], rows, caption=caption),
            unfolded=len(rows) <= 12,
        )
        if rows
        else ""
    )
    grave = worst(about["verdict"] for about in trials.values())
    warned = [
        (name, f["code"], f["message"], f["action"])
        for name, about in trials.items()
        for f in about["findings"]
    ]
    summary = f"<p>{verdict(grave)}. {escape(text)}</p>"
    plain = paragraph(found) if found else ""
    return section("quality", "Quality of the recordings", summary, plain, detail, warnings_of_files(warned))


def _tightness(study: Person) -> str:
    parts = []
    if study.breakpoints:
        point = study.breakpoints["operating_point"]
        knee = (
            f" The knee of the sweep lies at {rounded(point['knee_cm'])} cm"
            f" ({'within' if point['agree'] else 'not within'} one step of it)."
            if point.get("knee_cm") is not None
            else f" Knee of the sweep: {point['status']}."
        )
        parts.append(paragraph(f"Operating point T*: {rounded(point['selected_cm'])} cm, as selected.{knee}"))
        if study.breakpoints.get("warning"):
            parts.append(paragraph(f"Check subject.yaml: {study.breakpoints['warning']}."))
    else:
        parts.append(paragraph("No tightness sweep was recorded."))
    if study.limits:
        rows = []
        for axis, low, high in zip(
            study.limits["axes"], study.limits["q_min"], study.limits["q_max"], strict=True
        ):
            factor = 1e3 if axis[0] == "t" else math.degrees(1)
            ends = (style.signed(factor * end, 1) for end in (low, high))
            rows.append([escape(axis), escape(_AXES[axis]), *ends])
        caption = "Joint limits of the interface at T*, from rest: what the sweeps allowed"
        parts.append(
            table(["Coordinate", "Direction (unit)", "From", "To"], rows, caption=caption, numeric=(2, 3))
        )
    else:
        parts.append(paragraph("No joint limits: the sweeps at T* are missing. The strap's joints are free."))
    if study.step:
        parts.append(
            paragraph(f"Time step: {study.step['timestep_s']:g} s, {_chosen(study.step['status'])}.")
        )
    else:
        parts.append(paragraph(f"Time step: {study.notes['timestep_s']:g} s, without a step study."))
    return section("tightness", "Tightness and limits", *parts)


def _chosen(status: str) -> str:
    """Return who chose the time step, from the status of the step study."""
    return status if status.startswith(BY_HAND) else f"by the step study ({status})"


def _parameters(study: Person) -> str:
    refined, beside = study.refined, _beside_cause(study.diagnosis)
    trials = refined["trials"]
    incomplete = study.diagnosis is not None and shows_gap(study.diagnosis)
    head = ["Parameter", "Unit"]
    if beside:
        head += [f"With {_cause(study.diagnosis)}", "Verdict"]
    first = len(head)
    head += ["Prior", "Searched", "Value", "From"]
    for trial in trials:
        head += [_words(trial), "Verdict (plain model)" if incomplete else "Verdict"]
    rows = []
    for name in PARAMETERS:
        row = refined["parameters"][name]
        cells = [escape(name), escape(row["unit"])]
        if beside:
            cells += beside.get(name, [_DASH, _DASH])
        cells += _from_prior(row, searched=refined["status"] == OK)
        for trial in trials.values():
            cells += _judged(trial, name, incomplete=incomplete)
        rows.append(cells)
    caption = (
        f"The {len(PARAMETERS)} parameters, relative as long as no force was measured. Value: of all trials together."
        " Trials: their own refinement with its 95 % interval, the fixed parameters taken for known. Rotation about y"
        " is informed only through the arm's pitch."
    )
    numeric = [*range(2, first, 2), *range(first, first + 3), *range(first + 4, len(head), 2)]
    if study.diagnosis and beside:
        caption += (
            f" With {_cause(study.diagnosis)}: fitted together with it on {' and '.join(study.diagnosis['train'])}"
            f"{'' if study.diagnosis['verdict'] == 'unknown' else ', with the 95 % interval of that fit'}; all other"
            " columns are of the plain model."
        )
    return section(
        "parameters",
        "Parameters",
        _of_plain_model(study),
        _figure(study) if refined["status"] == OK and refined["free"] else "",
        table(head, rows, caption=caption, numeric=numeric),
    )


def _from_prior(row: Mapping[str, Any], *, searched: bool) -> list[str]:
    """Return the cells prior, searched, value and from; without a search the prior stands, whatever its use."""
    source = row["source"]
    if searched and source == "prior":
        source = f"prior, {row['use']}"
    between = _interval(row["low"], row["high"]) if searched else _DASH
    return [rounded(row["prior"], 4), between, rounded(row["value"], 4), escape(source)]


def _judged(trial: Mapping[str, Any], name: str, *, incomplete: bool) -> list[str]:
    """Return value and verdict by one trial; no check mark where the diagnosis finds the plain model incomplete."""
    found = trial["verdicts"].get(name)
    if found is None:
        return [_DASH, _DASH]
    about = verdict(found["verdict"])
    if incomplete and found["verdict"] == DETERMINED:
        about = escape(DETERMINED)
    return [_with_interval(trial["refined"]["parameters"][name], found["ci95"]), about]


def _with_interval(value: float, ci95: Sequence[float | None]) -> str:
    return f"{rounded(value)} <span class='small'>{_interval(*ci95)}</span>"


# -------------------- the plain model and what it lacks


def _cause(diagnosis: Mapping[str, Any] | None) -> str:
    """Return what the diagnosis finds beside the plain model, in words; `shows_gap` is true of it."""
    assert diagnosis is not None
    robot = other_robot(diagnosis)
    if diagnosis["verdict"] == "unknown":
        return "measured law" if diagnosis.get("free_form") else "unknown cause"
    names = [
        _words(name) for name in diagnosis.get("verdict_set") or [diagnosis["verdict"]] if name != "none"
    ]
    return listed([*names, *([f"another robot, {robot}"] if robot else [])])


def _cause_model(diagnosis: Mapping[str, Any] | None) -> bool:
    """Return whether model.xml of a diagnosis was fitted together with a cause or with a measured law."""
    if diagnosis is None or not shows_gap(diagnosis):
        return False
    if diagnosis["verdict"] == "unknown":
        law = diagnosis.get("free_form")
        return bool(law and law["model"])
    return bool(diagnosis["verdict"] != "none")


def _beside_cause(diagnosis: Mapping[str, Any] | None) -> dict[str, list[str]]:
    """Return value and verdict of each parameter as fitted together with the cause, as cells; empty without one."""
    if diagnosis is None or not _cause_model(diagnosis):
        return {}
    if diagnosis["verdict"] == "unknown":
        fitted = diagnosis["free_form"]["model"]["parameters"]
        return {name: [rounded(row["value"]), _DASH] for name, row in fitted.items()}
    return {
        name: [_with_interval(row["with_effect"], row["ci95"]), verdict(row["verdict"])]
        for name, row in diagnosis["parameters"].items()
    }


def _of_plain_model(study: Person) -> str:
    """Return the notice that the values are those of a model that the diagnosis finds incomplete; else nothing."""
    d = study.diagnosis
    if d is None or not shows_gap(d):
        return ""
    cause, sure = _cause(d), likely(answer_probability(d))
    lacks = "the cause is unknown" if d["verdict"] == "unknown" else f"it lacks {cause}"
    name = study.refined["subject"]
    text = (
        "Stiffness and damping by refinement (table of parameters, interface.xml, refined.json) are of the plain model,"
        f" which the diagnosis finds incomplete: {lacks} (probability {sure}). They make up for what the model lacks,"
        " so that their intervals, which count noise alone, need not hold the true values."
    )
    if "model.xml" in study.files:
        text += (
            f" results/diagnosis/{name}/model.xml (under Files: {name}_model.xml) holds the model that was fitted"
            f" together with the diagnosed cause ({cause}); model.json beside it says which part of the cause cannot"
            " be in a model file, and what to do about it."
        )
    elif d["verdict"] == "none":
        text += " Configure that robot (robot) and refine again."
    elif not _cause_model(d):
        text += " There is no model with the cause."
    return f'<p class="notice">{escape(text)}</p>'


def _figure(study: Person) -> str:
    """Free parameters over their prior: what was searched, what each trial and all together give."""
    refined = study.refined
    names = [name for name in PARAMETERS if name in refined["free"]]
    rows = {name: refined["parameters"][name] for name in names}
    with page_style():
        figure = style.new_figure(1.1 + 0.22 * len(names), phantom=refined["phantom"])
        axes = figure.subplots()
        axes.axvline(1, color=style.GREY, linewidth=0.8)
        reach = 1.2
        for i, (name, row) in enumerate(rows.items()):
            ends = [row["low"] / row["prior"], row["high"] / row["prior"]]
            axes.plot(ends, [i, i], color=style.GREY, linewidth=3, solid_capstyle="butt", label="searched")
            reach = max(reach, 1 / ends[0], ends[1])
            for j, trial in enumerate(refined["trials"].values()):
                ratio = trial["refined"]["parameters"][name] / row["prior"]
                look = style.person_style(j + 1)
                axes.plot(ratio, i, linestyle="", label=_words(list(refined["trials"])[j]), **look)
            axes.plot(
                row["value"] / row["prior"],
                i,
                "|",
                color=style.BLUE,
                markersize=10,
                markeredgewidth=2,
                label="value",
            )
        axes.set_xscale("log")
        axes.set_xlim(1 / reach**1.05, reach**1.05)
        style.log_axis(axes.xaxis, 1 / reach, reach)
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.set_xlabel("value / prior (logarithmic)")
        handles, labels = axes.get_legend_handles_labels()
        first = dict(zip(reversed(labels), reversed(handles), strict=True))
        ordered = dict(reversed(first.items()))
        figure.legend(list(ordered.values()), list(ordered), loc="outside lower center", ncols=4)
        words = ", ".join(f"{name} {rounded(row['value'] / row['prior'])}" for name, row in rows.items())
        return picture(
            figure,
            "values",
            f"Refined parameters over their prior: {words}.",
            "Free parameters over the point prior (no unit): grey, where was searched; markers, each dynamic trial"
            " alone; bar, all trials together.",
        )


def _costs(study: Person) -> str:
    refined = study.refined
    if refined["status"] != OK:
        return section(
            "cost", "Cost J and noise", paragraph(f"{refined['status'][0].upper()}{refined['status'][1:]}.")
        )
    floor = refined["noise_floor"]
    low, high = floor["ci95"]
    caption = (
        f"Cost J (no unit) and position RMSE. Measurement noise alone costs {rounded(floor['J'])}"
        f" [{rounded(low)}, {rounded(high)}]; evaluations of a full calibration: of its best restart"
    )
    if refined["pooled"]:
        caption += (
            ". Refined on all trials together: the values in the table of parameters and in interface.xml. Refined on"
            " this trial alone: lower, because only this trial decided the values"
        )
    costs = table(
        ["Trial and parameters", "J", "Times noise", "RMSE [mm]", "Evaluations"],
        _cost_rows(refined),
        caption=caption,
        numeric=(1, 2, 3, 4),
    )
    return section(
        "cost",
        "Cost J and noise",
        costs,
        _against(refined),
        _beyond(refined),
        _elsewhere(refined),
        _more(refined),
    )


def _cost_rows(refined: Mapping[str, Any]) -> list[list[str]]:
    """Return a row of costs per trial and set of parameters, and one of the mean J that was minimised on all trials."""
    floor, pooled = refined["noise_floor"]["J"], refined["pooled"]
    alone = "refined on this trial alone" if pooled else "refined"
    together = "refined on all trials together"
    rows = []
    for name, trial in refined["trials"].items():
        full = trial["full"]
        found = [
            ("point prior", trial["prior"], None),
            (alone, trial["refined"], trial["refined"]["evaluations"]),
        ]
        if pooled:
            found.append((together, pooled["trials"][name], pooled["evaluations"] // len(refined["trials"])))
        if full:
            found.append(("full calibration", full, full["evaluations_best_restart"]))
        rows += [_cost_row(f"{_words(name)}, {label}", cost, floor, count) for label, cost, count in found]
    if pooled:
        rows.append(_cost_row(f"mean of the trials, {together}", pooled, floor, pooled["evaluations"]))
    return rows


def _cost_row(label: str, cost: Mapping[str, Any], floor: float, evaluations: int | None) -> list[str]:
    return [
        escape(label),
        rounded(cost["J"], 4),
        rounded(cost["J"] / floor),
        rounded(1e3 * cost["rmse_position_m"]) if "rmse_position_m" in cost else _DASH,
        _DASH if evaluations is None else str(evaluations),
    ]


def _against(refined: Mapping[str, Any]) -> str:
    out = []
    for name, trial in refined["trials"].items():
        found = trial["against_full"]
        if not found:
            continue
        bar = found["bar"]
        said = "meets" if found["met"] else "misses"
        beside = "above" if found["J_ratio"] >= 1 else "below"
        text = (
            f"{_words(name)}: J is {percent(abs(found['J_ratio'] - 1), 1)} {beside} a full calibration's with"
            f" {percent(found['evaluations_over_best_restart'], 1)} of the evaluations of one restart"
            f" ({percent(found['evaluations_over_all_restarts'], 1)} of all). It {said} the bar of"
            f" {percent(bar['J_ratio'] - 1)} with {percent(bar['evaluations_over_best_restart'])}."
        )
        out.append(paragraph(text))
    if not out:
        out.append(paragraph("No full calibration of this person is there to compare with."))
    return "\n".join(out)


def _beyond(refined: Mapping[str, Any]) -> str:
    """Return the sentence about the cost of staying inside the intervals."""
    out = []
    for name, trial in refined["trials"].items():
        further = trial["beyond_ends"]
        if further:
            values = ", ".join(
                f"{parameter} {rounded(value)}" for parameter, value in further["parameters"].items()
            )
            out.append(
                paragraph(
                    f"{_words(name)}: beyond the ends of the intervals that were reached J would fall by"
                    f" {percent(1 - further['J'] / trial['refined']['J'], 1)} ({values}); refinement.also_free searches"
                    " there by name."
                )
            )
    return "\n".join(out)


def _elsewhere(refined: Mapping[str, Any]) -> str:
    if not refined["cross_trial"]:
        return ""
    labels = {"refined": "refined", "full": "full calibration"}
    rows = [
        [
            escape(f"{labels[kind]}, {_words(pair['train'])} on {_words(pair['test'])}"),
            rounded(pair["J_cross"], 4),
            rounded(pair["J_within"], 4),
            percent(pair["J_cross"] / pair["J_within"] - 1, 1),
        ]
        for kind, about in refined["cross_trial"].items()
        for pair in about["pairs"]
    ]
    return table(
        ["Parameters of a trial on another", "J", "J of its own", "Overhead"],
        rows,
        caption="What was found on one trial, judged on the other",
        numeric=(1, 2, 3),
    )


def _more(refined: Mapping[str, Any]) -> str:
    """Return the table of gains of each fixed parameter if it were free too."""
    gained = {name: trial["if_also_free"] for name, trial in refined["trials"].items()}
    fixed = [name for name in PARAMETERS if all(name in more for more in gained.values())]
    against = [name for name in fixed if all(more[name]["contradicts_prior"] for more in gained.values())]
    if not fixed:
        return ""
    head = ["Parameter"]
    for trial in gained:
        head += [f"{_words(trial)}: J falls by", "to the value", "beyond noise"]
    rows = []
    for name in fixed:
        cells = [escape(name)]
        for more in gained.values():
            own = more[name]
            cells += [
                percent(own["gain"], 1),
                rounded(own["value"]),
                "yes" if own["contradicts_prior"] else "no",
            ]
        rows.append(cells)
    caption = "One fixed parameter free at a time, inside the search bounds"
    numeric = tuple(i for k in range(len(gained)) for i in (1 + 3 * k, 2 + 3 * k))
    said = (
        f"Every trial speaks against the prior of {', '.join(against)}. To refine such a parameter too, name it under"
        " refinement.also_free. What the model lacks (see the diagnosis) shows here as well."
        if against
        else "No fixed parameter's prior is contradicted by every trial."
    )
    return paragraph(said) + folded(
        "What more freedom would gain", table(head, rows, caption=caption, numeric=numeric)
    )


def _diagnosis(study: Person) -> str:
    heading = "Why simulation and measurement differ"
    if study.diagnosis is None:
        return section("diagnosis", heading, paragraph("A diagnosis needs two dynamic trials."))
    return section("diagnosis", heading, digest(study.diagnosis))


def _files(study: Person) -> str:
    name, notes = study.refined["subject"], study.notes
    links = "".join(
        f"<li>{download(f'{name}_{file}', path.read_bytes(), kind)}</li>"
        for file, (path, kind) in study.files.items()
    )
    off = notes["replay_difference_m"]
    same = "where ours are, to the last bit" if off == 0 else f"within {off:.1g} m of ours"
    text = (
        "interface.xml is robot, strap and pelvis in one file that MuJoCo loads, with these parameters, joint limits"
        f" and rest pose; interface_replay.csv beside it drives it through {_words(notes['trial'])}. Loaded again and"
        f" replayed by plain MuJoCo, its markers are {same}."
    )
    return section("files", "Files", _of_plain_model(study), paragraph(text), f"<ul>{links}</ul>")


def _provenance(study: Person) -> str:
    record = study.refined["provenance"]
    packages = ", ".join(f"{name} {version}" for name, version in record["packages"].items())
    rows = [
        [f"<code>{escape(path)}</code>", f"<code>{digest_[:16]}</code>"]
        for path, digest_ in sorted(record["inputs_sha256"].items())
    ]
    facts = f"Refined by code {record['code_fingerprint']}; Python {record['python']}; {packages}."
    files = table(["File", "SHA-256 (first 16)"], rows, caption="Files that this rests on")
    inside = f"{paragraph(facts)}\n{folded(f'{len(rows)} input files', files)}"
    return f'<footer>\n<h2 id="provenance">Provenance</h2>\n{inside}\n</footer>'
