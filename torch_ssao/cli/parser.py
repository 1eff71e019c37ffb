"""The arguments of every command."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn, final

from torch_ssao.cli import commands, techniques
from torch_ssao.cli.errors import CommandLineError


@final
class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise CommandLineError(
            f"{message}: see {self.prog} --help"
        )  # argparse would print the usage, several lines of it


def build() -> argparse.ArgumentParser:
    """The parser; what it returns has the function to call as `command`."""
    from torch_ssao import __version__

    parser = _Parser(
        prog="torch-ssao",
        description="Screen-space ambient occlusion: pictures, fits to ray-traced references, reports.",
    )
    parser.add_argument("--version", action="version", version=f"torch-ssao {__version__}")
    listed = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_scenes(listed)
    _add_render(listed)
    fits = (
        "Fit techniques to a scene's ray-traced reference, print their errors on views not used for fitting, and choose the "
        "cheapest that is good enough: chosen.json. With a target or a budget, do what report does too. A run that was "
        "interrupted goes on where it stopped when it is called again."
    )
    example = "torch-ssao fit bunny.ply --cameras cameras.json --technique all --target-rmse 0.05 --out out/bunny"
    _add_measure(_command(listed, "fit", commands.fit_command, fits, example))
    page = (
        "Do what fit does and write report.html: a slider over untuned, fitted and reference pictures, error maps, "
        "speed-against-error plot, fitted values; and report.csv, report.json."
    )
    example = "torch-ssao report temple --technique statvo,hbao --layers 1,4 --slices 3,4 --steps 4,8"
    _add_measure(_command(listed, "report", commands.report_command, page, example))
    return parser


def _command(listed: Any, name: str, function: Any, text: str, example: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = listed.add_parser(
        name,
        help=text,
        description=text,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(command=function)
    return parser


def _add_scenes(listed: Any) -> None:
    text = "List the built-in scenes, or describe one of them or a mesh file."
    example = "torch-ssao scenes bunny.ply --cameras cameras.json"
    parser = _command(listed, "scenes", commands.scenes_command, text, example)
    parser.add_argument(
        "scene", nargs="?", metavar="SCENE", help="a built-in scene or a mesh file; all built-in scenes if left out"
    )
    _add_cameras(parser)


def _add_render(listed: Any) -> None:
    text = "Write visibility pictures of a scene: PNG, linear 8-bit grey, 255 = open."
    example = "torch-ssao render temple --technique hbao --slices 4 --steps 8 --views 0,2 --size 640x480 --reference"
    parser = _command(listed, "render", commands.render_command, text, example)
    _add_common(parser, size=(640, 480))
    parser.add_argument("--views", type=_numbers, metavar="0,2", help="views to render; all if left out")
    parser.add_argument(
        "--module",
        type=Path,
        metavar="FILE",
        help="a fitted module (JSON) instead; --radius is then the reference's only",
    )
    parser.add_argument("--reference", action="store_true", help="write the ray-traced reference too")
    help_text = "statvo, hbao or ray_march (default statvo)"
    parser.add_argument("--technique", type=techniques.parse_names, metavar="NAME", help=help_text)
    note = "Left out: 4 layers; 4 slices with 4 steps; 16 rays with 8 steps."
    techniques.add_options(parser, int, "N", note)


def _add_measure(parser: argparse.ArgumentParser) -> None:
    _add_common(parser, size=(480, 360))
    help_text = "what to fit: statvo, hbao, ray_march, several with commas between them, or all (default statvo)"
    parser.add_argument(
        "--technique", type=techniques.parse_names, default=("statvo",), metavar="NAMES", help=help_text
    )
    parser.add_argument("--fit-views", type=_numbers, default=(0,), metavar="0", help="views to fit on (default 0)")
    parser.add_argument("--views", type=_numbers, metavar="1,2", help="views to judge on; all others if left out")
    chosen = "parameters to fit, of each technique those that it has; all if left out"
    parser.add_argument("--parameters", type=_names, metavar="radius,height", help=chosen)
    budget = "budget of each fit, in forward passes; by the number of parameters if left out"
    parser.add_argument("--max-evaluations", type=int, metavar="N", help=budget)
    target = "error on the judged views that is good enough: the cheapest model that reaches it is chosen"
    parser.add_argument("--target-rmse", type=float, metavar="E", help=target)
    milliseconds = (
        "milliseconds a view that the chosen model may take; with neither, the cheapest that nearly equals the best"
    )
    parser.add_argument("--budget-ms", type=float, metavar="T", help=milliseconds)
    peers = (
        "JSON file with results of other implementations, shown beside ours: name, ms, validation: {rmse, psnr, ssim}"
    )
    parser.add_argument("--peers", type=Path, metavar="FILE", help=peers)
    note = (
        "One fit for each count; counts of a pair are taken together, --slices 3,4 --steps 4,8 is 3x4 and 4x8.\n"
        "Left out: 1, 2, 4 and 8 layers; 2x4 and 3x6 slices and steps; 16x8 rays and steps. With a target or a budget,\n"
        "1x4, 2x4, 2x6, 3x6 and 4x8 slices and steps; 4x4, 8x4, 8x8 and 16x8 rays and steps."
    )
    techniques.add_options(parser, _numbers, "N,N", note)


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
