"""The wheel holds all that the library needs: it works where there is no checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import real2sim
from real2sim.configuration import validated
from real2sim.provenance import fingerprint

ROOT = Path(__file__).parents[2]


def _run(*command: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess:
    """Run a command with no PYTHONPATH but the given one; both streams are in ``stdout``."""
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env=kept | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build the wheel from the checkout with the installed build backend; no network is used."""
    out = tmp_path_factory.mktemp("wheel")
    options = ("--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", out)
    # a backend beside the environment's packages is found too
    done = _run("-m", "pip", "wheel", *options, ROOT, cwd=out, PYTHONPATH=os.environ.get("PYTHONPATH", ""))
    assert done.returncode == 0, f"install tests/environment-lock.txt, which has hatchling:\n{done.stdout}"
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Return the folder that the wheel is installed into."""
    target = tmp_path_factory.mktemp("installed")
    done = _run("-m", "pip", "install", "--no-deps", "--no-index", "--target", target, wheel, cwd=target)
    assert done.returncode == 0, done.stdout
    return target


@pytest.fixture
def python(installed, tmp_path):
    """Return a function that runs Python away from the checkout on the installed wheel, and its output's lines."""

    def run(*arguments: str) -> list[str]:
        done = _run(*arguments, cwd=tmp_path, PYTHONPATH=str(installed))
        assert done.returncode == 0, done.stdout
        return done.stdout.splitlines()

    return run


def test_wheel_has_every_file_of_the_package_and_the_shipped_systems(wheel):
    package = ROOT / "workflow" / "real2sim"
    sources = {
        path.relative_to(package.parent).as_posix()
        for path in package.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    shipped = {
        f"real2sim/{path.relative_to(ROOT / 'resources').as_posix()}"
        for folder in ("systems", "robot")
        for path in (ROOT / "resources" / folder).rglob("*")
        if path.is_file()
    }
    assert {"real2sim/py.typed", "real2sim/schemas/config.schema.yaml"} <= sources
    assert "real2sim/systems/strap/system.yaml" in shipped
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert held == sources | shipped


def test_version_of_the_distribution_is_the_librarys(python, wheel):
    assert wheel.name == f"phri_real2sim-{real2sim.__version__}-py3-none-any.whl"
    code = "import real2sim as r; from importlib.metadata import version as v; print(r.__version__, v('phri-real2sim'))"
    assert python("-c", code) == [f"{real2sim.__version__} {real2sim.__version__}"]


def test_installed_library_fills_in_and_refuses_configurations(python, installed):
    default, refused, place = python(
        "-c",
        "import json, real2sim.configuration as c; from pathlib import Path\n"
        "print(json.dumps(c.validated({}, 'config', Path('none'))))\n"
        "try: c.validated({'plant': {'timestep': 1}}, 'config', Path('mine.yaml'))\n"
        "except c.InputError as error: print(str(error).splitlines()[0])\n"
        "print(c.__file__)",
    )
    assert json.loads(default) == validated({}, "config", Path("none"))
    assert "mine.yaml, plant" in refused
    assert Path(place).is_relative_to(installed)


def test_shipped_strap_compiles_from_the_installed_library(python, installed):
    lines = python(
        "-c",
        "import mujoco, real2sim; from real2sim.system.description import shipped\n"
        "system = real2sim.System.from_yaml(shipped('strap') / 'system.yaml')\n"
        "print(system.model.resolve()); print(mujoco.MjModel.from_xml_path(str(system.model)).njnt)",
    )
    assert Path(lines[0]).is_relative_to(installed.resolve())
    assert int(lines[1]) == 6


def test_fingerprints_of_the_installed_library_are_the_checkouts(python):
    modules = ("real2sim.study.fit", "real2sim.study.diagnose")
    code = f"from real2sim.provenance import fingerprint; print(*map(fingerprint, {modules}))"
    assert python("-c", code) == [" ".join(map(fingerprint, modules))]


def test_both_command_lines_of_the_installed_library_list_the_commands(installed, tmp_path):
    for command in (("-m", "real2sim"), (installed / "bin" / "real2sim",)):
        done = _run(*command, cwd=tmp_path, PYTHONPATH=str(installed))
        assert done.returncode == 2
        assert "cross-trial" in done.stdout
        helped = _run(*command, "fit", "--help", cwd=tmp_path, PYTHONPATH=str(installed))
        assert helped.returncode == 0, helped.stdout
        assert "--settings" in helped.stdout


def test_import_of_the_library_loads_no_numerical_package(python):
    heavy = ("numpy", "scipy", "pandas", "mujoco", "matplotlib", "yaml", "jsonschema", "snakemake")
    code = f"import sys, real2sim, real2sim.__main__; print([m for m in {heavy} if m in sys.modules])"
    assert python("-c", code) == ["[]"]


def test_every_public_name_exists_and_others_are_refused():
    assert all(getattr(real2sim, name) is not None for name in real2sim.__all__)
    assert set(real2sim.__all__) <= set(dir(real2sim))
    with pytest.raises(AttributeError, match="Sytem"):
        _ = real2sim.Sytem


def test_no_module_looks_for_the_folders_of_a_checkout():
    """Only `shipped` may look outside the package: in a checkout the systems are in resources/."""
    found = [
        path.relative_to(ROOT).as_posix()
        for path in sorted((ROOT / "workflow" / "real2sim").rglob("*.py"))
        if "__file__" in path.read_text(encoding="utf-8")
    ]
    assert found == [
        "workflow/real2sim/configuration.py",
        "workflow/real2sim/provenance.py",
        "workflow/real2sim/system/description.py",
    ]


@pytest.mark.long
def test_a_system_of_two_joints_described_away_from_the_checkout_is_diagnosed(installed, tmp_path):
    """Dry friction in the elbow of an arm is named; the description is short."""
    script = ROOT / "tests" / "unit" / "two_joint_system.py"
    text = script.read_text(encoding="utf-8")
    described = text[text.index("# description begins") : text.index("# description ends")]
    assert len(described.splitlines()) - 1 <= 40
    done = _run(script, cwd=tmp_path, PYTHONPATH=str(installed))
    assert done.returncode == 0, done.stdout
    verdict, probability = json.loads(done.stdout.splitlines()[-1])
    assert verdict == "coulomb"
    assert probability > 0.9
