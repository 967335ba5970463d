"""The loss curve of an optimization."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import replace_file

__all__ = ["draw_loss_curve", "require_matplotlib"]

_COLOR, _BEST_COLOR = "#2a6f97", "#c8553d"


def require_matplotlib() -> None:
    """Check that curves can be drawn.

    Raises:
        InvalidInput: If Matplotlib is not installed; the message names the extra.
    """
    from_extra("matplotlib", "viewer", "curves need Matplotlib")


def draw_loss_curve(path: Path, losses: Sequence[float], *, label: str = "loss") -> None:
    """Draw losses over iterations, and the best so far, to an image file.

    Args:
        path: Image file.
        losses: Loss of each iteration.
        label: Text at the vertical axis.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    iterations = np.arange(len(losses))
    axes.plot(iterations, losses, "o-", color=_COLOR, markersize=3.5, linewidth=1.5, label="loss")
    best = np.minimum.accumulate(losses)
    axes.step(iterations, best, where="post", color=_BEST_COLOR, linewidth=1.0, label="best so far")
    axes.set_xlabel("iteration")
    axes.set_ylabel(label)
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    with replace_file(path) as part:
        figure.savefig(part, format=path.suffix[1:])
