"""Tables of the benchmark of learning: rows of several seeds pooled."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from benchmarks.learning_methods import FROM_REWARDS, METHODS
from benchmarks.pages import around, share, table

MARKS = "<!-- methods -->\n", "<!-- end of methods -->\n"  # around the tables on a page
Rows = Sequence[Mapping[str, Any]]
# Columns of the first table by method: title, and attribute of `Pooled`.
_COLUMNS = {
    "replay": [("replay", "share")],
    "script": [("script", "share"), ("its return", "mean")],
    "imitate": [
        ("imitation", "share"),
        ("its return", "mean"),
        ("successes by seed", "by_seed"),
        ("steps", "steps"),
        ("minutes", "minutes"),
    ],
}
_NAMES = {"moves": "APG, steps of actions", "plan": "plans"}  # of methods, if not in capitals


@dataclass(frozen=True)
class Pooled:
    """Rows of a task, a size, a method and a budget, with all their seeds.

    Attributes:
        share: Successes of all episodes, with the Wilson interval.
        by_seed: Number of successes of each seed.
        mean: Mean of the returns.
        steps: Mean of the environment steps of learning.
        minutes: Mean processor time of learning [min].
    """

    share: str
    by_seed: str
    mean: str
    steps: str
    minutes: str


def pooled(rows: Rows) -> Pooled:
    """Pool rows that differ in their seeds."""
    count = sum(row["episodes"] for row in rows)
    done = sorted((row["seed"], round(row["success"] * row["episodes"])) for row in rows)
    return Pooled(
        share(sum(successes for _, successes in done), count),
        ", ".join(f"{seed}: {successes}" for seed, successes in done),
        f"{fmean(row['return'] for row in rows):.1f}",
        f"{fmean(row['steps'] for row in rows):,.0f}",
        f"{fmean(row['minutes'] for row in rows):.1f}",
    )


def tables(rows: Rows) -> str:
    """Two tables: imitation beside its teacher and at other sizes, and learning from rewards."""
    tasks = sorted({row["task"] for row in rows})
    return f"{_imitation(rows, tasks)}\n\n{_from_rewards(rows, tasks)}\n"


def _imitation(rows: Rows, tasks: Iterable[str]) -> str:
    sizes = sorted({row["size"] for row in rows if row["method"] == "transfer"})
    head = ["task", *(title for columns in _COLUMNS.values() for title, _ in columns)]
    lines = []
    for task in tasks:
        line = [f"`{task}`"]
        for method, columns in _COLUMNS.items():
            line += _cells(_of(rows, task, method), [name for _, name in columns])
        for size in sizes:
            line += _cells([r for r in _of(rows, task, "transfer") if r["size"] == size], ["share"])
        lines.append(line)
    return table([*head, *(f"{size} x {size}" for size in sizes)], lines)


def _from_rewards(rows: Rows, tasks: Iterable[str]) -> str:
    names = ("by_seed", "share", "mean", "steps", "minutes")
    lines = []
    for task in tasks:
        for method in (*FROM_REWARDS, "plan"):
            mine = _of(rows, task, method)
            for budget in sorted({row["budget"] for row in mine}):
                same = [row for row in mine if row["budget"] == budget]
                lines.append(
                    [f"`{task}`", _NAMES.get(method, method.upper()), *_cells(same, names)]
                )
    head = ["task", "method", "successes by seed", "success", "return", "steps", "minutes"]
    return table(head, lines)


def _of(rows: Rows, task: str, method: str) -> Rows:
    return [row for row in rows if (row["task"], row["method"]) == (task, method)]


def _cells(rows: Rows, names: Sequence[str]) -> list[str]:
    """Values of pooled rows; nothing for values that were not measured."""
    found = pooled(rows) if rows else None
    return [str(getattr(found, name)) if found else "" for name in names]


def with_tables(text: str, rows: Rows) -> str:
    """The text of a page with the tables between the lines `MARKS`."""
    begin, end = MARKS
    before, _, after = around(text, begin, end)
    return "".join([before, begin, tables(rows), end, after])


def listing(rows: Rows) -> str:
    """A table of all rows."""
    head = ["task", "size", "method", "seed", "success", "return", "steps", "minutes", "revision"]
    lines = [
        [
            *(str(row[name]) for name in ("task", "size", "method", "seed")),
            *_cells([row], ("share", "mean", "steps", "minutes")),
            row["revision"],
        ]
        for row in sorted(rows, key=lambda r: (r["task"], METHODS.index(r["method"]), r["seed"]))
    ]
    return table(head, lines)
