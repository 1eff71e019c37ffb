"""What goes wrong where: halos, rows of pillars, thin surfaces, the border of the image."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

import torch_ssao as ts
from benchmarks.statvo_claims import stages
from benchmarks.statvo_claims.common import Candidate, Run, builtin_case, case, fitted, visibility
from benchmarks.statvo_claims.obscurance import point_sampled
from benchmarks.statvo_claims.pictures import curves, strip

HEIGHT = 240
FIT_HEIGHT = 120  # parameters are in scene units: they hold at any resolution
BAND = 20  # pixels beside the silhouette
GAPS = (2.0, 4.0, 8.0, 16.0)  # of the radius, from the pillar's back to the wall
TURNS = (("facing wall", 0.0), ("turned by 35 degrees", 35.0))
HALO_CANDIDATES = (
    *(Candidate(n) for n in (1, 2, 4, 8)),
    Candidate(4, quadrants=True),
    Candidate(64, "uniform"),
)
AZIMUTHS = (0.0, 2.0, 5.0, 10.0, 20.0, 45.0, 90.0)
BORDERS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of the footprint


def halos(run: Run) -> tuple[list[dict[str, Any]], str]:
    """Darkness on a wall beside a pillar far in front of it, where the truth is 1."""
    rows, pictures = [], []
    for name, turn in TURNS:
        for gap in GAPS:
            where = case(stages.pillar_before_wall(gap * stages.RADIUS, turn), 0, HEIGHT)
            # The turned wall comes closer on one side: only pixels that the rays call open are judged.
            pillar = (where.gbuffer.depth < stages.PILLAR_DISTANCE + 0.25) & where.valid
            near = F.max_pool2d(pillar.float(), 2 * BAND + 1, stride=1, padding=BAND) > 0
            band = near & ~_pillar_sides(where.gbuffer) & where.valid & (where.truth.visibility > 0.9999)
            for candidate in HALO_CANDIDATES:
                image = visibility(candidate.build(where.radius), where.gbuffer)
                dark = 1 - image[band]
                row = {"wall": name, "gap_radii": gap, "worst": float(dark.max())} | candidate.row()
                row |= {"mean": float(dark.mean()), "pixels": int(band.sum())}
                rows.append(row | {"share_above_1_percent": float((dark > 0.01).float().mean())})
                if gap == 4.0:
                    pictures.append((f"{candidate.label}\n{row['worst']:.2f}, {row['mean']:.3f}", image))
            if gap == 4.0:
                pictures.append(("ray-traced\n0, 0", where.truth.visibility))
    middle = slice(40, 200), slice(50, 270)
    cut = [(caption, image[..., *middle]) for caption, image in pictures]
    title = f"wall 4 R behind a pillar: worst and mean darkness of the wall within {BAND} px of the pillar (truth 0)"
    half = len(cut) // 2
    strip(
        run.figures / "statvo_halos.png", [cut[:half], cut[half:]], names=[n for n, _ in TURNS], title=title, size=1.75
    )
    return rows, _halo_statement(rows)


def _pillar_sides(gbuffer: ts.GBuffer) -> Tensor:
    """Pixels of the pillar, front and sides."""
    points = gbuffer.camera.unproject(gbuffer.depth)[:, :, 0]
    behind = points[:, 2] > stages.PILLAR_DISTANCE + 0.51
    return (~behind | (points[:, 0].abs() < 0.351) & (points[:, 2] < stages.PILLAR_DISTANCE + 0.51))[:, None]


def _halo_statement(rows: list[dict[str, Any]]) -> str:
    words = []
    for name, _ in TURNS:
        for candidate in HALO_CANDIDATES:
            mine = [r for r in rows if r["wall"] == name and r.items() >= candidate.row().items()]
            worst, mean = max(r["worst"] for r in mine), max(r["mean"] for r in mine)
            words.append(f"{name}, {candidate.label}: worst {worst:.3f}, largest mean {mean:.4f}")
    return "; ".join(words)


def pillars(run: Run) -> tuple[list[dict[str, Any]], str]:
    """Looking along a row of pillars: more discontinuities in a window than layers."""
    where, small = (case(stages.row_of_pillars(), 0, height, samples=1024) for height in (HEIGHT, FIT_HEIGHT))
    shared, _ = fitted(Candidate(16), small)
    values = shared.values()
    obscurance = point_sampled(where.gbuffer, **values)
    rows, line = [], []
    for candidate in (*(Candidate(n) for n in (1, 2, 4, 8, 16)), Candidate(4, quadrants=True)):
        image = visibility(candidate.build(**values), where.gbuffer)
        own, _ = fitted(candidate, small)
        row = candidate.row() | {"rmse_rays": where.error(image), "rmse_vo": where.error(image, obscurance)}
        row["rmse_rays_own_fit"] = where.error(visibility(own, where.gbuffer))
        row |= {"values": values, "own_values": own.values()}
        rows.append(row)
        line.append((f"{candidate.label}, {row['rmse_vo']:.3f} / {row['rmse_rays']:.3f}", image))
    line += [
        (f"point-sampled, 0 / {where.error(obscurance):.3f}", obscurance),
        ("ray-traced", where.truth.visibility),
    ]
    zoom = slice(50, 210), slice(90, 250)
    cut = [(caption, image[..., *zoom]) for caption, image in line]
    title = "along a row of pillars: RMSE against point-sampled obscurance / against rays; one set of parameters"
    strip(run.figures / "statvo_pillars.png", [cut[:4], cut[4:]], title=title)
    rows.append({"layers": None, "rmse_vo": 0.0, "rmse_rays": where.error(obscurance)})
    words = [
        f"{r['layers']} layers{', quadrants' * r['quadrants']}: {r['rmse_vo']:.4f} from point-sampled obscurance, "
        f"{r['rmse_rays']:.4f} from rays (own fit {r['rmse_rays_own_fit']:.4f})"
        for r in rows[:-1]
    ]
    return rows, "; ".join([*words, f"point-sampled obscurance itself: {rows[-1]['rmse_rays']:.4f} from rays"])


def thin(run: Run) -> tuple[list[dict[str, Any]], str]:
    """A thin plate on a floor, from edge-on to the side: occlusion of the floor beside it, as a share of the true one."""
    scene = stages.plate(AZIMUTHS)
    size = {"height": HEIGHT, "width": HEIGHT * 4 // 3}
    candidates = {
        "1 layer": Candidate(1),
        "4 layers": Candidate(4),
        "4 layers, quadrants": Candidate(4, quadrants=True),
    }
    side = case(scene, len(AZIMUTHS) - 1, FIT_HEIGHT)
    near_plate = _beside_plate(ts.scenes.primary_hits(scene, len(AZIMUTHS) - 1, FIT_HEIGHT, FIT_HEIGHT * 4 // 3))
    modules = {name: fitted(candidate, side, mask=near_plate)[0] for name, candidate in candidates.items()}
    rows, strips = [], {}
    for view, azimuth in enumerate(AZIMUTHS):
        where = case(scene, view, HEIGHT)
        beside = _beside_plate(ts.scenes.primary_hits(scene, view, **size))
        true = float((1 - where.truth.visibility)[beside].mean())
        images = [(name, visibility(module, where.gbuffer)) for name, module in modules.items()]
        strips[azimuth] = [*images, ("ray-traced", where.truth.visibility)]
        for name, image in images:
            found = float((1 - image)[beside].mean())
            row = {"azimuth_deg": azimuth, "candidate": name, "occlusion": found, "true_occlusion": true}
            rows.append(row | {"share": found / true, "rmse": where.error(image, mask=beside)})
    middle = slice(40, 210), slice(60, 260)
    cut = [[(caption, image[..., *middle]) for caption, image in strips[a]] for a in (AZIMUTHS[0], AZIMUTHS[-1])]
    title = "thin plate on a floor; parameters fitted to the floor beside it, seen from the side"
    strip(run.figures / "statvo_thin.png", cut, names=("edge-on", "from the side"), title=title)
    lines = {n: (list(AZIMUTHS), _shares(rows, n)) for n in candidates}
    x, y = "degrees from edge-on", "occlusion of the floor / true"
    curves(run.figures / "statvo_thin_angle.png", {"floor within R of a plate of 2 cm": lines}, x=x, y=y)
    words = [f"{n}: {_shares(rows, n)[0]:.2f} edge-on, {_shares(rows, n)[-1]:.2f} from the side" for n in candidates]
    return rows, "occlusion of the floor within R of the plate, of the true one: " + "; ".join(words)


def _shares(rows: list[dict[str, Any]], name: str) -> list[float]:
    return [r["share"] for r in rows if r["candidate"] == name]


def _beside_plate(hits: ts.scenes.PrimaryHits) -> Tensor:
    """(1, 1, H, W) floor pixels within the radius of the plate."""
    x, y, z = np.moveaxis(hits.position, -1, 0)
    across = np.maximum(np.abs(x) - stages.PLATE_HALF_WIDTH, 0.0)
    along = np.maximum(np.abs(z) - stages.PLATE_HALF_LENGTH, 0.0)
    on_floor = hits.hit & (np.abs(y) < 1e-6)
    return torch.from_numpy(on_floor & (np.hypot(across, along) < stages.RADIUS))[None, None]


def guard_band(run: Run) -> tuple[list[dict[str, Any]], str]:
    """Pixels whose window is cut by the image border, rendered with and without a border that is cropped afterwards."""
    rows, words = [], []
    lines: dict[str, tuple[list[float], list[float]]] = {}
    for name, view in (("temple", 1), ("street", 1), ("room", 0)):
        scene = ts.scenes.builtin(name)
        where = case(scene, view, HEIGHT)
        module, _ = fitted(Candidate(4), builtin_case(name, view, FIT_HEIGHT))
        cut, footprint = _cut_windows(where.gbuffer, where.radius, where.valid)
        whole = _rendered_with_border(scene, view, module, round(4 * footprint))
        for share in BORDERS:
            image = _rendered_with_border(scene, view, module, round(share * footprint))
            row = {"scene": name, "view": view, "border": share, "border_px": round(share * footprint)}
            row |= {"footprint_px": footprint, "pixels_cut": float((cut & where.valid).sum() / where.valid.sum())}
            row |= {
                "rmse_whole": where.error(image, whole, cut),
                "worst_whole": float((image - whole)[cut].abs().max()),
            }
            rows.append(row | {"rmse_rays": where.error(image, mask=cut), "rmse_rays_all": where.error(image)})
        mine = rows[-len(BORDERS) :]
        lines[name] = ([r["border"] for r in mine], [r["rmse_whole"] for r in mine])
        errors = ", ".join(f"{r['rmse_whole']:.4f} at {r['border']:g}" for r in mine)
        words.append(
            f"{name}: {100 * mine[0]['pixels_cut']:.0f} % of the pixels are cut (footprint {footprint:.0f} px); RMSE there "
            f"against a border of 4 footprints {errors}; against rays {mine[0]['rmse_rays']:.4f} without, "
            f"{mine[3]['rmse_rays']:.4f} with one footprint"
        )
        print(words[-1], flush=True)
    x, y = "border / footprint", "RMSE against a border of 4 footprints"
    curves(run.figures / "statvo_guard_band.png", {"pixels whose window the image border cuts": lines}, x=x, y=y)
    return rows, "; ".join(words)


def _cut_windows(gbuffer: ts.GBuffer, radius: float, valid: Tensor) -> tuple[Tensor, float]:
    """Pixels whose window leaves the image, (1, 1, H, W), and the median half-size of their windows in pixels."""
    half = gbuffer.camera.footprint(torch.tensor(radius), torch.where(valid, gbuffer.depth, 1.0))[:, 0]
    rows, columns = valid.shape[-2:]
    y, x = torch.arange(rows)[:, None] + 0.5, torch.arange(columns) + 0.5
    inside = (x >= half) & (columns - x >= half) & (y >= half) & (rows - y >= half)
    cut = ~inside & valid
    return cut, float(half[cut].median())


def _rendered_with_border(scene: ts.scenes.Scene, view: int, module: ts.StatVO, border: int) -> Tensor:
    wide = stages.with_border(scene, view, HEIGHT, border)
    width = HEIGHT * 4 // 3
    gbuffer = ts.scenes.render(wide, height=HEIGHT + 2 * border, width=width + 2 * border)
    return visibility(module, gbuffer)[..., border : border + HEIGHT, border : border + width]
