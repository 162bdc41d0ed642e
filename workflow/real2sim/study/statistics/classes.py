"""Which parameters people share, as far as it can be told: classes of three intervals beside what was determined."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from real2sim.artefacts import number, read_table, write_table
from real2sim.inference.parameters import PARAMETERS, unit

SHARED, OWN, UNTOLD = "shared", "person's own", "cannot be told"
FLAT = "shared only because it is not determined"
BOUND = "shared only because it sits on its bound"
SEARCH = "shared only because the search does not repeat itself"
# Restarts that scatter by more than this (ln) and more than trials do: the fits say more of the search than of people
LOOSE_SD_LN = 0.1
# verdicts of the assessment and their columns
VERDICTS = {
    "determined": "share_determined",
    "weak": "share_weak",
    "not determined": "share_not_determined",
    "at bound": "share_at_bound",
}
SD_COLUMNS = ("sd_person_ln", "sd_trial_ln", "sd_restart_ln")
CLASS_COLUMNS = (
    "parameter",
    "unit",
    "status",
    "verdict",
    "reason",
    "class",
    "class_by_exact_interval",
    "class_by_nested_interval",
    *VERDICTS.values(),
    "share_of_fits_at_bound",
    *SD_COLUMNS,
    "n_subjects",
    "n_trials",
    "overridden",
    "phantom",
)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


@dataclass(frozen=True)
class Evidence:
    """Evidence about one parameter.

    ``paper``, ``exact`` and ``nested`` are its class by the cluster bootstrap over fits (the paper's), the exact F
    interval over fits and the exact F interval over trials: common, distinct or uncertain. ``shares`` is the share of
    trials by verdict of the assessment (keys of VERDICTS), ``fits_at_bound`` the share of all fits that end on a bound;
    ``sd`` are the standard deviations of ln of people, trials and restarts (NaN where not known), ``interval`` the
    interval over trials as text.
    """

    paper: str
    exact: str
    nested: str
    shares: dict[str, float]
    fits_at_bound: float
    sd: tuple[float, float, float]
    interval: str

    @property
    def common(self) -> bool:
        """Return whether any of the intervals says common."""
        return "common" in (self.paper, self.exact, self.nested)

    @property
    def loose(self) -> bool:
        """Return whether restarts of one trial scatter more than trials, and more than can be ignored."""
        _, trial, restart = self.sd
        return restart > LOOSE_SD_LN and not restart <= trial


def verdict(e: Evidence) -> tuple[str, str]:
    """Verdict on one parameter, and why. The first rule that applies decides.

    1. More than half of the trials, or of the fits, at a bound: "shared only because it sits on its bound" where any
       of the three classes is common, else "cannot be told": a bound is no measurement of anybody.
    2. At most half of the trials determined and any class common: "shared only because it is not determined", since
       scatter of what the data leave open lowers an ICC as agreement does (unless the trials say distinct).
    3. More than half of the trials not determined: "cannot be told", whatever the classes.
    4. Restarts that scatter (`Evidence.loose`) and any class common: "shared only because the search does not repeat
       itself" (unless the trials say distinct).
    5. The class by trials, which alone counts independent repeats: common is "shared", distinct "person's own".
    6. Else "cannot be told".
    """
    sure, bound = e.shares["determined"], max(e.shares["at bound"], e.fits_at_bound)
    if bound > 0.5:
        where = f"at a bound in {_percent(e.shares['at bound'])} of trials and {_percent(e.fits_at_bound)} of fits"
        return (BOUND, where) if e.common else (UNTOLD, where)
    masked = e.common and e.nested != "distinct"
    if sure <= 0.5 and masked:
        return FLAT, f"determined in only {_percent(sure)} of trials: scatter lowers the ICC"
    if e.shares["not determined"] > 0.5:
        return UNTOLD, f"not determined in {_percent(e.shares['not determined'])} of trials"
    if e.loose and masked:
        return (
            SEARCH,
            f"restarts of one trial scatter by {e.sd[2]:.2g} (SD of ln): more evaluations are needed",
        )
    told = f"ICC of trials {e.interval}"
    if e.nested != "uncertain":
        spread = f"people differ by {e.sd[0]:.2g} (SD of ln), determined in {_percent(sure)} of trials"
        return (SHARED if e.nested == "common" else OWN), f"{told}; {spread}"
    claims = {"the paper's interval": e.paper, "the exact interval over fits": e.exact}
    said = [f"{name} says {what}" for name, what in claims.items() if what != "uncertain"]
    but = f"; {' and '.join(said)}, counting restarts as repeats" if said else ""
    return UNTOLD, f"{told}: more people or trials are needed{but}"


def _shares(rows: list[dict[str, str]]) -> dict[str, float]:
    return {what: sum(row["verdict"] == what for row in rows) / len(rows) for what in VERDICTS}


def classes(*, icc: Path, nested: Path, identifiability: Path, out: Path) -> None:
    """One row per parameter: its class by three intervals, how often it was determined, and a verdict with its reason.

    ``icc`` is the table of `shareability`, ``nested`` of `nested_variance`, ``identifiability`` of
    `assessment_table`. The rule is that of `verdict`; where one of the classes is missing, the verdict is
    "cannot be told" and the reason what is missing.
    """
    by_fits = {row["parameter"]: row for row in read_table(icc, ("parameter", "class", "share_at_bound"))}
    by_trials = {row["parameter"]: row for row in read_table(nested, ("parameter", "class", *SD_COLUMNS))}
    told = read_table(identifiability, ("subject", "trial", "parameter", "verdict"))
    rows: list[dict[str, Any]] = []
    for name in PARAMETERS:
        fits, trials = by_fits[name], by_trials[name]
        own = [row for row in told if row["parameter"] == name]
        shares = _shares(own) if own else {}
        row: dict[str, Any] = {
            "parameter": name,
            "unit": unit(name),
            "class": fits["class"],
            "class_by_exact_interval": fits["class_by_exact_interval"],
            "class_by_nested_interval": trials["class"],
            "share_of_fits_at_bound": fits["share_at_bound"],
            "n_trials": len(own),
            **{VERDICTS[what]: share for what, share in shares.items()},
            **{key: trials[key] for key in SD_COLUMNS},
            **{key: fits[key] for key in ("n_subjects", "overridden", "phantom")},
        }
        missing = [each["status"] for each in (fits, trials) if not each["class"]]
        if missing or not own:
            why = missing[0] if missing else "no trial has been assessed"
            row |= {"status": why, "verdict": UNTOLD, "reason": why}
        else:
            low, high = number(trials["trials_low"]), number(trials["trials_high"])
            person, trial, restart = (number(trials[key]) for key in SD_COLUMNS)
            said = verdict(
                Evidence(
                    paper=fits["class"],
                    exact=fits["class_by_exact_interval"],
                    nested=trials["class"],
                    shares=shares,
                    fits_at_bound=number(fits["share_at_bound"]),
                    sd=(person, trial, restart),
                    interval=f"{low:.2f} to {high:.2f}" if low <= high else "without any variance",
                )
            )
            row |= {"status": "ok", "verdict": said[0], "reason": said[1]}
        rows.append(row)
    write_table(out, CLASS_COLUMNS, rows)
