"""Functions that save their inputs only and recompute piece by piece: the autograd wiring that sampled techniques share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

Outputs = tuple[Tensor, ...]


class Kernel(Protocol):
    """A map of batched tensors whose derivatives it computes itself; plain tensors come in, with no graph.

    Tensors have the batch as first dimension (or are None); vmapped dimensions are folded into it. Constants that no
    one differentiates or maps over live in the kernel.
    """

    @property
    def name(self) -> str:
        """The public function's, for error messages."""

    def value(self, *tensors: Tensor | None) -> Outputs:
        """The output and, after it, what the derivatives want to find again (not differentiable)."""

    def pull_back(
        self, grad: Tensor, needed: Sequence[bool], outputs: Outputs, *tensors: Tensor | None
    ) -> list[Tensor]:
        """Cotangents of the needed tensors, in their order."""

    def push_forward(self, tangents: Sequence[Tensor | None], outputs: Outputs, *tensors: Tensor | None) -> Tensor:
        """Tangent of the output."""


@torch.compiler.disable
def recompute(kernel: Kernel, *tensors: Tensor | None) -> Tensor:
    """Apply a kernel: reverse mode, forward mode and vmap work, second derivatives raise a RuntimeError.

    `torch.compile` leaves it as it is, with a graph break: unrolled, its loops would compile for minutes.

    Args:
        kernel: see `Kernel`.
        tensors: batch first, or None.
    Returns: the kernel's output.
    Gradients: by the kernel, for every floating tensor.
    """
    return _Recompute.apply(kernel, *tensors)[0]


def pull_back(
    function: Callable[..., Outputs], inputs: Sequence[Tensor], cotangents: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Cotangents of the inputs of a piece, by recording it now."""
    with torch.enable_grad():
        leaves = [tensor.detach().requires_grad_() for tensor in inputs]
        return torch.autograd.grad(function(*leaves), leaves, cotangents, materialize_grads=True)


def push_forward(
    function: Callable[..., Outputs], inputs: Sequence[Tensor], tangents: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Tangents of the outputs of a piece.

    The pull-back is linear in its cotangents, so its own derivative to them is the push-forward. Unlike dual numbers
    this works inside any nesting of forward mode.
    """
    with torch.enable_grad():
        leaves = [tensor.detach().requires_grad_() for tensor in inputs]
        outputs = function(*leaves)
        cotangents = [torch.zeros_like(output).requires_grad_() for output in outputs]
        pulled = torch.autograd.grad(outputs, leaves, cotangents, create_graph=True, materialize_grads=True)
        return torch.autograd.grad(pulled, cotangents, list(tangents), materialize_grads=True)


def _fold(size: int, dims: Sequence[int | None], arguments: Sequence[Any]) -> list[Any]:
    """Move the mapped dimension of every tensor into its batch."""
    folded = []
    for dim, argument in zip(dims, arguments, strict=True):
        if not isinstance(argument, Tensor):
            folded.append(argument)
            continue
        mapped = argument.expand(size, *argument.shape) if dim is None else argument.movedim(dim, 0)
        folded.append(mapped.flatten(0, 1))
    return folded


class _Folding(torch.autograd.Function):
    """vmap by folding the mapped dimension into the batch, so that kernels only ever see plain tensors."""

    @classmethod
    def vmap(cls, info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Outputs, tuple[int, ...]]:
        outputs = cls.apply(*_fold(info.batch_size, in_dims, arguments))
        outputs = tuple(output.unflatten(0, (info.batch_size, -1)) for output in outputs)
        return outputs, (0,) * len(outputs)


class _Recompute(_Folding):
    @staticmethod
    def forward(kernel: Kernel, *tensors: Tensor | None) -> Outputs:
        return kernel.value(*tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Outputs) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.kernel, ctx.outputs = inputs[0], len(output)
        ctx.save_for_backward(*inputs[1:], *output)
        ctx.save_for_forward(*inputs[1:], *output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *unused: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[1:]
        grads = iter(_PullBack.apply(ctx.kernel, needed, ctx.outputs, grad, *ctx.saved_tensors))
        return None, *(next(grads) if want else None for want in needed)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        (tangent,) = _PushForward.apply(ctx.kernel, ctx.outputs, *ctx.saved_tensors, *tangents)
        return tangent, *([None] * (ctx.outputs - 1))


class _Last(_Folding):
    """A derivative as a Function of its own: differentiating it again is an error, never a silent zero."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Outputs) -> None:
        ctx.kernel = inputs[0]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise _no_second_derivative(ctx.kernel)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> None:
        raise _no_second_derivative(ctx.kernel)


class _PullBack(_Last):
    @staticmethod
    def forward(kernel: Kernel, needed: tuple[bool, ...], count: int, grad: Tensor, *saved: Tensor | None) -> Outputs:
        outputs: Any = saved[len(saved) - count :]
        return tuple(kernel.pull_back(grad, needed, outputs, *saved[: len(saved) - count]))


class _PushForward(_Last):
    @staticmethod
    def forward(kernel: Kernel, count: int, *saved: Tensor | None) -> Outputs:
        inputs = (len(saved) - count) // 2
        outputs: Any = saved[inputs : inputs + count]
        return (kernel.push_forward(saved[inputs + count :], outputs, *saved[:inputs]),)


def _no_second_derivative(kernel: Kernel) -> RuntimeError:
    return RuntimeError(
        f"{kernel.name} has no second derivative: detach the first gradient, or difference it numerically"
    )
