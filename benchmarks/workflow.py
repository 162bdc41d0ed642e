"""How long does the whole line take, and how much memory does a job need?

    python benchmarks/workflow.py --configfile config/quick.yaml
    python benchmarks/workflow.py

Clones the tree into a fresh folder, times the dry run and the run on 2 cores, and reads the peak memory of each job
from Snakemake's own benchmark files.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
TREE = ("Snakefile", "workflow", "config", "resources", "profiles", "environment-lock.txt")


def clone(folder: Path) -> None:
    for name in TREE:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, folder / name)


def timed(folder: Path, *arguments: str) -> float:
    start = time.monotonic()
    command = [sys.executable, "-m", "snakemake", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stdout[-4000:] + done.stderr[-4000:])
    return time.monotonic() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--configfile", type=Path)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="keep the clone here")
    options = parser.parse_args()
    temporary = Path(tempfile.mkdtemp())
    folder = options.folder or temporary / "clone"
    folder.mkdir(parents=True, exist_ok=True)
    clone(folder)
    extra = ["--configfile", str(options.configfile)] if options.configfile else []
    print(f"dry run of a clean clone: {timed(folder, '-n', '--quiet', 'all', *extra):.1f} s")
    whole = timed(folder, "--cores", str(options.cores), *extra)
    print(f"whole line on {options.cores} cores: {whole / 60:.1f} min")
    peaks: dict[str, list[tuple[float, float]]] = {}
    for path in sorted((folder / "logs" / "benchmarks").rglob("*.tsv")):
        stage = path.relative_to(folder / "logs" / "benchmarks").parts[0].removesuffix(".tsv")
        with path.open() as stream:
            for row in csv.DictReader(stream, delimiter="\t"):
                rss = float(row["max_rss"]) if row["max_rss"] not in ("-", "NA") else 0.0
                peaks.setdefault(stage, []).append((float(row["s"]), rss))
    print(f"{'stage':14s} {'jobs':>5s} {'seconds':>9s} {'longest':>9s} {'peak MB':>9s}")
    for stage, jobs in peaks.items():
        seconds = [s for s, _ in jobs]
        print(
            f"{stage:14s} {len(jobs):5d} {sum(seconds):9.1f} {max(seconds):9.1f} {max(r for _, r in jobs):9.0f}"
        )
    shutil.rmtree(temporary)


if __name__ == "__main__":
    main()
