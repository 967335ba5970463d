"""Workers that compute pieces of work: processes, jobs, Ray actors, ranks of a torchrun job.

Each class has `map(function, items)`, which returns results in the order of the items, as executors
of `concurrent.futures` do. The result of a piece has the same bits for all workers.
"""

from __future__ import annotations

import math
import os
import pickle
import threading
from collections.abc import Callable, Iterable, Sequence
from datetime import timedelta
from typing import Any, Generic, Protocol, TypeVar

from diffcloth_torch.checks import NON_NEGATIVE, Range, check_count, check_number, refuse_threads
from diffcloth_torch.errors import InvalidInput, WorkerError
from diffcloth_torch.extras import from_extra
from diffcloth_torch.processes import DEADLINE, LARGEST_WORKERS, LONGEST_DEADLINE, Pool
from diffcloth_torch.worker import end_with_parent, portable

__all__ = [
    "Jobs",
    "Processes",
    "Ranks",
    "RayActors",
    "Workers",
    "check_workers",
    "pickled",
]

A = TypeVar("A")
B = TypeVar("B")

_DEADLINES = Range(0.0, LONGEST_DEADLINE)
_REPEATS = 3  # of a piece whose actor died, before an error is raised


class Workers(Protocol):
    """Protocol of workers; executors of `concurrent.futures` satisfy it, except thread pools."""

    def map(self, function: Callable[[Any], Any], items: Any, /) -> Iterable[Any]:
        """Return results of a function for items, in their order."""
        ...


def check_workers(name: str, workers: object) -> None:
    """Require workers, or None."""
    refuse_threads(name, workers)
    if workers is not None and (
        isinstance(workers, type) or not callable(getattr(workers, "map", None))
    ):
        raise TypeError(
            f"{name} must have `map`, as dc.learn.Processes(2) and executors do, got {workers!r}"
        )


def pickled(name: str, function: object) -> bytes:
    """Pickle a function that workers call.

    Raises:
        InvalidInput: If the function cannot be pickled.
    """
    try:
        return pickle.dumps(function)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InvalidInput(
            f"{name} must be a function of a module, or such as "
            f"functools.partial(dc.envs.make, 'FoldCloth'), that can be pickled: {error}"
        ) from error


class _Portable(Generic[A, B]):
    """A function whose exceptions can be pickled; other exceptions are replaced by their text."""

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
    """Processes on this machine, which end with this process, however it ends.

    A piece is recomputed up to three times if its process dies or misses the deadline.
    """

    def __init__(self, count: int, *, deadline: float = DEADLINE) -> None:
        """Prepare to start processes.

        Args:
            count: Number of processes.
            deadline: Longest duration of a piece [s].

        Raises:
            InvalidInput: If an argument is not accepted.
        """
        check_count("Processes: `count`", count, 1, LARGEST_WORKERS)
        check_number("Processes: `deadline`", deadline, _DEADLINES)
        self._pool = Pool("Processes", count, deadline)
        self._lock = threading.Lock()

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Compute results in the order of the items.

        Raises:
            WorkerError: If processes for a piece die, or miss the deadline, four times.
        """
        with self._lock:
            return list(self._pool.map(function, items))

    def close(self) -> None:
        """End the processes; a later `map` starts new ones."""
        self._pool.close()


class Jobs:
    """Any executor with `submit(function, item)` that returns an object with `result()`.

    Examples are executors of submitit (Slurm) and clients of dask, whose own `map` differs.
    """

    def __init__(self, executor: Any) -> None:
        """Wrap a configured executor; the caller closes it."""
        self.executor = executor

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Compute results in the order of the items."""
        jobs = [self.executor.submit(function, item) for item in items]
        return [job.result() for job in jobs]


class RayActors:
    """Actors of Ray, on this machine or on the cluster of `ray.init`.

    Ray restarts an actor that dies, and repeats its unfinished pieces, up to three times.
    """

    def __init__(self, count: int, *, cores: float = 1.0, deadline: float = DEADLINE) -> None:
        """Start the actors, and Ray on this machine unless it has been initialized.

        Args:
            count: Number of actors.
            cores: Number of cores that each actor occupies.
            deadline: Longest wait for the next result of a `map` [s].

        Raises:
            InvalidInput: If an argument is not accepted, or Ray is not installed.
        """
        check_count("RayActors: `count`", count, 1, LARGEST_WORKERS)
        check_number("RayActors: `cores`", cores, NON_NEGATIVE)
        self._deadline = check_number("RayActors: `deadline`", deadline, _DEADLINES)
        ray = from_extra("ray", "ray", "RayActors needs ray")
        if not ray.is_initialized():
            # The cores that all actors occupy; with fewer, actors would never be scheduled.
            cpus = max(math.ceil(count * cores), 1)
            ray.init(num_cpus=cpus, include_dashboard=False, log_to_driver=False)
        remote: Any = ray.remote(num_cpus=cores, max_restarts=-1, max_task_retries=_REPEATS)(
            _Caller
        )
        self.actors: list[Any] = [remote.remote() for _ in range(count)]

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Compute results in the order of the items.

        Raises:
            WorkerError: If actors die four times over a piece, or if no result arrives within the
                deadline; the actors are then ended.
            InvalidInput: If the actors have been closed.
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
    """The processes of a `torchrun` job, which all run the same program.

    Each process computes its share of the pieces, and all gather all results, so their states stay
    equal. Under torchrun, a process ends with the agent that started it, however the agent ends.
    """

    def __init__(self, *, deadline: float = DEADLINE) -> None:
        """Join the job by gloo, unless `torch.distributed` has been initialized.

        Args:
            deadline: Longest wait for the results of other processes [s]; a group that has been
                initialized keeps its own timeout.

        Raises:
            InvalidInput: If this process does not belong to a job.
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
        """Compute results in the order of the items, in every process.

        Raises:
            Exception: The error of the first failed piece, in all processes.
            WorkerError: If a process has died or missed the deadline.
        """
        made: list[tuple[B | None, Exception | None]] = []
        for item in items[self.rank :: self.size]:
            try:
                made.append((function(item), None))
            except Exception as error:  # sent to all processes, which would otherwise wait
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
        """Require equal digests in all processes.

        Args:
            what: Name of the digested data, for the message.
            digest: Digest of this process.

        Raises:
            InvalidInput: If digests differ; raised in every process.
        """
        digests = self._gather(digest)
        others = [rank for rank, other in enumerate(digests) if other != digests[0]]
        if others:
            raise InvalidInput(
                f"Ranks: {what} must be the same in all processes, those of ranks {others} differ "
                "from rank 0; seeds of each environment follow from the one of the options"
            )

    def _gather(self, value: object) -> list[Any]:
        """Gather the values of all processes, in the order of ranks."""
        import torch.distributed as dist

        gathered: list[Any] = [None] * self.size
        try:
            dist.all_gather_object(gathered, value)
        except RuntimeError as error:  # of gloo: a closed connection or a timeout
            raise WorkerError(
                f"Ranks: another process died, or gave no result within the deadline, as rank "
                f"{self.rank} of {self.size} reports: {error}"
            ) from error
        return gathered

    def close(self) -> None:
        """Leave the job."""
        import torch.distributed as dist

        dist.destroy_process_group()
