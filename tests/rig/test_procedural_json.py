"""The procedural definition: what the shipped file says, and how a wrong one is refused."""

import copy
import json
from pathlib import Path

import pytest

from assets.make.twist_template import procedural_document
from soma_core.errors import AssetError
from soma_core.paths import assets_dir
from soma_core.rig import load_canonical
from soma_core.rig.manifest import PROCEDURAL_NAME
from soma_core.rig.procedural import MODES
from soma_core.rig.procedural_json import parse_procedural, read_procedural

SHARES = (0.05, 0.3333333, 0.6666667, 0.95)
FLOAT32 = 1e-6
ALIGNED, SWING, EULER = "aligned_x_swing_twist", "local_x_swing_twist", "local_x_euler"


@pytest.fixture(scope="module")
def names():
    return load_canonical("low")[1].joint_names


@pytest.fixture
def document(names):
    return procedural_document(names)


def changed(document, path, value):
    """A copy with one field replaced; `path` as in the errors. None removes the field."""
    copied = copy.deepcopy(document)
    at = copied
    keys = [int(key) if key.isdigit() else key for key in path.replace("]", "").replace("[", ".").split(".")]
    for key in keys[:-1]:
        at = at[key]
    if value is None:
        del at[keys[-1]]
    else:
        at[keys[-1]] = value
    return copied


def test_the_shipped_file_is_what_the_builder_writes(names):
    path = assets_dir() / PROCEDURAL_NAME
    assert json.loads(path.read_text()) == procedural_document(names)
    assert read_procedural(path) == parse_procedural(procedural_document(names), path)


def test_the_shipped_definition(names):
    definition = read_procedural(assets_dir() / PROCEDURAL_NAME)
    assert definition.main_joints == names
    assert len(definition.helpers) == len(set(definition.helpers)) == 32
    assert definition.helpers[:4] == tuple(f"LeftArmTwist{number}" for number in range(1, 5))
    assert set(definition.modes.values()) == {ALIGNED}
    for segment in definition.segments:
        assert segment.reverse == (segment.parent is not None) == segment.start.endswith(("tArm", "Leg"))
        assert (segment.axis, segment.sign) == (0, 1)
        for helper, share in zip(segment.helpers, SHARES, strict=True):
            own = {segment.start: -(1 - share)} if segment.reverse else {}
            assert definition.rotation[helper] == pytest.approx(own | {segment.end: share}, abs=FLOAT32)
            place = {segment.start: 1 - share, segment.end: share}
            assert definition.translation[helper] == pytest.approx(place, abs=FLOAT32)


@pytest.mark.parametrize("policy", [{"default": SWING}, {"default": EULER, "per_procedural_joint": {}}])
def test_a_default_mode_serves_every_helper(document, policy):
    definition = parse_procedural(changed(document, "rotation_extraction", policy), Path("x"))
    assert set(definition.modes.values()) == {policy["default"]}


def test_modes_may_be_mixed(document):
    policy = {"default": ALIGNED, "per_procedural_joint": {"LeftArmTwist1": EULER, "RightLegTwist4": SWING}}
    modes = parse_procedural(changed(document, "rotation_extraction", policy), Path("x")).modes
    assert (modes["LeftArmTwist1"], modes["RightLegTwist4"], modes["LeftArmTwist2"]) == (
        EULER,
        SWING,
        ALIGNED,
    )


def test_a_default_is_not_needed_where_every_helper_has_a_mode(document):
    helpers = [name for segment in document["segments"] for name in segment["twist_joints"]]
    policy = {"per_procedural_joint": dict.fromkeys(helpers, SWING)}
    assert parse_procedural(changed(document, "rotation_extraction", policy), Path("x")).modes[
        "LeftArmTwist1"
    ]


def test_axes_may_be_numbers(document):
    document["segments"] = [
        segment | {"source_axis": 2, "source_sign": -1} for segment in document["segments"]
    ]
    definition = parse_procedural(document, Path("x"))
    assert {(segment.axis, segment.sign) for segment in definition.segments} == {(2, -1)}


@pytest.mark.parametrize("template", [{}, {"file": "a.usda"}])
def test_a_template_may_be_left_unsaid(document, template):
    definition = parse_procedural(document | {"template_asset": template}, Path("x"))
    assert definition.joint_count is None


def test_a_later_minor_version_and_unknown_fields_are_read(document):
    document |= {"schema_version": "1.7.3", "more": {"of": "it"}}
    assert len(parse_procedural(document, Path("x")).segments) == 8


ENTRY = {"row": "LeftArmTwist1", "column": "LeftArm", "value": 1.0}
ROTATION, TRANSLATION = (f"parameter_matrices.{kind}" for kind in ("rotation", "translation"))


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        ("schema_version", "2.0.0", r"schema_version is '2\.0\.0', expected a version 1\.x"),
        ("schema_version", None, r"schema_version is None"),
        ("schema_version", 1, r"schema_version is 1,"),
        ("conventions.linear_unit", "meters", r"conventions\.linear_unit is 'meters', expected one of cm"),
        ("conventions.angular_unit", "degrees", r"conventions\.angular_unit is 'degrees'"),
        ("conventions.quaternion_order", "wxyz", r"conventions\.quaternion_order is 'wxyz'.*xyzw"),
        ("conventions.up_axis", "+Z", r"conventions\.up_axis is '\+Z'"),
        ("conventions.matrix_storage", "column_major", r"conventions\.matrix_storage is 'column_major'"),
        ("modes", [], r"modes is \[\], expected a non-empty array"),
        ("modes", [ALIGNED, ALIGNED], r"modes\[1\] is 'aligned_x_swing_twist', .*repeated"),
        ("modes[1]", "local_y", r"modes\[1\] is 'local_y', expected one of local_x_euler"),
        ("modes", "all", r"modes is 'all', expected a non-empty array"),
        (f"channel_extractors.{SWING}", None, r"channel_extractors is \['aligned_x_swing_"),
        ("channel_extractors.other", {}, r"channel_extractors is .*'other'.*and no other"),
        ("channel_extractors", 3, r"channel_extractors is 3, expected an object"),
        ("rotation_extraction", "local_y", r"rotation_extraction is 'local_y', expected one of modes"),
        ("rotation_extraction", ["x"], r"rotation_extraction is \['x'\], expected an object"),
        ("rotation_extraction", {}, r"rotation_extraction\.default is None, .*LeftArmTwist1 has none"),
        ("rotation_extraction", {"default": "no"}, r"rotation_extraction\.default is 'no'"),
        (
            "rotation_extraction",
            {"default": SWING, "per_procedural_joint": {"Tail": SWING}},
            r"rotation_extraction\.per_procedural_joint\.Tail is 'local_x_swing_twist'.*Tail is not a twist",
        ),
        (
            "rotation_extraction",
            {"default": SWING, "per_procedural_joint": {"LeftArmTwist1": "no"}},
            r"rotation_extraction\.per_procedural_joint\.LeftArmTwist1 is 'no'",
        ),
        ("public_rig_derivation.main_joint_names[3]", "Hips", r"main_joint_names\[3\] is 'Hips', .*repeated"),
        ("public_rig_derivation", None, r"public_rig_derivation is None, expected an object"),
        ("segments", [], r"segments is \[\]"),
        ("segments[3].end_joint", "Tail", r"segments\[3\]\.end_joint is 'Tail'.*main_joint_names"),
        ("segments[3].end_joint", "LeftShin", r"segments\[3\]\.end_joint is 'LeftShin', .*than start_joint"),
        ("segments[0].start_joint", None, r"segments\[0\]\.start_joint is None"),
        ("segments[2].parent_joint", "Tail", r"segments\[2\]\.parent_joint is 'Tail'"),
        ("segments[2].parent_joint", None, r"segments\[2\]\.parent_joint is None, .*LeftLegTwist1 reads"),
        ("segments[1].reverse", "yes", r"segments\[1\]\.reverse is 'yes', expected true or false"),
        ("segments[1].twist_joints[2]", "Hips", r"segments\[1\]\.twist_joints\[2\] is 'Hips', .*neither"),
        ("segments[1].twist_joints[2]", "LeftArmTwist1", r"\[1\]\.twist_joints\[2\] is 'LeftArmTwist1'"),
        ("segments[1].twist_joints", [], r"segments\[1\]\.twist_joints is \[\]"),
        ("segments[4].source_axis", "w", r"segments\[4\]\.source_axis is 'w'"),
        ("segments[4].source_axis", 3, r"segments\[4\]\.source_axis is 3"),
        ("segments[4].source_axis", [0], r"segments\[4\]\.source_axis is \[0\]"),
        ("segments[4].source_sign", 2, r"segments\[4\]\.source_sign is 2, expected 1 or -1"),
        ("segments[1].twist_joints[2]", 7, r"segments\[1\]\.twist_joints\[2\] is 7"),
        ("parameter_matrices", None, r"parameter_matrices is None, expected an object"),
        ("template_asset.joint_count", 109, r"template_asset\.joint_count is 109, .*the 110 joints"),
        ("template_asset.joint_count", "110", r"template_asset\.joint_count is '110'"),
        ("template_asset", "a.usda", r"template_asset is 'a\.usda', expected an object"),
        (f"{ROTATION}.format", "dense", r"rotation\.format is 'dense', expected 'sparse_coo_named'"),
        (f"{ROTATION}.dtype", "int8", r"rotation\.dtype is 'int8', expected 'float32'"),
        (f"{ROTATION}.entries", [], r"rotation\.entries is \[\]"),
        (f"{TRANSLATION}.entries", [], r"translation\.entries is \[\]"),
        (f"{ROTATION}.entries[5].row", "Hips", r"rotation\.entries\[5\]\.row is 'Hips', expected a twist"),
        (f"{ROTATION}.entries[5].column", "Tail", r"rotation\.entries\[5\]\.column is 'Tail'"),
        (f"{ROTATION}.entries[5].column", "LeftArmTwist1", r"entries\[5\]\.column is 'LeftArmTwist1'"),
        (f"{ROTATION}.entries[5].column", "Head", r"\(row LeftArmTwist3, column Head\) is .*the end joint"),
        (f"{ROTATION}.entries[5].value", "1", r"rotation\.entries\[5\]\.value is '1', expected a number"),
        (f"{ROTATION}.entries[5].value", 10**400, r"entries\[5\]\.value is 1000+\.\.\., .*finite"),
        (f"{ROTATION}.entries[5].value", float("nan"), r"rotation\.entries\[5\]\.value is nan, .*finite"),
        (f"{ROTATION}.entries[5]", ENTRY, r"entries\[5\] is \{'row': .*one entry for row LeftArmTwist1"),
        (f"{TRANSLATION}.entries[1].value", 0.5, r"entries \(sum of row LeftArmTwist1\) is 1\.45"),
        (
            f"{TRANSLATION}.entries[1].column",
            "LeftArmTwist1",
            r"translation\.entries is \['LeftArmTwist1'\], .*in a circle",
        ),
    ],
)  # fmt: skip
def test_an_error_names_the_field_its_value_and_what_it_must_be(document, path, value, text):
    with pytest.raises(AssetError, match=rf"^twist\.json: .*{text}"):
        parse_procedural(changed(document, path, value), Path("twist.json"))


def test_one_axis_for_one_source(document):
    """The forearm is the end of one segment; as the start of another, reversed one it must turn alike."""
    document["segments"][1] |= {"reverse": True, "parent_joint": "LeftArm", "source_axis": "y"}
    with pytest.raises(AssetError, match=r"segments\[1\]\.source_axis is 'y'.*gives LeftForeArm"):
        parse_procedural(document, Path("x"))


@pytest.mark.parametrize("content", [[], None, 3, "x"])
def test_something_else_than_an_object_is_refused(content):
    with pytest.raises(AssetError, match=r"document is .*expected an object"):
        parse_procedural(content, Path("x"))


@pytest.mark.parametrize("text", ["{", "", "\udcff"])
def test_a_file_that_is_no_json_is_refused(tmp_path, text):
    path = tmp_path / "twist.json"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(AssetError, match=r"twist\.json: .*(not valid JSON|empty)"):
        read_procedural(path)
    with pytest.raises(AssetError, match=r"none\.json"):
        read_procedural(tmp_path / "none.json")


def test_modes_are_the_documented_ones():
    assert MODES == (EULER, SWING, ALIGNED)
