"""One look for the pages that carry everything in themselves: no file beside them, light and dark.

Figures are SVG inside the page. Their text is the page's and their colours are its variables, so that both follow the
reader's light or dark setting.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from html import escape
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from real2sim.inference.identifiability import AT_BOUND, DETERMINED, NOT_DETERMINED, WEAK
from real2sim.pages import style
from real2sim.recording.quality.verdict import PASS, REFUSE, WARN

# A cell with more characters beside its markup holds a sentence
_SENTENCE = 40
_MARKS = {
    DETERMINED: "\N{CHECK MARK}",
    WEAK: "\N{ALMOST EQUAL TO}",
    NOT_DETERMINED: "\N{MULTIPLICATION SIGN}",
    AT_BOUND: "\N{LEFTWARDS ARROW TO BAR OVER RIGHTWARDS ARROW TO BAR}",
    PASS: "\N{CHECK MARK}",
    WARN: "!",
    REFUSE: "\N{MULTIPLICATION SIGN}",
}
_GOOD, _BAD = (DETERMINED, PASS), (NOT_DETERMINED, REFUSE)
# What replaces a colour of a figure: name of the variable, in light, in dark
_COLOURS = {
    "#000000": ("ink", "#1a1a1a", "#e6e6e6"),
    "#ffffff": ("paper", "#ffffff", "#15181c"),
    style.GREY: ("muted", "#6b6b6b", "#a3a8ae"),
    style.BLUE: ("blue", style.BLUE, style.SKY),
    style.VERMILION: ("vermilion", "#c04f00", "#ff8a4d"),
    style.GREEN: ("green", "#007a59", "#2fc79b"),
    style.ORANGE: ("orange", "#c98a00", style.ORANGE),
}
_RC: Any = style.RC | {
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "axes.facecolor": "none",
}
_VARIABLES = ("; ".join(f"--{name}: {row[i]}" for name, *row in _COLOURS.values()) for i in (0, 1))
_LIGHT, _DARK = _VARIABLES
_STYLE = f"""
:root {{ color-scheme: light dark; {_LIGHT}; --line: #cfcfcf; --tint: #f3f5f7; --warn: #fdf1e8 }}
@media screen and (prefers-color-scheme: dark) {{ :root {{ {_DARK};
  --line: #3d434a; --tint: #1f242a; --warn: #3a2618 }} }}
""" + (
    """
* { box-sizing: border-box }
body { font: 16px/1.5 system-ui, sans-serif; margin: 0; color: var(--ink); background: var(--paper) }
main { max-width: 84rem; margin: 0 auto; padding: 1rem clamp(0.8rem, 3vw, 2.5rem) 3rem }
h1 { font-size: 1.5rem; margin: 0.5rem 0 }
h2 { font-size: 1.2rem; margin: 2rem 0 0.5rem; padding-top: 0.8rem; border-top: 1px solid var(--line) }
h3 { font-size: 1rem; margin: 1rem 0 0.3rem }
p, li, figcaption { max-width: 46rem; margin: 0.4rem 0 }
.lead { font-size: 1.25rem; line-height: 1.4; max-width: 54rem }
.front { display: grid; grid-template-columns: 11rem 1fr; gap: 0.5rem 1.2rem; margin: 1rem 0; max-width: 62rem }
.front dt { font-weight: 600 }
.front dd { margin: 0 }
.stages { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.5rem, 1fr)); gap: 0.4rem; margin: 0;
  padding: 0; list-style: none; max-width: none }
.front ul { margin: 0; padding-left: 1.1rem }
.front .stages { padding: 0 }
.stages li { display: grid; grid-template-rows: auto 1fr auto; margin: 0; padding: 0.35rem 0.6rem; max-width: none;
  border: 1px solid var(--line); border-radius: 0.3rem }
.stages .here { outline: 2px solid var(--blue); outline-offset: -1px; background: var(--tint) }
.small, figcaption { font-size: 0.88rem; font-weight: 400; color: var(--muted) }
.notice { border-left: 0.4rem solid var(--vermilion); background: var(--warn); padding: 0.6rem 1rem; max-width: none }
.grid { display: grid; gap: 1rem 2.5rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 25rem), 1fr));
  align-items: start }
.grid.wide { grid-template-columns: repeat(auto-fit, minmax(min(100%, 33rem), 1fr)) }
figure { margin: 0.5rem 0; min-width: 0 }
svg.plot { display: block; width: 100%; height: auto; max-width: 36rem; fill: var(--ink) }
svg.plot.wide { max-width: none; min-width: 46rem }
svg.plot text { font-family: system-ui, sans-serif !important }
.scroll { overflow-x: auto; container-type: inline-size }
table { border-collapse: collapse; font-size: 0.9rem; margin: 0.4rem 0; max-width: 100% }
caption { text-align: left; color: var(--muted); padding-bottom: 0.3rem }
caption span { display: inline-block; width: max-content; position: sticky; left: 0; max-width: min(46rem, 100cqw) }
th, td { padding: 0.25rem 0.7rem 0.25rem 0; border-bottom: 1px solid var(--line); text-align: left;
  vertical-align: top }
th { font-weight: 600 }
td.sentence { min-width: 14rem }
td .small { font-size: 0.9em }
.said { display: inline-block; min-width: 15rem }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
.bar { display: inline-block; width: 6rem; max-width: 100%; height: 0.7rem; background: var(--tint);
  border: 1px solid var(--line); margin-right: 0.5rem }
.bar > span { display: block; height: 100%; background: var(--blue) }
.met { color: var(--green); font-weight: 600 }
.missed { color: var(--vermilion); font-weight: 600 }
.warned { font-weight: 600 }
.met, .missed, .warned { white-space: nowrap }
.wrapped { white-space: normal }
.contents { display: flex; flex-wrap: wrap; gap: 0.2rem 1.2rem; list-style: none; padding: 0; max-width: none }
a { color: var(--blue) }
:focus-visible { outline: 3px solid var(--blue); outline-offset: 2px }
button { font: inherit; color: var(--ink); background: var(--tint); border: 1px solid var(--muted);
  border-radius: 0.3rem; padding: 0.15rem 0.7rem; min-height: 1.75rem; cursor: pointer }
dialog.zoom { width: 96vw; max-width: none; height: 94vh; max-height: none; padding: 0.8rem; color: var(--ink);
  background: var(--paper); border: 1px solid var(--muted) }
dialog.zoom[open] { display: flex; flex-direction: column }
dialog.zoom h2 { border: 0; margin: 0; padding: 0 }
.bar-of-tools { display: flex; justify-content: space-between; gap: 1rem; padding-bottom: 0.5rem }
.sheet { overflow: auto; flex: 1; min-height: 0 }
.sheet svg.plot { width: calc(100% * var(--size, 1)); max-width: none }
.nowrap { white-space: nowrap }
code { font-size: 0.85em; overflow-wrap: anywhere }
details { margin: 0.5rem 0 }
summary { cursor: pointer }
footer { margin-top: 2.5rem; padding-top: 0.8rem; border-top: 1px solid var(--line); font-size: 0.85rem;
  overflow-wrap: anywhere }
footer h2 { border: 0; margin-top: 0; padding-top: 0 }
@media (max-width: 34rem) {
  th, td { padding-right: 0.45rem }
  table { font-size: 0.82rem }
  .lead { font-size: 1.1rem }
  .front { grid-template-columns: 1fr; gap: 0.1rem }
  .front dd { margin-bottom: 0.6rem }
  .bar { display: block; width: 100%; min-width: 3.5rem }
}
@media print {
  main { max-width: none; padding: 0 }
  .tools, .contents { display: none }
  .scroll { overflow: visible }
  figure, tr, .notice { break-inside: avoid }
  h2, h3, caption { break-after: avoid }
  table { font-size: 0.72rem }
  th, td { overflow-wrap: break-word }
  th.number { white-space: normal }
  .met, .missed, .warned { white-space: normal }
  footer th, footer td { overflow-wrap: anywhere }
  td.sentence, .said { min-width: 0 }
}
""".strip()
)


def page_style() -> AbstractContextManager[None]:
    """Settings under which figures for a page are drawn and turned to SVG."""
    return matplotlib.rc_context(_RC)


def document(title: str, body: Sequence[str], *, phantom: bool, script: str = "") -> str:
    """The whole page; ``body`` are its sections after the heading, ``title`` is plain text.

    ``script`` may add to the page but is not needed to read it.
    """
    notice = ""
    if phantom:
        text = f"{style.PHANTOM_LABEL}: every number and figure here rests on synthetic people, not on measurements."
        notice = f'<p class="notice">{escape(text)}</p>'
    return "\n".join(
        [
            f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{escape(title)}</title>',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>\n{_STYLE}\n</style>\n</head>\n<body>\n<main>\n<h1>{escape(title)}</h1>",
            *([notice] if notice else []),
            *body,
            "</main>",
            *([f"<script>\n{script}\n</script>"] if script else []),
            "</body>\n</html>\n",
        ]
    )


def section(identifier: str, heading: str, *parts: str) -> str:
    """A section under a second heading; ``parts`` are markup, empty ones are left out."""
    inside = "\n".join(part for part in parts if part)
    title = f'<h2 id="{identifier}">{escape(heading)}</h2>'
    return f'<section aria-labelledby="{identifier}">\n{title}\n{inside}\n</section>'


def paragraph(text: str, kind: str = "") -> str:
    """Plain text as a paragraph of a class of the style sheet."""
    marked = f' class="{kind}"' if kind else ""
    return f"<p{marked}>{escape(text)}</p>"


def picture(figure: Figure, name: str, alt: str, caption: str, *, wide: bool = False) -> str:
    """A figure as SVG inside the page, with what it shows in words; ``name`` is unique on the page.

    ``wide`` keeps it legible on a narrow screen by scrolling.
    """
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata=style.SVG_METADATA)
    return inline(stream.getvalue(), name, alt, caption, wide=wide)


def inline(content: str, name: str, alt: str, caption: str, *, wide: bool = False) -> str:
    """An SVG file's content as a figure of the page, see `picture`."""
    root = re.search(r"<svg[^>]*viewBox=\"([^\"]+)\"[^>]*>", content)
    assert root is not None
    inside = re.sub(r"<metadata>.*?</metadata>", "", content[root.end() :], flags=re.DOTALL)
    inside = re.sub(r"xlink:href", "href", inside)
    for old, new in (
        (r'\bid="', f'id="{name}-'),
        (r"url\(#", f"url(#{name}-"),
        (r'href="#', f'href="#{name}-'),
    ):
        inside = re.sub(old, new, inside)
    for colour, (variable, *_) in _COLOURS.items():
        inside = re.sub(rf"{colour}\b", f"var(--{variable})", inside, flags=re.IGNORECASE)
    kind = "plot wide" if wide else "plot"
    svg = f'<svg class="{kind}" viewBox="{root[1]}" role="img" aria-label="{escape(alt, quote=True)}">{inside.strip()}'
    if wide:
        label = escape(f"{caption.split('.')[0]}, scrolls", quote=True)
        svg = f'<div class="scroll" tabindex="0" role="region" aria-label="{label}">{svg}</div>'
    return f"<figure>\n{svg}\n<figcaption>{escape(caption)}</figcaption>\n</figure>"


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, caption: str, numeric: Sequence[int] = ()
) -> str:
    """Table whose first column names its rows; cells are markup, ``numeric`` are columns set to the right.

    Raises ValueError for a row that has not a cell for each name of ``head``.
    """
    if any(len(row) != len(head) for row in rows):
        raise ValueError(f"{caption}: a row has not {len(head)} cells")

    def cell(i: int, text: str) -> str:
        if i == 0:
            return f'<th scope="row">{text}</th>'
        if i in numeric:
            return f'<td class="number">{text}</td>'
        # a sentence is not squeezed to a word per line beside columns of numbers
        kind = ' class="sentence"' if len(re.sub("<[^>]*>", "", text)) > _SENTENCE else ""
        return f"<td{kind}>{text}</td>"

    kinds = [' class="number"' if i in numeric else "" for i in range(len(head))]
    top = "".join(
        f'<th scope="col"{kind}>{escape(text)}</th>' for kind, text in zip(kinds, head, strict=True)
    )
    body = "\n".join("<tr>" + "".join(cell(i, text) for i, text in enumerate(row)) + "</tr>" for row in rows)
    label = escape(caption, quote=True)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{label}">\n'
        f"<table>\n<caption><span>{escape(caption)}</span></caption>\n"
        f"<thead><tr>{top}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>\n</div>"
    )


def listed(words: Sequence[str], joint: str = "and") -> str:
    """Words in a sentence, at least one."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {joint} {words[-1]}"


def percent(value: float | None, digits: int = 0) -> str:
    """Share as a percentage with a typographic minus; a dash where there is none."""
    return "\N{EN DASH}" if value is None else f"{style.signed(100 * value, digits)} %"


def likely(probability: float, digits: int = 0) -> str:
    """A probability or share as a percentage: over 99 % for what is not quite all, under 1 % for more than none."""
    step = 10.0**-digits
    if 1 - step / 200 <= probability < 1:
        return f"over {percent(1 - step / 100, digits)}"
    if 0 < probability < step / 200:
        return f"under {percent(step / 100, digits)}"
    return percent(probability, digits)


def rounded(value: float | None, digits: int = 3) -> str:
    """A number to ``digits`` figures without a power of ten where that reads well; a dash where there is none."""
    if value is None:
        return "\N{EN DASH}"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-6 < abs(value) < 1e7:
        text = f"{float(text):.6f}".rstrip("0") if abs(value) < 1 else f"{float(text):.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def bar(share: float) -> str:
    """A bar of a probability or share, for the eye only: the number stands beside it."""
    width = 100 * min(max(share, 0.0), 1.0)
    return f'<span class="bar" aria-hidden="true"><span style="width:{width:.1f}%"></span></span>'


def verdict(name: str, text: str = "") -> str:
    """A verdict of a gate or on a parameter as word and mark: never colour alone."""
    kind = "met" if name in _GOOD else "missed" if name in _BAD else "warned"
    return f'<span class="{kind}">{_MARKS[name]} {escape(text or name)}</span>'


def download(name: str, content: bytes, kind: str) -> str:
    """A link that holds the file itself; ``kind`` is its MIME type."""
    data = base64.b64encode(content).decode()
    return f'<a download="{escape(name, quote=True)}" href="data:{kind};base64,{data}">{escape(name)}</a>'


def folded(summary: str, inside: str, *, unfolded: bool = False) -> str:
    """Markup behind a line of plain text."""
    return f"<details{' open' if unfolded else ''}><summary>{escape(summary)}</summary>\n{inside}\n</details>"
