"""Table I with the plain model and with the diagnosed causes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from real2sim.artefacts import number, read_table, write_json
from real2sim.inference.parameters import PARAMETERS
from real2sim.study.paper.with_effects import with_effects

PUBLISHED = Path(__file__).parents[2] / "resources" / "published" / "table1_priors.csv"


def _answer(subject, plain, explained, verdict="soft_tissue"):
    numbers = {name: {"base": plain, "with_effect": explained, "unit": "N/m"} for name in PARAMETERS}
    return {"subject": subject, "verdict": verdict, "phantom": True, "parameters": numbers}


def _table(folder, *answers):
    paths = [folder / f"{i}.json" for i in range(len(answers))]
    for path, answer in zip(paths, answers, strict=True):
        write_json(path, answer)
    out = [folder / "table1_priors.csv", folder / "table1_priors.tex"]
    with_effects(diagnoses=paths, published=PUBLISHED, out=out)
    return read_table(out[0]), out[1].read_text(encoding="utf-8")


def test_both_models_stand_beside_the_published_numbers(tmp_path):
    rows, tex = _table(tmp_path, _answer("S01", 100.0, 200.0), _answer("S02", 400.0, 200.0, "unknown"))
    first = rows[0]
    assert [row["parameter"] for row in rows] == list(PARAMETERS)
    assert number(first["prior_plain"]) == pytest.approx(200)
    sd = math.log(4) / math.sqrt(2)
    assert number(first["spread_high_plain"]) == pytest.approx(200 * math.exp(1.96 * sd))
    assert number(first["spread_low_with_effects"]) == pytest.approx(200)
    assert number(first["change_percent"]) == pytest.approx(0, abs=1e-9)
    assert (first["n_subjects"], first["n_with_a_cause"]) == ("2", "1")
    assert number(first["published_prior"]) == 725
    assert first["phantom"] == "true"
    assert "of 1 of them" in tex
    assert "Phantom" in tex
    assert "e+" not in tex


def test_one_person_has_no_spread(tmp_path):
    rows, tex = _table(tmp_path, _answer("S01", 5000.0, 6000.0))
    assert rows[0]["spread_low_plain"] == ""
    assert "5000 & [--, --] & 6000" in tex
    assert number(rows[0]["change_percent"]) == pytest.approx(20)
