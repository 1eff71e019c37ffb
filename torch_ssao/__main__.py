"""`python -m torch_ssao` is the command `torch-ssao`."""

import sys

from torch_ssao.cli import main

if __name__ == "__main__":
    sys.exit(main())
