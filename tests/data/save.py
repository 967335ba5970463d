"""Save what a later version must load, with the version that is installed.

    python tests/data/save.py tests/data/first_version

wrote `first_version.pkl` and `first_version.pt` with version 0.1.0.
"""

import pickle
import sys
from pathlib import Path

import torch

import diffcloth_torch as dc


def main(path: Path) -> None:
    cloth = dc.Cloth.grid(
        4,
        4,
        (0.3, 0.3),
        material=dc.Material(stretch=300.0, friction=0.3),
        pins={"left": [0, 4]},
        soft_pins={"right": [3]},
        name="sheet",
    )
    box = dc.RigidBody.box(0.1, motion="kinematic", pose=[0, 0, -0.06, 1, 0, 0, 0])
    simulator = dc.Simulator(
        dc.Scene([cloth], [box]),
        0.01,
        scheme="split",
        contact=dc.ContactOptions(friction_iterations=1),
        solver=dc.SolverOptions(metric="identity"),
    )
    control = simulator.control(pins={"left": torch.tensor(cloth.vertices[[0, 4]]) + 1e-3})
    state = simulator.step(simulator.initial_state(), control)
    batch = simulator.step(simulator.initial_state(2))
    records = {
        "state": state,
        "batch": batch,
        "control": control,
        "parameters": simulator.parameters(),
    }
    path.with_suffix(".pkl").write_bytes(pickle.dumps({"simulator": simulator, **records}))
    torch.save(records, path.with_suffix(".pt"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
