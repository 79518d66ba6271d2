"""Adam by kernels against PyTorch's."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from outlap.mql.adam import CHUNK, Adam
from outlap.mql.torch_threads import ROWS_OF_THREAD

SHAPES = [(2, 3), (1,), (40, 2 * CHUNK // 40 + 7), (CHUNK,), (), (2 * ROWS_OF_THREAD, CHUNK + 1)]  # for two threads


def parameters() -> list[nn.Parameter]:
    return [nn.Parameter(torch.randn(shape)) for shape in SHAPES]


def twins() -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The same twice, the second time in float64."""
    first = parameters()
    return first, [nn.Parameter(p.detach().double()) for p in first]


def give_gradients(ours: list[nn.Parameter], theirs: list[nn.Parameter], size: float) -> None:
    for p, q in zip(ours, theirs, strict=True):
        p.grad = size * torch.randn_like(p) * (torch.rand_like(p) < 0.9)  # a unit that is dead has 0
        q.grad = p.grad.to(torch.float64, copy=True)


def reference_step(optimizer: torch.optim.Optimizer, max_norm: float) -> Tensor:
    norm = nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], max_norm)
    optimizer.step()
    return norm


def check_equal(ours: list[nn.Parameter], theirs: list[nn.Parameter]) -> None:
    for p, q in zip(ours, theirs, strict=True):
        torch.testing.assert_close(p.double(), q, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("threads", [1, 2])
def test_steps_are_those_of_pytorch_in_float64(threads: int) -> None:
    torch.manual_seed(0)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        ours, theirs = twins()
        optimizer, reference = Adam(ours, 0.01), torch.optim.Adam(theirs, lr=0.01)
        for k in range(20):
            give_gradients(ours, theirs, size=0.01 if k % 3 else 1.0)  # of norms below and above the limit
            torch.testing.assert_close(optimizer.step_clipped(10.0).double(), reference_step(reference, 10.0))
            check_equal(ours, theirs)
    finally:
        torch.set_num_threads(before)


def test_the_state_is_pytorchs_and_can_be_taken_up_by_it_and_from_it() -> None:
    torch.manual_seed(0)
    ours, theirs = twins()
    optimizer, reference = Adam(ours, 0.01), torch.optim.Adam(theirs, lr=0.01)
    for turn in range(4):
        give_gradients(ours, theirs, 0.1)
        optimizer.step_clipped(1.0)
        reference_step(reference, 1.0)
        saved, expected = optimizer.state_dict()["state"], reference.state_dict()["state"]
        assert saved.keys() == expected.keys()
        for number, state in saved.items():
            assert state.keys() == expected[number].keys()
            for name, value in state.items():
                right = expected[number][name].double()
                torch.testing.assert_close(value.double(), right, rtol=1e-5, atol=1e-6 * right.abs().max().item())
        given = copy.deepcopy(optimizer.state_dict() if turn % 2 else reference.state_dict())
        optimizer, reference = Adam(ours, 0.01), torch.optim.Adam(theirs, lr=0.01)
        optimizer.load_state_dict(copy.deepcopy(given))
        reference.load_state_dict(given)
        reference.param_groups[0]["fused"] = None
    check_equal(ours, theirs)


def test_a_parameter_without_gradient_stays_and_is_not_counted() -> None:
    torch.manual_seed(0)
    ours, theirs = twins()
    optimizer, reference = Adam(ours, 0.01), torch.optim.Adam(theirs, lr=0.01)
    for without in (0, 2, 2):
        give_gradients(ours, theirs, 0.1)
        ours[without].grad = theirs[without].grad = None
        optimizer.step_clipped(10.0)
        reference_step(reference, 10.0)
    check_equal(ours, theirs)
    assert [optimizer.state[p]["step"].item() for p in ours[:3]] == [2.0, 3.0, 1.0]
    for p in ours:
        p.grad = None
    assert optimizer.step_clipped(10.0) == 0.0


def test_a_gradient_may_lie_in_any_order() -> None:
    torch.manual_seed(0)
    ours, theirs = twins()
    optimizer, reference = Adam(ours, 0.01), torch.optim.Adam(theirs, lr=0.01)
    give_gradients(ours, theirs, 0.1)
    ours[0].grad = theirs[0].grad.float().t().contiguous().t()  # type: ignore[union-attr]
    assert not ours[0].grad.is_contiguous()
    optimizer.step_clipped(10.0)
    reference_step(reference, 10.0)
    check_equal(ours, theirs)


def test_nan_goes_to_all_parameters() -> None:
    ours = parameters()
    for p in ours:
        p.grad = torch.ones_like(p)
    ours[0].grad[1, 1] = float("nan")  # type: ignore[index]
    assert Adam(ours, 0.01).step_clipped(10.0).isnan()
    assert all(p.isnan().all() for p in ours)


def test_an_endless_gradient_is_clipped_as_by_pytorch() -> None:
    torch.manual_seed(0)
    ours, theirs = twins()
    give_gradients(ours, theirs, 1.0)
    ours[0].grad[1, 1] = theirs[0].grad[1, 1] = float("inf")  # type: ignore[index]
    before = copy.deepcopy(ours)
    assert Adam(ours, 0.01).step_clipped(10.0).isinf()
    reference_step(torch.optim.Adam(theirs, lr=0.01), 10.0)
    for p, q in zip(ours, theirs, strict=True):
        torch.testing.assert_close(p.double(), q, equal_nan=True)
    assert torch.equal(ours[2], before[2])


def test_a_graph_of_parameters_before_the_step_cannot_be_gone_back_through() -> None:
    ours = [nn.Parameter(torch.ones(4))]
    loss = ours[0].square().sum()
    loss.backward(retain_graph=True)
    Adam(ours, 0.01).step_clipped(10.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def _in_float64(p: nn.Parameter, optimizer: torch.optim.Adam) -> None:
    p.data = p.data.double()


def _with_steps_in_float64(p: nn.Parameter, optimizer: torch.optim.Adam) -> None:
    optimizer.state[p] = {
        "step": torch.zeros((), dtype=torch.float64),
        "exp_avg": torch.zeros_like(p),
        "exp_avg_sq": torch.zeros_like(p),
    }
    optimizer.param_groups[0]["fused"] = None


def _with_weight_decay(p: nn.Parameter, optimizer: torch.optim.Adam) -> None:
    optimizer.param_groups[0]["weight_decay"] = 0.1


@pytest.mark.parametrize("change", [_in_float64, _with_steps_in_float64, _with_weight_decay])
def test_what_the_kernels_cannot_take_goes_to_pytorch(change) -> None:
    torch.manual_seed(0)
    ours = parameters()
    theirs = copy.deepcopy(ours)
    optimizer, reference = Adam(ours, 0.01), torch.optim.Adam(theirs, lr=0.01)
    for p, q in zip(ours, theirs, strict=True):
        change(p, optimizer)
        change(q, reference)
    for _ in range(3):
        for p, q in zip(ours, theirs, strict=True):
            p.grad = torch.randn_like(p)
            q.grad = p.grad.clone()
        torch.testing.assert_close(optimizer.step_clipped(1.0), reference_step(reference, 1.0))
        for p, q in zip(ours, theirs, strict=True):
            torch.testing.assert_close(p, q, rtol=1e-6, atol=1e-6)
