"""Write docs/rules.md: which rule needs which, as a picture, and what each does.

python docs/make_rule_graph.py [--check]
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "rules.md"
TARGETS = ("all", "diagnosis", "motion", "twin", "suite")
HEAD = """# The rules

Made by `docs/make_rule_graph.py` from the Snakefile of the phantom cohort. What needs what, per target; a rule that
runs once per person or trial stands once, and what follows from a longer way is left out. Of your own study:
`snakemake --rulegraph | dot -Tsvg > rules.svg`.
"""


def graph(target: str) -> dict[str, set[str]]:
    """Rules that each rule feeds, those of single people under one name."""
    command = [
        sys.executable,
        "-m",
        "snakemake",
        "--cores",
        "1",
        "--rulegraph",
        "mermaid-js",
        "--forceall",
        "--",
        target,
    ]
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    names = {
        key: re.sub(r"_(S\d+|\d+|[a-z]+-\d+)$", "", name)
        for key, name in re.findall(r"^\s*(id\d+)\[(.+)\]$", done.stdout, re.M)
    }
    out: dict[str, set[str]] = {name: set() for name in names.values()}
    for start, end in re.findall(r"^\s*(id\d+) --> (id\d+)$", done.stdout, re.M):
        if names[start] != names[end]:
            out[names[start]].add(names[end])
    return out


def reachable(edges: dict[str, set[str]], start: str) -> set[str]:
    """Everything that a rule feeds, through others too."""
    seen: set[str] = set()
    todo = list(edges.get(start, ()))
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += edges.get(name, ())
    return seen


def reduced(edges: dict[str, set[str]]) -> dict[str, set[str]]:
    """Without the edges that a longer way makes plain."""
    return {
        name: {e for e in ends if not any(e in reachable(edges, other) for other in ends - {e})}
        for name, ends in edges.items()
    }


def docstrings() -> dict[str, tuple[str, str]]:
    """First line of the docstring and the stage of each rule, in the order of the files."""
    out = {}
    for path in sorted((ROOT / "workflow" / "rules").glob("*.smk")):
        text = path.read_text(encoding="utf-8")
        blocks = re.split(r"^(?=\s*rule\b)", text, flags=re.M)[1:]
        for block in blocks:
            name = re.match(r"\s*rule\s*(\w*)", block)
            doc = re.search(r'"""(.+?)(?:\n|""")', block)
            label = name[1] if name and name[1] else _generated(block)
            if doc:
                out[label] = (path.stem, doc[1].strip())
    return out


def _generated(block: str) -> str:
    """Name of a rule that a loop makes, from its benchmark's folder."""
    found = re.search(r"name:\s*f?\"([a-z_]+?)_?\{", block)
    return found[1] if found else "all"


def page() -> str:
    """The whole page."""
    words = docstrings()
    parts = [HEAD]
    known: set[str] = set()
    for target in TARGETS:
        edges = reduced(graph(target))
        lines = [
            f"    {a} --> {b}"
            for a in sorted(edges)
            for b in sorted(edges[a])
            if not {a, b} <= known or b == target
        ]
        title = "The study" if target == "all" else f"`snakemake {target}`"
        parts.append(f"## {title}\n\n```mermaid\nflowchart TB\n" + "\n".join(lines) + "\n```\n")
        known |= edges.keys()
    table = [f"| `{name}` | {stage} | {doc} |" for name, (stage, doc) in words.items()]
    parts.append("## What each does\n\n| rule | stage | |\n|---|---|---|\n" + "\n".join(table) + "\n")
    return "\n".join(parts)


def main() -> int:
    """Write the page, or with --check say whether it is current."""
    made = page()
    if "--check" in sys.argv:
        return 0 if PAGE.exists() and made == PAGE.read_text(encoding="utf-8") else 1
    PAGE.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
