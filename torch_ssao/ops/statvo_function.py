"""StatVO's autograd: raw custom operators, opaque to compilers, under a Function that knows all derivatives.

`torch.compile` refuses a Function with a forward-mode rule, and `torch.func.jvp` through an operator's own registered autograd
is silently zero; so the Function carries the derivatives, and a twin without forward mode serves compilers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_ssao.ops.layered_obscurance import LayeredObscurance, Queries, Settings
from torch_ssao.ops.partition import Samples

# In the order of the operators' arguments. Those that move have a tangent and a cotangent.
TENSORS = ("position", "mass", "sample_half", "centre", "normal", "seen", "half", "box_height", "slope", "width")
MOVING = ("position", "sample_half", "centre", "normal", "half", "box_height", "slope")
SAVED = 3  # labels, boxes, count
_ARGUMENTS = ", ".join(f"Tensor {name}" for name in TENSORS)
_SETTINGS = "int layers, str layering, bool quadrants, int block, bool differential, str gradient"
_STATE = "Tensor labels, Tensor boxes, Tensor count"
NO_SECOND = "statvo_obscurance has no second derivative: detach the first gradient, or difference it numerically"


def _problem(arguments: tuple[Any, ...]) -> LayeredObscurance:
    position, mass, sample_half, centre, normal, seen, half, box_height, slope, width = (
        tensor.contiguous() for tensor in arguments[: len(TENSORS)]
    )
    settings = Settings(*arguments[len(TENSORS) :])
    samples = Samples(position, mass, sample_half, (seen.shape[1], seen.shape[2]), settings.block)
    return LayeredObscurance(samples, Queries(centre, normal, seen, half, box_height, slope, width), settings)


@torch.library.custom_op(
    "torch_ssao::statvo", mutates_args=(), schema=f"({_ARGUMENTS}, {_SETTINGS}) -> (Tensor, Tensor, Tensor, Tensor)"
)
def _value(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return _problem(arguments).value()


@torch.library.custom_op(
    "torch_ssao::statvo_backward",
    mutates_args=(),
    schema=f"(Tensor grad, {_ARGUMENTS}, {_STATE}, {_SETTINGS}) -> ({', '.join(['Tensor'] * len(MOVING))})",
)
def _backward(grad: Tensor, *arguments: Any) -> tuple[Tensor, ...]:
    inputs, state, settings = _split(arguments)
    return tuple(_problem((*inputs, *settings)).pull_back(grad.contiguous(), *state))


@torch.library.custom_op(
    "torch_ssao::statvo_jvp",
    mutates_args=(),
    schema=f"({', '.join(f'Tensor? d_{name}' for name in MOVING)}, {_ARGUMENTS}, {_STATE}, {_SETTINGS}) -> Tensor",
)
def _forward_mode(*arguments: Any) -> Tensor:
    tangents = dict(zip(MOVING, arguments[: len(MOVING)], strict=True))
    inputs, state, settings = _split(arguments[len(MOVING) :])
    return _problem((*inputs, *settings)).push_forward(tangents, *state)


@_value.register_fake
def _(*arguments: Any) -> tuple[Tensor, ...]:
    named = dict(zip(TENSORS, arguments, strict=False))
    quadrants = arguments[len(TENSORS) + 2]
    boxes = named["centre"].new_empty((named["seen"].shape[0], 4 if quadrants else 1, *named["seen"].shape[1:]))
    labels = named["mass"].new_empty(named["mass"].shape, dtype=torch.uint8)
    return named["centre"].new_empty(named["seen"].shape), labels, boxes, torch.empty_like(boxes)


@_backward.register_fake
def _(grad: Tensor, *arguments: Any) -> tuple[Tensor, ...]:
    named = dict(zip(TENSORS, arguments, strict=False))
    soft = arguments[-1] == "surrogate" and arguments[-6] > 1
    shapes = [list(named[name].shape) for name in MOVING]
    if not soft:
        shapes[MOVING.index("sample_half")] = [grad.shape[0], 0]
    return tuple(grad.new_empty(shape) for shape in shapes)


@_forward_mode.register_fake
def _(*arguments: Any) -> Tensor:
    named = dict(zip(TENSORS, arguments[len(MOVING) :], strict=False))
    return named["centre"].new_empty(named["seen"].shape)


def _fold(operator: Any) -> Callable[..., Any]:
    """The operator's vmap rule: the mapped dimension joins the batch."""

    def rule(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> Any:
        def joined(argument: Any, dim: int | None) -> Any:
            if not isinstance(argument, Tensor):
                return argument
            mapped = argument.expand(info.batch_size, *argument.shape) if dim is None else argument.movedim(dim, 0)
            return mapped.flatten(0, 1)

        outputs = operator(*(joined(argument, dim) for argument, dim in zip(arguments, in_dims, strict=True)))
        if isinstance(outputs, Tensor):
            return outputs.unflatten(0, (info.batch_size, -1)), 0
        return tuple(output.unflatten(0, (info.batch_size, -1)) for output in outputs), (0,) * len(outputs)

    return rule


for _operator in (_value, _backward, _forward_mode):
    _operator.register_vmap(_fold(_operator))


class _Layered(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _value(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)
        ctx.settings = inputs[len(TENSORS) :]
        ctx.save_for_backward(*inputs[: len(TENSORS)], *output[1:])
        ctx.save_for_forward(*inputs[: len(TENSORS)], *output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, *unused: Tensor | None) -> tuple[Tensor | None, ...]:
        if grad is None:
            return (None,) * (len(TENSORS) + len(ctx.settings))
        first = _backward if torch.compiler.is_compiling() else _Backward.apply
        cotangents = dict(zip(MOVING, first(grad, *ctx.saved_tensors, *ctx.settings), strict=True))
        if cotangents["sample_half"].numel() == 0:
            cotangents["sample_half"] = None
        return (*(cotangents.get(name) for name in TENSORS), *(None for _ in ctx.settings))


class _LayeredWithJvp(_Layered):
    """The same with forward mode, which dynamo refuses to trace."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, None, None, None]:
        named = dict(zip(TENSORS, tangents, strict=False))
        return _forward_mode(*(named[name] for name in MOVING), *ctx.saved_tensors, *ctx.settings), None, None, None


class _Backward(torch.autograd.Function):
    """The backward pass as a Function of its own: differentiating it again is an error, never a silent zero."""

    generate_vmap_rule = True

    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, ...]:
        return _backward(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise RuntimeError(NO_SECOND)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> None:
        raise RuntimeError(NO_SECOND)


def layered_obscurance(*arguments: Any) -> Tensor:
    """Differentiable obscurance (B, H, W) of `Queries` over `Samples`; arguments are `TENSORS`, then the fields of `Settings`."""
    function = _Layered if torch.compiler.is_compiling() else _LayeredWithJvp
    return function.apply(*arguments)[0]


def _split(arguments: tuple[Any, ...]) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    tensors = len(TENSORS)
    return arguments[:tensors], arguments[tensors : tensors + SAVED], arguments[tensors + SAVED :]
