"""Barrier stiffness: the default of a pair of surfaces depends only on these two surfaces."""

import warnings

import numpy as np
import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.robots import GRIPPER

F64 = torch.float64
DT = 0.01
G = 9.81
FLOOR = dc.RigidBody.plane(2.0, name="floor")
TURN = [1, 0, 0, 0]


def sheet(points=8, height=0.05, **material):
    return dc.Cloth.grid(
        points,
        points,
        size=(0.05 * (points - 1),) * 2,
        material=dc.Material(**material),
        pose=[0, 0, height, 1, 0, 0, 0],
    )


def box(mass, *place, side=0.1, name=None):
    pose = [*place, 1, 0, 0, 0]
    return dc.RigidBody.box(side, motion="dynamic", mass=mass, pose=pose, name=name)


def simulator(cloths, bodies=(), robots=(), dt=DT, coupling="monolithic", scheme="coupled", **o):
    scene = dc.Scene(cloths, bodies, robots)
    contact = dc.ContactOptions(**o)
    return dc.Simulator(scene, dt, contact=contact, coupling=coupling, scheme=scheme)


def pairs(sim):
    """The default of each pair of surfaces by their names."""
    count = len(sim.surfaces)
    values = sim.default_parameters().barrier_stiffness.expand(count, count)
    return {
        (a, b): values[i, j].item()
        for i, a in enumerate(sim.surfaces)
        for j, b in enumerate(sim.surfaces)
    }


def arm():
    return dc.Robot.load(
        GRIPPER, name="hand", pose=[0, 0, 0.9, 1, 0, 0, 0], stiffness=200.0, damping=5.0
    )


SCENES = {
    "sheet": ([sheet()], [], []),
    "sheet and floor": ([sheet()], [FLOOR], []),
    "two sheets": ([sheet(), sheet(6, 0.1, stretch=90.0, density=0.4)], [FLOOR], []),
    "sheet, box and floor": ([sheet()], [FLOOR, box(0.7, 0, 0, 0.2)], []),
    "boxes": ([], [FLOOR, box(0.7, 0, 0, 0.2), box(3.0, 0, 0, 0.4)], []),
    "sheet and hand": ([sheet()], [FLOOR], [arm()]),
    "hand alone": ([], [FLOOR], [arm()]),
}


def may_touch(a, b):
    """Return whether two surfaces of these scenes may touch; the base of the hand is fixed."""
    still = ("floor", "hand/palm")
    if a.startswith("cloth") or b.startswith("cloth"):
        return True
    return a != b and not (a in still and b in still) and {a[:5], b[:5]} != {"hand/"}


@pytest.mark.parametrize("mass", [1e-3, 95.0, 2e4])
@pytest.mark.parametrize("name", SCENES)
def test_a_body_far_away_changes_no_default(name, mass):
    cloths, bodies, robots = SCENES[name]
    options = {} if cloths else {"barrier_distance": 4e-3}
    alone = pairs(simulator(cloths, bodies, robots, **options))
    far = box(mass, 30.0, 0.0, 1.0, side=0.4, name="far")
    joined = pairs(simulator(cloths, [*bodies, far], robots, **options))
    # With a cloth no default changes; otherwise pairs that never touch have another pair's value.
    compared = {pair: value for pair, value in alone.items() if cloths or may_touch(*pair)}
    assert compared
    assert {pair: joined[pair] for pair in compared} == compared
    assert all(value > 0 for value in joined.values())


def test_the_default_of_one_cloth_is_one_number_as_before():
    """The value is equal up to rounding; bending contributes a share of 1e-6."""
    sim = simulator([sheet(8, density=0.2, stretch=700.0, bending=2e-5)], [FLOOR])
    stiffness = sim.default_parameters().barrier_stiffness
    assert stiffness.shape == ()
    assert stiffness.item() == pytest.approx(3718.8886128683357, rel=1e-12)


def test_a_pair_has_the_larger_stiffness_of_its_two_surfaces():
    soft, stiff = sheet(8), sheet(8, 0.1, stretch=9e3)
    light, heavy = box(0.2, 0, 0, 0.3, name="light"), box(80.0, 0, 0, 0.5, name="heavy")
    found = pairs(simulator([soft, stiff], [FLOOR, light, heavy]))
    for own, other in (("cloth0", "floor"), ("cloth0", "light"), ("heavy", "floor")):
        assert found[own, other] == found[other, own]
    # The pair with the floor has the surface's own requirement.
    needs = {name: found[name, "floor"] for name in ("cloth0", "cloth1", "light", "heavy")}
    assert needs["light"] < needs["cloth0"] < needs["cloth1"] < needs["heavy"]
    assert needs["heavy"] == pytest.approx(400 * needs["light"], rel=1e-12)
    assert found["cloth0", "cloth0"] == needs["cloth0"]
    for a in needs:
        for b in needs:
            if a != b:
                assert found[a, b] == max(needs[a], needs[b])


def test_a_cloth_needs_the_stiffness_of_a_scene_of_its_own():
    options = {"barrier_distance": 3e-3}
    cloths = [sheet(8, thickness=1e-3), sheet(6, 0.1, stretch=90.0, density=0.4)]
    found = pairs(simulator(cloths, [FLOOR], **options))
    for k, cloth in enumerate(cloths):
        alone = pairs(simulator([cloth], **options))
        assert found[f"cloth{k}", "floor"] == alone["cloth0", "cloth0"]


def test_joints_count_only_against_static_surfaces():
    found = pairs(simulator([sheet()], [FLOOR, box(0.7, 1, 0, 0.2, name="box")], [arm()]))
    finger = "hand/left_finger"
    alone = pairs(simulator([], [FLOOR], [arm()], barrier_distance=0.005))
    assert found[finger, "cloth0"] == found["cloth0", "cloth0"]
    assert found[finger, "box"] == found["box", "floor"]
    assert found[finger, "floor"] == pytest.approx(alone[finger, "floor"], rel=1e-12)
    assert found[finger, "floor"] < found["box", "floor"]


def rolled(sim, steps, state=None):
    with torch.no_grad():
        return sim.rollout(sim.initial_state() if state is None else state, steps=steps)


def test_a_body_far_away_does_not_change_how_a_cloth_lands():
    near = [sheet(9, 0.02)], [FLOOR]
    alone = rolled(simulator(*near), 25)
    far = box(95.0, 30.0, 0.0, 1.0)
    joined = rolled(simulator(near[0], [*near[1], far]), 25)
    # One solve moves both bodies, to a tolerance of 1e-6 m/s.
    for a, b in zip(alone, joined, strict=True):
        assert (a.positions - b.positions).abs().max() < 1e-8
    assert alone[-1].report.contact_count > 50


def test_a_heavy_box_lands_beside_a_cloth():
    """The box rests at half the barrier distance; the cloth rests as without the box."""
    cloth = sheet(9, 0.004)
    alone = rolled(simulator([cloth], [FLOOR]), 60)[-1]
    sim = simulator([cloth], [FLOOR, box(100.0, 0.5, 0.0, 0.2, name="box")])
    state = rolled(sim, 60)[-1]
    assert (state.positions - alone.positions).abs().max() < 1e-6
    reach = sim.default_parameters().barrier_distance.item()
    # Corners and the ridges between them share the weight: a little above one half.
    assert 0.45 * reach < state.body_poses[1, 2] - 0.05 < 0.8 * reach
    wrenches = sim.contact_wrenches(state)
    assert wrenches["box"][2] == pytest.approx(100.0 * G, rel=1e-5)


@pytest.mark.parametrize("radius", [0.005, 0.05, 0.5])
def test_a_smooth_ball_rests_at_half_the_barrier_distance(radius):
    reach = 4e-3
    ball = dc.RigidBody.sphere(
        radius, smooth=True, motion="dynamic", mass=0.7, pose=[0, 0, radius + 0.6 * reach, *TURN]
    )
    sim = simulator([], [FLOOR, ball], barrier_distance=reach)
    gap = rolled(sim, 40)[-1].body_poses[1, 2].item() - radius
    assert gap == pytest.approx(0.5 * reach, rel=1e-6)


def at_half_gap(xi, reach):
    """Slope and curvature of the barrier by the gap, from its formula."""
    gap = torch.tensor(0.5 * reach, dtype=F64, requires_grad=True)
    sigma = (xi + gap) ** 2 - xi**2
    s = 2 * xi * reach + reach**2
    barrier = -reach / s**2 * (sigma - s) ** 2 * torch.log(sigma / s)
    (slope,) = torch.autograd.grad(barrier, gap, create_graph=True)
    (curvature,) = torch.autograd.grad(slope, gap)
    return slope.item(), curvature.item()


@pytest.mark.parametrize(("mass", "of"), [(1e-3, "cloth0"), (50.0, "ball")])
def test_a_radius_does_not_reduce_the_stiffness_of_a_surface(mass, of):
    """With additional thickness: a cloth needs a curvature at half the gap, a body a slope."""
    reach, radius, thicknesses = 3e-3, 0.04, {"cloth0": 2e-3, "ball": 7e-3}
    ball = dc.RigidBody.sphere(
        radius,
        smooth=True,
        motion="dynamic",
        mass=mass,
        thickness=thicknesses["ball"],
        pose=[0, 0, 1, *TURN],
        name="ball",
    )
    sim = simulator([sheet(thickness=thicknesses["cloth0"])], [FLOOR, ball], barrier_distance=reach)
    found = pairs(sim)
    xi, kind = thicknesses[of], 1 if of == "cloth0" else 0
    with_radius, without = (at_half_gap(xi + r, reach)[kind] for r in (radius, 0.0))
    if of == "cloth0":
        need = found["cloth0", "cloth0"] * without
    else:  # the weight on a sixth of the area, of which a vertex counts a quarter
        area = 4 * np.pi * radius**2
        need = mass * G / (0.25 * area / 6)
    assert abs(found["cloth0", "ball"] * with_radius) == pytest.approx(need, rel=1e-9)


def test_a_body_without_gravity_needs_a_stiffness_that_stops_it_within_a_step():
    """Equal to the need at a gravity that falls through the barrier distance in one step."""
    reach = 4e-3
    found = []
    for g in (0.0, reach / DT**2):
        bodies = [FLOOR, box(0.7, 0, 0, 0.2, name="box")]
        scene = dc.Scene([], bodies, gravity=[0.0, -g, 0.0])
        sim = dc.Simulator(scene, DT, contact=dc.ContactOptions(barrier_distance=reach))
        found.append(pairs(sim)["box", "floor"])
    assert found[0] == pytest.approx(found[1], rel=1e-12)


@pytest.mark.parametrize("shift", [0.0, 1.0])
@pytest.mark.parametrize("width", [0.3, 0.3001, 0.301])
def test_the_length_of_a_spring_and_where_a_scene_is_are_no_matter(width, shift):
    """Springs that are shorter than at rest push sideways: seams had defaults below zero."""

    def defaults(rest_length, shift):
        front = dc.Cloth.grid(6, 6, 0.3, pose=[shift, 0, 0, *TURN])
        back = dc.Cloth.grid(6, 6, width, pose=[shift, 0, 0.02, *TURN])
        ball = dc.RigidBody.sphere(0.05, pose=[shift, 0, -0.06, *TURN])
        edge, length = range(6), {"stiffness": 3000.0, "rest_length": rest_length}
        seam = dc.Attachment(("cloth0", edge), ("cloth1", edge), **length)
        hook = dc.Attachment(("body0", [0, 0, 0.05]), ("cloth0", [14]), **length)
        scene = dc.Scene([front, back], [ball], attachments=[seam, hook])
        return dc.Simulator(scene, DT).default_parameters().barrier_stiffness

    without = defaults(0.0, 0.0)
    assert (without > 1e3).all()
    torch.testing.assert_close(defaults(5e-3, shift), without, rtol=1e-12, atol=0)


@pytest.mark.parametrize("thickness", [0.0, 4e-3, 2e-2])
def test_a_box_rests_above_half_the_barrier_distance_whatever_its_thickness(thickness):
    reach = 4e-3
    floor = dc.RigidBody.plane(2.0, thickness=thickness)
    place = [0, 0, 0.05 + thickness + 0.6 * reach, *TURN]
    body = dc.RigidBody.box(0.1, motion="dynamic", mass=0.7, thickness=thickness, pose=place)
    sim = simulator([], [floor, body], barrier_distance=reach)
    gap = rolled(sim, 40)[-1].body_poses[1, 2].item() - 0.05 - thickness
    # Corners and the ridges between them share the weight.
    assert 0.65 * reach < gap < 0.8 * reach


def test_a_joint_needs_the_stiffness_of_the_mass_at_its_farthest_point(tmp_path):
    """An arm of twice the size and equal mass has equal mass there, on four times the area."""
    found = []
    for size in (1.0, 2.0):
        path = tmp_path / "arm.urdf"
        inertia = 0.01 * size**2
        box = f"{0.1 * size} {0.2 * size} {0.1 * size}"
        at = f'<origin xyz="{0.4 * size} 0 0"/>'
        path.write_text(f"""<robot name="arm"><link name="base"/><link name="arm">
          <inertial>{at}<mass value="2"/><inertia ixx="{inertia}" iyy="{inertia}"
            izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>
          <collision>{at}<geometry><box size="{box}"/></geometry></collision></link>
          <joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/>
          <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="0" velocity="0"/></joint>
          </robot>""")
        robot = dc.Robot.load(path, name="hand", pose=[0, 0, 1, *TURN], actuation="torque")
        sim = simulator([], [FLOOR], [robot], barrier_distance=4e-3)
        found.append(pairs(sim)["hand/arm", "floor"])
    assert found[1] == pytest.approx(found[0] / 4, rel=1e-9)


@pytest.mark.parametrize("masses", [(0.5, 60.0), (60.0, 0.5)], ids=["light below", "heavy below"])
def test_boxes_of_different_mass_stand_on_each_other(masses):
    below, above = masses
    bodies = [FLOOR, box(below, 0, 0, 0.0533, name="below"), box(above, 0, 0, 0.157, name="above")]
    sim = simulator([], bodies, barrier_distance=4e-3)
    *_, before, state = rolled(sim, 80)
    assert (state.body_poses - before.body_poses).abs().max() < 1e-7
    wrenches = sim.contact_wrenches(state)
    assert wrenches["above"][2] == pytest.approx(above * G, rel=1e-5)
    assert wrenches["floor"][2] == pytest.approx(-sum(masses) * G, rel=1e-5)


@pytest.mark.parametrize("mass", [0.5, 10.0, 100.0])
def test_a_cloth_lies_between_a_floor_and_a_box(mass):
    """The stiffness of floor and cloth ignores the box's load: the gap shrinks but stays open."""
    sim = simulator([sheet(9, 0.01)], [FLOOR, box(mass, 0, 0, 0.08, name="box")])
    state = rolled(sim, 80)[-1]
    assert state.positions[:, 2].min() > 0.01 * sim.default_parameters().barrier_distance
    wrenches = sim.contact_wrenches(state)
    cloth = sim.vertex_masses().sum().item()
    assert wrenches["box"][2] == pytest.approx(mass * G, rel=1e-3)
    assert wrenches["floor"][2] == pytest.approx(-(mass + cloth) * G, rel=1e-3)


def test_a_start_is_deep_by_the_stiffness_of_its_own_pair():
    """A body that is elsewhere does not decide which starts a simulator warns of."""
    far = box(95.0, 30.0, 0.0, 1.0)

    def soft(height):
        return sheet(4, height, density=2.0, stretch=20.0, bending=1e-7)

    def warns(height, *bodies):
        cloth = soft(height)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sim = simulator([cloth], [FLOOR, *bodies], dt=0.03, barrier_distance=4e-3)
            sim.step(sim.initial_state())
        return [warning.category for warning in caught] == [dc.BarrierStartWarning]

    heights = np.linspace(6e-4, 4.2e-3, 15)
    alone = [warns(height) for height in heights]
    assert any(alone)
    assert not all(alone)
    assert [warns(height, far) for height in heights] == alone


# --- One number and many -------------------------------------------------------------------------


def several(scheme="coupled", coupling="monolithic", **options):
    """Two sheets on a floor, and a box on the sheets unless the scheme is `split`."""
    bodies = [FLOOR] if scheme == "split" else [FLOOR, box(0.4, 0.03, 0.02, 0.086, name="box")]
    cloths = [sheet(6, 0.01, friction=0.3), sheet(5, 0.022, stretch=300.0)]
    dt = 0.002 if coupling == "cloth_to_rigid" else DT
    return simulator(cloths, bodies, dt=dt, scheme=scheme, coupling=coupling, **options)


WAYS = [
    ("coupled", "monolithic"),
    ("split", "monolithic"),
    ("coupled", "rigid_to_cloth"),
    ("coupled", "cloth_to_rigid"),
]


def gradient_and_end(sim, state, parameters):
    x = state.positions.detach().requires_grad_()
    end = sim.step(state.replace(positions=x), None, parameters)
    weights = torch.sin(torch.arange(end.positions.numel(), dtype=F64)).reshape(x.shape)
    value = (weights * end.positions).sum() + end.body_forces.sum()
    return torch.autograd.grad(value, [x, parameters.barrier_stiffness]), end


@pytest.mark.filterwarnings("ignore::diffcloth_torch.AddedMassWarning")
@pytest.mark.parametrize(("scheme", "coupling"), WAYS)
def test_a_single_number_applies_to_every_pair(scheme, coupling):
    """Bit for bit, and its gradient is the sum of theirs."""
    sim = several(scheme, coupling, barrier_stiffness=1500.0)
    count = len(sim.surfaces)
    given = sim.default_parameters()
    assert given.barrier_stiffness.shape == ()
    state = rolled(sim, round(0.06 / sim.dt))[-1]
    found = [
        gradient_and_end(
            sim,
            state,
            given.replace(
                barrier_stiffness=torch.full(shape, 1500.0, dtype=F64, requires_grad=True)
            ),
        )
        for shape in ((), (count, count))
    ]
    (one, by_one), (many, by_many) = found
    assert by_one.report.contact_count > 20
    for name in ("positions", "velocities", "body_poses", "body_forces", "body_velocities"):
        assert torch.equal(getattr(by_one, name), getattr(by_many, name))
    assert torch.equal(one[0], many[0])
    torch.testing.assert_close(one[1], many[1].sum(), rtol=1e-9, atol=0)
    assert torch.equal(many[1], many[1].T)


def test_a_batch_has_a_number_or_numbers_for_each_environment():
    sim = several()
    count = len(sim.surfaces)
    default = sim.default_parameters().barrier_stiffness
    state = rolled(sim, 6)[-1]
    batch = dc.stack([state, state])
    numbers = torch.tensor([700.0, 4e3], dtype=F64)
    matrices = torch.stack([default, 2.0 * default])
    for values in (numbers, matrices):
        end = sim.step(batch, None, sim.default_parameters().replace(barrier_stiffness=values))
        for k in range(2):
            parameters = sim.default_parameters().replace(barrier_stiffness=values[k])
            assert torch.equal(end.positions[k], sim.step(state, None, parameters).positions)
    assert default.shape == (count, count)
    wrong = sim.default_parameters().replace(barrier_stiffness=torch.ones(count, dtype=F64))
    with pytest.raises(dc.InvalidInput, match=rf"\[\] or \[{count}, {count}\]"):
        sim.step(state, None, wrong)
    wrong = default.clone()
    wrong[1, 2] = 0.0
    with pytest.raises(dc.InvalidInput, match=r"`parameters\.barrier_stiffness` must .*> 0, got 0"):
        sim.step(state, None, sim.default_parameters().replace(barrier_stiffness=wrong))


def test_a_pair_uses_the_mean_of_its_two_entries_and_no_other():
    sim = several()
    state = rolled(sim, 6)[-1]
    default = sim.default_parameters().barrier_stiffness
    surfaces = list(sim.surfaces)

    def end(values):
        return sim.step(
            state, None, sim.default_parameters().replace(barrier_stiffness=values)
        ).positions

    a, b = surfaces.index("cloth0"), surfaces.index("cloth1")
    one_sided = default.clone()
    one_sided[a, b], one_sided[b, a] = 0.5 * default[a, b], 1.5 * default[a, b]
    assert torch.equal(end(default), end(one_sided))
    assert not torch.equal(end(default), end(one_sided + one_sided.T))
    # The floor and the box are apart by the sheets.
    a, b = surfaces.index("floor"), surfaces.index("box")
    other = default.clone()
    other[a, b] *= 50.0
    assert torch.equal(end(default), end(other))


@pytest.mark.parametrize("unit", [2.0**-10, 2.0**12])
def test_defaults_do_not_know_the_unit_of_length(unit):
    """Powers of two scale every number without rounding."""

    def scene(m):
        material = dc.Material(stretch=550.0, bending=1e-5 * m**2, density=0.124 / m**2)
        grid = dc.Cloth.grid(7, 7, size=(0.3 * m, 0.3 * m), material=material)
        bodies = [
            dc.RigidBody.plane(2.0 * m, pose=[0, 0, -0.1 * m, 1, 0, 0, 0]),
            box(40.0, 0, 0, 0.2 * m, side=0.1 * m),
        ]
        solver = dc.SolverOptions(tolerance=1e-6 * m)
        gravity = np.array([0, 0, -9.81]) * m
        contact = dc.ContactOptions(slip_velocity=1e-3 * m)
        return dc.Simulator(
            dc.Scene([grid], bodies, gravity=gravity), DT, solver=solver, contact=contact
        )

    # The unit is N/m^2, and N contains one length: the stiffness scales with 1/length.
    expected, found = scene(1.0).default_parameters(), scene(unit).default_parameters()
    assert torch.equal(found.barrier_stiffness * unit, expected.barrier_stiffness)
