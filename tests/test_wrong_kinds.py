"""Public functions refuse what is of another type than they take, in one sentence that says what it is."""

import numpy as np
import pytest
import torch

from soma_core import (
    InputError,
    Motion,
    NativeFit,
    PointInversion,
    PoseInversion,
    PosePriors,
    SomaLayer,
    fit_identity,
    motion,
)
from soma_core.io.joint_order import USER_JOINTS
from tests.bodies import randn, tiny_canonical, tiny_registry


@pytest.fixture(scope="module")
def layer(tmp_path_factory):
    registry = tiny_registry(tmp_path_factory.mktemp("tiny"))
    return SomaLayer("tiny", canonical=tiny_canonical(), registry=registry)


def still(**changes):
    given = {
        "rotations": np.tile(np.eye(3), (5, 77, 1, 1)), "translation": np.zeros((5, 3)), "fps": 30.0,
        "joint_names": USER_JOINTS,
    }  # fmt: skip
    return Motion(**given | changes)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"correctives": False}, r"correctives: got False \(bool\), expected str or PathLike or None"),
        ({"assets": 3}, r"assets: got 3 \(int\)"),
        ({"options": "fast"}, r"options: got 'fast' \(str\), expected Mapping or None\. .*\{'NAME': value\}"),
        ({"procedural": "off"}, r"procedural: got 'off' \(str\), expected bool\. Pass True or False"),
        ({"backend": None}, "backend: got a value of type NoneType, expected str"),
    ],
)
def test_a_layer_is_made_of_what_it_takes(change, told):
    with pytest.raises(InputError, match=told):
        SomaLayer(**change)


IDENTITY = r"identity: got a value of type \w+, expected Identity\. Make one: layer\.identity\(params\)"


@pytest.mark.parametrize("other", [None, {"size": 0.5}, torch.zeros(3)])
def test_parameters_are_no_identity(layer, other):
    turns = torch.zeros(2, len(layer.joint_names), 3)
    vertices = layer.pose(layer.identity(), turns).vertices
    for use in (
        lambda: layer.pose(other, turns),
        lambda: PoseInversion(layer)(vertices, other),
        lambda: motion.mirrored_body(layer, other),
        lambda: motion.animate(layer, other, still()),
        lambda: motion.write_body("body.glb", layer, other, still()),
    ):
        with pytest.raises(InputError, match=IDENTITY):
            use()


@pytest.mark.parametrize("other", ["tall", 3, torch.zeros(1, 10)])
def test_parameters_have_names(layer, other):
    with pytest.raises(InputError, match=r"params: got .*, expected Mapping\. .*\{'NAME': value\}"):
        layer.identity(other)


@pytest.mark.parametrize("make", [PoseInversion, PointInversion, lambda it: fit_identity(it, randn(1, 9, 3))])
@pytest.mark.parametrize("other", [None, "anny"])
def test_a_name_is_no_layer(make, other):
    with pytest.raises(InputError, match="layer: got one of type .*, expected SomaLayer. Make one"):
        make(other)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"iterations": 1.5}, r"iterations: got 1\.5 \(float\), expected int"),
        ({"tolerance": "fine"}, r"tolerance: got 'fine' \(str\)"),
        ({"robust": "yes"}, r"robust: got 'yes' \(str\), expected Real or None"),
        ({"analytical": 3}, "analytical: got 3"),
        ({"priors": {"untwist": 0}}, "priors: got a value of type dict, expected PosePriors"),
        ({"priors": PosePriors(rest_strength=float("nan"))}, "rest_strength: got nan, expected at least 0"),
    ],
)
def test_a_fit_is_made_of_what_it_takes(layer, change, told):
    with pytest.raises(InputError, match=told):
        PoseInversion(layer, **change)


@pytest.mark.parametrize(
    ("use", "told"),
    [
        (lambda: motion.clean(None), "motion: got a value of type NoneType, expected Motion. Read one"),
        (lambda: motion.clean(still(), options=3), r"options: got 3 \(int\), expected CleanOptions"),
        (lambda: motion.smooth(still(), 0.1), r"seconds: got 0\.1 \(float\), expected LimbSeconds"),
        (lambda: motion.resample(still(), "30"), "rate: got '30', expected frames per second"),
        (lambda: motion.mirror("walk.npz"), r"motion: got 'walk.npz' \(str\), expected Motion"),
        (lambda: motion.motion_quality({}), "motion: got a value of type dict"),
        (lambda: motion.write(still(), "walk.bvh"), r"path: got 'walk\.bvh', expected \.npz\. .*write_bvh"),
        (lambda: motion.convert("walk.npz", options={}), "options: got a value of type dict, expected Conv"),
        (lambda: motion.retarget(still()), "source: got a value of type Motion, expected SkeletonMotion"),
        (lambda: still(fps="30"), "fps: got '30', expected a positive number"),
        (lambda: still(joint_names=("Hips",) * 77), "joint_names: got a name twice"),
        (lambda: still(identity=3), r"identity: got 3 \(int\), expected Mapping"),
        (lambda: NativeFit(3), r"backend: got 3 \(int\), expected str"),
    ],
)
def test_functions_name_what_they_take(use, told):
    with pytest.raises(InputError, match=told):
        use()
