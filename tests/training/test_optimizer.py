"""RowAdam is torch's Adam on the rows that are stepped, and does not touch the others."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from clod_adapter.training.optimizer import RowAdam, add_to_mean

SHAPES = {"means": (3,), "quats": (4,), "opacity_logits": (), "sh0": (1, 3), "shN": (8, 3)}


class PlainRowAdam(RowAdam):
    """Always takes the plain way."""

    def _step_fused(self, gradients: dict[str, Tensor], rows: Tensor, rates: dict[str, float]) -> None:
        self._step_plain(gradients, rows, rates)


def parameters(n: int, seed: int = 0) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {name: torch.randn(n, *shape, generator=g) for name, shape in SHAPES.items()}


def gradients(n: int, seed: int) -> dict[str, Tensor]:
    """Over many orders of magnitude, and some zeros."""
    g = torch.Generator().manual_seed(seed)
    out = {}
    for name, shape in SHAPES.items():
        size = 10 ** (8 * torch.rand(n, *[1] * len(shape), generator=g) - 6)
        out[name] = torch.randn(n, *shape, generator=g) * size * (torch.rand(n, *shape, generator=g) > 0.1)
    return out


def rates(rate: float) -> dict[str, float]:
    return dict.fromkeys(SHAPES, rate)


def everything(n: int) -> Tensor:
    return torch.ones(n, dtype=torch.bool)


@pytest.mark.parametrize("seed", range(3))
def test_fused_is_plain(seed: int, n: int = 203) -> None:
    """Different rows each step."""
    fused, plain = RowAdam(parameters(n)), PlainRowAdam(parameters(n))
    g = torch.Generator().manual_seed(seed)
    for step in range(8):
        rows = torch.rand(n, generator=g) < torch.rand((), generator=g)
        for optimizer in (fused, plain):
            optimizer.step(gradients(n, 100 * seed + step), rows, rates(0.01))
    start = parameters(n)
    for name in SHAPES:
        moved = (fused.parameters[name] - start[name]).abs()
        assert (moved > 0.01).any()
        torch.testing.assert_close(
            fused.parameters[name], plain.parameters[name], rtol=1e-6, atol=1e-6, msg=lambda m: f"seed {seed}: {m}"
        )


def test_all_rows_is_torch_s_adam(n: int = 57) -> None:
    ours, theirs = parameters(n), {name: p.requires_grad_() for name, p in parameters(n).items()}
    optimizer = RowAdam(ours)
    adam = torch.optim.Adam(theirs.values(), lr=0.02, betas=(0.9, 0.999), eps=1e-15)
    for step in range(12):
        optimizer.step(gradients(n, step), everything(n), rates(0.02))
        for name, gradient in gradients(n, step).items():
            theirs[name].grad = gradient
        adam.step()
    for name in SHAPES:
        torch.testing.assert_close(ours[name], theirs[name].detach(), rtol=2e-6, atol=2e-6)


def test_betas_and_epsilon_are_used(n: int = 20) -> None:
    ours, theirs = parameters(n)["means"], parameters(n)["means"].requires_grad_()
    optimizer = RowAdam({"means": ours}, beta1=0.5, beta2=0.7, epsilon=1e-2)
    adam = torch.optim.Adam([theirs], lr=0.02, betas=(0.5, 0.7), eps=1e-2)
    for step in range(5):
        theirs.grad = gradients(n, step)["means"]
        optimizer.step({"means": theirs.grad}, everything(n), {"means": 0.02})
        adam.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
def test_other_rows_keep_every_bit(kind: type[RowAdam], n: int = 40) -> None:
    values = parameters(n)
    values["means"][5] = torch.nan
    optimizer = kind(values)
    before = {name: value.clone().view(torch.int32) for name, value in values.items()}
    rows = torch.zeros(n, dtype=torch.bool)
    rows[[31, 2, 17]] = True
    others = ~rows
    for step in range(3):
        optimizer.step({name: gradient + 1 for name, gradient in gradients(n, step).items()}, rows, rates(0.1))
    for name, value in values.items():
        assert optimizer.parameters[name] is value  # in place
        assert torch.equal(value.view(torch.int32)[others], before[name][others]), name
        assert (value.view(torch.int32)[rows] != before[name][rows]).all(), name


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
def test_the_leading_rows_of_larger_tensors(kind: type[RowAdam], n: int = 30) -> None:
    """They are stepped as on their own, and what lies behind them keeps every bit."""
    larger, own = parameters(n + 11), parameters(n + 11)
    behind = {name: value[n:].clone() for name, value in larger.items()}
    optimizers = (
        kind({name: value[:n] for name, value in larger.items()}),
        kind({k: v[:n].clone() for k, v in own.items()}),
    )
    for step in range(3):
        rows = torch.arange(n) % (step + 2) == 0
        for optimizer in optimizers:
            optimizer.step(gradients(n, step), rows, rates(0.05))
    for name, value in larger.items():
        assert torch.equal(value[:n], optimizers[1].parameters[name]) and torch.equal(value[n:], behind[name])
        assert not torch.equal(value[:n], own[name][:n])


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
def test_what_a_gradient_holds_in_other_rows_does_not_matter(kind: type[RowAdam], n: int = 30) -> None:
    rows, results = torch.arange(n) % 3 == 0, []
    for filler in (0.0, torch.nan, torch.inf):
        optimizer = kind(parameters(n))
        for step in range(2):
            given = {
                k: v.masked_fill(~rows.view(-1, *[1] * (v.dim() - 1)), filler) for k, v in gradients(n, step).items()
            }
            optimizer.step(given, rows, rates(0.05))
        results.append(optimizer)
    for other in results[1:]:
        for mine, want in zip(other.state().values(), results[0].state().values(), strict=True):
            assert all(torch.equal(mine[name], want[name]) for name in want)
        assert all(torch.equal(other.parameters[name], results[0].parameters[name]) for name in SHAPES)


@pytest.mark.parametrize("kind", [RowAdam, PlainRowAdam])
@pytest.mark.parametrize("size", [1e-8, 1e-3, 1.0, 1e6])
def test_a_first_step_is_as_long_as_the_rate(kind: type[RowAdam], size: float) -> None:
    """Whatever the gradient's size, and however many steps other rows have had."""
    values = torch.zeros(10, 3)
    optimizer = kind({"means": values})
    rows = torch.arange(10) < 5
    for _ in range(5):
        optimizer.step({"means": torch.ones(10, 3)}, rows, {"means": 0.01})
    gradient = size * torch.tensor([1.0, -1.0, 0.0]).repeat(10, 1)
    optimizer.step({"means": gradient}, ~rows, {"means": 0.25})
    torch.testing.assert_close(values[5:], torch.tensor([-0.25, 0.25, 0.0]).repeat(5, 1), rtol=1e-5, atol=0)


def test_rows_and_threads_do_not_matter_to_a_row(n: int = 100) -> None:
    """A row's value does not depend on which rows are stepped beside it, nor on who steps it."""
    gradient = gradients(n, 0)["shN"]
    g, before = torch.Generator().manual_seed(0), torch.get_num_threads()
    results = []
    for count, some in [(1, everything(n)), (2, everything(n)), (3, torch.rand(n, generator=g) < 0.6)]:
        torch.set_num_threads(count)
        try:
            optimizer = RowAdam(parameters(n))
            for _ in range(3):
                optimizer.step({"shN": gradient}, some, {"shN": 0.01})
        finally:
            torch.set_num_threads(before)
        results.append(optimizer.parameters["shN"])
    assert torch.equal(results[0], results[1]) and torch.equal(results[0][some], results[2][some])


def test_bias_corrections_end(n: int = 20) -> None:
    """Past the last that is stored, here the 79th, they count as 1."""
    ours, theirs = parameters(n)["means"], parameters(n)["means"].requires_grad_()
    optimizer = RowAdam({"means": ours}, beta1=0.5, beta2=0.8)
    adam = torch.optim.Adam([theirs], lr=0.02, betas=(0.5, 0.8), eps=1e-15)
    for step in range(220):
        theirs.grad = gradients(n, step)["means"]
        optimizer.step({"means": theirs.grad}, everything(n), {"means": 0.02})
        adam.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-5, atol=1e-5)


def test_no_rows() -> None:
    for n in (4, 0):
        optimizer = RowAdam(parameters(n))
        optimizer.step(gradients(n, 0), torch.zeros(n, dtype=torch.bool), rates(0.1))
        for name, value in parameters(n).items():
            assert torch.equal(optimizer.parameters[name], value)


def test_no_columns() -> None:
    """shN of a checkpoint of SH degree 0."""
    optimizer = RowAdam({"shN": torch.empty(4, 0, 3)})
    optimizer.step({"shN": torch.empty(4, 0, 3)}, everything(4), {"shN": 0.1})
    assert optimizer.parameters["shN"].shape == (4, 0, 3)


def test_the_mean_is_one(n: int = 9) -> None:
    """Of finite values; an infinite one is its own."""
    mean: dict[str, Tensor] = {}
    all_values = [torch.randn(n, 3, generator=torch.Generator().manual_seed(k)) for k in range(4)]
    for count, values in enumerate(all_values, 1):
        values[2, 1], values[5, 0] = math.inf, -math.inf
        add_to_mean(mean, {"any": values}, count)
    assert mean["any"] is not all_values[0]
    torch.testing.assert_close(mean["any"], torch.stack(all_values).mean(0))
