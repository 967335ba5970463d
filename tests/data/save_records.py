"""Save one of each kind of record, with the version that is installed, for later versions to load.

    python tests/data/save_records.py tests/data/saved_0_1

wrote `saved_0_1.pkl` and `saved_0_1.pt` with commit 1426a16, before modules had their place of
today.
"""

import pickle
import sys
from pathlib import Path

import torch

import diffcloth_torch as dc

GRIPPER = Path(dc.__file__).parent / "robots" / "gripper.urdf"


def scene() -> dc.Scene:
    """A woven sheet on a box, an attachment to it, and a gripper."""
    sheet = dc.Cloth.grid(
        4,
        4,
        (0.3, 0.3),
        material=dc.fabrics.material("denim", friction=0.3),
        pins={"left": [0, 4]},
        soft_pins={"right": [3]},
        name="sheet",
    )
    box = dc.RigidBody.box(0.1, motion="kinematic", pose=[0, 0, -0.058, 1, 0, 0, 0], name="box")
    ball = dc.RigidBody.sphere(
        0.05,
        motion="dynamic",
        mass=0.1,
        smooth=True,
        pose=[1, 0, 0, 1, 0, 0, 0],
        name="ball",
    )
    hand = dc.Robot.load(GRIPPER, pose=[0, 1, 0, 1, 0, 0, 0], stiffness=100.0, name="hand")
    seam = dc.Attachment(("sheet", [12]), ("box", [[0.05, 0.05, 0.05]]), stiffness=10.0)
    return dc.Scene([sheet], [box, ball], [hand], attachments=[seam])


def main(path: Path) -> None:
    """Write both files."""
    simulator = dc.Simulator(
        scene(),
        0.01,
        coupling="monolithic",
        contact=dc.ContactOptions(friction_iterations=1),
        solver=dc.SolverOptions(tolerance=1e-7),
    )
    sheet = simulator.scene.cloths[0]
    control = simulator.control(pins={"left": torch.tensor(sheet.vertices[[0, 4]]) + 1e-3})
    state = simulator.step(simulator.initial_state(), control)
    batch = simulator.step(simulator.initial_state(2))
    records = {
        "state": state,
        "batch": batch,
        "control": control,
        "parameters": simulator.parameters(),
        "contacts": simulator.contacts(state),
    }
    path.with_suffix(".pkl").write_bytes(pickle.dumps({"simulator": simulator, **records}))
    torch.save(records, path.with_suffix(".pt"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
