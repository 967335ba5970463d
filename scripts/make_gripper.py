#!/usr/bin/env python3
"""Write diffcloth_torch/robots/gripper.urdf: a palm and two fingers that slide towards each other.

At zero the fingers are open. All parts are boxes of uniform density; z points from the palm to the
finger tips.
"""

from __future__ import annotations

from pathlib import Path

PATH = Path(__file__).resolve().parent.parent / "diffcloth_torch" / "robots" / "gripper.urdf"

# Sizes along x, y, z [m] and masses [kg]. The pads are 2 cm wide, to hold the edge of a cloth by
# two or three of its vertices, some centimeters apart.
PALM, PALM_MASS = (0.04, 0.13, 0.03), 0.4
FINGER, FINGER_MASS = (0.02, 0.01, 0.05), 0.03
OPENING = 0.08  # between the pads of open fingers [m]
CLOSED = 0.001  # between the pads of closed fingers: prescribed pads never cross [m]
GAP = 0.001  # between palm and fingers [m]


def numbers(*values: float) -> str:
    """Write numbers in their shortest form that is exact to 12 digits."""
    return " ".join(f"{value:.12g}" for value in values)


def link(name: str, size: tuple[float, float, float], mass: float) -> str:
    """Make a box whose frame is in the middle of the side that faces -z."""
    x, y, z = size
    moments = [mass / 12 * (a * a + b * b) for a, b in ((y, z), (x, z), (x, y))]
    ixx, iyy, izz = (numbers(moment) for moment in moments)
    origin = f'<origin xyz="{numbers(0, 0, z / 2)}" rpy="0 0 0"/>'
    box = f'<geometry><box size="{numbers(x, y, z)}"/></geometry>'
    return f"""\
  <link name="{name}">
    <inertial>
      {origin}
      <mass value="{numbers(mass)}"/>
      <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>
    </inertial>
    <visual>{origin}{box}</visual>
    <collision>{origin}{box}</collision>
  </link>
"""


def joint(side: str, sign: int) -> str:
    """Make the joint of a finger on the side of y with this sign; larger values close it."""
    y = sign * (OPENING + FINGER[1]) / 2
    return f"""\
  <joint name="{side}_finger_joint" type="prismatic">
    <origin xyz="{numbers(0, y, PALM[2] + GAP)}" rpy="0 0 0"/>
    <parent link="palm"/>
    <child link="{side}_finger"/>
    <axis xyz="0 {-sign} 0"/>
    <limit lower="0" upper="{numbers((OPENING - CLOSED) / 2)}" effort="0" velocity="0"/>
  </joint>
"""


def gripper() -> str:
    """Make the text of the file."""
    fingers = [
        link(f"{side}_finger", FINGER, FINGER_MASS) + joint(side, sign)
        for side, sign in (("left", 1), ("right", -1))
    ]
    return (
        '<?xml version="1.0"?>\n<!-- Made by scripts/make_gripper.py. -->\n'
        '<robot name="gripper">\n' + link("palm", PALM, PALM_MASS) + "".join(fingers) + "</robot>\n"
    )


if __name__ == "__main__":
    PATH.write_text(gripper(), encoding="utf-8")
