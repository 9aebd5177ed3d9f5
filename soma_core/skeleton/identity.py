"""A prepared identity: the rest shape on the canonical mesh and the skeleton fitted to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

__all__ = ["Identity"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Identity:
    """An immutable value; made by ``SomaLayer.identity``, consumed by ``SomaLayer.pose``.

    Attributes:
        rest: rest vertices [m], (batch, v, 3), +Y up, in the bind pose when reposed.
        bind_world: world transforms of the joints at `rest` [m], (batch, J, 4, 4).
        fitted_rest: rest vertices as the backend posed them, before reposing to bind.
        fitted_world: world transforms fitted to `fitted_rest` (paper, section 3.4).
        backend: name of the backend, for provenance.
        rig_revision: revision of the rig the skeleton belongs to.
        params: the parameters it was made from.
    """

    rest: Tensor
    bind_world: Tensor
    fitted_rest: Tensor
    fitted_world: Tensor
    backend: str = ""
    rig_revision: str = ""
    params: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def batch_size(self) -> int:
        """Number of identities."""
        return self.rest.shape[0]
