"""Parts that sections of the report are made of: figures, files to take away, cells of tables."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from real2sim.artefacts import number
from real2sim.pages.page import download, folded, inline, percent, rounded
from real2sim.pages.report.study import Row, Study, Table
from real2sim.pages.style import NAMED_PEOPLE

# Beyond so many people the page tells of all together; rows of single ones are folded away or left to the tables
MANY_PEOPLE = 40


DASH = "\N{EN DASH}"


# By the name of the figure's file: title; what to see in it, what it shows with units, its place in the paper
FIGURES = {
    "gap": (
        "The gap of everyone",
        "The further right a circle, the larger the gap; the nearer its diamond to the dashed line, the more of it is "
        "explained. Chi-squared per residual (no unit, logarithmic) of the held-out trial, or of the fitted one where "
        "that alone shows the gap (marked *): circle, the plain model of strap and robot; diamond, the same with the "
        "diagnosed cause or, where that is unknown, the measured law in it, open where a cause carries the misfit mark:"
        " more than noise is left beside it; dashed, what noise alone leaves, 1. At the dashed line there is no gap to "
        "explain, and the answer is none. In brackets: the probability of the answer.",
    ),
    "paper_gap": (
        "Causes beside the paper",
        "The further left a cause, the more of the paper's numbers its cohort comes near; filled circles cannot be "
        "told from the nearest. By how much the cohort of each cause misses what the paper prints, over what causes "
        "usually miss it by (no unit), nearest at the top. Circle: the five people; bar: 90 % of resamples of them.",
    ),
    "tightness": (
        "Tightness sweep",
        "The slopes say how much motion a further tightening takes away before the knee and beyond it. Allowable "
        "motion against normalised tightness (no unit; 0 is the selected level, positive is tighter). (a, b) Range of"
        " translation in mm. (c) Range of pelvic rotation of either side in deg, with the pooled two-segment "
        "regression, its slopes in deg per unit of normalised tightness, and the knee with its interval (grey band). Of"
        " few people, the band holds the true knee less often than it says (docs/statistics.md). Paper: Fig. 3.",
    ),
    "convergence": (
        "Convergence",
        "A best curve that is flat at its end has converged; restarts that end there too agree on the minimum, and "
        "one that ends on the dashed line leaves nothing but noise. Best cost J so far (no unit, logarithmic) against"
        " cost evaluations, a row per person and a column per dynamic trial; restarts grey, the best one blue. "
        "Dashed: what measurement noise alone costs, from the person's neutral trial. Paper: Fig. 4, top.",
    ),
    "icc": (
        "Shareability",
        "A parameter that is low in (a), and whose fits lie together in (b) whoever they are of, is shared; one that "
        "is high in (a), and whose fits lie together only person by person, is a person's own. (a) ICC(1,1) (no unit)"
        " of each parameter with the cluster bootstrap's percentile interval and the exact F interval; zones are the "
        "class limits. (b) Every fit over the geometric mean of all (no unit, logarithmic), shaded by class, whose "
        "first letter stands at the right. Paper: Fig. 4, middle.",
    ),
    "coverage": (
        "What the intervals are worth",
        "An interval is worth what it says where its curve lies at 95 %. Simulated cohorts with a known ICC: how "
        "often each method's 95 % interval holds it, against people, and how often a truly common and a truly "
        "distinct parameter are classed right (shares, no unit). Simulation, no measurement and no phantom.",
    ),
    "loso": (
        "Leave one subject out",
        "Where an overhead is near zero, the prior of the others serves a person as well as their own fit. What the "
        "prior of the others costs the person left out: overhead over their own best fit in %, for cost J and for "
        f"position RMSE. Bars: each person. Curves, of more than {NAMED_PEOPLE} people: the share whose overhead is at "
        "most so much. Paper: Fig. 4, bottom, and eq. 7.",
    ),
    "interface": (
        "Interface while walking",
        "An ellipse as large and as long as the measured one says that the simulated strap lets a person move as the "
        "real one does. Where the interface midpoint goes relative to the pelvis, from above (mm), while walking with"
        " the robot: measured, and simulated under every interface (first seed), with 95 % ellipses; γ is the ratio "
        "of the spreads forward and to the side. Paper: Fig. 5.",
    ),
    "gait": (
        "Gait",
        "The robot moves the simulated curves the same way as the measured ones, and as far, where the simulated "
        "person adapts as the real one does. Hip, knee and ankle angle (deg) over the gait cycle (%), measured and "
        "simulated, with and without the robot; mean and SD over cycles, first seed. (g) What the robot changes in "
        "the range of motion (deg), a point per seed. Paper: Fig. 6.",
    ),
    "speed": (
        "Speed or strap",
        "Changes on the line come from walking slower; what lies off it is the strap. Change of the range of motion "
        "(deg) of hip and knee against the change of walking speed (%): a point per strap, cap, robot and seed, "
        "filled where the simulated person takes up the speed that the robot allows. The line is the same person as "
        "slow without a robot.",
    ),
    "wrench": (
        "Force of the strap",
        "Peaks as high and as early as the logged ones say that stiffness and damping found from motion also tell "
        "force. Force (N) and torque (Nm) of the strap on the robot's interface over the gait cycle (%), where a "
        "sensor logged them and as the simulated strap exerts them without its stops; mean over strides, first seed.",
    ),
}


def downloads(*tables: Table) -> str:
    """The tables behind a section, to take away."""
    links = [download(table.path.name, table.path.read_bytes(), "text/csv") for table in tables]
    return f'<p class="small tools">All numbers: {", ".join(links)}</p>'


def figure(study: Study, name: str) -> str:
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


def value_cell(text: str, digits: int = 3) -> str:
    """A number of a table's cell, rounded; a dash for an empty cell."""
    return rounded(number(text), digits) if text else DASH


def percent_cell(text: str) -> str:
    """The same of a number in percent."""
    return percent(number(text) / 100, 1) if text else DASH


def interval_cell(low: str, high: str) -> str:
    """An interval in brackets; nothing where neither end is known."""
    return f"[{value_cell(low)}, {value_cell(high)}]" if low or high else ""


def joined(names: Sequence[str]) -> str:
    """Names with commas, or the word none."""
    return ", ".join(names) if names else "none"


def rows_of(rows: Sequence[Row], **wanted: str) -> list[Row]:
    """Rows whose columns hold the wanted texts."""
    return [row for row in rows if all(row[column] == text for column, text in wanted.items())]


def by_subject(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of each person, in the order in which people come."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(row["subject"], []).append(row)
    return out


def one_by_one(study: Study, markup: str) -> str:
    """A table with a row per person, folded away where there are many."""
    people = len(study.people)
    return folded(f"{people} people, one by one", markup) if people > MANY_PEOPLE else markup


def row_of(rows: Sequence[Row], name: str) -> Row | None:
    """First row of a person, None without one."""
    return next((row for row in rows if row["subject"] == name), None)


def words(name: str) -> str:
    """A name of the code as words."""
    return name.replace("_", " ")
