"""Other implementations of the same work, each in its own environment.

``py-soma-x`` takes its assets from a hub; ``build`` makes what it needs from ours, in its documented
layout, so that both run on the same rig, mesh and shape space.

    python benchmarks/peers.py build FOLDER          make the peer's assets (in this project's environment)
    python benchmarks/peers.py py-soma-x FOLDER BACKEND THREADS      worker (in the peer's environment)
    python benchmarks/peers.py py-soma-x-inversion FOLDER THREADS    worker: pose inversion (there too)
    python benchmarks/peers.py anny THREADS                          worker: the anny package's own SOMA rig
"""

from __future__ import annotations

import importlib.metadata
import json
import shutil
import sys
from pathlib import Path

import numpy as np

SEGMENTS = (
    "head", "feet", "torso", "mouth_bag", "eye_bags", "between_toes", "hair", "haircap", "armpits",
)  # fmt: skip
PHENOTYPES = ("gender", "age", "muscle", "weight", "height", "proportions")


def build(folder: Path) -> None:
    """Write ``SOMA_neutral.npz`` with the rig inside, as version 0.1 reads it, and the Anny pair."""
    from soma_core.plugin.registry import default_registry
    from soma_core.rig import load_canonical
    from soma_core.rig.neutral import load_shape_space

    mesh, rig = load_canonical("mid")
    low, _ = load_canonical("low")
    space = load_shape_space()
    parents = np.maximum(rig.parents, 0).astype(np.int32)

    def centimetres(transforms: np.ndarray) -> np.ndarray:
        scaled = np.array(transforms)
        scaled[:, :3, 3] *= 100
        return scaled

    def local(world: np.ndarray) -> np.ndarray:
        result = np.linalg.inv(world[parents]) @ world
        result[0] = world[0]
        return result.astype(np.float32)

    bind, pose = centimetres(rig.bind_world), centimetres(rig.t_pose_world)
    columns = rig.weights.tocsc()
    empty = np.zeros(0, np.int32)
    segments = {f"segment_{name}": mesh.segments.get(name, empty) for name in SEGMENTS}
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "SOMA_neutral.npz",
        mean=space.mean, shapedirs=space.shapedirs, eigenvalues=space.eigenvalues,
        triangles=mesh.triangles, triangles_low=low.triangles, lod_mid_to_low=low.mid_ids,
        face_vert_indices=mesh.face_vert_indices, face_vert_counts=mesh.face_vert_counts,
        face_vert_indices_low=low.face_vert_indices, face_vert_counts_low=low.face_vert_counts,
        joint_names=np.array(rig.joint_names), joint_parent_ids=parents,
        bind_pose_world=bind.astype(np.float32), bind_pose_local=local(bind),
        t_pose_world=pose.astype(np.float32), t_pose_local=local(pose),
        bind_shape=(100 * rig.bind_shape).astype(np.float32),
        skinning_weights_data=columns.data.astype(np.float32), skinning_weights_indices=columns.indices,
        skinning_weights_indptr=columns.indptr, skinning_weights_shape=np.array(columns.shape),
        metadata=np.array(json.dumps({"units": "cm"})), **segments,
    )  # fmt: skip
    pair = default_registry().spec("anny").wrap
    (folder / "Anny").mkdir(exist_ok=True)
    shutil.copy(pair.native, folder / "Anny" / "base_body.obj")
    shutil.copy(pair.wrap, folder / "Anny" / "SOMA_wrap.obj")


def serve_py_soma_x(folder: str, backend: str, threads: str) -> None:
    import torch
    from soma import SOMALayer
    from worker import serve

    torch.set_num_threads(int(threads))
    layer = SOMALayer(Path(folder), device="cpu", identity_model_type=backend, mode="warp")
    scales = {} if backend == "anny" else None

    def coefficients(inputs: dict[str, np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(inputs["shape"]) if backend == "soma" else _phenotypes(layer, inputs)

    def prepare(case, inputs):
        poses, shift = torch.from_numpy(inputs["poses"]), torch.from_numpy(inputs["translation"])
        given = coefficients(inputs)

        def forward():
            return layer(poses, given, scale_params=scales, transl=shift, apply_correctives=False)["vertices"]

        if case == "forward":
            return torch.no_grad()(forward)
        if case == "pose":
            with torch.no_grad():
                layer.prepare_identity(given[:1], scales, repose_to_bind_pose=False)
            return torch.no_grad()(
                lambda: layer.pose(poses, transl=shift, apply_correctives=False)["vertices"]
            )
        tracked = [tensor.requires_grad_() for tensor in (poses, shift, given)]

        def both():
            for tensor in tracked:
                tensor.grad = None
            vertices = forward()
            vertices.square().mean().backward()
            return vertices.detach()

        return both

    versions = {name: importlib.metadata.version(name) for name in ("py-soma-x", "torch", "warp-lang")}
    serve(prepare, {"implementation": "py-soma-x", **versions})


def _phenotypes(layer, inputs: dict[str, np.ndarray]):
    """Anny's parameters in the order of the peer's model; those that are not given stay in the middle."""
    import torch

    labels = list(layer.identity_model.identity_model.anny_model.phenotype_labels)
    values = torch.full((len(inputs["phenotypes"]), len(labels)), 0.5)
    for index, name in enumerate(PHENOTYPES):
        values[:, labels.index(name)] = torch.from_numpy(inputs["phenotypes"][:, index])
    return values


INVERSIONS = {
    "analytical": {"body_iters": 2, "full_iters": 1},
    "autograd": {"body_iters": 0, "full_iters": 0, "autograd_iters": 100},
    "analytical_autograd": {"body_iters": 2, "full_iters": 1, "autograd_iters": 100},
}
"""Settings of the paper's rows; its first row, the skeleton transfer, is not among what ``fit`` offers."""


def _skeleton_transfer(inversion, vertices, parents: np.ndarray) -> dict:
    """Local rotations (frames, J, 3, 3) and Hips positions from the peer's skeleton fit alone."""
    world = inversion._skel_transfer.fit(vertices)
    turns = world[..., :3, :3]
    local = turns[:, parents].transpose(-1, -2) @ turns
    local[:, 1] = turns[:, 1]  # Root, which is virtual, does not turn
    return {"rotations": local, "root_translation": world[:, 1, :3, 3]}


def serve_py_soma_x_inversion(folder: str, threads: str) -> None:
    import torch
    from soma import SOMALayer
    from soma.pose_inversion import PoseInversion
    from worker import Work, serve

    torch.set_num_threads(int(threads))
    layer = SOMALayer(Path(folder), device="cpu", identity_model_type="anny", mode="warp")
    with np.load(Path(folder) / "SOMA_neutral.npz", allow_pickle=False) as file:
        low, parents = torch.from_numpy(file["lod_mid_to_low"]).long(), file["joint_parent_ids"]

    def prepare(case, inputs):
        lod, method = case.split("/")
        given, own = _phenotypes(layer, inputs), "vertices" not in inputs

        def pose(rotations, shift, **options):
            layer.prepare_identity(given, {}, repose_to_bind_pose=own)
            return layer.pose(rotations, transl=shift, apply_correctives=False, **options)["vertices"]

        with torch.no_grad():
            if own:
                target = pose(torch.from_numpy(inputs["poses"]), torch.from_numpy(inputs["translation"]))
            else:
                target = torch.from_numpy(inputs["vertices"])
        seen = target[:, low].contiguous() if lod == "low" else target
        # One that has served another identity gives wrong answers.
        inversion = PoseInversion(layer, low_lod=lod == "low")
        inversion.prepare_identity(given, {}, repose_to_bind_pose=own)

        @torch.no_grad()
        def array(found):
            rotations, shift = found["rotations"].detach(), found["root_translation"].detach()
            posed = pose(rotations[:, 1:], shift, pose2rot=False, absolute_pose=True)
            return torch.stack([posed, target]).numpy()

        if method == "skeleton_transfer":
            return Work(torch.no_grad()(lambda: _skeleton_transfer(inversion, seen, parents)), array)
        return Work(lambda: inversion.fit(seen, **INVERSIONS[method]), array)

    versions = {name: importlib.metadata.version(name) for name in ("py-soma-x", "torch", "warp-lang")}
    serve(prepare, {"implementation": "py-soma-x", **versions})


def serve_anny(threads: str) -> None:
    import anny
    import torch
    from worker import serve

    torch.set_num_threads(int(threads))
    model = anny.Anny(rig="soma", topology="soma", phenotypes="all", pose_parameterization="local-ref")
    model = model.to(torch.float32)

    def prepare(case, inputs):
        if case != "forward":
            raise ValueError(f"case {case!r}: only the forward pass is compared with the anny package")
        import roma

        poses = torch.from_numpy(inputs["poses"])
        values = torch.from_numpy(inputs["phenotypes"])
        given = {name: values[:, index] for index, name in enumerate(PHENOTYPES)}

        def forward():
            deltas = torch.eye(4).repeat(len(poses), 78, 1, 1)
            deltas[:, 1:, :3, :3] = roma.rotvec_to_rotmat(poses)
            return model(pose_parameters=deltas, phenotype_kwargs=given)["vertices"]

        return torch.no_grad()(forward)

    versions = {name: importlib.metadata.version(name) for name in ("anny", "torch", "warp-lang")}
    serve(prepare, {"implementation": "anny", **versions})


if __name__ == "__main__":
    verb, *rest = sys.argv[1:]
    if verb == "build":
        build(Path(rest[0]))
    elif verb == "py-soma-x":
        serve_py_soma_x(*rest)
    elif verb == "py-soma-x-inversion":
        serve_py_soma_x_inversion(*rest)
    elif verb == "anny":
        serve_anny(*rest)
    else:
        sys.exit(f"unknown verb {verb!r}; see the top of this file")
