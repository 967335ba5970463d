"""Undocumented functions of torch against the public behavior that they represent."""

import subprocess
import sys

import pytest
import torch
from torch.autograd import forward_ad

from diffcloth_torch.autograd import torch_private

X = torch.arange(6.0, dtype=torch.float64).reshape(3, 2)


def inside(transform):
    """Observations inside a transform: its activity, the stack, and the wrapper of an argument."""
    seen = []

    def function(x):
        inner, axis = torch_private.unwrap(x)
        seen.append((torch_private.transforms(), axis, inner.shape))
        assert torch_private.in_transform()
        assert torch_private.is_wrapped(x)
        with torch_private.outside_transforms():
            assert not torch_private.in_transform()
        assert torch_private.in_transform()
        return (x * x).sum()

    transform(function)(X)
    return seen[0]


@pytest.mark.parametrize(
    ("transform", "stack", "axis", "shape"),
    [
        pytest.param(torch.func.grad, [True], None, (3, 2), id="grad"),
        pytest.param(torch.func.jacrev, [True], None, (3, 2), id="jacrev"),
        pytest.param(torch.vmap, [False], 0, (3, 2), id="vmap"),
        pytest.param(lambda f: torch.vmap(f, in_dims=1), [False], 1, (3, 2), id="vmap-axis-1"),
        pytest.param(
            lambda f: torch.vmap(torch.func.grad(f)), [False, True], None, (2,), id="both"
        ),
    ],
)
def test_transforms_and_their_wrappers(transform, stack, axis, shape):
    assert inside(transform) == (stack, axis, shape)


def test_a_tensor_outside_of_transforms_is_not_wrapped():
    assert not torch_private.in_transform()
    assert torch_private.transforms() == []
    assert not torch_private.is_wrapped(X)


def test_forward_mode():
    assert not torch_private.in_forward_mode()
    with forward_ad.dual_level():
        assert torch_private.in_forward_mode()
    assert not torch_private.in_forward_mode()
    seen = []
    torch.func.jvp(lambda x: seen.append(torch_private.in_forward_mode()) or x, (X,), (X,))
    assert seen == [True]


class Cube(torch.autograd.Function):
    """x^3, whose tangent is computed from dual numbers."""

    allows = True
    generate_vmap_rule = True

    @staticmethod
    def forward(x):
        return x**3

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_forward(*inputs)

    @staticmethod
    def jvp(ctx, change):
        (x,) = ctx.saved_tensors
        if not Cube.allows:
            return 3 * x**2 * change
        with torch_private.with_tangents():
            return 3 * forward_ad.unpack_dual(x).primal ** 2 * change


@pytest.mark.parametrize("allows", [True, False])
def test_tangents_of_tangents(allows, monkeypatch):
    """Without the function, torch loses the tangent of a tangent."""
    monkeypatch.setattr(Cube, "allows", allows)
    x = torch.tensor(2.0, dtype=torch.float64)
    one = torch.ones_like(x)

    def first(at):
        return torch.func.jvp(Cube.apply, (at,), (one,))[1]

    _, second = torch.func.jvp(first, (x,), (one,))
    assert (second.item() == 12.0) is allows


class Watched(torch.autograd.Function):
    """The identity; backward records the cotangent's rows and returns twice the cotangent."""

    rows = None

    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, cotangent):
        assert torch_private.is_batched_by_older_vmap(cotangent)
        rows = torch_private.without_older_axis(cotangent)
        fixed = torch_private.without_older_axis(X[0], len(rows))
        assert torch.equal(fixed, X[:1].expand(len(rows), 2))
        Watched.rows = rows.clone()
        return torch_private.with_older_axis(2 * rows)


def test_axis_of_the_older_vmap():
    x = X[0].clone().requires_grad_()
    (gradients,) = torch.autograd.grad(
        Watched.apply(x), x, grad_outputs=X.clone(), is_grads_batched=True
    )
    assert torch.equal(Watched.rows, X)
    assert torch.equal(gradients, 2 * X)
    assert not torch_private.is_batched_by_older_vmap(X)


class Pair:
    """Two branches with names, and a note that is none."""

    def __init__(self, left, right, note):
        self.left, self.right, self.note = left, right, note


def test_a_class_becomes_a_tree():
    torch_private.register_tree(
        Pair,
        lambda pair: ([pair.left, pair.right], pair.note),
        lambda branches, note: Pair(*branches, note),
        lambda _note: ("left", "right"),
    )
    doubled = torch.utils._pytree.tree_map(lambda x: 2 * x, {"pair": Pair(1, [2, 3], "kept")})
    assert vars(doubled["pair"]) == {"left": 2, "right": [4, 6], "note": "kept"}
    paths, _ = torch.utils._pytree.tree_flatten_with_path(Pair(1, [2, 3], ""))
    assert [torch.utils._pytree.keystr(path) for path, _ in paths] == [
        ".left",
        ".right[0]",
        ".right[1]",
    ]
    x = torch.ones(3)
    total = torch.vmap(lambda pair: pair.left + pair.right)(Pair(x, x, ""))
    assert torch.equal(total, 2 * x)


def test_a_class_is_collated():
    class Note(str):
        """Text, which is collated as a list without this."""

    torch_private.register_collate(Note, lambda notes: "".join(notes))
    batch = torch.utils.data.default_collate([{"note": Note("a")}, {"note": Note("b")}])
    assert batch == {"note": "ab"}


@pytest.mark.slow
def test_lines_that_are_not_compiled():
    """Functions called from an uncompiled function are still compiled."""
    import torch._dynamo

    sizes = []

    def backend(graph, _inputs):
        sizes.append(sum(node.op == "call_function" for node in graph.graph.nodes))
        return graph

    def double(x):
        return 2 * x

    def outer(x):
        return double(x) + 1

    def run():
        assert torch.equal(torch.compile(outer, backend=backend)(X), 2 * X + 1)

    torch._dynamo.reset()
    run()
    torch._dynamo.reset()
    torch_private.compile_nothing_in(outer)
    run()
    torch._dynamo.reset()
    assert sizes == [2, 1]


@pytest.mark.slow
def test_the_compiler_is_seen_once_it_is_imported():
    code = (
        "from diffcloth_torch.autograd.torch_private import has_compiler\n"
        "before = has_compiler()\n"
        "import torch._dynamo\n"
        "print(before, has_compiler())"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split()[-1] == "True"
