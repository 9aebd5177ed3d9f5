"""The experiments on pose inversion: meshes that move smoothly, tables like the paper's, bounds that bite."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.errors import InputError, SomaError
from soma_core.evaluation import (
    anny_rig,
    conversion_matrix,
    inversion_sequences,
    table2_inversion,
    table3_regions,
    unknown_identity,
)
from soma_core.evaluation.inversion_runs import joint_angle_errors, run_methods
from soma_core.evaluation.inversion_sequences import MovingMesh
from soma_core.evaluation.joint_turns import own_turns
from soma_core.evaluation.random_poses import joint_spread, smooth_axis_angles
from soma_core.evaluation.shipped_layers import plain_layer
from soma_core.geometry.rotations import axis_angle_to_matrix
from soma_core.inversion import IdentityFit, InversionResult, PoseInversion
from soma_core.layer import SomaLayer

ANGLE_TOLERANCE = 1e-3
"""Degrees; float32 matrices resolve about a twentieth of that."""

FRAMES = 3


def configured(**changes):
    experiment = {"name": "x", "backend": "anny", "count": FRAMES, "methods": ["gauss_newton"]} | changes
    return OmegaConf.create({"experiment": experiment, "seed": 0, "device": "cpu"})


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", procedural=False, correctives=None)


@pytest.fixture(scope="module")
def mesh(layer):
    """Three frames of the native body."""
    turns = smooth_axis_angles(joint_spread(layer.joint_names), FRAMES, np.random.default_rng(0))
    rotations = axis_angle_to_matrix(torch.as_tensor(turns)).float()
    with torch.no_grad():
        vertices = layer.pose(layer.identity({}), rotations).vertices
    return MovingMesh(
        name="made here", backend="soma", vertices=vertices, rotations=rotations,
        turns=own_turns(layer, rotations),
    )  # fmt: skip


@pytest.fixture(scope="module")
def twisted(mesh):
    """The same frames, posed by the full model."""
    layer = SomaLayer("soma")
    with torch.no_grad():
        vertices = layer.pose(layer.identity({}), mesh.rotations).vertices
    return replace(mesh, vertices=vertices)


@pytest.fixture(scope="module")
def small(mesh, twisted):
    """Both experiments on that mesh alone, so that they take seconds."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (table2_inversion, table3_regions):
            patch.setattr(module, "anny_meshes", lambda count, seed: iter([mesh]))
        patch.setattr(table2_inversion, "own_meshes", by_layer(mesh, twisted))
        yield


@pytest.fixture(scope="module")
def table2(small):
    return table2_inversion.run(configured())


def by_layer(plain, default):
    """Makes the same mesh as posed by either layer."""
    return lambda count, seed, make: iter([plain if make is plain_layer else default])


def test_smooth_motions_are_smooth_and_end_where_they_begin():
    spread = np.array([0.5, 0.0, 0.2])
    turns = smooth_axis_angles(spread, 100, np.random.default_rng(0))
    assert turns.shape == (100, 3, 3)
    assert not turns[:, 1].any()
    steps = np.linalg.norm(np.diff(turns, axis=0, append=turns[:1]), axis=-1)
    assert steps.max() < 0.15  # rad a frame; a jump at the seam would be about as long as the spread
    assert steps[-1].max() < 0.15
    assert np.linalg.norm(turns, axis=-1).max() <= 1.6 + 1e-12
    again = smooth_axis_angles(spread, 100, np.random.default_rng(0))
    np.testing.assert_array_equal(turns, again)


@pytest.mark.slow
def test_table2_lays_the_papers_rows_and_both_layers_side_by_side(table2):
    assert not [figure for figure in table2.failed if figure.name.startswith("plain, own meshes")]
    assert {figure.name.partition(",")[0] for figure in table2.figures} == {"default", "plain"}
    text = table2.as_markdown()
    assert "| skeleton transfer only | 16.5 | 13.9 |  | 80.1 | 17,393 |" in text
    own, native, each = table2.tables[1:]
    assert [row[:2] for row in own.rows] == [
        ("gauss_newton", "default"),
        ("gauss_newton, ignoring twist and correctives", "default"),
        ("gauss_newton", "plain"),
    ]
    assert [row[:2] for row in native.rows] == [("gauss_newton", "default"), ("gauss_newton", "plain")]
    assert [row[:2] for row in each.rows] == [("made here", "default"), ("made here", "plain")] * 2
    assert json.loads(json.dumps(table2.as_json()))["tables"][0]["rows"][1][:3] == ["analytical", 5.3, 3.2]


@pytest.mark.slow
def test_the_default_rows_fit_what_the_default_posed(table2):
    through, ignoring = (row[2] for row in table2.tables[1].rows[:2])
    assert through < ignoring, "a fit that ignores twist joints and correctives misses what posed the mesh"


@pytest.mark.slow
def test_table2_fails_where_the_default_misses_its_bound(small, mesh, twisted, monkeypatch):
    noise = 0.01 * torch.randn(mesh.vertices.shape, generator=torch.Generator().manual_seed(0))
    noisy = [replace(one, vertices=one.vertices + noise) for one in (mesh, twisted)]
    monkeypatch.setattr(table2_inversion, "own_meshes", by_layer(*noisy))
    failed = {figure.name for figure in table2_inversion.run(configured()).failed}
    for layer in ("default", "plain"):
        measures = ("mean", "max", "mean angle of a joint", "max angle of a joint", "converged but wrong")
        assert {f"{layer}, own meshes, {measure}" for measure in measures} <= failed


def test_table3_gives_every_region_of_the_paper_for_both_layers(small):
    report = table3_regions.run(configured())
    assert [figure.name for figure in report.figures] == [
        f"{layer}, {measure}"
        for layer in ("default", "plain")
        for measure in ("shoulders, peak change", "not converged", "turn between frames beyond the bone's")
    ]
    text = report.as_markdown()
    assert "| method | all, mm | body, mm | hands, mm | feet, mm | head, mm |" in text
    assert "| the paper, Newton-Schulz |  |  | 0.8 |" in text


def test_methods_are_those_of_the_command_line(mesh):
    with pytest.raises(InputError, match=r"experiment\.methods: got 'guess', expected among .*gauss_newton"):
        run_methods([mesh], ["guess"], plain_layer, device="cpu")


def test_the_angle_is_that_between_the_rotations(layer, mesh):
    names = list(layer.joint_names)
    turned = mesh.rotations.clone()
    turned[:, names.index("LeftForeArm")] @= axis_angle_to_matrix(
        torch.tensor([0.0, np.radians(5), 0]).float()
    )
    turned[:, names.index("HeadEnd")] = torch.eye(3)  # carries no skin and does not count
    fields = dict.fromkeys(InversionResult.__dataclass_fields__, torch.zeros(0))
    angles = joint_angle_errors(mesh, InversionResult(**fields | {"rotations": turned}), layer)
    assert angles.max() == pytest.approx(5, abs=ANGLE_TOLERANCE)
    assert (angles > 1).sum() == FRAMES
    assert len(angles) == FRAMES
    assert 50 < angles.shape[1] < 77
    foreign = replace(mesh, rotations=None)
    assert not joint_angle_errors(foreign, InversionResult(**fields | {"rotations": turned}), layer).size


def test_own_meshes_cover_both_backends_and_the_clip():
    pytest.importorskip("soma_backend_anny")
    found = list(inversion_sequences.own_meshes(2, 0, plain_layer))
    assert [mesh.backend for mesh in found[:3]] == ["anny", "soma", "anny"]
    assert "range of motion" in found[2].name
    assert all(mesh.vertices.shape == (2, 18056, 3) for mesh in found)
    assert all(mesh.rotations.shape == (2, 77, 3, 3) for mesh in found)


@pytest.mark.slow
def test_annys_own_rig_gives_bodies_that_the_fit_explains():
    pytest.importorskip("anny")
    pytest.importorskip("soma_backend_anny")
    meshes = list(inversion_sequences.anny_meshes(FRAMES, 0))
    assert [mesh.topology for mesh in meshes] == ["native", "native"]
    runs, each = run_methods(meshes, ["gauss_newton"], plain_layer, device="cpu")
    assert runs["gauss_newton"].summary["error_mm"]["all"]["mean"] < 6
    assert len(each) == 2
    assert runs["gauss_newton"].excess is not None


def test_a_missing_anny_package_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "anny", None)
    with pytest.raises(InputError, match=r"got no anny, expected anny installed\. Run: pip install anny"):
        anny_rig.smooth_clip({}, 2, np.random.default_rng(0))


@pytest.fixture
def known_body(monkeypatch):
    """One body that its layer posed in place of all, whose identity is found at once."""

    def case(inversion, *_):
        random = np.random.default_rng(0)
        return [unknown_identity._posed(inversion, {}, random)]

    def found(layer, vertices, *, method, inversion):
        identity = layer.identity()
        return IdentityFit(
            identity=identity, params={}, pose=inversion(vertices, identity), frames=torch.arange(FRAMES),
            history=(), converged=True,
        )  # fmt: skip

    monkeypatch.setattr(unknown_identity, "_LOD", "low")
    monkeypatch.setattr(unknown_identity, "_FRAMES", FRAMES)
    monkeypatch.setattr(unknown_identity, "_people", case)
    monkeypatch.setattr(unknown_identity, "_own", case)
    monkeypatch.setattr(unknown_identity, "fit_identity", found)


def test_an_unknown_identity_is_measured_on_both_layers(known_body):
    pytest.importorskip("soma_backend_anny")
    report = unknown_identity.run(configured(count=1))
    for table in report.tables:
        assert [row[1] for row in table.rows] == ["default", "plain"]
    values = {figure.name: figure for figure in report.figures}
    assert values["default, anny's own rig, rest shape, worst body"].value == pytest.approx(0, abs=1e-6)
    assert values["default, anny's own rig, rest shape, worst body"].bound == 1
    assert values["plain, anny's own rig, rest shape, worst body"].bound is None
    assert values["plain, anny, mean angle"].value < 0.1  # degrees
    assert values["plain, anny's own rig, frames not converged"].value == 0


@pytest.mark.slow
def test_people_of_annys_own_rig_are_adults_and_an_infant(monkeypatch):
    pytest.importorskip("anny")
    pytest.importorskip("soma_backend_anny")
    monkeypatch.setattr(unknown_identity, "_FRAMES", FRAMES)
    layer = plain_layer("anny", lod="low")
    cases = list(unknown_identity._people(PoseInversion(layer), 2, 0))
    assert [case.name for case in cases] == ["adult 1", "adult 2", "infant"]
    heights = [float(case.truth.rest[0, :, 1].max() - case.truth.rest[0, :, 1].min()) for case in cases]
    assert heights[2] < 1 < min(heights[:2])
    assert all(len(turns) == FRAMES - 1 for case in cases for turns in case.turns.values())


@pytest.fixture
def few_frames(monkeypatch):
    monkeypatch.setattr(conversion_matrix, "_FRAMES", FRAMES)


def test_every_ordered_pair_is_a_row_and_a_backends_own_body_is_held_to_bounds(few_frames, monkeypatch):
    def found(layer, vertices, *, inversion):
        identity = layer.identity()
        return IdentityFit(
            identity=identity, params=identity.params, pose=inversion(vertices, identity),
            frames=torch.arange(FRAMES), history=(), converged=True,
        )  # fmt: skip

    monkeypatch.setattr(conversion_matrix, "fit_identity", found)
    report = conversion_matrix.run(configured(count=1, methods=["soma", "toy"]))
    pairs = [(row[0], row[1]) for row in report.tables[0].rows]
    assert pairs == [("soma", "soma"), ("soma", "toy"), ("toy", "soma"), ("toy", "toy")]
    assert [body.caption for body in report.bodies] == ["soma as toy", "toy as soma"]
    assert {figure.name.split(",")[0] for figure in report.figures} == {"soma", "toy"}
    assert report.failed  # bodies that were not looked for are other bodies


@pytest.mark.slow
def test_a_backends_own_body_comes_back(few_frames):
    report = conversion_matrix.run(configured(count=1, methods=["toy"]))
    assert not report.failed
    (row,) = report.tables[0].rows
    assert row[8] < 1e-4


def test_backends_without_their_files_are_left_out_and_named(monkeypatch, tmp_path):
    monkeypatch.setenv("SOMA_DATA_DIR", str(tmp_path))
    fits, notes = conversion_matrix._fits(configured(methods=[]))
    assert "soma" in [fit.layer.backend for fit in fits]
    assert any(note.startswith("smplx was left out: ") for note in notes)
    with pytest.raises(SomaError, match="smplx"):
        conversion_matrix._fits(configured(methods=["smplx"]))
