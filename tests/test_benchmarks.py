"""The benchmarks run, and their scenes are in the regimes of their names. No time is judged."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import diffcloth_torch as dc

ROOT = Path(__file__).resolve().parents[1]
ORDINARY = 7
# Including scenes in air, of woven cloth, over a smooth ball, and two with a gripper.
SCENES = ORDINARY + 7


@pytest.fixture(autouse=True)
def ours(monkeypatch):
    """Import our `benchmarks`: a package that tests install has a folder of that name, too."""
    monkeypatch.syspath_prepend(ROOT)


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Output and records of the quick form, in a separate process: it sets torch's threads."""
    out = tmp_path_factory.mktemp("benchmarks") / "step.json"
    command = [sys.executable, "-m", "benchmarks.step", "--quick", "--json", str(out)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout, json.loads(out.read_text())


@pytest.mark.slow
def test_every_scene_is_timed_alone_and_in_batches(quick):
    text, records = quick
    assert len(records["timings"]) == SCENES * (2 + 2)
    for timing in records["timings"]:
        assert timing["scene"] in text
        for field in ("forward", "backward", "reference"):
            spread = timing[field]
            assert 0 < spread["lower"] <= spread["median"] <= spread["upper"]
        assert all(milliseconds >= 0 for milliseconds in timing["phases"].values())
        assert timing["forward_in_ef"] == pytest.approx(
            timing["forward"]["median"] / timing["reference"]["median"]
        )
        assert timing["iterations"] >= 1
        assert 0 <= timing["residual"] < 1e-6  # the default tolerance [m/s]


@pytest.mark.slow
def test_scenes_are_in_their_regimes(quick):
    _, records = quick
    for timing in records["timings"]:
        share, contacts = timing["contact_share"], timing["contacts"]
        if timing["scene"] in ("hanging", "damped", "stiff", "air"):
            assert contacts == share == 0
        else:
            assert contacts > 0
            assert share > 0
        if timing["scene"] == "plane":
            assert share == 1


def test_threads_do_not_change_solutions(quick):
    _, records = quick
    for scene in {timing["scene"] for timing in records["timings"]}:
        one, two = (t for t in records["timings"] if t["scene"] == scene and t["batch"] > 0)
        assert (one["threads"], two["threads"]) == (1, 2)
        for field in ("iterations", "residual", "contacts", "contact_share"):
            assert one[field] == two[field]


def test_summaries_have_a_finite_row_for_each_scene(quick):
    _, records = quick
    for summary in ("exponents", "batch_scaling"):
        assert len(records[summary]) == SCENES
        for row in records[summary].values():
            assert all(math.isfinite(number) for number in row.values())


@pytest.mark.slow
def test_two_packages_are_compared_on_the_same_steps(tmp_path):
    out = tmp_path / "compare.json"
    command = [
        sys.executable,
        "-m",
        "benchmarks.compare",
        "--against",
        str(ROOT),
        "--json",
        str(out),
    ]
    command += ["--scene", "plane", "--size", "6", "--steps", "2"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = json.loads(out.read_text())
    assert [(row["batch"], row["threads"]) for row in rows] == [(0, 1), (8, 1), (8, 2)]
    for row in rows:
        assert row["this"]["iterations"] == row["other"]["iterations"] >= 1
        for side in ("this", "other"):
            assert row[side]["forward"] > 0 < row[side]["backward"]
            assert row[side]["unconverged"] == 0


@pytest.mark.slow
def test_a_folder_without_a_package_is_refused(tmp_path):
    command = [sys.executable, "-m", "benchmarks.compare", "--against", str(tmp_path)]
    command += ["--scene", "hanging", "--size", "6", "--no-batch"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert f"{tmp_path} has no diffcloth_torch" in result.stderr


@pytest.mark.slow
def test_every_factorization_is_timed():
    command = [sys.executable, "-m", "benchmarks.factorization", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    for name in ("hanging", "self-contact"):
        assert result.stdout.count(f"\n{name}, ") == 2
    for method in ("multifrontal (portable)", "eigen"):
        assert result.stdout.count(method) >= 4


@pytest.mark.slow
def test_dynamic_bodies_are_timed_beside_prescribed_ones():
    command = [sys.executable, "-m", "benchmarks.coupling", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = [line.split() for line in result.stdout.splitlines()]
    assert [row[0] for row in rows[1:]] == ["free", "gripper"]
    assert all(float(row[-1]) >= 1 for row in rows[1:])  # steps in contact


@pytest.mark.slow
def test_a_fit_is_made_in_all_ways():
    command = [sys.executable, "-m", "benchmarks.step_bias", "--quick", "slide"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = [line.split()[0] for line in result.stdout.splitlines()[2:]]
    assert rows == ["euler", "its", "extrapolated", "in", "second_order", "its", "the"]


def test_intervals_of_fits_to_another_simulator_are_counted(monkeypatch):
    """Nine markers in two frames: intervals, moved ones, and their counts in a table."""
    foreign = importlib.import_module("benchmarks.foreign")
    monkeypatch.setattr(foreign.example(), "ROWS", 3)
    case = foreign.Case("few frames", 1, 0.02)
    one = foreign.outcome(case, 0, frames=2)
    assert list(one.intervals) == ["white", "white, step", "robust", "robust, step"]
    for noise in ("white", "robust"):
        for name in foreign.NUMBERS:
            still, moved = one.intervals[noise], one.intervals[f"{noise}, step"]
            assert moved[name][1] - still[name][1] == pytest.approx(moved[name][0] - still[name][0])
            assert moved[name] != still[name]
    wide = one._replace(intervals={"white": dict.fromkeys(foreign.NUMBERS, (-1e9, 1e9))})
    narrow = one._replace(
        intervals={"white": {n: (t + 1e-9, t + 1) for n, t in one.true.items()}},
        warned=frozenset({dc.ModelErrorWarning}),
    )
    _, warned, *rows = foreign.table(case, [wide, narrow])
    assert "ModelErrorWarning 1 of 2" in warned
    assert [row.split()[-4:] for row in rows[1:4]] == [["1", "of", "2", "(9-91%)"]] * 3
    assert rows[4].split() == ["all", "3", "of", "6"]
    assert rows[5].split() == ["not", "warned", "3", "of", "3"]


def test_fits_to_another_simulator_take_no_configuration():
    main = importlib.import_module("benchmarks.identification").main
    result = CliRunner().invoke(main, ["--foreign", "--set", "simulation.dt=0.01"])
    assert result.exit_code == 2
    assert "--foreign has scenes of its own" in result.output


@pytest.mark.filterwarnings("ignore::diffcloth_torch.errors.CorrelatedResidualsWarning")
def test_white_intervals_are_those_of_a_fit_under_white_noise():
    """A fit of its own to one series, whose robust intervals differ."""
    foreign = importlib.import_module("benchmarks.foreign")
    noise = torch.from_numpy(np.random.default_rng(0).standard_normal(50))
    free = {"a": dc.Variable(1.0)}
    robust = dc.fit(free, lambda p, v: v["a"] - noise, covariance="robust")
    plain = dc.fit(free, lambda p, v: v["a"] - noise, covariance="white")
    assert foreign.white(robust)["a"] == pytest.approx(plain.intervals["a"])
    assert robust.intervals["a"] != pytest.approx(plain.intervals["a"])


@pytest.mark.slow
def test_a_jacobian_is_timed_beside_its_rollout():
    command = [sys.executable, "-m", "benchmarks.tangents", "--size", "6", "--steps", "4"]
    command += ["--repeats", "1"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = {line.split()[0]: line.split()[1] for line in result.stdout.splitlines()[1:]}
    assert list(rows) == ["rollout", "jacfwd", "differences", "stretch", "friction", "bending"]
    assert float(rows["stretch"]) < 1e-3


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    """A folder with the page of a quick run against this very checkout."""
    docs = tmp_path_factory.mktemp("figures")
    run_figures("--quick", "--cpu", "--against", f"an equal={ROOT}", "--docs", str(docs))
    return docs


def run_figures(*arguments):
    command = [sys.executable, "-m", "benchmarks.figures", *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_the_page_of_figures_has_the_measurements(figures):
    records = json.loads((figures / "performance.json").read_text())
    page = (figures / "performance.md").read_text()
    rows = records["releases"]["an equal"]
    assert "## Compared with an equal" in page
    assert [(row["scene"], row["batch"]) for row in rows] == [
        ("hanging", 0),
        ("sphere", 0),
        ("sphere", 8),
    ]
    assert len(records["phases"]) == ORDINARY
    for row in rows:
        assert row["this"]["iterations"] == row["other"]["iterations"] >= 1
        ratio = row["other"]["forward"] / row["this"]["forward"]
        cells = [row["scene"], str(row["size"]), str(row["batch"] or 1), "1"]
        (line,) = (x for x in page.splitlines() if x.startswith(f"| {' | '.join(cells)} |"))
        assert float(line.split("|")[7]) == pytest.approx(ratio, rel=0.01)  # three digits
    for row in records["losses"]:
        assert row["loop"] > 0 < row["once"]
    for row in records["shared"]:
        assert row["one"] > 0 < row["two"]
        assert f"| {row['scene']} | {row['size']} |" in page.partition("on two threads")[2]
    shown = {path.name for path in (figures / "images").iterdir()}
    assert shown == {f"performance_{name}.svg" for name in ("ratio", "size", "phases")}
    assert all(f"](images/{name})" in page for name in shown)


@pytest.mark.quick("hanging", "plane")
@pytest.mark.parametrize("name", ["hanging", "plane", "sphere"])
def test_our_side_of_a_peer(name):
    """Gradients of rollouts at 60 Hz match differences, and no vertex penetrates."""
    peers = importlib.import_module("benchmarks.peers")
    told = peers.scene(name, 6)
    found = peers.time_ours(told)
    assert len(found["frames"]) == peers.FRAMES + 1
    assert peers.gradient_error(found) < 1e-3
    assert peers.depth(told, found) == 0.0
    # The judges can fail.
    wrong = {**found, "slopes": [1.5 * slope for slope in found["slopes"]]}
    assert peers.gradient_error(wrong) > 5e-3
    if told["body"] is not None:
        low = {**found, "frames": [x - [0.0, 0.0, 0.1] for x in found["frames"]]}
        assert peers.depth(told, low) > 0.02


@pytest.mark.parametrize("name", ["hanging", "plane", "sphere", "self-contact"])
def test_our_side_of_a_peer_without_gradients(name):
    peers = importlib.import_module("benchmarks.forward_peers")
    told = peers.scene(name, 8)
    found = peers.time_ours(told)
    assert len(found["frames"]) == told["frames"] + 1
    judged = peers.judge(told, found)
    assert (judged["crossings"], judged["inside"], judged["depth"]) == (0, 0, 0.0)
    assert 1.0 <= judged["stretch"] < 1.5
    # The judges can fail: for an edge through the sheet, and for a lower sheet.
    if told["body"] is None:
        x = np.array(told["rest"])
        x[1, 2] += 0.1
        x[0] = (0.25, 0.25, -0.1)
        assert peers.judge(told, {**found, "frames": [x]})["crossings"] > 0
    else:
        low = {**found, "frames": [x - [0.0, 0.0, 0.1] for x in found["frames"]]}
        assert peers.judge(told, low)["inside"] > 0
        assert peers.judge(told, low)["depth"] > 20.0
    assert told["mass"] == pytest.approx(told["density"], rel=1e-9)  # of one square meter


@pytest.mark.slow
def test_errors_of_integrators_fall_with_the_time_step():
    integrators = importlib.import_module("benchmarks.integrators")
    rows = integrators.errors_and_times(4, 0.2, turns=1)
    assert [row["h"] for row in rows] == [0.02, 0.01, 0.005, 0.0025]
    euler, second = ([row[name]["error"] for row in rows] for name in integrators.INTEGRATORS)
    # 5.29, 2.67, 1.34 and .67 mm; .46, .20, .07 and .02 mm: the sheet has modes faster than h.
    assert all(1.8 < a / b < 2.2 for a, b in itertools.pairwise(euler))
    assert second[0] > 10 * second[-1]
    assert all(10 * b < a for a, b in zip(euler, second, strict=True))
    assert all(row[name]["milliseconds"] > 0 for row in rows for name in integrators.INTEGRATORS)


@pytest.mark.slow
def test_the_page_of_figures_is_that_of_its_records(tmp_path):
    """The page has no manual edits, and was redrawn after the last change of its records."""
    for name in ("performance.json", "performance.md"):
        (tmp_path / name).write_bytes((ROOT / "docs" / name).read_bytes())
    run_figures("--draw", "--docs", str(tmp_path))
    assert (tmp_path / "performance.md").read_text() == (ROOT / "docs/performance.md").read_text()
    drawn = {path.name for path in (tmp_path / "images").iterdir()}
    assert drawn == {path.name for path in (ROOT / "docs/images").glob("performance_*")}


def read_tables(*command):
    """Title -> method -> column -> cell, of the tables that a benchmark prints."""
    result = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    lines = [line for line in result.stdout.splitlines() if line.startswith("| ")]
    tables = {}
    for line in lines:
        first, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        if cells[0] == "pairs":
            title, columns = first, cells
            tables[title] = {}
        else:
            tables[title][first] = dict(zip(columns, cells, strict=True))
    return tables


@pytest.mark.slow
def test_experiments_are_compared_by_scheme():
    tables = read_tables("benchmarks.experiments", "--quick")
    assert list(tables) == ["tie", "cloth_on_cube"]
    for rows in tables.values():
        for method in ("split", "coupled, frictionless", "coupled"):
            assert rows[method]["pairs"] == "0"
    cube = tables["cloth_on_cube"]
    assert float(tables["tie"]["coupled"]["turns"]) >= 0
    assert cube["coupled"]["turns"] == "-"
    assert int(cube["projective"]["pairs"]) > 0
    assert float(cube["coupled"]["distance [mm]"]) < 100  # from half a meter


def test_turns_are_those_of_links():
    linking = importlib.import_module("benchmarks.experiments").linking
    t = np.linspace(0, 2 * np.pi, 13)
    ring = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    other = np.stack([1 + np.cos(t), 0 * t + 0.01, np.sin(t)], axis=1)
    # Solid angles add up to the solid angle of a sphere, up to rounding.
    assert abs(linking(ring, other)) == pytest.approx(1, abs=1e-12)
    assert linking(ring, other[::-1]) == pytest.approx(-linking(ring, other), abs=1e-12)
    assert linking(ring, other + np.array([3, 0, 0])) == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_schemes_are_compared_on_the_same_scenes():
    tables = read_tables("benchmarks.schemes", "--quick")
    assert list(tables) == ["sphere", "floor", "box"]
    for rows in tables.values():
        for method, row in rows.items():
            assert float(row["gradient"]) < 1e-3, method
            if not method.startswith("projective"):
                assert row["pairs"] == "0", method
            if method != "split, identity":
                assert float(row["momentum"]) < 1e-5, method
        assert float(rows["split, identity"]["momentum"]) > 1e-3
        assert float(rows["coupled"]["energy"]) < 1e-6


def test_crossings_are_those_of_triangles(monkeypatch):
    """Two sheets that pierce each other, against all pairs of edges and triangles."""
    crossings_of = importlib.import_module("benchmarks.crossings").Crossings
    sheets = [
        dc.Cloth.grid(4, 4, 1.0, name="level"),
        dc.Cloth.grid(5, 5, 0.9, name="steep", pose=[9, 0, 0, 0.8, 0.6, 0, 0]),
    ]
    scene = dc.Scene(sheets, [dc.RigidBody.sphere(0.2, subdivisions=0, pose=[0, 0, 9, 1, 0, 0, 0])])
    state = dc.Simulator(scene, 0.01).initial_state()
    crossings = crossings_of(scene)
    assert crossings.count(state) == 0
    moved = state.positions.clone()
    moved[16:, 0] -= 9 - 0.013
    moved[:, 2] += torch.linspace(0, 0.1, len(moved), dtype=torch.float64)
    poses = state.body_poses.clone()
    poses[:, 2] = 0.11
    state = state.replace(positions=moved, body_poses=poses)
    points = crossings.points(state)
    faces = np.concatenate(
        [sheets[0].faces, 16 + sheets[1].faces, len(moved) + scene.bodies[0].faces]
    )
    expected = {
        (i, j)
        for i in range(len(faces) - len(scene.bodies[0].faces))
        for j in range(i + 1, len(faces))
        if not set(faces[i]) & set(faces[j])
        and (
            pierces(points[faces[i]], points[faces[j]])
            or pierces(points[faces[j]], points[faces[i]])
        )
    }
    assert crossings.count(state) == len(expected) > 10


def pierces(a, b):
    """Return whether an edge of triangle `a` passes through triangle `b`."""
    for p, q in ((a[0], a[1]), (a[1], a[2]), (a[2], a[0])):
        # p + t (q - p) = b0 + u (b1 - b0) + v (b2 - b0)
        matrix = np.stack([p - q, b[1] - b[0], b[2] - b[0]], axis=1)
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue  # parallel, and not in the plane
        t, u, v = np.linalg.solve(matrix, p - b[0])
        if 0 <= t <= 1 and u >= 0 and v >= 0 and u + v <= 1:
            return True
    return False


@pytest.mark.slow
def test_the_baseline_is_timed_with_both_elastic_solvers():
    command = [sys.executable, "-m", "benchmarks.projective", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = [line.split() for line in result.stdout.splitlines()]
    assert [row[0] for row in rows[1:]] == 2 * ["newton", "projective"]
    assert all(int(row[2]) > 0 for row in rows[1:])  # vertices in contact


@pytest.mark.quick("step-ipctk-*")
@pytest.mark.parametrize(
    ("benchmark", "module", "sentence"),
    [
        ("step", "ipctk", "needs ipctk: run  pip install 'diffcloth-torch[test]'"),
        ("schemes", "ipctk", "needs ipctk: run  pip install 'diffcloth-torch[test]'"),
        ("factorization", "scipy", "needs scipy.spatial: run  pip install 'diffcloth-torch[test]'"),
        ("factorization", "diffcloth_torch._kernels", "CMAKE_ARGS=-DDIFFCLOTH_KERNELS=ON"),
    ],
)
def test_a_missing_extra_is_named_in_a_sentence(benchmark, module, sentence):
    """None in sys.modules makes Python's import of the module fail."""
    code = (
        f"import runpy, sys; sys.modules[{module!r}] = None; "
        f"runpy.run_module('benchmarks.{benchmark}', run_name='__main__')"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert sentence in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.slow
def test_jumps_are_counted():
    command = [sys.executable, "-m", "benchmarks.branches", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    rows = [line.split() for line in result.stdout.splitlines()[1:]]
    assert [row[0] for row in rows] == ["thrown", "crumple"]
    for row in rows:
        jumps, starts, failed, growth, iterations, milliseconds = map(float, row[2:])
        assert 0 <= jumps <= starts == 6
        assert failed == 0
        assert growth > 0
        assert iterations > 1
        assert milliseconds > 0


def test_an_end_that_is_elsewhere_is_a_jump(monkeypatch):
    """With a threshold below the differences of starts, every start jumps."""
    branches = importlib.import_module("benchmarks.branches")
    monkeypatch.setattr(branches, "JUMP", 1e-13)
    count = branches.count_jumps("crumple", 8, 2, 2, (1e-9, 1e-7))
    assert (count.jumps, count.starts, count.failed) == (4, 4, 0)


@pytest.mark.slow
def test_creep_is_measured():
    command = [sys.executable, "-m", "benchmarks.sticking", "--quick"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    held = [line for line in result.stdout.splitlines() if "of its friction" in line]
    assert len(held) == 4
    for line in held:
        way, law = map(float, line.rpartition(":")[2].split(","))
        assert way == pytest.approx(law, abs=2e-3)


@pytest.mark.slow
def test_bits_are_the_same_twice_and_others_in_another_scheme():
    command = [sys.executable, "-m", "benchmarks.bits", "--size", "6", "--only", "sphere"]
    runs = [
        subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        for _ in range(2)
    ]
    assert runs[0].returncode == 0, runs[0].stderr
    assert runs[0].stdout == runs[1].stdout
    lines = [line.split() for line in runs[0].stdout.splitlines()]
    # Three schemes and a batch; without `projective` woven and damped cloth and a smooth ball.
    assert len(lines) == 13
    # At this size the sheet may have left the ball; then two schemes agree.
    assert len({line[-2] for line in lines}) >= 3
    assert len({line[-1] for line in lines}) >= 3


@pytest.mark.slow
def test_uneven_batches_are_shared_as_evenly_as_costs_tell():
    uneven = importlib.import_module("benchmarks.uneven")
    assert uneven.makespan([1.0, 1.0, 2.0]) == 3.0
    assert uneven.makespan([2.0, 1.0, 1.0]) == 2.0
    assert uneven.best_makespan([3.0, 3.0, 2.0, 2.0, 2.0]) == 6.0
    assert uneven.makespan([3.0, 3.0, 2.0, 2.0, 2.0]) == 7.0
    options = ("--size", "8", "--environments", "4", "--steps", "1")
    command = [sys.executable, "-m", "benchmarks.uneven", *options]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    seconds, *ratios = result.stdout.splitlines()
    assert len(seconds.split(":")[1].split()) == 4
    found = {name: float(rest.split(",")[0]) for name, rest in (r.split(": ") for r in ratios)}
    assert found["cost"] <= found["best"] <= 2.0
    assert found["batch"] <= found["best"]


@pytest.mark.slow
def test_energy_of_fast_turns_is_counted():
    command = [sys.executable, "-m", "benchmarks.turns", "--throws", "1", "--seconds", "0.05"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    thrown, rolled = result.stdout.split("\n\n")
    rows = [line.split() for line in thrown.splitlines()[1:]]
    assert len(rows) == 18
    assert sum(int(row[-4]) for row in rows) > 10  # steps
    rows = [line.split() for line in rolled.splitlines()[1:]]
    assert [row[0] for row in rows[::6]] == ["80", "320", "1280"]
    for _, dt, _, steps, _, largest, formula, _ in rows:
        assert int(steps) == round(50 / float(dt))
        assert float(formula) == pytest.approx(9.81 * (float(dt) / 1e3) ** 2 / 0.07, abs=1e-4)
        assert -1 < float(largest) < 2 * float(formula) + 1e-3


def test_rows_of_learning_are_made_once(tmp_path):
    learning = importlib.import_module("benchmarks.learning")
    file = tmp_path / "rows.jsonl"
    common = ["HitCloth", "--size", "4", "--episodes", "2", "--results", str(file)]
    common += ["--policies", str(tmp_path / "policies")]

    def run(*arguments):
        result = CliRunner().invoke(learning.main, [*common, *arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return [json.loads(line) for line in file.read_text().splitlines()]

    first = run("--method", "zero", "--seed", "0")
    assert [(row["task"], row["method"], row["seed"]) for row in first] == [("HitCloth", "zero", 0)]
    assert first[0]["episodes"] == 2
    assert first[0]["success"] == 0.0
    assert first[0]["interval"][1] == pytest.approx(0.6576, abs=1e-4)  # Wilson's, of 0 of 2
    assert first[0]["steps"] == 0
    with file.open("a") as end:
        end.write('{"task": "HitCl')  # cut off
    second = run("--method", "zero", "--method", "script", "--seed", "0")
    assert second[0] == first[0]
    assert [row["method"] for row in second] == ["zero", "script"]
    assert second[1]["return"] > first[0]["return"]


def test_tables_of_learning_pool_seeds():
    tables = importlib.import_module("benchmarks.learning_tables")

    def row(method, seed, success, size=7, budget=0):
        return {
            "task": "HitCloth", "size": size, "method": method, "seed": seed, "budget": budget,
            "episodes": 4, "success": success, "return": 1.0 + seed, "steps": 10, "minutes": 0.5,
        }  # fmt: skip

    rows = [row("imitate", 0, 1.0), row("imitate", 1, 0.5), row("transfer", 0, 0.25, size=9)]
    rows += [row("ppo", 0, 0.0, budget=20), row("ppo", 0, 0.5, budget=30)]
    text = tables.with_tables("a\n<!-- methods -->\nold\n<!-- end of methods -->\nb\n", rows)
    assert text.splitlines()[:2] == ["a", "<!-- methods -->"]
    assert text.splitlines()[-2:] == ["<!-- end of methods -->", "b"]
    assert "old" not in text
    cells = "|  |  |  | 75 % (41 % to 93 %) | 1.5 | 0: 4, 1: 2 | 10 | 0.5 | 25 % (5 % to 70 %) |"
    assert "| `HitCloth` " + cells in text
    assert "| `HitCloth` | PPO | 0: 0 | 0 % (0 % to 49 %) | 1.0 | 10 | 0.5 |" in text
    assert "| `HitCloth` | PPO | 0: 2 | 50 % (15 % to 85 %) | 1.0 | 10 | 0.5 |" in text
    assert tables.with_tables(text, rows) == text
    same = tables.pooled([row("imitate", 0, 1.0), row("imitate", 0, 0.5, size=9)])
    assert (same.share, same.by_seed) == ("75 % (41 % to 93 %)", "0: 2, 0: 4")
    with pytest.raises(ValueError, match="the page must have lines"):
        tables.with_tables("a", rows)


def test_jobs_that_inform_most_come_first(tmp_path):
    learning = importlib.import_module("benchmarks.learning")
    tasks, others = ("DropCloth", "HitCloth"), (9, 12)
    jobs = learning.jobs(tasks, learning.METHODS, (0, 1), 7, others, None, {}, tmp_path)
    assert len({job.key for job in jobs}) == len(jobs)
    order = [(job.task, job.size, job.method, job.seed) for job in jobs]
    assert order[:2] == [("DropCloth", 7, "zero", 0), ("HitCloth", 7, "zero", 0)]
    milestones = [
        ("HitCloth", 7, "replay", 0),
        ("DropCloth", 7, "imitate", 0),
        ("HitCloth", 7, "ppo", 0),
        ("HitCloth", 12, "transfer", 0),
        ("DropCloth", 7, "script", 1),
        ("HitCloth", 7, "sapo", 1),
        ("DropCloth", 7, "apg", 0),
        ("HitCloth", 7, "plan", 1),
    ]
    assert [order.index(each) for each in milestones] == sorted(map(order.index, milestones))
    budgets = {(job.task, job.seed): job.budget for job in jobs if job.method == "sac"}
    assert budgets == {("HitCloth", 0): 30_000, ("HitCloth", 1): 30_000, ("DropCloth", 0): 10_000}


def test_learning_uses_the_settings_of_the_configurations(tmp_path):
    methods = importlib.import_module("benchmarks.learning_methods")
    assert methods.stage_of("FoldCloth") == {"rounds": 6, "episodes": 48, "iterations": 1000}
    for task in methods.envs.TASKS:
        assert methods.stage_of(task)["rounds"] >= 1
    job = methods.Job("FoldCloth", 4, "apg", 5, 100, 4, {}, tmp_path)
    options, num_envs = methods.trainer_of(job)
    assert (options.plan_knots, options.scale, options.seed, num_envs) == (12, "tensor", 5, 2)
    options, num_envs = methods.trainer_of(dataclasses.replace(job, method="moves"))
    assert (options.action_step, options.horizon, num_envs) == (0.05, 45, 8)
    options, num_envs = methods.trainer_of(dataclasses.replace(job, task="PushCube"))
    assert (options.learning_rate, options.plan_knots, num_envs) == (0.003, 0, 4)
    options, _ = methods.trainer_of(dataclasses.replace(job, method="sapo"))
    assert options.algorithm == "sapo"
    assert options.horizon == 22  # half of an episode


@pytest.mark.slow
def test_learning_counts_its_steps(tmp_path):
    learning = importlib.import_module("benchmarks.learning")

    def row(method, size=4, budget=0, **changed):
        job = learning.Job("HitCloth", size, method, 0, budget, 4, changed, tmp_path)
        return learning.measured(job, 2)

    imitated = row("imitate", rounds=2, episodes=2, iterations=20)
    assert imitated["steps"] == 2 * 2 * 36
    assert imitated["minutes"] > 0
    moved = row("transfer", size=5)
    assert moved["steps"] == 0
    assert row("transfer")["return"] == imitated["return"]  # the same policy
    (tmp_path / "HitCloth-4-0.pt").unlink()
    again = row("transfer", rounds=2, episodes=2, iterations=20)
    assert (again["return"], again["steps"]) == (imitated["return"], imitated["steps"])
    assert row("plan", episodes=1, attempts=1, knots=2, iterations=1)["episodes"] == 1
    assert row("apg", budget=150)["steps"] == 2 * 4 * 36
    assert row("shac", budget=150)["steps"] == 3 * 4 * 18
    assert row("ppo", budget=150)["steps"] == 4 * 64
