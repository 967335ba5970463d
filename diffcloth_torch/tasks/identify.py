"""Identify: fit parameters of a scene to observations of its motion or equilibrium."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checks import FloatArray
from diffcloth_torch.config.documents import resolve_path, set_values
from diffcloth_torch.config.fit_schema import FitConfig, SyntheticSection, TrajectorySection
from diffcloth_torch.config.scenes import select_vertices
from diffcloth_torch.config.schema import RunConfig
from diffcloth_torch.config.validation import validate
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import read_regular_file
from diffcloth_torch.model.quantities import PARAMETERS
from diffcloth_torch.model.scene import Scene
from diffcloth_torch.optimize import residuals
from diffcloth_torch.optimize.compared import noting
from diffcloth_torch.optimize.outlines import silhouettes
from diffcloth_torch.optimize.problem import Residuals
from diffcloth_torch.optimize.starts import Stage
from diffcloth_torch.optimize.variables import Variable
from diffcloth_torch.sim.half_step import at_half_step
from diffcloth_torch.sim.records.controls import Parameters
from diffcloth_torch.sim.records.state import State
from diffcloth_torch.tasks.task import ConfiguredTask
from diffcloth_torch.viewers.fitted import Track

__all__ = ["Identify", "Observations"]

_VELOCITY = "velocity"  # initial velocity of all vertices without pins; not a parameter
_LARGEST_OBSERVATION = 256 << 20  # bytes of a file: one hour of video with a hundred markers
# Smallest tolerance of extrapolated fits, whose evaluations are expensive: a last step of at most
# .3 standard errors, with a thousand residuals.
_ROUGH = 1e-4
_SAME_POINT = 1e-6  # largest distance of vertices of two meshes at one material point, over size


class Identify(ConfiguredTask):
    """A scene with the motion of its configuration, and the observations for the fit."""

    Config = FitConfig

    def __init__(self, config: FitConfig, source: Path) -> None:
        """Build the scene of a configuration that was read from the file `source`."""
        super().__init__(config, source)
        self._fit, self._fit_config, self._source = config.fit, config, source
        for name in config.fit.variables:
            _check_name(f"{source}: `fit.variables`", name)
        names = [section.name for section in config.fit.trajectories]
        if len(set(names)) < len(names):
            raise InvalidInput(f"{source}: `fit.trajectories` must have names that differ: {names}")
        trajectories = [_trajectory(config, section, source) for section in config.fit.trajectories]
        self.observed = Observations([t for t in trajectories if not t.section.hold_out])
        self.held_out = Observations([t for t in trajectories if t.section.hold_out])

    @property
    def checks_step(self) -> bool:
        """True if the bias of the time step is estimated: for motions observed by markers."""
        if self._fit.extrapolate or not self._fit.step_check:
            return False
        sections = self._fit.trajectories
        moves = not all(section.equilibrium for section in sections)
        return moves and all(section.kind == "markers" for section in sections)

    @property
    def order(self) -> float:
        """Power of the time step in the error of motions."""
        return 2.0 if self.simulator.integrator == "second_order" else 1.0

    def finer(self, observed: Observations) -> Observations:
        """Compare these observations with simulations at half the time step."""
        return Observations(
            [
                replace(t, motion=_halved(self._fit_config, t, self._source))
                for t in observed.trajectories
            ]
        )

    def residuals(self) -> Residuals | list[Stage]:
        """The residuals of `fit`; with `extrapolate` its stages, the first without."""
        if not self._fit.extrapolate:
            return self.observed
        tolerance = max(self._fit.tolerance, _ROUGH)
        extrapolated = self._extrapolated(self.observed)
        return [Stage(self.observed, tolerance=tolerance), Stage(extrapolated, tolerance=tolerance)]

    def hold_out(self) -> Residuals | None:
        """The residuals of trajectories that are kept out of the fit."""
        if not len(self.held_out):
            return None
        return self._extrapolated(self.held_out) if self._fit.extrapolate else self.held_out

    def _extrapolated(self, observed: Observations) -> Residuals:
        return residuals.extrapolated(observed, self.finer(observed), order=self.order)

    def variables(self) -> dict[str, Variable]:
        """Make the variables of the fit."""
        return {
            name: Variable(
                section.value,
                bounds=None if section.bounds is None else (section.bounds[0], section.bounds[1]),
                scale=section.scale,
                free=section.free,
                spread=section.spread,
                prior=None if section.prior is None else (section.prior[0], section.prior[1]),
            )
            for name, section in self._fit.variables.items()
        }

    def options(self) -> dict[str, Any]:
        """Give the options of `fit`."""
        return self._fit.model_dump(
            exclude={"variables", "trajectories", "extrapolate", "step_check"}
        )


@dataclass(frozen=True, eq=False)
class _Motion:
    """A scene with the motion of a trajectory.

    `velocity` is the velocity at the real start: in free fall x(t) = v t + g t^2 / 2 at all steps.
    """

    task: ConfiguredTask
    velocity: FloatArray | None
    steps: list[int] | None  # None: at equilibrium

    def simulate(self, values: Mapping[str, Tensor]) -> list[State]:
        """Simulate the observed states at values of the variables."""
        simulator, start = self.task.simulator, self.task.initial_state()
        given: dict[str, Any] = {n: v for n, v in values.items() if n in PARAMETERS}
        parameters = simulator.default_parameters().replace(**given)
        velocity = values.get(_VELOCITY)
        if velocity is None and self.velocity is not None:
            velocity = torch.from_numpy(self.velocity)
        controller = self.task.controller({})
        is_second_order = simulator.integrator == "second_order" and self.steps is not None
        if velocity is None and is_second_order:
            velocity = torch.zeros_like(start.velocities)
        if velocity is not None:
            free = torch.ones_like(start.velocities)
            for pinned in self.task.scene.cloths[0].pins.values():
                free[torch.from_numpy(pinned.astype(np.int64))] = 0.0
            if is_second_order:
                start = start.replace(velocities=free * velocity)
                control = controller(0, start)
                start = at_half_step(start, control, parameters, simulator=simulator)
            else:
                assert parameters.gravity is not None  # the simulator sets it
                # Implicit Euler lets gravity act half a step too long before the first position.
                late = 0.5 * simulator.dt * parameters.gravity
                start = start.replace(velocities=free * (velocity - late))
        if self.steps is None:
            return [simulator.equilibrium(start, controller(0, start), parameters)]
        states = simulator.rollout(start, controller, parameters=parameters, steps=self.steps[-1])
        return [states[k - 1] for k in self.steps]


@dataclass(frozen=True, eq=False)
class _Observed:
    """A motion and its observations."""

    section: TrajectorySection
    motion: _Motion
    vertices: list[int]
    seen: FloatArray

    def residuals(self, values: Mapping[str, Tensor]) -> Tensor:
        """Differences of simulation and observations, divided by the noise."""
        return self._compare(self.motion.simulate(values))

    def track(self, values: Mapping[str, Tensor]) -> Track:
        """The simulated states and their observations, for a viewer."""
        with torch.no_grad(), noting() as notes:
            states = self.motion.simulate(values)
            self._compare(states)
        return Track(states, notes[0].placed)

    def _compare(self, states: list[State]) -> Tensor:
        section = self.section
        if section.kind == "markers":
            return residuals.markers(states, self.seen, vertices=self.vertices, noise=section.noise)
        return residuals.outline(
            states,
            list(self.seen),
            self.motion.task.scene.cloths[0].faces,
            center=section.center,
            directions=section.directions,
            noise=section.noise,
            turned=section.turned,
        )


class Observations:
    """The residuals of trajectories; can be sent to another process."""

    def __init__(self, trajectories: list[_Observed]) -> None:
        self.trajectories = trajectories

    def __len__(self) -> int:
        """Count the trajectories."""
        return len(self.trajectories)

    def __call__(
        self, parameters: Parameters, values: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Return the residuals of each trajectory by its name."""
        given = {n: v for n, v in vars(parameters).items() if isinstance(v, Tensor)}
        return {t.section.name: t.residuals(given | dict(values or {})) for t in self.trajectories}

    def scenes(self) -> list[Scene]:
        """Give the scene of each trajectory."""
        return [t.motion.task.scene for t in self.trajectories]

    def tracks(self, values: Mapping[str, Tensor]) -> list[Track]:
        """Simulate each trajectory at values of all variables, for a viewer."""
        return [t.track(values) for t in self.trajectories]


def _trajectory(config: FitConfig, section: TrajectorySection, source: Path) -> _Observed:
    motion = _motion(config, section, section.changes, source, section.steps)
    cloth = motion.task.scene.cloths[0]
    vertices = list(range(len(cloth.vertices)))
    if section.markers is not None:
        name = f"fit.trajectories.{section.name}.markers"
        vertices = [int(i) for i in select_vertices(name, section.markers, cloth.vertices)]
    if section.synthetic is not None:
        seen = _synthesize(config, section, section.synthetic, source, motion, vertices)
    else:
        assert section.file is not None  # the schema requires one of the two
        seen = _read(resolve_path(source, config.root, section.file), section, len(vertices))
    return _Observed(section, motion, vertices, seen)


def _halved(config: FitConfig, observed: _Observed, source: Path) -> _Motion:
    """Return the motion at half the time step."""
    section, task = observed.section, observed.motion.task
    changes = [
        *section.changes,
        f"simulation.dt={task.simulator.dt / 2!r}",
        f"simulation.steps={2 * task.steps}",
    ]
    steps = None if section.steps is None else [2 * k for k in section.steps]
    return _motion(config, section, changes, source, steps)


def _motion(
    config: FitConfig,
    section: TrajectorySection,
    changes: list[str],
    source: Path,
    steps: list[int] | None,
) -> _Motion:
    document = config.model_dump(mode="json", exclude_unset=True)
    del document["fit"]
    changed = validate(RunConfig, set_values(document, changes), source)
    task = ConfiguredTask(changed, source)
    if len(task.scene.cloths) != 1:
        raise InvalidInput(
            f"{source}: `scene.cloths` must have one cloth to fit, got {len(task.scene.cloths)}"
        )
    velocity = None if section.velocity is None else np.array(section.velocity)
    if steps is not None and steps[-1] > task.steps:
        raise InvalidInput(
            f"{source}: `fit.trajectories.{section.name}.steps` must be at most "
            f"`simulation.steps`, {task.steps}, got {steps[-1]}"
        )
    return _Motion(task, velocity, steps)


def _synthesize(
    config: FitConfig,
    section: TrajectorySection,
    synthetic: SyntheticSection,
    source: Path,
    motion: _Motion,
    vertices: list[int],
) -> FloatArray:
    """Simulate synthetic observations, on a mesh of their own, and add noise."""
    where = f"{source}: `fit.trajectories.{section.name}.synthetic`"
    for name in synthetic.values:
        _check_name(where, name)
    changes = [*section.changes, *synthetic.changes]
    other = _motion(config, section, changes, source, None)
    if section.steps is not None:
        ratio = motion.task.simulator.dt / other.task.simulator.dt
        if abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
            raise InvalidInput(f"{where}.changes must divide the time step, got {ratio:g} parts")
        later = [round(ratio) * k for k in section.steps]
        other = _motion(config, section, changes, source, later)
    values = {name: cpu.tensor(value) for name, value in synthetic.values.items()}
    with torch.no_grad():
        states = other.simulate(values)
    generator = np.random.default_rng(synthetic.seed)
    if section.kind == "markers":
        rows = _same_points(where, motion.task, other.task, vertices)
        seen: FloatArray = torch.stack([state.positions for state in states]).numpy()[:, rows]
        return seen + section.noise * generator.standard_normal(seen.shape)
    center = np.array(section.center)
    radii, rays = silhouettes(
        "fit", states, other.task.scene.cloths[0].faces, center, section.directions
    )
    numbers = radii.numpy() + section.noise * generator.standard_normal(radii.shape)
    outlines: FloatArray = center + numbers[..., None] * rays
    return outlines


def _same_points(
    where: str, task: ConfiguredTask, other: ConfiguredTask, vertices: list[int]
) -> list[int]:
    """Vertices of another mesh at the same material points, by their rest positions."""
    from scipy.spatial import cKDTree

    cloths = [t.scene.cloths[0] for t in (task, other)]
    if any(cloth.has_seams for cloth in cloths):
        raise InvalidInput(
            f"{where} must have cloths whose rest meshes have no seams, where each vertex has one "
            "place at rest"
        )
    mine, theirs = (cloth.rest_embedding for cloth in cloths)
    distances, rows = cKDTree(theirs).query(mine[vertices])
    if distances.max() > _SAME_POINT * float(np.ptp(mine, axis=0).max()):
        raise InvalidInput(
            f"{where} must have a vertex at each marker: the nearest one to vertex "
            f"{vertices[int(distances.argmax())]} is {distances.max():.3g} m away at rest; "
            "halve the edges of a grid"
        )
    return [int(i) for i in rows]


def _read(file: Path, section: TrajectorySection, markers: int) -> FloatArray:
    """Positions [T, m, 3] or outlines [T, n, 2] of a file."""
    name, last = ("positions", 3) if section.kind == "markers" else ("outlines", 2)
    content = BytesIO(read_regular_file(file, _LARGEST_OBSERVATION))
    try:
        with np.load(content, allow_pickle=False) as arrays:
            found = np.array(arrays[name], dtype=np.float64)
    except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
        raise InvalidInput(f"{file}: must be an .npz with the array `{name}`: {error}") from error
    frames = 1 if section.steps is None else len(section.steps)
    wanted: list[Any] = [frames, markers if section.kind == "markers" else "n", last]
    if found.ndim != 3 or any(
        isinstance(w, int) and w != n for w, n in zip(wanted, found.shape, strict=True)
    ):
        raise InvalidInput(f"{file}: `{name}` must have shape {wanted}, got {list(found.shape)}")
    return found


def _check_name(where: str, name: str) -> None:
    if name not in PARAMETERS and name != _VELOCITY:
        raise InvalidInput(f"{where} may name {_VELOCITY}, {', '.join(PARAMETERS)}; got {name!r}")
