"""The examples: that of one axis runs; of the others the options are parsed."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def _load(name: str):
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_example_of_one_axis_names_the_friction_and_writes_a_model(tmp_path):
    answer = _load("emps").main(["--duration", "4", "--out", str(tmp_path)])
    assert answer.verdict == "coulomb"
    assert {"diagnosis.json", "traces.png", "model.xml"} <= {path.name for path in tmp_path.iterdir()}
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    friction = answer.answer.causes[0].parameters["force_x_N"]["value"]
    assert model.dof_frictionloss[0] == pytest.approx(friction, rel=1e-9)


@pytest.mark.parametrize("name", ["cuff", "drba", "emps", "strap"])
def test_options_of_an_example_are_parsed(name):
    module = _load(name)
    assert module.parser.parse_args([]).out == Path("results/examples") / name
    assert 20 <= len((EXAMPLES / f"{name}.py").read_text(encoding="utf-8").strip().splitlines()) <= 45
    with pytest.raises(SystemExit):
        module.parser.parse_args(["--no-such-option"])
