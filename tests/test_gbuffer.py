"""GBuffer: validity, pytrees, joining, and errors."""

from __future__ import annotations

import math

import pytest
import torch
from torch.utils import _pytree as pytree

import torch_ssao as ts
from support.gbuffers import plane_gbuffer, random_gbuffer
from torch_ssao import checks

CAMERA = ts.Camera.perspective(60.0, 2, 3)


def test_unusable_depth_is_invalid() -> None:
    depth = torch.tensor([[[[1.0, 0.0, -1.0], [math.inf, math.nan, 2.0]]]])
    mask = torch.tensor([[[[True, True, True], [True, True, False]]]])
    assert ts.GBuffer(depth, CAMERA).valid.tolist() == [[[[True, False, False], [False, False, True]]]]
    assert ts.GBuffer(depth, CAMERA, valid=mask).valid.sum() == 1


@pytest.mark.parametrize("shape", [(2, 3), (4, 2, 3), (4, 2, 2, 3)])
def test_from_depth_accepts_plain_maps(shape: tuple[int, ...]) -> None:
    depth = torch.rand(shape, generator=torch.Generator().manual_seed(1)) + 1
    gb = ts.GBuffer.from_depth(depth, CAMERA)
    assert gb.depth.ndim == 4
    assert gb.normal is not None
    assert gb.normal.shape == (gb.depth.shape[0], 3, 2, 3)
    assert len(gb.camera) == len(gb)


def test_pytree_keeps_none_fields_out() -> None:
    gb = random_gbuffer(0, batch=2, normals=False)
    leaves, spec = pytree.tree_flatten(gb)
    assert len(leaves) == 6  # four intrinsics, depth, valid
    again = pytree.tree_unflatten(leaves, spec)
    assert again.normal is None
    assert torch.equal(again.depth, gb.depth)
    doubled = pytree.tree_map(lambda t: t if t.dtype == torch.bool else 2 * t, gb)
    assert torch.equal(doubled.depth, 2 * gb.depth)


def test_index_cat_and_collate_round_trip() -> None:
    gb = random_gbuffer(0, batch=3)
    again = ts.GBuffer.cat([gb[0], gb[1:]])
    assert torch.equal(again.depth, gb.depth)
    assert torch.equal(again.valid, gb.valid)
    assert torch.equal(again.camera.fx, gb.camera.fx)
    batch = ts.collate([(gb[0], 1, {"gb": gb[1]}), (gb[1], 2, {"gb": gb[2]})])
    assert len(batch[0]) == 2
    assert batch[1].tolist() == [1, 2]
    assert torch.equal(batch[2]["gb"].depth, gb.depth[1:])
    with pytest.raises(checks.ShapeError, match="normal must have one shape"):
        ts.GBuffer.cat([gb, random_gbuffer(0, normals=False)])
    with pytest.raises(checks.ShapeError, match="at least one"):
        ts.GBuffer.cat([])


def test_data_loader_yields_batches() -> None:
    gb = random_gbuffer(0, batch=4)
    loader = torch.utils.data.DataLoader([gb[i] for i in range(4)], batch_size=2, collate_fn=ts.collate)
    assert [len(batch) for batch in loader] == [2, 2]


def test_to_keeps_masks_boolean() -> None:
    gb = random_gbuffer(0).to(torch.float32)
    assert gb.depth.dtype == gb.camera.fx.dtype == torch.float32
    assert gb.valid.dtype == torch.bool


def test_gradient_through_from_depth() -> None:
    depth = plane_gbuffer(30, height=5, width=6, dtype=torch.float64).depth[0, 0]
    depth = depth + 0.01 * torch.rand(5, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    depth = depth.requires_grad_()

    def normals(depth: torch.Tensor) -> torch.Tensor:
        return ts.GBuffer.from_depth(depth, ts.Camera.perspective(50.0, 5, 6).to(torch.float64)).normal

    assert torch.autograd.gradcheck(normals, depth, check_forward_ad=True)


def good() -> dict[str, object]:
    return {"depth": torch.ones(2, 1, 2, 3), "camera": CAMERA}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"depth": torch.ones(2, 3)}, checks.ShapeError, "depth must have shape"),
        ({"depth": torch.ones(2, 1, 2, 3, dtype=torch.int)}, checks.DtypeError, "depth must be floating point"),
        ({"depth": [1.0]}, checks.DtypeError, "depth must be a torch.Tensor"),
        ({"camera": None}, checks.ShapeError, "camera must be a torch_ssao.Camera"),
        ({"camera": ts.Camera.perspective(60.0, 3, 2)}, checks.ShapeError, "image size of depth"),
        ({"camera": ts.Camera.perspective(torch.ones(3), 2, 3)}, checks.ShapeError, "batch 1 or 2"),
        ({"normal": torch.ones(2, 1, 2, 3)}, checks.ShapeError, "normal must have shape"),
        ({"normal": torch.ones(2, 3, 2, 3).double()}, checks.DtypeError, "normal must have depth's dtype"),
        ({"valid": torch.ones(2, 1, 2, 2).bool()}, checks.ShapeError, "valid must have shape"),
        ({"valid": torch.ones(2, 1, 2, 3)}, checks.DtypeError, "valid must be bool"),
        ({"triangles": torch.ones(2, 3, 2, 3)}, checks.ShapeError, "triangles must have shape"),
        ({"depth": torch.ones(2, 1, 2, 3, device="meta")}, checks.DeviceError, "move them to one device"),
    ],
)
def test_bad_input_names_argument_and_remedy(change: dict[str, object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        ts.GBuffer(**(good() | change))
    assert "\n" not in str(caught.value)


def test_from_depth_errors() -> None:
    with pytest.raises(checks.ShapeError, match="depth must have shape"):
        ts.GBuffer.from_depth(torch.ones(3), CAMERA)
    with pytest.raises(checks.ShapeError, match="valid must have shape"):
        ts.GBuffer.from_depth(torch.ones(2, 3), CAMERA, valid=torch.ones(3, 2).bool())
