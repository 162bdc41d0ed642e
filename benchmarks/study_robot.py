"""Which of the twelve parameters does a replay with the study's robot determine, and what do restarts make of the rest?

    snakemake --cores 2 results/tables/identifiability.csv results/shareability/classes.csv
      --configfile config/study-robot.yaml     # one line, in a clone of its own
    python benchmarks/study_robot.py results --out docs/images/study_robot.png

Reads the fits of that study: phantom people whose truth is sealed, on the study's robot as a strap feels it. Per
parameter: verdicts over the trials, centre and spread of the best fits, spread of the restarts within a trial, error
against the truth, class by ICC; beside Table I of the paper. Prints a table and draws every restart.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from real2sim.artefacts import number, read_json, read_table
from real2sim.inference.parameters import PARAMETERS
from real2sim.pages import style

ROOT = Path(__file__).resolve().parents[1]
_SHORT = {"determined": "determined", "weak": "weak", "not determined": "not", "at bound": "at bound"}
_COLOURS = {
    "determined": style.GREEN,
    "weak": style.ORANGE,
    "not determined": style.VERMILION,
    "at bound": style.PURPLE,
}


@dataclass(frozen=True)
class Fits:
    """Fits of one parameter: restarts, best fit and verdict by (person, trial); the truth by person."""

    restarts: dict[tuple[str, str], list[float]]
    best: dict[tuple[str, str], float]
    truth: dict[str, float]
    verdicts: dict[tuple[str, str], str]

    @classmethod
    def read(cls, results: Path, name: str) -> Fits:
        """Read a parameter's fits from the folder of results."""
        restarts: dict[tuple[str, str], list[float]] = {}
        best: dict[tuple[str, str], tuple[float, float]] = {}
        for path in sorted((results / "fits").glob("*/*/restart-*.json")):
            fit = read_json(path, ("subject", "trial", "parameters", "cost"))
            trial = fit["subject"], fit["trial"]
            value = fit["parameters"][name]
            value = float(value["value"] if isinstance(value, dict) else value)
            restarts.setdefault(trial, []).append(value)
            best[trial] = min(best.get(trial, (np.inf, 0.0)), (fit["cost"]["J"], value))
        truth = {
            person: read_json(results / "phantom" / "sealed" / f"{person}.json")["parameters"][name]["value"]
            for person in {person for person, _ in restarts}
        }
        judged = [
            read_json(path, ("subject", "trial", "parameters"))
            for path in sorted((results / "identifiability").glob("*/*.json"))
        ]
        verdicts = {(one["subject"], one["trial"]): one["parameters"][name]["verdict"] for one in judged}
        return cls(restarts, {trial: value for trial, (_, value) in best.items()}, truth, verdicts)

    def row(self) -> dict[str, float | str]:
        """Return centre, spread between trials, spread of restarts within a trial, error against the truth."""
        ln = np.log(list(self.best.values()))
        within = [np.std(np.log(values)) for values in self.restarts.values()]
        error = [np.log(value / self.truth[person]) for (person, _), value in self.best.items()]
        return {
            "verdicts": ", ".join(
                f"{n} {_SHORT[v]}" for v, n in Counter(self.verdicts.values()).most_common()
            ),
            "centre": float(np.exp(ln.mean())),
            "spread of best (factor)": float(np.exp(ln.std(ddof=1))),
            "spread of restarts (factor)": float(np.exp(np.mean(within))),
            "off the truth (factor)": float(np.exp(np.sqrt(np.mean(np.square(error))))),
        }


def draw(
    fits: dict[str, Fits], published: dict[str, dict[str, str]], bounds: dict[str, tuple], out: Path
) -> None:
    """Draw every restart of every trial as a share of its search range, with truth and the published interval.

    The best restart of a trial has the colour of that trial's verdict, and is black where there is none.
    """
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(4.6, phantom=True)
        axes = figure.subplots()
        for y, (name, found) in enumerate(fits.items()):
            low, high = np.log(bounds[name])

            def at(value: float, low: float = low, high: float = high) -> float:
                return float((np.log(value) - low) / (high - low))

            interval = [at(number(published[name][key])) for key in ("interval_low", "interval_high")]
            axes.plot(np.clip(interval, -0.03, 1.03), [y + 0.28] * 2, color=style.GREY, linewidth=1.5)
            axes.plot(at(number(published[name]["prior"])), y + 0.28, "|", color=style.GREY, markersize=6)
            for values in found.restarts.values():
                axes.plot(
                    [at(v) for v in values], [y - 0.12] * len(values), ".", color=style.SKY, markersize=2.5
                )
            for trial, best in found.best.items():
                colour = _COLOURS.get(found.verdicts.get(trial, ""), style.BLACK)
                axes.plot(at(best), y + 0.06, "o", color=colour, markersize=3)
            axes.plot([at(v) for v in found.truth.values()], [y - 0.3] * len(found.truth), "k|", markersize=4)
        axes.set_yticks(range(len(fits)), [style.math_name(name) for name in fits])
        axes.invert_yaxis()
        axes.set_xlim(-0.04, 1.04)
        axes.set_xticks([0, 0.5, 1], ["lower\nbound", "geometric\nmiddle", "upper\nbound"])
        marks = [(c, "o", "", f"best of a trial: {v}") for v, c in _COLOURS.items()]
        marks += [
            (style.SKY, ".", "", "all restarts"),
            (style.BLACK, "|", "", "truth"),
            (style.GREY, "|", "-", "Table I"),
        ]
        handles = [Line2D([], [], color=c, marker=m, linestyle=s, label=n) for c, m, s, n in marks]
        figure.legend(handles=handles, loc="outside lower center", ncols=2)
        style.save(figure, [out])


def main() -> None:
    """Print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks/study_robot.png"))
    options = parser.parse_args()
    published = {row["parameter"]: row for row in read_table(ROOT / "resources/published/table1_priors.csv")}
    bounds = {
        row["parameter"]: (number(row["lower"]), number(row["upper"]))
        for row in read_table(ROOT / "resources/published/bounds.csv")
    }
    classes_path = options.results / "shareability" / "icc.csv"
    classes = (
        {row["parameter"]: row["class"] for row in read_table(classes_path)} if classes_path.exists() else {}
    )
    fits = {name: Fits.read(options.results, name) for name in PARAMETERS}
    rows = []
    for name, found in fits.items():
        theirs = published[name]
        rows.append(
            {
                "parameter": name,
                **found.row(),
                "class": classes.get(name, ""),
                "Table I": f"{theirs['prior']} [{theirs['interval_low']}, {theirs['interval_high']}] {theirs['class']}",
            }
        )
    table = pd.DataFrame(rows)
    print(table.to_string(index=False, float_format=lambda v: f"{v:.3g}"))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(options.out.with_suffix(".csv"), index=False)
    draw(fits, published, bounds, options.out)


if __name__ == "__main__":
    main()
