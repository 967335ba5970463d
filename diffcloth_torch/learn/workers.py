"""Workers that make pieces of work: processes, jobs, actors of Ray, ranks of a torchrun job.

Each has `map(function, items)`, which gives the results in the order of the items, as executors of
`concurrent.futures` do. A piece does not depend on who makes it: all give the same bits.
"""

from __future__ import annotations

import math
import os
import pickle
import threading
from collections.abc import Callable, Iterable, Sequence
from datetime import timedelta
from typing import Any, Generic, Protocol, TypeVar

from diffcloth_torch.checks import (
    NON_NEGATIVE,
    Range,
    check_count,
    check_number,
    refuse_threads,
)
from diffcloth_torch.errors import InvalidInput, WorkerError
from diffcloth_torch.extras import from_extra
from diffcloth_torch.processes import DEADLINE, LARGEST_WORKERS, LONGEST_DEADLINE, Pool
from diffcloth_torch.worker import end_with_parent, portable

__all__ = ["Jobs", "Processes", "Ranks", "RayActors", "Workers", "check_workers", "pickled"]

A = TypeVar("A")
B = TypeVar("B")

_DEADLINES = Range(0.0, LONGEST_DEADLINE)
_REPEATS = 3  # of pieces whose actor died, before the error is passed on


class Workers(Protocol):
    """What makes pieces of work; an executor of `concurrent.futures` is one, but of threads."""

    def map(self, function: Callable[[Any], Any], items: Any, /) -> Iterable[Any]:
        """Results of a function for items, in their order."""
        ...


def check_workers(name: str, workers: object) -> None:
    """Require workers of other processes, or None."""
    refuse_threads(name, workers)
    if workers is not None and (
        isinstance(workers, type) or not callable(getattr(workers, "map", None))
    ):
        raise TypeError(
            f"{name} must have `map`, as dc.learn.Processes(2) and executors do, got {workers!r}"
        )


def pickled(name: str, function: Callable[..., Any]) -> bytes:
    """A function for other processes.

    Raises:
        InvalidInput: If it cannot be pickled.
    """
    try:
        return pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InvalidInput(
            f"{name} must, with `workers`, be a function of a module, or such as "
            f"functools.partial(dc.envs.make, 'FoldCloth'), that can be pickled: {error}"
        ) from error


class _Portable(Generic[A, B]):
    """A function whose exceptions reach other processes; what cannot be pickled becomes text."""

    def __init__(self, function: Callable[[A], B]) -> None:
        self._function = function

    def __call__(self, item: A) -> B:
        try:
            return self._function(item)
        except Exception as error:
            found = portable(error)
            if found is error:
                raise
            raise found from None


class Processes:
    """Processes on this machine, which end with this one however it ends.

    A piece whose process dies, or misses the deadline, is computed again, up to three times.
    """

    def __init__(self, count: int, *, deadline: float = DEADLINE) -> None:
        """Prepare to start processes.

        Args:
            count: Their number.
            deadline: Longest time of a piece [s].

        Raises:
            InvalidInput: If an argument is not accepted.
        """
        check_count("Processes: `count`", count, 1, LARGEST_WORKERS)
        check_number("Processes: `deadline`", deadline, _DEADLINES)
        self._pool = Pool("Processes", count, deadline)
        self._lock = threading.Lock()

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Results in the order of the items.

        Raises:
            WorkerError: If processes die, or miss the deadline, again and again.
        """
        with self._lock:
            return list(self._pool.map(function, items))

    def close(self) -> None:
        """End the processes; a later `map` starts new ones."""
        self._pool.close()


class Jobs:
    """Whatever has `submit(function, item)`, whose result has `result()`.

    So do executors of submitit (Slurm) and clients of dask, whose `map` is another one.
    """

    def __init__(self, executor: Any) -> None:
        """Take an executor that has been set up; it is closed by who made it."""
        self.executor = executor

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Results in the order of the items."""
        jobs = [self.executor.submit(function, item) for item in items]
        return [job.result() for job in jobs]


class RayActors:
    """Actors of Ray, on this machine or on a cluster: `ray.init` says which.

    An actor that dies is started again, and what it did not finish is made again, up to three
    times.
    """

    def __init__(self, count: int, *, cores: float = 1.0, deadline: float = DEADLINE) -> None:
        """Start the actors, and Ray on this machine where it has not been started.

        Args:
            count: Number of actors.
            cores: That each occupies.
            deadline: Longest time until the next result of a `map` arrives [s].

        Raises:
            InvalidInput: If an argument is not accepted, or Ray is not installed.
        """
        check_count("RayActors: `count`", count, 1, LARGEST_WORKERS)
        check_number("RayActors: `cores`", cores, NON_NEGATIVE)
        self._deadline = check_number("RayActors: `deadline`", deadline, _DEADLINES)
        ray = from_extra("ray", "ray", "RayActors needs ray")
        if not ray.is_initialized():
            # As many as they occupy, or they would wait for cores for ever.
            cpus = max(math.ceil(count * cores), 1)
            ray.init(num_cpus=cpus, include_dashboard=False, log_to_driver=False)
        remote: Any = ray.remote(num_cpus=cores, max_restarts=-1, max_task_retries=_REPEATS)(
            _Caller
        )
        self.actors: list[Any] = [remote.remote() for _ in range(count)]

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Results in the order of the items.

        Raises:
            WorkerError: If actors die again and again, or no result arrives within the deadline,
                which ends the actors.
            InvalidInput: If they have been closed.
        """
        from ray.exceptions import RayActorError
        from ray.util import ActorPool

        if not self.actors:
            raise InvalidInput("RayActors: they have been closed; make new ones")
        pool: Any = ActorPool(self.actors)
        call = _Portable(function)
        for item in items:
            pool.submit(lambda actor, item: actor.call.remote(call, item), item)
        results: list[B] = []
        try:
            while pool.has_next():
                results.append(pool.get_next(timeout=self._deadline))
        except TimeoutError as error:
            self.close()
            raise WorkerError(
                f"RayActors: piece {len(results)} of {len(items)} did not end within the deadline "
                f"of {self._deadline:g} s; the actors were ended"
            ) from error
        except RayActorError as error:
            raise WorkerError(
                f"RayActors: piece {len(results)} of {len(items)} was given up after "
                f"{_REPEATS + 1} attempts: {error}"
            ) from error
        return results

    def close(self) -> None:
        """End the actors."""
        import ray

        for actor in self.actors:
            ray.kill(actor)
        self.actors = []


class _Caller:
    def call(self, function: Callable[[A], B], item: A) -> B:
        return function(item)


class Ranks:
    """The processes of a `torchrun` job, each of which runs the same program.

    Each makes the pieces that fall to it and sends the results to all, so that all go on alike.
    Under torchrun each ends with the agent that started it, however the agent ends.
    """

    def __init__(self, *, deadline: float = DEADLINE) -> None:
        """Join the job by gloo, where `torch.distributed` has not been initialized.

        Args:
            deadline: Longest time to wait for the results of the others [s]; a group that has been
                initialized keeps its own.

        Raises:
            InvalidInput: If this is no process of a job.
        """
        import torch.distributed as dist

        check_number("Ranks: `deadline`", deadline, _DEADLINES)

        if not dist.is_initialized():
            if not dist.is_torchelastic_launched():
                raise InvalidInput("Ranks must run under torchrun")
            end_with_parent(os.getppid())
            dist.init_process_group("gloo", timeout=timedelta(seconds=deadline))
        self.rank, self.size = dist.get_rank(), dist.get_world_size()

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Results in the order of the items, in every process.

        Raises:
            Exception: What a piece raised in any of the processes.
            WorkerError: If a process has died, or missed the deadline.
        """
        made: list[tuple[B | None, Exception | None]] = []
        for item in items[self.rank :: self.size]:
            try:
                made.append((function(item), None))
            except Exception as error:  # all processes must learn of it, or they would wait
                made.append((None, portable(error)))
        gathered = self._gather(made)
        results = []
        for k in range(len(items)):
            result, failure = gathered[k % self.size][k // self.size]
            if failure is not None:
                raise failure
            results.append(result)
        return results

    def require_same(self, what: str, digest: bytes) -> None:
        """Require all processes to have the same digest of something.

        Raises:
            InvalidInput: If they do not, in every process.
        """
        digests = self._gather(digest)
        others = [rank for rank, other in enumerate(digests) if other != digests[0]]
        if others:
            raise InvalidInput(
                f"Ranks: {what} must be the same in all processes, those of ranks {others} differ "
                "from rank 0; seeds of each environment follow from the one of the options"
            )

    def _gather(self, value: object) -> list[Any]:
        """The values of all processes, in the order of their ranks."""
        import torch.distributed as dist

        gathered: list[Any] = [None] * self.size
        try:
            dist.all_gather_object(gathered, value)
        except RuntimeError as error:  # of gloo: a connection that is closed, or a time out
            raise WorkerError(
                f"Ranks: another process died, or gave no result within the deadline, as rank "
                f"{self.rank} of {self.size} reports: {error}"
            ) from error
        return gathered

    def close(self) -> None:
        """Leave the job."""
        import torch.distributed as dist

        dist.destroy_process_group()
