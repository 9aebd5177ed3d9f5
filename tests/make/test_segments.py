import numpy as np
import pytest

from assets.make.segments import RiggedMesh, label_segments
from soma_core.errors import InputError
from soma_core.rig import load_canonical


def rigged(interior: np.ndarray) -> RiggedMesh:
    mesh, rig = load_canonical("low")
    return RiggedMesh(
        vertices=100 * mesh.vertices,
        triangles=mesh.triangles,
        weights=rig.weights.toarray(),
        joint_names=rig.joint_names,
        mirror=mesh.mirror,
        face_interior=interior,
    )


def test_labels_of_the_low_mesh_agree_with_those_cut_from_mid():
    mesh, _ = load_canonical("low")
    found = label_segments(rigged(mesh.face_interior))
    for name in ("head", "feet", "torso", "mouth_bag", "eye_bags"):
        np.testing.assert_array_equal(found[name], mesh.segments[name], err_msg=name)


def test_interior_in_other_than_three_parts_is_refused():
    mesh, _ = load_canonical("low")
    with pytest.raises(InputError, match="1 connected parts"):
        label_segments(rigged(mesh.segments["mouth_bag"]))
