"""Parameters of faces that are given at the vertices of cloths."""

import pytest
import torch

import diffcloth_torch as dc


@pytest.fixture(scope="module")
def simulator():
    """Two hanging sheets: 9 + 6 vertices, 8 + 4 faces."""
    sheets = [
        dc.Cloth.grid((3, 3), 0.2, name="a", pins={"a": [0]}),
        dc.Cloth.grid((3, 2), (0.2, 0.1), name="b", pins={"b": [0]}, pose=[1, 0, 0, 1, 0, 0, 0]),
    ]
    return dc.Simulator(dc.Scene(sheets), 0.02)


def faces(simulator):
    starts = (0, 9)
    parts = [c.faces + s for c, s in zip(simulator.scene.cloths, starts, strict=True)]
    return torch.from_numpy(parts[0]).long(), torch.cat([torch.from_numpy(p).long() for p in parts])


@pytest.mark.parametrize("name", ["stretch", "bending", "density", "damping", "normal_drag"])
def test_a_face_has_the_mean_of_its_corners(simulator, name):
    _, corners = faces(simulator)
    generator = torch.Generator().manual_seed(1)
    default = getattr(simulator.default_parameters(), name).item() or 0.5
    values = default * (1 + torch.rand(15, generator=generator, dtype=torch.float64))
    start = simulator.initial_state()
    start = start.replace(velocities=torch.linspace(0, 1, 45, dtype=torch.float64).reshape(15, 3))

    def loss(values):
        given = simulator.default_parameters().replace(**{name: values})
        return simulator.step(start, None, given).positions.square().sum()

    at_vertices, at_faces = values.clone().requires_grad_(), values[corners].mean(-1)
    at_faces.requires_grad_()
    one, other = loss(at_vertices), loss(at_faces)
    assert one.item() == pytest.approx(other.item(), rel=1e-14)  # the order of three numbers
    (found,), (by_faces,) = (
        torch.autograd.grad(x, y) for x, y in ((one, at_vertices), (other, at_faces))
    )
    expected = torch.zeros(15, dtype=torch.float64)
    expected.index_add_(0, corners.flatten(), (by_faces / 3).repeat_interleave(3))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9 * expected.abs().max().item())
    assert found.abs().min() > 0


def test_environments_may_differ(simulator):
    values = torch.linspace(0.1, 0.3, 30, dtype=torch.float64).reshape(2, 15)
    batch = simulator.step(simulator.initial_state(2), None, dc.Parameters(density=values))
    for i, own in enumerate(values):
        alone = simulator.step(simulator.initial_state(), None, dc.Parameters(density=own))
        assert torch.equal(batch.positions[i], alone.positions)


def test_unclear_shapes_are_refused(simulator):
    values = torch.full((15,), 0.2, dtype=torch.float64)
    with pytest.raises(dc.InvalidInput, match=r"\[15\] could mean .* environment or per vertex"):
        simulator.step(simulator.initial_state(15), None, dc.Parameters(density=values))
    with pytest.raises(dc.InvalidInput, match=r"accepted are \[\] or \[2\] or \[15\] or \[12\]"):
        simulator.step(simulator.initial_state(), None, dc.Parameters(density=values[:3]))
    with pytest.raises(dc.InvalidInput, match=r"`parameters\.density` must be .* > 0"):
        simulator.step(simulator.initial_state(), None, dc.Parameters(density=values * 0))


def test_equal_counts_of_vertices_and_faces_are_refused_and_names_are_clear():
    """A sheet of 3 x 4 vertices has 12 faces."""
    material = dc.Material(density=torch.linspace(0.1, 0.2, 12))
    sheet = dc.Cloth.grid((4, 3), 0.3, name="sheet", material=material)
    simulator = dc.Simulator(dc.Scene([sheet]), 0.01)
    own = simulator.default_parameters()
    start = simulator.initial_state()
    expected = simulator.step(start).positions
    assert torch.equal(simulator.step(start, None, own).positions, expected)
    with pytest.raises(dc.InvalidInput, match="of 12 values could mean one per vertex or one per"):
        simulator.step(start, None, own.replace(density=own.density.clone()))
    named = own.replace(density={"sheet": own.density.clone()})
    assert torch.equal(simulator.step(start, None, named).positions, expected)
