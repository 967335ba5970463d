"""Drape a mesh of your own over another one: the Python form of `diffcloth run`.

python examples/drape_own_mesh.py CLOTH.obj BODY.ply
"""

from __future__ import annotations

from pathlib import Path

import click

import diffcloth_torch as dc


@click.command()
@click.argument("cloth_path", type=click.Path(exists=True, path_type=Path))
@click.argument("body_path", type=click.Path(exists=True, path_type=Path))
@click.option("--height", default=0.0, help="How far to lift the cloth before it falls [m].")
@click.option("--steps", default=100, help="Steps of 0.01 s.")
@click.option("--out", default="draped.obj", type=click.Path(path_type=Path, dir_okay=False))
def main(cloth_path: Path, body_path: Path, height: float, steps: int, out: Path) -> None:
    """Drop CLOTH_PATH onto BODY_PATH and write the draped cloth."""
    cloth = dc.Cloth.load(cloth_path, pose=[0, 0, height, 1, 0, 0, 0])
    simulator = dc.Simulator(dc.Scene([cloth], [dc.RigidBody.load(body_path)]), dt=0.01)
    states = simulator.rollout(simulator.initial_state(), steps=steps)
    states[-1].export(out)
    print(f"{out}: {states[-1].report.contact_count} contacts")


if __name__ == "__main__":
    main()
