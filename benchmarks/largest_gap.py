"""How large a gap each effect can make: J of the plain fit, refitted, with the effect at its largest published size.

    python benchmarks/largest_gap.py [--draws 6] [--out results/benchmarks]

The person moves as in the phantom's dynamic trials. An effect's largest size is the largest magnitude that is published
or that the trial carries (docs/effects.md). The paper's J is 1.28. Prints an effect per row, the largest J of its draws
on the fitted and on the held-out trial, without noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from real2sim.configuration import validated
from real2sim.verification.cohort.plan import read_settings
from real2sim.verification.cohort.write import prepare
from real2sim.verification.phantom.person import draw_person, stream
from real2sim.verification.phantom.physics import Robot, robot_controller
from real2sim.verification.suite.forms import FORMS
from real2sim.verification.suite.gaps import gaps
from real2sim.verification.suite.plan import EFFECTS, Case
from real2sim.verification.suite.synthetic import Applied, Synthetic, World, about_of, describe, linearise

ROOT = Path(__file__).parents[1]
ROBOT = ROOT / "resources" / "robot" / "drba.xml"
TRIALS = ("neutral", "dynamic_1", "dynamic_2")
STEP_S, REFITS, DURATION_S = 0.0025, 4, 20.0
# Simulations side by side
_BATCH = 60


def synthetic(settings: dict, controllers: dict, name: str, robot: Robot) -> Synthetic:
    """Return a person of the phantom with neutral and dynamic trials."""
    person = draw_person(settings, name, float(robot.rest_middle(np.zeros(6))[1][2]))
    start = np.zeros(6)
    trials = {trial: prepare(settings, person, robot, trial, start) for trial in TRIALS}
    return Synthetic(
        Case(name, "gap", (), None),
        person,
        settings,
        {name: trial.motion for name, trial in trials.items()},
        {name: trial.path for name, trial in trials.items()},
        dict.fromkeys(TRIALS, start),
        {name: robot_controller(settings, controllers, "dynamic", start) for name in TRIALS},
        None,
        (1.0, 1.0),
        [],
    )


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=6, help="draws of an effect: its axes, signs and shape")
    parser.add_argument("--people", nargs="+", default=["S01", "S03"])
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "benchmarks")
    options = parser.parse_args()
    settings = read_settings(ROOT / "config" / "phantom.yaml")
    settings["trials"]["dynamic_s"] = DURATION_S
    controllers = validated({}, "config", Path("defaults"))["robot"]
    robot = Robot(ROBOT, STEP_S)
    about = {"seed": settings["seed"], "parameters": settings["parameters"], "severity": {"refits": REFITS}}
    world = World(about, settings, robot, robot)
    people = [synthetic(settings, controllers, name, robot) for name in options.people]
    describe(world, people)
    linearise(world, people)
    asked: list[tuple[str, Synthetic, Applied]] = []
    for name in EFFECTS:
        form = FORMS[name]
        for i in range(options.draws):
            p = people[i % len(people)]
            draw = form.draw(stream(settings, p.person.name, name, str(i)), about_of(p))
            asked.append((name, p, [(form, form.values(draw, 1.0, about_of(p)))]))
    rows = []
    for start in range(0, len(asked), _BATCH):
        some = asked[start : start + _BATCH]
        fits = gaps(world, [p for _, p, _ in some], [effects for *_, effects in some])
        for (name, p, _), fit in zip(some, fits, strict=True):
            costs = [float(r @ r) if fit.usable else np.nan for r in (fit.train, fit.held_out)]
            rows.append(
                {"effect": name, "person": p.person.name, "j_fitted": costs[0], "j_held_out": costs[1]}
            )
        print(f"{start + len(some)} of {len(asked)}", flush=True)
    table = pd.DataFrame(rows)
    options.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(options.out / "largest_gap.csv", index=False)
    largest = (
        table.groupby("effect")[["j_fitted", "j_held_out"]].max().sort_values("j_fitted", ascending=False)
    )
    print(largest.round(3).to_string())


if __name__ == "__main__":
    main()
