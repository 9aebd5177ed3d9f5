"""Starting Warp: quiet, once, and precise about scalar types."""

import subprocess
import sys

import pytest
import torch

from soma_core.errors import InputError
from soma_core.kernels._runtime import scalar_name


@pytest.mark.parametrize(("dtype", "name"), [(torch.float32, "float32"), (torch.float64, "float64")])
def test_scalar_names(dtype, name):
    assert scalar_name(dtype) == name


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_other_scalars_are_refused_by_name(dtype):
    with pytest.raises(
        InputError, match=rf"dtype: got {dtype}, expected torch.float32 or torch.float64. .*'torch'"
    ):
        scalar_name(dtype)


def test_starting_prints_nothing():
    """A library that prints a banner breaks pipes; Warp does by default, also about a missing GPU."""
    code = "from soma_core.kernels._runtime import start; start()"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("", "")
