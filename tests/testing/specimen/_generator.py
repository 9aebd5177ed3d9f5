"""Template and directions as formulas of the template."""

from __future__ import annotations

import functools

import torch

from soma_core.plugin import Expressions, LinearBasis, SkinnedModel, axis_angle_to_matrix, read_obj

read_obj = functools.cache(read_obj)  # a check builds many generators of one file


class Specimen:
    """Rest vertices [cm], +Z up, facing -Y."""

    def __init__(self, path, strength, *, device, dtype):
        vertices, faces = read_obj(path)
        template = torch.tensor(vertices)  # a copy: the file is read once
        x, y, z = template.T / 100
        zero = torch.zeros_like(x)
        bump = torch.exp(-((z - 1) ** 2 + x**2) / 0.02)
        fields = [
            template,
            100 * torch.stack((0.1 * x, zero, zero), 1),
            100 * torch.stack((zero, 0.2 * y, zero), 1),
            100 * torch.stack((zero, zero, 0.04 * z), 1),
            100 * torch.stack((0.02 * x * torch.sin(3 * z), 0.02 * y * torch.cos(3 * z), zero), 1),
            100 * torch.stack((zero, -0.03 * strength * bump, zero), 1),
        ]
        near = torch.exp(-((template[:, 2, None] - torch.tensor([95.0, 120.0, 155.0])) ** 2) / 400) + 1e-9
        kind = {"device": device, "dtype": dtype}
        self.faces = torch.as_tensor(faces, device=device)
        self.weights = (near / near.sum(1, keepdim=True)).to(**kind)
        self.places = (near / near.sum(0)).T.to(**kind)
        self.smile = 100 * torch.stack((zero, -0.01 * bump, zero), 1).to(**kind)
        self.template = template.to(device=device, dtype=dtype)
        self.fields = torch.stack(fields).to(device=device, dtype=dtype)

    def coefficients(self, params):
        """(batch, 6): logarithm of size, shape saturating at the ends, belly."""
        size = params["size"]
        belly = params.get("belly", torch.zeros_like(size))
        return torch.cat((size.log()[:, None], torch.tanh(params["shape"] / 3), belly[:, None]), 1)

    def rest(self, params):
        """(batch, n, 3)."""
        coefficients = self.coefficients(params)
        return self.template + torch.einsum("bk,knc->bnc", coefficients, self.fields)

    def linear_basis(self):
        """The same, as template, basis and coefficients."""
        return LinearBasis(template=self.template, basis=self.fields, coefficients=self.coefficients)

    def triangles(self):
        """(t, 3), counter-clockwise from outside."""
        return self.faces

    def skinning(self, params):
        """Three joints in a row."""
        rest = self.rest(params)
        joints = torch.einsum("jn,bnc->bjc", self.places, rest)
        names = ("hips", "chest", "head")
        return SkinnedModel(
            joint_names=names, parents=(-1, 0, 1), rest=rest, joints=joints, weights=self.weights
        )

    pose_size, root_size, heading = 6, 6, 5

    def posed(self, params, pose):
        """(batch, n, 3), by rotations and translation, or by a vector: a shift and a turn of the root."""
        model = self.skinning(params)
        if "parameters" in pose:
            shift, turn = pose["parameters"].split(3, dim=1)
            turns = torch.stack((turn, torch.zeros_like(turn), torch.zeros_like(turn)), 1)
        else:
            shift, turns = pose["translation"], pose["rotations"]
        local = axis_angle_to_matrix(turns)
        world, place = local[:, 0], model.joints[:, 0]
        total = torch.zeros_like(model.rest)
        for joint in range(3):
            if joint:
                bone = model.joints[:, joint] - model.joints[:, joint - 1]
                place = place + torch.einsum("bij,bj->bi", world, bone)
                world = world @ local[:, joint]
            offsets = (model.rest - model.joints[:, joint, None]) @ world.mT + place[:, None]
            total = total + model.weights[:, joint, None] * offsets
        return total + shift[:, None]

    def own_arrays(self, params, parameters):
        """The vector under two names."""
        return {"shift": parameters[:, :3], "turn": parameters[:, 3:]}

    def random_poses(self, count, seed):
        """Small turns of every joint."""
        random = torch.Generator().manual_seed(seed)
        turns = 0.2 * torch.randn(count, 3, 3, generator=random, dtype=torch.float64)
        kind = {"device": self.template.device, "dtype": self.template.dtype}
        return {"rotations": turns.to(**kind), "translation": torch.zeros(count, 3, **kind)}

    def expressions(self):
        """One direction."""
        return Expressions(names=("smile",), basis=self.smile[None])
