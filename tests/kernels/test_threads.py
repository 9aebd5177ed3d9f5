"""Parts side by side: each in a thread of its own with one of torch's, and nothing else of torch changed."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest
import torch

from soma_core.kernels._runtime import once
from soma_core.kernels._threads import in_parts, in_threads, shared_out, side_by_side

MANY = torch.zeros(8)


@pytest.fixture
def two() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def _begins_with() -> int:
    """How many threads of torch a new thread begins with."""
    found: list[int] = []
    one = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    one.start()
    one.join()
    return found[0]


@pytest.mark.usefixtures("two")
def test_parts_are_alone_in_their_thread_and_the_caller_is_as_before():
    def run(part: int) -> tuple[int, int, str]:
        (MANY + part).sum()
        return part, torch.get_num_threads(), threading.current_thread().name

    with side_by_side(8, 4, MANY) as threads:
        assert (threads, torch.get_num_threads(), _begins_with()) == (2, 1, 2)
        found = in_parts(run, [3, 1, 2], threads)
    assert [one[:2] for one in found] == [(3, 1), (1, 1), (2, 1)]
    assert all(one[2].startswith("soma-lanes") for one in found)
    assert (torch.get_num_threads(), _begins_with()) == (2, 2)


@pytest.mark.usefixtures("two")
@pytest.mark.parametrize("mode", [torch.no_grad, torch.enable_grad, torch.inference_mode])
def test_gradients_are_followed_as_around_them(mode: Callable):
    with mode():
        expected = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
        found = in_parts(lambda _: (torch.is_grad_enabled(), torch.is_inference_mode_enabled()), [0, 1], 2)
    assert found == [expected, expected]


@pytest.mark.usefixtures("two")
def test_what_goes_wrong_in_a_part_is_told_and_threads_come_back():
    def run(part: int) -> None:
        if part:
            raise ValueError(f"part {part}")

    with pytest.raises(ValueError, match="part 1"), side_by_side(8, 2, MANY) as threads:
        in_parts(run, [0, 1, 2], threads)
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two")
def test_parts_start_no_threads_of_their_own():
    """They would wait for one another."""
    seen: list[slice] = []
    in_parts(lambda _: in_threads(seen.append, 5, MANY), [0, 1, 2], 2)
    assert seen == [slice(0, 5)] * 3
    assert in_parts(lambda _: in_parts(lambda part: part, [1, 2], 2), [0, 1], 2) == [[1, 2]] * 2


@pytest.mark.parametrize(
    ("count", "most", "threads", "parts"),
    [(0, 512, 1, 1), (1, 512, 1, 1), (2049, 2048, 1, 2), (600, 512, 2, 4)],
)
def test_frames_are_shared_out_evenly_in_whole_lanes(count: int, most: int, threads: int, parts: int):
    found = shared_out(count, most, threads)
    rows = [range(count)[part] for part in found]
    assert len(found) == parts
    assert [row for own in rows for row in own] == list(range(count))
    assert all(len(own) % 16 == 0 and len(own) - len(rows[-1]) < 16 * parts for own in rows[:-1])


@pytest.mark.usefixtures("two")
def test_few_are_not_shared_out():
    with side_by_side(7, 4, MANY) as threads:
        assert (threads, torch.get_num_threads()) == (1, 2)


def test_two_threads_make_one_thing():
    made: list[int] = []
    go = threading.Barrier(4)

    @once
    def make() -> int:
        made.append(threading.get_ident())
        return len(made)

    def ask() -> int:
        go.wait()
        return make()

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert len(made) == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_has_threads_of_its_own():
    code = """
import os, torch
from soma_core.kernels._threads import in_parts
torch.set_num_threads(2)
square = lambda part: float((torch.ones(4) * part).square().sum())
assert in_parts(square, [1, 2], 2) == [4, 16]
child = os.fork()
if child == 0:
    os._exit(0 if in_parts(square, [3, 1], 2) == [36, 4] else 1)
assert os.waitpid(child, 0)[1] == 0
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
