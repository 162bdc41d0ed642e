"""The page of a study: one file that holds its figures and tables, needs nothing beside it and is read offline.

A section stands where what it tells of exists; a later stage adds one by adding its function to `_SECTIONS`.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from real2sim.artefacts import number, read_json, read_table
from real2sim.files import write_text
from real2sim.inference.parameters import PARAMETERS, unit
from real2sim.pages.diagnosis import (
    answer_probability,
    answer_words,
    chi2_closed,
    chi2_per_residual,
    digest,
    shows_gap,
)
from real2sim.pages.front import front
from real2sim.pages.page import (
    bar,
    document,
    download,
    folded,
    inline,
    likely,
    paragraph,
    percent,
    rounded,
    section,
    table,
    verdict,
)
from real2sim.pages.paper_gap import RECORD_KEYS as PAPER_GAP_KEYS
from real2sim.pages.paper_gap import told
from real2sim.pages.style import signed
from real2sim.pages.validation import RECORD_KEYS, withheld_check
from real2sim.recording.quality.verdict import PASS, REFUSE, WARN, worst
from real2sim.study.paper.tables import ABOUT_COUNTS, is_published, missing_priors

Row = dict[str, str]

# Beyond so many people the page tells of all together; rows of single ones are folded away or left to the tables
MANY_PEOPLE = 40
# Beyond so many input files each fit file holds its own, and the page their number
MANY_FILES = 400
VERDICTS = ("determined", "weak", "not determined", "at bound")
_DASH = "\N{EN DASH}"

# By the name of the figure's file: title, and what it shows with units and place in the paper
FIGURES = {
    "gap": (
        "The gap of everyone",
        "Chi-squared per residual (no unit, logarithmic) of the held-out trial, or of the fitted one where that alone "
        "shows the gap (marked *): circle, the plain model of strap and robot; diamond, the same with the diagnosed "
        "cause or, where that is unknown, the measured law in it, open where a cause carries the misfit mark: more "
        "than noise is left beside it; dashed, what noise alone leaves, 1. At the dashed line there is no gap to "
        "explain, and the answer is none. In brackets: the probability of the answer.",
    ),
    "paper_gap": (
        "Causes beside the paper",
        "By how much the cohort of each cause misses what the paper prints, over what causes usually miss it by (no "
        "unit), nearest at the top. Circle: the five people; bar: 90 % of resamples of them. Filled: the numbers "
        "cannot tell it from the nearest.",
    ),
    "tightness": (
        "Tightness sweep",
        "Allowable motion against normalised tightness (no unit; 0 is the selected level, positive is "
        "tighter). (a, b) "
        "Range of translation in mm. (c) Range of pelvic rotation of either side in deg, with the pooled two-segment "
        "regression, its slopes in deg per unit of normalised tightness, and the knee with its interval (grey band). "
        "Paper: Fig. 3.",
    ),
    "convergence": (
        "Convergence",
        "Best cost J so far (no unit, logarithmic) against cost evaluations, a row per person and a column "
        "per dynamic "
        "trial; restarts grey, the best one blue. Dashed: what measurement noise alone costs, from the "
        "person's neutral "
        "trial. Paper: Fig. 4, top.",
    ),
    "icc": (
        "Shareability",
        "(a) ICC(1,1) (no unit) of each parameter with the cluster bootstrap's percentile interval and the exact F "
        "interval; zones are the class limits. (b) Every fit over the geometric mean of all (no unit, logarithmic), "
        "shaded by class. Paper: Fig. 4, middle.",
    ),
    "coverage": (
        "What the intervals are worth",
        "Simulated cohorts with a known ICC: how often each method's 95 % interval holds it, against people, and how "
        "often a truly common and a truly distinct parameter are classed right (shares, no unit). Simulation, no "
        "measurement and no phantom.",
    ),
    "loso": (
        "Leave one subject out",
        "What the prior of the others costs the person left out: overhead over their own best fit in %, for "
        "cost J and "
        "for position RMSE. Paper: Fig. 4, bottom, and eq. 7.",
    ),
    "interface": (
        "Interface while walking",
        "Where the interface midpoint goes relative to the pelvis, from above (mm), while walking with the robot: "
        "measured, and simulated under every interface (first seed), with 95 % ellipses; γ is "
        "the ratio of the spreads forward and to the side. Paper: Fig. 5.",
    ),
    "gait": (
        "Gait",
        "Hip, knee and ankle angle (deg) over the gait cycle (%), measured and simulated, with and without the robot; "
        "mean and SD over cycles, first seed. (g) What the robot changes in the range of motion (deg), a point per "
        "seed. Paper: Fig. 6.",
    ),
    "speed": (
        "Speed or strap",
        "Change of the range of motion (deg) of hip and knee against the change of walking speed (%): a point per "
        "strap, cap, robot and seed, filled where the simulated person takes up the speed that the robot allows. The "
        "line is the same person as slow without a robot: what lies on it is speed, what lies off it is the strap.",
    ),
    "wrench": (
        "Force of the strap",
        "Force (N) and torque (Nm) of the strap on the robot's interface over the gait cycle (%), where a sensor "
        "logged them and as the simulated strap exerts them without its stops; mean over strides, first seed.",
    ),
}

_SCRIPT = """
(() => {
  const box = document.createElement('dialog');
  box.className = 'zoom';
  box.setAttribute('aria-labelledby', 'zoom-title');
  box.innerHTML = '<div class="bar-of-tools"><h2 id="zoom-title"></h2><span><button type="button" value="-0.5" '
    + 'aria-label="Smaller">\\u2212</button> <button type="button" value="0.5" aria-label="Larger">+</button> '
    + '<button type="button" value="close">Close</button></span></div>'
    + '<div class="sheet" tabindex="0" role="region" aria-label="Figure, scrolls"></div>';
  document.body.append(box);
  const sheet = box.querySelector('.sheet');
  let home = null, drawing = null, size = 1;
  const fit = (value) => { size = Math.min(6, Math.max(1, value)); sheet.style.setProperty('--size', size); };
  box.addEventListener('click', (event) => {
    const button = event.target.closest('button');
    if (!button) return;
    if (button.value === 'close') box.close(); else fit(size + Number(button.value));
  });
  box.addEventListener('close', () => { home.prepend(drawing); home.querySelector('button').focus(); });
  for (const button of document.querySelectorAll('button.enlarge')) {
    button.hidden = false;
    button.addEventListener('click', () => {
      home = button.closest('figure');
      drawing = home.firstElementChild;
      box.querySelector('h2').textContent = button.dataset.title;
      sheet.replaceChildren(drawing);
      fit(1);
      box.showModal();
      box.querySelector('[value=close]').focus();
    });
  }
  addEventListener('beforeprint', () => { for (const d of document.querySelectorAll('details')) d.open = true; });
})();
""".strip()


@dataclass(frozen=True)
class Table:
    """A CSV file and its rows of text."""

    path: Path
    rows: list[Row]

    @classmethod
    def read(cls, path: Path) -> Table:
        """Read a table. Raises InputError where it is broken."""
        return cls(path, read_table(path))


@dataclass(frozen=True)
class Tightness:
    """Sweeps of the strap: the regression of all people by motion, and each person's operating point."""

    pooled: dict[str, dict[str, Any]]
    people: list[dict[str, Any]]

    @classmethod
    def read(cls, cohort: Path, people: list[Path]) -> Tightness:
        """Read the files of the stage ``tightness``. Raises InputError where one is broken."""
        points = [read_json(path, ("subject", "operating_point")) for path in people]
        return cls(read_json(cohort, ("status", "pooled"))["pooled"], points)


@dataclass(frozen=True)
class Identification:
    """Fits of single trials, their costs on the person's other trial, and which parameters they determine."""

    fits: list[dict[str, Any]]
    cross_trial: Table
    identifiability: Table

    @classmethod
    def read(cls, fits: list[Path], cross_trial: Path, identifiability: Path) -> Identification:
        """Read the fits and what was made of them. Raises InputError where a file is broken."""
        required = ("subject", "trial", "cost", "settings", "provenance")
        records = [read_json(path, required) for path in fits]
        return cls(records, Table.read(cross_trial), Table.read(identifiability))


@dataclass(frozen=True)
class Sharing:
    """Sharing between people: ICC and class of each parameter, priors, and what the priors cost someone left out.

    ``explained``: Table I and transfer with the plain model and with the causes, claims with the causes, and claims by
    the plain fits of the same people and trials; none where nobody was diagnosed.
    """

    icc: Table
    classes: Table
    priors: Table
    anthropometrics: Table
    loso: Table
    refined: list[dict[str, Any]]
    explained: list[Table]

    @classmethod
    def read(
        cls,
        icc: Path,
        classes: Path,
        priors: Path,
        anthropometrics: Path,
        loso: Path,
        refined: list[Path],
        explained: list[Path],
    ) -> Sharing:
        """Read the tables, and refinements of unseen people. Raises InputError where a file is broken."""
        records = [read_json(path, ("subject", "status", "free", "trials")) for path in refined]
        return cls(
            Table.read(icc),
            Table.read(classes),
            Table.read(priors),
            Table.read(anthropometrics),
            Table.read(loso),
            records,
            [Table.read(path) for path in explained],
        )


@dataclass(frozen=True)
class Walking:
    """Tables II and III, and the bars that trained walkers have to meet; None where none was trained."""

    interface: Table
    gait: Table
    bars: Table | None

    @classmethod
    def read(cls, interface: Path, gait: Path, bars: Path | None) -> Walking:
        """Read the tables. Raises InputError where one is broken."""
        return cls(Table.read(interface), Table.read(gait), Table.read(bars) if bars else None)


@dataclass(frozen=True)
class Study:
    """Contents of the page: ``people`` maps an id to its cohort, ``figures`` a name in `FIGURES` to its SVG."""

    people: dict[str, str]
    figures: dict[str, Path]
    quality: Table
    tightness: Tightness
    identification: Identification
    sharing: Sharing
    walking: Walking
    diagnoses: list[dict[str, Any]]
    validation: list[dict[str, Any]]
    claims: Table
    paper_gap: Path | None


def report_page(
    *,
    people: dict[str, str],
    figures: list[Path],
    quality: Path,
    tightness: Path,
    breakpoints: list[Path],
    cross_trial: Path,
    identifiability: Path,
    icc: Path,
    classes: Path,
    priors: Path,
    anthropometrics: Path,
    loso: Path,
    interface: Path,
    gait: Path,
    claims: Path,
    fits: list[Path],
    title: str,
    out: Path,
    bars: Path | None = None,
    refined: list[Path] | None = None,
    diagnoses: list[Path] | None = None,
    validation: list[Path] | None = None,
    explained: list[Path] | None = None,
    paper_gap: Path | None = None,
) -> None:
    """Write the report of a study: cohort, gates, tightness, identification, priors, validation, claims, provenance.

    Parameters
    ----------
    people
        Cohort (calibration or validation) of everyone, by id.
    figures
        SVG files, by the names in `FIGURES`.
    quality, tightness, breakpoints, cross_trial, identifiability, icc, classes, priors, anthropometrics, loso, claims
        Files of the stages that bear these names.
    interface, gait, bars
        Tables II and III of `paper.tables`, and the twins' bars where one was trained.
    fits, refined, diagnoses, validation, paper_gap
        All fit files, refinements of unseen people, diagnosis.json of those who have one; records of
        resources/validation and of resources/paper_gap.
    explained
        table1_priors.csv, transfer.csv and claims.csv of results/paper/with_effects, and claims.csv of the plain fits
        of the same people and trials, where the calibration people are diagnosed.
    """
    study = Study(
        people=people,
        figures={path.stem: path for path in figures},
        quality=Table.read(quality),
        tightness=Tightness.read(tightness, breakpoints),
        identification=Identification.read(fits, cross_trial, identifiability),
        sharing=Sharing.read(icc, classes, priors, anthropometrics, loso, refined or [], explained or []),
        walking=Walking.read(interface, gait, bars),
        diagnoses=[read_json(path, ("subject", "verdict")) for path in diagnoses or []],
        validation=[read_json(path, RECORD_KEYS) for path in validation or []],
        claims=Table.read(claims),
        paper_gap=paper_gap,
    )
    write_text(out, _page(study, title))


def _page(study: Study, title: str) -> str:
    parts = {name: make(study) for name, make in _SECTIONS.items()}
    shown = [part for part in parts.values() if part]
    contents = "".join(
        f'<li><a href="#{name}">{_heading(part)}</a></li>' for name, part in parts.items() if part
    )
    phantom = any(fit["phantom"] for fit in study.identification.fits)
    body = [
        *_notices(study),
        front(study.diagnoses, study.validation),
        _lead(study),
        f'<nav aria-label="Contents"><ul class="contents">{contents}</ul></nav>',
        *shown,
        _provenance(study),
    ]
    return document(title, body, phantom=phantom, script=_SCRIPT)


def _heading(part: str) -> str:
    """Heading of a section, in HTML."""
    return part.split("</h2>")[0].rsplit(">", 1)[1]


# -------------------- parts of a page


def _file(*tables: Table) -> str:
    """The tables behind a section, to take away."""
    links = [download(table.path.name, table.path.read_bytes(), "text/csv") for table in tables]
    return f'<p class="small tools">All numbers: {", ".join(links)}</p>'


def _figure(study: Study, name: str) -> str:
    """A figure with a button that enlarges it and a link that takes it away."""
    path = study.figures.get(name)
    if path is None:
        return ""
    title, text = FIGURES[name]
    content = path.read_text(encoding="utf-8")
    shown = inline(content, name, f"{title}. {text}", text)
    quoted = escape(title, quote=True)
    tools = (
        f'<p class="small tools"><button type="button" class="enlarge" data-title="{quoted}" hidden '
        f'aria-label="Enlarge: {quoted}">Enlarge</button> '
        f"{download(path.name, path.read_bytes(), 'image/svg+xml')}</p>"
    )
    return shown.replace("</figure>", f"{tools}</figure>")


def _value(text: str, digits: int = 3) -> str:
    return rounded(number(text), digits) if text else _DASH


def _percent_of(text: str) -> str:
    return percent(number(text) / 100, 1) if text else _DASH


def _interval(low: str, high: str) -> str:
    return f"[{_value(low)}, {_value(high)}]" if low or high else ""


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "none"


def _of(rows: Sequence[Row], **wanted: str) -> list[Row]:
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def _by_subject(rows: Sequence[Row]) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(row["subject"], []).append(row)
    return out


def _one_by_one(study: Study, markup: str) -> str:
    """A table with a row per person, folded away where there are many."""
    people = len(study.people)
    return folded(f"{people} people, one by one", markup) if people > MANY_PEOPLE else markup


def _person(rows: Sequence[Row], name: str) -> Row | None:
    return next((row for row in rows if row["subject"] == name), None)


# -------------------- the top


def _notices(study: Study) -> list[str]:
    """Return the notices that a reader needs before any number."""
    notices = []
    for name, rows in (
        ("Shareability", study.sharing.icc.rows),
        ("Leave one subject out", study.sharing.loso.rows),
        ("Cross-trial", study.identification.cross_trial.rows),
    ):
        wanting = {row["status"] for row in rows if row.get("status", "").startswith(("needs", "only"))}
        notices += [f"{name}: {status}." for status in sorted(wanting)]
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
    if refused:
        listed = ", ".join(sorted(refused))
        notices.append(
            f"Fitted although a gate refuses it (quality.override): {listed}. All results rest on it."
        )
    return [f'<p class="notice">{escape(text)}</p>' for text in notices]


def _trials(study: Study) -> dict[tuple[str, str], str]:
    """Gravest verdict of the gates on each trial."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in study.quality.rows:
        found.setdefault((row["subject"], row["trial"]), []).append(row["verdict"])
    return {key: worst(verdicts) for key, verdicts in found.items()}


def _verdicts_of_people(study: Study) -> dict[str, Counter[str]]:
    """Count the trials of each person that pass, are warned about, are refused."""
    counts: dict[str, Counter[str]] = {name: Counter() for name in study.people}
    for (person, _), gravest in _trials(study).items():
        if person in counts:
            counts[person][gravest] += 1
    return counts


def _over_floor(study: Study, name: str) -> float | None:
    row = _person(study.identification.cross_trial.rows, name)
    if row is None or not row["J_within_mean_1"] or not row["J_floor_1"]:
        return None
    return number(row["J_within_mean_1"]) / number(row["J_floor_1"])


def _lead(study: Study) -> str:
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


# -------------------- sections


def _cohort(study: Study) -> str:
    gates, values = _verdicts_of_people(study), _by_subject(study.identification.identifiability.rows)
    points = {b["subject"]: b["operating_point"] for b in study.tightness.people}
    diagnosed = {d["subject"]: d for d in study.diagnoses}
    rows = []
    for name, kind in study.people.items():
        own = gates[name]
        cross, loso = (
            _person(study.identification.cross_trial.rows, name),
            _person(study.sharing.loso.rows, name),
        )
        verdicts = Counter(row["verdict"] for row in values.get(name, []))
        grave = worst(own)
        row = [
            escape(name),
            escape(kind),
            str(own.total()),
            verdict(grave, f"{own[grave]} {grave}" if grave != PASS else "pass"),
            rounded(points.get(name, {}).get("selected_cm"), 3),
            _value(cross["J_within_mean_1"]) if cross else _DASH,
            _value(cross["J_floor_1"]) if cross else _DASH,
            f"{verdicts['determined']} of {verdicts.total()}" if verdicts else _DASH,
            _percent_of(loso["overhead_J_percent"]) if loso else _DASH,
        ]
        if study.diagnoses:
            d = diagnosed.get(name)
            row.append(escape(_words(d["verdict"])) if d else _DASH)
        rows.append(row)
    head = [
        "Person",
        "Cohort",
        "Trials",
        "Gates",
        "T* [cm]",
        "J",
        "J of noise",
        "Determined",
        "LOSO overhead",
    ]
    caption = (
        "Everyone of the study. J: mean over the dynamic trials of the best fit's cost; J of noise: what "
        "measurement noise "
        "alone costs; determined: values that their trial determines; LOSO overhead: what the prior of the "
        "others costs, in J."
    )
    head += ["Diagnosis"] if study.diagnoses else []
    markup = table(head, rows, caption=caption, numeric=(2, 4, 5, 6, 8))
    return section("cohort", "The cohort", _one_by_one(study, markup))


def _words(name: str) -> str:
    return name.replace("_", " ")


def _gates(study: Study) -> str:
    counts = _verdicts_of_people(study)
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
    summary = _one_by_one(study, markup)
    found = [row for row in study.quality.rows if row["verdict"] != PASS]
    listed = [
        [
            escape(f"{row['subject']} {row['trial']}"),
            verdict(row["verdict"], row["verdict"] + (", overridden" if row["overridden"] == "true" else "")),
            escape(_words(row["gate"])),
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
            _file(study.quality),
        )
    detail = table(
        ["Trial", "Verdict", "Gate", "What was found", "What helps"],
        listed,
        caption="Every warning and refusal. A refused trial stops its fit unless it is overridden by name",
    )
    body = folded(f"{len(listed)} warnings and refusals", detail, unfolded=len(listed) <= 12)
    return section("quality", "Quality of the recordings", summary, body, _file(study.quality))


def _tightness(study: Study) -> str:
    pooled = study.tightness.pooled
    rows = [
        [
            {"dphi": "Pelvic rotation", "dx": "Forward and back", "dy": "Left and right"}.get(
                name, escape(name)
            ),
            escape(about["status"]),
            verdict("determined", "yes") if about.get("exists") else "no",
            rounded(about.get("breakpoint")) if about.get("exists") else _DASH,
            rounded(about.get("p_value")),
            str(about.get("n_subjects", _DASH)),
        ]
        for name, about in pooled.items()
    ]
    regressions = table(
        ["Motion", "Status", "Breakpoint", "At normalised tightness", "p", "People"],
        rows,
        caption="Is there a level beyond which a tighter strap takes motion away? Two-segment regression of "
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
    return section(
        "tightness",
        "Tightness and operating point",
        f'<div class="grid">{_figure(study, "tightness")}<div>{regressions}{_one_by_one(study, chosen)}</div></div>',
    )


def _centimetres(value: float | None) -> str:
    return _DASH if value is None else signed(value, 2)


def _identification(study: Study) -> str:
    rows = [
        [
            escape(row["subject"]),
            _value(row["J_within_mean_1"], 4),
            _value(row["J_floor_1"], 4),
            _interval(row["J_floor_low_1"], row["J_floor_high_1"]),
            _value(row["J_cross_mean_1"], 4),
            _percent_of(row["overhead_percent"]),
        ]
        for row in study.identification.cross_trial.rows
    ]
    costs = table(
        ["Person", "J", "J of noise", "95 % interval", "J on the other trial", "Overhead"],
        rows,
        caption="Cost J (no unit): mean of the best fits on their own trial, what measurement noise alone "
        "costs, and the same "
        "parameters on the person's other trial. Paper: section V-B.1, and its figures in the last row.",
        numeric=(1, 2, 3, 4, 5),
    )
    people = _by_subject(study.identification.identifiability.rows)
    own = "\n".join(
        folded(f"{name}: {_counted(mine)}", _parameters(name, mine), unfolded=i == 0)
        for i, (name, mine) in enumerate(people.items())
    )
    if len(people) > MANY_PEOPLE:
        own = paragraph(f"The verdicts on {len(people)} people one by one stand in the table below.")
    return section(
        "identification",
        "Identification",
        f'<div class="grid">{_figure(study, "convergence")}<div>{_one_by_one(study, costs)}'
        f"{_file(study.identification.cross_trial)}</div></div>",
        "<h3>What each trial determines</h3>",
        paragraph(
            "A value that is not called determined is not a result. The interval of 95 % takes the "
            "residuals' autocorrelation "
            "and the noise of the pelvis markers into account."
        ),
        _per_parameter(study),
        own,
        _file(study.identification.identifiability),
    )


def _counted(rows: Sequence[Row]) -> str:
    counts = Counter(row["verdict"] for row in rows)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict])


def _per_parameter(study: Study) -> str:
    rows = []
    for name in PARAMETERS:
        counts = Counter(
            row["verdict"] for row in _of(study.identification.identifiability.rows, parameter=name)
        )
        if counts:
            share = counts["determined"] / counts.total()
            rows.append(
                [escape(name), *(str(counts[verdict]) for verdict in VERDICTS), bar(share) + percent(share)]
            )
    return table(
        ["Parameter", *(verdict.capitalize() for verdict in VERDICTS), "Determined"],
        rows,
        caption="Verdicts over all people and dynamic trials. Rotation about y is informed only through the "
        "arm's pitch.",
        numeric=(1, 2, 3, 4),
    )


def _parameters(name: str, mine: Sequence[Row]) -> str:
    trials = list(dict.fromkeys(row["trial"] for row in mine))
    rows = []
    for parameter in PARAMETERS:
        cells = [escape(parameter), escape(unit(parameter))]
        for trial in trials:
            found = _of(mine, parameter=parameter, trial=trial)
            cells += _judged(found[0]) if found else [_DASH, _DASH]
        rows.append(cells)
    head = ["Parameter", "Unit"]
    for trial in trials:
        head += [_words(trial), "Verdict"]
    reasons = [
        [
            escape(f"{row['parameter']}, {_words(row['trial'])}"),
            escape(row["reason"]),
            escape(row["next_trial"]),
        ]
        for row in mine
        if row["verdict"] != "determined"
    ]
    why = (
        table(["Value", "Reason", "Trial that would help"], reasons, caption=f"What {name} lacks")
        if reasons
        else ""
    )
    numeric = tuple(range(2, len(head), 2))
    return table(head, rows, caption=f"Parameters of {name} with 95 % intervals", numeric=numeric) + why


def _judged(row: Row) -> list[str]:
    between = _interval(row["ci95_low"], row["ci95_high"])
    return [f"{_value(row['value'])} <span class='small'>{between}</span>", verdict(row["verdict"])]


def _priors(study: Study) -> str:
    shared = study.sharing
    return section(
        "priors",
        "What people share, and priors",
        f'<div class="grid">{_figure(study, "icc")}{_figure(study, "loso")}</div>',
        _classes(study),
        _figure(study, "coverage"),
        _priors_table(study),
        _with_effects(study),
        _one_by_one(study, _loso_table(study)),
        _refinements(study),
        _regression(study),
        _file(shared.icc, shared.classes, shared.priors, shared.loso, shared.anthropometrics),
    )


def _with_effects(study: Study) -> str:
    """Table I and the transfer costs twice, where the calibration people are diagnosed."""
    if not study.sharing.explained:
        return ""
    priors, transfer = study.sharing.explained[:2]
    first = priors.rows[0]
    who = (
        f"{first['n_with_a_cause']} of {first['n_subjects']} calibration people have a diagnosed cause. Both models "
        f"are fitted to the first two dynamic trials of the same people: the plain one by {first['search_plain']}, the "
        f"one with causes by {first['search_with_effects']}"
    )
    models = ("plain", "with_effects")
    missing = [row[f"status_{m}"] for row in priors.rows for m in models if is_published(row[f"source_{m}"])]
    dashes = f". {missing_priors(missing)}" if missing else ""

    def numbers(row: Row, model: str) -> list[str]:
        if is_published(row[f"source_{model}"]):
            return [_DASH, _DASH, _value(row[f"icc_{model}"]), _DASH]
        spread = _interval(row[f"interval_low_{model}"], row[f"interval_high_{model}"])
        return [
            _value(row[f"prior_{model}"], 4),
            spread,
            _value(row[f"icc_{model}"]),
            escape(row[f"class_{model}"]),
        ]

    of_model = ["95 % spread", "ICC", "Class"]
    tables = [
        table(
            ["Quantity", "Plain model", "With causes", "Published", "Unit"],
            [
                [escape(row["says"]), *(_value(row[m]) for m in (*models, "published")), escape(row["unit"])]
                for row in transfer.rows
            ],
            caption="What the parameters of the strap cost on the person's other trial and with the prior of the other "
            f"people: cost J, means over {transfer.rows[0]['n_subjects']} people. {who}. An overhead is small where "
            "the gap makes up most of J, whatever the parameters are: the extra J says what they cost",
            numeric=(1, 2, 3),
        ),
        table(
            ["Parameter", "Plain model", *of_model, "With causes", *of_model, "Unit", "Published", "Class"],
            [
                [
                    escape(row["parameter"]),
                    *numbers(row, "plain"),
                    *numbers(row, "with_effects"),
                    escape(row["unit"]),
                    _value(row["published_prior"], 4),
                    escape(row["published_class"]),
                ]
                for row in priors.rows
            ],
            caption="Table I with the plain model and with the diagnosed causes in it: prior, central 95 % of the "
            f"fits, their ICC and the class by it. {who}{dashes}",
            numeric=(1, 3, 5, 7, 10),
        ),
        _file(priors, transfer),
    ]
    return folded("The same with the diagnosed causes in the model", "\n".join(tables))


def _priors_table(study: Study) -> str:
    share = {row["parameter"]: row for row in study.sharing.icc.rows}
    rows = [
        [
            escape(row["parameter"]),
            _value(row["prior"], 4),
            _interval(row["interval_low"], row["interval_high"]),
            _interval(row["prediction_low"], row["prediction_high"]),
            escape(row["unit"]),
            escape(row["class"]),
            _value(share.get(row["parameter"], {}).get("icc", "")),
            escape(row["use"]),
            _value(row["published_prior"], 4),
            escape(row["published_class"]),
        ]
        for row in study.sharing.priors.rows
    ]
    return table(
        [
            "Parameter",
            "Prior",
            "95 % spread",
            "Next person (95 %)",
            "Unit",
            "Class",
            "ICC",
            "Use",
            "Published",
            "Published class",
        ],
        rows,
        caption="Geometric mean and empirical spread of the fits, beside the paper's Table I. Where there "
        "are too few people "
        "the published prior stands in.",
        numeric=(1, 2, 3, 6, 8),
    )


def _loso_table(study: Study) -> str:
    rows = [
        [
            escape(row["subject"]),
            _value(row["J_best"], 4),
            _value(row["J_prior"], 4),
            _percent_of(row["overhead_J_percent"]),
            _percent_of(row["overhead_rmse_percent"]),
            escape(row["status"]),
        ]
        for row in study.sharing.loso.rows
    ]
    return table(
        ["Person", "J, own fit", "J, prior of the others", "Overhead J", "Overhead RMSE", "Status"],
        rows,
        caption="Leave one subject out: what the prior of the others costs the one left out. Paper: eq. 7.",
        numeric=(1, 2, 3, 4),
    )


def _classes(study: Study) -> str:
    """Return the part about the classes that can be trusted."""
    rows = [
        [
            escape(row["parameter"]),
            *(escape(row[f"class{by}"]) or _DASH for by in ("", "_by_exact_interval", "_by_nested_interval")),
            _percent_of(str(100 * number(row["share_determined"])) if row["share_determined"] else ""),
            f"<strong>{escape(row['verdict'])}</strong>",
            escape(row["reason"]),
        ]
        for row in study.sharing.classes.rows
    ]
    return table(
        ["Parameter", "Class (paper)", "By exact interval", "By trials", "Determined", "Verdict", "Why"],
        rows,
        caption="Class by the paper's bootstrap over fits, by the exact interval over fits, and by the exact interval "
        "over trials, which alone counts independent repeats; in how many trials the value was determined; what can be "
        "told",
        numeric=(4,),
    )


def _refinements(study: Study) -> str:
    """Return the part about priors for someone unseen: as they are, refined, and beside a full calibration."""
    rows = []
    for record in study.sharing.refined:
        for trial, found in record["trials"].items():
            full, against = found["full"], found["against_full"]
            rows.append(
                [
                    escape(f"{record['subject']}, {_words(trial)}"),
                    rounded(found["prior"]["J"], 4),
                    rounded(found["refined"]["J"], 4),
                    rounded(full["J"], 4) if full else _DASH,
                    percent(against["J_ratio"] - 1, 1) if against else _DASH,
                    str(found["refined"]["evaluations"]),
                    percent(against["evaluations_over_best_restart"], 0) if against else _DASH,
                ]
            )
    waiting = [f"{r['subject']}: {r['status']}." for r in study.sharing.refined if not r["trials"]]
    markup = "".join(paragraph(text) for text in waiting)
    if not rows:
        return markup
    free = study.sharing.refined[0]["free"]
    return markup + table(
        [
            "Person, trial",
            "J, prior",
            "J, refined",
            "J, full calibration",
            "Refined above full",
            "Evaluations",
            "Of one restart's",
        ],
        rows,
        caption=f"Unseen people: only {_listed(free)} are refined, the rest stays at the prior. Each person has a page "
        "of their own in results/people",
        numeric=(1, 2, 3, 4, 5, 6),
    )


def _regression(study: Study) -> str:
    """Does the body predict a parameter, or how many people it takes to ask."""
    body = _listed(
        [
            _words(name)
            for name in dict.fromkeys(row["predictor"] for row in study.sharing.anthropometrics.rows)
        ]
    )
    states = Counter(row["status"] for row in study.sharing.anthropometrics.rows)
    told = "; ".join(status for status in states if status != "ok")
    known = [row for row in study.sharing.anthropometrics.rows if row["status"] == "ok"]
    if not known:
        return paragraph(f"Regression on {body}: {told or 'none asked for'}.")
    rows = [
        [
            escape(row["parameter"]),
            escape(row["predictor"]),
            _value(row["exponent"]),
            _interval(row["exponent_low"], row["exponent_high"]),
            _value(row["p_holm"]),
        ]
        for row in known
    ]
    return table(
        ["Parameter", "Predictor", "Exponent", "95 % interval", "p (Holm)"],
        rows,
        caption=f"By which power of {body} a parameter grows",
        numeric=(2, 4),
    )


def _diagnoses(study: Study) -> str:
    if not study.diagnoses:
        return ""
    one_by_one = "\n".join(
        folded(f"{d['subject']}: {answer_words(d)}", digest(d)) for d in study.diagnoses[:MANY_PEOPLE]
    )
    if len(study.diagnoses) > MANY_PEOPLE:
        one_by_one = paragraph(f"The first {MANY_PEOPLE} of them:") + one_by_one
    return section(
        "diagnosis",
        "Why simulation and measurement differ",
        paragraph(_answers(study)),
        _figure(study, "gap"),
        _one_by_one(study, _answers_table(study)),
        withheld_check(study.validation),
        one_by_one,
    )


def _answers(study: Study) -> str:
    """The answers of everyone in one sentence."""
    counts = Counter(answer_words(d) for d in study.diagnoses).most_common()
    listed = _listed([f"{name} ({n})" for name, n in counts])
    closed = [share for d in study.diagnoses if (share := chi2_closed(d)) is not None]
    one = len(study.diagnoses) == 1
    if one:
        text = f"The answer for the one person who was diagnosed: {answer_words(study.diagnoses[0])}."
    else:
        text = f"The answers for {len(study.diagnoses)} people, and how many have each: {listed}."
    if closed:
        text += (
            f" What was found, a cause or a measured law, closes {percent(statistics.median(closed))} of what stands "
            f"above noise{'' if one else ' (median)'}."
        )
    if any(d["verdict"] == "none" for d in study.diagnoses):
        text += (
            " None says that the plain model leaves what noise leaves; the page of each person lists from which size "
            "on an effect would have been seen."
        )
    return text


def _answers_table(study: Study) -> str:
    rows = []
    for d in study.diagnoses:
        gap, where, both = d["gap"], d["where"], chi2_per_residual(d)
        rows.append(
            [
                escape(d["subject"]),
                escape(answer_words(d)),
                likely(answer_probability(d)),
                escape(str(where["stage"]) if shows_gap(d) else _DASH),
                rounded(gap["J_base"]),
                rounded(gap["J_floor"]),
                rounded(gap["J_with_effect"]),
                _DASH if both is None else " to ".join(map(rounded, both)),
                percent(chi2_closed(d)),
                escape(d["next_trial"] or _DASH),
            ]
        )
    head = [
        "Person",
        "Answer",
        "Probability",
        "Stage",
        "J plain",
        "J of noise",
        "J with it",
        "Misfit",
        "Closed",
        "Next trial",
    ]
    caption = (
        "The answer for everyone. J: cost of the held-out trial, or of the fitted one where that alone shows the gap, "
        "with the plain model, of measurement noise alone, and with the answer in the model. Misfit: chi-squared per "
        "residual of that trial without and with the answer; noise leaves 1, and chi-squared sees gaps that J does "
        "not. Closed: share of it above noise. Next trial: what would separate the likeliest causes."
    )
    return table(head, rows, caption=caption, numeric=(2, 4, 5, 6, 8))


def _validation(study: Study) -> str:
    """Tables II and III, and whether the twins are worth comparing."""
    walking = study.walking
    return section(
        "validation",
        "Validation on an unseen person",
        f'<div class="grid">{_figure(study, "interface")}{_figure(study, "gait")}</div>',
        f'<div class="grid">{_figure(study, "speed")}{_figure(study, "wrench")}</div>',
        _bars(study),
        _interface_table(study),
        _gait_table(study),
        _file(
            walking.interface, walking.gait, *([walking.bars] if walking.bars and walking.bars.rows else [])
        ),
    )


def _with_sd(row: Row, key: str) -> str:
    spread = row[f"{key}_seed_sd"]
    return _value(row[key]) + (f" <span class='small'>± {_value(spread, 2)}</span>" if spread else "")


def _counts_of(row: Row) -> list[str]:
    """Cells of the seeds with a value and of the walkers that stayed up; a dash where nothing was simulated."""
    return [row["seeds"] or _DASH, f"{row['survived']} of {row['walkers']}" if row["walkers"] else _DASH]


def _interface_table(study: Study) -> str:
    rows = [
        [
            escape(_words(row["condition"])),
            *_counts_of(row),
            *(_with_sd(row, f"sigma_{axis}_mm") for axis in "xyz"),
            _with_sd(row, "gamma"),
            *(_value(row[f"published_sigma_{axis}_mm"]) for axis in "xyz"),
            _value(row["published_gamma"]),
        ]
        for row in study.walking.interface.rows
    ]
    spreads = [f"\N{GREEK SMALL LETTER SIGMA} {axis} [mm]" for axis in "xyz"]
    gamma = "\N{GREEK SMALL LETTER GAMMA}"
    head = [
        "Condition",
        "Seeds",
        "Survived",
        *spreads,
        gamma,
        *(f"Published {name}" for name in (*spreads, gamma)),
    ]
    return table(
        head,
        rows,
        caption="Spread of the interface midpoint about the pelvis while walking with the robot, mean and SD over "
        f"seeds. {ABOUT_COUNTS} Paper: Table II.",
        numeric=range(1, len(head)),
    )


def _gait_table(study: Study) -> str:
    rows = [
        [
            escape(f"{_words(row['joint'])}, {_words(row['condition'])}"),
            *_counts_of(row),
            _with_sd(row, "rom_deg"),
            _with_sd(row, "rom_change_deg"),
            _with_sd(row, "peak_deg"),
            _value(row["r_walk_robot"]),
            _value(row["published_rom_deg"]),
            _value(row["published_peak_deg"]),
        ]
        for row in study.walking.gait.rows
    ]
    return table(
        [
            "Joint, condition",
            "Seeds",
            "Survived",
            "Range [deg]",
            "Change [deg]",
            "Peak [deg]",
            "r",
            "Published range [deg]",
            "Published peak [deg]",
        ],
        rows,
        caption="Range of motion, its change by the robot, peak angle, and correlation with the person's own walk with "
        f"the robot; mean and SD over seeds. {ABOUT_COUNTS} Paper: Table III.",
        numeric=range(1, 9),
    )


def _bars(study: Study) -> str:
    """Is the simulated walker one to believe: its bars, missed ones by name."""
    bars = study.walking.bars.rows if study.walking.bars else []
    if not bars:
        return paragraph("No twin was trained for this study: the tables hold what the paper prints.")
    missed = _of(bars, met="false")
    count = f"{len(bars) - len(missed)} of {len(bars)} bars of the simulated walkers are met."
    if not missed:
        return paragraph(count)
    rows = [
        [
            escape(f"{row['subject']}, seed {row['seed']}"),
            escape(_words(row["bar"])),
            _value(row["value"]),
            _value(row["limit"]),
        ]
        for row in missed
    ]
    return paragraph(f"{count} What a walker that misses a bar does with the robot is worth less.") + table(
        ["Walker", "Bar missed", "Value", "Limit"], rows, caption="Bars missed", numeric=(2, 3)
    )


_JUDGED = {
    "reproduced": "met",
    "holds": "met",
    "not reproduced": "missed",
    "inconsistent": "missed",
    "does not": "missed",
}


def _claims(study: Study) -> str:
    counts = Counter(row["verdict"] for row in study.claims.rows)
    others = _claims_of_the_diagnosed(study)
    head = ["The paper says", "Published", "Here", *others, "Unit", "Verdict", "Reason"]
    rows = []
    for row in study.claims.rows:
        kind = next((k for start, k in _JUDGED.items() if row["verdict"].startswith(start)), "warned")
        rows.append(
            [
                f"{escape(row['says'])} <span class='small'>{escape(row['place'])}</span>",
                _value(row["published"], 4),
                _value(row["here"]),
                *(cells[row["claim"]] for cells in others.values()),
                escape(row["unit"]) if row["unit"] != "1" else "",
                f'<span class="{kind} wrapped">{escape(row["verdict"])}</span>',
                escape(row["reason"]),
            ]
        )
    summary = "; ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
    caption = "Every quantitative claim of the paper. Its own criterion stands in the file"
    plain = "Here"
    if _SAME_TRIALS in others:
        plain = _SAME_TRIALS
        caption += (
            f". {_SAME_TRIALS}: the value, where it differs from Here, by the plain fits of the diagnosed people's "
            "first two dynamic trials, which the fits with causes rest on"
        )
    if others:
        caption += (
            f". With causes: the value, where it differs from {plain}, once the diagnosed causes are in the model, "
            f"fitted by {study.sharing.explained[0].rows[0]['search_with_effects']}"
        )
    return section(
        "claims",
        "What the paper claims, and what is found here",
        paragraph(f"{len(study.claims.rows)} claims: {summary}."),
        table(head, rows, caption=caption, numeric=(1, 2, *range(3, 3 + len(others)))),
        _file(study.claims),
    )


_SAME_TRIALS = "Same trials"


def _claims_of_the_diagnosed(study: Study) -> dict[str, dict[str, str]]:
    """Return further columns of the claims as cells by claim; none where nobody was diagnosed.

    ``Same trials`` is there where the study holds calibration people or trials that the fits with causes do not.
    """
    if not study.sharing.explained:
        return {}
    causes, same = ({row["claim"]: row for row in found.rows} for found in study.sharing.explained[2:])
    out = {
        _SAME_TRIALS: {row["claim"]: _other_value(row, same[row["claim"]]) for row in study.claims.rows},
        "With causes": {name: _other_value(row, causes[name]) for name, row in same.items()},
    }
    if not any(out[_SAME_TRIALS].values()):
        del out[_SAME_TRIALS]
    return out


def _other_value(row: Row, other: Row) -> str:
    """Return the value of a claim by another analysis, and its verdict where that is another one; or nothing."""
    if other["here"] == row["here"]:
        return ""
    verdict = other["verdict"]
    judged = f" <span class='small'>{escape(verdict)}</span>" if verdict != row["verdict"] else ""
    return f"{_value(other['here'])}{judged}"


def _paper_gap(study: Study) -> str:
    """The causes whose cohorts come nearest to the paper's numbers."""
    if study.paper_gap is None:
        return ""
    return section(
        "paper-gap",
        "Which gap would have made the paper's numbers?",
        told(read_json(study.paper_gap, PAPER_GAP_KEYS), _figure(study, "paper_gap")),
        '<p class="small tools">All numbers: '
        f"{download(study.paper_gap.name, study.paper_gap.read_bytes(), 'application/json')}</p>",
    )


_SECTIONS: Mapping[str, Callable[[Study], str]] = {
    "diagnosis": _diagnoses,
    "cohort": _cohort,
    "quality": _gates,
    "tightness": _tightness,
    "identification": _identification,
    "priors": _priors,
    "validation": _validation,
    "claims": _claims,
    "paper-gap": _paper_gap,
}


# -------------------- the foot


def _distinct(values: Sequence[str]) -> str:
    return " or ".join(dict.fromkeys(values))


def _provenance(study: Study) -> str:
    records = [fit["provenance"] for fit in study.identification.fits]
    packages = [", ".join(f"{name} {v}" for name, v in p["packages"].items()) for p in records]
    facts = [
        f"{len(study.identification.fits)} fits by code {_distinct([p['code_fingerprint'] for p in records])}; Python "
        f"{_distinct([p['python'] for p in records])}; {_distinct(packages)}.",
        f"Search: {_distinct([_search(fit) for fit in study.identification.fits])}.",
    ]
    inputs = {path: digest_ for p in records for path, digest_ in p["inputs_sha256"].items()}
    rows = [
        [f"<code>{escape(path)}</code>", f"<code>{digest_[:16]}</code>"]
        for path, digest_ in sorted(inputs.items())
        if len(inputs) <= MANY_FILES
    ]
    files = table(["File", "SHA-256 (first 16)"], rows, caption="Files that the fits rest on") if rows else ""
    return (
        '<footer>\n<h2 id="provenance">Provenance</h2>\n'
        + "\n".join(paragraph(text) for text in facts if study.identification.fits)
        + (folded(f"{len(rows)} input files", files) if files else "")
        + (
            paragraph(f"{len(inputs)} input files; each fit file names its own.")
            if len(inputs) > MANY_FILES
            else ""
        )
        + "\n</footer>"
    )


def _search(fit: Mapping[str, Any]) -> str:
    ident = fit["settings"]["identification"]
    return (
        f"{fit['method']}, {ident['restarts']} restarts of {ident['evaluations']} evaluations, seed "
        f"{ident['seed']}, time step "
        f"{_distinct([str(fit['settings']['plant']['timestep_s'])])} s"
    )
