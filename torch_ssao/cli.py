"""The command `torch-ssao`: one function per command, one line per error."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, final

if TYPE_CHECKING:
    from torch_ssao.modules import AmbientVisibility
    from torch_ssao.report import Measurement
    from torch_ssao.scenes import Scene

_EXTRAS = {
    "scenes": ("trimesh", "embreex", "PIL", "tqdm", "platformdirs"),
    "fitting": ("optimistix", "jax", "jaxlib", "equinox", "lineax"),
    "report": ("matplotlib",),
}


@final
class CommandLineError(ValueError):
    """The command line cannot be understood."""


@final
class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise CommandLineError(
            f"{message}: see {self.prog} --help"
        )  # argparse would print the usage, several lines of it


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: arguments after the program's name; None takes those of the process.
    Returns: exit status: 0; 2 after an error, told in one line on stderr; 130 after Ctrl-C. Finished files stay.
    """
    try:
        arguments = _parser().parse_args(argv)
        arguments.command(arguments)
        sys.stdout.flush()  # a reader that left is noticed here, not while the interpreter ends
    except KeyboardInterrupt:
        print("torch-ssao: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # `torch-ssao scenes | head -1`: nothing is left to tell anybody
        return 0
    except (ValueError, OSError, ImportError) as error:
        if not _is_for_the_caller(error):
            raise
        print(f"torch-ssao: error: {_one_line(error)}", file=sys.stderr)
        return 2
    return 0


def run() -> NoReturn:
    """`main` as the installed command: ends the process with its exit status."""
    sys.exit(main())


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

    module = None if arguments.module is None else _module(arguments)
    scene = _scene(arguments)
    views = scene.view_indices(arguments.views)
    radius = scene.radius if arguments.radius is None else arguments.radius
    checks.check_positive("radius", radius)
    if module is None:
        module = rows.candidates("statvo", radius, (4 if arguments.layers is None else arguments.layers,))[0][2]
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
    """Fit a technique to a scene's ray-traced reference; print the errors before and after."""
    from torch_ssao.report import measure

    _tell(measure(**_measure_options(arguments)), "report.json")


def report_command(arguments: argparse.Namespace) -> None:
    """Do what fit does, and write the page with pictures."""
    from torch_ssao.report import make_report

    _tell(make_report(**_measure_options(arguments)), "report.html")


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
        "layers": arguments.layers,
        "technique": arguments.technique,
        "radius": arguments.radius,
        "parameters": arguments.parameters,
        "max_evaluations": arguments.max_evaluations,
        "progress": _progress(arguments),
    }


def _tell(measurement: Measurement, file: str) -> None:
    from torch_ssao.report import tables

    settings = measurement.settings
    fitted_on = ", ".join(map(str, measurement.fit_views))
    print(
        f"{measurement.scene.name}, {settings.width}x{settings.height}, radius {settings.radius:g}, "
        f"{settings.samples} rays a pixel; fitted on view {fitted_on}, judged on {measurement.judged_label}"
    )
    if measurement.judged_on_training_views:
        print("no view was left that the fit had not seen: the errors of the fitted models flatter them")
    print(tables.text_table(tables.COLUMNS, tables.score_cells(measurement)))
    print()
    print(tables.text_table(*tables.value_matrix(measurement)))
    print(f"\nwrote {measurement.out / file}")


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


def _module(arguments: argparse.Namespace) -> AmbientVisibility:
    from torch_ssao import serialize

    if arguments.layers is not None:
        raise CommandLineError("--layers must be left out with --module: the file says how many layers it has")
    return serialize.load(arguments.module)


def _out(arguments: argparse.Namespace, scene: Scene) -> Path:
    return Path("out") / scene.name if arguments.out is None else arguments.out


def _write_picture(path: Path, content: bytes) -> None:
    from torch_ssao.report import images

    images.write(path, content)
    print(f"wrote {path}")


def _progress(arguments: argparse.Namespace) -> bool | None:
    return False if arguments.quiet else None  # None: on a terminal


def _is_for_the_caller(error: Exception) -> bool:
    """Whether an error is meant for a person; another package's ValueError is a bug and keeps its traceback."""
    if type(error).__module__.startswith("torch_ssao."):
        return True
    return _extra(error) is not None if isinstance(error, ImportError) else isinstance(error, OSError)


def _extra(error: ImportError) -> str | None:
    top = (error.name or "").partition(".")[0]
    return next((extra for extra, packages in _EXTRAS.items() if top in packages), None)


def _one_line(error: Exception) -> str:
    if isinstance(error, ImportError) and _extra(error):
        return f"{error.name} is not installed: run pip install 'torch_ssao[{_extra(error)}]'"
    return " ".join(str(error).split()) or type(error).__name__


def _vector(values: Any) -> str:
    return "(" + ", ".join(f"{float(value):.4g}" for value in values) + ")"


# ---- arguments -------------------------------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    from torch_ssao import __version__

    parser = _Parser(
        prog="torch-ssao",
        description="Screen-space ambient occlusion: pictures, fits to ray-traced references, reports.",
    )
    parser.add_argument("--version", action="version", version=f"torch-ssao {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_scenes(commands)
    _add_render(commands)
    for name, function, text in (
        (
            "fit",
            fit_command,
            "Fit a technique to a scene's ray-traced reference and print its errors on views not used for fitting.",
        ),
        (
            "report",
            report_command,
            "Do what fit does and write report.html: pictures, error maps, speed-against-error plot, fitted values.",
        ),
    ):
        _add_measure(commands, name, function, text)
    return parser


def _command(commands: Any, name: str, function: Any, text: str, example: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=text,
        description=text,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(command=function)
    return parser


def _add_scenes(commands: Any) -> None:
    text = "List the built-in scenes, or describe one of them or a mesh file."
    parser = _command(commands, "scenes", scenes_command, text, "torch-ssao scenes bunny.ply --cameras cameras.json")
    parser.add_argument(
        "scene", nargs="?", metavar="SCENE", help="a built-in scene or a mesh file; all built-in scenes if left out"
    )
    _add_cameras(parser)


def _add_render(commands: Any) -> None:
    text = "Write visibility pictures of a scene: PNG, linear 8-bit grey, 255 = open."
    parser = _command(
        commands,
        "render",
        render_command,
        text,
        "torch-ssao render temple --views 0,2 --size 640x480 --layers 4 --reference",
    )
    _add_common(parser, size=(640, 480))
    parser.add_argument("--views", type=_numbers, metavar="0,2", help="views to render; all if left out")
    layers = "depth layers of StatVO with default values: 1, 2, 4, ... (default 4)"
    parser.add_argument("--layers", type=int, metavar="N", help=layers)
    parser.add_argument(
        "--module",
        type=Path,
        metavar="FILE",
        help="a fitted module (JSON) instead; --radius is then the reference's only",
    )
    parser.add_argument("--reference", action="store_true", help="write the ray-traced reference too")


def _add_measure(commands: Any, name: str, function: Any, text: str) -> None:
    example = f"torch-ssao {name} bunny.ply --cameras cameras.json --layers 1,4 --fit-views 0 --out out/bunny"
    parser = _command(commands, name, function, text, example)
    _add_common(parser, size=(480, 360))
    parser.add_argument("--technique", default="statvo", metavar="NAME", help="what to fit (default %(default)s)")
    parser.add_argument(
        "--layers", type=_numbers, default=(1, 2, 4, 8), metavar="1,2,4,8", help="depth layers, one fit for each"
    )
    parser.add_argument("--fit-views", type=_numbers, default=(0,), metavar="0", help="views to fit on (default 0)")
    parser.add_argument("--views", type=_numbers, metavar="1,2", help="views to judge on; all others if left out")
    parser.add_argument("--parameters", type=_names, metavar="radius,height", help="parameters to fit; all if left out")
    budget = "budget of each fit, in forward passes; by the number of parameters if left out"
    parser.add_argument("--max-evaluations", type=int, metavar="N", help=budget)


def _add_common(parser: argparse.ArgumentParser, size: tuple[int, int]) -> None:
    parser.add_argument("scene", metavar="SCENE", help="a built-in scene (see torch-ssao scenes) or a mesh file")
    _add_cameras(parser)
    parser.add_argument(
        "--radius", type=float, metavar="R", help="ambient-occlusion radius in scene units; the scene's own if left out"
    )
    parser.add_argument(
        "--size",
        type=_size,
        default=size,
        metavar="WIDTHxHEIGHT",
        help=f"image size in pixels (default {size[0]}x{size[1]})",
    )
    parser.add_argument(
        "--samples", type=int, default=512, metavar="N", help="rays a pixel of the reference (default %(default)s)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default out/<scene>)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr; it is shown on a terminal only")


def _add_cameras(parser: argparse.ArgumentParser) -> None:
    text = "JSON with a list of {eye, target, up, fov_y_deg} for a mesh file; placed automatically if left out"
    parser.add_argument("--cameras", type=Path, metavar="FILE", help=text)


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT in pixels such as 640x480, got {text!r}")
    return int(width), int(height)


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be whole numbers with commas between them such as 0,2, got {text!r}"
        ) from None


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())
