"""Frames of markers, and joint positions at which a plant shows what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from real2sim.geometry import pelvis_frame
from real2sim.system.described_plant import DRIVEN_SITE
from real2sim.system.description import System

# Weights of what has to hold exactly, of markers and of logs, in units of 1/m and 1/rad
_EXACT, _MARKER, _LOG, _NEAR = 1e6, 1e3, 1e4, 1e-3
_ROUNDS, _SMALL = 30, 1e-10


def frame_markers(system: System) -> tuple[str, ...]:
    """Return the markers that the frame of the driven segment is computed from: it is unknown without any of them."""
    return system.markers.segment[: 4 if system.markers.segment_frame == "pelvis" else 3]


def segment_frame(system: System, markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (n, 3, 3) and origin (n, 3) [m] of the driven segment, of its markers (n, k, 3) [m].

    The first of them are those of `frame_markers`; others count for nothing.
    """
    if system.markers.segment_frame == "pelvis":
        return pelvis_frame(*np.moveaxis(markers[:, :4], 1, 0))
    first, second, third = np.moveaxis(markers[:, :3], 1, 0)
    x = _unit(second - first)
    z = _unit(np.cross(x, third - first))
    return np.stack([x, np.cross(z, x), z], axis=-1), first


def rigid_pose(places: np.ndarray, markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (n, 3, 3) and position (n, 3) [m] of the mean of ``places``, by least squares.

    ``places`` (k, 3) [m] are where markers (n, k, 3) [m] sit on a body. Two markers leave the turn about their line
    open: it is the smallest one.
    """
    centred = places - places.mean(axis=0)
    middle = markers.mean(axis=1)
    covariance = np.einsum("nki,kj->nij", markers - middle[:, None], centred)
    if len(places) == 2:
        # any turn about the line fits; the one nearest to no turn
        covariance = covariance + 1e-6 * np.linalg.norm(centred) ** 2 * np.eye(3)
    u, _, vt = np.linalg.svd(covariance)
    sign = np.linalg.det(u @ vt)
    diagonal = np.zeros_like(covariance)
    diagonal[:, 0, 0] = diagonal[:, 1, 1] = 1
    diagonal[:, 2, 2] = sign
    return u @ diagonal @ vt, middle


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


@dataclass(frozen=True)
class Sample:
    """Measurements of one instant: pose of the segment, interface markers (k, 3) [m], logged joints.

    ``logged`` maps joints to positions [m, rad]; poses and markers are None for a system without a segment.
    """

    logged: dict[str, float]
    rotation: np.ndarray | None = None
    position: np.ndarray | None = None
    markers: np.ndarray | None = None


class Solver:
    """Joint positions of a plant that fit a sample: segment and loops exactly, the rest by least squares."""

    def __init__(self, model: mujoco.MjModel, sites: Sequence[str]):
        self._model, self._data = model, mujoco.MjData(model)
        self._sites = [model.site(name).id for name in sites]

    def solve(self, sample: Sample, start: np.ndarray) -> np.ndarray:
        """Return joint positions (nq,), from ``start`` (nq,)."""
        data, model = self._data, self._model
        data.qpos[:] = start
        for _ in range(_ROUNDS):
            residual, jacobian = self._linearise(sample)
            near = _NEAR * np.eye(model.nv)
            rows = np.vstack([jacobian, near])
            step = np.linalg.lstsq(rows, np.concatenate([-residual, np.zeros(model.nv)]), rcond=None)[0]
            mujoco.mj_integratePos(model, data.qpos, step, 1.0)
            if np.abs(step).max(initial=0.0) < _SMALL:
                break
        return np.asarray(data.qpos.copy())

    def rates(self, twist: np.ndarray | None, logged: dict[str, float]) -> np.ndarray:
        """Return joint rates (nv,) at the last solution, for the segment's twist (6,) and rates of logged joints."""
        model, data = self._model, self._data
        rows, values = [], []
        if twist is not None:
            rows.append(_EXACT * self._segment_jacobian())
            values.append(_EXACT * twist)
        loops = self._loop_jacobian()
        rows.append(_EXACT * loops)
        values.append(np.zeros(len(loops)))
        for joint, rate in logged.items():
            row = np.zeros((1, model.nv))
            row[0, model.joint(joint).dofadr[0]] = _LOG
            rows.append(row)
            values.append(np.array([_LOG * rate]))
        rows.append(_NEAR * np.eye(model.nv))
        values.append(np.zeros(model.nv))
        del data
        return np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0]

    def _linearise(self, sample: Sample) -> tuple[np.ndarray, np.ndarray]:
        """Weighted residuals (r,) and their Jacobian (r, nv)."""
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        residuals, rows = [], []
        if sample.rotation is not None and sample.position is not None:
            site = model.site(DRIVEN_SITE).id
            turn = data.site_xmat[site].reshape(3, 3) @ sample.rotation.T
            vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
            residuals += [_EXACT * (data.site_xpos[site] - sample.position), _EXACT * vector]
            rows.append(_EXACT * self._segment_jacobian())
        if sample.markers is not None:
            jac = np.zeros((3, model.nv))
            for site, marker in zip(self._sites, sample.markers, strict=True):
                mujoco.mj_jacSite(model, data, jac, None, site)
                if np.isfinite(marker).all():
                    residuals.append(_MARKER * (data.site_xpos[site] - marker))
                    rows.append(_MARKER * jac.copy())
        for joint, value in sample.logged.items():
            index = model.joint(joint)
            row = np.zeros((1, model.nv))
            row[0, index.dofadr[0]] = _LOG
            residuals.append(np.array([_LOG * (data.qpos[index.qposadr[0]] - value)]))
            rows.append(row)
        loops = self._loop_jacobian()
        if len(loops):
            residuals.append(_EXACT * self._loop_gap())
            rows.append(_EXACT * loops)
        if not residuals:
            return np.zeros(0), np.zeros((0, model.nv))
        return np.concatenate(residuals), np.vstack(rows)

    def _segment_jacobian(self) -> np.ndarray:
        model = self._model
        out = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, self._data, out[:3], out[3:], model.site(DRIVEN_SITE).id)
        return out

    def _loops(self) -> tuple[np.ndarray, np.ndarray]:
        """Gap and Jacobian of the model's equality constraints at the present positions."""
        model, data = self._model, self._data
        if not model.neq:
            return np.zeros(0), np.zeros((0, model.nv))
        mujoco.mj_fwdPosition(model, data)
        equal = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        dense = np.zeros((data.nefc, model.nv))
        if mujoco.mj_isSparse(model):
            mujoco.mju_sparse2dense(
                dense, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
            )
        else:
            dense = data.efc_J.reshape(-1, model.nv)[: data.nefc]
        return data.efc_pos[: data.nefc][equal].copy(), dense[equal]

    def _loop_gap(self) -> np.ndarray:
        return self._loops()[0]

    def _loop_jacobian(self) -> np.ndarray:
        return self._loops()[1]
