"""The report: exact means and maxima, regions that add up, and the same whatever the chunks."""

import json
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from soma_core.errors import InputError
from soma_core.inversion.regions import REGIONS, body_regions, shoulder_region
from soma_core.inversion.report import InversionReport
from soma_core.inversion.result import InversionResult
from soma_core.rig import load_canonical

QUANTILE_TOLERANCE = 2e-3
"""Relative: bins are 0.1 % wide, and one number may lie in the next."""

FRAMES = 12


@pytest.fixture(scope="module")
def canonical():
    return load_canonical("low")


@pytest.fixture(scope="module")
def result(canonical):
    """Twelve frames; frame 4 could not be used, and vertex 7 has no target."""
    mesh, rig = canonical
    random = torch.Generator().manual_seed(0)
    error = torch.rand(FRAMES, mesh.vertex_count, generator=random) ** 4 * 0.02
    valid = torch.ones(FRAMES, dtype=torch.bool)
    valid[4] = False
    error[4], error[:, 7] = float("nan"), float("nan")
    eye = torch.eye(3).repeat(FRAMES, len(rig.user_joint_names), 1, 1)
    eye[3, 5, 0, 1], eye[4, 0] = 1e-3, 7.0
    return InversionResult(
        rotations=eye,
        translation=torch.zeros(FRAMES, 3),
        vertex_error=error,
        valid=valid,
        determined=valid[:, None].expand(-1, len(rig.user_joint_names)),
        converged=torch.arange(FRAMES) % 2 == 0,
        iterations=torch.arange(FRAMES),
        residual=torch.zeros(FRAMES),
        plain=torch.arange(FRAMES) % 3 == 1,
        angle_std=torch.full((FRAMES, len(rig.user_joint_names)), 0.5),
    )


def part(result, frames):
    return InversionResult(**{name: getattr(result, name)[frames] for name in result.__dataclass_fields__})


def reported(canonical, result, sizes):
    report = InversionReport(*canonical)
    start = 0
    for size in sizes:
        report.add(part(result, slice(start, start + size)))
        start += size
    return report.as_dict()


@pytest.mark.parametrize("lod", ["mid", "low"])
def test_every_vertex_is_in_one_region(lod):
    mesh, rig = load_canonical(lod)
    regions = body_regions(mesh, rig)
    assert tuple(regions) == (*REGIONS, "face_interior")
    np.testing.assert_array_equal(
        np.sort(np.concatenate(list(regions.values()))), np.arange(mesh.vertex_count)
    )
    np.testing.assert_array_equal(regions["face_interior"], mesh.face_interior)
    low, high = mesh.vertices[regions["feet"]][:, 1].max(), mesh.vertices[regions["head"]][:, 1].min()
    assert low < 0.2 < 1.3 < high  # metres above the ground
    assert np.abs(mesh.vertices[regions["hands"]][:, 0]).min() > 0.3
    shoulders = mesh.vertices[shoulder_region(rig)]
    assert shoulders[:, 0].min() < 0 < shoulders[:, 0].max()
    assert shoulders[:, 1].min() > 1.2


def test_figures_are_those_of_the_errors(canonical, result):
    mesh, rig = canonical
    found = reported(canonical, result, [FRAMES])
    errors = 1e3 * result.vertex_error.double().numpy()
    regions = body_regions(mesh, rig)
    skin = np.setdiff1d(np.arange(mesh.vertex_count), mesh.face_interior)
    for name, ids in {"all": skin, **regions}.items():
        values = errors[:, ids][np.isfinite(errors[:, ids])]
        row = found["error_mm"][name]
        assert row["mean"] == pytest.approx(values.mean(), rel=1e-9)
        assert row["max"] == pytest.approx(values.max(), rel=1e-9)
        assert row["median"] == pytest.approx(np.median(values), rel=QUANTILE_TOLERANCE)
        assert row["p95"] == pytest.approx(np.quantile(values, 0.95), rel=QUANTILE_TOLERANCE)


def test_frames_that_could_not_be_used_count_apart(canonical, result):
    found = reported(canonical, result, [FRAMES])
    assert (found["frames"], found["unusable_frames"], found["unusable"]) == (FRAMES, 1, [4])
    assert found["converged_share"] == pytest.approx(5 / 11)
    assert found["plain_share"] == pytest.approx(3 / 11)
    assert found["iterations"] == {"mean": pytest.approx((66 - 4) / 11), "max": 11}
    assert found["orthonormality"] == pytest.approx(1e-3, rel=1e-3)


def test_the_shoulder_change_is_that_of_frames_next_to_each_other(canonical, result):
    errors = 1e3 * result.vertex_error.double().numpy()[:, shoulder_region(canonical[1])]
    change = np.abs(np.diff(errors, axis=0))
    kept = np.delete(change, [3, 4], axis=0)  # the pairs around frame 4
    found = reported(canonical, result, [FRAMES])["shoulder_change_mm_per_frame"]
    means = np.nanmean(kept, axis=1)
    assert found["mean"] == pytest.approx(means.mean(), rel=1e-6)
    assert found["peak"] == pytest.approx(means.max(), rel=1e-6)
    assert found["peak_of_a_vertex"] == pytest.approx(np.nanmax(kept), rel=1e-6)


@pytest.mark.parametrize("sizes", [[1] * FRAMES, [5, 7], [3, 1, 1, 7]])
def test_chunks_give_what_the_whole_gives(canonical, result, sizes):
    whole, chunked = reported(canonical, result, [FRAMES]), reported(canonical, result, sizes)
    flat, same = json.dumps(whole), json.loads(json.dumps(chunked))
    for key, value in json.loads(flat).items():
        if isinstance(value, dict):
            for name, entry in value.items():
                assert same[key][name] == pytest.approx(entry, rel=1e-9), (key, name)
        else:
            assert same[key] == pytest.approx(value)


def test_stored_states_merge_in_the_order_of_the_frames(canonical, result):
    joined = InversionReport(*canonical)
    for frames in (slice(0, 5), slice(5, FRAMES)):
        report = InversionReport(*canonical)
        report.add(part(result, frames))
        joined.merge({name: np.array(value) for name, value in report.arrays().items()})
    assert joined.as_dict()["unusable"] == [4]
    assert joined.as_dict()["frames"] == FRAMES


def test_sequences_join_without_a_change_between_them(canonical, result):
    parts = []
    for frames in (slice(0, 3), slice(8, FRAMES)):
        report = InversionReport(*canonical)
        report.add(part(result, frames))
        parts.append(report.arrays())
    joined = InversionReport(*canonical)
    for arrays in parts:
        joined.merge(arrays, consecutive=False)
    errors = 1e3 * result.vertex_error.double().numpy()[:, shoulder_region(canonical[1])]
    change = np.nanmean(np.abs(np.diff(errors, axis=0))[[0, 1, 8, 9, 10]], axis=1)
    found = joined.as_dict()["shoulder_change_mm_per_frame"]
    assert found["mean"] == pytest.approx(change.mean(), rel=1e-6)
    assert found["peak"] == pytest.approx(change.max(), rel=1e-6)


def test_nothing_usable_gives_no_figures(canonical, result):
    found = InversionReport(*canonical)
    found.add(part(result, slice(4, 5)))
    assert found.as_dict()["error_mm"]["all"] == dict.fromkeys(("mean", "median", "p95", "max"))
    assert found.as_dict()["converged_share"] is None
    assert "1 frames, 1 of them unusable; converged none" in found.as_text()


def test_the_table_names_every_region(canonical, result):
    report = InversionReport(*canonical)
    report.add(result)
    lines = report.as_text().splitlines()
    names = [line.split("  ")[0] for line in lines]
    assert names[:7] == ["error, mm", "all", "body", "hands", "feet", "head", "face interior"]
    assert "12 frames, 1 of them unusable; converged 45.5%, after 5.6 iterations" in lines[-3]
    assert "shoulder error changes by" in lines[-2]
    assert "another rig moved the skin of 27.3% of the frames" in lines[-1]


def test_a_result_of_another_mesh_is_refused(result):
    with pytest.raises(InputError, match=r"result\.vertex_error: got 4505 vertices, expected 18056"):
        InversionReport(*load_canonical("mid")).add(result)


def test_angle_deviations_are_medians_of_usable_frames_whatever_the_chunks(canonical, result):
    """By joint name; a joint that no frame determines has none."""
    angles = 0.5 * torch.arange(1, FRAMES + 1)[:, None].expand(-1, 77).clone()
    angles[4] = 100  # not usable
    angles[:, 3] = torch.inf
    values = {name: getattr(result, name) for name in result.__dataclass_fields__} | {"angle_std": angles}
    found = []
    for cuts in ([0, FRAMES], [0, 5, 6, FRAMES]):
        report = InversionReport(*canonical)
        for start, stop in pairwise(cuts):
            report.add(SimpleNamespace(**{name: array[start:stop] for name, array in values.items()}))
        found.append(report.as_dict()["angle_std_degrees"])
    assert found[0] == found[1]
    names = canonical[1].user_joint_names
    assert list(found[0]) == list(names)
    assert found[0][names[3]] is None
    assert found[0][names[0]] == pytest.approx(3.5, rel=0.01)


def test_angle_deviations_survive_a_chunk_without_any(canonical, result):
    report = InversionReport(*canonical)
    values = {name: getattr(result, name) for name in result.__dataclass_fields__}
    none = SimpleNamespace(**values | {"angle_std": torch.full((FRAMES, 77), torch.nan)})
    report.add(none)
    report.add(SimpleNamespace(**values | {"angle_std": torch.full((FRAMES, 77), 2.0)}))
    report.add(none)
    assert report.as_dict()["angle_std_degrees"]["Hips"] == pytest.approx(2.0, rel=0.01)
