"""A prepared identity: the rest shape on the canonical mesh and the skeleton fitted to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

from torch import Tensor

from soma_core.errors import InputError

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

    def __len__(self) -> int:
        """Number of identities."""
        return self.batch_size

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> Identity:
        """Some of them, as a batch still: one by its number, or by a slice, ids or a mask."""
        if isinstance(index, int):
            range(len(self))[index]  # IndexError where there is none, so that it can be iterated over
            index = slice(index, index + 1 or None)
        return self._with(lambda values: values[index])

    def check(self, vertices: int, revision: str) -> None:
        """Refuse (InputError) one of another mesh or rig than these."""
        if self.rest.shape[1] == vertices and self.rig_revision in ("", revision):
            return
        raise InputError(
            "identity",
            got=f"{self.rest.shape[1]} vertices on rig {self.rig_revision or 'unknown'}",
            expected=f"{vertices} vertices on rig {revision}",
            fix="Make it with this layer's identity().",
        )

    def to(self, *args: Any, **kwargs: Any) -> Identity:
        """Move or convert every tensor; takes what ``torch.Tensor.to`` does."""
        return self._with(lambda values: values.to(*args, **kwargs))

    def _with(self, change: Callable[[Tensor], Tensor]) -> Identity:
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        changed: dict[str, Any] = {
            name: change(value) for name, value in values.items() if isinstance(value, Tensor)
        }
        return replace(self, **changed, params={name: change(value) for name, value in self.params.items()})

    def __repr__(self) -> str:
        """Counts instead of numbers."""
        kind = f"{self.rest.dtype}, {self.rest.device}".removeprefix("torch.")
        return f"Identity({len(self)} of {self.backend!r}, {self.rest.shape[1]} vertices, {kind})"
