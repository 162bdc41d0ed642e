"""Lines of a score's target table: shares with Wilson's interval, other figures without."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from statsmodels.stats.proportion import proportion_confint

Row = dict[str, Any]


def claim(name: str, hits: Sequence[bool], target: str, met: Callable[[float], bool] | None) -> Row:
    """Return one line of the target table: a share with its Wilson interval.

    ``met`` says of the share whether it meets the target; it is None where there is no target.
    """
    n = len(hits)
    if n == 0:
        return figure(name, None, 0, target, met)
    count = int(np.sum(hits))
    low, high = proportion_confint(count, n, method="wilson")
    return {
        "claim": name,
        "value": count / n,
        "n": n,
        "wilson95": [float(low), float(high)],
        "target": target,
        "met": None if met is None else bool(met(count / n)),
    }


def figure(name: str, value: float | None, n: int, target: str, met: Callable[[float], bool] | None) -> Row:
    """Return one line of the target table: a number without an interval, which misses its target where it is None.

    So does one of no case at all (``n`` is 0), whatever its value.
    """
    value = value if n else None
    reached = None if met is None else value is not None and bool(met(value))
    return {"claim": name, "value": value, "n": n, "wilson95": None, "target": target, "met": reached}


def print_table(rows: Sequence[Row]) -> None:
    """Print the target table, one claim a line."""
    width = max((len(row["claim"]) for row in rows), default=0)
    for row in rows:
        share = row["wilson95"] is not None or "%" in row["target"]
        value = (
            "-" if row["value"] is None else f"{100 * row['value']:.1f} %" if share else f"{row['value']:.3g}"
        )
        between = (
            ""
            if row["wilson95"] is None
            else "[" + ", ".join(f"{100 * x:.1f}" for x in row["wilson95"]) + "]"
        )
        mark = {None: "", True: "met", False: "missed"}[row["met"]]
        print(
            f"{row['claim']:<{width}}  {value:>8} {between:<14} n {row['n']:<4} {mark:<6} ({row['target']})"
        )
