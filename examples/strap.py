"""Identify the strap of a phantom person: recordings by Snakemake, then the fit that its rule calls.

python examples/strap.py [--subject S02] [--evaluations 220] [--out FOLDER]      from the root of a checkout
"""

import argparse
import subprocess
from pathlib import Path

import matplotlib.pyplot as plt
from real2sim.artefacts import read_json
from real2sim.configuration import validated
from real2sim.study.fit import best_of, fit_trial

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--subject", default="S02", help="of config/phantom.yaml")
parser.add_argument("--evaluations", type=int, default=220, help="simulations of a restart")
parser.add_argument("--out", type=Path, default=Path("results/examples/strap"))


def main(arguments: list[str] | None = None) -> dict:
    """Write restart-1.json, restart-2.json and parameters.png; return the better restart."""
    options = parser.parse_args(arguments)
    limits, step = (Path(f"results/{kind}/{options.subject}.json") for kind in ("limits", "plant"))
    # recordings, canonical tables, joint limits and time step; what is there already is kept
    subprocess.run(["snakemake", "--cores", "1", str(step)], check=True)
    changed = {"identification": {"evaluations": options.evaluations}}
    settings = validated(changed, "config", Path(__file__))
    trial = Path("results/trials") / options.subject / "dynamic_1"
    tables = {"pose": trial / "pose.parquet", "markers": trial / "markers.parquet"}
    out = [options.out / f"restart-{i}.json" for i in (1, 2)]
    about = {"subject": options.subject, "trial": "dynamic_1", "restarts": [1, 2], "settings": settings}
    fit_trial(**about, **tables, limits=limits, step=step, robot=Path("resources/robot/drba.xml"), out=out)
    best = best_of([read_json(path, ("parameters", "cost")) for path in out])
    figure, axes = plt.subplots()
    axes.barh(list(best["parameters"]), list(best["parameters"].values()))
    axes.set(xscale="log", xlabel="fitted value [N/m, Nm/rad, Ns/m, Nms/rad]", title=options.subject)
    figure.savefig(options.out / "parameters.png", dpi=150)
    print(f"J {best['cost']['J']:.4f}", *(f"{k} {v:.4g}" for k, v in best["parameters"].items()), sep="\n")
    return best


if __name__ == "__main__":
    main()
