"""What every mechanism is told (scales, place, fields of the batch), and what several of them build."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from real2sim.geometry import AXES
from real2sim.system.plant import STRAP_JOINTS

# A dead band's end that is never reached [m, rad]
FAR = 10.0


@dataclass(frozen=True)
class Scales:
    """What the effects' parameters are measured in, for one person.

    ``q``, ``v`` (6,) are large excursions and rates of the interface [m, rad; m/s, rad/s], ``k``, ``d`` (6,) stiffness
    and damping of the plain fit, ``inertia`` (6,) what the robot puts against each strap axis [kg, kg m^2].
    """

    q: np.ndarray
    v: np.ndarray
    k: np.ndarray
    d: np.ndarray
    inertia: np.ndarray

    @property
    def force(self) -> np.ndarray:
        """Strap force in a large excursion (6,) [N, Nm]."""
        return self.k * self.q + self.d * self.v


class Mechanism(Protocol):
    """How an effect of the plant is compiled into it and set per simulation."""

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add elements to the plant, neutral or not."""

    def set(self, fields: Fields, where: Where, parameters: np.ndarray, values: np.ndarray) -> None:
        """Write values (m, p) [SI] and what follows from the strap parameters (m, 12) into the fields."""


@dataclass(frozen=True)
class Where:
    """Where an effect acts: axis indices, a side (+1, -1, or 0 for none), a variant of its form; and whose it is."""

    axes: tuple[int, ...] = ()
    side: int = 0
    variant: str = ""
    owner: str = ""

    @property
    def tag(self) -> str:
        """Suffix for the names of what is built there."""
        side = {1: "_upper", -1: "_lower", 0: ""}[self.side]
        return "_".join(AXES[a] for a in self.axes) + side + self.variant

    @property
    def element(self) -> str:
        """Ending of the names of elements in the model: no two effects share them."""
        return f"{self.owner}_{self.tag}"


class Fields:
    """Fields of the plant's batch, expanded per simulation when they are first asked for."""

    def __init__(self, batch, model: mujoco.MjModel, m: int, scales: Scales):
        self._batch, self.model, self.m, self.scales = batch, model, m, scales

    def __getitem__(self, name: str) -> np.ndarray:
        return self._batch.expand(name)[: self.m]

    def joint(self, axis: int) -> int:
        """Joint index of a strap axis."""
        return self.model.joint(STRAP_JOINTS[axis]).id

    def dof(self, axis: int) -> int:
        """Degree of freedom of a strap axis."""
        return int(self.model.joint(STRAP_JOINTS[axis]).dofadr[0])

    def tendon(self, name: str) -> int:
        """Index of a tendon."""
        return self.model.tendon(name).id

    def stiffest(self, axis: int) -> float:
        """Stiffness that the time step bears on a strap axis."""
        return float(0.5 * self.scales.inertia[axis] / self.model.opt.timestep**2)

    def hardest(self, axis: int) -> float:
        """Damping that the time step bears on a strap axis where it is not part of MuJoCo's implicit damping."""
        return float(0.5 * self.scales.inertia[axis] / self.model.opt.timestep)


def add_tendon(spec: mujoco.MjSpec, name: str, joints: dict[str, float], **attributes) -> None:
    """Add a fixed tendon over joints with coefficients to the plant; ``attributes`` are MuJoCo's."""
    tendon = spec.add_tendon(name=name, **attributes)
    for joint, coefficient in joints.items():
        tendon.wrap_joint(joint, coefficient)


def add_branch(spec: mujoco.MjSpec, name: str, joint: str) -> None:
    """A spring and a damper in series on a joint, at rest where that is zero."""
    body = spec.worldbody.add_body(
        name=name, mass=1e-6, inertia=[1e-9] * 3, explicitinertial=True, gravcomp=1
    )
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], damping=[1, 0, 0])
    add_tendon(spec, name, {joint: 1.0, name: -1.0}, stiffness=[1, 0, 0], springlength=[0, 0])


def set_branch(fields: Fields, name: str, stiffness: np.ndarray, time_constant: np.ndarray) -> None:
    """Values (m,) of a branch. The slide needs no inertia: its damping is implicit."""
    fields["tendon_stiffness"][:, fields.tendon(name)] = stiffness
    fields["dof_damping"][:, int(fields.model.joint(name).dofadr[0])] = stiffness * time_constant
