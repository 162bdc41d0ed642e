"""Write the causes that `snakemake paper_gap` ranked as the record that the report shows.

    python -m benchmarks.ship_paper_gap results/paper_gap/causes.json

Writes resources/paper_gap/causes.json with the commit and the day. Refuses a checkout that has changed files, because
its commit would not say which code gave the numbers.
"""

from __future__ import annotations

import argparse
import datetime
import sys
from pathlib import Path

from real2sim.artefacts import read_json, write_json

from benchmarks.ship_validation import git

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Write the record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("record", type=Path)
    parser.add_argument("--out", type=Path, default=ROOT / "resources" / "paper_gap" / "causes.json")
    options = parser.parse_args()
    folder = options.record.resolve().parent
    if changed := git(folder, "status", "--porcelain", "--untracked-files=no"):
        sys.exit(f"{options.record}: the checkout has changed files:\n{changed}\nRun in a clean clone.")
    record = read_json(options.record, ("causes", "published"))
    made = datetime.date.fromtimestamp(options.record.stat().st_mtime).isoformat()
    write_json(options.out, record | {"commit": git(folder, "rev-parse", "--short", "HEAD"), "date": made})
    print(options.out)


if __name__ == "__main__":
    main()
