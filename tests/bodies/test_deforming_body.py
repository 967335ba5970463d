"""Bodies that deform by prescription: contact, friction, gradients, and no mass or elasticity."""

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.geometry import shapes

F64 = torch.float64
G = 9.81


def ball(radius=0.1, subdivisions=2, **keywords):
    return dc.DeformingBody(*shapes.sphere(radius, subdivisions), name="walker", **keywords)


def dropped(body, counts=(9, 9), height=0.104, dt=0.01, **keywords):
    """A sheet just above a body."""
    sheet = dc.Cloth.grid(
        counts, 0.4, name="sheet", pose=[0.012, 0.007, height, 1, 0, 0, 0], **keywords
    )
    solver = dc.SolverOptions(tolerance=1e-10)
    return dc.Simulator(dc.Scene([sheet], [body]), dt, solver=solver)


def breathing(vertices, t):
    """The ball becomes an ellipsoid that bends, and moves along x."""
    x, y, z = vertices.unbind(-1)
    wide = 1 + 2 * t
    return torch.stack([wide * x + 0.2 * t + 0.5 * t * z, y / wide, z + t * x * 0.3], dim=-1)


# --- Motion, mass, elasticity ---------------------------------------------------------------------


def test_vertices_of_a_deforming_body_follow_the_control(tmp_path):
    simulator = dropped(ball())
    assert simulator.surfaces == ("sheet", "walker")
    rows = simulator.slices["walker"]
    assert rows == slice(81, 81 + 162)
    state = simulator.initial_state()
    target = breathing(state.positions[rows], 0.02)
    by_name = simulator.step(state, dc.Control(body_vertices={"walker": target}))
    assert torch.equal(by_name.positions[rows], target)
    expected = (target - state.positions[rows]) / 0.01
    torch.testing.assert_close(by_name.velocities[rows], expected, rtol=1e-12, atol=1e-12)
    by_rows = simulator.step(state, simulator.control(body_vertices=target.numpy()))
    assert torch.equal(by_rows.positions, by_name.positions)
    assert by_name.pin_forces.shape == (0, 3)
    held = simulator.step(by_name)
    assert torch.equal(held.positions[rows], target)
    dc.Trajectory([state, by_name]).save(tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as arrays:
        assert np.array_equal(arrays["positions/walker"][1], target)
    torch.save(simulator, tmp_path / "simulator.pt")
    again = torch.load(tmp_path / "simulator.pt", weights_only=True)
    assert torch.equal(again.step(state).positions, simulator.step(state).positions)


def test_environments_of_a_batch_move_apart():
    simulator = dropped(ball())
    start = simulator.initial_state()
    rows = simulator.slices["walker"]
    targets = torch.stack([breathing(start.positions[rows], t) for t in (0.0, 0.01, 0.02)])
    batch = simulator.step(simulator.initial_state(3), dc.Control(body_vertices=targets))
    for i, target in enumerate(targets):
        alone = simulator.step(start, dc.Control(body_vertices=target))
        assert torch.equal(batch.positions[i], alone.positions)


def test_a_deforming_body_has_no_mass_and_no_elasticity():
    """A distant deforming body changes no bit of a sheet's motion, for any deformation."""
    sheet = dc.Cloth.grid((5, 5), 0.3, name="sheet", pins={"edge": range(5)})
    far = ball(pose=[3, 0, 0, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([sheet], [far]), 0.01)
    alone = dc.Simulator(dc.Scene([sheet]), 0.01)
    assert (
        simulator.default_parameters().barrier_distance
        == alone.default_parameters().barrier_distance
    )
    masses = simulator.vertex_masses()
    assert torch.equal(masses[:25], alone.vertex_masses())
    assert not masses[25:].any()
    start, bare = simulator.initial_state(), alone.initial_state()
    targets = start.positions[25:].clone()
    for k in range(4):
        targets = targets * torch.tensor([1.0, 1.4, 0.6]) + torch.tensor([0.2 * k, 0.0, 0.0])
        start = simulator.step(start, dc.Control(body_vertices=targets))
        bare = alone.step(bare)
        assert torch.equal(start.positions[:25], bare.positions)
        assert torch.equal(simulator.momentum(start), alone.momentum(bare))
        assert torch.equal(simulator.kinetic_energy(start), alone.kinetic_energy(bare))
        energies = [sim.energy(s, parts=True) for sim, s in ((simulator, start), (alone, bare))]
        assert all(torch.equal(energies[0][part], energies[1][part]) for part in energies[1])


def test_a_deforming_body_may_cross_itself_and_prescribed_bodies():
    table = dc.RigidBody.box(0.2, pose=[0, 0, -0.25, 1, 0, 0, 0])
    hand = dc.RigidBody.box(0.05, motion="kinematic", pose=[0.05, 0, -0.05, 1, 0, 0, 0])
    other = dc.DeformingBody.grid((3, 3), 0.4, name="other")
    sheet = dc.Cloth.grid((5, 5), 0.3, pose=[0, 0, 0.4, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([sheet], [table, ball(), hand, other]), 0.01)
    start = simulator.initial_state()
    generator = torch.Generator().manual_seed(0)
    noise = 0.2 * torch.rand(162, 3, generator=generator, dtype=F64)
    noise[:, 2] -= 0.2
    state = simulator.step(start, dc.Control(body_vertices={"walker": noise}))
    assert torch.equal(state.positions[simulator.slices["walker"]], noise)
    assert state.report.contact_count == 0


# --- Contact --------------------------------------------------------------------------------------


def free(state, simulator, ipctk):
    """True if the sheet crosses neither itself nor the body; the body may cross itself."""
    first = simulator.slices["walker"].start
    faces = np.concatenate(
        [c.faces + s for c, s in zip(simulator.scene.cloths, (0, first), strict=True)]
    )
    points = state.positions.detach().numpy()
    mesh = ipctk.CollisionMesh(points, ipctk.edges(faces), faces)
    patches = np.concatenate([np.arange(first), np.full(len(points) - first, first)])
    mesh.can_collide = ipctk.make_vertex_patches_filter(patches.astype(np.int32))
    return not ipctk.has_intersections(mesh, points)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_a_deforming_body_never_passes_through_cloth(speed):
    """A punch that moves by many edge lengths per step carries the sheet along."""
    ipctk = pytest.importorskip("ipctk")
    simulator = dropped(ball(), counts=(7, 7), dt=0.02)
    state = simulator.initial_state()
    rest = state.positions[49:].clone()
    for k in range(5):
        moved = breathing(rest, 0.05 * (k + 1)) + torch.tensor([0, 0, speed * 0.02 * (k + 1)])
        state = simulator.step(state, dc.Control(body_vertices={"walker": moved}))
        assert free(state, simulator, ipctk)
        assert state.report.contacts["walker", "sheet"].force[2] > 0
    assert state.positions[:49, 2].max() > moved[:, 2].max()


def test_a_motion_that_cannot_be_completed_is_an_error():
    sheet = dc.Cloth.grid((5, 5), 0.3, pins={"all": range(25)}, pose=[0, 0, 0.12, 1, 0, 0, 0])
    free_sheet = dc.Cloth.grid((3, 3), 0.2, pose=[0, 0, 0.11, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([sheet, free_sheet], [ball()]), 0.01)
    start = simulator.initial_state()
    up = start.positions[34:] + torch.tensor([0, 0, 0.1])
    with pytest.raises(dc.InfeasibleMotion, match="walker") as caught:
        simulator.step(start, dc.Control(body_vertices={"walker": up}))
    assert 0 < caught.value.report.motion_fraction < 1


def test_a_start_that_overlaps_is_refused():
    with pytest.raises(dc.IntersectingState, match="'walker'"):
        dropped(ball(), height=0.05)


def test_cloth_rests_on_a_deforming_body():
    """The forces of contact bear the weight of the sheet, at rest."""
    simulator = dropped(ball(), counts=(5, 5))
    rest = simulator.equilibrium(simulator.initial_state())
    weight = simulator.vertex_masses().sum() * G
    force = rest.report.contacts["walker", "sheet"].force
    torch.testing.assert_close(force, torch.tensor([0, 0, weight]), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(rest.contact_forces[25:].sum(0), -force, rtol=1e-9, atol=1e-12)
    points = simulator.contacts(rest)
    assert points.mask.any()


# --- Friction -------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_moving_surface_drags_cloth_along(friction):
    """A belt of 1 m/s accelerates a sheet that lies on it by mu g."""
    belt = dc.DeformingBody.grid((9, 5), (1.2, 0.4), name="belt", friction=friction)
    sheet = dc.Cloth.grid(
        *((5, 5), 0.2),
        pose=[-0.1, 0, 0.0125, 1, 0, 0, 0],
        material=dc.Material(friction=friction, bending=1e-3),
    )
    contact = dc.ContactOptions(slip_velocity=1e-4, friction_iterations=4)
    simulator = dc.Simulator(dc.Scene([sheet], [belt]), 0.005, contact=contact)
    state = simulator.equilibrium(simulator.initial_state()).replace(
        time=torch.zeros((), dtype=F64)
    )
    for _ in range(8):
        moved = state.positions[25:] + torch.tensor([0.005, 0, 0])
        state = simulator.step(state, dc.Control(body_vertices={"belt": moved}))
    speed = state.velocities[:25, 0]
    # Waves of the first touch leave some mm/s.
    assert speed.mean().item() == pytest.approx(friction * G * 0.04, rel=0.02)
    assert state.velocities[:25, 1].abs().max() < 0.02


def test_a_dynamic_body_rests_on_a_deforming_body_and_is_dragged_along():
    belt = dc.DeformingBody.grid((13, 5), (1.2, 0.4), friction=0.5, name="belt")
    box = dc.RigidBody.box(
        [0.1, 0.1, 0.05],
        motion="dynamic",
        density=300,
        friction=0.5,
        pose=[-0.2, 0, 0.0295, 1, 0, 0, 0],
        name="box",
    )
    sheet = dc.Cloth.grid((5, 5), 0.2, pose=[0, 1, 0, 1, 0, 0, 0], pins={"edge": range(5)})
    simulator = dc.Simulator(dc.Scene([sheet], [belt, box]), 0.005)
    state, rows = simulator.initial_state(), simulator.slices["belt"]
    for _ in range(10):
        state = simulator.step(state)
    force = state.report.contacts["belt", "box"].force
    torch.testing.assert_close(force, torch.tensor([0, 0, 0.15 * G], dtype=F64), rtol=0, atol=0.02)
    for _ in range(20):
        moved = state.positions[rows] + torch.tensor([0.01, 0, 0])
        state = simulator.step(state, dc.Control(body_vertices={"belt": moved}))
    # The body rocks slightly on the contact forces.
    assert state.body_velocities[0, 0].item() == pytest.approx(0.5 * G * 0.1, rel=0.03)


def test_a_surface_that_widens_in_its_plane_drags_cloth_apart():
    """The belt's center rests and its speed grows outwards: the sheet is stretched."""
    belt = dc.DeformingBody.grid((9, 9), 0.5, name="belt", friction=1.0)
    soft = dc.Material(stretch=0.2, friction=1.0, bending=1e-4)
    sheet = dc.Cloth.grid((5, 5), 0.2, pose=[0, 0, 0.0125, 1, 0, 0, 0], material=soft)
    simulator = dc.Simulator(dc.Scene([sheet], [belt]), 0.01)
    state = simulator.equilibrium(simulator.initial_state())
    rest = state.positions[25:].clone()
    width = np.ptp(state.positions[:25, 0].numpy())
    for k in range(5):
        wide = rest * torch.tensor([1 + 0.01 * (k + 1), 1.0, 1.0])
        state = simulator.step(state, dc.Control(body_vertices={"belt": wide}))
    assert np.ptp(state.positions[:25, 0].numpy()) / width == pytest.approx(
        1.05, abs=6e-3
    )  # ends slip
    assert state.positions[:25, 0].mean().abs() < 1e-6


# --- Gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 4])
def test_gradients_by_the_motion_of_a_deforming_body(steps):
    """In contact with friction, by all vertices at all times, against differences of order four."""
    simulator = dropped(ball(subdivisions=1), counts=(5, 5), height=0.1045)
    state = simulator.equilibrium(simulator.initial_state())
    rest = state.positions[25:]
    assert state.report.contact_count > 0
    generator = torch.Generator().manual_seed(7)
    weights = torch.randn(25, 3, generator=generator, dtype=F64)
    motion = torch.stack([breathing(rest, 0.002 * (k + 1)) for k in range(steps)])

    def loss(motion):
        end = state
        for targets in motion:
            end = simulator.step(end, dc.Control(body_vertices=targets))
        return (weights * end.positions[:25]).sum()

    x = motion.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(x), x)
    direction = torch.randn(motion.shape, generator=generator, dtype=F64)
    h = 1e-6
    stencil = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))
    with torch.no_grad():
        expected = sum(w * loss(motion + k * h * direction).item() for k, w in stencil) / h
    # A solve to 1e-10 m/s leaves 1e-12 m in each difference: up to 9e-7 for three directions.
    assert (gradient * direction).sum().item() == pytest.approx(expected, rel=1e-5)
    _, tangent = torch.func.jvp(loss, (motion,), (direction,))
    assert tangent.item() == pytest.approx((gradient * direction).sum().item(), rel=1e-8)


# --- Refusals -------------------------------------------------------------------------------------


def test_scenes_without_support_for_deforming_bodies_are_refused():
    sheet = dc.Cloth.grid((3, 3), 0.2, pose=[0, 0, 1, 1, 0, 0, 0])
    with pytest.raises(
        TypeError, match=r"`bodies` must hold DeformingBody objects, not `cloths`\[1\]"
    ):
        dc.Scene([sheet, ball()])
    dynamic = dc.RigidBody.box(0.1, motion="dynamic", mass=1.0)
    with pytest.raises(dc.InvalidInput, match="at least one Cloth where a body deforms"):
        dc.Scene([], [dynamic, ball()])
    scene = dc.Scene([sheet], [ball()])
    for keywords in ({"scheme": "split"}, {"scheme": "projective"}, {"coupling": "rigid_to_cloth"}):
        with pytest.raises(dc.InvalidInput, match="deform by prescription need scheme 'coupled'"):
            dc.Simulator(scene, 0.01, **keywords)
    with pytest.raises(dc.InvalidInput, match=r"^DeformingBody: `friction` must be"):
        ball(friction=-1.0)
    with pytest.raises(
        dc.InvalidInput, match=r"^DeformingBody: `vertices` must each belong to a f"
    ):
        dc.DeformingBody(np.eye(4)[:, :3], [[0, 1, 2]])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        pytest.param(np.zeros((3, 3)), r"must have shape \[162, 3\] or \[B, 162, 3\]", id="shape"),
        pytest.param(np.full((162, 3), np.nan), r"must be finite, got nan at \[0, 0\]", id="nan"),
        pytest.param({"runner": np.zeros((162, 3))}, "has the names 'walker'", id="name"),
        pytest.param({"walker": np.zeros((2, 3))}, r"\[162, 3\]", id="rows"),
    ],
)
def test_other_motions_are_refused(given, message):
    simulator = dropped(ball())
    with pytest.raises(dc.InvalidInput, match=message):
        simulator.step(simulator.initial_state(), dc.Control(body_vertices=given))


def test_a_control_of_a_missing_deforming_body_is_refused():
    sheet = dc.Cloth.grid((3, 3), 0.2)
    simulator = dc.Simulator(dc.Scene([sheet]), 0.01)
    with pytest.raises(dc.InvalidInput, match="the scene has nothing of the kind"):
        simulator.control(body_vertices={"walker": np.zeros((3, 3))})


def test_woven_and_hinged_cloths_meet_a_deforming_body():
    for material, model in (
        (dc.fabrics.material("denim", friction=0.3), "patch"),
        (dc.Material(), "hinge"),
        (dc.Material(density=np.linspace(0.1, 0.2, 32)), "patch"),
    ):
        simulator = dropped(ball(), counts=(5, 5), material=material, bending_model=model)
        state = simulator.initial_state()
        for _ in range(2):
            state = simulator.step(state)
        assert state.report.converged
        named = simulator.default_parameters().replace(stretch={"sheet": 300.0})
        simulator.step(state, None, named)


def test_pictures_show_a_deforming_body(tmp_path):
    simulator = dropped(ball())
    state = simulator.initial_state()
    assert list(state.meshes()) == ["sheet", "walker"]
    state.export(tmp_path / "t.obj")
    assert (tmp_path / "t.obj").read_text().count("\no ") + 1 == 2
    assert sum(len(faces) for _, faces in state.meshes().values()) == 128 + 320
