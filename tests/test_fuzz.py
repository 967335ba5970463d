"""A few random scenes in the tests; `scripts/fuzz` runs any number of scenes."""

import importlib.util
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from differences import slope_error

pytest.importorskip("ipctk")

ROOT = Path(__file__).resolve().parents[1]
FUZZ = ROOT / "tests" / "fuzz"
sys.path.insert(0, str(FUZZ))
_spec = importlib.util.spec_from_file_location("fuzz_main", FUZZ / "__main__.py")
fuzz_main = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(fuzz_main)
draw_tower = fuzz_main.draw_tower


def fuzz(*arguments):
    command = [sys.executable, "tests/fuzz", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def numbers(text):
    """The text without times."""
    return re.sub(r" in \d+ s", "", text)


def test_nothing_is_wrong_with_a_few_random_scenes():
    result = fuzz("--scenes", "4", "--seed", "1")
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.startswith("4 scenes, ")
    assert "intersection 0, path 0, report 0, momentum 0, not finite 0, error 0" in result.stdout


@pytest.mark.slow
def test_directions_that_single_precision_turns_are_computed_again():
    """Two soft sheets of 1.6 cm between a box and a plane: damped directions pointed uphill."""
    result = fuzz("--seed", "3", "--only", "19")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "NotConverged 0" in result.stdout


@pytest.mark.slow
def test_exact_directions_that_single_precision_turns_are_computed_again():
    """A fold of a 5 mm sheet: a step of the exact Hessian pointed uphill, which ended the solve."""
    result = fuzz("--seed", "24", "--only", "21")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "NotConverged 0" in result.stdout


def test_every_second_scene_is_a_tower():
    """The other scenes equal earlier ones, in which only cloths moved."""
    drawings = fuzz_main.DRAWINGS
    for index, name in enumerate(("towers", "cloths", "towers", "cloths")):
        drawn = drawings["all"](6, index).description
        assert drawn == drawings[name](6, index).description
        assert ("coupling" in drawn) == (name == "towers")


@pytest.mark.slow
def test_towers_are_of_every_kind():
    scenes = [draw_tower(1, index) for index in range(60)]
    simulators = [scene.simulator for scene in scenes]
    assert {sim.scheme for sim in simulators} == {"coupled", "split", "projective"}
    assert {sim.coupling for sim in simulators} == {
        "monolithic", "rigid_to_cloth", "cloth_to_rigid",
    }  # fmt: skip
    robots = [robot for sim in simulators for robot in sim.scene.robots]
    assert {robot.mechanism.base for robot in robots} == {"fixed", "kinematic", "floating"}
    modes = {mode for robot in robots for mode in robot.mechanism.actuation}
    assert modes == {"pd", "position", "velocity", "torque"}
    assert any(not sim.scene.cloths for sim in simulators)
    again = draw_tower(1, 7)
    assert torch.equal(again.start.body_poses, scenes[7].start.body_poses)
    assert again.description == scenes[7].description


def test_the_fuzz_finds_planted_faults():
    """Judges are useful only if they detect errors."""
    scene = next(s for s in (draw_tower(1, i) for i in range(60)) if s.drives is not None)
    tally = fuzz_main.Tally(show_failures=False)
    before, where = scene.start, {"step": 0}
    after = scene.simulator.step(before, scene.control(before, 0))
    judge = fuzz_main.SchemeJudge(scene)
    path = judge.placed(scene.simulator.path(before, scene.control(before, 0)).numpy())
    fuzz_main._judge(scene, judge, before, after, path, tally, where)
    assert not tally.counts
    faster = after.replace(body_velocities=1.1 * after.body_velocities + 0.1)
    elsewhere = after.replace(joint_positions=after.joint_positions + 1.0)
    fuzz_main._check_bodies(scene, before, faster, tally, where)
    fuzz_main._check_joints(scene, elsewhere, tally, where)
    assert tally.counts["momentum"] >= 1
    assert tally.counts["report"] == 2
    assert judge.is_free_path(path)
    assert not judge.is_free_path(np.stack([path[0], -path[0]]))  # all through one point


def test_attachments_are_of_every_kind():
    draws = [fuzz_main.DRAWINGS["all"](1, index) for index in range(60)]
    kinds = [kind for scene in draws for kind in scene.description.get("attachments", ())]
    assert set(kinds) == {"target", "cloth", "body"}
    schemes = {scene.simulator.scheme for scene in draws if scene.pulls}
    assert schemes >= {"coupled", "split"}  # one in sixty is projective
    releases = [p.release < scene.steps for scene in draws for p in scene.pulls]
    assert any(releases)
    assert not all(releases)


def test_the_fuzz_sees_a_target_that_pulls_wrongly():
    """The momentum balance of cloths includes the forces of targets, computed by hand."""
    draws = (fuzz_main.DRAWINGS["cloths"](1, index) for index in range(60))
    scene = next(
        s
        for s in draws
        if any(p.target is not None for p in s.pulls)
        and not len(s.simulator._assembly.pins)
        and s.masses.sum() > 0
    )
    before, where = scene.start, {"step": 0}
    after = scene.simulator.step(before, scene.control(before, 0))
    for factor, wrong in ((1.0, 0), (1.05, 1)):
        pulls = tuple(replace(p, stiffness=factor * p.stiffness) for p in scene.pulls)
        tally = fuzz_main.Tally(show_failures=False)
        fuzz_main._check_momentum(replace(scene, pulls=pulls), before, after, tally, where)
        assert tally.counts["momentum"] == wrong


def test_the_fuzz_sees_air_that_pushes_wrongly():
    """The momentum balance of cloths includes air forces, computed by hand, also in gusts."""
    draws = [fuzz_main.DRAWINGS["cloths"](1, index) for index in range(60)]
    windy = [s for s in draws if s.air.wind is not None and not len(s.simulator._assembly.pins)]
    scene = next(s for s in windy if s.air.normal_drag > 0.2)
    before, where = scene.start, {"step": 1}
    after = scene.simulator.step(before, scene.control(before, 1))
    for factor, wrong in ((1.0, 0), (1.1, 1)):
        air = replace(scene.air, density=factor * scene.air.density)
        tally = fuzz_main.Tally(show_failures=False)
        fuzz_main._check_momentum(replace(scene, air=air), before, after, tally, where)
        assert tally.counts["momentum"] == wrong


@pytest.mark.slow
def test_a_scene_is_a_function_of_its_seed_and_index():
    first, again = (fuzz("--only", "2", "--seed", "1") for _ in range(2))
    assert numbers(first.stdout) == numbers(again.stdout)
    assert first.stdout.startswith("1 scenes, ")


def test_the_extent_of_a_run_must_be_given():
    result = fuzz()
    assert result.returncode == 2
    assert "--minutes, --scenes or --only" in result.stderr


def points_on_branches(factor):
    """Points (t, value, slope times `factor`): t = 0 on a branch alone, neighbors on others."""
    branches = [lambda t: (np.exp(3 * t), 3), lambda t: (2 + np.sin(t), 1), lambda t: (5 - t, -1)]
    found = {0.0: 0, 1e-4: 1, 1e-8: 2, -1e-4: 1, 1e-6: 2, -1e-8: 1, -1e-6: 2}
    return [
        (t, value, factor * slope)
        for t, branch in found.items()
        for value, slope in [branches[branch](t)]
    ]


def test_slopes_are_judged_on_their_own_branch():
    # The error is a slope of 1 instead of cos(t), and rounding of differences over 1e-4.
    assert slope_error(points_on_branches(1.0)) < 1e-7


@pytest.mark.parametrize("factor", [1.05, 0.95, 0.0, -1.0])
def test_wrong_slopes_are_wrong_on_all_branches(factor):
    assert slope_error(points_on_branches(factor)) > 0.04


def test_slopes_that_are_no_numbers_are_not_right():
    points = points_on_branches(1.0)
    points[2] = (*points[2][:2], np.nan)
    assert np.isnan(slope_error(points))


@pytest.mark.slow
@pytest.mark.rounding
def test_a_gradient_where_a_step_has_several_minima_is_not_suspect():
    """A stiff sheet, thrown without gravity: changes of 1e-9 change its buckling mode."""
    result = fuzz("--seed", "3", "--only", "23")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "suspect gradients 0 of 1 checked" in result.stdout
