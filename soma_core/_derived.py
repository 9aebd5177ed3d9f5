"""Modules whose constants are derived for one device and dtype, and what torch's transforms ask of them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self, TypeVar, cast

import torch
from torch import Tensor

from soma_core._inputs import check_choice, usable_device
from soma_core.errors import InputError, check_type

__all__ = ["Derived", "kind_of", "own_precision"]

_DTYPES = (torch.float32, torch.float64)
_Method = TypeVar("_Method", bound=Callable[..., Any])


class Derived(torch.nn.Module):
    """A module that is what it was made from: its constants are derived in float64, and never cast.

    Moved or converted, by itself or inside a network, it derives them again. A network that is cast to half
    precision, or taken to the meta device, leaves it as it is. Copies and pickles hold what it was made from,
    and derive it anew.

    Args:
        given: arguments of the constructor; others that are in it, such as `self`, do not matter.
        device, dtype: of all constants and results.

    Attributes:
        takes: types of arguments, and what to do about others; of a class, checked when it is made.

    Raises:
        InputError: an argument of another type, neither float32 nor float64, or no such device here.
    """

    takes: ClassVar[Mapping[str, tuple[tuple[type, ...], str]]] = {}

    def __init__(self, given: Mapping[str, Any], device: torch.device | str, dtype: torch.dtype) -> None:
        super().__init__()
        for name, (kinds, fix) in self.takes.items():
            check_type(name, given[name], *kinds, fix=fix)
        check_choice("dtype", dtype, _DTYPES)
        self._given: dict[str, Any] = {
            name: dict(value) if isinstance(value, Mapping) else value
            for name, value in given.items()
            if name not in ("self", "__class__")
        }
        self.device, self.dtype = usable_device(device), dtype

    def _build(self, device: torch.device, dtype: torch.dtype) -> None:
        """Derive all constants, in place of those that are there."""
        raise NotImplementedError

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:  # noqa: ARG002 - PyTorch's
        here = torch.empty(0, dtype=self.dtype, device=self.device)
        there = fn(here)
        dtype = there.dtype if there.dtype in _DTYPES else self.dtype
        if not there.is_meta and (there.device, dtype) != (here.device, here.dtype):
            self._build(there.device, dtype)
        return self

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Move or convert in place; takes what ``torch.nn.Module.to`` does.

        Raises:
            InputError: a dtype other than float32 and float64. Networks around it may have any.
        """
        for value in (*args, *kwargs.values()):
            kind = value.dtype if isinstance(value, Tensor) else value
            if isinstance(kind, torch.dtype):
                check_choice("dtype", kind, _DTYPES)
        return super().to(*args, **kwargs)

    def half(self) -> Self:
        """Refused, as in :meth:`to`."""
        return self.to(torch.float16)

    def bfloat16(self) -> Self:
        """Refused, as in :meth:`to`."""
        return self.to(torch.bfloat16)

    def __reduce__(self) -> tuple[Any, ...]:
        kind = {"device": self.device, "dtype": self.dtype}
        given = self._given | {key: one for key, one in kind.items() if key in self._given}
        # copy.deepcopy copies these, which come first, and shares what the function holds, such as meshes.
        modules = {name: value for name, value in given.items() if isinstance(value, torch.nn.Module)}
        rest = {name: value for name, value in given.items() if name not in modules}
        return functools.partial(type(self), **rest), tuple(modules.values()), {"training": self.training}


def kind_of(layer: Derived) -> tuple[torch.device, torch.dtype]:
    """Device and dtype of a layer; what is no layer is refused (InputError)."""
    if not isinstance(layer, Derived):
        fix = "Make one: SomaLayer('soma')."
        raise InputError("layer", got=f"one of type {type(layer).__name__}", expected="SomaLayer", fix=fix)
    return layer.device, layer.dtype


def own_precision(method: _Method) -> _Method:
    """Compute a method in its module's own precision, whatever ``torch.autocast`` says around it."""

    @functools.wraps(method)
    def exact(self: Any, *args: Any, **kwargs: Any) -> Any:
        if not torch.is_autocast_enabled(self.device.type):
            return method(self, *args, **kwargs)
        with torch.autocast(self.device.type, enabled=False):
            return method(self, *args, **kwargs)

    return cast(_Method, exact)
