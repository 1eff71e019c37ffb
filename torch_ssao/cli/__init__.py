"""The command `torch-ssao`: parsing in `parser`, one function per command in `commands`, one line per error."""

from torch_ssao.cli.program import main as main
from torch_ssao.cli.program import run as run
