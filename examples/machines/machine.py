"""A machine of this folder: which published files it needs, which parts of them are recordings, what is asked."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import real2sim as r2s
from readers import READERS
from real2sim.configuration import read_yaml
from real2sim.errors import InputError

HERE = Path(__file__).parent
MACHINES = tuple(sorted(path.parent.name for path in HERE.glob("*/machine.yaml")))


@dataclass(frozen=True)
class Machine:
    """One machine: its description (`system`), machine.yaml (``content``) and the folder with the published files."""

    name: str
    system: r2s.System
    content: Mapping[str, Any]
    data: Path

    @classmethod
    def load(cls, name: str, data: Path) -> Machine:
        """Read machine.yaml and the description that it names."""
        path = HERE / name / "machine.yaml"
        content = read_yaml(path)
        return cls(name, r2s.System.from_yaml((path.parent / content["system"]).resolve()), content, data)

    @property
    def origin(self) -> str:
        """Source of the files, in words."""
        source = self.content["source"]
        return f"{source['data']}. From: {source['where']}. Licence: {source['licence']}."

    def file(self, name: str) -> Path:
        """Return the path of a published file, anywhere below the data folder.

        Raises
        ------
        InputError
            Where it is missing, or is not the published one by its SHA-256.
        """
        found = sorted(self.data.rglob(name))
        if not found:
            expected = f"{name}, from {self.content['source']['where']}"
            raise InputError(self.data, name, "no such file", expected, "Put the file there.", "no_file")
        digest = hashlib.sha256(found[0].read_bytes()).hexdigest()
        if digest != self.content["files"][name]:
            expected = f"the published file, SHA-256 {self.content['files'][name]}"
            raise InputError(
                found[0], "", f"SHA-256 {digest}", expected, f"Get it anew: {self.origin}", "value"
            )
        return found[0]

    def table(self, record: str) -> pd.DataFrame:
        """Return the rows of a record; with ``mean_of``, the means of so many samples each."""
        part = self.content["records"][record]
        table = READERS[self.content["reader"]](self.file(part["file"]))
        inside = (table["time_s"] >= part["from_s"] - 1e-9) & (table["time_s"] < part["to_s"] - 1e-9)
        table = table[inside].reset_index(drop=True)
        count = part.get("mean_of", 1)
        whole = table.iloc[: len(table) // count * count].to_numpy()
        means = whole.reshape(-1, count, whole.shape[1]).mean(axis=1)
        out = pd.DataFrame(means, columns=table.columns)
        return out.assign(time_s=out["time_s"] - out["time_s"][0])

    def recording(self, record: str) -> r2s.Recording:
        """Return a record as the library takes it."""
        return r2s.Recording.from_table(
            self.system, self.table(record), record, self.content["records"][record]["file"]
        )

    def trusting(self, question: str) -> r2s.System:
        """Return the description with the level of noise that the repeats of the question's record tell, if any do."""
        record = self.content["questions"][question].get("noise")
        if record is None:
            return self.system
        again, first = self.content["noise"][record], self.recording(record)
        if isinstance(again, str):
            return self.system.trusting(first.scatter_to(self.recording(again)))
        return self.system.trusting(first.scatter_of_repeats(again))

    def ask(self, question: str, settings: Mapping[str, Any] | None = None) -> r2s.Diagnosis:
        """Diagnose the two records of a question; ``settings`` as of `real2sim.diagnose`."""
        asked = self.content["questions"][question]
        train, held_out = (self.recording(asked[part]) for part in ("train", "held_out"))
        return r2s.diagnose(self.trusting(question), train=train, held_out=held_out, settings=settings)


def closed(answer: r2s.Diagnosis) -> float:
    """Share of what stands above the noise on the held-out record that the named set takes away [1]."""
    gap = answer.answer.gap
    plain, best, noise = (gap[k][1] for k in ("chi2_plain", "chi2_best", "chi2_expected"))
    return float((plain - best) / max(plain - noise, np.sqrt(2 * noise)))
