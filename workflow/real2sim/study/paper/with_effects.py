"""The paper's tables twice: with the plain model, and with the diagnosed causes in it.

What of the paper's conclusions survives once the gap of each person is explained? Priors, ICC and classes (Table I),
and what the parameters cost on another trial of the same person and on another person, by the same cost J. Both models
are fitted to the same trials of the same people: other trials would change the columns without any cause in the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import number, read_json, read_table, write_table
from real2sim.diagnosis.decide import NONE, UNKNOWN
from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.study.explained import METHOD
from real2sim.study.paper.latex import latex_table
from real2sim.study.paper.tables import missing_priors, short
from real2sim.study.statistics.shareability import is_published

if TYPE_CHECKING:
    from real2sim.settings import IdentificationSettings

MODELS = ("plain", "with_effects")
# identification.method in the words of a caption
_SEARCHES = {"cma": "CMA-ES", "least_squares": "least squares"}
_OF_SEARCH = tuple(f"search_{model}" for model in MODELS)
_OF_PRIORS = ("prior", "interval_low", "interval_high", "class")
_ORIGIN = ("source", "status")
PRIOR_COLUMNS = (
    "parameter",
    "unit",
    "n_subjects",
    "n_with_a_cause",
    *(f"{what}_{model}" for model in MODELS for what in (*_OF_PRIORS, "icc")),
    "change_percent",
    *(f"published_{what}" for what in _OF_PRIORS),
    *_OF_SEARCH,
    *(f"{what}_{model}" for model in MODELS for what in _ORIGIN),
    "confidence",
    "phantom",
)
TRANSFER_COLUMNS = (
    "quantity",
    "says",
    "unit",
    "plain",
    "with_effects",
    "published",
    "n_subjects",
    *_OF_SEARCH,
    "phantom",
)

Row = Mapping[str, str]


def prior_rows(
    priors: Sequence[Sequence[Row]],
    icc: Sequence[Sequence[Row]],
    published: Mapping[str, Row],
    diagnoses: Sequence[Mapping[str, Any]],
) -> list[dict[str, Any]]:
    """Return a row per parameter: prior with the spread of the fits [SI], ICC and class, with each model.

    ``priors`` and ``icc`` are rows of priors.csv and icc.csv without and with the causes; ``published`` rows of Table I
    by parameter; ``diagnoses`` contents of diagnosis.json. Where the published prior stands in for one of the fits,
    there is no ``change_percent``.
    """
    caused = sum(d["verdict"] not in (NONE, UNKNOWN) for d in diagnoses)
    shared = [{row["parameter"]: row for row in rows} for rows in icc]
    out = []
    for pair in zip(*priors, strict=True):
        name = pair[0]["parameter"]
        row: dict[str, Any] = {"parameter": name, "unit": pair[0]["unit"]}
        row |= {"n_subjects": len(diagnoses), "n_with_a_cause": caused}
        for model, prior, ratios in zip(MODELS, pair, shared, strict=True):
            row |= {f"{what}_{model}": prior[what] for what in (*_OF_PRIORS, *_ORIGIN)}
            row[f"icc_{model}"] = ratios[name]["icc"]
        if not any(is_published(prior["source"]) for prior in pair):
            row["change_percent"] = 100 * (number(row["prior_with_effects"]) / number(row["prior_plain"]) - 1)
        row |= {f"published_{what}": published[name][what] for what in _OF_PRIORS}
        row["confidence"] = next((prior["confidence"] for prior in pair if prior.get("confidence")), None)
        row["phantom"] = any(d["phantom"] for d in diagnoses)
        out.append(row)
    return out


Record = Mapping[str, Any]


def _own(record: Record) -> float:
    """J of the best fits of a person who was left out, a mean over the trials."""
    return float(np.mean([trial["J_best"] for trial in record["trials"]]))


def _with_prior(record: Record) -> float:
    """J of the same trials with the prior of the others."""
    return float(np.mean([trial["J_prior"] for trial in record["trials"]]))


def _extra(record: Record) -> float:
    """Extra J of a fit on the person's other trial."""
    return float(record["J_cross_mean"] - record["J_within_mean"])


_SAME_IN_PERCENT = "the same over J of the own fit"
# By quantity of a person's result on the other trial: what it says, unit, value
_ON_OTHER_TRIAL: dict[str, tuple[str, str, Callable[[Record], float]]] = {
    "J_own": ("J of a fit on its own trial", "1", lambda r: float(r["J_within_mean"])),
    "J_other_trial": ("J of a fit on the person's other trial", "1", lambda r: float(r["J_cross_mean"])),
    "extra_other_trial": ("what the other trial costs more, in J", "1", _extra),
    "overhead_other_trial": (_SAME_IN_PERCENT, "percent", lambda r: 100 * _extra(r) / r["J_within_mean"]),
}
# The same of a person's result with the prior of the others
_WITH_PRIOR_OF_OTHERS: dict[str, tuple[str, str, Callable[[Record], float]]] = {
    "J_prior_of_others": ("J with the prior of the others", "1", _with_prior),
    "extra_prior_of_others": ("what that prior costs more, in J", "1", lambda r: _with_prior(r) - _own(r)),
    "overhead_prior_of_others": (_SAME_IN_PERCENT, "percent", lambda r: 100 * float(r["overhead_J"])),
}


def transfer_rows(
    cross_trial: Sequence[Sequence[Record]], loso: Sequence[Sequence[Record]], published: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Return what parameters cost on another trial and on another person, with each model; means over people.

    ``cross_trial`` and ``loso`` are contents of results/cross_trial and results/loso of the same people, without and
    with the causes; ``published`` maps a quantity to what the paper says of it.
    """
    crossed = [[r for r in records if "overhead" in r] for records in cross_trial]
    left_out = [[r for r in records if "overhead_J" in r] for records in loso]
    out = []
    for quantities, found in ((_ON_OTHER_TRIAL, crossed), (_WITH_PRIOR_OF_OTHERS, left_out)):
        for name, (says, unit, of) in quantities.items():
            row: dict[str, Any] = {"quantity": name, "says": says, "unit": unit}
            for model, records in zip(MODELS, found, strict=True):
                row[model] = float(np.mean([of(record) for record in records])) if records else math.nan
            row |= {"published": published.get(name, ""), "n_subjects": len(found[0])}
            out.append(row | {"phantom": any(r["phantom"] for r in found[0])})
    return out


def with_effects(
    *,
    diagnoses: list[Path],
    priors: list[Path],
    icc: list[Path],
    cross_trial: list[Path],
    cross_trial_explained: list[Path],
    loso: list[Path],
    loso_explained: list[Path],
    published: list[Path],
    settings: IdentificationSettings,
    out: list[Path],
) -> None:
    """Write Table I and the transfer costs with the plain model and with the diagnosed causes.

    Parameters
    ----------
    diagnoses
        diagnosis.json of the calibration people.
    priors, icc
        priors.csv and icc.csv, without and with the causes, of as many people and fits.
    cross_trial, cross_trial_explained, loso, loso_explained
        Results of the same trials of the same people, without and with the causes.
    published
        table1_priors.csv, cross_trial.csv and claims.csv of resources/published.
    settings
        Slice ``identification`` of the configuration: the search of the plain fits.
    out
        table1_priors and transfer, each .csv and .tex.

    Raises
    ------
    InputError
        Where a plain result rests on other people or other trials than the one with the causes beside it.
    """
    answers = [read_json(path) for path in diagnoses]
    table1 = {row["parameter"]: row for row in read_table(published[0], ("parameter", "prior", "class"))}
    searches = dict(zip(_OF_SEARCH, (_SEARCHES[settings["method"]], _SEARCHES[METHOD]), strict=True))
    rows = prior_rows(
        [read_table(path, ("parameter", "prior", "class", *_ORIGIN)) for path in priors],
        _read_icc(icc),
        table1,
        answers,
    )
    moved = transfer_rows(
        _read_same_trials(cross_trial, cross_trial_explained),
        _read_same_trials(loso, loso_explained),
        _published(published[1], published[2]),
    )
    rows, moved = ([row | searches for row in table] for table in (rows, moved))
    files = {path.name: path for path in out}
    write_table(files["table1_priors.csv"], PRIOR_COLUMNS, rows)
    write_text(files["table1_priors.tex"], _table1(rows))
    write_table(files["transfer.csv"], TRANSFER_COLUMNS, moved)
    write_text(files["transfer.tex"], _transfer(moved))


def _read_icc(paths: Sequence[Path]) -> list[list[dict[str, str]]]:
    """Read icc.csv without and with the causes. Raises InputError where the people or fits are not as many."""
    columns = ("n_subjects", "n_fits")
    tables = [read_table(path, ("parameter", "icc", *columns)) for path in paths]
    found, expected = (", ".join(f"{column} = {table[0][column]}" for column in columns) for table in tables)
    if found != expected:
        raise _other_evidence(paths[0], found, expected)
    return tables


def _read_same_trials(plain: Sequence[Path], explained: Sequence[Path]) -> list[list[Record]]:
    """Read results of people without and with the causes. Raises InputError where they are of other trials."""
    records: list[list[Record]] = [
        [read_json(path, ("subject",)) for path in paths] for paths in (plain, explained)
    ]
    for path, *pair in zip(plain, *records, strict=True):
        found, expected = (
            f"{record['subject']}: {', '.join(_trials_of(record)) or 'none'}" for record in pair
        )
        if found != expected:
            raise _other_evidence(path, found, expected)
    return records


def _trials_of(record: Record) -> list[str]:
    """Return the trials that a cross-trial or a leave-one-out result rests on, in alphabetical order."""
    return sorted(
        {part.get("trial") or part["train"] for key in ("trials", "pairs") for part in record.get(key, ())}
    )


def _other_evidence(path: Path, found: str, expected: str) -> InputError:
    remedy = "Compute the plain results of these people and trials (rules *_plain_side)."
    return InputError(path, "", found, f"{expected}, as with the causes", remedy)


def _published(cross_trial: Path, claims: Path) -> dict[str, str]:
    """Quantities of `transfer_rows` as the paper prints them."""
    trials = {row["quantity"]: row["value"] for row in read_table(cross_trial, ("quantity", "value"))}
    said = {row["claim"]: row["published"] for row in read_table(claims, ("claim", "published"))}
    return {
        "J_own": trials["J_within_mean"],
        "J_other_trial": trials["J_cross_mean"],
        "extra_other_trial": f"{number(trials['J_cross_mean']) - number(trials['J_within_mean']):.3g}",
        "overhead_other_trial": trials["overhead_mean"],
        "overhead_prior_of_others": said["loso_J"],
    }


def same_trials(row: Mapping[str, Any]) -> str:
    """Return the sentence that says which trials and which searches a row of either table rests on."""
    return (
        "Both models are fitted to the first two dynamic trials of the same people: the plain one by "
        f"{row['search_plain']}, the one with causes by {row['search_with_effects']}."
    )


def _model_cells(row: Mapping[str, Any], model: str) -> list[str]:
    """Prior with its range, ICC and class with one of the models; dashes where the published prior stands in."""
    icc = short(row[f"icc_{model}"])
    if is_published(row[f"source_{model}"]):
        return ["\N{EN DASH}", icc, "\N{EN DASH}"]
    prior = _with_range(row, f"prior_{model}", f"interval_low_{model}", f"interval_high_{model}")
    return [prior, icc, row[f"class_{model}"]]


def _table1(rows: Sequence[Mapping[str, Any]]) -> str:
    printed = []
    for row in rows:
        cells = [row["parameter"], row["unit"]]
        for model in MODELS:
            cells += _model_cells(row, model)
        low, high = "published_interval_low", "published_interval_high"
        cells += [_with_range(row, "published_prior", low, high), row["published_class"]]
        printed.append(cells)
    first, of_model = rows[0], ["ICC", "Class"]
    missing = [row[f"status_{m}"] for row in rows for m in MODELS if is_published(row[f"source_{m}"])]
    return latex_table(
        ["Parameter", "Unit", "Plain", *of_model, "With causes", *of_model, "Published", "Class"],
        printed,
        caption=(
            f"Priors of {first['n_subjects']} people with the plain model and with the diagnosed causes in it, of "
            f"{first['n_with_a_cause']} of them, beside the published ones (Table I). {same_trials(first)}"
            + (f" {missing_priors(missing)}" if missing else "")
        ),
        label="tab:priors-with-effects",
        columns="lllrllrlll",
        phantom=bool(first["phantom"]),
    )


def _transfer(rows: Sequence[Mapping[str, Any]]) -> str:
    return latex_table(
        ["Quantity", "Unit", "Plain", "With causes", "Published"],
        [[row["says"], row["unit"], *(short(row[key]) for key in (*MODELS, "published"))] for row in rows],
        caption=(
            f"What parameters cost on the person's other trial and on another person, means over "
            f"{rows[0]['n_subjects']} people, with the plain model and with the diagnosed causes in it. "
            f"{same_trials(rows[0])}"
        ),
        label="tab:transfer-with-effects",
        columns="llrrr",
        phantom=bool(rows[0]["phantom"]),
    )


def _with_range(row: Mapping[str, Any], value: str, low: str, high: str) -> str:
    return f"{short(row[value])} [{short(row[low])}, {short(row[high])}]"
