"""The foot of the report: code, packages, search and input files that the results rest on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from real2sim.pages.page import folded, paragraph, table
from real2sim.pages.report.parts import words
from real2sim.pages.report.study import Study

# Beyond so many input files each fit file holds its own, and the page their number
MANY_FILES = 400


def _distinct(values: Sequence[str]) -> str:
    return " or ".join(dict.fromkeys(values))


def provenance(study: Study) -> str:
    """Code, packages, search and input files behind the fits."""
    records = [fit["provenance"] for fit in study.identification.fits]
    packages = [", ".join(f"{name} {v}" for name, v in p["packages"].items()) for p in records]
    facts = [
        f"{len(study.identification.fits)} fits by code {_distinct([p['code_fingerprint'] for p in records])}; Python "
        f"{_distinct([p['python'] for p in records])}; {_distinct(packages)}.",
        f"Search: {_distinct([_search(fit) for fit in study.identification.fits])}.",
    ]
    inputs = {path: digest_ for p in records for path, digest_ in p["inputs_sha256"].items()}
    rows = [
        [f"<code>{escape(path)}</code>", f"<code>{digest_[:16]}</code>"]
        for path, digest_ in sorted(inputs.items())
        if len(inputs) <= MANY_FILES
    ]
    files = table(["File", "SHA-256 (first 16)"], rows, caption="Files that the fits rest on") if rows else ""
    return (
        '<footer>\n<h2 id="provenance">Provenance</h2>\n'
        + "\n".join(paragraph(text) for text in facts if study.identification.fits)
        + (folded(f"{len(rows)} input files", files) if files else "")
        + (
            paragraph(f"{len(inputs)} input files; each fit file names its own.")
            if len(inputs) > MANY_FILES
            else ""
        )
        + "\n</footer>"
    )


def _search(fit: Mapping[str, Any]) -> str:
    ident = fit["settings"]["identification"]
    if fit["method"] == "cma":
        budget = f"{ident['evaluations']} evaluations"
    else:
        own = ident["least_squares"]
        budget = f"at most {own['iterations']} iterations from the best of {own['screen']} starts"
    return (
        f"{words(fit['method'])}, {ident['restarts']} restarts of {budget}, seed {ident['seed']}, time step "
        f"{_distinct([str(fit['settings']['plant']['timestep_s'])])} s"
    )
