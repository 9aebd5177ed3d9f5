"""What must hold on the forward path whatever the identity: scale, joints, T-pose, orthonormality."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import scipy.sparse
import torch
from omegaconf import DictConfig
from torch import Tensor

from soma_core.backends.parameters import batch_parameters
from soma_core.evaluation.report import Figure, Report
from soma_core.geometry.rotations import orthonormality_error
from soma_core.layer import SomaLayer
from soma_core.plugin.registry import default_registry
from soma_core.shape_space.sampling import sample_parameters
from soma_core.skeleton.fit import SkeletonFit
from soma_core.skeleton.joints import joint_regressor
from soma_core.stored_matrix import StoredMatrix
from soma_core.tensor_archive import read_tensor_archive
from soma_core.topology.correspondence import load_correspondence
from soma_core.topology.fill import FillOperator, build_fill
from soma_core.topology.transfer import make_transfer

__all__ = ["run"]


def _scale_errors(layer: SomaLayer, params: dict[str, Tensor]) -> list[Figure]:
    """Scale the native mesh and compare the transfers, bags included and filled."""
    spec, mesh = layer.spec, layer.mesh
    assert spec.wrap is not None
    correspondence = load_correspondence(spec.wrap, mesh)
    generator = default_registry().generator(layer.backend, device=layer.device, dtype=layer.dtype)
    native = generator.rest(batch_parameters(spec, params, device=layer.device, dtype=layer.dtype))
    transfer = make_transfer(spec, mesh, correspondence, dtype=layer.dtype, device=layer.device)
    regions = build_fill(correspondence.wrap_vertices, mesh.triangles, mesh.face_interior.astype(np.int64))
    transfer.fill = FillOperator(regions, dtype=layer.dtype, device=layer.device)
    reference = transfer(native)
    figures = []
    for factor in (0.6, 100.0):
        error = (transfer(factor * native) / factor - reference).abs().max() / reference.abs().max()
        figures.append(
            Figure(name=f"transfer of a mesh scaled by {factor:g}, relative", value=float(error), bound=1e-6)
        )
    return figures


def _package_regressor() -> scipy.sparse.csr_array | None:
    """The joint regressor inside the anny package, an independent build of the same idea."""
    spec = importlib.util.find_spec("anny")
    if spec is None or not spec.submodule_search_locations:
        return None
    path = Path(spec.submodule_search_locations[0]) / "data" / "soma" / "soma_rig.pt"
    stored = read_tensor_archive(path, fix="Install anny again.", sparse=StoredMatrix.csr)
    return scipy.sparse.csr_array(stored["sparse_rbf_matrix"], dtype=np.float64)


def _joint_figures(layer: SomaLayer, rest: np.ndarray) -> list[Figure]:
    mesh, rig = layer.mesh, layer.rig
    ours = joint_regressor(mesh, rig)
    at_bind = np.abs(ours @ rig.bind_shape - rig.bind_world[:, :3, 3])[1:].max()
    figures = [
        Figure(name="joints at the bind shape against the rig", value=1e3 * at_bind, unit="mm", bound=1e-4)
    ]
    theirs = _package_regressor()
    if theirs is not None:
        difference = max(np.abs(ours @ body - theirs @ body)[1:].max() for body in rest)
        figures.append(
            Figure(
                name="joints against the anny package's regressor",
                value=1e3 * difference,
                unit="mm",
                bound=1e-3,
            )
        )
    return figures


@torch.no_grad()
def run(config: DictConfig) -> Report:
    """Check `config.experiment.count` random identities of `config.experiment.backend`, in float64."""
    layer = SomaLayer(config.experiment.backend, dtype=torch.float64, exact=True)
    groups = {parameter.group for parameter in layer.spec.params if parameter.group}
    random = np.random.default_rng(config.seed)
    drawn = sample_parameters(layer.spec, config.experiment.count, random, skip_groups=groups)
    params = {name: torch.as_tensor(value) for name, value in drawn.items()}
    identity = layer.identity(params)
    single = SomaLayer(config.experiment.backend)
    single_identity = single.identity({name: value.float() for name, value in params.items()})
    posed = layer.pose(identity, torch.zeros(1, len(layer.joint_names), 3, dtype=torch.float64))
    t_pose = torch.as_tensor(layer.rig.t_pose_world[:, :3, :3].copy())
    turned = (posed.transforms[..., :3, :3] - t_pose).abs().max()
    fit = SkeletonFit(layer.mesh, layer.rig, dtype=torch.float64, device="cpu")
    refit = fit(identity.rest) - identity.bind_world
    figures = _scale_errors(layer, params) if layer.spec.wrap else []
    figures += _joint_figures(layer, identity.fitted_rest.numpy())
    figures += [
        Figure(name="zero pose: rotations against the T-pose", value=float(turned), bound=1e-6),
        Figure(
            name="fitted rotations, float32: |R^T R - I|",
            value=float(orthonormality_error(single_identity.fitted_world[..., :3, :3].double()).max()),
            bound=1e-6,
        ),
        Figure(
            name="joints fitted again to the reposed body",
            value=1e3 * float(refit[..., :3, 3].norm(dim=-1).mean()),
            unit="mm",
        ),
    ]
    return Report(
        title=f"Forward path on {config.experiment.count} identities of {layer.backend}", figures=figures
    )
