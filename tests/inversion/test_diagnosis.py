"""Why a fit is no fit: each cause is told on several bodies, and a good fit is left alone, however noisy."""

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.inversion import PoseInversion
from soma_core.inversion.diagnosis import diagnose_fit
from soma_core.layer import SomaLayer
from tests.bodies import randn

NOISE = 0.02
"""Metres, in each coordinate."""

NOISE_ERROR = 1.596 * NOISE
"""Mean length of such noise, which is what a good fit leaves."""

GOOD_ERROR = 1e-4
ANOTHER_RIGS_ERROR = 0.008
"""Metres, of an adult: measured 5 mm on meshes that Anny's own rig posed."""

FRAMES = 8

BODIES = {
    "soma": ("soma", {}),
    "tall soma": ("soma", {"shape": [2.0, -1.5]}),
    "adult": ("anny", {"age": 0.67}),
    "woman": ("anny", {"age": 0.67, "gender": 1.0}),
    "child": ("anny", {"age": 0.2}),
    "infant": ("anny", {"age": -0.3}),
    "old heavy man": ("anny", {"age": 1.0, "weight": 1.0, "gender": 0.0}),
}


@pytest.fixture(scope="module")
def layers():
    pytest.importorskip("soma_backend_anny")
    return {name: SomaLayer(name, lod="low") for name in ("soma", "anny")}


@pytest.fixture(scope="module")
def cases(layers):
    """Layer, identity and vertices (8, v, 3) of each body, in eight poses."""
    turns, hips = 0.3 * randn(FRAMES, 77, 3, seed=1).float(), randn(FRAMES, 3, seed=2).float()
    turns[:, 0] *= 0.3  # nobody falls over

    def case(backend, params):
        layer = layers[backend]
        identity = layer.identity(params)
        with torch.no_grad():
            return layer, identity, layer.pose(identity, turns, hips).vertices

    return {name: case(*body) for name, body in BODIES.items()}


def noisy(vertices, seed=3):
    return vertices + NOISE * randn(*vertices.shape, seed=seed).float()


def errors_of(vertices, error):
    return np.full(len(vertices), error)


def shuffled(count, share=1.0, seed=0):
    """Ids of which a share, drawn at random, have changed places."""
    random, ids = np.random.default_rng(seed), np.arange(count)
    drawn = random.choice(count, int(share * count), replace=False)
    ids[drawn] = random.permutation(drawn)
    return torch.as_tensor(ids)


@pytest.mark.parametrize("name", BODIES)
def test_a_good_fit_is_left_alone(cases, name):
    layer, identity, vertices = cases[name]
    noise = noisy(vertices)
    gaps = noise.clone()
    gaps[::2] = torch.nan
    spoilt = vertices.clone()
    spoilt[2] = 0.3 * randn(*spoilt[2].shape, seed=4).float()
    spoilt[5] = 0
    for given, error in (
        (vertices, GOOD_ERROR), (vertices[:2], GOOD_ERROR), (noise, NOISE_ERROR), (noise[:2], NOISE_ERROR),
        (noise[:1], NOISE_ERROR), (gaps, NOISE_ERROR), (spoilt, GOOD_ERROR),
    ):  # fmt: skip
        assert diagnose_fit(layer, identity, given, errors=errors_of(given, error)) is None


@pytest.mark.parametrize("name", ["soma", "adult", "woman", "old heavy man"])
def test_another_rigs_mesh_is_a_good_fit(cases, name):
    layer, identity, vertices = cases[name]
    assert diagnose_fit(layer, identity, vertices, errors=errors_of(vertices, ANOTHER_RIGS_ERROR)) is None


@pytest.mark.parametrize("name", BODIES)
def test_mirrored_vertices_are_told_from_any_body(cases, name):
    layer, identity, vertices = cases[name]
    for given, mend in (
        (vertices * torch.tensor([-1.0, 1, 1]), "negate x of the vertices"),
        (noisy(vertices * torch.tensor([1.0, 1, -1])), "negate x of the vertices"),
        (vertices[:1, torch.as_tensor(layer.mesh.mirror.copy())], "put left and right back"),
        (vertices * torch.tensor([1.0, -1, 1]), "negate the upward axis"),
        (vertices[..., [0, 2, 1]], "swap y and z"),
    ):
        found = diagnose_fit(layer, identity, given)
        assert found.cause == "mirrored"
        assert found.failed
        assert mend in found.sentence


@pytest.mark.parametrize("name", BODIES)
def test_another_order_is_told_from_any_body(cases, name):
    layer, identity, vertices = cases[name]
    count = vertices.shape[1]
    last = torch.arange(count)
    last[-300:] = last[-300:][shuffled(300)]
    orders = {
        "all": shuffled(count), "a part": shuffled(count, 0.03), "reversed": torch.arange(count).flip(0),
        "one on": torch.arange(count).roll(1), "the last ones": last,
    }  # fmt: skip
    for order in orders.values():
        for given in (vertices[:, order], noisy(vertices[:, order]), vertices[:1, order]):
            found = diagnose_fit(layer, identity, given)
            assert found.cause == "order"
            assert found.failed
            assert f"another order than that of {layer.backend!r}" in found.sentence


def test_neighbours_that_changed_places_are_told(cases):
    layer, identity, vertices = cases["adult"]
    order = np.arange(vertices.shape[1])
    free = np.ones(len(order), bool)
    for a, b, _ in layer.mesh.triangles:
        if free[a] and free[b]:
            order[a], order[b] = b, a
            free[[a, b]] = False
    assert diagnose_fit(layer, identity, vertices[:, order]).cause == "order"


def test_a_few_vertices_out_of_place_are_not_another_order(cases):
    layer, identity, vertices = cases["adult"]
    given = vertices[:, shuffled(vertices.shape[1], 0.003)]
    assert diagnose_fit(layer, identity, given, errors=errors_of(given, 0.004)) is None


@pytest.mark.parametrize(
    ("body", "identity", "error", "failed"),
    [
        ("adult", "child", 0.20, True),
        ("child", "adult", 0.032, True),
        ("infant", "old heavy man", 0.047, True),
        ("soma", "tall soma", 0.040, True),
        ("old heavy man", "infant", 0.40, True),
        ("adult", "woman", 0.016, False),
    ],
)
def test_another_person_is_told_by_shape_and_error(cases, body, identity, error, failed):
    """Errors are those measured of each pair."""
    (layer, person, _), vertices = cases[identity], cases[body][2]
    for given, left in ((vertices, error), (noisy(vertices), np.hypot(error, NOISE_ERROR))):
        found = diagnose_fit(layer, person, given, errors=errors_of(given, left))
        if given is vertices or left > 1.3 * NOISE_ERROR:
            assert (found.cause, found.failed) == ("person", failed)
            assert "identity=unknown" in found.sentence
            assert f"{1e3 * left:.3g} mm" in found.sentence
    assert diagnose_fit(layer, person, vertices, errors=errors_of(vertices, GOOD_ERROR)) is None


def test_after_a_search_another_backend_is_the_way_on(cases):
    layer, identity, _ = cases["child"]
    vertices = cases["adult"][2]
    found = diagnose_fit(layer, identity, vertices, errors=errors_of(vertices, 0.2), searched=True)
    assert "pass another backend=, or identity.method=unpose" in found.sentence


@pytest.mark.parametrize(
    ("first", "second"), [("adult", "child"), ("soma", "tall soma"), ("woman", "infant")]
)
def test_a_person_who_changes_is_told_with_the_frame(cases, first, second):
    layer, identity, before = cases[first]
    after = cases[second][2]
    errors = np.r_[np.full(4, GOOD_ERROR), np.full(4, 0.04)]
    noise = np.hypot(errors, NOISE_ERROR)
    both = torch.cat((before[:4], after[4:]))
    for given, left in ((both, errors), (noisy(both), noise)):
        found = diagnose_fit(layer, identity, given, errors=left)
        assert (found.cause, found.failed, found.frame) == ("change", True, 4)
        assert "from frame 4 on" in found.sentence
        assert "cut the file there" in found.sentence
    found = diagnose_fit(layer, identity, both, errors=errors, frames=np.arange(8) * 10)
    assert found.frame == 40
    assert "between frames 30 and 40" in found.sentence
    found = diagnose_fit(layer, identity, both[3:5], errors=errors[3:5])
    assert (found.cause, found.frame) == ("change", 1)


def test_a_pose_that_changes_is_no_other_person(cases):
    layer, identity, vertices = cases["adult"]
    held = vertices[[0, 0, 0, 0, 3, 3, 3, 3]]
    assert diagnose_fit(layer, identity, held, errors=errors_of(held, ANOTHER_RIGS_ERROR)) is None


def test_an_error_without_a_cause_is_told_as_such(cases):
    layer, identity, vertices = cases["adult"]
    found = diagnose_fit(layer, identity, vertices, errors=errors_of(vertices, 0.1))
    assert (found.cause, found.failed) == ("unexplained", True)
    assert "100 mm" in found.sentence
    found = diagnose_fit(layer, identity, vertices, errors=errors_of(vertices, np.nan))
    assert found.cause == "unexplained"
    assert "no frame could be used" in found.sentence


@pytest.mark.parametrize("name", BODIES)
def test_a_body_that_lies_or_stands_on_its_head_is_a_warning(cases, name):
    layer, identity, vertices = cases[name]
    over = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    flat = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for turn, said, mend in (
        (over, "upside down on the whole, its head along -y", "turn the vertices until -y points up"),
        (flat, "lying on the whole, its head along z", "pass up=z"),
    ):
        given = noisy(vertices @ turn.T)
        found = diagnose_fit(layer, identity, given, errors=errors_of(given, NOISE_ERROR))
        assert (found.cause, found.failed) == ("axis", False)
        assert said in found.sentence
        assert mend in found.sentence
    found = diagnose_fit(layer, identity, vertices @ over.T, ups=("y", "-y"))
    assert "pass up=-y" in found.sentence


def test_axes_are_named_as_the_file_has_them(cases):
    layer, identity, vertices = cases["adult"]
    z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    found = diagnose_fit(layer, identity, -vertices[..., [0, 1, 2]] * torch.tensor([-1.0, 1, 1]), axes=z_up)
    assert "its head along -z of the file" in found.sentence


def test_frames_without_a_body_are_told(cases):
    layer, identity, vertices = cases["soma"]
    for given in (vertices * torch.nan, vertices * 0):
        found = diagnose_fit(layer, identity, given)
        assert (found.cause, found.failed) == ("missing", True)
        assert "each of the 8" in found.sentence


def test_errors_of_each_vertex_serve_as_well(layers):
    """A child fitted as an adult, from the result of a fit."""
    layer = layers["anny"]
    with torch.no_grad():
        vertices = layer.pose(layer.identity({"age": 0.67}), 0.2 * randn(3, 77, 3, seed=5).float()).vertices
        child = layer.identity({"age": 0.2})
        result = PoseInversion(layer)(vertices, child)
    found = diagnose_fit(layer, child, vertices, errors=result.vertex_error)
    assert (found.cause, found.failed) == ("person", True)


def test_native_vertices_are_told_by_what_they_become(layers):
    pytest.importorskip("anny")
    from soma_core.evaluation.anny_rig import smooth_clip

    layer, params = layers["anny"], {"age": 0.67}
    native = smooth_clip(params, 6, np.random.default_rng(0)).vertices
    inversion, identity = PoseInversion(layer), layer.identity(params)

    def found(vertices, error=0.005):
        canonical = inversion.canonical(vertices, "native")
        return diagnose_fit(layer, identity, canonical, errors=errors_of(canonical, error))

    assert found(native) is None
    assert found(noisy(native), 0.0235) is None  # several vertices make one, and their noise is less
    assert found(native * torch.tensor([-1.0, 1, 1])).cause == "mirrored"
    for order in (
        shuffled(native.shape[1]),
        shuffled(native.shape[1], 0.02),
        torch.arange(native.shape[1]).roll(1),
    ):
        assert found(native[:, order]).cause == "order"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"vertices": torch.zeros(2, 7, 3)}, r"vertices: got \(2, 7, 3\), expected \(frames, 4505, 3\)"),
        ({"errors": np.zeros(3)}, "errors: got 3 frames, expected 8, as vertices"),
        ({"frames": [1, 2]}, "frames: got 2 frames, expected 8"),
    ],
)
def test_what_does_not_fit_together_is_refused(cases, changes, said):
    layer, identity, vertices = cases["soma"]
    with pytest.raises(InputError, match=said):
        diagnose_fit(layer, identity, **{"vertices": vertices} | changes)


def test_one_body_at_a_time(layers):
    layer = layers["soma"]
    two = layer.identity({"shape": [[0.0], [1.0]]})
    with pytest.raises(InputError, match="identity: got a batch of 2, expected one body"):
        diagnose_fit(layer, two, torch.zeros(1, 4505, 3))
