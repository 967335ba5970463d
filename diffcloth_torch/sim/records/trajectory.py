"""The states of a rollout: a list that also has their fields over time."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any, SupportsIndex, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.animation.formats import ANIMATIONS
from diffcloth_torch.animation.surfaces import Animation, MovingSurface
from diffcloth_torch.autograd.torch_private import register_tree
from diffcloth_torch.autograd.transforms import numbers_of
from diffcloth_torch.checks import FloatArray, float_tensor
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.files import as_path, replace_file
from diffcloth_torch.geometry.poses import poses_of_frames
from diffcloth_torch.model.quantities import STATE, Fields
from diffcloth_torch.sim.records.state import State, check_shapes, check_state

__all__ = ["Trajectory", "check_ending"]

_FILES = (".pt", ".npz")  # with data; the others are animations

_ROUNDING = 1e-9  # of the largest time, by which a time may be outside
_ONE_STEP = 1e-6  # share of the largest displacement by which two states may differ from one step


class Trajectory(list[State]):
    """A list of successive states that also has each of their fields, stacked over time.

    `positions` has shape [T, N, 3], or [T, B, N, 3] in a batch, and likewise all other fields of
    `State`; they carry gradients. A slice is a trajectory too. A trajectory is a pytree of torch
    whose branches are its states.
    """

    def __getattr__(self, name: str) -> Tensor:
        if name not in STATE:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        if not self:
            raise InvalidInput(f"Trajectory: `{name}` needs at least one state, got none")
        return torch.stack([getattr(state, name) for state in self])

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *STATE]

    @overload
    def __getitem__(self, index: SupportsIndex) -> State: ...

    @overload
    def __getitem__(self, index: slice) -> Trajectory: ...

    def __getitem__(self, index: SupportsIndex | slice) -> State | Trajectory:
        """Select one state, or several as a trajectory."""
        found = super().__getitem__(index)
        return Trajectory(found) if isinstance(found, list) else found

    def __repr__(self) -> str:
        return f"Trajectory({len(self)} states)"

    def at(self, times: object) -> Tensor:
        """Positions between the states: cubic in time, by positions and velocities.

        Velocities of states are means over the step that led to them, with both integrators.
        Between two states that are one step apart, the velocity at the first is therefore the mean
        of both; at other states it is the one that they have, which is half a step early. Keep all
        steps where the step is not short beside the motion.

        >>> dc.Trajectory([start, *states]).at(camera_times - delay)

        Args:
            times: K times [s] from that of the first state to that of the last one; they may
                require gradients, as a delay does that is to be found.

        Returns:
            Positions [m], shape [K, N, 3], or [K, B, N, 3] in a batch whose environments have one
            time; differentiable in states and times.

        Raises:
            InvalidInput: If a time is outside, or there are fewer than two states.
        """
        owner = "Trajectory.at"
        known = self._times(owner)
        asked = float_tensor(f"{owner}: `times`", times)
        if asked.dim() != 1:
            raise InvalidInput(f"{owner}: `times` must have shape [K], got {list(asked.shape)}")
        numbers = numbers_of(asked)
        # Rounding may move a time beyond the ends, if a camera has the period of the steps.
        slack = _ROUNDING * max(abs(known[0]), abs(known[-1]))
        outside = ~((numbers >= known[0] - slack) & (numbers <= known[-1] + slack))
        if outside.any():
            k = int(np.flatnonzero(outside)[0])
            raise InvalidInput(
                f"{owner}: `times` must be between {known[0]:.6g} and {known[-1]:.6g} s, those of "
                f"the first and the last state, got {numbers[k]:.6g} at [{k}]"
            )
        rows = np.clip(np.searchsorted(known, numbers, side="right") - 1, 0, len(known) - 2)
        before, after = torch.from_numpy(rows), torch.from_numpy(rows + 1)
        clock = torch.from_numpy(known)
        step = (clock[after] - clock[before]).reshape(-1, *[1] * self[0].positions.dim())
        s = (asked - clock[before]).reshape(step.shape) / step
        x = self.positions
        v = self._velocities_in_time(x, clock)
        # Hermite's cubics, with the velocities in steps.
        return (
            (1 + 2 * s) * (1 - s) ** 2 * x[before]
            + s * (1 - s) ** 2 * step * v[before]
            + s**2 * (3 - 2 * s) * x[after]
            + s**2 * (s - 1) * step * v[after]
        )

    def _velocities_in_time(self, positions: Tensor, clock: Tensor) -> Tensor:
        """Velocities at the times of the states: means of two steps where both are known."""
        v = self.velocities
        x, steps = torch.from_numpy(numbers_of(positions)), torch.from_numpy(numbers_of(v))[1:]
        moved = x.diff(dim=0)
        times = clock.diff().reshape(-1, *[1] * (x.dim() - 1))
        left = (moved - times * steps).abs().amax(dim=tuple(range(1, x.dim())))
        is_one_step = left <= _ONE_STEP * moved.abs().max()
        weights = (0.5 * is_one_step).to(v.dtype).reshape(times.shape)
        return torch.cat([v[:-1] + weights * (v[1:] - v[:-1]), v[-1:]])

    def _times(self, owner: str) -> FloatArray:
        """Times of the states [s], which must increase."""
        if len(self) < 2:
            raise InvalidInput(f"{owner}: it needs two or more states, got {len(self)}")
        for i, state in enumerate(self):
            check_state(f"{owner}: the state [{i}]", state)
            if np.ptp(numbers_of(state.time)) > 0:
                raise InvalidInput(
                    f"{owner}: environments must have one time, those of the state [{i}] differ"
                )
        known = np.array([float(numbers_of(state.time).reshape(-1)[0]) for state in self])
        if not (np.diff(known) > 0).all():
            i = int(np.flatnonzero(~(np.diff(known) > 0))[0]) + 1
            raise InvalidInput(f"{owner}: times of states must increase, that of [{i}] does not")
        return known

    def detach(self) -> Trajectory:
        """Return a copy whose tensors carry no graph."""
        return Trajectory(state.detach() for state in self)

    def save(self, path: str | Path) -> None:
        """Write the states without their graph, in the format of the file's ending.

        - .pt: the states with reports and surfaces; `load` reads it.
        - .npz: arrays in float64, also of a batch: `times` [T]; `positions/cloth` and
          `velocities/cloth` [T, v, 3]; `faces/surface` [f, 3]; `vertices/surface` [v, 3] and
          `poses/surface` [T, 7] of bodies and links; `joint_positions/robot` [T, j].
        - .pvd: for ParaView; it names .vtp files in a folder of the same name.
        - .glb, .gltf: glTF with morph targets for cloths and moving nodes for bodies; y is up.
        - .usd, .usda, .usdc: USD with points and transforms over time; needs the extra `usd`.

        The last three hold the surfaces of one environment, in meters and seconds, z up unless
        stated otherwise; the times of the states must increase. glTF and USD have float32.

        Args:
            path: The file; an existing one is replaced.

        Raises:
            InvalidInput: If the ending is another one, or the format cannot hold the states.
            TypeError: If an item is not a State.
            OSError: If the file cannot be written.
        """
        for i, state in enumerate(self):
            check_state(f"Trajectory.save: the state [{i}]", state)
        file = as_path("Trajectory.save: `path`", path)
        ending = check_ending("Trajectory.save: `path`", file)
        if ending == ".pt":
            with replace_file(file, keeps_ending=True) as part:
                torch.save(list(self.detach()), part)
            return
        if not self:
            raise InvalidInput(f"Trajectory.save: {ending} needs at least one state, got none")
        places = [(f"at [{i}]", state) for i, state in enumerate(self)]
        check_shapes("Trajectory.save", "all states", places)
        if ending == ".npz":
            arrays = self._arrays()
            with replace_file(file, keeps_ending=True) as part:
                np.savez(part, **arrays)  # type: ignore[arg-type]
            return
        animation = self._animation()
        animation.check_times("Trajectory.save")
        if not file.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(file.parent))
        ANIMATIONS[ending](file, animation)

    def _fields(self) -> Fields:
        """Tensors of all states over time, without a graph."""
        states = self.detach()
        return {name: getattr(states, name) for name in STATE}

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of an .npz file."""
        surfaces, fields = self[0]._known_surfaces("Trajectory.save"), self._fields()
        arrays = {"times": fields["time"]}
        for field in ("positions", "velocities"):
            for name, (values, _) in surfaces.cloth_meshes(fields[field]).items():
                arrays[f"{field}/{name}"] = values
        for name, (_, faces) in surfaces.cloth_meshes(fields["positions"]).items():
            arrays[f"faces/{name}"] = faces
        frames = surfaces.surface_frames(fields).unbind(-3)
        for (name, (vertices, faces)), frame in zip(
            surfaces.rigid_meshes().items(), frames, strict=True
        ):
            arrays[f"vertices/{name}"], arrays[f"faces/{name}"] = vertices, faces
            arrays[f"poses/{name}"] = torch.from_numpy(poses_of_frames(frame.numpy()))
        for name, rows in surfaces.joint_slices().items():
            arrays[f"joint_positions/{name}"] = fields["joint_positions"][..., rows]
        return {name: values.numpy() for name, values in arrays.items()}

    def _animation(self) -> Animation:
        """Surfaces over time, of one environment."""
        surfaces = self[0]._known_surfaces("Trajectory.save")
        if self[0].batch_size is not None:
            raise InvalidInput(
                "Trajectory.save: the states must be those of one environment in this format, got "
                f"a batch of {self[0].batch_size}; save "
                "dc.Trajectory(state[i] for state in trajectory), or .npz"
            )
        fields = self._fields()
        vectors = {"velocity": fields["velocities"], "contact_force": fields["contact_forces"]}
        of_cloths = {name: surfaces.cloth_meshes(values) for name, values in vectors.items()}
        cloths = [
            MovingSurface(
                name,
                faces.numpy(),
                vertices.numpy(),
                vectors={kind: meshes[name][0].numpy() for kind, meshes in of_cloths.items()},
            )
            for name, (vertices, faces) in surfaces.cloth_meshes(fields["positions"]).items()
        ]
        frames = surfaces.surface_frames(fields).unbind(-3)
        rigid = [
            MovingSurface(name, faces.numpy(), vertices.numpy(), frames=frame.numpy())
            for (name, (vertices, faces)), frame in zip(
                surfaces.rigid_meshes().items(), frames, strict=True
            )
        ]
        return Animation(fields["time"].numpy(), [*cloths, *rigid])

    @staticmethod
    def load(path: str | Path) -> Trajectory:
        """Read a trajectory from a .pt file that `save` has written.

        Args:
            path: The file.

        Raises:
            InvalidInput: If the file holds anything else.
            OSError: If the file cannot be read.
        """
        file = as_path("Trajectory.load: `path`", path)
        try:
            states: Any = torch.load(file, map_location=cpu.DEVICE, weights_only=True)
        except OSError:
            raise
        except Exception as error:  # any error of the reader about the bytes of another format
            raise InvalidInput(f"Trajectory.load: {file} holds no trajectory: {error}") from error
        if not isinstance(states, list):
            kind = type(states).__name__
            raise InvalidInput(f"Trajectory.load: {file} must hold states, got {kind}")
        try:
            for i, state in enumerate(states):
                check_state(f"Trajectory.load: {file}: the state [{i}]", state)
        except TypeError as error:
            raise InvalidInput(str(error)) from error
        return Trajectory(states)


register_tree(
    Trajectory,
    lambda states: (list(states), None),
    lambda states, _: Trajectory(states),
    lambda _: None,
)


def check_ending(name: str, file: Path) -> str:
    """Return the ending of a file for states, in lower case.

    Args:
        name: Prefix of the message.
        file: The file.

    Raises:
        InvalidInput: If the ending names no format.
    """
    ending = file.suffix.lower()
    accepted = (*_FILES, *ANIMATIONS)
    if ending not in accepted:
        raise InvalidInput(f"{name} must end in {', '.join(accepted)}, got {str(file)!r}")
    return ending
