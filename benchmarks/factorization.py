"""Time sparse Cholesky factorizations of cloth Hessians, backend by backend.

    python -m benchmarks.factorization                   # sizes 24, 48, 96, and 200 for ours
    python -m benchmarks.factorization --size 24 --seconds 3
    python -m benchmarks.factorization --quick           # seconds

Matrices are M / h^2 plus projected elastic Hessians (`hanging`), and such matrices with a layer of
contacts (`self-contact`). Backends and the levels of our own kernels alternate on one matrix, so
that other load of the machine affects all of them. Times are medians of processor times, for the
factorization also the minimum [ms]. CHOLMOD is included if the core was built with
`DIFFCLOTH_CHOLMOD=ON`, and is as fast as its BLAS: OpenBLAS may need `OPENBLAS_CORETYPE` to
recognize a new processor. Ours is timed in single precision, which the solver uses, and in doubles.
Below each matrix: the share of each phase of our factorization in doubles at its best level.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import click
import numpy as np

import diffcloth_torch as dc
from benchmarks.extra import require
from benchmarks.hessians import HESSIANS, Hessian

_kernels = require("diffcloth_torch._kernels")

SIZES = (24, 48, 96, 200)
BURST = 3  # consecutive calls: the first one has its memory in no cache
LARGEST_ELSEWHERE = 96  # beyond this size only our own factorization is timed


@dataclass(frozen=True)
class Method:
    """A backend, and the level of its kernels' instructions if there is a choice."""

    backend: str
    level: str = ""
    single: bool = False

    def __str__(self) -> str:
        kind = [self.level] * bool(self.level) + ["single"] * self.single
        return f"{self.backend} ({', '.join(kind)})" if kind else self.backend


def methods() -> list[Method]:
    """Ours in single precision, then in doubles, the slowest level of each first."""
    ours = [
        Method("multifrontal", level, single)
        for single in (True, False)
        for level in _kernels.kernel_levels()
    ]
    return ours + [Method(b) for b in _kernels.cholesky_backends() if b != "multifrontal"]


class Trial:
    """One method on one matrix, with the times of analysis, factorization and solve."""

    def __init__(self, method: Method, matrix: Hessian) -> None:
        self.method = method
        self.matrix = matrix
        self.analysis, self.factor = self._analyze()
        self.workspace = _kernels.CholeskyWorkspace()
        self.b = np.random.default_rng(0).normal(size=(1, matrix.size, 3))
        self.x = np.zeros_like(self.b)
        self.seconds: dict[str, list[float]] = {"analysis": [], "factor": [], "solve": []}

    def run(self) -> None:
        self._time("analysis", self._analyze)
        self._time("factor", self._factorize)
        self._time("solve", lambda: self.factor.solve(self.b, self.x, self.workspace))

    def milliseconds(self, part: str) -> float:
        return 1e3 * median(self.seconds[part])

    def phases(self, repeats: int) -> dict[str, float]:
        return self.factor.profile(self.matrix.blocks, self.workspace, repeats)

    def _analyze(self):
        """The analysis, and an empty factor, whose construction completes the analysis."""
        m = self.matrix
        analysis = _kernels.CholeskyAnalysis(
            m.size, m.pairs, m.fixed, self.method.backend, self.method.level
        )
        return analysis, _kernels.CholeskyFactor(analysis, single=self.method.single)

    def _factorize(self) -> None:
        if not self.factor.compute(self.matrix.blocks, self.workspace):
            raise RuntimeError(f"{self.method} finds the matrix indefinite")

    def _time(self, part: str, call: Callable[[], object]) -> None:
        for _ in range(BURST):
            start = time.thread_time()
            call()
            self.seconds[part].append(time.thread_time() - start)


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.option("--matrix", "names", multiple=True, type=click.Choice(list(HESSIANS)))
@click.option("--size", "sizes", multiple=True, type=click.IntRange(min=4), help="Vertices a side.")
@click.option("--seconds", default=2.0, help="For each method and matrix, about.")
@click.option("--quick", is_flag=True, help="Small matrices, a few times: shows that it runs.")
def main(names: tuple[str, ...], sizes: tuple[int, ...], seconds: float, quick: bool) -> None:
    given = sizes or ((6, 8) if quick else SIZES)
    core = dc.build_info()
    print(f"{_processor()}; {core['factorization']}; BLAS of CHOLMOD: {core['blas']}")
    for name in names or HESSIANS:
        for size in given:
            _compare(name, size, HESSIANS[name](size), 0.02 if quick else seconds)


def _compare(name: str, size: int, matrix: Hessian, seconds: float) -> None:
    chosen = [m for m in methods() if m.backend == "multifrontal" or size <= LARGEST_ELSEWHERE]
    trials = [Trial(method, matrix) for method in chosen]
    for trial in trials:
        trial.run()  # caches fill
        trial.seconds = {part: [] for part in trial.seconds}
    end = time.perf_counter() + seconds * len(trials)
    while not trials[0].seconds["factor"] or time.perf_counter() < end:
        for trial in trials:
            trial.run()

    print(f"\n{name}, {size} x {size}: {trials[0].analysis.dimension()} unknowns")
    print(
        f"{'':<30}{'analysis':>9}{'factor':>9}{'least':>9}{'solve':>8}{'GFlop/s':>9}{'MFlop':>8}"
        f"{'entries of L':>14}{'MB':>7}"
    )
    for trial in trials:
        analysis, factor = trial.analysis, trial.milliseconds("factor")
        print(
            f"{trial.method!s:<30}{trial.milliseconds('analysis'):>9.2f}{factor:>9.3f}"
            f"{1e3 * min(trial.seconds['factor']):>9.3f}"
            f"{trial.milliseconds('solve'):>8.3f}{1e-6 * analysis.flops() / factor:>9.1f}"
            f"{1e-6 * analysis.flops():>8.0f}{analysis.nonzeros():>14}"
            f"{1e-6 * trial.factor.bytes():>7.1f}"
        )
    best = [trial for trial in trials if trial.method.backend == "multifrontal"][-1]
    phases = best.phases(3)
    shares = ", ".join(f"{phase} {1e3 * s:.3f} ms" for phase, s in phases.items())
    print(f"{best.method}: {shares}; {1e-6 * best.workspace.bytes():.1f} MB of work space")


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    models = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
