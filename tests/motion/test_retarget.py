"""Motions of other skeletons: bones point the same way here, whatever the names, lengths and rest poses."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_core import load_canonical
from soma_core.errors import InputError
from soma_core.io.bvh import write_bvh
from soma_core.io.joint_names import match_joints
from soma_core.io.joint_order import PARENT_NAMES, USER_JOINTS
from soma_core.io.skeleton_files import read_skeleton
from soma_core.io.skeleton_motion import soma_skeleton
from soma_core.layer import SomaLayer
from soma_core.motion import ConvertOptions, FrameRange, convert_file, load_clip, write_body
from soma_core.motion.carried import refined
from soma_core.motion.retargeting import retarget
from tests.skeletons import along_axes, biped, in_another_pose, moved

FLAT_DEGREES = 1.0
UPRIGHT_DEGREES = 6.0  # lines of feet that point outwards there and ahead here roll them a little
REACHED = 1.5e-3  # [m]: a thousandth of a leg, see Limb.reach
SAME_DEGREES = 0.05  # float32 rotations and seven decimals of a file; half a degree is what is asked

LAFAN = {
    "hips": "Hips",
    "spine": "Spine Spine1 Spine2",
    "neck": "Neck",
    "head": "Head",
    "collar": "*Shoulder",
    "arm": "*Arm",
    "elbow": "*ForeArm",
    "wrist": "*Hand",
    "thigh": "*UpLeg",
    "knee": "*Leg",
    "ankle": "*Foot",
    "toe": "*Toe",
    "finger1": "*HandMiddle1",
    "finger2": "*HandMiddle2",
}
MIXAMO = {part: " ".join(f"mixamorig:{name}" for name in names.split()) for part, names in LAFAN.items()}
MIXAMO["toe"] = "mixamorig:*ToeBase"
XSENS = {
    "hips": "Pelvis",
    "spine": "L5 L3 T12 T8",
    "neck": "Neck",
    "head": "Head",
    "collar": "*Shoulder",
    "arm": "*UpperArm",
    "elbow": "*ForeArm",
    "wrist": "*Hand",
    "thigh": "*UpperLeg",
    "knee": "*LowerLeg",
    "ankle": "*Foot",
    "toe": "*Toe",
}
STYLE = {
    "hips": "Hips",
    "spine": "Chest Chest2 Chest3 Chest4 Chest5",
    "neck": "Neck",
    "head": "Head",
    "collar": "*Collar",
    "arm": "*Shoulder",
    "elbow": "*Elbow",
    "wrist": "*Wrist",
    "thigh": "*Hip",
    "knee": "*Knee",
    "ankle": "*Ankle",
    "toe": "*Toe",
}
UNREAL = {
    "hips": "pelvis",
    "spine": "spine_01 spine_02",
    "neck": "neck_01",
    "head": "head",
    "collar": "clavicle_*",
    "arm": "upperarm_*",
    "elbow": "lowerarm_*",
    "wrist": "hand_*",
    "thigh": "thigh_*",
    "knee": "calf_*",
    "ankle": "foot_*",
    "toe": "ball_*",
    "finger1": "middle_01_*",
    "finger2": "middle_02_*",
}


@pytest.fixture(scope="module")
def rig():
    return load_canonical("mid")[1]


def lafan_like():
    return along_axes(moved(*biped(LAFAN, scale=1.05), seed=1))


def mixamo_like():
    return moved(*biped(MIXAMO), seed=2)


def xsens_like():
    """Rests with the arms hanging, a little bent."""
    motion = moved(*biped(XSENS, spine=4, hands=False), seed=3)
    turns = np.tile(np.eye(3), (len(motion.names), 1, 1))
    for joint, name in enumerate(motion.names):
        side = 1 if name.startswith("Left") else -1
        if name.removeprefix("Left").removeprefix("Right") in ("UpperArm", "ForeArm", "Hand"):
            bend = Rotation.from_rotvec([0, 0, -side * 1.45]) * Rotation.from_rotvec([0, -side * 0.2, 0])
            turns[joint] = bend.as_matrix()
    return in_another_pose(motion, turns)


SOURCES = [
    lafan_like,
    mixamo_like,
    xsens_like,
    lambda: moved(*biped(STYLE, spine=5, hands=False), seed=4),
    lambda: moved(*biped(UNREAL, spine=2), seed=5),
]


def bones_apart(source, found, rig):
    """Largest angle [degrees] between each bone there and here, over the frames."""
    report, here, there = found.report, soma_skeleton(found.motion, rig).positions(), source.positions()
    joints = dict(report["joints"]) | {"Neck1": report["neck"][0]}
    if len(report["spine"]) == 3:
        joints |= dict(zip(("Spine1", "Spine2", "Chest"), report["spine"], strict=True))
    apart = {}
    for name in joints:
        above = "Neck1" if name == "Head" else PARENT_NAMES[name]
        # Several bones hang on these, whose angles to each other are those of the body.
        if above in joints and above not in ("Hips", "Chest", "LeftHand", "RightHand"):
            bone = here[:, USER_JOINTS.index(name)] - here[:, USER_JOINTS.index(above)]
            index = [source.names.index(joints[each]) for each in (name, above)]
            other = there[:, index[0]] - there[:, index[1]]
            lengths = np.linalg.norm(bone, axis=-1) * np.linalg.norm(other, axis=-1)
            sine = np.linalg.norm(np.cross(bone, other), axis=-1) / lengths
            apart[name] = np.degrees(np.arctan2(sine, (bone * other).sum(-1) / lengths)).max()
    return apart


@pytest.mark.parametrize("make", SOURCES, ids=["lafan", "mixamo", "xsens", "100style", "unreal"])
def test_bones_point_the_same_way(make, rig):
    source = make()
    apart = bones_apart(source, retarget(source, match="bones"), rig)
    assert len(apart) >= 13
    assert max(apart.values()) < SAME_DEGREES, apart


@pytest.mark.parametrize("along", [False, True], ids=["standing", "along axes"])
@pytest.mark.parametrize("higher", [0.0, 0.03])
def test_soles_are_as_flat_as_there(along, higher, rig):
    """Ankles that lie higher above the sole leave it flat; every other bone points as there."""
    names, parents, rest = biped(MIXAMO)
    rest[[joint for joint, name in enumerate(names) if name.endswith("ToeBase")], 1] -= higher
    source = moved(names, parents, rest, frames=60, seed=7)
    feet = [joint for joint, name in enumerate(names) if name.endswith(("Foot", "ToeBase"))]
    turns = source.turns()
    turns[:30, feet] = np.eye(3)  # half of the time they stand, whatever the legs do
    for joint in feet:
        source.rotations[:, joint] = np.swapaxes(turns[:, parents[joint]], -1, -2) @ turns[:, joint]
    root = source.root + [0, 10, 0] * (np.arange(60)[:, None] >= 30)  # then they fly
    source = replace(source, root=root)
    found = retarget(along_axes(source) if along else source, match="soles")
    turns = soma_skeleton(found.motion, rig).turns()[:30]
    for joint in ("LeftFoot", "LeftToeBase", "RightToeBase"):
        here = turns[:, USER_JOINTS.index(joint)]
        pitch = np.degrees(np.arcsin(here[:, 1, 2]))  # how far a sole points up
        assert np.abs(pitch).max() < FLAT_DEGREES, joint
        assert here[:, 1, 1].min() > np.cos(np.radians(UPRIGHT_DEGREES)), joint
    apart = bones_apart(along_axes(source) if along else source, found, rig)
    assert max(angle for name, angle in apart.items() if "Toe" not in name) < SAME_DEGREES
    told = found.report["foot_slopes_degrees"]
    assert told == pytest.approx(
        {"LeftFoot": apart["LeftToeBase"], "RightFoot": apart["RightToeBase"]}, abs=0.05
    )


def test_feet_that_never_stand_flat_keep_their_bones(rig):
    source = lafan_like()  # feet turn at random: no frame tells the sole
    found = retarget(source, match="soles")
    assert max(bones_apart(source, found, rig).values()) < SAME_DEGREES
    assert found.report["foot_slopes_degrees"] == {}


def test_twist_comes_from_knees_and_elbows_where_bones_rest_along_axes(rig):
    plain = moved(*biped(LAFAN), seed=6)
    upright, aligned = (
        soma_skeleton(retarget(each).motion, rig).turns() for each in (plain, along_axes(plain))
    )
    for name in ("LeftLeg", "RightShin", "LeftArm", "RightArm", "LeftForeArm"):
        joint = USER_JOINTS.index(name)
        cosine = (np.einsum("fab,fab->f", upright[:, joint], aligned[:, joint]) - 1) / 2
        assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < 8, (
            name
        )  # a bent rest pose tells it otherwise
    assert retarget(along_axes(plain)).report["rest_pose"] == "bones along axes"


@pytest.mark.parametrize("spine", [2, 5])
def test_a_spine_of_another_length_shares_out_its_turn(spine, rig):
    names = STYLE if spine == 5 else UNREAL
    bare = biped(names, spine=spine, hands=False)
    motion = moved(*bare, seed=7)
    bend = Rotation.from_rotvec([0.2, 0, 0]).as_matrix()
    spines = [motion.names.index(name) for name in names["spine"].split()]
    motion.rotations[:] = np.eye(3)
    motion.rotations[:, spines] = bend
    found = retarget(motion, match="limbs")
    turns = soma_skeleton(found.motion, rig).turns()[0]
    angles = [
        np.degrees(Rotation.from_matrix(turns[USER_JOINTS.index(name)]).magnitude())
        for name in ("Spine1", "Spine2", "Chest", "Neck1")
    ]
    total = np.degrees(0.2 * spine)
    assert angles[2:] == pytest.approx([total, total], abs=1e-3)
    assert angles[1] - angles[0] == pytest.approx(angles[2] - angles[1], abs=1e-3)


@pytest.mark.parametrize(("metres", "said"), [(1, 0), (0.01, 0), (0.001, 0), (0.0254, 1)])
@pytest.mark.parametrize("up", ["+y", "+z", "-y"])
def test_units_and_axes_are_told(metres, said, up, rig, caplog):
    source = mixamo_like()
    turn = {
        "+y": np.eye(3),
        "+z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        "-y": np.diag([1.0, -1, -1]),
    }[up]
    with caplog.at_level(logging.WARNING):
        found = retarget(source.placed(turn, 1 / metres))
    meant = retarget(source)
    assert len(caplog.records) == said
    assert found.report["unit_metres"] == pytest.approx(metres)
    assert found.report["up"] == up
    assert np.abs(found.motion.rotations - meant.motion.rotations).max() < 1e-6
    assert np.abs(found.motion.translation - meant.motion.translation).max() < 1e-5


def test_feet_stand_where_they_stood(rig):
    """The path of the middle between the legs, scaled by the legs, leaves the feet as far above the floor."""
    source = mixamo_like()
    source.rotations[:] = np.eye(3)
    found = retarget(source)
    scale = found.report["path_scale"]
    here = soma_skeleton(found.motion, rig).positions()[:, USER_JOINTS.index("LeftFoot")]
    there = source.positions()[:, source.names.index("mixamorig:LeftFoot")]
    assert np.abs(here - scale * there)[:, 1].max() < 0.02  # [m]: legs that lean a little differ so much


def test_names_that_are_not_known_give_the_template_of_a_mapping(tmp_path, rig):
    strange = {
        part: " ".join(f"bone{index}*{word}" for word in range(len(names.split())))
        for index, (part, names) in enumerate(LAFAN.items())
    }
    source = moved(*biped(strange), seed=8)
    write_bvh(source, tmp_path / "strange.bvh")
    with pytest.raises(InputError, match="mapping=FILE") as caught:
        convert_file(tmp_path / "strange.bvh", tmp_path / "out")
    template = json.loads(re.search(r"\{.*\}", str(caught.value), re.DOTALL)[0])
    parts = {
        "Shoulder": "collar",
        "Arm": "arm",
        "ForeArm": "elbow",
        "Hand": "wrist",
        "Leg": "thigh",
        "Shin": "knee",
        "Foot": "ankle",
        "ToeBase": "toe",
    }
    for target in template:
        side = target[: len(target) - len(target.removeprefix("Left").removeprefix("Right"))]
        part = (
            parts[target.removeprefix(side)]
            if side
            else {"Hips": "hips", "Neck1": "neck", "Head": "head"}[target]
        )
        template[target] = strange[part].replace("*", side)
    (tmp_path / "names.yaml").write_text("".join(f"{target}: {name}\n" for target, name in template.items()))
    done = convert_file(
        tmp_path / "strange.bvh",
        tmp_path / "out",
        options=ConvertOptions(mapping=str(tmp_path / "names.yaml")),
    )
    assert done.report["spine"] == strange["spine"].split()
    assert bones_apart(source, retarget(source, mapping=template), rig)["LeftShin"] < SAME_DEGREES
    (tmp_path / "names.json").write_text(json.dumps(template | {"LeftLeg": "nobody"}))
    with pytest.raises(InputError, match="mapping: nobody"):
        convert_file(
            tmp_path / "strange.bvh",
            tmp_path / "out",
            options=ConvertOptions(mapping=str(tmp_path / "names.json")),
        )


def test_what_is_not_carried_over_is_listed(tmp_path):
    names, parents, rest = biped(LAFAN)
    source = moved((*names, "Tail"), np.append(parents, 0), np.vstack([rest, [0, 0.8, -0.2]]), seed=9)
    write_bvh(source, tmp_path / "a.bvh")
    report = convert_file(tmp_path / "a.bvh", tmp_path / "out").report
    assert report["not_carried"] == ["Tail"]
    assert "LeftHandIndex2" in report["at_rest"]
    assert report["joints"]["LeftShin"] == "LeftLeg"


@pytest.mark.parametrize("rest", ["t_pose", "bind"])
def test_our_own_files_come_back_as_they_were(rest, rig, tmp_path):
    source = retarget(mixamo_like()).motion
    write_bvh(source, tmp_path / "a.bvh", rig=rig, rest=rest)
    found = convert_file(tmp_path / "a.bvh", tmp_path / "out").motion()
    assert np.abs(found.rotations - source.rotations).max() < 1e-5
    assert np.abs(found.translation - source.translation).max() < 1e-6


@pytest.mark.parametrize(("option", "value"), [("mapping", "x.json"), ("root", "Hips"), ("match", "limbs")])
def test_settings_of_skeletons_are_refused_elsewhere(option, value, tmp_path):
    turns = np.tile(np.eye(3), (2, 77, 1, 1))
    np.savez(tmp_path / "a.npz", local_rot_mats=turns, root_positions=np.zeros((2, 3)))
    with pytest.raises(InputError, match=f"{option}: got {value}"):
        convert_file(tmp_path / "a.npz", tmp_path / "out", options=ConvertOptions(**{option: value}))


@pytest.mark.parametrize("name", ["body.glb", "body.usdc"])
def test_skinned_files_of_this_project_come_back_by_their_joints(name, tmp_path):
    """Rotations to 1e-5; float32 in the files leaves 1e-7."""
    layer = SomaLayer("soma", lod="low")
    motion = load_clip(frames=FrameRange(start=30, stop=210, step=60))
    write_body(tmp_path / name, layer, layer.identity(), motion)
    found = retarget(read_skeleton(tmp_path / name)).motion
    np.testing.assert_allclose(found.rotations, motion.rotations, atol=1e-5)
    np.testing.assert_allclose(found.translation, motion.translation, atol=1e-5)


@pytest.mark.parametrize("make", [mixamo_like, lafan_like, xsens_like], ids=["mixamo", "lafan", "xsens"])
def test_hands_and_feet_come_to_where_they_are_there(make, rig):
    """Within reach they are there to rounding; elsewhere the limb is stretched towards it."""
    source = make()
    found = retarget(source, match="soles")
    refined_one = refined(found)
    before, after = (soma_skeleton(each.motion, rig) for each in (found, refined_one))
    turns = [each.turns() for each in (before, after)]
    places = [each.positions() for each in (before, after)]
    goals = found.source.positions() * found.report["path_scale"]
    for name, (apart, left) in refined_one.report["refined_mm"].items():
        index = USER_JOINTS.index(name)
        goal = goals[:, found.source.names.index(found.report["joints"][name])]
        missed = np.linalg.norm(places[1][:, index] - goal, axis=-1)
        first = USER_JOINTS.index(name.replace("Hand", "Arm").replace("Foot", "Leg"))
        reach = np.linalg.norm(np.diff(places[0][:, [first, first + 1, first + 2]], axis=1), axis=-1).sum(1)
        within = np.linalg.norm(goal - places[0][:, first], axis=-1) < 0.99 * reach
        assert within.mean() > 0.5
        assert missed[within].max() < REACHED, name
        assert left < apart
        np.testing.assert_allclose(turns[1][:, index], turns[0][:, index], atol=1e-5)
    for name in ("Hips", "Chest", "Head", "LeftShoulder"):
        index = USER_JOINTS.index(name)
        np.testing.assert_allclose(turns[1][:, index], turns[0][:, index], atol=1e-5)


DIALECTS = {  # hips; thigh shin foot toe; neck head; collar arm forearm hand, * for the side
    "Mixamo": "mixamorig:Hips; *UpLeg *Leg *Foot *ToeBase; Neck Head; *Shoulder *Arm *ForeArm *Hand; "
    "mixamorig:Left mixamorig:Right",
    "Mixamo in Blender": "mixamorig12_Hips; *UpLeg *Leg *Foot *ToeBase; Neck Head; *Shoulder *Arm *ForeArm "
    "*Hand; mixamorig12_Left mixamorig12_Right",
    "CMU's ASF": "root; *femur *tibia *foot *toes; lowerneck head; *clavicle *humerus *radius *wrist; l r",
    "Poser": "hip; *Thigh *Shin *Foot -; neck head; *Collar *Shldr *ForeArm *Hand; l r",
    "Daz": "hip; *ThighBend *Shin *Foot *Toe; neckLower head; *Collar *ShldrBend *ForearmBend *Hand; l r",
    "Second Life": "mPelvis; mHip* mKnee* mAnkle* mToe*; mNeck mHead; mCollar* mShoulder* mElbow* mWrist*; "
    "Left Right",
    "Perception Neuron": "Robot_Hips; *UpLeg *Leg *Foot -; Robot_Neck Robot_Head; *Shoulder *Arm *ForeArm "
    "*Hand; Robot_Left Robot_Right",
    "OptiTrack": "Hip; *Thigh *Shin *Foot *Toe; Neck Head; *Shoulder *UArm *FArm *Hand; L R",
    "3ds Max": "Bip01 Pelvis; * Thigh,* Calf,* Foot,* Toe0; Bip01 Neck,Bip01 Head; * Clavicle,* UpperArm,"
    "* Forearm,* Hand; Bip01 L,Bip01 R",
    "Talking With Hands": "b_root; b_*_upleg b_*_leg b_*_foot b_*_toe; b_neck0 b_head; b_*_shoulder b_*_arm "
    "b_*_forearm b_*_wrist; l r",
    "Rigify": "spine; thigh.* shin.* foot.* toe.*; spine.004 spine.006; shoulder.* upper_arm.* forearm.* "
    "hand.*; L R",
    "VRoid": "J_Bip_C_Hips; J_Bip_*_UpperLeg J_Bip_*_LowerLeg J_Bip_*_Foot J_Bip_*_ToeBase; J_Bip_C_Neck "
    "J_Bip_C_Head; J_Bip_*_Shoulder J_Bip_*_UpperArm J_Bip_*_LowerArm J_Bip_*_Hand; L R",
    "Kinect": "SpineBase; Hip* Knee* Ankle* Foot*; Neck Head; - Shoulder* Elbow* Wrist*; Left Right",
    "Azure Kinect": "PELVIS; HIP_* KNEE_* ANKLE_* FOOT_*; NECK HEAD; CLAVICLE_* SHOULDER_* ELBOW_* WRIST_*; "
    "LEFT RIGHT",
    "Isaac": "Pelvis; *_Hip *_Knee *_Ankle *_Toe; Neck Head; *_Thorax *_Shoulder *_Elbow *_Wrist; L R",
    "SMPL's FBX": "m_avg_Pelvis; *_Hip *_Knee *_Ankle *_Foot; m_avg_Neck m_avg_Head; *_Collar *_Shoulder "
    "*_Elbow *_Wrist; m_avg_L m_avg_R",
    "Maya": "hips_jnt; *_upLeg_jnt *_leg_jnt *_foot_jnt *_toe_jnt; neck_jnt head_jnt; *_shoulder_jnt "
    "*_arm_jnt *_forearm_jnt *_hand_jnt; l r",
    "mocopi": "root; *_up_leg *_low_leg *_foot *_toes; neck_1 head; *_shoulder *_up_arm *_low_arm "
    "*_hand; l r",
    "Rokoko": "Hips; *Thigh *Shin *Foot *Toe; Neck Head; *Shoulder *Arm *ForeArm *Hand; Left Right",
    "MMD": "センター; *足 *ひざ *足首 *つま先; 首 頭; *肩 *腕 *ひじ *手首; 左 右",
    "no name of its own": "body; *UpLeg *Leg *Foot *Toe; Neck Head; *Shoulder *Arm *ForeArm *Hand; "
    "Left Right",
}  # fmt: skip
LIMBS = ("Leg", "Shin", "Foot", "ToeBase"), ("Shoulder", "Arm", "ForeArm", "Hand")


@pytest.mark.parametrize("tool", DIALECTS)
def test_names_of_tools_are_known(tool):
    hips, legs, trunk, arms, sides = (
        part.strip().split("," if "," in part else " ") for part in DIALECTS[tool].split(";")
    )
    names, parents, meant = [], [], {}

    def chain(above, targets, found):
        for target, name in zip(targets, found, strict=True):
            if name == "-":
                continue
            meant[target] = len(names)
            names.append(name)
            parents.append(above)
            above = len(names) - 1
            if target.endswith("Hand"):  # with the tips that Mixamo has, which look like a fourth phalanx
                stem = name.replace("Wrist", "Hand")
                fingers = [f"{target}Index{number}" for number in (2, 3, 4, "tip")]
                chain(above, fingers, [f"{stem}Index{number}" for number in (1, 2, 3, 4)])
        return above

    chain(-1, ["Hips"], [" ".join(hips)])
    for side, spelled in zip(("Left", "Right"), sides, strict=True):
        chain(0, [side + part for part in LIMBS[0]], [name.replace("*", spelled) for name in legs])
    neck = chain(0, ["Neck1", "Head"], trunk)
    for side, spelled in zip(("Left", "Right"), sides, strict=True):
        chain(
            parents[neck], [side + part for part in LIMBS[1]], [name.replace("*", spelled) for name in arms]
        )
    found = match_joints(names, np.array(parents))
    body = {target: names[joint] for target, joint in meant.items() if "Index" not in target}
    if tool == "Rigify":
        del body["Neck1"]  # its spine goes on to the head
    assert {target: names[joint] for target, joint in found.items() if "Index" not in target} == body
    if tool == "Mixamo":
        assert found == {target: joint for target, joint in meant.items() if "tip" not in target}


def test_main_joints_of_unknown_names_are_asked_for(caplog):
    names, parents, _ = biped(LAFAN)
    strange = tuple(name.replace("RightForeArm", "Unter") for name in names)
    found = match_joints(strange, parents, source="walk.bvh")
    assert "RightForeArm" not in found
    assert "walk.bvh: no joint is known as RightForeArm" in caplog.text
    assert "one of Unter, pass mapping=FILE" in caplog.text
    assert len(caplog.records) == 1
