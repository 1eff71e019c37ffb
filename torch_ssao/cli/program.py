"""Run a command: its exit status, and one line for an error."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from torch_ssao.cli import parser
from torch_ssao.cli.errors import is_for_the_caller, one_line


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: arguments after the program's name; None takes those of the process.
    Returns: exit status: 0; 2 after an error, told in one line on stderr; 130 after Ctrl-C. Finished files stay.
    """
    try:
        arguments = parser.build().parse_args(argv)
        arguments.command(arguments)
        sys.stdout.flush()  # a reader that left is noticed here, not while the interpreter ends
    except KeyboardInterrupt as interruption:
        told = " ".join(str(interruption).split()) or "interrupted: the same command goes on with what was finished"
        print(f"torch-ssao: {told}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # `torch-ssao scenes | head -1`: nothing is left to tell anybody
        return 0
    except (ValueError, OSError, ImportError) as error:
        if not is_for_the_caller(error):
            raise
        print(f"torch-ssao: error: {one_line(error)}", file=sys.stderr)
        return 2
    return 0


def run() -> NoReturn:
    """`main` as the installed command: ends the process with its exit status."""
    sys.exit(main())
