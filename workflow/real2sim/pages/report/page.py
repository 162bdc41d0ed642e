"""The whole page: reading what it tells of, the order of its sections, and the script that enlarges figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from real2sim.artefacts import read_json
from real2sim.files import write_text
from real2sim.pages.front import front
from real2sim.pages.page import document
from real2sim.pages.report.claims import claims_section, paper_gap_section
from real2sim.pages.report.diagnoses import diagnoses_section
from real2sim.pages.report.foot import provenance
from real2sim.pages.report.identification import identification_section
from real2sim.pages.report.parts import figure
from real2sim.pages.report.priors import priors_section
from real2sim.pages.report.recordings import cohort_section, gates_section, tightness_section
from real2sim.pages.report.study import Identification, Sharing, Study, Table, Tightness, Walking
from real2sim.pages.report.top import lead, notices
from real2sim.pages.report.walking import validation_section
from real2sim.pages.validation import RECORD_KEYS

_SCRIPT = """
(() => {
  const box = document.createElement('dialog');
  box.className = 'zoom';
  box.setAttribute('aria-labelledby', 'zoom-title');
  box.innerHTML = '<div class="bar-of-tools"><h2 id="zoom-title"></h2><span><button type="button" value="-0.5" '
    + 'aria-label="Smaller">\\u2212</button> <button type="button" value="0.5" aria-label="Larger">+</button> '
    + '<button type="button" value="close">Close</button></span></div>'
    + '<div class="sheet" tabindex="0" role="region" aria-label="Figure, scrolls"></div>';
  document.body.append(box);
  const sheet = box.querySelector('.sheet');
  let home = null, drawing = null, size = 1;
  const fit = (value) => { size = Math.min(6, Math.max(1, value)); sheet.style.setProperty('--size', size); };
  box.addEventListener('click', (event) => {
    const button = event.target.closest('button');
    if (!button) return;
    if (button.value === 'close') box.close(); else fit(size + Number(button.value));
  });
  box.addEventListener('close', () => { home.prepend(drawing); home.querySelector('button').focus(); });
  for (const button of document.querySelectorAll('button.enlarge')) {
    button.hidden = false;
    button.addEventListener('click', () => {
      home = button.closest('figure');
      drawing = home.firstElementChild;
      box.querySelector('h2').textContent = button.dataset.title;
      sheet.replaceChildren(drawing);
      fit(1);
      box.showModal();
      box.querySelector('[value=close]').focus();
    });
  }
  addEventListener('beforeprint', () => { for (const d of document.querySelectorAll('details')) d.open = true; });
})();
""".strip()


def report_page(
    *,
    people: dict[str, str],
    figures: list[Path],
    quality: Path,
    tightness: Path,
    breakpoints: list[Path],
    cross_trial: Path,
    identifiability: Path,
    icc: Path,
    classes: Path,
    priors: Path,
    anthropometrics: Path,
    loso: Path,
    interface: Path,
    gait: Path,
    claims: Path,
    fits: list[Path],
    title: str,
    out: Path,
    bars: Path | None = None,
    clouds: Path | None = None,
    refined: list[Path] | None = None,
    diagnoses: list[Path] | None = None,
    validation: list[Path] | None = None,
    explained: list[Path] | None = None,
    paper_gap: Path | None = None,
) -> None:
    """Write the report of a study: cohort, gates, tightness, identification, priors, validation, claims, provenance.

    Parameters
    ----------
    people
        Cohort (calibration or validation) of everyone, by id.
    figures
        SVG files, by the names in `FIGURES`.
    quality, tightness, breakpoints, cross_trial, identifiability, icc, classes, priors, anthropometrics, loso, claims
        Files of the stages that bear these names.
    interface, gait, bars, clouds
        Tables II and III of `paper.tables`; bars.csv and interface.csv of the twins, where one was trained.
    fits, refined, diagnoses, validation, paper_gap
        Fit files, refinements of unseen people, diagnoses; records of resources/validation and resources/paper_gap.
    explained
        table1_priors.csv, transfer.csv and claims.csv of results/paper/with_effects, and claims.csv of the plain fits
        of the same people and trials, where the calibration people are diagnosed.
    """
    study = Study(
        people=people,
        figures={path.stem: path for path in figures},
        quality=Table.read(quality),
        tightness=Tightness.read(tightness, breakpoints),
        identification=Identification.read(fits, cross_trial, identifiability),
        sharing=Sharing.read(icc, classes, priors, anthropometrics, loso, refined or [], explained or []),
        walking=Walking.read(interface, gait, bars, clouds),
        diagnoses=[read_json(path, ("subject", "verdict")) for path in diagnoses or []],
        validation=[read_json(path, RECORD_KEYS) for path in validation or []],
        claims=Table.read(claims),
        paper_gap=paper_gap,
    )
    write_text(out, _page(study, title))


def _page(study: Study, title: str) -> str:
    parts = {name: make(study) for name, make in SECTIONS.items()}
    shown = [part for part in parts.values() if part]
    contents = "".join(
        f'<li><a href="#{name}">{_heading(part)}</a></li>' for name, part in parts.items() if part
    )
    body = [
        *notices(study),
        _answer(study),
        lead(study),
        f'<nav aria-label="Contents"><ul class="contents">{contents}</ul></nav>',
        *shown,
        provenance(study),
    ]
    return document(title, body, phantom=study.phantom, script=_SCRIPT)


def _answer(study: Study) -> str:
    """The answer for this cohort, in words beside the picture of everyone's gap; empty where nobody was diagnosed."""
    words = front(study.diagnoses, study.validation)
    return f'<div class="grid wide">\n{words}\n{figure(study, "gap")}\n</div>' if words else ""


def _heading(part: str) -> str:
    """Heading of a section, in HTML."""
    return part.split("</h2>")[0].rsplit(">", 1)[1]


SECTIONS: Mapping[str, Callable[[Study], str]] = {
    "diagnosis": diagnoses_section,
    "cohort": cohort_section,
    "quality": gates_section,
    "tightness": tightness_section,
    "identification": identification_section,
    "priors": priors_section,
    "validation": validation_section,
    "claims": claims_section,
    "paper-gap": paper_gap_section,
}
