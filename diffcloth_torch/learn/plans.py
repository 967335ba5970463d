"""Plans: actions of whole episodes, optimized by gradients, one plan for each of several starts.

A plan is the tanh of a sum of hat functions of the time. Starts do not depend on each other: a
piece of work comprises the plans of some starts, and its results have the same bits in every
process.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from pathlib import Path

import torch
from torch import Tensor

from diffcloth_torch import cpu
from diffcloth_torch.checkpoint import (
    check_like,
    read_checkpoint,
    refusing_damage,
    write_checkpoint,
)
from diffcloth_torch.checks import check_count
from diffcloth_torch.envs.env import EnvState, add_steps, steps_made
from diffcloth_torch.envs.gym import ClothVectorEnv
from diffcloth_torch.errors import InvalidInput, SimulationError
from diffcloth_torch.files import as_path
from diffcloth_torch.learn.rollouts import LAST_WEIGHT, MakeEnv, threads_of_torch, unit_gradients
from diffcloth_torch.learn.starts import LARGEST_SEED, part_seeds
from diffcloth_torch.learn.workers import Workers, check_workers, pickled
from diffcloth_torch.memory import check_memory
from diffcloth_torch.operations import called

__all__ = ["Improved", "Plans", "improve", "knots_of", "plan"]

_CHECKPOINT = "plans"  # kind of the files of `Plans.save`
_TOGETHER, _REPLAYED = 2, 8  # plans of a piece of improvements, and of replays
_BETAS = (0.9, 0.95)  # decay rates of Adam
_RATE, _LAST_SHARE = 0.1, 0.1  # initial learning rate of Adam, and its final share
_NOISE = 0.2  # standard deviation of the noise of initial knots, common and of each
_DRAWS = 16  # initial knots of an attempt, of which the best are improved
_ROUNDS = 3  # largest number of repeated searches of starts without success
_NEIGHBORS = 3  # starts whose plans are tried from another start
_RIDGE = 0.1  # penalty of the linear function, relative to the mean square of its observations
_LEAST = 1e-6  # observations with a smaller deviation are constant
_LARGEST_KNOT = 0.995  # first actions are clipped to this before atanh
_SHARE = 3  # divides iterations and rate of plans that begin from good ones
_LARGEST_COUNT = 10**6


@dataclass(frozen=True, eq=False)
class Plans:
    """Plans for E starts of a task.

    Attributes:
        actions: Actions of all T transitions of an episode, in the frame of the task, float64
            [E, T, A].
        returns: Sums of the rewards of the plans, float64 [E].
        success: True if the plan succeeds [E].
        seeds: Seeds of the starts, int64 [E]: `env.reset(seed=plans.seeds.tolist())` begins there.
    """

    actions: Tensor
    returns: Tensor
    success: Tensor
    seeds: Tensor

    def __post_init__(self) -> None:
        kinds = (torch.float64, torch.float64, torch.bool, torch.int64)
        for field, kind in zip(fields(self), kinds, strict=True):
            value = getattr(self, field.name)
            axes = "[E, T, A]" if field.name == "actions" else "[E]"
            if not isinstance(value, Tensor):
                raise TypeError(
                    f"Plans: `{field.name}` must be a tensor {axes}, got {type(value).__name__}"
                )
            rank = 3 if field.name == "actions" else 1
            if value.dtype != kind or value.dim() != rank or not value.is_cpu:
                raise InvalidInput(
                    f"Plans: `{field.name}` must be a tensor {axes} of {kind} on the CPU, got "
                    f"{value.dtype} {list(value.shape)} on {value.device}"
                )
            if not len(value) or len(value) != len(self.actions):
                raise InvalidInput(
                    f"Plans: `{field.name}` must be of {max(len(self.actions), 1)} starts, got "
                    f"{len(value)}"
                )
        if not bool((self.actions.abs() <= 1).all()):
            raise InvalidInput("Plans: `actions` must be between -1 and 1")
        if not bool(torch.isfinite(self.returns).all()):
            raise InvalidInput("Plans: `returns` must be finite")
        if not bool(((self.seeds >= 0) & (self.seeds <= LARGEST_SEED)).all()):
            raise InvalidInput(f"Plans: `seeds` must be between 0 and {LARGEST_SEED}")

    def __len__(self) -> int:
        """Return E, the number of starts."""
        return len(self.actions)

    def save(self, path: str | Path) -> None:
        """Write the plans to a file, which replaces an older one completely or not at all.

        Raises:
            InvalidInput: If the folder of the file does not exist.
            OSError: If the file cannot be written; an older one remains unchanged.
        """
        path = as_path("Plans.save: `path`", path)
        if not path.parent.is_dir():
            raise InvalidInput(f"Plans.save: the folder of `path` must exist, got {str(path)!r}")
        content = {field.name: getattr(self, field.name).clone() for field in fields(self)}
        write_checkpoint(path, _CHECKPOINT, content)

    @classmethod
    def load(cls, path: str | Path) -> Plans:
        """Read a file of `save`.

        Raises:
            InvalidInput: If `path` is no such file, or is damaged.
        """
        path = as_path("Plans.load: `path`", path)
        if not path.is_file():
            raise InvalidInput(f"Plans.load: `path` must be a file, got {str(path)!r}")
        kept = read_checkpoint("Plans.load", path, _CHECKPOINT)
        with refusing_damage("Plans.load", path):
            check_like("the content", dict.fromkeys(kept, ""), {f.name: "" for f in fields(cls)})
            return cls(**kept)


@called("plan")
def plan(
    make: MakeEnv,
    episodes: int = 8,
    attempts: int = 4,
    knots: int = 12,
    iterations: int = 45,
    seed: int = 0,
    workers: Workers | None = None,
    coarse: int | None = None,
) -> Plans:
    """Find one plan for each of several starts, by gradients of their returns.

    First, each attempt optimizes a plan of one start. It replays random plans near the task's first
    action, without gradients, and improves the best of them. Each of these plans is then replayed
    from all starts, and the search of each start continues from the best plan for it, with a third
    of the iterations. A search continues from plans of other starts: the search of a start without
    success is repeated, at most three times, and at last the search of all starts. It then begins
    with the best of the start's own plan, the plans of the three nearest starts with success, and a
    linear function of the first observation, fitted to all plans with success.

    The best iterate of a start is kept, by success and then by return. Until a plan succeeds, the
    rewards of the last `holds` transitions, in which success is read, count four times. Adam
    updates the knots of a plan, with betas of (.9, .95) and a learning rate that falls linearly
    from .1 to .01, or from a third of these rates after the attempts; the gradient of each start is
    divided by its own norm.

    Infeasible motions and failed simulations receive the worst reward and have no gradient: a plan
    is updated by the gradients of its other rewards.

    Args:
        make: Makes environments: `functools.partial(dc.envs.make, "FoldCloth", size=7,
            opens_at=-1.0, reach=.06)`.
        episodes: E, the number of starts.
        attempts: Number of plans that are found from random plans, of at most E different starts.
        knots: Number of hat functions of the time.
        iterations: Updates of a plan of an attempt.
        seed: Seed of the starts and of the noise.
        workers: Workers that compute plans; None: this process, in one thread. Results have the
            same bits for any workers.
        coarse: Vertices a side of a coarser sheet, for which `make` is called with `size=coarse`:
            plans are found there first, and then improved for the sheet of `make`. None: no such
            stage.

    Raises:
        InvalidInput: If an argument is not accepted.
        SimulationError: If a return or its gradient is not finite.
    """
    if not callable(make):
        raise TypeError(f"plan: `make` must be a function that makes environments, got {make!r}")
    check_count("plan: `episodes`", episodes, 1, _LARGEST_COUNT)
    check_count("plan: `attempts`", attempts, 1, _LARGEST_COUNT)
    check_count("plan: `knots`", knots, 2, _LARGEST_COUNT)
    check_count("plan: `iterations`", iterations, 1, _LARGEST_COUNT)
    check_count("plan: `seed`", seed, 0, LARGEST_SEED)
    check_workers("plan: `workers`", workers)
    if coarse is not None:
        check_count("plan: `coarse`", coarse, 4, _LARGEST_COUNT)
    task = make(num_envs=1).task
    check_memory("plan: `knots`", knots, _DRAWS * attempts * task.action_size * 8, "a knot")
    check_memory("plan: `knots`", knots, episodes * task.action_size * 8, "a knot")
    check_memory("plan: `episodes`", episodes, task.horizon * task.action_size * 8, "an episode")
    if coarse is not None:
        _require_same_actions(make, coarse)
    seeds = part_seeds(seed, 0, episodes)
    draws = cpu.generator().manual_seed(seed)
    first = cpu.tensor(task.first_action).clamp(-_LARGEST_KNOT, _LARGEST_KNOT).atanh()
    sized = lru_cache(maxsize=8)(partial(_sized, make))
    stage = partial(_stage, make, sized, workers)
    sizes = [None] if coarse is None else [coarse, None]
    search = _Search(stage, sized, seeds, iterations, sizes[0])
    found = search.solved(search.attempts(_drawn(first, attempts, knots, len(seeds), draws)).knots)
    for size in sizes[1:]:
        found = _Search(stage, sized, seeds, iterations, size).solved_from(found)
    return found.plans(seeds)


@dataclass(frozen=True, eq=False)
class Improved:
    """The best iterates of some starts.

    Attributes:
        knots: Knots before tanh [n, K, A].
        actions: Actions [n, T, A].
        returns: Sums of rewards [n].
        success: True if the plan succeeds [n].
    """

    knots: Tensor
    actions: Tensor
    returns: Tensor
    success: Tensor

    def better(self, other: Improved) -> Improved:
        """Return the better iterate of each start; `self` in a tie."""
        wins = other.success & ~self.success
        wins |= (other.success == self.success) & (other.returns > self.returns)
        return Improved(
            *(
                torch.where(wins.reshape(-1, *[1] * (mine.dim() - 1)), yours, mine)
                for mine, yours in zip(self._parts(), other._parts(), strict=True)
            )
        )

    def replaced(self, rows: Sequence[int], others: Improved) -> Improved:
        """Return these iterates with some rows replaced by others."""
        places = cpu.tensor(list(rows), dtype=torch.int64)
        return Improved(
            *(
                mine.index_copy(0, places, yours)
                for mine, yours in zip(self._parts(), others._parts(), strict=True)
            )
        )

    def rows(self, rows: Sequence[int]) -> Improved:
        """Return some of the iterates, by index."""
        return Improved(*(part[list(rows)] for part in self._parts()))

    def best(self) -> int:
        """Return the index of the best iterate, by success and then by return."""
        keys = zip(self.success.tolist(), self.returns.tolist(), strict=True)
        return max(enumerate(keys), key=lambda pair: (pair[1], -pair[0]))[0]

    def plans(self, seeds: Sequence[int]) -> Plans:
        """Return plans of the starts with these seeds."""
        numbers = cpu.tensor(seeds, dtype=torch.int64)
        return Plans(self.actions, self.returns, self.success, numbers)

    @staticmethod
    def together(parts: Sequence[Improved]) -> Improved:
        """Concatenate parts."""
        columns = zip(*(part._parts() for part in parts), strict=True)
        return Improved(*(torch.cat(tensors) for tensors in columns))

    def _parts(self) -> tuple[Tensor, ...]:
        return self.knots, self.actions, self.returns, self.success


def improve(
    env: ClothVectorEnv, start: EnvState, knots: Tensor, iterations: int, rate: float = _RATE
) -> Improved:
    """Improve plans of environments from a given state, each by its own gradient.

    Until a plan succeeds, the last `holds` rewards count more.

    Args:
        env: Environments whose task and parameters are used; their state remains unchanged.
        start: States after equally many transitions in all environments, without a graph.
        knots: Knots of plans of whole episodes, before tanh [n, K, A].
        iterations: Number of updates; with 0 plans are only evaluated.
        rate: Initial learning rate of Adam; it falls linearly to a tenth.

    Returns:
        The best iterate of each start, including the initial one, with the remaining actions of the
        episode.

    Raises:
        SimulationError: If a return or a gradient is not finite.
    """
    done = int(start.elapsed[0])
    shares = hats(env.task.horizon, knots.shape[1])[done:]
    free = knots.detach().clone().requires_grad_()
    adam = torch.optim.Adam([free], lr=rate, betas=_BETAS)
    best: Improved | None = None
    for k in range(iterations + 1):
        before = torch.einsum("tk,nka->nta", shares, free)
        actions = before.detach().tanh()
        leaf = actions.clone().requires_grad_(k < iterations)
        with torch.set_grad_enabled(k < iterations):
            returns, last, success = _followed(env, start, leaf)
        found = Improved(free.detach().clone(), actions, returns.detach(), success)
        best = found if best is None else best.better(found)
        if k < iterations and returns.requires_grad:
            objective = returns + torch.where(best.success, 0.0, LAST_WEIGHT * last)
            (slope,) = torch.autograd.grad(objective.sum(), leaf)
            (free.grad,) = torch.autograd.grad(before.tanh(), free, -_normalized(env, slope, k))
            adam.param_groups[0]["lr"] = rate * (1 - (1 - _LAST_SHARE) * k / max(iterations - 1, 1))
            with cpu.DEVICE:  # device of the step counts of Adam
                adam.step()
    assert best is not None
    return best


def hats(horizon: int, knots: int) -> Tensor:
    """Return values of hat functions at the times of transitions [T, K]; rows sum to 1."""
    times = cpu.linspace(0.0, knots - 1.0, horizon)[:, None]
    return (1 - (times - cpu.arange(knots)).abs()).clamp(min=0)


def knots_of(actions: Tensor, knots: int, done: int = 0) -> Tensor:
    """Fit knots before tanh [E, K, A] to actions [E, T - done, A], by least squares before tanh.

    Knots on which only the first `done` transitions depend are zero.
    """
    shares = hats(done + actions.shape[1], knots)[done:]
    before = actions.clamp(-_LARGEST_KNOT, _LARGEST_KNOT).atanh()
    return torch.stack([torch.linalg.lstsq(shares, each, driver="gelsd")[0] for each in before])


def _followed(
    env: ClothVectorEnv, start: EnvState, actions: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Follow actions [n, T, A] from a state.

    Returns:
        Returns [n], their parts from the last `holds` transitions [n], and successes [n].
    """
    task, place = env.task, start
    returns = cpu.zeros(len(start))
    last = cpu.zeros(len(start))
    success = cpu.zeros(len(start), dtype=torch.bool)
    running = ~success
    for k in range(actions.shape[1]):
        place = task.transition(place, actions[:, k], env.parameters)
        outcome = torch.where(running, task.outcome(place), 0.0)
        returns = returns + outcome
        if k >= actions.shape[1] - task.holds:
            last = last + outcome
        success = torch.where(running, task.succeeded(place) & ~place.failed, success)
        running = running & ~task.terminal(place)
        if not bool(running.any()):
            break
    _require_finite(env, "return", returns.detach())
    return returns, last, success


def _normalized(env: ClothVectorEnv, slope: Tensor, iteration: int) -> Tensor:
    """Require finite gradients [n, T, A], and divide each by its own norm."""
    _require_finite(env, f"gradient of iteration {iteration}", slope.sum(dim=(1, 2)))
    return unit_gradients(slope, (1, 2))


def _require_finite(env: ClothVectorEnv, name: str, values: Tensor) -> None:
    wrong = ~torch.isfinite(values)
    if bool(wrong.any()):
        environments = wrong.nonzero()[:, 0].tolist()
        raise SimulationError(
            f"plan: the {name} of {env.task.name} is not finite in environments {environments}; a "
            "square root or a norm in a reward has no derivative at 0",
            environments=environments,
        )


@dataclass(frozen=True, eq=False)
class _Piece:
    """Plans to improve.

    Attributes:
        seeds: Seeds of the starts.
        knots: Knots before tanh [n, K, A].
        iterations: Number of updates.
        rate: Initial learning rate of Adam.
        size: Vertices a side of the sheet; None: the size of the environments of `make`.
    """

    seeds: list[int]
    knots: Tensor
    iterations: int
    rate: float
    size: int | None


def _improved(make: Callable[[int, int | None], ClothVectorEnv], piece: _Piece) -> Improved:
    with threads_of_torch(1):
        env = make(len(piece.seeds), piece.size)
        env.reset(seed=piece.seeds)
        start = env.env_state.detach()
        return improve(env, start, piece.knots, piece.iterations, piece.rate)


def _improved_remotely(work: tuple[bytes, _Piece]) -> tuple[Improved, int]:
    """Improve plans in this process, whose environments are reused; also count its steps."""
    before = steps_made()
    return _improved(partial(_made, work[0]), work[1]), steps_made() - before


@lru_cache(maxsize=8)
def _made(make: bytes, count: int, size: int | None) -> ClothVectorEnv:
    return _sized(pickle.loads(make), count, size)


def _sized(make: MakeEnv, count: int, size: int | None) -> ClothVectorEnv:
    return make(num_envs=count) if size is None else make(num_envs=count, size=size)


def _stage(
    make: MakeEnv,
    local: Callable[[int, int | None], ClothVectorEnv],
    workers: Workers | None,
    pieces: Sequence[_Piece],
) -> Improved:
    """Compute and concatenate results of pieces; without workers in local environments."""
    if workers is None:
        return Improved.together([_improved(local, piece) for piece in pieces])
    name = pickled("plan: with `workers`, `make`", make)
    found = list(workers.map(_improved_remotely, [(name, p) for p in pieces]))
    add_steps(sum(steps for _, steps in found))
    return Improved.together([improved for improved, _ in found])


_Stage = Callable[[Sequence[_Piece]], Improved]


def _drawn(first: Tensor, attempts: int, knots: int, starts: int, draws: torch.Generator) -> Tensor:
    """Draw initial knots of attempts [attempts, D, K, A] about the first action [A].

    The first draw of the first attempt of a start is without noise.
    """
    sizes = (attempts, _DRAWS, knots, len(first))
    noise = cpu.randn(*sizes, generator=draws, dtype=torch.float64)
    noise = noise + cpu.randn(*sizes[:2], 1, len(first), generator=draws, dtype=torch.float64)
    noise[:starts, 0] = 0.0
    return first + _NOISE * noise


class _Search:
    """A search of plans for several starts, with a sheet of one size."""

    def __init__(
        self,
        stage: _Stage,
        sized: Callable[[int, int | None], ClothVectorEnv],
        seeds: Sequence[int],
        iterations: int,
        size: int | None,
    ) -> None:
        self._stage, self._seeds, self._iterations, self._size = stage, seeds, iterations, size
        env = sized(1, size)
        seen = torch.cat([env.reset(seed=[seed])[0].double() for seed in seeds])
        scale = seen.std(dim=0, correction=0)
        centered = seen - seen.mean(dim=0)
        self._seen = torch.where(scale > _LEAST, centered / scale.clamp(min=_LEAST), 0.0)  # [E, O]

    def attempts(self, drawn: Tensor) -> Improved:
        """Improve the best of the drawn knots [attempts, D, K, A] of each attempt."""
        starts = [k % len(self._seeds) for k in range(len(drawn))]
        best = self._best_of(
            [(start, list(each)) for start, each in zip(starts, drawn, strict=True)]
        )
        return self._improved(starts, best.knots, self._iterations, _RATE)

    def solved(self, knots: Tensor) -> Improved:
        """Search plans of all starts; begin with the best of common knots [n, K, A] for each."""
        rows = list(range(len(self._seeds)))
        return self._chained(self._refined([(row, list(knots)) for row in rows]))

    def solved_from(self, found: Improved) -> Improved:
        """Search plans of all starts; begin with plans of these starts, found for another size."""
        rows = list(range(len(self._seeds)))
        return self._chained(self._refined(self._candidates(rows, found)))

    def _chained(self, found: Improved) -> Improved:
        """Repeat the search of starts without success, and at last of all starts."""
        for _ in range(_ROUNDS):
            rows = (~found.success).nonzero()[:, 0].tolist()
            if not rows:
                break
            found = self._again(rows, found)
        return self._again(list(range(len(self._seeds))), found)

    def _again(self, rows: Sequence[int], found: Improved) -> Improved:
        return found.replaced(rows, self._refined(self._candidates(rows, found)))

    def _candidates(self, rows: Sequence[int], found: Improved) -> list[tuple[int, list[Tensor]]]:
        """Knots from which the search of some starts can continue.

        These are the knots of the start, of the nearest starts with success, and a linear function
        of the observation that is fitted to the knots of all starts with success.
        """
        donors = found.success.nonzero()[:, 0].tolist() or list(range(len(self._seeds)))
        apart = torch.cdist(self._seen[list(rows)], self._seen[donors])
        fitted = _fitted(self._seen[donors], found.knots[donors], self._seen[list(rows)])
        candidates = []
        for row, distances, guess in zip(rows, apart, fitted, strict=True):
            near = [donors[k] for k in distances.argsort(stable=True).tolist()]
            others = [donor for donor in near if donor != row][:_NEIGHBORS]
            candidates.append((row, [found.knots[k] for k in (row, *others)] + [guess]))
        return candidates

    def _refined(self, candidates: Sequence[tuple[int, list[Tensor]]]) -> Improved:
        """Improve the best candidate of each start."""
        best = self._best_of(candidates)
        few = math.ceil(self._iterations / _SHARE)
        return self._improved([start for start, _ in candidates], best.knots, few, _RATE / _SHARE)

    def _best_of(self, candidates: Sequence[tuple[int, list[Tensor]]]) -> Improved:
        """Replay candidates, and return the best one of each start."""
        starts = [start for start, each in candidates for _ in each]
        knots = torch.stack([one for _, each in candidates for one in each])
        tried = self._improved(starts, knots, 0, _RATE, _REPLAYED)
        best, first = [], 0
        for _, each in candidates:
            best.append(first + tried.rows(range(first, first + len(each))).best())
            first += len(each)
        return tried.rows(best)

    def _improved(
        self,
        starts: Sequence[int],
        knots: Tensor,
        iterations: int,
        rate: float,
        together: int = _TOGETHER,
    ) -> Improved:
        seeds = [self._seeds[start] for start in starts]
        # Pieces have a fixed size, which does not depend on the number of workers.
        return self._stage(
            [
                _Piece(
                    seeds[k : k + together], knots[k : k + together], iterations, rate, self._size
                )
                for k in range(0, len(seeds), together)
            ]
        )


def _fitted(seen: Tensor, knots: Tensor, wanted: Tensor) -> Tensor:
    """Fit knots [n, K, A] by a linear function of observations [n, O], with a ridge penalty.

    Returns:
        Values of the function for the observations `wanted` [m, O], [m, K, A].
    """
    middle, mean = seen.mean(dim=0), knots.mean(dim=0)
    inner, outer = seen - middle, wanted - middle
    products = inner @ inner.T
    ridge = _RIDGE * products.diagonal().mean().clamp(min=_LEAST) * cpu.eye(len(seen))
    weights: Tensor = torch.linalg.solve(products + ridge, (knots - mean).flatten(1))
    return mean + (outer @ inner.T @ weights).reshape(-1, *mean.shape)


def _require_same_actions(make: MakeEnv, coarse: int) -> None:
    fine, other = (_sized(make, 1, size).task for size in (None, coarse))
    for name in ("action_size", "horizon"):
        if getattr(fine, name) != getattr(other, name):
            raise InvalidInput(
                f"plan: `coarse` must leave the task's {name} as it is, "
                f"{getattr(fine, name)}, got {getattr(other, name)} at {coarse}"
            )
