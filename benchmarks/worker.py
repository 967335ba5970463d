"""One side of a comparison: times single steps of a scene with the package of a given folder.

`benchmarks.compare` runs this file as a script, passes a row as JSON in the first line of its
input, and requests one timed step with each further line. The script uses only the public interface
of the package, so that versions with different internals can be compared.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    row = json.loads(sys.stdin.readline())
    os.sched_setaffinity(0, row["cores"])
    use_package(Path(row["package"]))
    steps = timed_steps(row)
    print(json.dumps(next(steps)), flush=True)  # ready: result of the approach
    for _ in sys.stdin:
        print(json.dumps(next(steps)), flush=True)


def use_package(folder: Path) -> None:
    """Import the package from `folder`, and the scenes from this checkout."""
    sys.path[0] = str(folder)
    import diffcloth_torch

    found = Path(diffcloth_torch.__file__).resolve().parents[1]
    if found != folder.resolve():
        raise SystemExit(f"{folder} has no diffcloth_torch; Python found that of {found}")
    sys.path[0] = str(ROOT)


def timed_steps(row: dict[str, Any]) -> Any:
    """Yield once when the scene is in its regime, then the times of each step."""
    import torch

    import diffcloth_torch as dc
    from benchmarks.scenes import BUCKLING, DT, FURTHER, SCENES, in_regime

    torch.set_num_threads(row["threads"])
    scene = (SCENES | BUCKLING | FURTHER)[row["scene"]](row["size"])
    given = {} if row["slip_velocity"] is None else {"slip_velocity": row["slip_velocity"]}
    simulator = dc.Simulator(
        scene.scene,
        DT,
        contact=dc.ContactOptions(**given),
        solver=dc.SolverOptions(throw=False),
    )
    state = in_regime(simulator, scene, row["batch"], Path(row["kept"]))
    generator = torch.Generator().manual_seed(1)
    yield {"core": dc.build_info()["factorization"]}

    count = row["batch"] or 1
    clock = time.process_time if row["processor_time"] else time.perf_counter
    while True:
        before = state.detach()
        leaves = [before.positions.requires_grad_(), before.velocities.requires_grad_()]
        control = scene.control(state)
        if isinstance(control.body_poses, torch.Tensor):
            leaves.append(control.body_poses.requires_grad_())
        start = clock()
        after = simulator.step(before, control)
        forward = clock() - start
        converged = torch.as_tensor(after.report.converged).sum().item()
        backward = None
        if converged == count:
            outputs = [after.positions, after.velocities]
            cotangents = [torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in outputs]
            start = clock()
            try:
                torch.autograd.backward(outputs, cotangents)
                backward = (clock() - start) / count
            except dc.SimulationError:
                converged = 0  # at a saddle, which the first version accepts as a minimum
        yield {
            "forward": forward / count,
            "backward": backward,
            "iterations": torch.as_tensor(after.report.iterations).double().mean().item(),
            "unconverged": count - converged,
        }
        state = after.detach()


if __name__ == "__main__":
    main()
