"""Everything that the report of a study tells of, read from the files of the stages."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from real2sim.artefacts import is_phantom, read_json, read_table

Row = dict[str, str]


@dataclass(frozen=True)
class Table:
    """A CSV file and its rows of text."""

    path: Path
    rows: list[Row]

    @classmethod
    def read(cls, path: Path) -> Table:
        """Read a table. Raises InputError where it is broken."""
        return cls(path, read_table(path))


@dataclass(frozen=True)
class Tightness:
    """Sweeps of the strap: the regression of all people by motion, and each person's operating point."""

    pooled: dict[str, dict[str, Any]]
    people: list[dict[str, Any]]

    @classmethod
    def read(cls, cohort: Path, people: list[Path]) -> Tightness:
        """Read the files of the stage ``tightness``. Raises InputError where one is broken."""
        points = [read_json(path, ("subject", "operating_point")) for path in people]
        return cls(read_json(cohort, ("status", "pooled"))["pooled"], points)


@dataclass(frozen=True)
class Identification:
    """Fits of single trials, their costs on the person's other trial, and which parameters they determine."""

    fits: list[dict[str, Any]]
    cross_trial: Table
    identifiability: Table

    @classmethod
    def read(cls, fits: list[Path], cross_trial: Path, identifiability: Path) -> Identification:
        """Read the fits and what was made of them. Raises InputError where a file is broken."""
        required = ("subject", "trial", "cost", "settings", "provenance")
        records = [read_json(path, required) for path in fits]
        return cls(records, Table.read(cross_trial), Table.read(identifiability))


@dataclass(frozen=True)
class Sharing:
    """Sharing between people: ICC and class of each parameter, priors, and what the priors cost someone left out.

    ``explained``: Table I and transfer with the plain model and with the causes, claims with the causes, and claims by
    the plain fits of the same people and trials; none where nobody was diagnosed.
    """

    icc: Table
    classes: Table
    priors: Table
    anthropometrics: Table
    loso: Table
    refined: list[dict[str, Any]]
    explained: list[Table]

    @classmethod
    def read(
        cls,
        icc: Path,
        classes: Path,
        priors: Path,
        anthropometrics: Path,
        loso: Path,
        refined: list[Path],
        explained: list[Path],
    ) -> Sharing:
        """Read the tables, and refinements of unseen people. Raises InputError where a file is broken."""
        records = [read_json(path, ("subject", "status", "free", "trials")) for path in refined]
        return cls(
            Table.read(icc),
            Table.read(classes),
            Table.read(priors),
            Table.read(anthropometrics),
            Table.read(loso),
            records,
            [Table.read(path) for path in explained],
        )


@dataclass(frozen=True)
class Walking:
    """Tables II and III; bars of trained walkers and their clouds by robot and seed, None where none was trained."""

    interface: Table
    gait: Table
    bars: Table | None
    clouds: Table | None

    @classmethod
    def read(cls, interface: Path, gait: Path, bars: Path | None, clouds: Path | None) -> Walking:
        """Read the tables. Raises InputError where one is broken."""
        return cls(
            Table.read(interface),
            Table.read(gait),
            Table.read(bars) if bars else None,
            Table.read(clouds) if clouds else None,
        )


@dataclass(frozen=True)
class Study:
    """Contents of the page: ``people`` maps an id to its cohort, ``figures`` a name in `FIGURES` to its SVG."""

    people: dict[str, str]
    figures: dict[str, Path]
    quality: Table
    tightness: Tightness
    identification: Identification
    sharing: Sharing
    walking: Walking
    diagnoses: list[dict[str, Any]]
    validation: list[dict[str, Any]]
    claims: Table
    paper_gap: Path | None

    @property
    def phantom(self) -> bool:
        """True where any result of the study rests on synthetic people: stages may have run without fits."""
        i, s, w = self.identification, self.sharing, self.walking
        tables = (self.quality, i.cross_trial, i.identifiability, s.icc, s.loso, w.interface, w.gait)
        records = (*self.tightness.people, *i.fits, *s.refined, *self.diagnoses)
        return is_phantom([*chain.from_iterable(table.rows for table in tables), *records])
