"""No file does harm: each reader refuses each hostile one, with an error that names it and the cause."""

from __future__ import annotations

import re

import pytest

from tests.hostile.corpus import FILES, LINKS
from tests.hostile.readers import READERS

each_reader = pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
KINDS = {
    ".npy": "array",
    ".vrm": "glb",
    ".usdz": "npz",
    ".pkl": "pickle",
    ".pca": "point.pca",
    ".json": "JSON",
    ".pt": "pt",
}
"""Suffix -> first word of the names of hostile files of that format, where it is not the suffix."""

FOR_ALL = (
    "pickle of os.system, protocol 2",
    "npz of object arrays",
    "npz bomb",
    "obj of an index out of range",
)

COSTLY = re.compile(
    "usda of (very )?(deep|doubled)|JSON of many|pt (compressed|of many)|glb of many nodes"
    "|parquet of (a list|more|many)|pickle of (deep records|keys that collide|a wide text|endless)"
)
"""Files that take long, and that one function refuses for all readers of the format: read by one of them.

All others of the format are read by each of its readers, which shows that they call that function.
"""


def files_for(reader):
    """Hostile files of the reader's own format, those of no format, and some of others."""
    kinds = {*KINDS.values(), "npz", "obj", "ply", "glb", "usda", "usdc", "bvh", "fbx", "csv", "parquet"} - {
        KINDS.get(reader.suffix, reader.suffix[1:])
    }
    first = next(other for other in READERS if other.suffix == reader.suffix) is reader
    return [
        name
        for name in FILES
        if (name in FOR_ALL or name.partition(" ")[0] not in kinds) and (first or not COSTLY.match(name))
    ]


PAIRS = [
    pytest.param(reader, name, id=f"{reader.name}-{name}") for reader in READERS for name in files_for(reader)
]


@pytest.mark.parametrize(("reader", "name"), PAIRS)
def test_hostile_files_are_refused(reader, name, ask):
    told = ask(reader.name, name)
    if name in reader.accepts:
        return
    assert told is not None, "was read"
    assert re.search(r"(hostile|MANIFEST)[^ ]*: ?\S", told)


@each_reader
@pytest.mark.parametrize("name", LINKS)
def test_what_is_no_file_is_refused(reader, name, ask):
    assert re.search("hostile|MANIFEST", ask(reader.name, name) or "was read")


@each_reader
def test_links_to_good_files_are_followed(reader, tmp_path):
    if reader.good is None:
        pytest.skip("no small file of this kind")
    good = tmp_path / f"good{reader.suffix}"
    reader.good(good)
    link = tmp_path / f"hostile{reader.suffix}"
    link.symlink_to(good)
    reader.read(link)
