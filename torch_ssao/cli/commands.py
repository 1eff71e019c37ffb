"""The commands: one function each."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_ssao.cli import techniques
from torch_ssao.cli.errors import CommandLineError

if TYPE_CHECKING:
    from torch_ssao.report import Measurement
    from torch_ssao.scenes import Scene


def scenes_command(arguments: argparse.Namespace) -> None:
    """List the built-in scenes, or describe one scene."""
    from torch_ssao import scenes
    from torch_ssao.report.tables import text_table

    if arguments.scene is None:
        listed = [scenes.builtin(name) for name in scenes.names()]
        cells = [[scene.name, str(len(scene.faces)), str(len(scene.cameras)), f"{scene.radius:g}"] for scene in listed]
        print(text_table(("scene", "faces", "views", "radius"), cells))
        return
    scene = _scene(arguments)
    used = scene.vertices[scene.faces].reshape(-1, 3)
    print(
        f"{scene.name}: {len(scene.faces)} faces, {len(scene.vertices)} vertices, suggested radius {scene.radius:.4g}"
    )
    print(f"bounding box {_vector(used.min(axis=0))} to {_vector(used.max(axis=0))}, diagonal {scene.diagonal:.4g}")
    views = [
        [str(i), _vector(view.eye), _vector(view.target), _vector(view.up), f"{view.fov_y_deg:g}"]
        for i, view in enumerate(scene.cameras)
    ]
    print(text_table(("view", "eye", "target", "up", "vertical field of view"), views))


def render_command(arguments: argparse.Namespace) -> None:
    """Write visibility pictures of a scene."""
    from torch_ssao import checks, scenes
    from torch_ssao.report import images, rows, truth

    saved = techniques.saved_module(arguments)
    scene = _scene(arguments)
    views = scene.view_indices(arguments.views)
    radius = scene.radius if arguments.radius is None else arguments.radius
    checks.check_positive("radius", radius)
    module = techniques.module(arguments, radius) if saved is None else saved
    width, height = arguments.size
    out = checks.check_output_folder("out", _out(arguments, scene))
    settings = truth.TraceSettings(height, width, radius, arguments.samples)
    for view in views:
        gbuffer = scenes.render(scene, views=view, height=height, width=width)
        _write_picture(out / f"visibility_{view}.png", images.grey_png(rows.predict(module, gbuffer)[0]))
        if arguments.reference:
            traced = truth.trace_views(scene, [view], settings, out, progress=_progress(arguments))
            _write_picture(out / f"reference_{view}.png", images.grey_png(traced.visibility[0]))


def fit_command(arguments: argparse.Namespace) -> None:
    """Fit techniques to a scene's ray-traced reference and choose one; with a target or a budget, write the report too."""
    from torch_ssao.report import make_report, measure

    has_wish = arguments.target_rmse is not None or arguments.budget_ms is not None
    _tell((make_report if has_wish else measure)(**_measure_options(arguments)))


def report_command(arguments: argparse.Namespace) -> None:
    """Do what fit does, and write the page with pictures."""
    from torch_ssao.report import make_report

    _tell(make_report(**_measure_options(arguments)))


# ---- what the commands share -----------------------------------------------------------------------------------------


def _measure_options(arguments: argparse.Namespace) -> dict[str, Any]:
    scene = _scene(arguments)
    width, height = arguments.size
    return {
        "scene": scene,
        "out": _out(arguments, scene),
        "views": arguments.views,
        "height": height,
        "width": width,
        "samples": arguments.samples,
        "fit_views": arguments.fit_views,
        "technique": arguments.technique,
        "options": techniques.options(arguments),
        "radius": arguments.radius,
        "parameters": arguments.parameters,
        "max_evaluations": arguments.max_evaluations,
        "target_rmse": arguments.target_rmse,
        "budget_ms": arguments.budget_ms,
        "peers": arguments.peers,
        "progress": _progress(arguments),
    }


def _tell(measurement: Measurement) -> None:
    from torch_ssao.report import tables

    settings = measurement.settings
    fitted_on = ", ".join(map(str, measurement.fit_views))
    print(
        f"{measurement.scene.name}, {settings.width}x{settings.height}, radius {settings.radius:g}, "
        f"{settings.samples} rays a pixel; fitted on view {fitted_on}, judged on {measurement.judged_label}"
    )
    if measurement.judged_on_training_views:
        print("no view was left that the fit had not seen: the errors of the fitted models flatter them")
    print(tables.text_table(tables.columns(measurement), tables.score_cells(measurement)))
    print()
    print(tables.text_table(*tables.value_matrix(measurement)))
    chosen = measurement.chosen
    if chosen is not None:
        print(f"\n{'chosen' if chosen.reached else 'not reached; nearest'}: {chosen.label}")
        print("\n".join((chosen.reason, *chosen.notes)))
    files = ("chosen.json", "report.html" if "report.html" in measurement.files else "report.json")
    print("\n" + "\n".join(f"wrote {measurement.out / file}" for file in files))


def _scene(arguments: argparse.Namespace) -> Scene:
    from torch_ssao import checks, scenes

    name, cameras, radius = arguments.scene, arguments.cameras, getattr(arguments, "radius", None)
    if name not in scenes.names():
        path = Path(name)
        if not path.exists() and not path.suffix:  # a misspelt name rather than a missing file
            known = ", ".join(scenes.names())
            raise checks.SceneError(
                f"scene must be a built-in scene ({known}) or a mesh file, got {name!r}: check its spelling"
            )
        return scenes.load(name, cameras=cameras, radius=radius)
    if cameras is not None:
        raise CommandLineError(f"--cameras must go with a mesh file, got the built-in scene {name!r}: leave it out")
    return scenes.builtin(name)


def _out(arguments: argparse.Namespace, scene: Scene) -> Path:
    return Path("out") / scene.name if arguments.out is None else arguments.out


def _write_picture(path: Path, content: bytes) -> None:
    from torch_ssao.report import images

    images.write(path, content)
    print(f"wrote {path}")


def _progress(arguments: argparse.Namespace) -> bool | None:
    return False if arguments.quiet else None  # None: on a terminal


def _vector(values: Any) -> str:
    return "(" + ", ".join(f"{float(value):.4g}" for value in values) + ")"
