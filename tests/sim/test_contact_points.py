"""Single contacts add up to the forces of the state, and lie at the contacts of surfaces."""

from dataclasses import fields

import numpy as np
import pytest
import scenes
import torch
from bodies import coupled_scenes
from scipy.spatial.transform import Rotation

import diffcloth_torch as dc

F64 = torch.float64
REGIMES = ["sticking", "sliding", "thick", "pushing", "folded_thick", "stacked", "sphere"]


def taken(name, scheme="coupled"):
    case = scenes.regime(name, scheme)
    return case.sim, case.step()


def with_robot(coupling="monolithic", base="floating"):
    sim, state = coupled_scenes.in_contact(coupling, base)
    return sim, sim.step(state, coupled_scenes.control(sim), coupled_scenes.parameters(sim))


STEPS = {
    **{f"coupled-{name}": (taken, name) for name in REGIMES},
    **{f"split-{name}": (taken, name, "split") for name in ("sliding", "stacked")},
    **{f"robot-{coupling}": (with_robot, coupling) for coupling in coupled_scenes.COUPLINGS},
}


@pytest.fixture(params=STEPS)
def step(request):
    make, *arguments = STEPS[request.param]
    sim, state = make(*arguments)
    return sim, state, sim.contacts(state)


def close(a, b, scale):
    torch.testing.assert_close(a, b, rtol=0, atol=1e-12 * float(scale))


def test_forces_add_up_to_those_of_the_state(step):
    sim, state, contacts = step
    assert contacts.mask.sum() > 10
    assert contacts.tangential_forces.abs().max() > 0
    scale = contacts.forces.abs().sum()
    cloths = [cloth.name or f"cloth{i}" for i, cloth in enumerate(sim.scene.cloths)]
    for name in sim.surfaces:
        rows = sim.slices[name]
        of_state = state.contact_forces if name in cloths else state.body_forces
        close(contacts.on(name).forces.sum(dim=0), of_state[rows].sum(dim=0), scale)


def test_forces_add_up_to_those_of_the_report(step):
    sim, state, contacts = step
    pairs = state.report.contacts
    assert len(pairs) > 0
    for first, second in pairs:
        between = contacts.pairs == torch.tensor([sim.surfaces.index(n) for n in (first, second)])
        rows = between.all(dim=-1)
        pressing = rows & (contacts.normal_forces != 0)
        # Exactly parallel edges are counted, but have zero force.
        assert int(pressing.sum()) <= pairs[first, second].count <= int(rows.sum())
        assert pairs[first, second].count - int(pressing.sum()) <= 3
        if first != second:
            force = contacts.forces[rows].sum(dim=0)
            close(force, pairs[first, second].force, contacts.forces.abs().sum())


def test_geometry_is_that_of_the_surfaces(step):
    sim, state, contacts = step
    way = contacts.points[:, 1] - contacts.points[:, 0]
    distance = way.norm(dim=-1)
    torch.testing.assert_close(way, distance[:, None] * contacts.normals, rtol=0, atol=1e-12)
    thickness = sim.default_parameters().thickness[contacts.pairs].mean(dim=-1)
    torch.testing.assert_close(contacts.gaps, distance - thickness, rtol=0, atol=1e-14)
    pressing = contacts.normal_forces != 0
    assert (contacts.gaps[pressing] < sim.default_parameters().barrier_distance).all()
    assert float(distance[pressing].min()) == pytest.approx(state.report.minimum_distance, rel=1e-9)
    along = (contacts.tangential_forces * contacts.normals).sum(dim=-1).abs()
    assert along.max() < 0.1 * contacts.forces.abs().max()  # normals lag by one solve


def test_points_lie_on_their_surfaces():
    sim, state = taken("pushing")
    contacts = sim.contacts(state)
    assert (contacts.pairs == torch.tensor([0, 1])).all()
    box = sim.scene.bodies[0]
    corners = state.meshes()[sim.surfaces[1]][0]
    axes = torch.linalg.lstsq(
        torch.from_numpy(np.c_[box.vertices, np.ones(8)]), torch.as_tensor(corners)
    ).solution
    local = (contacts.points[:, 1] - axes[3]) @ torch.linalg.inv(axes[:3])
    half = torch.from_numpy(np.array(box.vertices)).max(dim=0).values
    assert (local.abs() <= half + 1e-9).all()
    assert ((local.abs() - half).abs().min(dim=-1).values < 1e-9).all()


@pytest.mark.parametrize("order", [1, -1])
def test_points_on_two_round_bodies_lie_on_both(order):
    radii, centers = (0.05, 0.03), ([0.0, 0.0, 0.0], [0.0, 0.02, 0.0785])
    balls = [
        dc.RigidBody.sphere(r, smooth=True, pose=[*at, 1, 0, 0, 0], name=name, motion=motion)
        for r, at, name, motion in zip(radii, centers, "ab", ("static", "kinematic"), strict=True)
    ]
    # A capsule that falls on both.
    pill = dc.RigidBody.capsule(
        0.02, 0.1, smooth=True, motion="dynamic", mass=0.1, pose=[0.0, 0.075, 0.03, 1, 0, 0, 0]
    )
    bodies = [*balls, pill][::order]
    sim = dc.Simulator(dc.Scene([], bodies), 0.01, contact=dc.ContactOptions(barrier_distance=8e-3))
    with torch.no_grad():
        state = sim.step(sim.initial_state())
    contacts = sim.contacts(state)
    assert len(contacts.points) == 2
    for (first, second), ends in zip(contacts.pairs, contacts.points, strict=True):
        for k, end in ((first, ends[0]), (second, ends[1])):
            axis = state.body_poses[k, :3]
            if bodies[k] is pill:
                turn = Rotation.from_quat(state.body_poses[k, [4, 5, 6, 3]].numpy())
                way = torch.from_numpy(turn.apply([0.0, 0.0, 1.0]))
                axis = axis + ((end - axis) @ way).clamp(-0.05, 0.05) * way
            radius = 0.02 if bodies[k] is pill else radii["ab".index(bodies[k].name)]
            assert float((end - axis).norm()) == pytest.approx(radius, rel=1e-12)


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_a_sheet_that_slides_on_a_floor_obeys_coulomb_and_bears_its_weight(friction):
    vertices, faces = scenes.grid(12, 12, edge=0.03)
    vertices[:, 2] = 2.5e-3
    material = dc.Material(friction=friction, damping=0.01)
    cloth = dc.Cloth(vertices, faces, material=material, name="sheet")
    floor = dc.RigidBody.plane(4.0, friction=friction, name="floor")
    sim = dc.Simulator(dc.Scene([cloth], [floor]), 0.01)
    state = sim.initial_state()
    state = state.replace(velocities=state.velocities + torch.tensor([1.0, 0.0, 0.0], dtype=F64))
    with torch.no_grad():
        for _ in range(15):
            state = sim.step(state)
    on_floor = sim.contacts(state).on("floor")
    weight = 9.81 * float(sim.vertex_masses().sum())
    assert float(on_floor.normal_forces.sum()) == pytest.approx(weight, rel=0.05)
    torch.testing.assert_close(
        on_floor.normals, torch.tensor([0.0, 0.0, -1.0], dtype=F64).expand_as(on_floor.normals)
    )
    assert on_floor.points[:, 1, 2].abs().max() < 1e-12
    drag = on_floor.tangential_forces.sum(dim=0)
    assert float(drag[0]) == pytest.approx(friction * weight, rel=0.05)
    # The moments of forces at points and at vertices agree, up to the couple by which friction
    # across a gap conserves angular momentum.
    wrench = sim.contact_wrenches(state)["floor"]
    moment = torch.linalg.cross(on_floor.points[:, 1], on_floor.forces).sum(dim=0)
    couple = float(on_floor.gaps.max() * drag.norm())
    assert wrench[3:].norm() > 20 * couple
    torch.testing.assert_close(moment, wrench[3:], rtol=0, atol=2 * couple)


def batch_of(states):
    return dc.stack(states)


def test_environments_of_a_batch_are_padded_single_ones():
    sim = scenes.regime("sliding").sim
    start = scenes.regime("sliding").state
    lifted = start.replace(positions=start.positions + torch.tensor([0.0, 0.0, 0.05], dtype=F64))
    aside = start.replace(positions=start.positions + torch.tensor([0.1, 0.0, 0.0], dtype=F64))
    starts = [start, lifted, aside]
    alone = [sim.step(state) for state in starts]
    batch = sim.step(batch_of(starts))
    together = sim.contacts(batch)
    counts = [int(sim.contacts(state).mask.sum()) for state in alone]
    assert counts[1] == 0 < counts[2] < counts[0]
    assert together.mask.shape == (3, counts[0])
    assert together.mask.sum(dim=1).tolist() == counts
    assert (together.pairs[~together.mask] == -1).all()
    for padded in (together, together.on(sim.surfaces[1])):
        for f in fields(padded)[3:]:
            assert not getattr(padded, f.name)[~padded.mask].any(), f.name
    rearranged = batch_of([batch[i] for i in range(3)])
    mixed = dc.where(torch.tensor([True, False, True]), batch, batch_of([alone[0]] * 3))
    for i in range(3):
        of_mixed = alone[i if i != 1 else 0]
        for whole, one in ((together, alone[i]), (sim.contacts(mixed), of_mixed)):
            single = sim.contacts(one)
            for f in fields(single)[1:]:
                mine = getattr(whole, f.name)[i][whole.mask[i]]
                assert torch.equal(mine, getattr(single, f.name)), f.name
    assert torch.equal(sim.contacts(rearranged).points, together.points)
    assert torch.equal(sim.contacts(batch[1:]).mask.sum(dim=1), torch.tensor(counts[1:]))


def test_a_state_that_was_saved_has_its_contacts(tmp_path):
    sim, state = taken("sphere")
    torch.save(state, tmp_path / "state.pt")
    again = torch.load(tmp_path / "state.pt")
    assert torch.equal(sim.contacts(again).forces, sim.contacts(state).forces)


def test_single_contacts_have_no_gradient_and_say_so():
    case = scenes.regime("sliding")
    leaf = case.state.positions.clone().requires_grad_()
    state = case.step({"state.positions": leaf})
    contacts = case.sim.contacts(state)
    assert torch.equal(contacts.gaps, case.sim.contacts(state.detach()).gaps)
    with pytest.raises(dc.InvalidInput, match="contacts: single contacts have no gradient"):
        (contacts.on(case.sim.surfaces[1]).normal_forces.sum() + state.positions.sum()).backward()
    state.body_forces.sum().backward()
    assert leaf.grad.abs().max() > 0
    assert not case.sim.contacts(state.detach()).gaps.requires_grad


def test_states_without_contacts_of_a_step_are_refused():
    sim = scenes.regime("sliding").sim
    with pytest.raises(dc.InvalidInput, match="`state` must be the result of a step"):
        sim.contacts(sim.initial_state())
    contacts = sim.contacts(scenes.regime("sliding").step())
    with pytest.raises(dc.InvalidInput, match=r"`surface` must be one of .*, got 'moon'"):
        contacts.on("moon")


@pytest.mark.parametrize("scheme", ["projective", "split"])
def test_contact_at_vertices_is_refused(scheme):
    cloth = dc.Cloth.grid(4, 4, pose=[0, 0, 0.1, 1, 0, 0, 0])
    floor = dc.RigidBody.plane(1.0, nodal_contact=True)
    sim = dc.Simulator(dc.Scene([cloth], [floor]), 0.01, scheme=scheme)
    with pytest.raises(dc.InvalidInput, match="contacts: contact at vertices"):
        sim.contacts(sim.step(sim.initial_state()))
