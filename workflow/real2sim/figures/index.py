"""The page that links every figure and table of a run."""

from __future__ import annotations

import os
from html import escape
from pathlib import Path

from real2sim.artefacts import number, read_table
from real2sim.figures.style import PHANTOM_LABEL
from real2sim.files import write_text

# By the beginning of the file's name; what, units, place in the paper.
CAPTIONS = {
    "tightness": (
        "Tightness sweep",
        "Allowable motion against normalised tightness (no unit; 0 is the selected level, positive is "
        "tighter). (a, b) Range of translation in mm. (c) Range of pelvic rotation of either side in deg, "
        "with the pooled two-segment regression, its slopes in deg per unit of normalised tightness, and "
        "the knee with its interval (grey band). Paper: Fig. 3.",
    ),
    "convergence": (
        "Convergence",
        "Best cost J so far (no unit, logarithmic) against cost evaluations, a row per person and a column per "
        "dynamic trial; restarts grey, the best one blue. Dashed: what measurement noise alone costs, from the "
        "person's neutral trial. Paper: Fig. 4, top.",
    ),
    "icc": (
        "Shareability",
        "(a) ICC(1,1) (no unit) of each parameter with the cluster bootstrap's percentile interval and the "
        "exact F interval; zones are the class limits. (b) Every fit over the geometric mean of all (no "
        "unit, logarithmic), shaded by class. Paper: Fig. 4, middle.",
    ),
    "identifiability": (
        "What each trial determines",
        "Verdict on each parameter of each trial's best fit [SI units]: determined, weak, not determined or at bound, "
        "with a 95 % interval that takes the residuals' autocorrelation and the noise of the pelvis markers into "
        "account, the reason, the trial that would help, and the assumed constant of the robot that the value hangs on "
        "most (change in % when that constant is 10 % larger). A value that is not called determined is not a result.",
    ),
    "loso": (
        "Leave one subject out",
        "What the prior of the others costs the person left out: overhead over their own best fit in %, for"
        " cost J and for position RMSE. Costs J have no unit, RMSE is in m. Paper: Fig. 4, bottom, and eq. "
        "7.",
    ),
    "priors": (
        "Priors",
        "Geometric mean and empirical 95 % spread of the fits, beside the published ones, each in the unit "
        "of its row. Paper: Table I. Rotation about y is informed only through the arm's pitch.",
    ),
    "cross_trial": (
        "Cross-trial generalisation",
        "Cost J (no unit) of each trial's best fit on its own and on the other trial, overhead in %. Paper:"
        " section V-B.1.",
    ),
    "diagnosis": (
        "Diagnosis",
        "What causes each person's sim-to-real gap and how far it shrinks on a held-out trial. Costs J and shares "
        "have no unit; J_floor is what measurement noise alone costs.",
    ),
    "fits": ("All fits", "One row per restart; units in the column names."),
}
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 0 auto; padding: 1rem; color: #1a1a1a }
figure { margin: 0 0 2rem; }
figure img { max-width: 100%; width: 28rem; height: auto; border: 1px solid #ddd; }
figcaption { max-width: 45rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; }
th, td { padding: 0.2rem 0.6rem; border-bottom: 1px solid #ccc; }
th { text-align: left; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
.notice { border-left: 0.4rem solid #d55e00; background: #fdf1e8; padding: 0.6rem 1rem; }
""".strip()


def _caption(path: Path) -> tuple[str, str]:
    """Heading and caption of a file; what follows the known beginning (a person) joins the heading."""
    for key, (heading, text) in CAPTIONS.items():
        if path.stem == key:
            return heading, text
        if path.stem.startswith(f"{key}_"):
            return f"{heading}: {path.stem.removeprefix(f'{key}_').replace('_', ' ')}", text
    return path.stem.replace("_", " "), ""


def _link(target: Path, page: Path) -> str:
    return escape(Path(os.path.relpath(target, page.parent)).as_posix(), quote=True)


def _figure(png: Path, others: list[Path], page: Path) -> str:
    heading, text = _caption(png)
    files = ", ".join(f'<a href="{_link(p, page)}">{p.suffix[1:].upper()}</a>' for p in [png, *others])
    return (
        f'<section id="figure-{escape(png.stem)}">\n<h3>{escape(heading)}</h3>\n<figure>\n'
        f'<a href="{_link(png, page)}"><img src="{_link(png, page)}" alt="{escape(heading)}"></a>\n'
        f"<figcaption>{escape(text)} Files: {files}.</figcaption>\n</figure>\n</section>"
    )


def _cell(text: str) -> str:
    """A table cell; numbers are rounded to four digits for reading, the CSV keeps them all."""
    try:
        return f'<td class="number">{number(text):.4g}</td>' if text else "<td></td>"
    except ValueError:
        return f"<td>{escape(text)}</td>"


def _table(csv: Path, rows: list[dict[str, str]], page: Path) -> str:
    heading, text = _caption(csv)
    columns = list(rows[0]) if rows else []
    head = "".join(f'<th scope="col">{escape(c)}</th>' for c in columns)
    body = "\n".join("<tr>" + "".join(_cell(row[c]) for c in columns) + "</tr>" for row in rows)
    return (
        f'<section id="table-{escape(csv.stem)}">\n<h3>{escape(heading)}</h3>\n'
        f'<p>{escape(text)} File: <a href="{_link(csv, page)}">{escape(csv.name)}</a>.</p>\n'
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(heading, quote=True)}"><table>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>\n</section>"
    )


def _notices(tables: dict[Path, list[dict[str, str]]], phantom: bool) -> list[str]:
    notices = []
    if phantom:
        notices.append(
            f"{PHANTOM_LABEL}: every number and figure here rests on synthetic people, not on measurements."
        )
    for path, rows in tables.items():
        wanting = {row["status"] for row in rows if row.get("status", "").startswith(("needs", "only"))}
        notices += [f"{_caption(path)[0]}: {status}." for status in sorted(wanting)]
    refused = {
        trial for rows in tables.values() for row in rows for trial in row.get("overridden", "").split()
    }
    if refused:
        listed = ", ".join(sorted(refused))
        notices.append(
            f"Fitted although a gate refuses it (quality.override): {listed}. All results rest on it."
        )
    return notices


def index_page(*, figures: list[Path], tables: list[Path], title: str, phantom: bool, out: Path) -> None:
    """Write one HTML page with all figures and tables of a run, by relative links, without scripts.

    ``figures`` may list PNG and PDF of the same name: the PNG is shown, both are linked. The banner appears
    if ``phantom`` is set or any table's own ``phantom`` column says so. A ``status`` that asks for more
    people is repeated at the top.
    """
    read = {path: read_table(path) for path in tables}
    synthetic = phantom or any(row.get("phantom") == "true" for rows in read.values() for row in rows)
    pictures = [path for path in figures if path.suffix == ".png"]
    shown = [
        _figure(png, [p for p in figures if p.stem == png.stem and p.suffix != ".png"], out)
        for png in pictures
    ]
    notices = [f'<p class="notice">{escape(n)}</p>' for n in _notices(read, synthetic)]
    parts = [
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>\n{STYLE}\n</style>\n</head>\n<body>\n<main>\n<h1>{escape(title)}</h1>",
        *notices,
        "<h2>Figures</h2>",
        *shown,
        "<h2>Tables</h2>",
        *(_table(path, rows, out) for path, rows in read.items()),
        "</main>\n</body>\n</html>\n",
    ]
    write_text(out, "\n".join(parts))
