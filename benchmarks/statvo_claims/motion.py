"""Steadiness under a slowly moving camera."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

import torch_ssao as ts
from benchmarks.statvo_claims import stages
from benchmarks.statvo_claims.common import Candidate, Case, Run, builtin_case, case, fitted, visibility
from benchmarks.statvo_claims.obscurance import point_sampled
from benchmarks.statvo_claims.pictures import strip

HEIGHT = 240
FRAMES = 12
STEP_PX = 0.75  # motion of a point at the median depth, a frame
SAME_SURFACE = 0.005  # of the depth: what lies further off after reprojection was hidden, or is an edge
SAME_NORMAL = 0.98  # cosine between the normals
GAIN = 8.0  # of the pictures


def temporal(run: Run) -> tuple[list[dict[str, Any]], str]:
    """Change of visibility of a surface point from frame to frame: full, half, quarter SATs and the rays' own."""
    rows, words, lines = [], [], []
    for name in ("temple", "street"):
        start = builtin_case(name, 0, HEIGHT)
        focal, depth = float(start.gbuffer.camera.fx), float(start.gbuffer.depth[start.valid].median())
        path = stages.walk(ts.scenes.builtin(name), 0, FRAMES, STEP_PX * depth / focal)
        where = case(path, list(range(FRAMES)), HEIGHT, samples=1024)
        values = fitted(Candidate(4), builtin_case(name, 0, HEIGHT // 2))[0].values()
        films = {
            f"{label} SATs": visibility(Candidate(4, sat_scale=s).build(**values), where.gbuffer)
            for label, s in (("full", 1), ("half", 2), ("quarter", 4))
        }
        films |= {
            "point-sampled": point_sampled(where.gbuffer, **values, grid=12),
            "ray-traced": where.truth.visibility,
        }
        same, grid, moved = _reprojection(where)
        line = []
        for label, film in films.items():
            change = film[1:] - _lookup(film[:-1], grid)
            row = {"scene": name, "what": label, "step_px": moved} | _figures(change, same)
            row["sigma_noise"] = where.truth.noise if label == "ray-traced" else 0.0
            rows.append(row)
            shown = torch.where(same, 1 - GAIN * change.abs(), 1.0)[FRAMES // 2][None]
            line.append((f"{label}, RMS {row['rms']:.4f}", shown))
        lines.append([(caption, image[..., 40:200, 60:280]) for caption, image in line])
        mine = ", ".join(f"{r['what']} {r['rms']:.4f} RMS, {r['p99']:.4f}" for r in rows[-len(films) :])
        words.append(
            f"{name} ({moved:.2f} px a frame in the median): change from frame to frame {mine} at the 99th percentile; "
            f"noise of the rays alone {2**0.5 * where.truth.noise:.4f} RMS"
        )
        print(words[-1], flush=True)
    title = f"change of a surface point in one frame, darkness = {GAIN:g} times its size"
    strip(run.figures / "statvo_temporal.png", lines, names=("temple", "street"), title=title)
    return rows, "; ".join(words)


def _figures(change: Tensor, same: Tensor) -> dict[str, float]:
    kept = change[same].double().abs()
    return {
        "rms": float(kept.square().mean().sqrt()),
        "p99": float(kept.kthvalue(int(0.99 * kept.numel()))[0]),
        "p999": float(kept.kthvalue(int(0.999 * kept.numel()))[0]),
        "pixels": int(same.sum()),
    }


def _reprojection(where: Case) -> tuple[Tensor, Tensor, float]:
    """For frames 1..: pixels that the frame before saw too, where they lay there, and the median motion in pixels."""
    gbuffer = where.gbuffer
    camera, valid = gbuffer.camera, where.valid
    depth = torch.where(valid, gbuffer.depth, 1.0).double()
    points = camera.to(torch.float64).unproject(depth)[:, :, 0]  # (B, 3, H, W)
    pose = camera.world_to_view.double()
    relative = pose[:-1] @ torch.linalg.inv(pose[1:])  # from each view to the one before
    before = torch.einsum("bij,bjhw->bihw", relative[:, :3, :3], points[1:]) + relative[:, :3, 3, None, None]
    focal = camera.fx.double()[:-1, None, None]
    x = before[:, 0] / before[:, 2] * focal + camera.width / 2
    y = before[:, 1] / before[:, 2] * focal + camera.height / 2
    grid = torch.stack((2 * x / camera.width - 1, 2 * y / camera.height - 1), -1)
    there = _lookup(depth[:-1], grid)[:, 0]
    seen = _lookup(valid[:-1].double(), grid)[:, 0] > 0.999
    same = valid[1:, 0] & seen & (x > 1) & (x < camera.width - 1) & (y > 1) & (y < camera.height - 1)
    # The path has no rotation: view-space normals of one surface agree. A mixed one is shorter, so creases drop out too.
    normal = gbuffer.normal.double()
    same = same & ((_lookup(normal[:-1], grid) * normal[1:]).sum(1) > SAME_NORMAL)
    same = (same & ((there - before[:, 2]).abs() < SAME_SURFACE * before[:, 2]))[:, None]
    own_y, own_x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    return same, grid, float(torch.hypot(x - own_x, y - own_y)[same[:, 0]].median())


def _lookup(film: Tensor, grid: Tensor) -> Tensor:
    """Bilinear; the same for all techniques."""
    return F.grid_sample(film.double(), grid, mode="bilinear", padding_mode="border", align_corners=False)
