"""Every Warp kernel compiles for CUDA, here without a GPU: files are found, and so are the kernels in them.

A kernel is covered if it is a global of its module or comes out of a cached factory there: a function under
``functools.cache`` of `scalar` and, where it has them, of `lanes` and of switches annotated ``bool``, that
returns the kernel, alone or in a tuple or namespace. What a GPU uses is compiled: one lane, float32, every
setting of the switches.
"""

import ast
import importlib
import inspect
import itertools
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import warp as wp

import soma_core.kernels
from soma_core.kernels._runtime import start

ARCHITECTURE = 90
"""Compute capability of the GPUs that the project is measured on, times ten."""
FOLDER = Path(soma_core.kernels.__file__).parent
ROOT = FOLDER.parents[1]
FILES = sorted(FOLDER.glob("*_wp.py"))

LONG = ("pose_steps_wp", "pose_solver_wp", "skeleton_fit_wp", "twist_share_wp")
"""Files that take a compiler for CUDA four to fifteen seconds each, three fifths of all."""

CPU_ONLY = {"descent_wp.descent": "a GPU takes the steps of a descent one by one, with blocks for patches"}
"""Kernels without a version for CUDA, as ``file_wp.kernel``, and why it takes another one there."""


def defined_kernels(path: Path) -> dict[int, str]:
    """Kernels in a source file: number of the line of their decorator, and ``file.kernel``."""
    found: dict[int, str] = {}
    text = path.read_text(encoding="utf-8")
    if "kernel" not in text:
        return found
    for node in ast.walk(ast.parse(text)):
        for decorator in getattr(node, "decorator_list", ()):
            called = decorator.func if isinstance(decorator, ast.Call) else decorator
            if ast.unparse(called).rpartition(".")[2] == "kernel":
                found[min(one.lineno for one in node.decorator_list)] = f"{path.stem}.{node.name}"
    return found


def settings(factory) -> Iterator[dict[str, object]]:
    """Arguments with which a GPU calls a factory; none if it has parameters of another kind."""
    values = {"scalar": ["float32"], "lanes": [1]}
    parameters = inspect.signature(factory, eval_str=True).parameters
    choices = [
        values.get(name, [False, True] if parameter.annotation is bool else [])
        for name, parameter in parameters.items()
    ]
    for choice in itertools.product(*choices):
        yield dict(zip(parameters, choice, strict=True))


def kernels_in(value: object) -> Iterator[wp.Kernel]:
    if isinstance(value, wp.Kernel):
        yield value
    elif isinstance(value, tuple):
        yield from itertools.chain.from_iterable(map(kernels_in, value))
    elif isinstance(value, SimpleNamespace):
        yield from kernels_in(tuple(vars(value).values()))


def made_kernels(module: ModuleType) -> list[wp.Kernel]:
    """Kernels of a module as a GPU uses them."""
    mine = [one for one in vars(module).values() if getattr(one, "__module__", None) == module.__name__]
    factories = [one for one in mine if hasattr(one, "cache_info")]
    made = [
        factory(**values)
        for factory in factories
        if "scalar" in inspect.signature(factory).parameters
        for values in settings(factory)
    ]
    return list(kernels_in((*vars(module).values(), *made)))


def line_of(kernel: wp.Kernel) -> tuple[str, int]:
    code = kernel.func.__code__
    return code.co_filename, code.co_firstlineno


@pytest.fixture(scope="module", autouse=True)
def _compiler():
    start()
    if ARCHITECTURE not in wp.get_cuda_supported_archs():
        pytest.skip("this build of Warp has no compiler for CUDA")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_kernel_is_compiled_here(path):
    made = made_kernels(importlib.import_module(f"soma_core.kernels.{path.stem}"))
    covered = {line for name, line in map(line_of, made) if name == str(path)}
    missed = {name for line, name in defined_kernels(path).items() if line not in covered} - CPU_ONLY.keys()
    assert not missed, f"no cached factory makes {missed} of `scalar`, `lanes` and switches; see {__file__}"


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=[pytest.mark.slow] * (path.stem in LONG), id=path.stem) for path in FILES],
)
def test_compiles_for_cuda(path, tmp_path):
    made = made_kernels(importlib.import_module(f"soma_core.kernels.{path.stem}"))
    for module in {kernel.module for kernel in made}:
        (binary,) = wp.compile_aot_module(module, arch=[ARCHITECTURE], module_dir=tmp_path)
        assert binary.parent == tmp_path
        assert f"sm{ARCHITECTURE}" in binary.name
        assert binary.stat().st_size > 0


def test_kernels_lie_where_they_are_looked_for():
    elsewhere = {*ROOT.glob("soma_core/**/*.py"), *ROOT.glob("plugins/*/soma_backend_*/**/*.py")} - {*FILES}
    assert not {path: found for path in sorted(elsewhere) if (found := defined_kernels(path))}
    assert len(FILES) > 8


def test_a_gpu_compiles_kernels_of_one_identity_and_of_many_once():
    made = [
        [factory("float32", 1, shared=shared) for shared in (True, False)]
        for path in FILES
        for factory in vars(importlib.import_module(f"soma_core.kernels.{path.stem}")).values()
        if hasattr(factory, "cache_info") and "shared" in inspect.signature(factory).parameters
        and "lanes" in inspect.signature(factory).parameters
    ]  # fmt: skip
    assert len(made) > 2
    assert all(one is each for one, each in made)


def test_what_is_for_the_cpu_only_exists_and_says_why():
    known = {name for path in FILES for name in defined_kernels(path).values()}
    assert known >= CPU_ONLY.keys()
    assert all(CPU_ONLY.values())


SOURCE = """
import functools
import warp as wp

@functools.cache
def _kernel(scalar: str, {parameter}):
    @wp.kernel(module=wp.get_module(f"soma_test_aot_{{scalar}}"), enable_backward=False)
    def double(x: wp.array(dtype=getattr(wp, scalar))):
        x[wp.tid()] += x[wp.tid()]
    return {result}
"""


@pytest.mark.parametrize(
    ("parameter", "result", "count"),
    [("lanes: int", "double", 1), ("*, shared: bool", "double, 3", 2), ("width: int", "double", 0)],
)
def test_a_kernel_is_found_or_missed_by_name(site, parameter, result, count):
    path = site / "probe_of_aot_wp.py"
    path.write_text(SOURCE.format(parameter=parameter, result=result))
    made = made_kernels(importlib.import_module(path.stem))
    assert len(made) == count
    (line,) = defined_kernels(path)
    assert defined_kernels(path)[line] == f"{path.stem}.double"
    assert {line_of(kernel) for kernel in made} == ({(str(path), line)} if count else set())
