"""The optimization loop: its optimizers, its failures, environments of a batch, going on."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch

import diffcloth_torch as dc
from diffcloth_torch.optimize.descent import TrialError

F64 = torch.float64
SGD = partial(torch.optim.SGD, lr=0.25)
ADAM = partial(torch.optim.Adam, lr=0.1)


def leaf(*values):
    return torch.tensor(values, dtype=F64, requires_grad=True)


def state_of(values, statuses=None):
    """A state with the environments' values as positions [B, 1, 1]; some environments failed."""
    batch = len(values)
    statuses = statuses or ["converged"] * batch
    numbers = torch.zeros(batch)
    report = dc.Report(
        converged=torch.tensor([status == "converged" for status in statuses]),
        iterations=numbers.long(),
        residual=numbers,
        minimum_distance=numbers + math.inf,
        contact_count=numbers.long(),
        motion_fraction=numbers + 1,
        seconds={"all": numbers},
        status=tuple(statuses),
    )
    none = torch.zeros(batch, 0, 7, dtype=F64)
    positions = values.reshape(batch, 1, 1)
    return dc.State(positions, positions, none, none, none, numbers, report)


def bowl(reach=math.inf, name="a"):
    """Simulation that returns a variable's values as state; values beyond `reach` fail."""

    def simulate(variables):
        values = variables[name]
        far = (values.detach().abs() > reach).tolist()
        statuses = ["not_converged" if is_far else "converged" for is_far in far]
        return [state_of(values, statuses)]

    return simulate


def squares(states):
    return states[-1].positions.square().sum(dim=(1, 2))


def total(states):
    return squares(states).sum()


# --- optimizers -----------------------------------------------------------------------------------


OPTIMIZERS = [
    pytest.param(partial(torch.optim.SGD, lr=0.1, momentum=0.9, nesterov=True), id="sgd"),
    pytest.param(ADAM, id="adam"),
    pytest.param(partial(torch.optim.RMSprop, lr=0.1, momentum=0.5), id="rmsprop"),
    pytest.param(partial(torch.optim.Adagrad, lr=0.1), id="adagrad"),
]


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_the_loop_is_that_of_the_optimizer(make):
    """The bits equal a plain loop of the optimizer."""
    a = leaf(1.0, -2.0)
    found = dc.descend(bowl(), total, {"a": a}, make, iterations=5)
    b = leaf(1.0, -2.0)
    optimizer, losses = make([b]), []
    for _ in range(5):
        optimizer.zero_grad()
        loss = total(bowl()({"a": b}))
        losses.append(loss.item())
        loss.backward()
        optimizer.step()
    assert found.metrics()["losses"] == losses
    assert torch.equal(a, b)
    assert torch.equal(found.next_variables["a"], b)
    assert found.best.loss == min(losses)


def test_an_optimizer_with_groups_of_its_own_is_taken():
    a, b = leaf(1.0), leaf(1.0)
    optimizer = torch.optim.SGD([{"params": [a], "lr": 0.5}, {"params": [b], "lr": 0.25}], lr=1.0)
    simulate = lambda v: [state_of(torch.cat([v["a"], v["b"]]))]  # noqa: E731
    dc.descend(simulate, total, {"a": a, "b": b}, optimizer, iterations=1)
    assert (a.item(), b.item()) == (0.0, 0.5)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"variables": {}}, dc.InvalidInput, "`variables` must have at least one entry"),
        ({"variables": {"a": [1.0]}}, TypeError, r"`variables\['a'\]` must be a tensor of floats"),
        ({"variables": {"a": torch.ones(1)}}, dc.InvalidInput, "leaf that requires a gradient"),
        ({"optimizer": lambda _: 3}, TypeError, "`optimizer` must be an optimizer of torch"),
        ({"optimizer": torch.optim.LBFGS}, dc.InvalidInput, "which LBFGS does not"),
        ({"optimizer": SGD([leaf(1.0)])}, dc.InvalidInput, "must hold just the variables a"),
        ({"iterations": 0}, dc.InvalidInput, "`iterations` must be"),
        ({"clip": -1.0}, dc.InvalidInput, "`clip` must be"),
        ({"per_environment": "a"}, TypeError, "a list of names, got a str"),
        ({"per_environment": ["b"]}, dc.InvalidInput, "`per_environment` may name a; got 'b'"),
        ({"per_environment": ["a"]}, dc.InvalidInput, r"must have shape \[B\]"),
        (
            {"variables": {"a": leaf(1.0), "b": leaf(2.0)}},
            dc.InvalidInput,
            "does not depend on the variable 'b'",
        ),
        ({"loss": lambda _: torch.ones(2)}, dc.InvalidInput, r"shape \[\] or \[1\], got \[2\]"),
        ({"loss": lambda s: total(s) / 0}, dc.SimulationError, "the loss is inf: a gradient"),
    ],
)
def test_bad_arguments_are_refused(arguments, error, message):
    accepted = {
        "simulate": bowl(),
        "loss": total,
        "variables": {"a": leaf(1.0)},
        "optimizer": SGD,
        "iterations": 1,
    }
    with pytest.raises(error, match=message):
        dc.descend(**{**accepted, **arguments})


# --- failures -------------------------------------------------------------------------------------


def test_a_failed_status_fails_the_attempt_where_the_loss_is_one_number():
    # The first step leads from 1 to -9; -4 fails as well, -1.5 succeeds (also in tests/tasks).
    far = partial(torch.optim.SGD, lr=5.0)
    found = dc.descend(bowl(reach=2.0), total, {"a": leaf(1.0)}, far, iterations=2)
    assert found.metrics()["losses"] == [1.0, 1.5**2]
    assert [failure["iteration"] for failure in found.failures] == [1, 1]
    assert "NotConverged" in found.failures[0]["error"]
    assert r"environments [0] failed" in found.failures[0]["error"]


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_the_state_of_an_optimizer_is_dropped_after_a_failed_attempt(make):
    """From the point half way back, the loop continues as a loop that starts there."""
    seen = []
    fails = iter([False, False, True, False, False])

    def simulate(variables):
        seen.append(variables["a"].item())
        return [state_of(variables["a"], ["not_converged" if next(fails) else "converged"])]

    dc.descend(simulate, total, {"a": leaf(1.0)}, make, iterations=4)
    again = leaf((seen[2] + seen[1]) / 2)  # the second was the best
    assert seen[1] < seen[0]
    assert seen[3] == again.item()
    dc.descend(bowl(), total, {"a": again}, make, iterations=1)
    assert seen[4] == again.item()


def test_a_failure_at_the_start_is_raised():
    with pytest.raises(dc.NotConverged, match="status 'not_converged'") as caught:
        dc.descend(bowl(reach=2.0), total, {"a": leaf(1.0, 3.0)}, SGD, iterations=1)
    assert caught.value.environments == (1,)


def test_failed_environments_are_left_out_of_a_loss_for_each():
    """A shared variable follows the mean over the remaining environments."""
    shift = leaf(0.5)
    starts = torch.tensor([0.0, 1.0, 9.0], dtype=F64)
    simulate = bowl(reach=5.0, name="values")
    found = dc.descend(
        lambda v: simulate({"values": starts + v["shift"]}),
        squares,
        {"shift": shift},
        SGD,
        iterations=1,
    )
    assert found.best.environment_losses == [0.25, 2.25, None]
    assert found.best.failed_environments == [2]
    assert found.best.loss == 1.25
    assert shift.item() == 0.5 - 0.25 * (1.0 + 3.0) / 2
    assert found.failures == [
        {"iteration": 0, "error": "environments [2] failed and were left out of the loss"}
    ]


def test_a_smaller_loss_of_fewer_environments_is_not_better():
    # From the second evaluation on the third environment fails; the others' mean is smaller.
    starts = torch.tensor([0.0, 1.0, 9.0], dtype=F64)
    reaches = iter([99.0, 5.0, 5.0])

    def simulate(variables):
        return bowl(next(reaches), "values")({"values": starts + variables["shift"]})

    found = dc.descend(simulate, squares, {"shift": leaf(0.0)}, SGD, iterations=3)
    losses = found.metrics()["losses"]
    assert losses[1] < losses[0]
    assert found.best.loss == losses[0]


def test_an_attempt_of_which_no_environment_is_left_goes_back():
    far = partial(torch.optim.SGD, lr=5.0)
    found = dc.descend(bowl(reach=2.0), squares, {"a": leaf(1.0, 1.0)}, far, iterations=2)
    # Each of the two gets half of the mean's gradient: 1 - 5 = -4, then -1.5.
    assert found.metrics()["losses"] == [1.0, 1.5**2]


# --- Independent environments ---------------------------------------------------------------------


@pytest.mark.parametrize("make", OPTIMIZERS)
@pytest.mark.parametrize("options", [{}, {"clip": 0.7, "restart": True}])
def test_environments_descend_independently(make, options):
    """Clipping, restarts and losses of an environment are independent of the others."""
    starts = [1.0, -2.0, 0.1]
    together = leaf(*starts)
    options = {"iterations": 8, "per_environment": ["a"], **options}
    found = dc.descend(bowl(), squares, {"a": together}, make, **options)
    for i, start in enumerate(starts):
        alone = leaf(start)
        own = dc.descend(bowl(), squares, {"a": alone}, make, **options)
        assert torch.equal(alone[0], together[i])
        assert own.best_losses[0] == found.best_losses[i]


@pytest.mark.parametrize("make", OPTIMIZERS)
def test_a_row_is_clipped_as_a_tensor_of_its_own(make):
    rows, alone = leaf(1.0, -0.1), leaf(1.0)
    options = {"iterations": 4, "clip": 0.5}
    dc.descend(bowl(), squares, {"a": rows}, make, per_environment=["a"], **options)
    dc.descend(bowl(), squares, {"a": alone}, make, **options)
    assert torch.equal(rows[0], alone[0])


def test_an_environment_that_failed_goes_back_half_way_and_the_others_go_on():
    far = partial(torch.optim.SGD, lr=1.2, momentum=0.9)
    both, good = leaf(0.1, 1.9), leaf(0.1)
    options = {"iterations": 4, "per_environment": ["a"]}
    seen = []

    def simulate(variables):
        seen.append(variables["a"].detach().clone())
        return bowl(reach=2.0)(variables)

    found = dc.descend(simulate, squares, {"a": both}, far, **options)
    dc.descend(bowl(reach=2.0), squares, {"a": good}, far, **options)
    assert torch.equal(both[0], good[0])
    # 1.9 - 1.2 * 3.8 = -2.66 fails; half way to 1.9 is -0.38, a restart without momentum.
    rows = [values[1].item() for values in seen]
    assert rows[1] == pytest.approx(-2.66)
    assert rows[2] == pytest.approx(-0.38)
    assert rows[3] == pytest.approx(-0.38 + 1.2 * 0.76)
    assert [record["environment_losses"][1] is None for record in found.history] == [
        *(False, True, False, False)
    ]


def test_the_best_rows_are_those_of_the_smallest_losses():
    """The steps are too long for the last environment, whose loss rises."""
    rates = torch.tensor([0.9, 1.6, 2.3], dtype=F64)
    x = leaf(0.0, 0.0, 0.0)
    seen = []

    def loss(states):
        losses = 0.5 * rates * (x - 1.0) ** 2
        seen.append((x.detach().clone(), losses.detach()))
        return losses

    found = dc.descend(
        lambda variables: [state_of(variables["a"])],
        loss,
        {"a": x},
        partial(torch.optim.SGD, lr=1.0),
        iterations=6,
        per_environment=["a"],
    )
    losses = torch.stack([values for _, values in seen])
    best = losses.argmin(dim=0).tolist()
    assert best == [5, 5, 0]
    assert torch.equal(found.best_losses, losses.amin(dim=0))
    assert found.best_rows["a"].tolist() == [float(seen[k][0][i]) for i, k in enumerate(best)]


def test_an_environment_that_fails_too_often_ends_the_loop():
    calls = iter([99.0, 0.0, 0.0, 0.0, 0.0])

    def simulate(variables):
        reach = next(calls)
        statuses = ["converged", "not_converged" if reach == 0.0 else "converged"]
        return [state_of(variables["a"], statuses)]

    options = {"iterations": 9, "per_environment": ["a"], "failures": 2}
    with pytest.raises(dc.SimulationError, match=r"environment \[1\] failed in 3 evaluations"):
        dc.descend(simulate, squares, {"a": leaf(1.0, 1.0)}, SGD, **options)


def test_rows_must_be_those_of_the_environments():
    simulate = lambda v: [state_of(v["a"].repeat(2))]  # noqa: E731
    with pytest.raises(dc.InvalidInput, match="must have 2 rows, one for each environment, got 1"):
        dc.descend(simulate, squares, {"a": leaf(1.0)}, SGD, iterations=1, per_environment=["a"])


# --- going on -------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", OPTIMIZERS)
@pytest.mark.parametrize("per_environment", [[], ["a"]])
def test_a_loop_goes_on_with_the_same_bits(make, per_environment, tmp_path):
    """A resumed loop restores the optimizer, random numbers and records of each environment."""

    def run(variables, iterations, **options):
        def simulate(v):
            noise, luck = torch.rand(2, 2, dtype=F64, generator=options["generator"])
            statuses = ["not_converged" if each < 0.4 else "converged" for each in luck.tolist()]
            return [state_of(v["a"] + 0.3 * noise, statuses)]

        return dc.descend(
            simulate,
            squares,
            variables,
            make,
            iterations=iterations,
            per_environment=per_environment,
            restart=True,
            failures=50,
            **options,
        )

    generator = torch.Generator().manual_seed(7)
    whole = run({"a": leaf(0.9, -0.8)}, 9, generator=generator)
    half = run({"a": leaf(0.9, -0.8)}, 4, generator=torch.Generator().manual_seed(7))
    torch.save(half.record(), tmp_path / "half.pt")
    found = dc.Descent.restore(torch.load(tmp_path / "half.pt", weights_only=True))
    again = run({"a": leaf(0.0, 0.0)}, 9, generator=torch.Generator(), resume=found)
    assert whole.failures, "the test should go through failures"
    assert again.failures == whole.failures
    assert again.metrics()["losses"] == whole.metrics()["losses"]
    assert torch.equal(again.next_variables["a"], whole.next_variables["a"])
    assert torch.equal(again.best_losses, whole.best_losses)
    assert len(found.history) == 4


def test_random_numbers_of_torch_are_resumed():
    def run(iterations, found=None):
        simulate = lambda v: [state_of(v["a"] + torch.randn(1, dtype=F64))]  # noqa: E731
        return dc.descend(
            simulate, total, {"a": leaf(1.0)}, ADAM, iterations=iterations, resume=found
        )

    torch.manual_seed(3)
    whole = run(6)
    torch.manual_seed(3)
    half = run(2)
    torch.manual_seed(99)
    assert torch.equal(run(6, half).next_variables["a"], whole.next_variables["a"])


@pytest.mark.parametrize("per_environment", [[], ["a"]])
def test_the_loop_itself_draws_no_random_numbers(per_environment):
    calls = []

    def simulate(v):
        calls.append(v)
        if len(calls) == 2:
            raise TrialError("a failure that the loop undoes")
        status = "not_converged" if len(calls) == 4 else "converged"
        return [state_of(v["a"], ["converged", status])]

    before = torch.random.get_rng_state()
    found = dc.descend(
        simulate, squares, {"a": leaf(0.9, -0.8)}, ADAM,
        iterations=4, restart=True, per_environment=per_environment,
    )  # fmt: skip
    assert len(found.failures) == 2
    assert torch.equal(torch.random.get_rng_state(), before)


def test_keywords_of_0_1_warn_with_the_names_of_today():
    reports = []
    options = {"iterations": 1, "optimizer": ADAM}
    with pytest.warns(FutureWarning, match="descend: `report` is named `progress`") as caught:
        found = dc.descend(bowl(), total, {"a": leaf(1.0)}, report=reports.append, **options)
    assert caught[0].filename == __file__
    assert len(reports) == 1
    options["iterations"] = 2
    with pytest.warns(FutureWarning, match="descend: `found` is named `resume` since 0.2.0"):
        again = dc.descend(bowl(), total, {"a": leaf(5.0)}, found=found, **options)
    assert again.history[0] == found.history[0]
    with pytest.raises(TypeError, match="`found` is `resume`, which is given, too"):
        dc.descend(bowl(), total, {"a": leaf(1.0)}, found=found, resume=found, **options)


def test_reported_results_do_not_change_afterwards():
    reports = []
    dc.descend(bowl(), total, {"a": leaf(1.0)}, ADAM, iterations=3, progress=reports.append)
    assert [len(found.history) for found in reports] == [1, 2, 3]
    steps = [found.optimizer["state"][0]["step"].item() for found in reports]
    assert steps == [1, 2, 3]


# --- with a simulator -----------------------------------------------------------------------------


def hanging(**options):
    cloth = dc.Cloth.grid(3, 3, 0.2, pins={"corners": [0, 2]})
    return dc.Simulator(dc.Scene([cloth]), 0.01, **options)


def test_parameters_starts_and_weights_are_found():
    """Inputs of a rollout are recovered from its end: all leaves of a graph are equivalent."""
    simulator = hanging()
    network = torch.nn.Linear(3, 3, dtype=F64)
    truth = {"log_stretch": math.log(60.0), "lift": 0.4}

    def simulate(v):
        start = simulator.initial_state()
        velocities = start.velocities + v["lift"] * torch.tensor([0.0, 0.0, 1.0], dtype=F64)
        parameters = dc.Parameters(stretch=v["log_stretch"].exp())

        def controller(_, state):
            return dc.Control(forces=1e-3 * network(state.positions))

        start = start.replace(velocities=velocities)
        return simulator.rollout(start, controller, parameters, steps=5)

    with torch.no_grad():
        network.weight.zero_(), network.bias.zero_()
        wanted = simulate({name: torch.tensor(value, dtype=F64) for name, value in truth.items()})
    variables = {
        "log_stretch": torch.tensor(math.log(30.0), dtype=F64, requires_grad=True),
        "lift": torch.tensor(0.0, dtype=F64, requires_grad=True),
        **dict(network.named_parameters()),
    }

    def loss(states):
        pairs = zip(states, wanted, strict=True)
        return (
            1e4 * torch.stack([(a.positions - b.positions).square().mean() for a, b in pairs]).sum()
        )

    found = dc.descend(simulate, loss, variables, ADAM, iterations=25)
    assert found.best.loss < 0.05 * found.first.loss
    assert found.metrics()["steps"] == 25 * 5
    assert abs(found.best.variables["lift"].item() - truth["lift"]) < 0.1


def test_a_batch_of_a_simulator_whose_environments_fail():
    """One of three environments pushes its pins into a floor, goes back and has no gradient."""
    cloth = dc.Cloth.grid(3, 3, 0.2, pins={"all": range(9)}, pose=[0, 0, 0.1, 1, 0, 0, 0])
    scene = dc.Scene([cloth], [dc.RigidBody.plane(2.0)])
    simulator = dc.Simulator(scene, 0.01, solver=dc.SolverOptions(throw=False))
    start = simulator.initial_state(3)
    down = torch.tensor([0.02, 0.05, 0.05], dtype=F64, requires_grad=True)
    goals = torch.tensor([0.07, 0.06, -0.2], dtype=F64)  # the last is below the floor

    def simulate(v):
        fall = v["down"][:, None, None] * torch.tensor([0.0, 0.0, 1.0], dtype=F64)
        return simulator.rollout(start, [dc.Control(pins=start.positions - fall)])

    def loss(states):
        return (states[-1].positions[:, :, 2].mean(dim=1) - goals).square()

    found = dc.descend(
        simulate,
        loss,
        {"down": down},
        partial(torch.optim.SGD, lr=0.3),
        iterations=12,
        per_environment=["down"],
        failures=12,
    )
    assert any(record["environment_losses"][2] is None for record in found.history)
    assert all(record["environment_losses"][:2] != [None, None] for record in found.history)
    assert found.best_losses[:2].max() < 1e-6
    assert 0.05 < found.best_rows["down"][2] < 0.1  # the lowest feasible position
