import hashlib
import struct

import numpy as np
import pytest
import scipy.sparse

from soma_core.rig.revision import lod_revision, rig_hash


def parts() -> dict:
    return {
        "joint_names": ("Root", "Hips"),
        "parents": np.array([-1, 0]),
        "bind_world": np.tile(np.eye(4), (2, 1, 1)),
        "t_pose_world": np.tile(2 * np.eye(4), (2, 1, 1)),
        "bind_shape": np.arange(9.0).reshape(3, 3),
        "weights": scipy.sparse.csr_array(np.array([[0, 1], [0.25, 0.75], [1, 0]])),
        "triangles": np.array([[0, 1, 2]]),
    }


def test_hash_is_the_documented_byte_stream():
    matrices = [*np.tile(np.eye(4), (2, 1, 1)).ravel(), *np.tile(2 * np.eye(4), (2, 1, 1)).ravel()]
    triples = [(0, 1, 1.0), (1, 0, 0.25), (1, 1, 0.75), (2, 0, 1.0)]
    stream = b"Root\nHips" + struct.pack("<2i", -1, 0)
    stream += struct.pack("<64f", *matrices) + struct.pack("<9f", *range(9))
    stream += b"".join(struct.pack("<iif", *triple) for triple in triples) + struct.pack("<3i", 0, 1, 2)
    assert rig_hash(**parts()) == hashlib.sha256(stream).hexdigest()


@pytest.mark.parametrize("layout", [scipy.sparse.csc_array, scipy.sparse.coo_array])
def test_hash_ignores_storage_and_stored_zeros(layout):
    dense = parts()["weights"].toarray()
    stored = scipy.sparse.coo_array(
        (np.append(dense.ravel(), 0.0), (np.r_[np.repeat([0, 1, 2], 2), 0], [0, 1] * 3 + [1]))
    )
    assert rig_hash(**parts()) == rig_hash(**{**parts(), "weights": layout(stored)})


@pytest.mark.parametrize(
    "name", ["parents", "bind_world", "t_pose_world", "bind_shape", "triangles", "weights"]
)
def test_every_part_counts(name):
    changed = parts()
    changed[name] = changed[name] * 2
    assert rig_hash(**changed) != rig_hash(**parts())


def test_a_name_counts():
    assert rig_hash(**{**parts(), "joint_names": ("Root", "Hip")}) != rig_hash(**parts())


def test_derived_level_keeps_its_parent_and_adds_its_name():
    assert lod_revision("0123456789abcdef" * 4, "mid") == "0123456789abcdef"
    assert lod_revision("0123456789abcdef" * 4, "low") == "0123456789abcdef-low"
