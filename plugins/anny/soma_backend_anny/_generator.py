"""The Anny generator: phenotypes and local changes in, rest mesh out."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from soma_backend_anny import _basis
from soma_backend_anny._options import AnnyOptions
from soma_backend_anny._phenotypes import macro_weights
from soma_core import InputError
from soma_core.plugin import BackendSpec, LinearBasis, SkinnedModel

__all__ = ["AnnyGenerator", "signed_parts"]

_PHENOTYPE_SETS = {"all": _basis.PHENOTYPES, "default": _basis.DEFAULT_PHENOTYPES}


class AnnyGenerator:
    """Rest shapes [m], +Z up, facing -Y, 13,718 vertices; linear in the coefficients of a compact basis.

    Args:
        spec: the declaration, for the names of the local changes.
        device: where the tensors live.
        dtype: floating type of the tensors.
        options: see :class:`soma_backend_anny.AnnyOptions`.

    Raises:
        InputError: an option has an unknown value.
    """

    def __init__(
        self, spec: BackendSpec, *, device: torch.device, dtype: torch.dtype, options: AnnyOptions
    ) -> None:
        self._phenotypes = _phenotype_set(options.phenotypes)
        declared = [parameter.name for parameter in spec.params if parameter.group == "local_changes"]
        self._local_changes = _enabled_local_changes(options.local_changes, declared)
        stored = _basis.load_phenotype_basis(self._phenotypes)
        rank = int((stored.remaining_mm > float(options.tolerance_mm)).sum())
        rows, places = [stored.basis[:rank]], [stored.joints_basis[:rank]]
        if self._local_changes:
            surface, moved = _basis.load_local_changes(self._local_changes)
            rows.append(surface)
            places.append(moved)

        def tensor(array: np.ndarray) -> Tensor:
            return torch.from_numpy(array).to(device=device, dtype=dtype)

        self._template = tensor(stored.template)
        self._basis = tensor(np.concatenate(rows) if len(rows) > 1 else rows[0])
        self._joints, self._joints_basis = tensor(stored.joints), tensor(np.concatenate(places))
        self._projection = tensor(stored.projection[:, :rank])
        self._offset = tensor(stored.offset[:rank])

    def rest(self, params: Mapping[str, Tensor]) -> Tensor:
        """Rest vertices (batch, 13718, 3) [m]; differentiable in every parameter.

        Parameters that are absent count as their default.

        Raises:
            InputError: a parameter that the options did not enable.
        """
        return _moved(self._template, self._basis, self._coefficients(params))

    def skinning(self, params: Mapping[str, Tensor]) -> SkinnedModel:
        """Bodies on Anny's own 104 bones, in the package's order; params as of :meth:`rest`."""
        coefficients = self._coefficients(params)
        names, parents, weights = self._bones
        return SkinnedModel(
            joint_names=names,
            parents=parents,
            rest=_moved(self._template, self._basis, coefficients),
            joints=_moved(self._joints, self._joints_basis, coefficients),
            weights=weights,
        )

    @functools.cached_property
    def _bones(self) -> tuple[tuple[str, ...], tuple[int, ...], Tensor]:
        names, parents, weights = _basis.load_bones()
        return names, parents, torch.from_numpy(weights).to(self._template)

    def linear_basis(self) -> LinearBasis:
        """The template with every phenotype at 0.5, the basis, and the map from parameters to it."""
        return LinearBasis(template=self._template, basis=self._basis, coefficients=self._coefficients)

    def _coefficients(self, params: Mapping[str, Tensor]) -> Tensor:
        """Coefficients (batch, k) of the basis; zero when every parameter has its default."""
        self._check_enabled(params)
        batch = next((value.shape[0] for value in params.values()), 1)
        middle = self._template.new_full((batch,), 0.5)
        phenotypes = {name: params.get(name, middle) for name in _basis.PHENOTYPES}
        coefficients = macro_weights(phenotypes) @ self._projection + self._offset
        if not self._local_changes:
            return coefficients
        default = self._template.new_zeros(batch)
        values = torch.stack([params.get(name, default) for name in self._local_changes], dim=-1)
        return torch.cat((coefficients, signed_parts(values)), dim=-1)

    def _check_enabled(self, params: Mapping[str, Tensor]) -> None:
        enabled = {*self._phenotypes, *self._local_changes}
        for name in params:
            if name in enabled:
                continue
            local = name not in _basis.PHENOTYPES
            option, value = ("local_changes", [name]) if local else ("phenotypes", "all")
            current = f"{len(self._local_changes)} local changes" if local else "the six default phenotypes"
            override = f"backend.options.{option}=" + (f"[{name}]" if local else "all")
            raise InputError(
                f"params[{name!r}]",
                got=f"{name!r}, but the Anny backend was built with {current}",
                expected="a parameter that the backend's options enable",
                fix=f"Add {override} to the command, or pass options={{{option!r}: {value!r}}} in Python.",
            )


def _moved(template: Tensor, basis: Tensor, coefficients: Tensor) -> Tensor:
    return template + (coefficients @ basis.flatten(1)).unflatten(-1, template.shape)


def signed_parts(values: Tensor) -> Tensor:
    """Split (batch, n) into (batch, 2n): the part above zero and the part below, in turn.

    At zero both parts follow the value (derivatives +1 and -1), so that a fit can leave it.
    """
    zero = torch.zeros_like(values)
    above = torch.where(values >= 0, values, zero)
    below = torch.where(values <= 0, -values, zero)
    return torch.stack((above, below), dim=-1).flatten(1)


def _phenotype_set(value: object) -> tuple[str, ...]:
    if not isinstance(value, str) or value not in _PHENOTYPE_SETS:
        raise InputError(
            "options.phenotypes",
            got=repr(value),
            expected=f"one of {', '.join(_PHENOTYPE_SETS)}",
            fix="Use all, or default for the six main phenotypes.",
        )
    return _PHENOTYPE_SETS[value]


def _enabled_local_changes(value: object, declared: Sequence[str]) -> tuple[str, ...]:
    if value is None or value == "none":
        return ()
    if value == "all":
        return tuple(declared)
    names = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    unknown = [name for name in names if name not in declared]
    if unknown:
        raise InputError(
            "options.local_changes",
            got=repr(unknown[0]),
            expected="none, all, or a list of names of local changes",
            fix="`soma backends show anny` lists the names.",
        )
    wanted = set(names)
    return tuple(name for name in declared if name in wanted)
