"""The diagnosis of a person of the miniature, from the real Snakefile."""

from __future__ import annotations

import json

import mujoco
import pytest
from real2sim.artefacts import number, read_table

from tests.conftest import SHORT_SEARCH


@pytest.fixture(scope="module")
def mini(mini_done, tmp_path_factory):
    """One study for all tests of this file: what one of them diagnosed is not diagnosed again by the next."""
    study = mini_done.copy(tmp_path_factory.mktemp("diagnosed") / "mini")
    study.configure(diagnosis={"search": SHORT_SEARCH})
    return study


def test_diagnosis_answers_without_truth(mini):
    assert not list(mini.folder.rglob("*sealed*"))
    answer = mini.folder / "results" / "diagnosis" / "S01" / "diagnosis.json"
    target = str(answer.relative_to(mini.folder))
    mini.snakemake("--cores", "2", target)
    content = json.loads(answer.read_bytes())
    assert content["phantom"] is True
    assert content["train"] == ["dynamic_1"]
    assert content["held_out"] == ["dynamic_2"]
    assert abs(sum(content["probabilities"].values()) - 1) < 1e-9
    assert content["verdict"] in content["probabilities"]
    # skin over the pelvis is the effect that the phantom cohort is made with
    assert content["probabilities"]["soft_tissue"] == max(content["probabilities"].values())
    assert content["gap"]["J_with_effect"] < content["gap"]["J_base"]
    model = answer.with_name("model.xml")
    mini.snakemake("--cores", "2", str(model.relative_to(mini.folder)))
    loaded = mujoco.MjModel.from_xml_path(str(model))
    assert loaded.numeric("k_tx").data[0] == content["parameters"]["k_tx"]["fitted"]
    assert "PHANTOM" in model.read_text(encoding="utf-8")
    notes = json.loads(model.with_suffix(".json").read_text())
    # skin over the pelvis is no part of a model of robot and interface
    assert not notes["complete"]
    assert any(line.startswith("soft_tissue") for line in notes["to_do"])
    page = answer.with_suffix(".html")
    mini.snakemake("--cores", "2", str(page.relative_to(mini.folder)))
    text = page.read_text(encoding="utf-8")
    assert "soft tissue" in text.replace("_", " ")
    assert "PHANTOM" in text.upper()
    assert 'href="model.xml"' in text


@pytest.mark.long
def test_the_papers_tables_stand_twice_where_everyone_is_diagnosed(mini):
    tables = [f"results/paper/with_effects/{name}.csv" for name in ("table1_priors", "transfer", "claims")]
    page = "results/report.html"
    mini.snakemake("--cores", "2", "--config", "diagnosed=everyone", "--", *tables, page)
    priors, transfer, claims = (read_table(mini.folder / table) for table in tables)
    assert {row["n_subjects"] for row in priors} == {"2"}
    assert all(number(row["prior_plain"]) > 0 and number(row["prior_with_effects"]) > 0 for row in priors)
    # the phantom's skin slides: with it in the model less is left
    own = next(row for row in transfer if row["quantity"] == "J_own")
    assert 0 < number(own["with_effects"]) < number(own["plain"])
    plain = read_table(mini.folder / "results" / "paper" / "claims.csv")
    assert [row["claim"] for row in claims] == [row["claim"] for row in plain]
    assert [row["here"] for row in claims] != [row["here"] for row in plain]
    text = (mini.folder / page).read_text(encoding="utf-8")
    assert "The same with the diagnosed causes in the model" in text
    assert "With causes" in text
