"""Pages of the browser: their content, and their display in a browser."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from short_tasks import CONFIGS, DYNAMIC, controls_of

import diffcloth_torch as dc
from diffcloth_torch.cli import main
from diffcloth_torch.cli.optimize import optimize
from diffcloth_torch.cli.run import run
from diffcloth_torch.viewers.browser import Browser
from diffcloth_torch.viewers.fitted import FittedPage, Track
from diffcloth_torch.viewers.layers import colors, strain

pytest.importorskip("viser")

# Warnings of viser itself, which cannot be fixed here.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

WIDTH, HEIGHT = 640, 480
# Part of the image without Chromium's messages and the axes in the corner.
FREE = (slice(180, None), slice(80, None))


@pytest.fixture(scope="module")
def falling():
    """A sheet that falls past a ball, in two environments of different starts."""
    scene = dc.Scene(
        [dc.Cloth.grid(9, 9, size=(0.6, 0.6), pose=[0, 0, 0.35, 1, 0, 0, 0], name="sheet")],
        [dc.RigidBody.sphere(0.15, name="ball")],
    )
    sim = dc.Simulator(scene, 0.02)
    start = sim.initial_state(batch_size=2)
    moved = start.positions + torch.tensor([[[0.0, 0, 0]], [[0, 0, 0.1]]])
    states = sim.rollout(start.replace(positions=moved), steps=12)
    return scene, [start, *states]


def one(states):
    return [state[0] for state in states]


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    """Skip unless Chromium is installed and starts, which some containers do not allow."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    try:
        screenshot("data:text/html,<p>a page", tmp_path_factory.mktemp("chromium") / "page.png", 1)
    except subprocess.SubprocessError as error:
        pytest.skip(f"Chromium cannot start here: {error}")


def screenshot(page, file, seconds):
    """Pixels [height, width, 3] of a page after `seconds` of its own clock."""
    import imageio.v2 as imageio

    subprocess.run(
        [
            CHROMIUM, "--headless=new", "--no-sandbox", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--hide-scrollbars",
            f"--user-data-dir={file.parent}/profile", f"--window-size={WIDTH},{HEIGHT}",
            f"--virtual-time-budget={1000 * seconds}",
            f"--screenshot={file}", page,
        ],
        check=True, capture_output=True, timeout=120,
    )  # fmt: skip
    return np.asarray(imageio.imread(file))[..., :3].astype(int)


def screenshot_of(is_shown, page, file, seconds):
    """Pixels of a served page once `is_shown` accepts them, or of the third screenshot.

    The clock of a page does not wait for data from a server's socket: on a busy machine an image
    may be captured before all data has arrived.
    """
    for _ in range(3):
        image = screenshot(page, file, seconds)
        if is_shown(image):
            break
        seconds *= 2
    return image


def is_blue(image):
    return (image[..., 2] - image[..., 0] > 40) & (image[..., 2] > 120)


def is_sand(image):
    return (image[..., 0] - image[..., 2] > 40) & (image[..., 1] > 120)


def is_orange(image):
    return (image[..., 0] - image[..., 2] > 120) & (image[..., 1] < 130)


def test_strain_is_that_of_a_stretched_sheet():
    cloth = dc.Cloth.grid(5, 7, size=(1.0, 2.0), pose=[0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5])
    turned = cloth.vertices @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert strain([cloth], turned).max() < 1e-12
    # Stretch by a tenth along one side of the sheet, compression by a fifth along the other.
    along = cloth.vertices[6] - cloth.vertices[0]
    along /= np.linalg.norm(along)
    across = cloth.vertices[-7] - cloth.vertices[0]
    across /= np.linalg.norm(across)
    F = np.eye(3) + 0.1 * np.outer(along, along) - 0.2 * np.outer(across, across)
    np.testing.assert_allclose(strain([cloth, cloth], np.tile(cloth.vertices @ F, (2, 1))), 0.2)


def test_colors_go_from_zero_to_the_top():
    found = colors(np.array([[0.0, 1.0], [2.0, 5.0]]), 2.0)
    assert found.shape == (2, 2, 4)
    assert (found[1, 0] == found[1, 1]).all()  # constant beyond the top
    assert found[0, 0, :3].sum() < found[0, 1, :3].sum() < found[1, 0, :3].sum()
    assert (colors(np.zeros(3), 0.0) == found[0, 0]).all()


class TestPages:
    def test_a_page_of_150_frames_of_24_by_24_is_below_3_MB(self, tmp_path):
        ball = dc.RigidBody.sphere(0.2, pose=[0, 0, -1, 1, 0, 0, 0])
        scene = dc.Scene([dc.Cloth.grid(24, 24)], [ball])
        state = dc.Simulator(scene, 0.01).initial_state()
        generator = torch.Generator().manual_seed(0)
        moved, states = torch.zeros_like(state.positions), []
        for k in range(150):  # smooth, but different everywhere
            moved = moved + 1e-3 * torch.randn(3, generator=generator, dtype=torch.float64)
            wave = 0.05 * torch.sin(7 * state.positions + 0.1 * k).roll(1, dims=-1)
            states.append(state.replace(positions=state.positions + moved + wave))
        for color in ("plain", "strain"):
            file = tmp_path / f"{color}.html"
            dc.show(scene, states, file, color=color)
            assert 0.5e6 < file.stat().st_size < 3e6

    def test_a_notebook_gets_the_page(self, falling):
        scene, states = falling
        browser = Browser(scene)
        browser.show(states[0][0])
        assert "&lt;!doctype html&gt;" in browser._repr_html_().lower()[:200]

    def test_a_page_in_a_notebook_comes_without_announcements(self, falling, capsys, monkeypatch):
        import rich

        scene, states = falling
        # As in a notebook, in which rich does not print to standard output.
        printed = []
        monkeypatch.setattr(rich.get_console(), "is_jupyter", True, raising=False)
        monkeypatch.setattr("rich.jupyter.display", lambda *a: printed.append(a))
        browser = Browser(scene)
        browser.show(states[0][0])
        browser._repr_html_()
        assert printed == []
        assert capsys.readouterr().out == ""
        assert not rich.get_console().quiet

    def test_a_shown_state_does_not_change_with_its_tensors(self, falling):
        scene, states = falling
        browser = Browser(scene)
        state = states[0].replace(positions=states[0].positions.clone())
        browser.show(state)
        before = browser.motion[0].positions.copy()
        state.positions.zero_()
        np.testing.assert_array_equal(browser.motion[0].positions, before)

    def test_a_slider_ends_at_the_last_moment(self, falling):
        scene, states = falling
        browser = Browser(scene, port=8472)
        browser.show(states[0][0])
        assert browser.url  # the server begins, with the first moment
        try:
            for state in one(states[1:4]):
                browser.show(state)
            assert browser._moment.max == len(browser.motion) - 1 == 3
        finally:
            browser.close()

    def test_forces_end_and_gradients_begin_at_their_points(self, falling):
        scene, states = falling
        state = states[-1][0]
        generator = torch.Generator().manual_seed(0)
        gradient = torch.randn(state.positions.shape, generator=generator, dtype=torch.float64)
        browser = Browser(scene, port=8473, arrows=["forces", "gradient"])
        browser.show(state, gradient)
        assert browser.url
        try:
            arrows = {what: a.points for (_, what), a in browser._drawing._arrows.items()}
        finally:
            browser.close()
        cloth, ball = state.positions.numpy(), scene.bodies[0].vertices
        contact = np.concatenate([state.contact_forces.numpy(), state.body_forces.numpy()])
        for what, places, vectors, end in (
            ("forces", np.concatenate([cloth, ball]), contact, 1),
            ("gradient", cloth, gradient.numpy(), 0),
        ):
            lengths = np.linalg.norm(vectors, axis=1)
            seen = lengths > 0.01 * lengths.max()
            # Points of a page are of single precision.
            np.testing.assert_allclose(arrows[what][:, end], places[seen], atol=1e-6)
            along = arrows[what][:, 1] - arrows[what][:, 0]
            ratios = np.linalg.norm(along, axis=1) / lengths[seen]
            np.testing.assert_allclose(along, vectors[seen] * ratios.mean(), atol=1e-5)

    @pytest.mark.slow
    def test_a_page_of_its_own_plays(self, falling, chromium, tmp_path):
        scene, states = falling
        page = tmp_path / "falling.html"
        dc.show(scene, one(states), page)
        early = screenshot(page.as_uri(), tmp_path / "early.png", 3)
        late = screenshot(page.as_uri(), tmp_path / "late.png", 12)
        for image in (early, late):
            assert is_blue(image).sum() > 3000  # the sheet
        # Without the page's bar at the bottom, which always moves.
        assert (np.abs(early - late)[: HEIGHT // 2] > 60).any(axis=-1).sum() > 1000

    @pytest.mark.slow
    def test_several_environments_stand_side_by_side_in_color(self, falling, chromium, tmp_path):
        scene, states = falling
        page = tmp_path / "strain.html"
        camera = dc.Camera(azimuth=0, elevation=60)
        dc.show(scene, states, page, color="strain", arrows=["forces"], camera=camera)
        image = screenshot(page.as_uri(), tmp_path / "strain.png", 3)
        purple = (image[..., 0] > image[..., 1] + 20) & (image[..., 2] > image[..., 1] + 40)
        columns = np.flatnonzero(purple.any(axis=0))
        assert purple.sum() > 2000
        assert np.diff(columns).max() > 5  # two sheets, with a gap between them

    @pytest.mark.slow
    def test_a_server_shows_states_while_they_come(self, falling, chromium, tmp_path):
        scene, states = falling
        browser = Browser(scene, port=8471)
        browser.show(states[0][0])
        try:
            assert browser.url.startswith("http://127.0.0.1:")
            for state in one(states[1:]):
                browser.show(state)

            def has_sheet(image):
                # The page plays by the clock: beside other work the sheet is seen from its edge.
                return is_blue(image).sum() > 1500

            assert has_sheet(screenshot_of(has_sheet, browser.url, tmp_path / "served.png", 5))
            browser.close()
            # Opens another page.
            assert has_sheet(screenshot_of(has_sheet, browser.url, tmp_path / "again.png", 5))
        finally:
            browser.close()


def test_a_configuration_writes_its_page(tmp_path):
    config = tmp_path / "sheet.yaml"
    config.write_text(
        "task: drape\nsimulation: {dt: 0.01, steps: 3}\n"
        "scene: {cloths: [{name: sheet, shape: {kind: grid, rows: 4, columns: 4}}]}\n"
    )
    run(config, ["output.viewers=[web]"], tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["animation.html", "metrics.json"]


def test_an_optimization_shows_the_gradient_of_its_loss(tmp_path, monkeypatch):
    """By differences: displace a vertex after a step, continue, and compare losses."""
    task = DYNAMIC.load("simulation.solver.tolerance=1e-9")
    shown = []
    monkeypatch.setattr(Browser, "show", lambda _, *given: shown.append(given))
    monkeypatch.setattr(Browser, "__exit__", lambda *_: None)
    changes = [
        *DYNAMIC.assignments,
        "simulation.solver.tolerance=1e-9",
        "optimizer.iterations=1",
        "output={viewers: [web], every: 1}",
    ]
    optimize(CONFIGS / DYNAMIC.config, changes, tmp_path / "out")
    (_, none), *rest = shown
    assert none is None
    assert len(rest) == task.steps
    k, vertex = 2, 12
    state, gradient = rest[k]
    controls = controls_of(task, {n: a.detach() for n, a in task.actions().items()})[k + 1 :]
    moved = torch.zeros_like(state.positions)
    moved[vertex, 1] = 1e-5
    losses = []
    for sign in (1, -1):
        begin = state.replace(positions=state.positions + sign * moved)
        states = [s for s, _ in rest[: k + 1]]
        with torch.no_grad():
            states += task.simulator.rollout(begin, controls)
            losses.append(task.loss(states).item())
    difference = (losses[0] - losses[1]) / 2e-5
    assert abs(difference) > 1e-5
    # The solver's tolerance, over the step of the difference.
    assert gradient[vertex, 1].item() == pytest.approx(difference, rel=1e-3)


def test_the_command_line_chooses_viewers(tmp_path):
    config = tmp_path / "sheet.yaml"
    config.write_text(
        "task: drape\nsimulation: {dt: 0.01, steps: 2}\n"
        "scene: {cloths: [{name: sheet, shape: {kind: grid, rows: 3, columns: 3}}]}\n"
    )
    command = [sys.executable, "-m", "diffcloth_torch", "run", config, "--out", tmp_path / "out"]
    subprocess.run(
        [*command, "--viewer", "web", "--viewer", "meshes"], check=True, capture_output=True
    )
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["animation.html", "meshes", "metrics.json"]


FIT = """
task: identify
simulation: {dt: 0.02, steps: 4}
scene:
  cloths:
    - name: sheet
      shape: {kind: grid, rows: 3, columns: 3, size: 0.2}
      pose: {axis: [1, 0, 0], degrees: 90}
      material: {stretch: 10, density: 0.3}
      pins: {top: {box: {lower: [-1, -1, 0.09], upper: [1, 1, 0.11]}}}
fit:
  variables: {stretch: {value: 4}}
  trajectories:
    - {name: rest, equilibrium: true, noise: 1e-3, synthetic: {values: {stretch: 10}}}
    - {name: fall, steps: [2, 4], noise: 1e-3, synthetic: {values: {stretch: 10}}}
"""


class TestFits:
    @pytest.mark.slow
    def test_a_fit_writes_the_page_of_its_best_values(self, chromium, tmp_path, monkeypatch):
        config, out = tmp_path / "hang.yaml", tmp_path / "out"
        config.write_text(FIT)
        shown = []
        show = FittedPage.show
        monkeypatch.setattr(
            FittedPage, "show", lambda page, *given: [shown.append(given), show(page, *given)]
        )
        result = CliRunner().invoke(
            main, ["fit", str(config), "--out", str(out), "--viewer", "web"]
        )
        assert result.exit_code == 0, result.output
        found = json.loads((out / "fit.json").read_text())
        costs = [trial["cost"] for trial in found["history"]]
        assert len(shown) == sum(
            cost < min(costs[:k], default=np.inf) for k, cost in enumerate(costs)
        )
        # The last display has the residuals at the fitted values.
        tracks, text = shown[-1]
        off = [
            state.positions.numpy() - seen
            for track in tracks
            for state, seen in zip(track.states, track.observed, strict=True)
        ]
        assert [len(track.states) for track in tracks] == [1, 2]
        assert 0.5 * sum(((x / 1e-3) ** 2).sum() for x in off) == pytest.approx(found["cost"])
        assert f"stretch: {found['values']['stretch']:.4g}" in text
        image = screenshot((out / "animation.html").as_uri(), tmp_path / "fit.png", 3)
        assert is_blue(image).sum() + is_sand(image).sum() > 3000  # two sheets, of either side
        assert is_orange(image[FREE]).sum() > 50  # nine points on each

    @pytest.mark.slow
    def test_a_page_follows_a_fit(self, falling, chromium, tmp_path):
        """The page's points are the observed points, and follow the next observation."""
        scene, states = falling
        still = states[0][0]
        page = FittedPage([scene], port=8481, camera=dc.Camera(azimuth=0, elevation=40))
        below = np.array([0.0, 0.0, 0.3])
        seen = still.positions.numpy() - below
        seen[:40] = np.nan  # not seen

        def has_points(image):
            return is_orange(image[FREE]).any(axis=1).sum() > 5

        try:
            page.show([Track([still], [seen])], "first")
            before = screenshot_of(has_points, page.url, tmp_path / "before.png", 4)
            page.show([Track([still], [seen - below])], "second")
            after = screenshot_of(has_points, page.url, tmp_path / "after.png", 4)
        finally:
            page.close()
        assert has_points(before)
        assert has_points(after)
        rows = [np.flatnonzero(is_orange(im[FREE]).any(axis=1)) for im in (before, after)]
        assert rows[1].mean() > rows[0].mean() + 20
        assert [len(points) for points in page.points[0]] == [41]
        assert is_blue(after).sum() > 1500

    def test_an_outline_is_a_closed_line_below_the_cloth(self, falling):
        _, states = falling
        state = states[0][0]
        square = np.array([[0.2, 0.2], [-0.2, 0.2], [-0.2, -0.2], [0.2, -0.2]])
        (points,) = Track([state], [square]).points()
        assert points[:, 2] == pytest.approx(float(state.positions[:, 2].min()))
        assert np.abs(points[:, :2]).max(axis=1) == pytest.approx(0.2)
        steps = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
        assert steps == pytest.approx(0.4 / 8)

    def test_trajectories_must_be_those_of_the_scenes(self, falling):
        scene, _ = falling
        with pytest.raises(dc.InvalidInput, match="one for each of 1 scenes, got 0"):
            FittedPage([scene]).show([])

    def test_a_resumed_fit_refuses_another_viewer(self, tmp_path):
        result = CliRunner().invoke(main, ["fit", "--resume", str(tmp_path), "--viewer", "web"])
        assert result.exit_code == 2
        assert "--set or --viewer" in result.output


class TestRefused:
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"color": "red"}, "`color` must be one of plain, strain, contact, got 'red'"),
            ({"arrows": ["wind"]}, "`arrows` must be of forces, gradient, got 'wind'"),
            ({"arrows": ["gradient"]}, "'gradient', which needs `gradients`"),
            ({"gradients": []}, "one for each of 13 states, got 0"),
            ({"path": "page.htm"}, "must end in .html"),
            ({"path": "nowhere/page.html"}, "in an existing folder"),
        ],
    )
    def test_bad_arguments_are_refused(self, falling, arguments, message, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        scene, states = falling
        with pytest.raises(dc.InvalidInput, match=message):
            dc.show(scene, states, **{"path": "page.html", **arguments})
        assert not list(tmp_path.iterdir())

    def test_gradients_of_another_shape_are_refused(self, falling, tmp_path):
        scene, states = falling
        with pytest.raises(dc.InvalidInput, match=r"`gradients`\[0\] must have shape \[2, 81, 3\]"):
            dc.show(scene, states[:1], tmp_path / "p.html", gradients=[torch.zeros(81, 3)])

    def test_states_of_another_scene_or_batch_are_refused(self, falling, tmp_path):
        scene, states = falling
        other = dc.Scene([dc.Cloth.grid(4, 4)])
        with pytest.raises(dc.InvalidInput, match=r"show: states\[0\] must be of this scene"):
            dc.show(other, states, tmp_path / "p.html")
        with pytest.raises(dc.InvalidInput, match=r"states\[1\] must be a batch of 2"):
            dc.show(scene, [states[0], states[1][0]], tmp_path / "p.html")
