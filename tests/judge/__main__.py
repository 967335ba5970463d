"""Judge results of optimizations: search for intersections in all states and on all paths.

    diffcloth optimize configs/push_cube.yaml --set output.viewers=[]
    python tests/judge results/push_cube

Plays the best actions of each folder that `diffcloth optimize` has written. The IPC Toolkit judges
every state and every segment of the solver's paths, with all bodies and links. Prints a line for
each folder; the exit status is 1 if anything intersects.
"""

from __future__ import annotations

import sys
from pathlib import Path

import click
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "physics"))

from physics_scenes import judge_attempt

from diffcloth_torch.tasks.registry import check_document, make_task


@click.command(help=__doc__.replace("\n\n    ", "\n\n\b\n    "))
@click.argument(
    "folders",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, path_type=Path, file_okay=False),
)
def main(folders: tuple[Path, ...]) -> None:
    """Judge each folder."""
    torch.set_num_threads(1)
    any_wrong = False
    for folder in folders:
        saved = torch.load(folder / "resume.pt", weights_only=True)
        source = Path(saved["source"])
        task = make_task(check_document(saved["config"], source), source)
        found = saved["found"]
        if found is None:
            raise click.ClickException(f"{folder} holds no finished iteration")
        wrong, touched = judge_attempt(task, found["best"]["actions"])
        click.echo(
            f"{folder.name}: best loss {found['best']['loss']:.3g} of {len(found['history'])} "
            f"iterations, {task.steps} steps, {touched} in contact, {len(wrong)} intersections"
        )
        for text in wrong:
            click.echo(f"  {text}")
        any_wrong |= bool(wrong)
    sys.exit(any_wrong)


if __name__ == "__main__":
    main()
