"""Every Warp kernel on the device against the torch reference in float64 on the CPU, values and gradients."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from gpu_bench import Bench
from torch import Tensor

from soma_core.animation.kinematics import Kinematics
from soma_core.animation.skinning import Skinning
from soma_core.geometry.kabsch import rotation_from_covariance
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion.moments import SkinMoments
from soma_core.inversion.structure import skin_structure
from soma_core.kernels import model_residual
from soma_core.rig import load_canonical
from soma_core.skeleton.fit import SkeletonFit
from soma_core.skeleton.identity import Identity
from soma_core.skeleton.rotations import RotationFit

__all__ = ["DTYPES", "Twin", "compared", "kernels", "randn"]

DTYPES = (torch.float32, torch.float64)
CPU = torch.device("cpu")
Values = tuple[Tensor, ...]
Function = Callable[..., Values]


@dataclass(frozen=True, kw_only=True, eq=False)
class Twin:
    """One kernel, and its reference.

    Attributes:
        build: (dtype, device, warp) -> function of the inputs.
        inputs: float64 on the CPU.
        bounds: largest error in float32 and float64.
        relative: to the largest entry of each output rather than absolute (metres, entries of rotations).
        slopes: bounds of gradients, relative to the largest entry; None without a derivative.
        double_only: float32 has no digits left of it.
    """

    name: str
    build: Callable[..., Function]
    inputs: Values
    bounds: tuple[float, float] = (1e-5, 1e-10)
    relative: bool = False
    slopes: tuple[float, float] | None = None
    double_only: bool = False


def randn(*shape: int, seed: int = 0) -> Tensor:
    """Normal numbers in float64 that depend on the seed alone."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def turns_of(count: int, joints: int, spread: float, seed: int) -> Tensor:
    return axis_angle_to_matrix(spread * randn(count, joints, 3, seed=seed))


def compared(twin: Twin, dtype: torch.dtype, device: torch.device) -> dict:
    """Largest errors of values and gradients, in the units of their bounds."""
    which = DTYPES.index(dtype)
    rounded = [part.to(dtype) for part in twin.inputs]  # rounding of the inputs is nobody's error
    begin = time.perf_counter()
    found = _values(twin.build(dtype, device, warp=True), [part.to(device) for part in rounded], twin)
    if device.type == "cuda":
        torch.cuda.synchronize()
    first = time.perf_counter() - begin
    expected = _values(twin.build(torch.float64, CPU, warp=False), [part.double() for part in rounded], twin)
    row = {"dtype": str(dtype)[6:], "first_s": round(first, 2), "bound": twin.bounds[which]}
    row["error"] = max(map(functools.partial(_error, relative=twin.relative), found[0], expected[0]))
    row["ok"] = row["error"] <= row["bound"]
    if twin.slopes is not None:
        row["gradient_bound"] = twin.slopes[which]
        row["gradient_error"] = max(map(functools.partial(_error, relative=True), found[1], expected[1]))
        row["ok"] = row["ok"] and row["gradient_error"] <= row["gradient_bound"]
    return row


def _values(function: Function, inputs: list[Tensor], twin: Twin) -> tuple[Values, Values]:
    if twin.slopes is None:
        with torch.no_grad():
            return function(*inputs), ()
    leaves = [part.detach().clone().requires_grad_() for part in inputs]
    found = function(*leaves)
    pulls = [randn(*part.shape, seed=99 + number).to(part) for number, part in enumerate(found)]
    loss = sum((part * pull).sum() for part, pull in zip(found, pulls, strict=True))
    return tuple(part.detach() for part in found), torch.autograd.grad(loss, leaves)


def _error(found: Tensor, expected: Tensor, *, relative: bool) -> float:
    """Largest difference; infinite where one is no number and the other is."""
    found = found.detach().cpu().double()
    expected = expected.expand_as(found)
    known = expected.isfinite()
    if not torch.equal(known, found.isfinite()):
        return float("inf")
    if not known.any():
        return 0.0
    off = float((found[known] - expected[known]).abs().max())
    return off / max(float(expected[known].abs().max()), 1e-30) if relative else off


def kernels(bench: Bench) -> None:
    """A row for each kernel and precision."""
    from gpu_solver import solver_twins

    count = 3 if bench.quick else 40
    lod = "low" if bench.quick else "mid"
    twins = [twin for make in (forward_twins, fit_twins, solver_twins) for twin in make(lod, count)]
    for dtype in DTYPES:
        for twin in twins:
            if twin.double_only and dtype == torch.float32:
                continue
            call = functools.partial(compared, twin, dtype, bench.device)
            bench.row(f"{twin.name} {str(dtype)[6:]}", call)


def forward_twins(lod: str, count: int) -> Iterator[Twin]:
    """Of the layer."""
    mesh, rig = load_canonical(lod)
    joints = rig.joint_count
    bind = torch.tensor(rig.bind_world).repeat(count, 1, 1, 1)
    bind[:, 1:, :3, 3] = 0.9 * bind[:, 1:, :3, 3] + 0.02 * randn(count, joints - 1, 3, seed=1)
    bind[:, 1:, :3, :3] = turns_of(count, joints - 1, 0.1, 2) @ bind[:, 1:, :3, :3]
    turns = turns_of(count, joints - 1, 0.5, 3)

    def walk(dtype: torch.dtype, device: torch.device, *, warp: bool) -> Function:
        run = Kinematics(rig, dtype=dtype, device=device, warp=warp)
        return lambda bind, turns, shift: tuple(run(turns, run.local_offsets(bind), shift))

    yield Twin(name="kinematics", build=walk, inputs=(bind, turns, randn(count, 3, seed=4)),
               slopes=(1e-4, 1e-8))  # fmt: skip

    def skinning(dtype: torch.dtype, device: torch.device, *, warp: bool) -> Function:
        run = Skinning(rig.weights, dtype=dtype, device=device)
        if not warp:
            return lambda rest, moves: (run(rest.permute(2, 1, 0), moves, rows=True),)
        from soma_core.kernels.skinning_wp import skin

        return lambda rest, moves: (skin(rest, moves, run.weights.csr, run.weights.transpose),)

    few = min(count, 8)
    rest = torch.tensor(mesh.vertices)[None] + 0.02 * randn(few, mesh.vertex_count, 3, seed=5)
    moves = randn(few, joints, 3, 4, seed=6)
    yield Twin(name="skinning", build=skinning, inputs=(rest, moves), slopes=(1e-4, 1e-8))

    fit = SkeletonFit(mesh, rig, dtype=torch.float64, device=CPU)
    flat = rest.permute(1, 2, 0).reshape(mesh.vertex_count, -1)
    moments = fit.moments(flat).view(joints, 4, 3, few).permute(3, 0, 1, 2)

    def rotations(dtype: torch.dtype, device: torch.device, *, warp: bool) -> Function:
        run = RotationFit(rig, dtype=dtype, device=device, warp=warp)
        return lambda places, covariances: (run(places, covariances),)

    given = moments[:, :, 0].contiguous(), moments[:, :, 1:].mT.contiguous()
    # Covariances of fingers are known to few digits in float32; this is no comparison of twins.
    yield Twin(name="skeleton_fit", build=rotations, inputs=given, bounds=(2e-4, 1e-10), slopes=(5e-3, 1e-7))
    yield from _matrix_twins()


def _matrix_twins() -> Iterator[Twin]:
    def nearest(dtype: torch.dtype, device: torch.device, *, warp: bool) -> Function:  # noqa: ARG001
        if not warp:
            return lambda given: (rotation_from_covariance(given),)
        from soma_core.kernels.nearest_rotation_wp import nearest_rotation

        return lambda given: (nearest_rotation(given),)

    left, right = (torch.linalg.qr(randn(500, 3, 3, seed=seed))[0] for seed in (1, 2))
    left, right = (basis * torch.linalg.det(basis)[:, None, None] for basis in (left, right))
    stretch = torch.diag_embed(torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64) + 0.01 * randn(500, 3))
    yield Twin(name="nearest_rotation", build=nearest, inputs=(left @ stretch @ right.mT,),
               bounds=(2e-5, 1e-10))  # fmt: skip

    def frames(dtype: torch.dtype, device: torch.device, *, warp: bool) -> Function:  # noqa: ARG001
        crow, col = torch.arange(0, 3 * 200 + 1, 3), torch.arange(600) % 7

        def run(moves: Tensor, moments: Tensor, centre: Tensor) -> Values:
            if not warp:
                from soma_core.correctives.frames import surface_frames_reference

                return (surface_frames_reference(moves, crow, col, moments, centre),)
            from soma_core.kernels.surface_frames_wp import surface_frames

            return (surface_frames(moves, crow.to(device), col.to(device), moments, centre),)

        return run

    moments = 0.1 * randn(600, 4, 3, seed=3)
    moments[:, :3] += torch.eye(3)
    moves = torch.cat((turns_of(5, 7, 0.3, 4), 0.1 * randn(5, 7, 3, 1, seed=5)), -1)
    yield Twin(name="surface_frames", build=frames, inputs=(moves, moments, 0.3 * randn(200, 3, seed=6)),
               bounds=(1e-4, 1e-10))  # fmt: skip


def fit_twins(lod: str, count: int) -> Iterator[Twin]:
    """Of moments and of what a pose leaves of its target."""
    mesh, rig = load_canonical(lod)
    fitted = torch.ones(mesh.vertex_count, dtype=torch.bool)
    fitted[torch.as_tensor(mesh.face_interior.copy())] = False
    structure = skin_structure(rig, fitted.numpy())
    few = min(count, 9)
    rest = torch.tensor(mesh.vertices)[None] + 0.003 * randn(few, mesh.vertex_count, 3, seed=1)
    bind = torch.tensor(rig.bind_world).repeat(few, 1, 1, 1)
    bind[:, 1:, :3, 3] += 0.003 * randn(few, rig.joint_count - 1, 3, seed=2)
    weights = (0.5 + randn(few, mesh.vertex_count, seed=3).abs()) * fitted
    seen = rest @ turns_of(few, 1, 0.3, 4)[:, 0].mT[:, :, :] + randn(few, 1, 3, seed=5)

    def moments(*, each: bool) -> Callable[..., Function]:
        def build(dtype: torch.dtype, device: torch.device, *, warp: bool) -> Function:
            run = SkinMoments(structure, rig, dtype=dtype, device=device, warp=warp)
            offsets = Kinematics(rig, dtype=dtype, device=device).local_offsets

            def made(seen: Tensor, rest: Tensor, bind: Tensor, weights: Tensor) -> Values:
                who = Identity(rest=rest, bind_world=bind, fitted_rest=rest, fitted_world=bind)
                if each:
                    sums, target, _ = run.each(seen, who, weights, offsets(bind))
                    return sums.own, sums.second, target
                sums = run.rest(who, weights, offsets(bind))
                return sums.own, sums.second, run.target(seen, sums)[0]

            return made

        return build

    bounds = {"bounds": (3e-5, 1e-9), "relative": True}
    yield Twin(name="rest and skin moments", build=moments(each=False),
               inputs=(seen, rest[:1], bind[:1], weights[:1]), **bounds)  # fmt: skip
    yield Twin(name="frame moments", build=moments(each=True), inputs=(seen, rest, bind, weights), **bounds)

    def residual(dtype: torch.dtype, device: torch.device, *, warp: bool, patches: bool) -> Function:
        skin = Skinning(rig.weights, dtype=dtype, device=device).weights
        run = model_residual.ModelResidual(skin.csr, None, warp=warp, dtype=dtype, device=device)

        def made(rest: Tensor, weights: Tensor, moves: Tensor, seen: Tensor, origin: Tensor) -> Values:
            usual, model_residual.in_patches = model_residual.in_patches, lambda _tensor: patches
            found = run(rest, weights, moves, None, None, seen, origin, distances=True)
            model_residual.in_patches = usual
            return found.energy, found.forces, found.distances

        return made

    moves = 0.6 * randn(few, rig.joint_count, 3, 4, seed=6)
    for name, patches in (("model residual", False), ("residual by patches", True)):
        yield Twin(name=name, build=functools.partial(residual, patches=patches), relative=True,
                   bounds=(1e-4, 1e-11),
                   inputs=(rest[:1], weights[:1], moves, seen, randn(few, 3, seed=7)))  # fmt: skip
