"""A converged step is a minimum: the whole spectrum of its Hessian, by dense eigenvalues.

Every scene starts exactly planar. By symmetry a compressed planar sheet has no preferred side to
buckle: a step may converge towards the saddle, but must not stop there.
"""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch import _kernels

G = 9.81
DEFAULT = dc.Material()

pytestmark = pytest.mark.rounding


@dataclass
class Sheet:
    """A flat sheet in the xy-plane with gravity along -y, without contact."""

    rows: int  # along y
    columns: int
    height: float  # [m]
    pins: list[int]
    h: float
    material: dc.Material
    steps: int = 3
    gravity: tuple[float, float, float] = (0.0, -G, 0.0)
    cloth: dc.Cloth = field(init=False)

    def __post_init__(self):
        width = self.height * (self.columns - 1) / (self.rows - 1)
        self.cloth = dc.Cloth.grid(
            self.rows,
            self.columns,
            size=(width, self.height),
            material=self.material,
            pins={"held": self.pins},
        )

    def simulator(self, scheme="coupled"):
        scene = dc.Scene([self.cloth], gravity=self.gravity)
        contact = dc.ContactOptions(self_contact=False)
        return dc.Simulator(scene, self.h, scheme=scheme, contact=contact)

    def smallest_eigenvalue(self, positions):
        """Smallest eigenvalue of M/h^2 + W'' at free vertices, relative to the mean of M/h^2."""
        X = np.ascontiguousarray(self.cloth.vertices)
        faces = np.ascontiguousarray(self.cloth.faces, dtype=np.int32)
        one = np.ones(len(faces))
        m = self.material
        elastic = _kernels.Elastic(X, faces, "patch")
        elastic.set_parameters(
            m.stretch * one, m.bending * one, m.poisson * one, 0 * one, self.h, None
        )
        sides = X[faces[:, 1:]] - X[faces[:, :1]]
        area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        mass = np.bincount(faces.ravel(), np.repeat(m.density * area / 3, 3), minlength=len(X))
        H = elastic.hessian(np.ascontiguousarray(positions), False)
        H += np.diag(np.repeat(mass, 3)) / self.h**2
        free = np.flatnonzero(np.repeat(~np.isin(np.arange(len(X)), self.pins), 3))
        return np.linalg.eigvalsh(H[np.ix_(free, free)])[0] * self.h**2 / mass.mean()

    def check(self, scheme="coupled"):
        """Each step ends in a minimum and has a gradient; returns the last state."""
        sim = self.simulator(scheme)
        state = sim.initial_state()
        for _ in range(self.steps):
            start = state.positions.clone().requires_grad_()
            state = sim.step(state.replace(positions=start))
            assert state.report.converged
            assert self.smallest_eigenvalue(state.positions.detach().numpy()) > 0
            (state.positions**2).sum().backward()
            assert torch.isfinite(start.grad).all()
            state = state.detach()
        return state


def out_of_plane(state):
    return state.positions[:, 2].abs().max()


# Hung in its plane by two corners, and standing on two corners: planar solutions are saddles.
@pytest.mark.parametrize("pins", [[90, 99], [0, 9]], ids=["hung", "standing"])
@pytest.mark.parametrize("scheme", ["coupled", "split"])
def test_a_flat_sheet_never_stops_in_a_saddle(pins, scheme):
    sheet = Sheet(10, 10, 1.0, pins, 0.05, dc.Material(1e4, 1e-5, 0.3, 0.124))
    assert out_of_plane(sheet.check(scheme)) > 1e-4


# A stiff sheet crosses its buckling load within so short a path that a factor from before the load
# appears to be current.
@pytest.mark.parametrize("stretch", [2e4, 1e5])
@pytest.mark.parametrize("columns", [9, pytest.param(41, marks=pytest.mark.slow)])
def test_a_stiff_sheet_that_stands_upright_buckles(stretch, columns):
    material = dc.Material(stretch=stretch)
    sheet = Sheet(41, columns, 0.2, list(range(2 * columns)), 0.02, material)
    assert out_of_plane(sheet.check()) > 1e-6


# A column clamped at its foot buckles under its own weight w per length if w L^3 / D > 7.84. The
# step is long, so that inertia does not stabilize the column.
@pytest.mark.parametrize("load", [12.0, 40.0])
@pytest.mark.parametrize("dt", [0.05, 1.0])
def test_a_heavy_column_buckles_once_inertia_lets_it(load, dt):
    length, density = 0.2, 0.124
    bending = density * G * length**3 / load
    material = dc.Material(stretch=1e3, bending=bending, poisson=0.0, density=density)
    sheet = Sheet(21, 4, length, list(range(8)), dt, material)
    state = sheet.check()
    if dt == 1.0:
        assert out_of_plane(state) > 1e-2 * length


# A strip with this sideways load in its plane [m/s^2] buckles from 9.0698 on; within the default
# tolerance a step may end slightly earlier, so that 9.0699 is flat, too. The curvature is 1e-10 of
# the diagonal: far below the resolution of single precision.
@pytest.mark.parametrize("load", [9.0692, 9.0697, 9.0702, 9.0707, 9.0717, 9.0727, 9.0737])
def test_a_strip_about_to_buckle_is_flat_only_where_that_is_a_minimum(load):
    material = dc.Material(stretch=6247.0, bending=7.45e-3)
    gravity = (load, 0.0, 0.0)
    strip = Sheet(59, 3, 0.58, list(range(6)), 0.168, material, steps=1, gravity=gravity)
    assert (out_of_plane(strip.check()) == 0.0) == (load < 9.0699)


@pytest.mark.parametrize("gravity", [(0.0, -G, 0.0), (0.0, 0.0, -G)], ids=["upright", "level"])
@pytest.mark.parametrize("pins", ["corners", "edge"])
@pytest.mark.parametrize("stretch", [DEFAULT.stretch, 1e4])
def test_a_flat_sheet_that_hangs_ends_every_step_in_a_minimum(pins, gravity, stretch):
    n = 16
    held = {"corners": [n * (n - 1), n * n - 1], "edge": list(range(n * (n - 1), n * n))}[pins]
    Sheet(n, n, 0.5, held, 0.02, dc.Material(stretch=stretch), steps=5, gravity=gravity).check()
