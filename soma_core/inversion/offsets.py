"""What a pose adds to the rest shape, as the fit sees it: activations, their slopes, and a few modes.

Offsets are ``sum_c a_c(pose) V_c`` with constant shapes V. Pose correctives and pose blend shapes are of this
form; they differ in how activations follow from the rotations: ``a = tanh(relu(W f))`` or ``a = f`` with f a
linear function of every joint's local rotation.

The derivative of the error is exact. Its Gauss-Newton matrix needs ``J_b^T J_b`` and ``J_s^T J_b``, where J_b
is the motion by offsets and J_s that by skinning. Both are read from moments that are made once: shapes of
one joint's activations are replaced by their largest modes, and vertices move as if each influence were
rigid. What that leaves out only changes the path to the minimum.
"""

from __future__ import annotations

import functools

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from soma_core.correctives.model import Correctives
from soma_core.geometry.constants import constant
from soma_core.geometry.rotations import skew
from soma_core.geometry.sparse import SparseRows
from soma_core.inversion.moments import RestMoments
from soma_core.inversion.problem import Activity
from soma_core.inversion.skin_equations import SkinEquations
from soma_core.rig.skeleton import Rig

__all__ = ["PoseOffsets"]

_FILLED = 0.1
"""Share of entries from which shapes are no longer treated as sparse."""

_LEAST_MODE = 1e-4
"""Root mean square motion of all vertices [m] below which a mode of one joint's shapes is left out."""


class PoseOffsets(torch.nn.Module):
    """Offsets of one rig and mesh.

    Args:
        left, right: (J, 3, 3); the features of joint j are the first columns of ``left_j R_j right_j``, less
            their value at the pose without offsets.
        still: (J, 3, columns) that value.
        first: W (C, 3 columns J); None where activations are the features.
        squash: apply tanh after relu; without `first` neither is applied.
        shapes: V (3 v, C), the three rows of a vertex together [m].
        owner: (C,) joint that each activation belongs to: activations of a joint share modes.
        rig: joints and weights that carry the skin, driven ones included.
        fitted: (v,) vertices that count.

    Attributes:
        reads, taken, gate, modes: blocks of the activations of one joint: the joints that they read (P, R),
            their ids (P, C'), their part of W (P, C', R, S), and their modes (P, K, C').
        gram: (P K, P K) products of modes.
        torque, force: (T, 3, P K) of modes on the weighted joints' clouds, in the joints' own axes.
        extent, mass: (T,) root mean square arm [m] and weight of each cloud.
        products: (C, C) of shapes, over the vertices that count.
        least: value of a mode there, below which it is left out.
    """

    def __init__(
        self,
        *,
        left: np.ndarray,
        right: np.ndarray,
        still: np.ndarray,
        first: scipy.sparse.csr_array | None,
        squash: bool,
        shapes: scipy.sparse.csr_array,
        owner: np.ndarray,
        rig: Rig,
        joints: np.ndarray,
        fitted: np.ndarray,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        super().__init__()
        self.squash, self.columns = squash, still.shape[-1]
        self.first = None if first is None else SparseRows(first, dtype=dtype, device=device)
        self.shapes = SparseRows(shapes, dtype=dtype, device=device)
        keep = functools.partial(constant, device=device, dtype=dtype)
        self.left = keep(left)
        self.right = keep(right)
        self.still = keep(still)
        blocks = _blocks(first, owner, len(left), 3 * self.columns)
        self.taken, self.reads, self.gate = (keep(blocks[name]) for name in ("taken", "reads", "gate"))
        counted = scipy.sparse.csr_array(scipy.sparse.diags_array(np.repeat(fitted * 1.0, 3)) @ shapes)
        part = counted if counted.nnz < _FILLED * np.prod(shapes.shape) else counted.toarray()
        self.products = scipy.sparse.csr_array(part.T @ part)
        self.least = _LEAST_MODE**2 * fitted.sum()
        modes, mixing = _modes(self.products, blocks["taken"], self.least)
        self.modes, self.gram = keep(modes), keep((mixing.T @ (self.products @ mixing)).toarray())
        made = {name: keep(array) for name, array in _moments(part, mixing, rig, joints, fitted).items()}
        self.torque, self.force = made["torque"], made["force"]
        self.extent, self.mass = made["extent"], made["mass"]

    @classmethod
    def of_correctives(
        cls,
        correctives: Correctives,
        rig: Rig,
        joints: np.ndarray,
        fitted: np.ndarray,
        *,
        some: np.ndarray | None = None,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> PoseOffsets:
        """Those of a layer's correctives, on the vertices `some`; the rest as of the class."""
        features = correctives.features
        left, right = (
            np.concatenate([np.zeros((1, 3, 3)), part.double().cpu().numpy()])
            for part in (features.left, features.right)
        )
        still = np.broadcast_to(np.eye(3)[:, :2], (len(left), 3, 2)).copy()
        still[0] = 0
        first, second = (rows.scipy() for rows in (correctives.first, correctives.second))
        if some is not None:
            second = second[(3 * some[:, None] + np.arange(3)).ravel()]
        return cls(
            left=left, right=right, still=still, first=first, squash=correctives.use_tanh, shapes=second,
            owner=correctives.owner, rig=rig, joints=joints, fitted=fitted, dtype=dtype, device=device,
        )  # fmt: skip

    def activity(self, relative: Tensor) -> Activity:
        """Activations of local rotations (F, J, 3, 3), the virtual root's included."""
        turned = (self.left @ relative @ self.right)[..., : self.columns] - self.still
        features = turned.flatten(1)
        if self.first is None:
            return Activity(value=features)
        before = self.first(_paired(features).T.contiguous()).T[: len(features)]
        value = self.squashed(before)
        rising = (before > 0).to(before)
        slope = rising * (1 - value * value) if self.squash else rising
        return Activity(value=value, before=before, slope=slope)

    def squashed(self, before: Tensor) -> Tensor:
        """Activations from what goes into them."""
        value = torch.relu(before)
        return torch.tanh(value) if self.squash else value

    def features(self, relative: Tensor, joint: int) -> Tensor:
        """Features (..., S) of local rotations (..., 3, 3) of one joint."""
        turned = (self.left[joint] @ relative @ self.right[joint])[..., : self.columns] - self.still[joint]
        return turned.flatten(-2)

    def seen_by(self, own: int, end: int) -> dict[str, Tensor]:
        """Activations that read either of two joints: their ids, how they read them, and their shapes.

        Shapes come in coordinates (c, r) of their own, of which small ones are left out.
        """
        width = 3 * self.columns
        reads = self.gate.new_zeros(self.shapes.shape[1] + 1, 2, width)
        for which, joint in enumerate((own, end)):
            block, place = torch.nonzero(self.reads == joint, as_tuple=True)
            reads[self.taken[block].flatten(), which] = self.gate[block, :, place].flatten(0, 1)
        ids = torch.nonzero((reads[:-1] != 0).any(-1).any(-1)).flatten()
        of = ids.cpu().numpy()
        values, vectors = np.linalg.eigh(self.products[of][:, of].toarray())
        kept = values > self.least
        coordinates = vectors[:, kept] * np.sqrt(values[kept])
        return {
            "ids": ids, "by_own": reads[ids, 0], "by_end": reads[ids, 1],
            "shapes": torch.as_tensor(coordinates).to(reads),
        }  # fmt: skip

    def slopes(self, pull: Tensor, activity: Activity, relative: Tensor, above: Tensor) -> Tensor:
        """Derivative (F, J, 3) by world turns of each joint, from that by activations (F, C).

        Args:
            pull: derivative of an energy by the activations.
            activity: of the pose.
            relative: (F, J, 3, 3) local rotations.
            above: (F, J, 3, 3) world turns of the parents.
        """
        if self.first is not None:
            assert activity.slope is not None
            pull = self.first.pull_back(_paired(pull * activity.slope))[: len(pull)]
        by_feature = pull.unflatten(1, (-1, 3, self.columns))
        by_rotation = self.left.mT @ by_feature @ self.right[..., : self.columns].mT
        product = relative @ by_rotation.mT
        spin = torch.stack(
            (
                product[..., 1, 2] - product[..., 2, 1],
                product[..., 2, 0] - product[..., 0, 2],
                product[..., 0, 1] - product[..., 1, 0],
            ),
            -1,
        )
        return (above @ spin[..., None]).squeeze(-1)

    def responses(self, activity: Activity, relative: Tensor, above: Tensor) -> Tensor:
        """How world turns of the joints that it reads move every mode, (F, P, K, R, 3)."""
        axes = skew(above)  # row a of `above`: the world's axis a in the axes of the parent
        turned = self.left[:, None] @ (axes @ relative[:, :, None]) @ self.right[:, None]
        change = turned[..., : self.columns].flatten(-2)  # (F, J, 3, S)
        change = torch.nn.functional.pad(change, (0, 0, 0, 0, 0, 1))[:, self.reads]  # (F, P, R, 3, S)
        gate = self.gate
        if activity.slope is None:
            seen = torch.einsum("pkc,pcrs->pkrs", self.modes, gate)
            return torch.einsum("pkrs,fpras->fpkra", seen, change)
        slope = torch.nn.functional.pad(activity.slope, (0, 1))[:, self.taken]  # (F, P, C')
        seen = torch.einsum("fpkc,pcrs->fpkrs", self.modes * slope[:, :, None], gate)
        return torch.einsum("fpkrs,fpras->fpkra", seen, change)

    def matrix(
        self,
        activity: Activity,
        relative: Tensor,
        turns: Tensor,
        places: Tensor,
        solver: SkinEquations,
        fold: Tensor | None,
        scale: Tensor,
        sizes: tuple[Tensor, Tensor],
    ) -> Tensor:
        """What to add to the matrix (F, n + 1, 3, n + 1, 3) of :meth:`SkinEquations.normal_equations`.

        Args:
            activity, relative: of the pose.
            turns, places: of all joints.
            solver: whose variables the matrix has.
            fold: of :meth:`SkinEquations.fold`; None without driven joints.
            scale: (F,) size of the bodies; moments are those of the canonical one.
            sizes: of :meth:`sizes`.
        """
        n, frames = len(solver.variables), len(turns)
        public = solver.public_count
        above = turns[:, solver.parents[:public]]
        response = self.responses(activity, relative, above)  # (F, P, K, R, 3)
        modes = response.shape[1] * response.shape[2]
        spread = turns.new_zeros(frames, modes, len(self.left) + 1, 3)
        index = self.reads.repeat_interleave(response.shape[2], 0)[None, :, :, None]
        spread.scatter_add_(2, index.expand(frames, -1, -1, 3), response.flatten(1, 2))
        spread = spread[:, :, solver.variables].flatten(2)  # (F, M, 3 n)
        size = scale[:, None, None]
        left = self._pulled(turns, places, solver, fold, sizes).flatten(1, 2)  # (F, 3 n + 3, M)
        left[:, : 3 * n] += 0.5 * size * sizes[1][:, -1:, None] * (self.gram @ spread).mT
        half = torch.nn.functional.pad(left @ spread, (0, 3))
        return ((half + half.mT) * size).unflatten(1, (n + 1, 3)).unflatten(3, (n + 1, 3))

    def sizes(self, rest: RestMoments) -> tuple[Tensor, Tensor]:
        """How a body and its vertex weights differ from what the moments were made of, (i, T) and (i, T + 1).

        Extent of every joint's cloud beside that of the canonical body; and its weight, beside that of all
        vertices that take part by default. The last entry is the largest weight: it bounds what modes weigh.
        """
        own = rest.own
        spread, mass = own[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1), own[..., 3, 3]
        extent = (spread / mass.clamp_min(torch.finfo(own.dtype).tiny)).sqrt() / self.extent
        share = mass / self.mass
        return extent, torch.cat((share, share.amax(1, keepdim=True)), 1)

    def _pulled(
        self,
        turns: Tensor,
        places: Tensor,
        solver: SkinEquations,
        fold: Tensor | None,
        sizes: tuple[Tensor, Tensor],
    ) -> Tensor:
        """Torque of every mode's motion about each variable, and its force, (F, n + 1, 3, M)."""
        joints, all_variables = solver.joints, solver.movable
        own = turns[:, joints]
        extent, share = sizes[0][..., None, None], sizes[1][:, :-1, None, None]
        torque, force = share * extent * (own @ self.torque), share * (own @ self.force)
        torque = torque + skew(places[:, joints]) @ force
        subtree = solver.above.to(torque)
        torque, force_below = (torch.einsum("nt,ftam->fnam", subtree, one) for one in (torque, force))
        torque = torque - skew(places[:, all_variables]) @ force_below
        rows = torch.cat((torque, force.sum(1, keepdim=True)), 1)
        return rows if fold is None else solver.folded(rows, fold)


def _paired(rows: Tensor) -> Tensor:
    """Rows of frames, of a lone one twice: sums over one column alone run in another order (PyTorch 2.13)."""
    return rows.expand(2, -1) if len(rows) == 1 else rows


def _blocks(
    first: scipy.sparse.csr_array | None, owner: np.ndarray, joint_count: int, width: int
) -> dict[str, np.ndarray]:
    """Activations of each owner, the joints that they read, and their weights; padded."""
    count = len(owner)
    if first is None:
        first = scipy.sparse.csr_array(scipy.sparse.eye_array(count))
    owners = np.unique(owner)
    ids = [np.flatnonzero(owner == one) for one in owners]
    reads = [np.unique(first[part].tocoo().col // width) for part in ids]
    taken = np.full((len(owners), max(map(len, ids))), count)
    read = np.full((len(owners), max(map(len, reads))), joint_count)
    gate = np.zeros((len(owners), taken.shape[1], read.shape[1], width))
    for row, (part, found) in enumerate(zip(ids, reads, strict=True)):
        taken[row, : len(part)], read[row, : len(found)] = part, found
        columns = (width * found[:, None] + np.arange(width)).ravel()
        gate[row, : len(part), : len(found)] = first[part][:, columns].toarray().reshape(len(part), -1, width)
    return {"taken": taken, "reads": read, "gate": gate}


def _modes(
    products: scipy.sparse.csr_array, taken: np.ndarray, least: float
) -> tuple[np.ndarray, scipy.sparse.csr_array]:
    """Modes (P, K, C') of each block, orthonormal, and the same as columns (C, P K)."""
    count, found = products.shape[0], []
    for row in taken:
        ids = row[row < count]
        values, vectors = np.linalg.eigh(products[ids][:, ids].toarray())
        found.append(vectors[:, np.flatnonzero(values > least)[::-1]].T)
    modes = np.zeros((len(taken), max(1, *map(len, found)), taken.shape[1]))
    for p, part in enumerate(found):
        modes[p, : part.shape[0], : part.shape[1]] = part
    block, mode, own = np.nonzero(modes)
    width = modes.shape[1]
    at = (taken[block, own], block * width + mode)
    return modes, scipy.sparse.csr_array((modes[block, mode, own], at), shape=(count, len(taken) * width))


def _moments(
    counted: scipy.sparse.csr_array | np.ndarray,
    mixing: scipy.sparse.csr_array,
    rig: Rig,
    joints: np.ndarray,
    fitted: np.ndarray,
) -> dict[str, np.ndarray]:
    """Torque of modes about and force on each weighted joint, in its own axes; its extent and mass.

    Args:
        counted: (3 v, C) shapes, without vertices that do not count.
        mixing: of :func:`_modes`.
        rig, joints, fitted: as of :class:`PoseOffsets`.
    """
    weights = scipy.sparse.csr_array(rig.skin.tocsc()[:, joints].T @ scipy.sparse.diags_array(fitted * 1.0))
    arms = [weights @ scipy.sparse.diags_array(rig.bind_shape[:, axis]) for axis in range(3)]
    rows = scipy.sparse.csr_array(scipy.sparse.vstack([weights, *arms]))
    planes = [_full((rows @ counted[axis::3]) @ mixing) for axis in range(3)]
    force, *moment = np.stack(planes, 1).reshape(4, len(joints), 3, -1)  # (T, 3, M) each
    torque = np.stack([moment[b][:, c] - moment[c][:, b] for b, c in ((1, 2), (2, 0), (0, 1))], 1)
    centre = rig.bind_world[joints, :3, 3]
    torque -= np.cross(centre[:, :, None], force, axis=1)
    orient = rig.t_pose_world[joints, :3, :3].copy()
    turn = orient @ rig.bind_world[joints, :3, :3].transpose(0, 2, 1)
    arm = np.stack([(weights @ rig.bind_shape[:, a]) for a in range(3)])  # sums
    mass = np.asarray(weights.sum(1)).ravel()
    square = weights @ (rig.bind_shape**2).sum(1)
    spread = square - 2 * (centre * arm.T).sum(1) + mass * (centre**2).sum(1)
    extent = np.sqrt(spread / mass.clip(1e-12)).clip(1e-6)
    return {
        "torque": turn @ torque, "force": turn @ force, "extent": extent, "mass": mass.clip(1e-12),
    }  # fmt: skip


def _full(product: scipy.sparse.csr_array | np.ndarray) -> np.ndarray:
    return product if isinstance(product, np.ndarray) else product.toarray()
