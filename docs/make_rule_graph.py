"""Write docs/rules.md: which rule needs which, as a picture, what each does, and which settings it reads.

python docs/make_rule_graph.py [--check]
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "rules.md"
TARGETS = ("all", "diagnosis", "motion", "twin", "suite", "paper_gap")
# asked for by name: one job of one rule, whose picture would say nothing
FURTHER = ("results/twin/S06/twin.gif",)
PLANNING = "(planning)"
HEAD = """# The rules

Made by `docs/make_rule_graph.py` from the Snakefile of the phantom cohort. What needs what, per target; a rule that
runs once per person or trial stands once, and what follows from a longer way is left out. Of your own study:
`snakemake --rulegraph | dot -Tsvg > rules.svg`.
"""
SETTINGS = """## Which settings each reads

Keys of `config/config.yaml` ([what they mean](../config/README.md#keys)); a section stands for all keys in it. A rule
runs again where one of its keys has changed. `(planning)`: what decides which jobs there are. Rules that are not listed
read files alone. A suite's cases also read the file that `suite` names.

| rule | keys |
|---|---|
"""


def graph(target: str) -> dict[str, set[str]]:
    """Rules that each rule feeds, those of single people under one name."""
    shown = _snakemake("--rulegraph", "mermaid-js", "--forceall", "--", target)
    names = {key: _without_person(name) for key, name in re.findall(r"^\s*(id\d+)\[(.+)\]$", shown, re.M)}
    out: dict[str, set[str]] = {name: set() for name in names.values()}
    for start, end in re.findall(r"^\s*(id\d+) --> (id\d+)$", shown, re.M):
        if names[start] != names[end]:
            out[names[start]].add(names[end])
    return out


def _snakemake(*options: str) -> str:
    """Return what Snakemake writes to the standard output."""
    command = [sys.executable, "-m", "snakemake", "--cores", "1", *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def _without_person(name: str) -> str:
    """Return a rule's name without the person or number that a loop adds."""
    return re.sub(r"_(S\d+|\d+|[a-z]+-\d+)$", "", name)


def settings_read() -> dict[str, list[str]]:
    """Return the keys of config/config.yaml that each rule passes to its command, and those that plan the run.

    Taken from the commands of a dry run, so that it is what a job gets.
    """
    study, phantom = (
        yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text(encoding="utf-8"))
        for name in ("config", "phantom")
    )
    out: dict[str, set[str]] = {PLANNING: set(_planned_with(study))}
    for target in (*TARGETS, *FURTHER):
        # the workflow's own profile hides the commands
        shown = _snakemake("-n", "-p", "--forceall", "--workflow-profile", "none", "--", target)
        for job in re.split(r"^(?=(?:local)?rule \w+:)", shown, flags=re.M)[1:]:
            name = _without_person(re.match(r"(?:local)?rule (\w+):", job)[1])
            command = re.search(r"^Shell command: (.+?)(?=^\[|^$|\Z)", job, re.M | re.S)
            words = shlex.split(command[1]) if command else []
            for option, value in pairwise(words):
                if option == "--settings":
                    given = json.loads(value)
                    whole = phantom.keys() <= given.keys()
                    keys = ["config/phantom.yaml"] if whole else _keys_of(given, study)
                    out.setdefault(name, set()).update(keys)
    # a dry run lists jobs in no order that lasts; the rules' files have one
    order = list(docstrings())
    ordered = sorted(out, key=lambda name: (order.index(name) if name in order else -1, name))
    return {name: sorted(out[name]) for name in ordered if out[name]}


def _planned_with(study: dict[str, Any]) -> Iterator[str]:
    """Yield the keys that the rules themselves look up."""
    text = "".join(p.read_text(encoding="utf-8") for p in sorted((ROOT / "workflow" / "rules").glob("*.smk")))
    # what is passed on to a command plans nothing
    text = re.sub(r"json\.dumps\((?:[^()]|\([^()]*\))*\)", "", text)
    for section, key in re.findall(r'(?:STUDY|study)\["(\w+)"\](?:\["(\w+)"\])?', text):
        if key or not isinstance(study[section], dict):
            yield f"{section}.{key}" if key else section


def _keys_of(given: dict[str, Any], study: dict[str, Any]) -> Iterator[str]:
    """Yield the keys of the configuration that settings of a command were taken from."""
    sections = {name: content for name, content in study.items() if isinstance(content, dict)}
    for name, content in sections.items():
        # one section without its name
        if given.keys() <= content.keys():
            yield from _parts(name, given, content)
            return
    for key, value in given.items():
        if key in sections:
            yield from _parts(key, value, sections[key])
        else:
            yield from [key] if key in study else [f"{n}.{key}" for n, c in sections.items() if key in c]


def _parts(name: str, given: dict[str, Any], content: dict[str, Any]) -> list[str]:
    """Return a section's name where all of it is given, else the keys that are."""
    return [name] if given.keys() >= content.keys() else [f"{name}.{key}" for key in given]


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
        blocks = re.split(r"^(?=\s*(?:use )?rule\b)", text, flags=re.M)[1:]
        for block in blocks:
            # one that is made of another has the second name
            name = re.match(r"\s*(?:use rule \w+ as|rule)\s*(\w*)", block)
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
    rows = [f"| `{name}` | {', '.join(f'`{k}`' for k in keys)} |" for name, keys in settings_read().items()]
    parts.append(SETTINGS + "\n".join(rows) + "\n")
    return "\n".join(parts)


def main() -> int:
    """Write the page, or with --check say whether it is current."""
    made = page()
    if "--check" in sys.argv:
        if PAGE.exists() and made == PAGE.read_text(encoding="utf-8"):
            return 0
        print(f"{PAGE.relative_to(ROOT)} is not what {Path(__file__).name} writes: run it", file=sys.stderr)
        return 1
    PAGE.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
