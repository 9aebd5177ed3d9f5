"""Good files with damage: whatever is changed, a reader gives a value or an error of its own."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from soma_core.errors import SomaError
from tests.hostile.readers import READERS

SMALL = [reader for reader in READERS if reader.good]
EXAMPLES = 60

_edits = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True),
        st.sampled_from(["flip", "drop", "repeat", "insert", "zero", "ones"]),
        st.binary(min_size=1, max_size=8),
    ),
    min_size=1,
    max_size=6,
)


def mutated(content: bytes, edits) -> bytes:
    """The content with each edit made at its place, given as a share of the length."""
    data = bytearray(content)
    for share, kind, extra in edits:
        at = int(share * len(data))
        stop = at + len(extra)
        if kind == "flip":
            data[at:stop] = bytes(a ^ b for a, b in zip(data[at:stop], extra, strict=False))
        elif kind == "drop":
            del data[at:]
        else:
            filler = {
                "repeat": bytes(data[at:stop]) * 3,
                "insert": extra,
                "zero": bytes(4),
                "ones": b"\xff" * 4,
            }
            data[at : at if kind == "insert" else stop] = filler[kind]
    return bytes(data)


@pytest.mark.filterwarnings("ignore")  # numpy and scipy warn of damaged numbers, which is no refusal
@pytest.mark.parametrize("reader", SMALL, ids=lambda reader: reader.name)
def test_damaged_files_give_values_or_errors(reader, tmp_path, guarded):
    path = tmp_path / f"damaged{reader.suffix}"
    reader.good(path)
    content = path.read_bytes()
    reader.read(path)

    @settings(
        max_examples=EXAMPLES, deadline=None, derandomize=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(_edits)
    def check(edits):
        path.write_bytes(mutated(content, edits))
        with suppress(SomaError):
            reader.read(path)

    with guarded():
        check()
