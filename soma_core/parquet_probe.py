"""Look through a Parquet file of a stranger in this process, which has limits: run by `parquet_file`.

A few hundred bytes can unfold to gigabytes, a footer can name a hundred thousand columns, and damaged files
make pyarrow end the process. What dies here dies alone.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from soma_core.apart import limit_process

__all__: list[str] = []

_MOST_COLUMNS = 10_000
_WHOLE = 64 * 2**20
"""Bytes up to which all of it is unfolded here; of longer ones counts what they say of themselves."""

_MOST_EXPANSION = 64
_BATCH = 8


def _told(path: Path) -> dict[str, Any]:
    """Columns and rows of a file, or why it is refused."""
    from pyarrow.parquet import ParquetFile

    try:
        with ParquetFile(path) as file:
            size, about = path.stat().st_size, file.metadata
            if about.num_columns > _MOST_COLUMNS:
                return {"refused": f"has {about.num_columns} columns, more than {_MOST_COLUMNS}"}
            if about.num_rows > size:
                return {"refused": f"claims {about.num_rows} rows in {size} bytes"}
            groups = (about.row_group(number) for number in range(about.num_row_groups))
            unfolded = sum(group.total_byte_size for group in groups)
            if size > _WHOLE and unfolded > _MOST_EXPANSION * size:
                return {"refused": f"unfolds to {unfolded} bytes from {size}"}
            for _ in file.iter_batches(batch_size=_BATCH, use_threads=False) if size <= _WHOLE else ():
                pass
            return {"names": file.schema_arrow.names, "rows": about.num_rows}
    except MemoryError:  # also ArrowMemoryError
        return {"refused": "unfolds to more memory than its size can mean"}
    except Exception as error:  # what pyarrow raises of a damaged file is of many kinds
        return {"refused": f"damaged ({' '.join(str(error).split())[:200]})"}


if __name__ == "__main__":
    import pyarrow.parquet  # noqa: F401 - before the limits

    _path, _seconds, _size = sys.argv[1:]
    limit_process(int(_seconds), int(_size))
    sys.stdout.write("\n" + json.dumps(_told(Path(_path))) + "\n")
    sys.stdout.flush()
    os._exit(0)  # what a damaged file left behind may not survive an orderly end
