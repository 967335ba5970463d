"""The page of a fit: one HTML file with embedded pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffcloth_torch.checks import FloatArray
from diffcloth_torch.extras import from_extra
from diffcloth_torch.files import replace_file
from diffcloth_torch.optimize.compared import Comparison, noting
from diffcloth_torch.optimize.misfit import Block
from diffcloth_torch.optimize.problem import Residuals, Trial, blocks_at
from diffcloth_torch.optimize.starts import Start

__all__ = ["Page", "write_page"]

_OBSERVED, _FIRST, _LAST = "#444444", "#c8553d", "#2a6f97"
_FRAMES = 4  # moments shown for each trajectory
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em;
       color: #222; }
h1, h2 { font-weight: 600; } h2 { margin-top: 2em; }
table { border-collapse: collapse; } td, th { padding: .25em .9em; text-align: right;
       border-bottom: 1px solid #ddd; } td:first-child, th:first-child { text-align: left; }
td.text { text-align: left; } img { max-width: 100%; }
"""


@dataclass(frozen=True, eq=False)
class Page:
    """Content of the page: fields of `Fit`, with `intervals` as sentences."""

    names: list[str]
    values: Mapping[str, Tensor]
    first: Mapping[str, Tensor]
    intervals: Mapping[str, str]
    correlation: FloatArray
    unidentifiable: list[str]
    collinear: list[str]
    blocks: Mapping[str, Block]
    noise_model: str
    rms: float
    message: str
    starts: Sequence[Start]
    history: Sequence[Trial]
    held_out: Sequence[float]
    residuals: Sequence[Residuals]


def write_page(path: Path, page: Page) -> None:
    """Evaluate the residuals at the first and the last values, draw, and write one file."""
    first, last = _compare(page, page.first), _compare(page, page.values)
    parts = [
        f"<p>{html.escape(page.message)} The residuals have a root mean square of "
        f"{page.rms:.3g}, in units of the noise that was "
        f"given; {len(page.history)} evaluations, "
        f"{sum(bool(trial.failure) for trial in page.history)} of which failed.</p>",
        "<h2>Values</h2>",
        _values(page),
        f"<p>The intervals are those of {page.noise_model}.</p>",
        *[f"<p>Cannot be told apart: {html.escape(text)}.</p>" for text in page.unidentifiable],
        *[f"<p>Nearly collinear: {html.escape(text)}.</p>" for text in page.collinear],
        "<h2>Residuals</h2>",
        _blocks(page),
    ]
    if len(page.names) > 1:
        parts += ["<h2>Correlation</h2>", _correlation(page)]
    for (title, before), (_, after) in zip(first, last, strict=True):
        parts += _trajectory(title, before, after)
    if page.held_out:
        errors = ", ".join(f"{error:.3g}" for error in page.held_out)
        parts += [
            "<h2>Kept out of the fit</h2>",
            "<p>Root mean square of the residuals of each trajectory, about one if the model is "
            f"right: {errors}.</p>",
        ]
    parts += ["<h2>Cost</h2>", _image(lambda figure: _costs(figure, page), (7.0, 3.2), "Cost")]
    parts += ["<h2>Starts</h2>", _starts(page)]
    text = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>Fit</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n<h1>Fit</h1>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )
    with replace_file(path) as part:
        part.write_text(text, encoding="utf-8")


def _compare(page: Page, values: Mapping[str, Tensor]) -> list[tuple[str, Comparison]]:
    """Titles and comparisons: fitted trajectories first, then trajectories kept out."""
    found = []
    for kind, residuals in zip(("Fitted", "Kept out of the fit"), page.residuals, strict=False):
        with torch.no_grad(), noting() as notes:
            names = [*blocks_at(residuals, values)]
        if len(names) != len(notes):
            names = [f"comparison {k}" for k in range(len(notes))]
        found += [(f"{kind}: {name}", n) for name, n in zip(names, notes, strict=True)]
    return found


def _values(page: Page) -> str:
    first = _numbers(page.first, page.names)
    last = _numbers(page.values, page.names)
    rows = [
        [name, f"{a:.6g}", f"{b:.6g}", page.intervals[name]]
        for name, a, b in zip(page.names, first, last, strict=True)
    ]
    return _table(["", "first", "found", "interval of 95 %"], rows)


def _blocks(page: Page) -> str:
    head = ["", "number", "root mean square", "chi2", "expected", "p-value", "autocorrelation"]
    rows = [
        [
            name,
            str(block.count),
            f"{block.rms:.3g}",
            f"{block.chi2:.4g}",
            f"{block.freedom:.4g}",
            "not known" if np.isnan(block.p_value) else f"{block.p_value:.2g}",
            f"{block.autocorrelation:+.2f}",
        ]
        for name, block in page.blocks.items()
    ]
    return _table(head, rows)


def _numbers(values: Mapping[str, Tensor], names: Sequence[str]) -> list[float]:
    """The fitted numbers, in the order of their names."""
    free = dict.fromkeys(name.partition("[")[0] for name in names)
    return [float(x) for name in free for x in values[name].flatten()]


def _correlation(page: Page) -> str:
    rows = [
        [name, *(f"{x:+.2f}" for x in row)]
        for name, row in zip(page.names, page.correlation, strict=True)
    ]
    return _table(["", *page.names], rows)


def _starts(page: Page) -> str:
    best = min(range(len(page.starts)), key=lambda k: page.starts[k].cost)
    rows = [
        [
            str(k),
            *(f"{x:.4g}" for x in _numbers(start.values, page.names)),
            f"{start.cost:.6g}",
            str(start.evaluations),
            "the best" if k == best else start.apart or "at the same place",
        ]
        for k, start in enumerate(page.starts)
    ]
    return _table(["start", *page.names, "cost", "evaluations", "where it ended"], rows)


def _trajectory(title: str, first: Comparison, last: Comparison) -> list[str]:
    distances = _distances(last)
    by_point = np.sqrt(np.nanmean(distances**2, axis=0))
    worst = int(np.nanargmax(by_point))
    noise = f"the noise was given as {1e3 * last.noise:.3g} mm"
    if _coordinates(last) > 1:
        noise += (
            f" for each coordinate, which is sqrt({_coordinates(last)}) times as much, "
            f"{1e3 * _expected(last):.3g} mm, for a distance"
        )
    return [
        f"<h2>{html.escape(title)} ({last.kind.replace('_', ' ')})</h2>",
        f"<p>The worst is {last.labels[worst]}: {1e3 * by_point[worst]:.3g} mm on average, "
        f"{1e3 * np.nanmax(distances[:, worst]):.3g} mm at most; {noise}.</p>",
        _image(lambda figure: _over_time(figure, first, last, worst), (7.0, 3.2), "Over time"),
        _image(lambda figure: _frames(figure, first, last), (9.0, 3.4), "Beside the observation"),
    ]


def _distances(compared: Comparison) -> FloatArray:
    """Distance of each point to its observation [m], shape [T, n]; NaN for unseen points."""
    found = np.full((len(compared.times), len(compared.labels)), np.nan)
    pairs = zip(compared.simulated, compared.observed, strict=True)
    for k, (simulated, observed) in enumerate(pairs):
        found[k, : len(simulated)] = np.linalg.norm(simulated - observed, axis=1)
    return found


def _coordinates(compared: Comparison) -> int:
    """Number of noisy coordinates of a point: outlines have noise along their rays only."""
    return 1 if compared.kind == "outline" else 3


def _expected(compared: Comparison) -> float:
    """Root mean square of a distance that is due to noise alone [m]."""
    return compared.noise * float(np.sqrt(_coordinates(compared)))


def _noise_band(compared: Comparison) -> FloatArray:
    """Interval of 95 % of the root mean square distance of each frame by noise alone, [2, T]."""
    from scipy.stats import chi2

    counts = (~np.isnan(_distances(compared))).sum(axis=1) * _coordinates(compared)
    shares = [[0.025], [0.975]]
    with np.errstate(invalid="ignore", divide="ignore"):
        band: FloatArray = _expected(compared) * np.sqrt(chi2.ppf(shares, counts) / counts)
    return band


def _over_time(figure: Any, first: Comparison, last: Comparison, worst: int) -> None:
    axes = figure.add_subplot()
    for compared, color, label in ((first, _FIRST, "first"), (last, _LAST, "found")):
        mean = np.sqrt(np.nanmean(_distances(compared) ** 2, axis=1))
        axes.plot(compared.times, 1e3 * mean, "o-", color=color, markersize=3, label=label)
    low, high = 1e3 * _noise_band(last)
    axes.fill_between(last.times, low, high, color=_OBSERVED, alpha=0.15, label="noise, 95 %")
    label = f"found, {last.labels[worst]}"
    axes.plot(last.times, 1e3 * _distances(last)[:, worst], ":", color=_LAST, label=label)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("distance [mm], root mean square")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def _frames(figure: Any, first: Comparison, last: Comparison) -> None:
    chosen = np.unique(np.linspace(0, len(last.times) - 1, _FRAMES).round().astype(int))
    u, v = _plane(last)
    for i, k in enumerate(chosen):
        axes = figure.add_subplot(1, len(chosen), i + 1)
        for points, style, color, label in (
            (last.observed[k], "x", _OBSERVED, "observed"),
            (first.simulated[k], ".", _FIRST, "first"),
            (last.simulated[k], ".", _LAST, "found"),
        ):
            axes.plot(points[:, u], points[:, v], style, color=color, markersize=4, label=label)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(f"{last.times[k]:.3g} s", fontsize=9)
        axes.set_xlabel(f"{'xyz'[u]} [m]", fontsize=8)
        axes.set_ylabel(f"{'xyz'[v]} [m]" if i == 0 else "", fontsize=8)
        axes.tick_params(labelsize=7)
    figure.axes[0].legend(frameon=False, fontsize=7)


def _plane(compared: Comparison) -> tuple[int, int]:
    """Indices of the two coordinates that vary most, for the view of the frames."""
    points = np.concatenate(compared.observed)
    order = np.argsort(np.nanmax(points, axis=0) - np.nanmin(points, axis=0), kind="stable")
    low, high = sorted(int(i) for i in order[-2:])
    return low, high


def _costs(figure: Any, page: Page) -> None:
    axes = figure.add_subplot()
    for k in range(len(page.starts)):
        costs = [trial.cost for trial in page.history if trial.start == k]
        axes.plot(costs, "o-", markersize=3, label=f"start {k}")
    axes.set_yscale("log")
    axes.set_xlabel("evaluation")
    axes.set_ylabel("half the sum of squares")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def _image(draw: Callable[[Any], None], size: tuple[float, float], name: str) -> str:
    from_extra("matplotlib", "fit", "the page of a fit needs Matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure)
    data = BytesIO()
    figure.savefig(data, format="png")
    encoded = base64.b64encode(data.getvalue()).decode("ascii")
    return f'<p><img alt="{name}" src="data:image/png;base64,{encoded}"></p>'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    titles = "".join(f"<th>{html.escape(text)}</th>" for text in head)
    lines = [
        "<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>" for row in rows
    ]
    return f"<table><tr>{titles}</tr>\n" + "\n".join(lines) + "</table>"
