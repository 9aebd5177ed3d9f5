"""What a caller may write for identity parameters, brought to one batched form for a generator."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor

from soma_core._inputs import may_look, widened
from soma_core.errors import InputError, check_type
from soma_core.plugin.spec import BackendSpec, Parameter

__all__ = ["batch_parameters"]


def batch_parameters(
    spec: BackendSpec, params: Mapping[str, Any] | None, *, device: torch.device, dtype: torch.dtype
) -> dict[str, Tensor]:
    """Bring identity parameters to tensors of shape (batch, *parameter.shape).

    A value is a number, a (nested) list, a NumPy array or a tensor of shape ``parameter.shape``
    (one sample) or ``(batch, *parameter.shape)``. Vectors may be shorter than declared and are
    padded with the default. Values of batch size 1 are broadcast. Parameters without a group
    appear in the result whether given or not; grouped ones (there may be hundreds) only when given,
    and a generator takes a missing one as its default.

    Tensors keep their autograd history and must already have `device` and `dtype`; half precision is
    widened. Values are checked to be finite on the CPU, outside ``torch.compile`` and ``torch.func``:
    elsewhere the check would make the host wait for the device.

    Raises:
        InputError: unknown name, wrong shape, batch sizes that disagree, NaN or infinity, an
            integer, boolean or complex array, a tensor on another device or of another dtype.
    """
    params = {} if params is None else params
    check_type("params", params, Mapping, fix="Give each by its name: {'NAME': value}.")
    given = dict(params)
    declared = {parameter.name: parameter for parameter in spec.params}
    for name in given:
        if name not in declared:
            raise _unknown(spec, name, declared)
    tensors = {
        name: _as_sample_batch(declared[name], value, device=device, dtype=dtype)
        for name, value in given.items()
    }
    batch = _batch_size(tensors)
    _check_finite(tensors)
    result = {}
    for parameter in spec.params:
        tensor = tensors.get(parameter.name)
        if tensor is not None:
            result[parameter.name] = tensor.expand(batch, *parameter.shape)
        elif not parameter.group:
            result[parameter.name] = torch.full(
                (batch, *parameter.shape), parameter.default, device=device, dtype=dtype
            )
    return result


def _argument(name: object) -> str:
    return f"params[{name!r}]"


def _unknown(spec: BackendSpec, name: object, declared: Mapping[str, Parameter]) -> InputError:
    close = difflib.get_close_matches(str(name), declared, n=3)
    hint = f"Did you mean {' or '.join(repr(match) for match in close)}? " if close else ""
    ungrouped = [parameter.name for parameter in spec.params if not parameter.group]
    groups = sorted({parameter.group for parameter in spec.params if parameter.group})
    known = ", ".join(ungrouped) + "".join(f", any of the group {group!r}" for group in groups)
    return InputError(
        _argument(name),
        got=f"unknown name {name!r}",
        expected=f"a parameter of backend {spec.name!r}: {known}",
        fix=f"{hint}`soma backends show {spec.name}` lists every parameter.",
    )


def _as_sample_batch(parameter: Parameter, value: Any, *, device: torch.device, dtype: torch.dtype) -> Tensor:
    """One parameter as (batch, *shape), padded; batch is 1 for a single sample."""
    tensor = _as_tensor(parameter, value, device=device, dtype=dtype)
    rank = len(parameter.shape)
    if tensor.ndim not in (rank, rank + 1):
        raise _wrong_shape(parameter, tuple(tensor.shape))
    if tensor.ndim == rank:
        tensor = tensor[None]
    got = tuple(tensor.shape[1:])
    if got == parameter.shape:
        return tensor
    if rank != 1 or got[0] > parameter.shape[0]:
        raise _wrong_shape(parameter, tuple(tensor.shape))
    missing = parameter.shape[0] - got[0]
    return torch.nn.functional.pad(tensor, (0, missing), value=parameter.default)


def _as_tensor(parameter: Parameter, value: Any, *, device: torch.device, dtype: torch.dtype) -> Tensor:
    if isinstance(value, Tensor):
        value = widened(value, dtype)
        _check_tensor(parameter, value, device=device, dtype=dtype)
        return value
    if isinstance(value, Real) and not isinstance(value, bool):
        return torch.full((), float(value), device=device, dtype=dtype)
    from_array = isinstance(value, np.ndarray | np.generic)
    try:
        array = np.asarray(value)
    except ValueError:  # ragged nested lists
        raise _not_numeric(parameter, f"a ragged {type(value).__name__} {value!r:.60}") from None
    if array.dtype.kind not in ("f" if from_array else "fiu"):
        raise _not_numeric(parameter, f"dtype {array.dtype} ({value!r:.60})")
    return torch.from_numpy(np.array(array, dtype=np.float64)).to(device=device, dtype=dtype)


def _check_tensor(parameter: Parameter, value: Tensor, *, device: torch.device, dtype: torch.dtype) -> None:
    if not value.is_floating_point():
        raise _not_numeric(parameter, f"dtype {value.dtype}")
    if value.dtype != dtype:
        raise InputError(
            _argument(parameter.name),
            got=f"dtype {value.dtype}",
            expected=f"dtype {dtype}, the layer's",
            fix=f"Convert it with .to({dtype}), or build the layer with dtype={value.dtype}.",
        )
    target = torch.device(device)
    same_index = target.index is None or value.device.index in (None, target.index)
    if value.device.type != target.type or not same_index:
        raise InputError(
            _argument(parameter.name),
            got=f"device {value.device}",
            expected=f"device {target}, the layer's",
            fix=f"Move it with .to({str(target)!r}).",
        )


def _not_numeric(parameter: Parameter, got: str) -> InputError:
    return InputError(
        _argument(parameter.name),
        got=got,
        expected="real floating-point values",
        fix="Pass Python numbers, or an array converted with .astype(float) or .float().",
    )


def _wrong_shape(parameter: Parameter, got: tuple[int, ...]) -> InputError:
    sample = parameter.shape
    batched = "(batch" + "".join(f", {size}" for size in sample) + ("," if not sample else "") + ")"
    padding = "; a shorter vector is padded" if len(sample) == 1 else ""
    return InputError(
        _argument(parameter.name),
        got=f"shape {got}",
        expected=f"shape {sample} or {batched}{padding}",
        fix=f"Reshape the value; {parameter.name!r} holds {int(np.prod(sample))} number(s) per identity.",
    )


def _batch_size(tensors: Mapping[str, Tensor]) -> int:
    """The common batch size; values of size 1 go along with any other."""
    batch, owner = 1, ""
    for name, tensor in tensors.items():
        size = tensor.shape[0]
        if size == 1 or size == batch:
            continue
        if batch != 1:
            raise InputError(
                _argument(name),
                got=f"batch size {size}",
                expected=f"batch size {batch} as in {_argument(owner)}, or 1",
                fix="Give every parameter the same number of samples, or a single one to share.",
            )
        batch, owner = size, name
    return batch


def _check_finite(tensors: Mapping[str, Tensor]) -> None:
    """Refuse NaN and infinity where looking at values costs no synchronisation."""
    if not tensors or not all(map(may_look, tensors.values())):
        return
    # x * 0 is 0 for finite x and NaN otherwise; unlike a plain sum it cannot overflow.
    probe = sum(((tensor.detach() * 0).sum() for tensor in tensors.values()), torch.zeros(()))
    if bool(torch.isfinite(probe)):
        return
    for name, tensor in tensors.items():
        bad = (~torch.isfinite(tensor.detach())).nonzero()
        if len(bad):
            index = tuple(bad[0].tolist())
            raise InputError(
                _argument(name),
                got=f"{tensor.detach()[index].item()} at index {index}",
                expected="finite values",
                fix="Remove NaN and infinity before building the identity.",
            )
