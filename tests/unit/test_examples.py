"""The examples of one axis and of the cuff run; of the others the options are parsed."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest
import real2sim
from real2sim.verification.systems import one_axis

from tests.conftest import SHORT_SEARCH

EXAMPLES = Path(__file__).parents[2] / "examples"


def _load(name: str):
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def short_search(monkeypatch):
    """Let the examples search less."""
    diagnose = real2sim.diagnose

    def shorter(*about, settings=None, **recordings):
        own = (settings or {}).get("diagnosis", {})
        return diagnose(*about, settings={"diagnosis": {"search": SHORT_SEARCH} | own}, **recordings)

    monkeypatch.setattr(real2sim, "diagnose", shorter)


@pytest.mark.usefixtures("short_search")
@pytest.mark.parametrize(
    ("name", "duration_s", "verdict"),
    [("emps", 5.0, "coulomb"), pytest.param("cuff", 4.0, "slack", marks=pytest.mark.long)],
)
def test_an_example_names_what_it_simulates_and_writes_a_model(name, duration_s, verdict, tmp_path):
    answer = _load(name).main(["--duration", str(duration_s), "--out", str(tmp_path)])
    assert answer.verdict == verdict
    assert answer.probabilities[verdict] > 0.5
    assert {"diagnosis.json", "traces.png", "model.xml"} <= {path.name for path in tmp_path.iterdir()}
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    mujoco.mj_step(model, mujoco.MjData(model))
    if name == "emps":
        assert model.dof_frictionloss[0] == pytest.approx(20.4, rel=0.1)
        viscous = answer.answer.parameters["d_x"]["with_effect"]
        assert viscous == pytest.approx(one_axis.EMPS["viscous"], rel=0.1)


@pytest.mark.long
@pytest.mark.usefixtures("short_search")
def test_a_law_without_a_name_is_measured_and_drawn(tmp_path):
    module = _load("unlisted")
    answer = module.main(["--out", str(tmp_path)])
    assert (answer.verdict, answer.free_form["kind"]) == ("unknown", "elastic")
    cubic = next(row for row in answer.free_form["equation"] if row["term"] == "q_x^3")
    assert cubic["value"] == pytest.approx(-module.CUBIC, rel=0.1)
    assert (tmp_path / "law.png").stat().st_size > 5000
    text = (tmp_path / "model.xml").read_text(encoding="utf-8")
    assert "the measured law" in text
    loaded = mujoco.MjModel.from_xml_string(text)
    assert [loaded.actuator(i).name.split("_")[0] for i in range(loaded.nu)].count("planned") == 1
    own = answer.free_form["model"]
    assert own["units"] == ["N"]
    assert len(own["forces"][0]) == len(own["time_s"])
    assert own["parameters"].keys() == answer.answer.parameters.keys()
    # where the gap lies and how far it closes is told of the law: no name is behind the answer
    where, gap = answer.answer.where, answer.answer.gap
    assert (where["stage"], where["axes"]) == ("interface", {"x": 1.0})
    assert where["stages"]["interface"] == pytest.approx(1.0, abs=0.02)
    assert gap["chi2_best"] == answer.free_form["chi2"]
    assert gap["J_with_effect"] < gap["J_base"]
    traces = answer.answer.traces()
    with_law = [name for name in traces if name.startswith("with_effect")]
    assert any(not np.array_equal(traces[n], traces[n.replace("with_effect", "plain")]) for n in with_law)
    assert answer.answer.fitted.effects == ()


@pytest.mark.parametrize("name", ["cuff", "drba", "emps", "strap"])
def test_options_of_an_example_are_parsed(name):
    module = _load(name)
    assert module.parser.parse_args([]).out == Path("results/examples") / name
    assert 20 <= len((EXAMPLES / f"{name}.py").read_text(encoding="utf-8").strip().splitlines()) <= 45
    with pytest.raises(SystemExit):
        module.parser.parse_args(["--no-such-option"])
