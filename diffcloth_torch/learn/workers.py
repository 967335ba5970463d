"""Workers that make pieces of work: processes, jobs, actors of Ray, ranks of a torchrun job.

Each has `map(function, items)`, which gives the results in the order of the items, as executors of
`concurrent.futures` do. A piece does not depend on who makes it: all give the same bits.
"""

from __future__ import annotations

import math
import pickle
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, Generic, Protocol, TypeVar

from diffcloth_torch.checks import NON_NEGATIVE, check_count, check_number
from diffcloth_torch.errors import InvalidInput
from diffcloth_torch.extras import from_extra

__all__ = ["Jobs", "Processes", "Ranks", "RayActors", "Workers"]

A = TypeVar("A")
B = TypeVar("B")

_REPEATS = 3  # of pieces whose process or actor died, before the error is passed on


class Workers(Protocol):
    """What makes pieces of work; an executor of `concurrent.futures` is one, but of threads."""

    def map(self, function: Callable[[Any], Any], items: Any, /) -> Iterable[Any]:
        """Results of a function for items, in their order."""
        ...


class _Portable(Generic[A, B]):
    """A function whose exceptions reach other processes; what cannot be pickled becomes text."""

    def __init__(self, function: Callable[[A], B]) -> None:
        self._function = function

    def __call__(self, item: A) -> B:
        try:
            return self._function(item)
        except Exception as error:
            portable = _portable(error)
            if portable is error:
                raise
            raise portable from None


def _portable(error: Exception) -> Exception:
    try:
        copy = pickle.loads(pickle.dumps(error))
    except Exception:  # whatever its class does with arguments that are not its own
        copy = None
    if type(copy) is type(error):
        return error
    text = "".join(traceback.format_exception(error))
    return RuntimeError(f"a worker raised {type(error).__qualname__}: {error}\n{text}")


class Processes:
    """Processes on this machine; what a process that dies did not finish is made again."""

    def __init__(self, count: int) -> None:
        """Prepare to start `count` processes."""
        self._count = check_count("Processes: `count`", count, 1)
        self._pool: ProcessPoolExecutor | None = None

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Results in the order of the items.

        Raises:
            BrokenProcessPool: If processes die again and again.
        """
        for repeat in range(_REPEATS + 1):
            if self._pool is None:
                # Processes that are spawned inherit no thread or lock.
                self._pool = ProcessPoolExecutor(self._count, mp_context=get_context("spawn"))
            try:
                return list(self._pool.map(_Portable(function), items))
            except BrokenProcessPool:
                self.close()
                if repeat == _REPEATS:
                    raise
        raise AssertionError("unreachable")

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


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

    def __init__(self, count: int, *, cores: float = 1.0) -> None:
        """Start the actors, and Ray on this machine where it has not been started.

        Args:
            count: Number of actors.
            cores: That each occupies.

        Raises:
            InvalidInput: If Ray is not there.
        """
        check_count("RayActors: `count`", count, 1)
        check_number("RayActors: `cores`", cores, NON_NEGATIVE)
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
            RayActorError: If actors die again and again.
            InvalidInput: If they have been closed.
        """
        from ray.util import ActorPool

        if not self.actors:
            raise InvalidInput("RayActors: they have been closed; make new ones")
        pool: Any = ActorPool(self.actors)
        call = _Portable(function)
        return list(pool.map(lambda actor, item: actor.call.remote(call, item), items))

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
    """

    def __init__(self) -> None:
        """Join the job by gloo, where `torch.distributed` has not been initialized.

        Raises:
            InvalidInput: If this is no process of a job.
        """
        import torch.distributed as dist

        if not dist.is_initialized():
            if not dist.is_torchelastic_launched():
                raise InvalidInput("Ranks must run under torchrun")
            dist.init_process_group("gloo")
        self.rank, self.size = dist.get_rank(), dist.get_world_size()

    def map(self, function: Callable[[A], B], items: Sequence[A], /) -> list[B]:
        """Results in the order of the items, in every process.

        Raises:
            Exception: What a piece raised in any of the processes.
        """
        import torch.distributed as dist

        made: list[tuple[B | None, Exception | None]] = []
        for item in items[self.rank :: self.size]:
            try:
                made.append((function(item), None))
            except Exception as error:  # all processes must learn of it, or they would wait
                made.append((None, _portable(error)))
        gathered: list[Any] = [None] * self.size
        dist.all_gather_object(gathered, made)
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
        import torch.distributed as dist

        digests: list[Any] = [None] * self.size
        dist.all_gather_object(digests, digest)
        others = [rank for rank, other in enumerate(digests) if other != digests[0]]
        if others:
            raise InvalidInput(
                f"Ranks: {what} must be the same in all processes, those of ranks {others} differ "
                "from rank 0; seeds of each environment follow from the one of the options"
            )

    def close(self) -> None:
        """Leave the job."""
        import torch.distributed as dist

        dist.destroy_process_group()
