"""What the documents promise is what is there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    "script",
    [
        "make_config_reference.py",
        "make_system_reference.py",
        "make_settings.py",
        "make_validation_tables.py",
    ],
)
def test_what_a_script_makes_is_current(script):
    done = subprocess.run([sys.executable, ROOT / "docs" / script, "--check"], check=False)
    assert done.returncode == 0, f"run: python docs/{script}"


def test_ci_runs_the_readmes_test_command():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = re.findall(r"```sh\n(.+?)\n```", readme, re.S)
    assert len(commands) >= 2
    assert "snakemake --cores 2" in commands[0]
    assert "pytest" in commands[1]
    assert commands[1] in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        "config/README.md",
        "docs/assumptions.md",
        "docs/library.md",
        "docs/measured-law.md",
        "examples/README.md",
        "docs/troubleshooting.md",
        "docs/decisions/README.md",
        *sorted(f"docs/decisions/{path.name}" for path in (ROOT / "docs" / "decisions").glob("0*.md")),
    ],
)
def test_links_of_a_page_lead_somewhere(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", text) + re.findall(r'src="([^"]+)"', text):
        if "://" not in target:
            assert (ROOT / page).parent.joinpath(target).exists(), f"{page} links to {target}"


def _keys(schema: dict, place: str = "") -> dict[str, str]:
    """Every key of a schema by its path, with its description."""
    out = {}
    for key, sub in schema.get("properties", {}).items():
        out[f"{place}{key}"] = sub.get("description", "")
        out |= _keys(sub, f"{place}{key}.")
    return out


def test_every_assumption_is_explained_by_a_key_that_exists():
    keys = _keys(
        yaml.safe_load(
            (ROOT / "workflow" / "real2sim" / "schemas" / "config.schema.yaml").read_text(encoding="utf-8")
        )
    )
    page = (ROOT / "docs" / "assumptions.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([a-z]+(?:\.[a-zA-Z_0-9]+)+)`", page)) - {"config.yaml"}
    assert len(named) > 30
    assert not sorted(named - keys.keys()), "keys that do not exist"
    assumed = {key for key, words in keys.items() if "assumed" in words.lower()}
    explained = {key for key in assumed if any(key == n or key.startswith(f"{n}.") for n in named)}
    # the robot's two groups stand under their own names
    assert assumed - explained <= {"robot"}, sorted(assumed - explained)


def test_no_registry_host_is_named():
    # built from parts, so that this file does not name them either
    hosts = [".".join(parts) for parts in (("pypi", "org"), ("files", "pythonhosted"), ("registry", "npmjs"))]
    tracked = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    ).stdout.split()
    for name in tracked:
        path = ROOT / name
        if path.is_file() and path.suffix not in (".png", ".pdf", ".gif"):
            text = path.read_text(encoding="utf-8", errors="ignore")
            assert not any(host in text for host in hosts), name


def test_prose_is_wrapped():
    """Lines of prose have at most 120 characters; tables, code and pictures may be longer."""
    pages = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True)
    long = []
    for page in pages.stdout.split():
        fenced = False
        for number, line in enumerate((ROOT / page).read_text(encoding="utf-8").splitlines(), 1):
            fenced ^= line.startswith("```")
            free = fenced or line.startswith(("|", "    ", "![", "<img"))
            if not free and len(line) > 120:
                long.append(f"{page}:{number}")
    assert long == []


def test_the_worked_example_takes_an_answers_numbers_and_no_other_words():
    sys.path.insert(0, str(ROOT / "docs"))
    from make_example import updated

    block = '{"a 1": [1.5, "... 2 more"], "verdict": "slack", "equation": "F = k ...", "n": {"x": 2, "...": "3 more"}}'
    told = {"a 1": [0.123456, 7, 8], "verdict": "slack", "equation": "F = k q + c", "n": {"x": 30, "y": 4}}
    assert updated(block, told) == block.replace("1.5", "0.12346").replace('"x": 2', '"x": 30')
    with pytest.raises(ValueError, match="verdict: 'coulomb'"):
        updated(block, told | {"verdict": "coulomb"})
    with pytest.raises(KeyError):
        updated(block, {key: value for key, value in told.items() if key != "n"})
