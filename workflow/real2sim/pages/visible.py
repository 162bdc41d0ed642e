"""What a record without a cause could have shown: a table of the smallest sizes on the page of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from real2sim.pages.page import paragraph, rounded, section, table


def visible_section(
    entries: Sequence[Mapping[str, Any]] | None, shown: Mapping[str, tuple[float, str]]
) -> list[str]:
    """Return the section of ``could_show`` of diagnosis.json, nothing without one.

    ``shown`` maps SI units to a factor and the unit that a person reads.
    """
    if not entries:
        return []
    rows, invisible = [], []
    for entry in entries:
        name = entry["effect"].replace("_", " ")
        place = ", ".join(entry["axes"])
        if entry["from"] is None:
            invisible.append(f"{name} {place}".strip() + f" ({entry['parameter'].replace('_', ' ')})")
            continue
        factor, unit = shown.get(entry["unit"], (1.0, entry["unit"]))
        value = rounded(factor * entry["from"], 2)
        parameter = entry["parameter"].replace("_", " ")
        rows.append([escape(name), escape(parameter), escape(place), value, escape(unit)])
    text = (
        "No cause is named, which says that none of these was larger: each would have been told from none in 95 of 100 "
        "such records, by a calculation on the plain model. Smaller ones may be there."
    )
    parts = [paragraph(text)]
    parts.append(
        table(
            ["Effect", "Size", "Axis", "Seen from", "Unit"],
            rows,
            caption="Smallest size that these two trials would have shown, one effect at a time",
            numeric=(3,),
        )
    )
    if invisible:
        parts.append(
            paragraph(
                f"These do not show at any size that is searched: {'; '.join(invisible)}. Stiffness, damping or the "
                "pose at the start take up what they do."
            )
        )
    return [section("visible", "What these trials could have shown", *parts)]
