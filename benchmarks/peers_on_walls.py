"""What the peers, as they come, answer on a plane and before an infinite right-angle wall: `python -m benchmarks.peers_on_walls`.

Radius 1, 40 pixels; taps off the image are kept out of the measured part. Means over pixels and four frames, so noise is averaged
away and bias is left. Rows go to benchmarks/results/peers_on_walls.json, a table to stdout.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_ssao as ts
from benchmarks.peers import PEERS
from benchmarks.peers.line_sampled import LineSampled
from torch_ssao.camera import Camera, look_at
from torch_ssao.gbuffer import GBuffer
from torch_ssao.modules import AmbientVisibility
from torch_ssao.report.environment import environment
from torch_ssao.scenes import analytic, closed_forms

RESULTS = Path(__file__).parent / "results" / "peers_on_walls.json"
ANGLES = (20.0, 45.0, 70.0)
DISTANCES = (0.1, 0.25, 0.5, 0.75)
PIXELS_A_UNIT = 40
FRAMES = 4

MODELS: dict[str, Callable[[], AmbientVisibility]] = {
    **{name: lambda peer=peer: peer(1.0) for name, peer in PEERS.items()},  # type: ignore[misc]
    "line_sampled, full sphere": lambda: LineSampled(1.0, volume="sphere"),
    "ours: HBAO": lambda: ts.HBAO(1.0),
    "ours: RayMarchedSSAO, binary": lambda: ts.RayMarchedSSAO(1.0, falloff=50.0),
}


def scene(name: str, angle_deg: float) -> tuple[GBuffer, Tensor]:
    """Orthographic view across the wall from an angle to the floor's normal, and the floor's distance from the wall."""
    span = 6.0
    angle = math.radians(angle_deg)
    focus = torch.tensor([0.7, 0.0, 0.0], dtype=torch.float64)
    towards = torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)
    up = torch.tensor([-math.cos(angle), 0.0, math.sin(angle)], dtype=torch.float64)
    pixels = int(span * PIXELS_A_UNIT)
    pose = look_at(focus + 10 * towards, focus, up)
    camera = Camera.orthographic(torch.tensor(span, dtype=torch.float64), pixels, pixels, world_to_view=pose)
    gbuffer = getattr(analytic, name)().render(camera, dtype=torch.float32)
    view = gbuffer.camera.unproject(gbuffer.depth.double())[0, :, 0]
    to_world = torch.linalg.inv(pose)
    x, y, z = torch.einsum("ij,jhw->ihw", to_world[:3, :3], view) + to_world[:3, 3, None, None]
    return gbuffer, torch.where((z.abs() < 1e-3) & (y.abs() < 1.2), x, math.nan)


def measure(name: str, make: Callable[[], AmbientVisibility]) -> dict[str, Any]:
    """Visibility on the plane and at distances from the wall, by viewing angle."""
    row: dict[str, Any] = {"model": name, "plane": {}, "wall": {}}
    module = make()
    for angle in ANGLES:
        for kind in ("plane", "wall"):
            gbuffer, distance = scene(kind, angle)
            with torch.no_grad():
                image = torch.stack([module(gbuffer, frame=frame)[0, 0] for frame in range(FRAMES)]).mean(0)
            if kind == "plane":
                row["plane"][f"{angle:g}"] = round(float(image[(distance - 0.7).abs() < 0.5].mean()), 4)
                continue
            at = {s: image[(distance - s).abs() < 0.04].mean() for s in DISTANCES}
            row["wall"][f"{angle:g}"] = {f"{s:g}": round(float(value), 4) for s, value in at.items()}
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown; a cell of the wall holds the views of `ANGLES`."""
    names = "/".join(f"{angle:g}" for angle in ANGLES)
    head = [f"plane, views {names}°", *(f"wall, s = {s:g}" for s in DISTANCES)]
    lines = ["| model | " + " | ".join(head) + " |", "|---|" + "---|" * len(head)]
    for row in rows:
        cells = [" ".join(f"{value:.3f}" for value in row["plane"].values())]
        cells += [" ".join(f"{at[f'{s:g}']:.3f}" for at in row["wall"].values()) for s in DISTANCES]
        lines.append(f"| {row['model']} | " + " | ".join(cells) + " |")
    for kind, options in (("cosine, binary", {}), ("volumetric", {"weighting": "volumetric"})):
        exact = [f"{float(closed_forms.wall(s, radius=1.0, **options)):.3f}" for s in DISTANCES]
        lines.append(f"| exact, {kind} | 1 | " + " | ".join(exact) + " |")
    return "\n".join(lines)


def main() -> None:
    rows = [measure(name, make) for name, make in MODELS.items()]
    RESULTS.write_text(json.dumps({"environment": environment(), "rows": rows}, indent=1) + "\n", encoding="utf-8")
    print(table(rows))


if __name__ == "__main__":
    main()
