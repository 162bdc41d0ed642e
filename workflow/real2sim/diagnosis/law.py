"""A measured law in words and numbers: where it acts, on what it depends, its curve with a band, what it closes.

The entry ``free_form`` of diagnosis.json is made here from refitted families (`free_form.Law`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.diagnosis.free_form import AnyFamily, Law, Library
from real2sim.diagnosis.intervals import precision_by_noise
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair
from real2sim.effects.chains import Context
from real2sim.effects.families import Family, Term, Variable, times
from real2sim.effects.free_run import feed_back

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSettings

# Points of a curve over the visited range
_POINTS = 41
# Powers of one variable that an equation is written in, and how many of them at most
_POWERS = (1, 2, 3, 4, 5)
_MOST_TERMS = 3
# What an equation has to hold of the law's mean square [1]
_ENOUGH = 0.95
_NORMAL_95 = 1.96
# Kinds that hold a simpler one as a special case
_SIMPLER = {"elastic coupling": "elastic", "damping by coordinate": "dissipative"}


@dataclass(frozen=True)
class _Fitted:
    """A family with its coefficients (p,) and their covariance (p, p)."""

    family: AnyFamily
    coefficients: np.ndarray
    covariance: np.ndarray


def describe(
    pair: Pair, law: Law, rivals: Sequence[Law], library: Library, options: DiagnosisSettings
) -> dict[str, Any]:
    """Return what diagnosis.json says of a law, but for what it closes.

    ``rivals`` are the other laws that were refitted, by falling evidence; ``options`` is the slice ``diagnosis``.
    """
    fitted = _fitted(pair, law, options)
    told = [least_family(one.family, one.coefficients, library, pair) for one in fitted]
    first = told[0]
    alike = [one for one in told if one["kind"] == first["kind"]]
    return {
        "stage": first["stage"],
        "kind": first["kind"],
        "axes": list(dict.fromkeys(axis for one in alike for axis in one["axes"])),
        "depends_on": list(dict.fromkeys(name for one in alike for name in one["depends_on"])),
        "family": first["family"],
        "families": told,
        "own_history_in_each_trial": law.is_history,
        "ln_evidence": law.gain,
        "equation": [row for one in fitted for row in _equation(pair, one, library)],
        "curve": _curve(fitted[0], library),
        "model": as_model(pair, law, library),
        "rivals": [
            {"families": [named_family(f) for f in r.families], "ln_evidence_behind": law.gain - r.gain}
            for r in rivals
            if np.isfinite(r.gain)
        ],
    }


def size(pair: Pair, law: Law, library: Library) -> dict[str, Any] | None:
    """Return the RMS of the law's first force on the fitted trial about its mean, None for a displacement.

    Of a force on several joints, the one is told that is largest beside the joint's large force.
    """
    family = law.families[0]
    if not isinstance(family, Family):
        return None
    x = law.coefficients[0][: len(family.terms)]
    rms = {}
    for joint in dict.fromkeys(t.joint for row in family.terms for t in row):
        rows = [
            library.signals([t for t in row if t.joint == joint], pair.train.context) for row in family.terms
        ]
        rms[joint] = float(np.std(x @ np.array([row.sum(axis=0) for row in rows])))
    joint = max(rms, key=lambda j: rms[j])
    return {"rms": rms[joint] * library.force[joint], "unit": "Nm" if library.is_turn(joint) else "N"}


def as_model(pair: Pair, law: Law, library: Library) -> dict[str, Any] | None:
    """Return what makes the plant with the law again: parameters, and its forces on the fitted trial [N, Nm].

    None where something that it holds is no force. ``forces`` (j, n) are those on ``joints`` at ``time_s``, as the
    free run has them.
    """
    if not all(isinstance(family, Family) for family in law.families):
        return None
    context = _planned_from(pair, law.hypothesis)
    forces: dict[str, np.ndarray] = {}
    for family, x in zip(law.families, law.coefficients, strict=True):
        assert isinstance(family, Family)
        for row, value in zip(family.terms, x, strict=False):
            for term, signal in zip(row, library.signals(row, context), strict=True):
                part = value * signal * library.force[term.joint]
                forces[term.joint] = forces[term.joint] + part if term.joint in forces else part
    values = pair.system.values(law.hypothesis.base)
    return {
        "parameters": {
            p.name: {"value": float(v), "unit": p.unit}
            for p, v in zip(pair.system.parameters, values, strict=True)
        },
        "joints": list(forces),
        "units": ["Nm" if library.is_turn(joint) else "N" for joint in forces],
        "time_s": context.time_s.tolist(),
        "forces": [force.tolist() for force in forces.values()],
    }


def _planned_from(pair: Pair, hypothesis: Hypothesis) -> Context:
    """Return the context that planned forces are computed from in a free run of the fitted trial."""
    if not feed_back(hypothesis.effects):
        return pair.train.context
    replay = pair.train.replay(list(hypothesis.effects), 1)
    replay.run_freely(pair.system.values(hypothesis.base)[None], [x[None] for x in hypothesis.split()])
    return replay.planned_from


def named_family(family: AnyFamily) -> dict[str, Any]:
    """Return what diagnosis.json says of a family: place, kind and variables."""
    return {
        "family": family.name,
        "stage": family.stage,
        "kind": family.kind,
        "axes": list(family.axes),
        "depends_on": list(family.depends_on),
    }


def least_family(
    family: AnyFamily, coefficients: np.ndarray, library: Library, pair: Pair, enough: float = _ENOUGH
) -> dict[str, Any]:
    """Return what is said of a family: the simpler kind that it holds where that carries ``enough`` of it, 95 %.

    A potential of two coordinates may be two springs, and a damping by the coordinate one by the rate alone. Counted is
    what stiffness and damping of the axes cannot do. ``coefficients`` (p,) are the family's.
    """
    about = named_family(family)
    if not isinstance(family, Family) or family.kind not in _SIMPLER:
        return about
    kind, context = _SIMPLER[family.kind], pair.train.context
    simple = {f.axes[0]: f for f in library.forces if f.kind == kind and len(f.axes) == 1}
    forces = {}
    for axis in family.axes:
        joint = simple[axis].terms[0][0].joint
        rows = [[t for t in row if t.joint == joint] for row in family.terms]
        parts = np.array([library.signals(row, context).sum(axis=0) for row in rows])
        force = (coefficients @ parts)[:, None]
        plain = library.signals([times(joint, {f"{x}_{axis}": 1}) for x in "qv"], context)
        signals = library.signals([t for row in simple[axis].terms for t in row], context)
        rest, left = (_without(force, by) for by in (plain, np.vstack([plain, signals])))
        forces[axis] = float(rest @ rest), float(left @ left)
    total = sum(rest for rest, _ in forces.values())
    own = [axis for axis, (rest, _) in forces.items() if rest >= (1 - enough) * total]
    missed = sum(left if axis in own else rest for axis, (rest, left) in forces.items())
    if missed > (1 - enough) * total:
        return about
    names = [simple[axis].depends_on[0] for axis in own]
    return about | {"kind": kind, "axes": own, "depends_on": names}


def _without(force: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Return what a constant and signals (s, n) do not explain of a force (n, 1), as (n,)."""
    known = np.column_stack([signals.T, np.ones(signals.shape[1])])
    return np.asarray(force - known @ np.linalg.lstsq(known, force, rcond=None)[0])[:, 0]


def _beyond_noise(pair: Pair, hypothesis: Hypothesis) -> float:
    """Chi-squared over its expectation, of the trial where that is more, and at least 1.

    A law that leaves more than noise is known less well than noise alone says, by the root of this (Birge, Phys. Rev.
    40 (1932) 207). What it leaves of the trial that it was not fitted to shows best how far off it is.
    """
    expected = pair.train.samples, pair.held_out.samples
    return max(1.0, *(left / n for left, n in zip(hypothesis.chi2, expected, strict=True)))


def _fitted(pair: Pair, law: Law, options: DiagnosisSettings) -> list[_Fitted]:
    known = precision_by_noise(pair, law.hypothesis, options)
    covariance = known.widened * _beyond_noise(pair, law.hypothesis)
    at, out = law.first, []
    for family, x in zip(law.families, law.coefficients, strict=True):
        # of coefficients that each trial has of its own, those of the fitted one are told
        count = len(family.terms)
        own = slice(at, at + count)
        out.append(_Fitted(family, x[:count], covariance[own, own]))
        at += len(x)
    return out


def _equation(pair: Pair, fitted: _Fitted, library: Library) -> list[dict[str, Any]]:
    """Return the fewest terms that carry 95 % of a family's force on the training trial, at most three."""
    family = fitted.family
    if not isinstance(family, Family):
        return []
    context = pair.train.context
    if family.is_free:
        # a history is no equation
        return []
    out: list[dict[str, Any]] = []
    for joint in dict.fromkeys(t.joint for row in family.terms for t in row):
        rows = [[t for t in row if t.joint == joint] for row in family.terms]
        force = np.array([library.signals(row, context).sum(axis=0) for row in rows])
        terms = _readable(family, joint)
        signals = library.signals(terms, context)
        chosen, share = _fewest(signals, fitted.coefficients @ force)
        # beside a constant, which is a preload and no part of the equation
        with_constant = np.column_stack([signals[chosen].T, np.ones(signals.shape[1])])
        fit = np.linalg.lstsq(with_constant, force.T, rcond=None)[0][:-1]
        values = fit @ fitted.coefficients
        sd = np.sqrt(np.einsum("ij,jk,ik->i", fit, fitted.covariance, fit))
        for i, value, spread in zip(chosen, values, sd, strict=True):
            scale, unit = library.unit_of(terms[i])
            ends = sorted(scale * (value + k * _NORMAL_95 * spread) for k in (-1, 1))
            out.append(
                {
                    "term": terms[i].name,
                    "on": joint,
                    "value": float(scale * value),
                    "unit": unit,
                    "ci95": [float(e) for e in ends],
                    "share": float(share),
                }
            )
    return out


def _readable(family: Family, joint: str) -> list[Term]:
    """Return powers of the variable where a family depends on one coordinate; its own basis functions elsewhere."""
    own = [t for row in family.terms for t in row if t.joint == joint]
    if len(family.depends_on) == 1 and any(t.name.startswith("P") for t in own):
        return [times(joint, {family.depends_on[0]: k}) for k in _POWERS]
    return own


def _fewest(signals: np.ndarray, law: np.ndarray) -> tuple[list[int], float]:
    """Return the indices of the signals (s, n), greedily chosen, that carry 95 % of a law (n,), and what they carry."""
    law = law - law.mean()
    centred = signals - signals.mean(axis=1, keepdims=True)
    total = float(law @ law) or 1.0
    chosen: list[int] = []
    share = 0.0
    while len(chosen) < min(_MOST_TERMS, len(signals)) and share < _ENOUGH:
        left = {}
        for i in set(range(len(signals))) - set(chosen):
            part = centred[[*chosen, i]].T
            rest = law - part @ np.linalg.lstsq(part, law, rcond=None)[0]
            left[i] = float(rest @ rest)
        best = min(left, key=lambda i: left[i])
        chosen.append(best)
        share = 1 - left[best] / total
    return chosen, share


def _curve(fitted: _Fitted, library: Library) -> dict[str, Any] | None:
    """Return the force over the one variable that it depends on, with a 95 % band, without its linear part.

    The linear part is stiffness or damping of the axis; ``total`` is the force with it, as the law's own parameters of
    the system ask for. Only the range that the training trial visited is told.
    """
    family = fitted.family
    if not isinstance(family, Family) or len(family.depends_on) != 1 or len(family.axes) != 1:
        return None
    name = family.depends_on[0]
    if name not in library.ranges or name == "time" or "history" in name:
        return None
    seen, variable = library.ranges[name], library.template[name]
    grid = np.linspace(seen.low, seen.high, _POINTS)
    own = {name: Variable(name, variable.unit, variable.scale, grid)}
    joint = family.terms[0][0].joint
    basis = np.array(
        [sum(t.basis(own, library.ranges, 0.01) * t.factor for t in row) for row in family.terms]
    )
    line = np.column_stack([np.ones(_POINTS), grid])
    total = (basis.T @ fitted.coefficients) * library.force[joint]
    basis = (basis.T - line @ np.linalg.lstsq(line, basis.T, rcond=None)[0]) * library.force[joint]
    mean = basis @ fitted.coefficients
    sd = np.sqrt(np.einsum("ij,jk,ik->i", basis, fitted.covariance, basis))
    unit = "Nm" if library.is_turn(joint) else "N"
    return {
        "variable": name,
        "unit": variable.unit,
        "quantity": f"{'moment' if unit == 'Nm' else 'force'} along {family.axes[0]}",
        "quantity_unit": unit,
        "grid": (grid * variable.scale).tolist(),
        "total": total.tolist(),
        "mean": mean.tolist(),
        "low": (mean - _NORMAL_95 * sd).tolist(),
        "high": (mean + _NORMAL_95 * sd).tolist(),
    }
