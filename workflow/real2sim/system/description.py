"""A system as its YAML describes it: machine, interface, drive, markers, outputs and parameters.

Nothing here knows a lab, an effect or a person. A description stands beside the MJCF of the machine; what is measured
(rest pose, start, paths) comes with each recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.signals import Scatter

POSE, PATH, FORCE = "pose", "path", "force"
STIFFNESS, DAMPING, MASS = "stiffness", "damping", "mass"
# Unit of what a parameter sets, of a translation and of a rotation; a mass is one of a body
_UNITS = {
    STIFFNESS: ("N/m", "Nm/rad"),
    DAMPING: ("Ns/m", "Nms/rad"),
    MASS: ("kg", "kg"),
    "offset": ("N", "Nm"),
}
BASE_JOINTS = ("base_x", "base_y", "base_yaw")
ARM_JOINTS = ("arm_lift", "arm_roll", "arm_pitch")


@dataclass(frozen=True)
class Impedance:
    """Stiffness [N/m, Nm/rad] and damping [Ns/m, Nms/rad] of the controller that holds one joint."""

    stiffness: float
    damping: float


@dataclass(frozen=True)
class MachineJoint:
    """One joint of the machine: its controller's impedance (None: passive), and whether its position is logged.

    ``trusted_to`` [m, rad]: no residual of its log is trusted beyond this, nor beyond its ``scatter`` from repeat to
    repeat.
    """

    name: str
    impedance: Impedance | None = None
    logged: bool = True
    trusted_to: float = 1e-4
    scatter: Scatter | None = None


@dataclass(frozen=True)
class Axis:
    """One coordinate of the interface: ``name`` in tables and answers, ``joint`` in the model.

    ``direction`` (3,) is its axis in the segment's frame at rest where the plant makes the joint, None where the joint
    stands in the machine's MJCF.
    """

    name: str
    joint: str
    rotational: bool
    direction: tuple[float, float, float] | None = None

    @property
    def unit(self) -> str:
        """Unit of the coordinate."""
        return "rad" if self.rotational else "m"


@dataclass(frozen=True)
class Drive:
    """Source of motion of a replay: the pose of a segment, the path of joints, or forces on joints.

    ``columns`` maps joints of the model to the columns of a recording that hold their path or force. ``held``: a force
    keeps its value from each sample to the next, as a command does, and is not a signal that was sampled.
    """

    by: str
    columns: Mapping[str, str]
    held: bool = False


@dataclass(frozen=True)
class Markers:
    """Markers on the driven segment and on the interface, and how they make a frame.

    ``sites`` maps each interface marker to the site of the machine's MJCF where it sits.
    """

    segment: tuple[str, ...] = ()
    segment_frame: str = "points"
    sites: Mapping[str, str] | None = None
    interface_frame: str = "points"

    @property
    def interface(self) -> tuple[str, ...]:
        """Names of the interface's markers."""
        return tuple(self.sites or ())


@dataclass(frozen=True)
class Output:
    """A measured column: ``quantity`` ("position", "velocity" or "force") of a joint of the model.

    ``trusted_to`` is the SD below which no residual is trusted, in the column's unit; 0 where its noise alone counts.
    ``zero_sd``: the zero of the column differs so much from recording to recording (SD), as that of a force sensor
    does; 0 where it stays. ``scatter`` is the column's noise from repeat to repeat, where that was measured: no
    residual is trusted beyond it.
    """

    column: str
    joint: str
    quantity: str = "position"
    trusted_to: float = 0.0
    zero_sd: float = 0.0
    scatter: Scatter | None = None


@dataclass(frozen=True)
class Parameter:
    """One number that a fit finds: name, unit, bounds, and what it is in the model.

    ``sets`` is "stiffness" or "damping" of the axis ``of``, "mass" of the body ``of``, or "offset": a constant force on
    the joint of the axis ``of``. ``log``: searched by its logarithm, which needs positive bounds.
    """

    name: str
    unit: str
    lower: float
    upper: float
    sets: str
    of: str
    log: bool = True


@dataclass(frozen=True)
class System:
    """A machine, the interface at its end and what moves them; see docs/library.md.

    ``model`` is the MJCF of the machine, ``body`` the machine's body that the interface hangs on, ``segment`` the body
    that the plant hangs behind it (None where all joints stand in the MJCF). ``rest`` says where the coordinates are
    zero: "quiet" (mean over a quiet recording) or "model". ``band_hz``: what is faster in a recording is noise.
    ``step_s`` is the largest time step of a simulation.
    """

    name: str
    model: Path
    machine: tuple[MachineJoint, ...]
    axes: tuple[Axis, ...]
    drive: Drive
    parameters: tuple[Parameter, ...]
    outputs: tuple[Output, ...] = ()
    markers: Markers = Markers()
    body: str = ""
    segment: str | None = None
    rest: str = "model"
    about: str = ""
    band_hz: float = 10.0
    step_s: float = 0.004

    @classmethod
    def from_yaml(cls, path: Path | str) -> System:
        """Read a description.

        Raises
        ------
        InputError
            Naming the file and the key, where it is not one.
        """
        path = Path(path)
        return cls.from_dict(read_yaml(path), path)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], source: Path | str = "system") -> System:
        """As `from_yaml`, of its content; ``model`` is relative to the folder of ``source``."""
        source = Path(source)
        c = validated(content, "system", source)
        interface = c["interface"]
        system = cls(
            c["name"],
            (source.parent / c["model"]).resolve(),
            tuple(_machine_joint(name, given) for name, given in c["machine"].items()),
            tuple(_axis(name, given) for name, given in interface["axes"].items()),
            Drive(c["drive"]["by"], dict(c["drive"]["of"]), c["drive"]["held"]),
            tuple(_parameter(name, given) for name, given in c["parameters"].items()),
            tuple(Output(name, **given) for name, given in c["outputs"].items()),
            _markers(c["markers"]),
            interface["body"],
            interface["segment"],
            interface["rest"],
            c["about"],
            float(c["band_hz"]),
            float(c["step_s"]),
        )
        system._check(source)
        system._check_outputs(source)
        return system

    def _check_outputs(self, source: Path) -> None:
        """Refuse the force on a joint that follows no path: only that of a prescribed motion is simulated."""
        driven = tuple(self.drive.columns) if self.drive.by == PATH else ()
        for output in self.outputs:
            if output.quantity == "force" and output.joint not in driven:
                raise InputError(
                    source,
                    f"outputs.{output.column}",
                    f"the force on joint {output.joint}, which follows no path",
                    f"a joint of drive.of that is driven by path ({', '.join(driven) or 'none is'})",
                    "Drive it by path, or measure its position.",
                    "value",
                )

    def _check(self, source: Path) -> None:
        """Refuse what contradicts itself."""
        targets = {axis.name for axis in self.axes}
        for p in self.parameters:
            if p.sets != MASS and p.of not in targets:
                raise InputError(
                    source,
                    f"parameters.{p.name}.of",
                    p.of,
                    f"one of {', '.join(targets)}",
                    "Name an axis.",
                    "value",
                )
            if not p.lower < p.upper or (p.log and p.lower <= 0):
                expected = "lower < upper" + (", both positive where log is true" if p.log else "")
                raise InputError(
                    source,
                    f"parameters.{p.name}.bounds",
                    f"[{p.lower}, {p.upper}]",
                    expected,
                    "Correct the bounds.",
                    "value",
                )
            if any(other.sets == p.sets and other.of == p.of for other in self.parameters if other is not p):
                raise InputError(
                    source,
                    f"parameters.{p.name}",
                    f"a second parameter that sets the {p.sets} of {p.of}",
                    "one parameter for each",
                    "Remove one of them.",
                    "value",
                )
        if self.rest == "quiet" and self.drive.by != POSE:
            raise InputError(
                source,
                "interface.rest",
                f"quiet, and a drive by {self.drive.by}",
                "rest: model, where joints of the MJCF are read as they are",
                "Take the rest position off the recordings' columns, or set the joint's springref in the MJCF.",
                "value",
            )
        if self.drive.by == POSE and self.segment is None:
            raise InputError(
                source,
                "interface.segment",
                "none",
                "the body that is driven by a pose",
                "Name the segment.",
                "value",
            )
        if self.drive.by != POSE and not self.drive.columns:
            raise InputError(
                source,
                "drive.of",
                "nothing",
                "joint: column of the recording",
                "Name what is driven.",
                "value",
            )

    def check_units(self) -> None:
        """Refuse a unit that is not that of what its parameter sets: numbers are searched and printed in SI.

        Raises
        ------
        InputError
            Naming the parameter and its unit.
        """
        rotational = {axis.name: axis.rotational for axis in self.axes}
        for p in self.parameters:
            linear, angular = _UNITS[p.sets]
            unit = angular if rotational.get(p.of, False) else linear
            if _bare(p.unit) != _bare(unit):
                raise InputError(
                    self.name,
                    f"parameters.{p.name}.unit",
                    p.unit,
                    f"{unit}, the unit of the {p.sets} of {p.of}",
                    "Give bounds in this unit, and correct it.",
                    "value",
                )

    def trusting(self, levels: Mapping[str, float | Scatter]) -> System:
        """The same system whose outputs and logs are trusted no further than ``levels``, by column.

        A level is a `Scatter` from repeats (`Recording.scatter_of_repeats`), of which simulated noise is a part, or an
        SD in the column's unit, which comes beside it. Columns that it does not name stay as they are; an SD that is
        larger already stays too.
        """
        units = self.joint_units
        outputs = tuple(_trusted(o, levels.get(o.column)) for o in self.outputs)
        machine = tuple(_trusted(j, levels.get(f"{j.name}_{units[j.name]}")) for j in self.machine)
        return replace(self, outputs=outputs, machine=machine)

    def with_model(
        self,
        model: Path,
        impedances: Mapping[str, Mapping[str, float]] | None = None,
        bounds: Mapping[str, Any] | None = None,
    ) -> System:
        """The same system with another MJCF, other impedances by machine joint and other bounds by parameter."""
        machine = tuple(
            replace(j, impedance=Impedance(impedances[j.name]["stiffness"], impedances[j.name]["damping"]))
            if impedances and j.name in impedances
            else j
            for j in self.machine
        )
        parameters = tuple(
            replace(p, lower=float(bounds[p.name][0]), upper=float(bounds[p.name][1]))
            if bounds and p.name in bounds
            else p
            for p in self.parameters
        )
        return replace(self, model=Path(model), machine=machine, parameters=parameters)

    @cached_property
    def offers(self) -> frozenset[str]:
        """Properties that effects may need (`Effect.needs`): the kind of drive, joints, markers and axes.

        A base of three joints and its arm are told by these; the joints of any other machine one by one.
        """
        found = {self.drive.by}
        names = {joint.name for joint in self.machine}
        if set(BASE_JOINTS) <= names:
            found.add("base")
        else:
            found |= {"passive_joints" if j.impedance is None else "controllers" for j in self.machine}
        if set(ARM_JOINTS) <= names:
            found.add("arm")
        if self.body:
            found.add("interface_body")
        if len(self.axes) == 6 and [axis.rotational for axis in self.axes] == [False] * 3 + [True] * 3:
            found.add("six_axes")
        if self.markers.interface:
            found.add("markers")
        if self.markers.interface_frame == "bar":
            found.add("bar")
        if self.markers.segment_frame == "pelvis":
            found.add("pelvis_markers")
        return frozenset(found)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the interface's coordinates, in order."""
        return tuple(axis.name for axis in self.axes)

    @property
    def axis_joints(self) -> tuple[str, ...]:
        """Joints of the interface in the model, in the order of the axes."""
        return tuple(axis.joint for axis in self.axes)

    @property
    def machine_joints(self) -> tuple[str, ...]:
        """Joints of the machine, in order."""
        return tuple(joint.name for joint in self.machine)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def joint_units(self) -> dict[str, str]:
        """Unit of each joint of the machine's MJCF, by name: m for a slide, rad for a hinge."""
        # a description is read where no simulator is: only its joints need one
        import mujoco

        from real2sim.system.mjcf import read_model

        slide = mujoco.mjtJoint.mjJNT_SLIDE
        spec = read_model(self.model)
        return {joint.name: "m" if joint.type == slide else "rad" for joint in spec.joints}

    @cached_property
    def stiffness_of_axis(self) -> dict[int, int]:
        """Index of the parameter that is the stiffness of an axis, by axis index; axes without one are missing."""
        return self._index(STIFFNESS)

    @cached_property
    def damping_of_axis(self) -> dict[int, int]:
        """Index of the parameter that is the damping of an axis, by axis index; axes without one are missing."""
        return self._index(DAMPING)

    def _index(self, sets: str) -> dict[int, int]:
        axes = {axis.name: i for i, axis in enumerate(self.axes)}
        return {axes[p.of]: i for i, p in enumerate(self.parameters) if p.sets == sets}

    @cached_property
    def _log(self) -> np.ndarray:
        return np.array([p.log for p in self.parameters], dtype=bool)

    def values(self, z: np.ndarray) -> np.ndarray:
        """Parameters (..., n) [SI] of searched numbers (..., n): logarithms where the parameter is searched so."""
        if self._log.all():
            return np.asarray(np.exp(z))
        return np.where(self._log, np.exp(np.where(self._log, z, 0.0)), z)

    def searched(self, values: np.ndarray) -> np.ndarray:
        """Return the searched numbers (..., n) of parameters (..., n) [SI]: the inverse of `values`."""
        if self._log.all():
            return np.asarray(np.log(values))
        return np.where(self._log, np.log(np.where(self._log, values, 1.0)), values)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (n,) of the searched numbers."""
        lower = np.array([p.lower for p in self.parameters], dtype=float)
        upper = np.array([p.upper for p in self.parameters], dtype=float)
        return self.searched(lower), self.searched(upper)


def _machine_joint(name: str, given: Mapping[str, Any]) -> MachineJoint:
    held = given["stiffness"] is not None or given["damping"] is not None
    impedance = Impedance(float(given["stiffness"] or 0.0), float(given["damping"] or 0.0)) if held else None
    return MachineJoint(name, impedance, given["logged"], float(given["trusted_to"]))


_Channel = TypeVar("_Channel", Output, MachineJoint)


def _trusted(channel: _Channel, level: float | Scatter | None) -> _Channel:
    if isinstance(level, Scatter):
        return replace(channel, scatter=level)
    return replace(channel, trusted_to=max(channel.trusted_to, float(level or 0.0)))


def _axis(name: str, given: Mapping[str, Any]) -> Axis:
    direction = given["axis"]
    x, y, z = direction or (0.0, 0.0, 0.0)
    made = (float(x), float(y), float(z)) if direction else None
    return Axis(name, given["joint"] or name, given["type"] == "hinge", made)


def _parameter(name: str, given: Mapping[str, Any]) -> Parameter:
    lower, upper = given["bounds"]
    return Parameter(
        name, given["unit"], float(lower), float(upper), given["sets"], given["of"], given["log"]
    )


def _markers(given: Mapping[str, Any]) -> Markers:
    segment, interface = given["segment"], given["interface"]
    return Markers(
        tuple(segment["names"]), segment["frame"], dict(interface["sites"]) or None, interface["frame"]
    )


def _bare(unit: str) -> str:
    """Return a unit without the signs of multiplication that some write: N·m/rad is Nm/rad."""
    return "".join(letter for letter in unit if letter not in " ·*.")


@cache
def shipped_system(name: str) -> System:
    """Return a system that comes with the library, as its description says."""
    return System.from_yaml(shipped(name) / "system.yaml")


def shipped(name: str) -> Path:
    """Folder of a system that comes with the library: system.yaml, MJCF, page."""
    package = Path(__file__).parents[1]
    for folder in (package / "systems" / name, package.parents[1] / "resources" / "systems" / name):
        if folder.is_dir():
            return folder
    raise InputError(
        name, "", "no such system", "a system of resources/systems", "Correct the name.", "no_file"
    )
