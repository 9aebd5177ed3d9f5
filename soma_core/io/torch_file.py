"""The arrays in a file of ``torch.save``, as results of estimators are kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from soma_core.files import refuse_unreadable
from soma_core.io.pickled_arrays import RecordArrays
from soma_core.tensor_archive import read_tensor_archive

__all__ = ["read_torch_arrays"]


def read_torch_arrays(path: Path | str) -> Any:
    """Contents of a ``.pt`` or ``.pth`` file: nested dictionaries, lists, tuples, arrays and plain values.

    Tensors come as arrays in native byte order (bfloat16 as float32, sparse ones dense), which may be
    read-only views of each other; numpy's arrays as they are; keys are text or integers. Nothing is run,
    and nothing is built that the metadata of the file do not bear out.

    Raises:
        AssetError: as :func:`~soma_core.tensor_archive.read_tensor_archive`; the cause names the keys that
            lead to what cannot be read.
    """
    refuse_unreadable(path)
    arrays = RecordArrays(Path(path).stat().st_size)
    return read_tensor_archive(
        path,
        fix="Save plain tensors: torch.save({'name': tensor.cpu()}, FILE).",
        sparse=arrays.dense,
        other=arrays.array,
    )
