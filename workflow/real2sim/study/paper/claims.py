"""Each quantitative claim of the paper, what is found here, and what that says of the claim.

What the paper says stands in resources/published/claims.csv, its tables in the files beside it. A claim is judged by
the function of its name: from the results, or from the paper's own numbers where those contradict each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from real2sim.artefacts import is_phantom, needs_people, number, read_json, read_table, write_table
from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.inference.parameters import PARAMETERS, parameter_column
from real2sim.recording.subjects import subject_values
from real2sim.study.paper.latex import latex_table, macros
from real2sim.study.twin.adaptation import JOINT_NAMES

Row = dict[str, str]

PRIVATE = "not reproducible from public data"
INCONSISTENT = "inconsistent within the paper"
CONSISTENT = "holds within the paper"
NOT_COMPUTED = "not computed here"
# a number that the phantom or the model here was made with
SET = "set, not tested"
# of a method, tried on simulated data that are neither measured nor the phantom's
SIMULATED, REFUTED = "holds in simulation", "does not hold in simulation"
COLUMNS = (
    "claim",
    "place",
    "says",
    "published",
    "here",
    "unit",
    "verdict",
    "reason",
    "criterion",
    "overridden",
    "phantom",
)


@dataclass(frozen=True)
class Finding:
    """Result for a claim: a number (None where there is none), a verdict and its reason."""

    here: float | None
    verdict: str
    reason: str


@dataclass
class Walks:
    """The walking twin: tables of gait and interface, degrees of freedom."""

    gait: list[Row] = field(default_factory=list)
    interface: list[Row] = field(default_factory=list)
    dof: int | None = None

    @property
    def seeds(self) -> list[str]:
        """Seeds of the twins that walked, also those whose walkers all fell."""
        return list(dict.fromkeys(row["seed"] for row in (*self.interface, *self.gait)))

    def fallen(self, standing: Iterable[str], which: str = "") -> str:
        """Return a sentence on the seeds other than ``standing``, whose walkers left no value; empty without any.

        ``which`` says of which walks, where there are more than one.
        """
        lost = sorted(set(self.seeds) - set(standing))
        if not lost:
            return ""
        named = f"seed{'s' * (len(lost) > 1)} {', '.join(lost)}"
        return (
            f"In {len(lost)} of {len(self.seeds)} seeds ({named}) all walkers fell or took no whole stride{which}: "
            "there is no value."
        )


@dataclass
class Evidence:
    """The results and published tables that claims are judged by; empty where a stage did not run."""

    published: dict[str, list[Row]]
    claims: dict[str, Row]
    people: list[dict[str, Any]]
    sweeps: list[list[Row]]
    tightness: dict[str, Any]
    fits: list[Row]
    cross_trial: list[Row]
    icc: list[Row]
    loso: list[Row]
    coverage: list[Row] = field(default_factory=list)
    refined: list[dict[str, Any]] = field(default_factory=list)
    walks: Walks = field(default_factory=Walks)
    phantom: bool = False

    def said(self, claim: str) -> float:
        """Return the number that the paper prints."""
        return number(self.claims[claim]["published"])

    def judged(self, holds: bool, here: float | None, reason: str) -> Finding:
        """Return the finding: reproduced or not, on the phantom or on measured people."""
        where = " on the phantom" if self.phantom else ""
        return Finding(here, f"reproduced{where}" if holds else f"not reproduced{where}", reason)

    def absolute(self, claim: str, here: float, reason: str) -> Finding:
        """Return the finding on a number that depends on the study's own recordings: none on the phantom."""
        if self.phantom:
            return Finding(
                here, PRIVATE, f"{reason} The study's recordings are private; the phantom's noise is its own."
            )
        return self.judged(abs(here / self.said(claim) - 1) <= 0.05, here, reason)


# How much less than the own fit [%] parameters from elsewhere may cost before that fit counts as not found
SEARCH_TOLERANCE_PERCENT = 1.0

Judge = Callable[[Evidence], Finding]
_JUDGES: dict[str, Judge] = {}


def _judges(*names: str) -> Callable[[Judge], Judge]:
    def register(judge: Judge) -> Judge:
        for name in names:
            _JUDGES[name] = judge
        return judge

    return register


def _claim(make: Callable[..., Finding], *names: str) -> None:
    """Register one judge, which is told the claim, for several claims."""
    for name in names:
        _JUDGES[name] = partial(make, claim=name)


def _no(reason: str) -> Finding:
    return Finding(None, NOT_COMPUTED, reason)


def _not_converged(what: str, changes: Iterable[tuple[str, float]]) -> Finding | None:
    """Return that a claim cannot be judged, where ``what`` costs less than a fit of the trial itself; else None.

    ``changes`` are names and costs above the own fit [%]. Parameters from elsewhere cannot be better than the best ones
    of a trial: what does better shows that these were not found.
    """
    better = [f"{name} {_short(x)} %" for name, x in changes if x < -SEARCH_TOLERANCE_PERCENT]
    if not better:
        return None
    return _no(
        f"Searches have not converged: {what} cost less than the own fit ({', '.join(better)}). Give more evaluations "
        "or restarts (identification)."
    )


def _short(value: float, digits: int = 3) -> str:
    return f"{value:.{digits}g}"


def _sentences(*texts: str) -> str:
    """Return the texts that are not empty, joined by a space."""
    return " ".join(filter(None, texts))


def _half_digit(text: str) -> float:
    """Return half of the last printed digit of a number."""
    return 0.5 * 10.0 ** -len(text.partition(".")[2])


def _by(rows: Iterable[Row], key: str) -> dict[str, Row]:
    return {row[key]: row for row in rows}


# -------------------- the people and the tightness sweep


def _counted(e: Evidence, claim: str) -> Finding:
    cohort = claim.removeprefix("n_")
    here = sum(person["cohort"] == cohort for person in e.people)
    return _made_or_judged(e, here == e.said(claim), here)


def _made_or_judged(e: Evidence, holds: bool, here: float) -> Finding:
    """Return the finding on a number of the cohort: judged on people, set where the phantom was made with it."""
    return Finding(here, SET, "The phantom was made with this.") if e.phantom else e.judged(holds, here, "")


def _mean_of_people(e: Evidence, claim: str) -> Finding:
    key, factor = {
        "mass_mean": ("mass_kg", 1.0),
        "height_mean": ("height_m", 100.0),
        "waist_mean": ("waist_m", 100.0),
    }[claim]
    values = factor * np.array([float(person[key]) for person in e.people])
    mean = float(values.mean())
    if len(values) < 2:
        return e.judged(False, mean, "One person has no spread to compare with.")
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    return _made_or_judged(e, abs(mean - e.said(claim)) <= error, mean)


def _levels(e: Evidence, claim: str) -> Finding:
    counts = [len({row["level_cm"] for row in rows}) for rows in e.sweeps if rows]
    if not counts:
        return _no("Nobody has a tightness sweep.")
    fewest = claim == "levels_fewest"
    here = min(counts) if fewest else max(counts)
    holds = here >= e.said(claim) if fewest else here <= e.said(claim)
    return _made_or_judged(e, holds, here)


def _pooled_regression(e: Evidence, quantity: str) -> tuple[dict[str, Any], Finding | None]:
    """Return the regression over people, and why it says nothing of what people share; None where it does."""
    pooled = e.tightness["pooled"].get(quantity, {"status": "nobody has a tightness sweep"})
    status = pooled["status"]
    if status == "ok" and pooled["n_subjects"] < 2:
        # one person shares nothing with anybody
        status = needs_people(2, pooled["n_subjects"])
    return pooled, None if status == "ok" else _no(f"Pooled regression: {status}.")


def _knee(e: Evidence, claim: str) -> Finding:
    quantity = {"knee_rotation": "dphi", "knee_x": "dx", "knee_y": "dy"}[claim]
    pooled, nothing = _pooled_regression(e, quantity)
    if nothing:
        return nothing
    wanted = claim == "knee_rotation"
    count = e.tightness["persons"][quantity]
    reason = (
        f"p = {_short(pooled['p_value'])} on {pooled['n_points']} levels of {pooled['n_subjects']} people; of "
        f"{count['n_subjects']} with levels enough to be tested alone, {count['n_with_breakpoint']} have a breakpoint."
    )
    return e.judged(pooled["exists"] is wanted, pooled["p_value"], reason)


@_judges("knee_at_selected")
def _knee_at_selected(e: Evidence) -> Finding:
    pooled, nothing = _pooled_regression(e, "dphi")
    if nothing:
        return nothing
    if not pooled["exists"]:
        return _no("There is no pooled breakpoint to compare with.")
    low, high = pooled["breakpoint_interval"]
    points = e.tightness["operating_points"]
    compared = sum(point["agree"] is not None for point in points.values())
    reason = (
        f"Interval [{_short(low)}, {_short(high)}]; of {compared} people with a knee of their own, "
        f"{e.tightness['n_agree']} have it at most one level from the selected one."
    )
    # one level in units of normalised tightness (eq. 1 of section III-A), as most people have it
    half_range = {
        p["id"]: (p["tightness"]["tightest_cm"] - p["tightness"]["loosest_cm"]) / 2 for p in e.people
    }
    steps = [p["level_step_cm"] / half_range[name] for name, p in points.items() if "level_step_cm" in p]
    near = bool(steps) and abs(pooled["breakpoint"]) <= float(np.median(np.abs(steps)))
    return e.judged(low <= 0 <= high or near, pooled["breakpoint"], reason)


_claim(_counted, "n_calibration", "n_validation")
_claim(_mean_of_people, "mass_mean", "height_mean", "waist_mean")
_claim(_levels, "levels_fewest", "levels_most")
_claim(_knee, "knee_rotation", "knee_x", "knee_y")


# -------------------- identification


@_judges("plateau")
def _plateau(e: Evidence) -> Finding:
    costs: dict[tuple[str, str], list[float]] = {}
    for row in e.fits:
        costs.setdefault((row["subject"], row["trial"]), []).append(number(row["J"]))
    several = {key: values for key, values in costs.items() if len(values) > 1}
    if not several:
        return _no("No trial has more than one restart.")
    excess = {key: 100 * (max(values) / min(values) - 1) for key, values in several.items()}
    worst = max(excess, key=lambda key: excess[key])
    within = sum(value <= 5 for value in excess.values())
    reason = (
        f"Worst restart over best, largest of {len(excess)} trials ({worst[0]} {worst[1]}); {within} trials "
        "meet the criterion. The paper prints no number."
    )
    return e.judged(within == len(excess), excess[worst], reason)


def _by_person(rows: list[Row], key: str) -> list[tuple[str, float]]:
    """Return a number of each person of a table that has it."""
    done = [row for row in rows if row["status"] == "ok" and row["subject"] != "mean"]
    return [(row["subject"], number(row[key])) for row in done]


def _mean_row(rows: list[Row]) -> Row | None:
    return next((row for row in rows if row["subject"] == "mean" and row["status"] == "ok"), None)


def _cost(e: Evidence, claim: str) -> Finding:
    mean = _mean_row(e.cross_trial)
    if mean is None:
        return _no("Not everyone has two dynamic trials.")
    here = number(mean[f"{claim}_mean_1"])
    floor = number(mean["J_floor_1"])
    reason = "The paper gives no noise floor."
    if math.isfinite(floor):
        reason = f"{_short(here / floor)} times what noise alone costs here. {reason}"
    return e.absolute(claim, here, reason)


def _within_over_floor(e: Evidence) -> float:
    """Return the mean J of the within-trial fits over the mean J of noise alone; NaN where one is unknown."""
    mean = _mean_row(e.cross_trial)
    return number(mean["J_within_mean_1"]) / number(mean["J_floor_1"]) if mean else math.nan


@_judges("overhead_mean")
def _overhead(e: Evidence) -> Finding:
    mean = _mean_row(e.cross_trial)
    if mean is None:
        return _no("Not everyone has two dynamic trials.")
    here = number(mean["overhead_percent"])
    failed = _not_converged("parameters of the other trial", _by_person(e.cross_trial, "overhead_percent"))
    return failed or e.judged(here <= e.said("overhead_mean"), here, "A relative cost: it can be compared.")


@_judges("overhead_highest")
def _overhead_highest(e: Evidence) -> Finding:
    done = [r for r in e.cross_trial if r["status"] == "ok" and r["subject"] != "mean"]
    if not done:
        return _no("Nobody has two dynamic trials.")
    worst = max(done, key=lambda row: number(row["overhead_percent"]))
    here = number(worst["overhead_percent"])
    failed = _not_converged("parameters of the other trial", _by_person(e.cross_trial, "overhead_percent"))
    return failed or e.judged(here <= e.said("overhead_highest"), here, f"{worst['subject']}.")


@_judges("overhead_arithmetic")
def _overhead_arithmetic(e: Evidence) -> Finding:
    cross, within = (e.claims[name]["published"] for name in ("J_cross", "J_within"))
    a, b, half = float(cross), float(within), _half_digit(cross)
    low, high = 100 * ((a - half) / (b + half) - 1), 100 * ((a + half) / (b - half) - 1)
    said = e.said("overhead_arithmetic")
    holds = low <= said <= high
    reason = f"{cross} and {within} allow {_short(low)} to {_short(high)} %."
    return Finding(100 * (a / b - 1), CONSISTENT if holds else INCONSISTENT, reason)


_claim(_cost, "J_within", "J_cross")


# -------------------- what people share


def _known(e: Evidence) -> list[Row]:
    return [row for row in e.icc if row["class"]]


def _number_of_class(e: Evidence, claim: str) -> Finding:
    if not _known(e):
        return _no(f"ICC: {e.icc[0]['status'] if e.icc else 'no fits'}.")
    kind = claim.removeprefix("n_")
    named = [row["parameter"] for row in e.icc if row["class"] == kind]
    reason = f"{', '.join(named) or 'none'}."
    return e.judged(len(named) == e.said(claim), len(named), reason)


@_judges("same_classes")
def _same_classes(e: Evidence) -> Finding:
    if not _known(e):
        return _no(f"ICC: {e.icc[0]['status'] if e.icc else 'no fits'}.")
    theirs = _by(e.published["table1_priors"], "parameter")
    differ = [r["parameter"] for r in e.icc if r["class"] != theirs[r["parameter"]]["class"]]
    here = len(PARAMETERS) - len(differ)
    reason = f"Other class: {', '.join(differ)}." if differ else "All the same."
    return e.judged(here >= 11, here, reason)


@_judges("exact_common")
def _exact_common(e: Evidence) -> Finding:
    if not _known(e):
        return _no(f"ICC: {e.icc[0]['status'] if e.icc else 'no fits'}.")
    named = [row["parameter"] for row in e.icc if row["class_by_exact_interval"] == "common"]
    reason = _sentences(f"{', '.join(named) or 'None'}.", _exact_widths(e))
    return e.judged(len(named) == e.said("exact_common"), len(named), reason)


def _exact_widths(e: Evidence) -> str:
    """Return a sentence on the narrowest and the widest exact interval of an ICC; empty where there is none."""
    ends = {row["parameter"]: (number(row["exact_low"]), number(row["exact_high"])) for row in _known(e)}
    widths = {name: high - low for name, (low, high) in ends.items() if math.isfinite(high - low)}
    if not widths:
        return ""
    narrow, wide = (
        f"{_short(widths[name])} ({name}, from {_short(ends[name][0])} to {_short(ends[name][1])})"
        for name in (min(widths, key=lambda n: widths[n]), max(widths, key=lambda n: widths[n]))
    )
    return f"The exact intervals of the ICC of {e.icc[0]['n_subjects']} people have widths between {narrow} and {wide}."


@_judges("bootstrap_coverage")
def _bootstrap_coverage(e: Evidence) -> Finding:
    people = e.said("n_calibration")
    rows = [
        row
        for row in e.coverage
        if (row["method"], row["design"]) == ("bootstrap", "restarts of trials")
        and number(row["n_people"]) == people
    ]
    if not rows:
        return _no("The coverage study did not run.")
    coverage = {number(row["icc"]): 100 * number(row["coverage"]) for row in rows}
    low, high = min(coverage.values()), max(coverage.values())
    reason = (
        f"Between {_short(low)} and {_short(high)} % over true ICCs from {_short(min(coverage))} to "
        f"{_short(max(coverage))}, simulated normal data of {_short(people)} people with restarts of trials."
    )
    return Finding(low, SIMULATED if low >= 93 and high <= 97 else REFUTED, reason)


_claim(_number_of_class, "n_common", "n_uncertain")


# -------------------- Table I against itself


def _half_widths(e: Evidence) -> dict[str, float]:
    """Return half of the printed interval's width in ln."""
    return {
        row["parameter"]: math.log(number(row["interval_high"]) / number(row["interval_low"])) / 2
        for row in e.published["table1_priors"]
    }


@_judges("tight_cluster")
def _tight_cluster(e: Evidence) -> Finding:
    widths = _half_widths(e)
    kind = {row["parameter"]: row["class"] for row in e.published["table1_priors"]}
    common = {name: w for name, w in widths.items() if kind[name] == "common"}
    widest = max(common, key=lambda name: common[name])
    narrowest = min(w for name, w in widths.items() if kind[name] == "uncertain")
    order = sorted(widths, key=lambda name: -widths[name]).index(widest)
    reason = (
        f"{widest} is called shareable and has a factor of {_short(math.exp(common[widest]))} to either side, "
        f"{'the widest' if order == 0 else 'among the widest'} of all; the narrowest uncertain one has "
        f"{_short(math.exp(narrowest))}. A low ICC there means scatter within people, not agreement between them."
    )
    return Finding(common[widest], INCONSISTENT if common[widest] > narrowest else CONSISTENT, reason)


@_judges("interval_in_bounds")
def _interval_in_bounds(e: Evidence) -> Finding:
    bounds = _by(e.published["bounds"], "parameter")
    outside = [
        row["parameter"]
        for row in e.published["table1_priors"]
        if number(row["interval_high"]) > number(bounds[row["parameter"]]["upper"])
        or number(row["interval_low"]) < number(bounds[row["parameter"]]["lower"])
    ]
    reason = f"{', '.join(outside)}: percentiles of fits inside the bounds cannot lie outside them."
    return Finding(len(outside), INCONSISTENT if outside else CONSISTENT, reason if outside else "None.")


@_judges("interval_percentiles")
def _interval_percentiles(e: Evidence) -> Finding:
    symmetric = [r["parameter"] for r in e.published["table1_priors"] if _symmetric(r)]
    reason = (
        f"{len(symmetric)} of {len(PARAMETERS)} are symmetric about the prior in ln to the printed digits, as "
        "exp(mean ± c SD) is and percentiles of 50 fits are not."
    )
    many = len(symmetric) >= len(PARAMETERS) - 1
    return Finding(len(symmetric), INCONSISTENT if many else CONSISTENT, reason)


def _symmetric(row: Row) -> bool:
    """Return whether some rounding of the three printed numbers makes the prior the geometric centre."""

    def ends(text: str) -> tuple[float, float]:
        digits = len(text.replace(".", "").strip("0").lstrip("0")) or 1
        value = float(text)
        printed = max(digits, 3)
        half = 0.5 * 10.0 ** (math.floor(math.log10(value)) - printed + 1)
        return value - half, value + half

    prior, low, high = (ends(row[key]) for key in ("prior", "interval_low", "interval_high"))
    centre = math.sqrt(low[0] * high[0]), math.sqrt(low[1] * high[1])
    return centre[0] <= prior[1] and prior[0] <= centre[1]


@_judges("bound_k_rz")
def _bound_k_rz(e: Evidence) -> Finding:
    if not e.fits:
        return _no("There are no fits.")
    values = np.array([number(fit[parameter_column("k_rz")]) for fit in e.fits])
    ends = _by(e.published["bounds"], "parameter")["k_rz"]
    # which of the two bounds a fit is on
    low = values < math.sqrt(number(ends["lower"]) * number(ends["upper"]))
    share = float(np.mean(low & ["k_rz" in fit["at_bound"].split() for fit in e.fits]))
    reason = (
        f"{_short(100 * share)} % of the fits here end on the lower bound; their geometric mean is compared."
    )
    return e.judged(share > 0.5, float(np.exp(np.log(values).mean())), reason)


@_judges("damping_ratio")
def _damping_ratio(e: Evidence) -> Finding:
    prior = {row["parameter"]: number(row["prior"]) for row in e.published["table1_priors"]}
    known = {row["quantity"]: number(row["value"]) for row in e.published["pelvis_inertia"]}
    ratio = {}
    for axis in ("tx", "ty", "tz", "rx", "ry", "rz"):
        inertia = known["mass"] if axis[0] == "t" else known[f"inertia_{axis}"]
        ratio[axis] = prior[f"d_{axis}"] / (2 * math.sqrt(prior[f"k_{axis}"] * inertia))
    above = [f"{axis} {_short(value, 2)}" for axis, value in ratio.items() if value > e.said("damping_ratio")]
    reason = f"At the pelvis' mass and inertia the priors give {', '.join(above) or 'none above'}."
    return Finding(max(ratio.values()), INCONSISTENT if above else CONSISTENT, reason)


# -------------------- priors for the person left out, and for an unseen one


def _loso(e: Evidence, claim: str) -> Finding:
    mean = _mean_row(e.loso)
    if mean is None:
        return _no("Not everyone has a prior of the others.")
    key = {"loso_J": "overhead_J_percent", "loso_rmse": "overhead_rmse_percent"}[claim]
    here = number(mean[key])
    over = _within_over_floor(e)
    near = f", whose J is {_short(over)} times that of noise alone" if math.isfinite(over) else ""
    reason = (
        f"An overhead is a percentage of the own best fit{near}; the same extra cost is a larger percentage of a "
        "smaller J."
    )
    # fits minimise J, so that only J shows a search that ended early: the fit of least J has not the least RMSE
    failed = _not_converged("priors of the others", _by_person(e.loso, "overhead_J_percent"))
    return failed or e.judged(here <= e.said(claim), here, reason if here > e.said(claim) else "")


_claim(_loso, "loso_J", "loso_rmse")


def _against_full(e: Evidence) -> list[tuple[str, dict[str, Any]]]:
    """Return how refining compares with a full calibration, by person and trial, without people behind the priors."""
    return [
        (f"{record['subject']} {trial}", found["against_full"])
        for record in e.refined
        if not record["prior_rests_on_person"]
        for trial, found in record["trials"].items()
        if found["against_full"]
    ]


@_judges("refine_count")
def _refine_count(e: Evidence) -> Finding:
    unseen = [r for r in e.refined if not r["prior_rests_on_person"] and r["status"] == "ok"]
    if not unseen:
        return _no("No unseen person has dynamic trials to refine on.")
    if not any(row["class"] for row in e.icc):
        return _no("There is no ICC: what is refined follows the paper's own Table I.")
    free = [name for name in unseen[0]["free"] if name not in unseen[0]["also_free"]]
    return e.judged(len(free) == e.said("refine_count"), len(free), f"{', '.join(free)}.")


def _refined(e: Evidence, claim: str) -> Finding:
    found = _against_full(e)
    if not found:
        return _no("No unseen person was calibrated in full beside the refinement.")
    key, offset = {
        "refine_fidelity": ("J_ratio", 1.0),
        "refine_evaluations": ("evaluations_over_best_restart", 0.0),
    }[claim]
    values = {name: 100 * (against[key] - offset) for name, against in found}
    failed = _not_converged("refined parameters", values.items()) if offset else None
    if failed:
        return failed
    worst = max(values, key=lambda name: values[name])
    limit = 100 * (found[0][1]["bar"][key] - offset)
    named = ", ".join(f"{name} {_short(value)}" for name, value in values.items())
    what = "J above that of the full calibration" if offset else "Share of the best restart's evaluations"
    return e.judged(values[worst] <= limit, values[worst], f"{what}: {named}.")


_claim(_refined, "refine_fidelity", "refine_evaluations")


@_judges("refine_tested")
def _refine_tested(e: Evidence) -> Finding:
    deployed = _by(e.published["deployed"], "quantity")["refined_in_validation"]
    here = number(deployed["value"])
    reason = f"{_short(here)} are refined there ({deployed['place']}); the search is the paper's future work."
    holds = here == e.said("refine_tested")
    return Finding(here, CONSISTENT if holds else INCONSISTENT, "" if holds else reason)


# -------------------- the validation: interface


def _table2(e: Evidence) -> dict[str, dict[str, str]]:
    return _by(e.published["table2_interface"], "condition")


@_judges("gamma_arithmetic")
def _gamma_arithmetic(e: Evidence) -> Finding:
    wrong = []
    for name, row in _table2(e).items():
        x, y, gamma = row["sigma_x_mm"], row["sigma_y_mm"], row["gamma"]
        low = (float(x) - _half_digit(x)) / (float(y) + _half_digit(y)) - _half_digit(gamma)
        high = (float(x) + _half_digit(x)) / (float(y) - _half_digit(y)) + _half_digit(gamma)
        if not low <= float(gamma) <= high:
            wrong.append(name)
    reason = f"Does not follow: {', '.join(wrong)}." if wrong else "All four follow."
    return Finding(None, INCONSISTENT if wrong else CONSISTENT, reason)


def _clouds(e: Evidence, *, factors: bool = False) -> dict[str, dict[str, Row]]:
    """Return the compared rows of the interface table by seed and condition; of a changed robot with ``factors``."""
    out: dict[str, dict[str, Row]] = {}
    for row in e.walks.interface:
        plain = not row["robot_factor"]
        if not row["sigma_x_mm"] or row["main"] != "true" or plain is factors:
            continue
        name = row["condition"] if plain else f"{row['condition']} {row['robot_factor']}"
        out.setdefault(row["seed"], {})[name] = row
    return out


_NO_TWIN = "No twin was trained: nobody has a walk_normal trial."


@_judges("sway_order")
def _sway_order(e: Evidence) -> Finding:
    if not e.walks.interface:
        return _no(_NO_TWIN)
    straps = ("soft", "prior", "stiff")
    whole = {seed: rows for seed, rows in _clouds(e).items() if all(name in rows for name in straps)}
    holds = [
        all(
            number(rows["soft"][f"sigma_{axis}_mm"])
            > number(rows["prior"][f"sigma_{axis}_mm"])
            > number(rows["stiff"][f"sigma_{axis}_mm"])
            for axis in "xy"
        )
        for rows in whole.values()
    ]
    seeds = e.walks.seeds
    lost = len(seeds) - len(whole)
    reason = f"Holds in {sum(holds)} of {len(seeds)} seeds."
    if lost:
        reason += f" In {lost} of {len(seeds)} seeds all walkers of at least one of the three straps fell."
    return e.judged(sum(holds) == len(seeds), float(sum(holds)), reason)


def _gammas(e: Evidence) -> dict[str, float]:
    """Return the ratio of the spreads under the prior by seed, without the seeds in which all walkers fell."""
    return {seed: number(rows["prior"]["gamma"]) for seed, rows in _clouds(e).items() if "prior" in rows}


@_judges("gamma_prior")
def _gamma_prior(e: Evidence) -> Finding:
    if not e.walks.interface:
        return _no(_NO_TWIN)
    found = _gammas(e)
    fallen = e.walks.fallen(found)
    if not found:
        return e.judged(False, None, fallen)
    values = list(found.values())
    reason = f"Per seed: {', '.join(map(_short, values))}. The direction is compared, not the size."
    return e.judged(max(values) < 1 and not fallen, float(np.mean(values)), _sentences(reason, fallen))


@_judges("gamma_value")
def _gamma_value(e: Evidence) -> Finding:
    if not e.walks.interface:
        return _no(_NO_TWIN)
    by_seed = _gammas(e)
    found, fallen = list(by_seed.values()), e.walks.fallen(by_seed)
    if not found:
        return e.judged(False, None, fallen)
    changed = [number(row["gamma"]) for rows in _clouds(e, factors=True).values() for row in rows.values()]
    values = [*found, *changed]
    low, high = min(values), max(values)
    holds = low <= e.said("gamma_value") <= high
    reason = (
        f"With the robot's constants changed by the factors of twin.coupled it moves between "
        f"{_short(low)} and {_short(high)}. The paper gives none of them, so its number is "
        f"{'within reach but not explained' if holds else 'not reached'}."
    )
    reason, here = _sentences(reason, fallen), float(np.mean(found))
    return Finding(here, PRIVATE, reason) if holds else e.judged(False, here, reason)


@_judges("sigma_prior_best")
def _sigma_prior_best(e: Evidence) -> Finding:
    table = _table2(e)
    off = []
    for axis in "xyz":
        key = f"sigma_{axis}_mm"
        real = float(table["walk_robot"][key])
        # the prior comes first, so that a tie is its own
        nearest = min(("prior", "soft", "stiff"), key=lambda n: abs(float(table[n][key]) - real))
        if nearest != "prior":
            off.append(
                f"sigma_{axis}: {nearest} {table[nearest][key]} mm is nearer to {real} mm than the "
                f"prior's {table['prior'][key]} mm"
            )
    return Finding(len(off), INCONSISTENT if off else CONSISTENT, "; ".join(off) + "." if off else "")


# -------------------- the validation: gait

_JOINTS = {name: joint for joint, name in JOINT_NAMES.items()}


@_judges("dof")
def _dof(e: Evidence) -> Finding:
    if e.walks.dof is None:
        return _no(_NO_TWIN)
    if e.walks.dof == e.said("dof"):
        return Finding(e.walks.dof, SET, "The skeletal model is built with as many as the paper says.")
    return e.judged(False, e.walks.dof, "")


def _gait(e: Evidence, condition: str, joint: str) -> list[Row]:
    return [
        row
        for row in e.walks.gait
        if row["condition"] == condition and row["joint"] == joint and row["main"] == "true"
    ]


@_judges("cycles")
def _cycles(e: Evidence) -> Finding:
    if not e.walks.seeds:
        return _no(_NO_TWIN)
    counts: dict[tuple[str, ...], float] = {}
    for row in e.walks.gait:
        walk = tuple(row[key] for key in ("seed", "condition", "robot", "aware", "cap", "main"))
        counts[walk] = min(counts.get(walk, math.inf), number(row["cycles"]))
    fallen = e.walks.fallen(seed for seed, *_ in counts)
    fewest = 0.0 if fallen else min(counts.values())
    reason = _sentences("Fewest of all conditions and seeds.", _walks_without_cycles(counts), fallen)
    return e.judged(fewest >= e.said("cycles"), fewest, reason)


def _walks_without_cycles(counts: dict[tuple[str, ...], float]) -> str:
    """Return a sentence on the walks of no cycle; ``counts`` maps a walk (seed first, main last) to its cycles."""
    lost = [walk for walk, count in counts.items() if not count]
    if not lost:
        return ""
    named = ", ".join(
        f"{condition} in seed {seed} ({robot} robot, {'aware' if aware == 'true' else 'fixed'} gait, cap {cap})"
        for seed, condition, robot, aware, cap, _ in lost
    )
    compared = sum(main == "true" for *_, main in lost)
    return (
        f"In {len(lost)} of {len(counts)} walks (a condition in a seed) all walkers fell or took no whole stride: "
        f"{named}. Of these walks {compared} are at the robot and speed cap that the measurement is compared with."
    )


def _rom_change(e: Evidence, claim: str) -> Finding:
    if not e.walks.seeds:
        return _no(_NO_TWIN)
    joint = _JOINTS[claim.removesuffix("_change")]
    rows = [r for r in _gait(e, "prior", joint) if r["rom_change_deg"]]
    found = [number(r["rom_change_deg"]) for r in rows]
    fallen = e.walks.fallen((r["seed"] for r in rows), ", with the robot or in the walk without it")
    if not found:
        return e.judged(False, None, fallen)
    said = e.said(claim)
    same = [math.copysign(1, value) == math.copysign(1, said) for value in found]
    measured = [number(r["rom_change_deg"]) for r in _gait(e, "walk_robot", joint) if r["rom_change_deg"]]
    reason = (
        f"Per seed: {', '.join(_short(v, 2) for v in found)} with the {rows[0]['robot']} robot at a speed cap of "
        f"{_short(number(rows[0]['cap']))}."
    )
    if measured:
        reason += f" The person's own walks change by {_short(measured[0], 2)}."
    return e.judged(all(same) and not fallen, float(np.mean(found)), _sentences(reason, fallen))


_claim(_rom_change, "hip_change", "knee_change", "ankle_change")


@_judges("hip_r")
def _hip_r(e: Evidence) -> Finding:
    hip = _JOINTS["hip"]
    if not any(number(row["cycles"]) for row in _gait(e, "walk_robot", hip)):
        return _no("No twin walks beside a measured walk with the robot.")
    by_seed = {r["seed"]: number(r["r_walk_robot"]) for r in _gait(e, "prior", hip) if r["r_walk_robot"]}
    found, fallen = list(by_seed.values()), e.walks.fallen(by_seed)
    if not found:
        return e.judged(False, None, fallen)
    reason = _sentences(f"Per seed: {', '.join(map(_short, found))}.", fallen)
    least = e.said("hip_r") - _half_digit(e.claims["hip_r"]["published"])
    return e.judged(min(found) >= least and not fallen, float(np.mean(found)), reason)


def _table3(e: Evidence) -> dict[tuple[str, str], Row]:
    return {(row["joint"], row["condition"]): row for row in e.published["table3_gait"]}


@_judges("changes_arithmetic")
def _changes_arithmetic(e: Evidence) -> Finding:
    table, wrong = _table3(e), []
    for name, joint in _JOINTS.items():
        claim = f"{name}_change"
        a, b = table[joint, "prior"]["rom_deg"], table[joint, "free"]["rom_deg"]
        if abs(float(a) - float(b) - e.said(claim)) > _half_digit(a) + _half_digit(b) + 1e-9:
            wrong.append(claim)
    return Finding(
        None,
        INCONSISTENT if wrong else CONSISTENT,
        f"Does not follow: {', '.join(wrong)}." if wrong else "All three follow.",
    )


@_judges("compresses_all")
def _compresses_all(e: Evidence) -> Finding:
    table, rises = _table3(e), []
    for name, joint in _JOINTS.items():
        off, on = (number(table[joint, condition]["rom_deg"]) for condition in ("walk_normal", "walk_robot"))
        if on > off:
            model = [number(table[joint, condition]["rom_deg"]) for condition in ("free", "prior")]
            rises.append(
                f"{name} rises from {off} to {on} in reality"
                + (f" and falls from {model[0]} to {model[1]} in simulation" if model[1] < model[0] else "")
            )
    return Finding(len(rises), INCONSISTENT if rises else CONSISTENT, "; ".join(rises) + "." if rises else "")


@_judges("bracketed_hip")
def _bracketed_hip(e: Evidence) -> Finding:
    rows = [_table3(e)[_JOINTS["hip"], name] for name in ("soft", "prior")]
    (a, b), sd = (number(r["rom_deg"]) for r in rows), max(number(r["rom_sd_deg"]) for r in rows)
    reason = f"{a} against {b}, with an SD of {sd} between cycles."
    return Finding(abs(a - b), CONSISTENT if abs(a - b) > sd else INCONSISTENT, reason)


# -------------------- the table


def judge(evidence: Evidence, source: Path) -> list[dict[str, Any]]:
    """Return a row per claim of ``source``, the table of claims.

    Raises
    ------
    InputError
        Where a claim has no judge, or a judge has no claim.
    """
    differ = sorted(evidence.claims.keys() ^ _JUDGES.keys())
    if differ:
        raise InputError(
            source,
            "column claim",
            ", ".join(differ),
            "the claims that real2sim.study.paper.claims can judge",
            "Write a function for a new claim, or take it out of the table.",
        )
    rows = []
    for name, claim in evidence.claims.items():
        found = _JUDGES[name](evidence)
        own = found.verdict not in (INCONSISTENT, CONSISTENT, SIMULATED, REFUTED)
        rows.append(
            {key: claim[key] for key in ("claim", "place", "says", "unit", "criterion")}
            | {"published": claim["published"], "here": found.here, "verdict": found.verdict}
            | {"reason": found.reason, "phantom": evidence.phantom and own}
            | {"overridden": _refused(evidence) if own else ""}
        )
    return rows


def _refused(evidence: Evidence) -> str:
    """Return the trials that the results rest on although a gate refuses them, as a table cell."""
    of_fits = {trial for row in evidence.icc for trial in row.get("overridden", "").split()}
    return " ".join(
        sorted(of_fits.union(*(record.get("overridden_gates", {}) for record in evidence.refined)))
    )


def _rows_of(table: Path | None, subject: str) -> list[Row]:
    """Return one person's rows; none where there is no table."""
    return [row for row in read_table(table) if row["subject"] == subject] if table else []


def claims(
    *,
    published: list[Path],
    people: list[Path],
    sweeps: list[Path],
    tightness: Path,
    fits: Path,
    cross_trial: Path,
    icc: Path,
    loso: Path,
    out: Path,
    out_tex: Path,
    out_numbers: Path,
    coverage: Path | None = None,
    refined: list[Path] | None = None,
    subject: str = "",
    gait: Path | None = None,
    interface: Path | None = None,
    human: Path | None = None,
) -> None:
    """Judge every claim of the paper: table as CSV and LaTeX, and the numbers as LaTeX macros.

    Parameters
    ----------
    published
        Tables of resources/published, ``claims.csv`` among them.
    people
        Folders with a subject.yaml.
    sweeps, tightness, fits, cross_trial, icc, loso, coverage, refined, gait, interface
        Files of the stages that bear these names.
    subject, human
        The unseen person whose twin walks, and the MJCF of their skeletal model.
    """
    tables = {path.stem: read_table(path) for path in published}
    icc_rows = read_table(icc, ("parameter", "class", "phantom"))
    evidence = Evidence(
        published=tables,
        claims=_by(tables.pop("claims"), "claim"),
        people=[subject_values(folder) for folder in people],
        sweeps=[read_table(path) for path in sweeps],
        tightness=read_json(tightness, ("pooled", "persons", "operating_points")),
        fits=read_table(fits, ("subject", "trial", "J")),
        cross_trial=read_table(cross_trial, ("subject", "status")),
        icc=icc_rows,
        loso=read_table(loso, ("subject", "status")),
        coverage=read_table(coverage) if coverage else [],
        refined=[read_json(path, ("subject", "status")) for path in refined or []],
        walks=_walks(subject, gait, interface, human),
    )
    evidence.phantom = _on_phantom(evidence)
    rows = judge(evidence, next(path for path in published if path.stem == "claims"))
    write_table(out, COLUMNS, rows)
    write_text(out_tex, _latex(rows, evidence.phantom))
    values = {row["claim"]: row["here"] for row in rows if row["here"] is not None}
    write_text(out_numbers, macros(values, phantom=evidence.phantom))


def _on_phantom(e: Evidence) -> bool:
    """Return whether any result that claims are judged by rests on synthetic people."""
    tables = (e.icc, e.fits, e.cross_trial, e.loso, e.walks.gait, e.walks.interface, *e.sweeps)
    return is_phantom([*chain.from_iterable(tables), e.tightness, *e.refined])


def _walks(subject: str, gait: Path | None, interface: Path | None, human: Path | None) -> Walks:
    """Read what is known of the walking twin of one person; arguments as of `claims`."""
    dof = mujoco.MjModel.from_xml_path(str(human)).nv if human else None
    return Walks(_rows_of(gait, subject), _rows_of(interface, subject), dof)


def _latex(rows: list[dict[str, Any]], phantom: bool) -> str:
    """Return the judged claims as a LaTeX table."""
    printed = [
        [
            row["says"],
            row["published"],
            "" if row["here"] is None else _short(row["here"]),
            row["unit"],
            row["verdict"],
        ]
        for row in rows
    ]
    return latex_table(
        ["Claim", "Published", "Here", "Unit", "Verdict"],
        printed,
        caption="Quantitative claims of the paper and what is found here.",
        label="tab:claims",
        columns="p{0.42\\linewidth}rrlp{0.2\\linewidth}",
        phantom=phantom,
    )
