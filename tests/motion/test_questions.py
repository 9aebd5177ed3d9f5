"""What is asked about a reading: each mistake is named with the setting that mends it, and no body is."""

from __future__ import annotations

import json
import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core import SmplMotion
from soma_core.choices import Skinning
from soma_core.errors import InputError
from soma_core.io import USER_JOINTS, Motion, write_motion
from soma_core.io.bvh import write_bvh
from soma_core.io.rotation_vectors import in_radians
from soma_core.io.skeleton_files import read_skeleton
from soma_core.motion import ConvertOptions, convert_file, convert_folder, load_clip, questions, read
from soma_core.motion.posed_input import world_axes
from soma_core.motion.retargeting import retarget
from soma_core.options import InversionChoice
from soma_core.plugin.registry import default_registry
from tests.motion.test_retarget import MIXAMO
from tests.skeletons import biped
from tests.skeletons import moved as moved_biped

FPS, FRAMES = 30, 240
SECONDS = np.arange(FRAMES) / FPS
STILL = 0 * SECONDS
STEP = np.sin(12 * SECONDS)
WALK = np.stack([1.4 * SECONDS, 0.95 + 0.03 * STEP, STILL], axis=1)
RANDOM = np.random.default_rng(3)


def moved(path, turn=None, **changes):
    """A motion along `path`, whose hips are turned by a rotation or one a frame."""
    rotations = np.tile(np.eye(3), (len(path), 77, 1, 1))
    if turn is not None:
        rotations[:, 0] = turn.as_matrix()
    breath = 0.01 * np.sin(np.arange(len(path)))[:, None] * [1, 0, 0]
    rotations[:, USER_JOINTS.index("Chest")] = Rotation.from_rotvec(breath).as_matrix()
    values = {"rotations": rotations, "translation": path, "fps": FPS, "joint_names": USER_JOINTS}
    return Motion(**values | changes)


def turned(axis, degrees):
    return Rotation.from_euler(axis, np.broadcast_to(degrees, FRAMES)[:, None], degrees=True)


PEOPLE = {
    "walk": (WALK, None),
    "run": (np.stack([8 * SECONDS, 0.95 + 0.06 * STEP, STILL], 1), None),
    "sprint": (np.stack([12.4 * SECONDS, 0.95 + 0.06 * STEP, STILL], 1), None),
    "jump": (np.stack([STILL, 0.95 + 1.2 * np.maximum(STEP, 0), STILL], 1), None),
    "stairs to the third floor": (WALK + np.stack([STILL, SECONDS, STILL], 1), None),
    "300 m away": (WALK + np.array([300, 0, -200]), None),
    "up a mountain": (WALK + np.array([0, 1800, 0]), None),
    "infant that crawls": (WALK * [0.2, 0.12, 0.2], None),
    "at the origin": (0 * WALK, None),
    "from its first frame": (WALK - WALK[0], None),
    "about its mean": (WALK - WALK.mean(axis=0), None),
    "a single frame": (WALK[:1], None),
    "before a shaky camera": (RANDOM.normal([0, 1, 6], [0.05, 0.05, 0.4], (FRAMES, 3)), None),
    "lies down at the end": (WALK, turned("x", np.where(np.arange(FRAMES) < 160, 0, -90))),
    "cartwheels": (WALK, turned("z", 300 * SECONDS)),
    "bends forward": (WALK, turned("x", 35)),
    "turns on the spot": (WALK, turned("y", 400 * SECONDS)),
}


@pytest.mark.parametrize("name", PEOPLE)
def test_what_people_do_is_not_questioned(name):
    path, turn = PEOPLE[name]
    assert questions.of_motion(moved(path, turn)) == []


@pytest.mark.parametrize("scale", [0.3, 1.0, 1.2])  # infant and giant
@pytest.mark.parametrize(("unit", "factor"), [("cm", 100), ("mm", 1000)])
@pytest.mark.parametrize("path", [WALK, WALK[:1], WALK[:4], WALK * [0, 1, 0]])
def test_lengths_in_another_unit_are_named(path, unit, factor, scale):
    (said,) = questions.of_motion(moved(scale * factor * path))
    assert said.startswith("the path of the Hips puts the body ")
    assert said.endswith(f"if the lengths are in {unit}, pass unit={unit}")


def test_other_readings_are_named():
    names = questions.Names(unit="motion_unit", fps="motion_fps", ups=())
    (fast,) = questions.of_motion(moved(100 * (WALK - WALK[0])), names)
    assert "moves it at up to 140" in fast
    assert fast.endswith("pass motion_unit=cm, and if the frame rate is wrong, motion_fps=30 (the true rate)")
    (small,) = questions.of_motion(moved(0.001 * WALK))
    assert "puts the hips 0.95" in small
    joined = np.concatenate([WALK[:120], WALK[120:] + np.array([0, 0, 30])])
    (leap,) = questions.of_motion(moved(joined))
    assert "leaps at frame 120; if two recordings follow each other there, cut the file" in leap
    assert "below the ground" in questions.of_motion(moved(-100 * WALK[:1]))[0]


@pytest.mark.parametrize("fps", [1 / 120, 1 / 30, 1 / 24])
def test_a_frame_time_is_no_rate(fps):
    (said,) = questions.of_motion(moved(WALK[:3], fps=fps))
    assert said.endswith(f"if that is a frame time, pass fps={round(1 / fps)}")
    assert questions.of_rate(1.0) == questions.of_rate(960.0) == []
    assert "more than cameras take" in questions.of_rate(33333.0)[0]


@pytest.mark.parametrize("up", ["+y", "+z", "-y", "-z"])
@pytest.mark.parametrize("taken", ["+y", "+z", "-y", "-z"])
def test_every_wrong_axis_is_told_with_the_one_that_is_right(up, taken):
    # A person who stands where `up` is up, in a file whose world is taken to have `taken` up.
    root = Rotation.from_matrix(world_axes(up).T) * turned("y", 60 * SECONDS)
    rotations = np.zeros((FRAMES, 24, 3))
    rotations[:, 0] = root.as_rotvec()
    person = SmplMotion(
        model="smpl", rotations=rotations, translation=WALK @ world_axes(up), betas=[0], gender="male",
        fps=FPS, up=taken,
    )  # fmt: skip
    said = questions.of_smpl(person)
    if up == taken:
        assert said == []
        return
    (told,) = said
    assert told.endswith(f"if that is not its pose, pass up={up.lstrip('+')}")
    assert ("upside down" in told) == (up[1] == taken[1])


def test_a_motion_on_this_skeleton_lies_whatever_its_rotations_are_relative_to():
    from soma_core.rig import load_canonical

    rig = load_canonical("mid")[1]
    own, above = rig.t_pose_world[1:, :3, :3], rig.t_pose_world[rig.parents[1:], :3, :3]
    for angle in (0, 90):
        rotations = moved(WALK, turned("x", angle)).rotations
        relative = questions.of_motion(moved(WALK, rotations=rotations))
        local = np.swapaxes(above, -1, -2) @ rotations @ own
        absolute = moved(WALK, rotations=local, convention="absolute_local")
        assert questions.of_motion(absolute) == relative
        assert bool(relative) == (angle == 90)


@pytest.mark.parametrize("model", [("smpl", 24), ("smplh", 52), ("smplx", 55)])
@pytest.mark.parametrize("largest", [0.4, 2.6])
def test_degrees_are_told_from_radians(tmp_path, model, largest):
    vectors = RANDOM.uniform(-1, 1, (20, model[1], 3))
    vectors *= largest / np.linalg.norm(vectors, axis=-1).max()

    def person(angles):
        return SmplMotion(
            model=model[0],
            rotations=angles,
            translation=np.zeros((20, 3)),
            betas=[0],
            gender="female",
            fps=FPS,
        )

    assert not any("degrees" in said for said in questions.of_smpl(person(vectors)))
    degrees = np.rad2deg(vectors)
    assert questions.of_smpl(person(degrees))[0].endswith("if the angles are in degrees, pass angles=deg")
    np.testing.assert_allclose(in_radians(tmp_path, degrees, "deg"), vectors)
    with pytest.raises(InputError, match=r"angles: got deg for .* largest angle .*Leave angles out"):
        in_radians(tmp_path, vectors, "deg")


def test_joints_carried_over_are_questioned_too(tmp_path, caplog):
    """Without the model, SMPL's angles and lengths are asked for as with it, and the settings mend them."""
    poses = np.zeros((FRAMES, 22, 3))
    poses[:, 0] = Rotation.from_euler("x", 90, degrees=True).as_rotvec()
    poses[:, 4] = np.linspace([0, 0, 0], [1.2, 0, 0], FRAMES)
    names = {
        "betas": np.zeros(10),
        "gender": "neutral",
        "mocap_frame_rate": 30.0,
        "surface_model_type": "smplx",
    }
    walk = WALK[:, [0, 2, 1]]
    np.savez(tmp_path / "a.npz", poses=poses.reshape(FRAMES, -1), trans=walk, **names)
    wrong = np.degrees(poses.reshape(FRAMES, -1))
    np.savez(tmp_path / "b.npz", poses=wrong, trans=100 * walk, **names)
    options = ConvertOptions(carry="skeleton")
    right = convert_file(tmp_path / "a.npz", tmp_path / "a", options=options)
    assert not [text for text in right.report["warnings"] if "pass" in text]
    found = convert_file(tmp_path / "b.npz", tmp_path / "b", options=options)
    assert any("angles=deg" in text for text in found.report["warnings"])
    options = ConvertOptions(carry="skeleton", angles="deg", unit="cm")
    found = convert_file(tmp_path / "b.npz", tmp_path / "c", options=options).motion()
    np.testing.assert_allclose(found.rotations, right.motion().rotations, atol=1e-5)
    np.testing.assert_allclose(found.translation, right.motion().translation, atol=1e-5)


def test_a_path_in_another_unit_than_the_bones_is_said(tmp_path, caplog):
    source = upright()
    write_bvh(replace(source, root=100 * source.root), tmp_path / "a.bvh")
    said = convert_file(tmp_path / "a.bvh", tmp_path / "out").report["warnings"]
    assert any("above the ground" in text for text in said), said


def test_angles_of_a_bvh_may_be_radians(tmp_path, caplog):
    source = upright()
    write_bvh(source, tmp_path / "a.bvh")
    expected = read_skeleton(tmp_path / "a.bvh")
    assert "angles=rad" not in caplog.text
    head, _, rows = (tmp_path / "a.bvh").read_text().partition("Frame Time:")
    time, _, rows = rows.partition("\n")
    numbers = np.array([row.split() for row in rows.splitlines()], np.float64)
    numbers[:, 3:] = np.radians(numbers[:, 3:])
    rows = "\n".join(" ".join(map(repr, map(float, row))) for row in numbers)
    (tmp_path / "b.bvh").write_text(f"{head}Frame Time:{time}\n{rows}\n")
    read_skeleton(tmp_path / "b.bvh")
    assert "angles=rad" in caplog.text
    found = convert_file(tmp_path / "b.bvh", tmp_path / "out", options=ConvertOptions(angles="rad"))
    assert not any("angles" in text for text in found.report["warnings"])
    np.testing.assert_allclose(
        read_skeleton(tmp_path / "b.bvh", angles="rad").rotations, expected.rotations, atol=1e-6
    )


def upright():
    """A walker of another skeleton."""
    return moved_biped(*biped(MIXAMO), seed=4)


@pytest.mark.parametrize("axis", [0, 2])
def test_a_mirrored_skeleton_is_said(axis, tmp_path, caplog):
    source = upright()
    assert not retarget(source).report["not_carried"]
    assert "backwards" not in caplog.text
    signs = np.where(np.arange(3) == axis, -1, 1)
    retarget(replace(source, rest=source.rest * signs))
    assert "toes point backwards" in caplog.text
    assert "mapping=FILE" in caplog.text


def test_a_leap_within_a_step_is_named():
    """Eight metres from one frame to the next are none's, though half a minute of walking is as far."""
    path = WALK.copy()
    path[100:, 0] += 8
    assert "leaps at frame 100" in " ".join(questions.of_motion(moved(path)))


def test_a_body_that_was_turned_many_times_is_no_file_of_degrees():
    rotations = np.zeros((FRAMES, 24, 3))
    rotations[:, 0] = turned("y", 0).as_rotvec() + np.stack([STILL, 2 * SECONDS, STILL], 1)
    person = SmplMotion(
        model="smpl", rotations=rotations, translation=WALK, betas=[0], gender="male", fps=FPS, up="+y"
    )
    assert questions.of_smpl(person) == []


def test_parameters_far_outside_their_range_are_named():
    spec = default_registry().spec("soma")
    assert questions.of_params(spec, {"shape": [4.0, -4.5, 0]}) == []
    (said,) = questions.of_params(spec, {"shape": [0, 1, -40]})
    assert said.startswith(
        "backend.params.shape=-40 is far outside the range of soma, -3 to 3 (coefficients in"
    )
    assert questions.of_params(spec, {"shape": "none"}) == []  # the backend refuses that itself


def kimodo(path, **arrays):
    turns = np.tile(np.eye(3), (3, 77, 1, 1))
    values = {"local_rot_mats": turns, "root_positions": np.tile([0, 95.0, 0], (3, 1))}
    np.savez(path, **values | arrays)
    return path


def test_a_setting_that_does_not_apply_is_refused_for_a_file_and_said_in_a_folder(tmp_path, caplog):
    (tmp_path / "clips").mkdir()
    file = kimodo(tmp_path / "clips/m.npz")
    for name, value in {
        "gender": "male",
        "up": "z",
        "axes": "camera",
        "angles": "deg",
        "most_betas": 4,
    }.items():
        with pytest.raises(
            InputError, match=rf"m\.npz: {name}: got {value}, expected none.*Leave {name} out"
        ):
            convert_file(file, tmp_path / "out", options=ConvertOptions(unit="cm", **{name: value}))
    caplog.set_level(logging.WARNING)
    found = convert_folder(tmp_path / "clips", tmp_path / "all", options=ConvertOptions(up="z"))
    row = json.loads((tmp_path / "all/report.json").read_text())["files"]["m.npz"]
    unused, high = row["warnings"]
    assert unused == "m.npz: up=z is not used: a kimodo file has no use for it"
    assert high.endswith("if the lengths are in cm, pass unit=cm")
    assert not found.errors


def test_a_unit_is_applied_wherever_lengths_are_read(tmp_path, caplog):
    file = kimodo(tmp_path / "m.npz")
    caplog.set_level(logging.WARNING)
    motion = convert_file(file, tmp_path / "out", options=ConvertOptions(unit="cm")).motion()
    np.testing.assert_allclose(motion.translation[:, 1], 0.95)
    np.testing.assert_allclose(load_clip(file, unit="cm").translation[:, 1], 0.95)
    assert not caplog.text
    load_clip(file)
    assert "pass motion_unit=cm" in caplog.text


def test_smpl_files_have_their_unit_and_angles(smplh_models, amass, tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    # Plain skinning: the full model has folds, beside which rounding decides where a noisy stand-in ends.
    told = InversionChoice(skinning=Skinning.plain)
    options = ConvertOptions(lod="low", inversion=told, unit="mm", angles="deg")
    degrees = {"poses": np.rad2deg(amass["poses"]), "trans": 1000 * amass["trans"]}
    np.savez(tmp_path / "m.npz", **amass | degrees)
    np.savez(tmp_path / "plain.npz", **amass)
    mended = convert_file(tmp_path / "m.npz", tmp_path / "a", options=options)
    same = ConvertOptions(lod="low", inversion=told)
    plain = convert_file(tmp_path / "plain.npz", tmp_path / "b", options=same)
    assert not caplog.text
    np.testing.assert_allclose(mended.motion().translation, plain.motion().translation, atol=1e-4)
    # The fit ends at steps of 0.02 mm, which rounding changes.
    hips = [found.motion().rotations[:, 0] for found in (mended, plain)]
    np.testing.assert_allclose(*hips, atol=5e-3)
    assert mended.error_mm["mean"] == pytest.approx(plain.error_mm["mean"], rel=0.02)
    assert mended.report["settings"]["angles"] == "deg"
    assert mended.report["warnings"] == []


def test_rotation_vectors_of_soma_files_may_be_degrees(tmp_path, caplog):
    turns = RANDOM.uniform(-1, 1, (4, 77, 3))
    keys = {"transl": np.ones((4, 3)), "unit": "meters", "fps": 30, "convention": "t_pose_relative"}
    np.savez(tmp_path / "m.npz", poses=np.rad2deg(turns), **keys)
    caplog.set_level(logging.WARNING)
    read(tmp_path / "m.npz")
    assert "if the angles are in degrees, pass angles=deg" in caplog.text
    found = read(tmp_path / "m.npz", angles="deg").rotations
    np.testing.assert_allclose(found[:, 5], Rotation.from_rotvec(turns[:, 5]).as_matrix(), atol=1e-6)


def test_an_overridden_frame_rate_and_unit_are_said(tmp_path, caplog):
    write_motion(moved(WALK), tmp_path / "m.npz")
    caplog.set_level(logging.WARNING)
    read(tmp_path / "m.npz", fps=30.0, unit="m")
    assert not caplog.text
    read(tmp_path / "m.npz", fps=24, unit="mm")
    assert "m.npz: fps=24 is taken in place of the file's own, 30" in caplog.text
    assert "m.npz: unit=mm is taken in place of the file's own, meters" in caplog.text


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"poses": np.zeros((3, 165)), "betas": np.zeros(10)}, "Pass fps="),
        ({"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((3, 63))}, "Pass betas="),
        ({"joints_3d": np.zeros((3, 22, 3))}, "expected poses, or root_orient and pose_body"),
        ({"betas": np.zeros(16), "gender": "male"}, None),
        ({"cam_poses": np.zeros((4, 4, 4)), "K": np.eye(3)}, None),
        ({"extrinsics": np.zeros((4, 3, 4)), "dist_coeffs": np.zeros(5)}, None),
    ],
)
def test_poses_that_cannot_be_read_count_as_failed(tmp_path, keys, reason):
    (tmp_path / "clips").mkdir()
    np.savez(tmp_path / "clips/m.npz", **keys)
    found = convert_folder(tmp_path / "clips", tmp_path / "out")
    row = json.loads((tmp_path / "out/report.json").read_text())["files"]["m.npz"]
    assert (row["state"], list(found.errors)) == (("failed", ["m.npz"]) if reason else ("skipped", []))
    if reason:
        assert reason in row["reason"]
    if not (reason or "").startswith("Pass"):
        assert f"the keys {', '.join(keys)}" in row["reason"]


def test_only_what_is_said_meanwhile_in_this_package_is_heard():
    log = logging.getLogger("soma_core.somewhere")
    log.warning("before")
    with questions.heard() as said:
        log.warning("%d of them", 3)
        log.warning("%d of them", 3)
        log.info("not this")
        logging.getLogger("another").warning("nor this")
    log.warning("after")
    assert said == ["3 of them"]


CASES = Path(os.environ.get("SOMA_TEST_DATA", "")) / "cases"


@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("14_kimodo_hips_cm", {}, ["100 m or more above the ground; if the lengths are in cm, pass unit=cm"]),
        ("14_kimodo_hips_cm", {"unit": "cm"}, []),
    ],
)
def test_files_of_others(tmp_path, name, settings, told):
    file = CASES / f"{name}.npz"
    if not file.is_file():
        pytest.skip(f"needs SOMA_TEST_DATA with {file}")
    warnings = convert_file(file, tmp_path, options=ConvertOptions(**settings)).report["warnings"]
    assert len(warnings) == len(told)
    assert all(part in warning for part, warning in zip(told, warnings, strict=True))


@pytest.mark.parametrize("name", ["01_single_text_prompt", "03_full_body_keyframes", "06_root_waypoints"])
def test_motions_of_others_are_not_questioned(name):
    file = CASES.with_name("motions") / f"kimodo_{name}.npz"
    if not file.is_file():
        pytest.skip(f"needs SOMA_TEST_DATA with {file}")
    assert questions.of_motion(read(file)) == []


def test_the_shipped_clip_is_not_questioned(caplog):
    load_clip()
    assert not caplog.text


def test_an_earlier_run_repeats_its_doubts(smplh_models, amass, tmp_path, caplog):
    np.savez(tmp_path / "m.npz", **amass | {"trans": 100 * amass["trans"]})
    options = ConvertOptions(lod="low")
    first = convert_file(tmp_path / "m.npz", tmp_path / "out", options=options)
    (told,) = first.report["warnings"]
    assert "trans puts the body 90 m or more above the ground" in told
    caplog.clear()
    again = convert_file(tmp_path / "m.npz", tmp_path / "out", options=options)
    assert again.earlier
    assert told in caplog.text


def test_rows_of_coefficients_that_differ_are_several_persons():
    rows = np.zeros((FRAMES, 8))
    several = {"backend": "mhr", "identity_coeffs": rows + (np.arange(FRAMES) > 100)[:, None]}
    assert "holds several persons" in questions.of_motion(moved(WALK, identity=several))[0]
    assert not questions.of_motion(moved(WALK, identity={"backend": "mhr", "identity_coeffs": rows}))
