"""Starting Warp: quiet, once, and precise about scalar types."""

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from soma_core.errors import InputError
from soma_core.kernels._runtime import loaded, scalar_name, start


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


def test_one_thread_compiles_whoever_launches(monkeypatch):
    threads, load = set(), wp.load_module
    monkeypatch.setattr(
        wp, "load_module", lambda *a, **k: (threads.add(threading.current_thread().name), load(*a, **k))
    )

    def kernel_of(number):
        def fill(out: wp.array(dtype=wp.float32)):
            out[wp.tid()] = wp.float32(number)

        return wp.kernel(fill, module=wp.get_module(f"soma_test_{number}"), enable_backward=False)

    start()
    with ThreadPoolExecutor(2) as pool:
        kernels = [kernel_of(number) for number in (0, 0, 1, 2)]
        assert list(pool.map(lambda kernel: loaded(kernel, "cpu"), kernels)) == kernels
    assert len(threads) == 1
    assert threads != {threading.current_thread().name}


def test_a_kernel_that_does_not_compile_says_so_at_every_launch():
    @wp.kernel(module=wp.get_module("soma_test_broken"))
    def broken(out: wp.array(dtype=wp.float32)):
        out[wp.tid()] = there_is_no_such_function(1.0)  # noqa: F821

    start()
    for _ in range(2):
        with pytest.raises(Exception, match="there_is_no_such_function"):
            loaded(broken, "cpu")
