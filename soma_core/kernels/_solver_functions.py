"""Native functions of the pose solver's kernels."""

import functools
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import TypeVar

import warp as wp

from soma_core.kernels import _descent_text as descent
from soma_core.kernels import _matrix_text as matrix
from soma_core.kernels import _solver_text as text
from soma_core.kernels import _variance_text as variance
from soma_core.kernels import _view_text as view
from soma_core.kernels._native import native
from soma_core.kernels._runtime import once
from soma_core.kernels._share_text import SHARE
from soma_core.kernels._solver_layout import COUNTS, KEPT, LISTS, NUMBERS, SLOTS

__all__ = ["Task", "descent_functions", "of_identities", "share_function", "solver_functions"]

_ids, _Made = wp.array(dtype=wp.int32), TypeVar("_Made")


_BARE = {
    "assemble": matrix.ASSEMBLE, "twists": matrix.TWISTS, "modes": matrix.MODES, "factor": matrix.FACTOR,
    "forces": text.FORCES, "solve": text.SOLVE, "selected": variance.SELECTED, "keep": view.KEEP,
    "transform": view.TRANSFORM, "activate": view.ACTIVATE, "pull": view.PULL, "turn": view.TURN,
}  # fmt: skip
"""Bodies that take nothing but the lists and the memory."""


def of_identities(factory: Callable[..., _Made]) -> Callable[..., _Made]:
    """Cache what makes kernels for one identity or for one a frame; on a GPU the same ones take both."""
    made = once(factory)

    @once
    @functools.wraps(factory)
    def make(scalar: str, lanes: int, *, shared: bool) -> _Made:
        return made(scalar, lanes, shared=shared or lanes == 1)

    return make


@of_identities
def solver_functions(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    real = wp.array(dtype=getattr(wp, scalar))
    number = getattr(wp, scalar)

    def walk(plan: _ids, numbers: real, k: real, s: real, f: real, trial: int): ...

    def change(plan: _ids, numbers: real, k: real, s: real, f: real, begin: int): ...

    def copy(plan: _ids, numbers: real, k: real, s: real, f: real, forced: int): ...

    def terms(
        plan: _ids, numbers: real, k: real, s: real, f: real, softs: _ids, stiffs: real, reference: real,
        soft_count: int, hinge_end: int, stiffness: number, trial: int,
    ): ...  # fmt: skip

    def move(
        plan: _ids, numbers: real, k: real, s: real, f: real, stiffs: real, soft_count: int, hinge_end: int,
        longest: number, apart: int,
    ): ...  # fmt: skip

    def accept(
        plan: _ids, numbers: real, k: real, s: real, f: real, lower: number, higher: number, least: number,
        most: number,
    ) -> int:  # fmt: skip
        return 0

    def doubt(
        plan: _ids, numbers: real, k: real, s: real, f: real, columns: _ids, spins: real, squares: real,
        count: int,
    ): ...  # fmt: skip

    def root_turn(plan: _ids, numbers: real, k: real, s: real, f: real, damping_start: number): ...

    bodies = {
        "walk": (text.WALK, walk), "change": (text.CHANGE, change), "copy": (text.BEGIN, copy),
        "terms": (text.TERMS, terms), "move": (text.MOVE, move), "accept": (text.ACCEPT, accept),
        "still": (text.STILL, root_turn), "doubt": (view.DOUBT, doubt),
    }  # fmt: skip
    return _made({**bodies, **_bare(_BARE, real)}, scalar, lanes, shared=shared)


def _bare(texts: Mapping[str, str], real) -> dict:
    """Bodies that take nothing but the lists and the memory."""
    bodies = {}
    for name, body in texts.items():

        def stub(plan: _ids, numbers: real, k: real, s: real, f: real): ...

        stub.__name__ = name
        bodies[name] = body, stub
    return bodies


def _made(bodies: Mapping[str, tuple], scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    for _, stub in bodies.values():
        stub.__name__ += "_one" if shared else "_each"
    texts = {
        name: text.prelude(COUNTS, LISTS, NUMBERS, SLOTS, KEPT, body, lanes=lanes, shared=shared) + body
        for name, (body, _) in bodies.items()
    }
    return SimpleNamespace(
        **{name: native(texts[name], scalar, lanes, stub) for name, (_, stub) in bodies.items()}
    )


@of_identities
def descent_functions(scalar: str, lanes: int, *, shared: bool) -> SimpleNamespace:
    """Functions between those of the solver and of the model's residual, for a whole descent."""
    real = wp.array(dtype=getattr(wp, scalar))
    number = getattr(wp, scalar)

    def given(plan: _ids, numbers: real, k: real, s: real, f: real, turned: real, source: real): ...

    def brought(
        plan: _ids, numbers: real, k: real, s: real, f: real, forced: real, back: real, tile: real, at: int
    ): ...  # fmt: skip

    def weighed(
        plan: _ids, numbers: real, k: real, s: real, f: real, base: real, squares: real, count: int,
        first: int, unit: number, least: number,
    ): ...  # fmt: skip

    def combined(plan: _ids, numbers: real, k: real, s: real, f: real, clipped: int): ...

    def doubted(
        plan: _ids, numbers: real, k: real, s: real, f: real, columns: _ids, squares: real, count: int
    ): ...  # fmt: skip

    def begun(plan: _ids, numbers: real, k: real, s: real, f: real, again: int, growth: number): ...

    def mixed(plan: _ids, numbers: real, k: real, s: real, f: real, longest: number): ...

    def judged(
        plan: _ids, numbers: real, k: real, s: real, f: real, tolerance: number, share: number
    ) -> int:  # fmt: skip
        return 0

    def accepted(
        plan: _ids, numbers: real, k: real, s: real, f: real, noise: number, floor_: number,
        lower: number, raise_: number, least: number, most: number, shorten: number,
    ): ...  # fmt: skip

    bodies = {
        "given": (descent.GIVEN, given), "brought": (descent.BROUGHT, brought),
        "weighed": (descent.WEIGHED, weighed), "combined": (descent.COMBINED, combined),
        "doubted": (descent.DOUBTED, doubted), "begun": (descent.BEGUN, begun),
        "mixed": (descent.MIXED, mixed), "judged": (descent.JUDGED, judged),
        "accepted": (descent.ACCEPTED, accepted),
    }  # fmt: skip
    bare = {"taken": descent.TAKEN, "drawn": descent.DRAWN}
    return _made({**bodies, **_bare(bare, real)}, scalar, lanes, shared=shared)


@of_identities
def share_function(scalar: str, lanes: int, *, shared: bool) -> wp.Function:
    """Searches how limbs share their twist."""
    real = wp.array(dtype=getattr(wp, scalar))
    number = getattr(wp, scalar)

    def share(
        plan: _ids, numbers: real, k: real, s: real, f: real, limbs: _ids, values: real, angles: real,
        doubts: real, count: int, held: int, dear: number, clear_least: number,
    ): ...  # fmt: skip

    return _made({"share": (SHARE, share)}, scalar, lanes, shared=shared).share


@wp.struct
class Task:
    """Counts of one launch; groups begin .. end of frames."""

    begin: int
    end: int
    frames: int
    iterations: int
    forced: int
    soft_count: int
    hinge_end: int
    outcome: int
    apart: int
