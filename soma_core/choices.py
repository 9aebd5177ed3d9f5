"""Closed sets of values that a user can choose from."""

from __future__ import annotations

from enum import StrEnum

__all__ = [
    "AngleUnit",
    "Axes",
    "BetasFrom",
    "BodyGender",
    "BoneMatch",
    "BvhRest",
    "Carry",
    "Contacts",
    "ConvertResult",
    "Coordinates",
    "DatasetOutput",
    "Engine",
    "EulerOrder",
    "FitLod",
    "Gallery",
    "Gaps",
    "Ground",
    "IdentityMethod",
    "IdentitySource",
    "Kernels",
    "LengthUnit",
    "Lod",
    "ModelFile",
    "ModelPart",
    "Product",
    "Refine",
    "RotationLayout",
    "RotationZero",
    "Skinning",
    "Smooth",
    "SmplLayout",
    "SmplModel",
    "Topology",
    "Translation",
    "Upward",
]


class BetasFrom(StrEnum):
    """How one body is made of shapes for each frame."""

    mean = "mean"
    median = "median"
    first = "first"


class BodyGender(StrEnum):
    """Which of a user's SMPL models a motion is posed with."""

    neutral = "neutral"
    male = "male"
    female = "female"


class Skinning(StrEnum):
    """What a fit poses by: the full model, plain skinning, or whichever describes a frame."""

    auto = "auto"
    full = "full"
    plain = "plain"


class SmplLayout(StrEnum):
    """Names of the keys that pose parameters of SMPL models are written under."""

    amass = "amass"
    smplx = "smplx"


class Contacts(StrEnum):
    """What becomes of feet in contact with the ground: they go with the legs, or stay where they stand."""

    free = "free"
    lock = "lock"


class BoneMatch(StrEnum):
    """Which bones of another skeleton are matched by direction; the others keep their turn since rest.

    ``soles`` matches all but the slope of feet.
    """

    bones = "bones"
    soles = "soles"
    limbs = "limbs"


class Refine(StrEnum):
    """What is fitted after the joints of another skeleton were carried over."""

    joints = "joints"


class Carry(StrEnum):
    """How a motion of a model comes over: its body is fitted, or its joints are carried."""

    fit = "fit"
    skeleton = "skeleton"


class ConvertResult(StrEnum):
    """What the way back gives: pose parameters of the model, or vertices."""

    poses = "poses"
    vertices = "vertices"


class Coordinates(StrEnum):
    """Which of a file's motions of one person is taken."""

    world = "world"
    camera = "camera"


class FitLod(StrEnum):
    """Level of detail that poses are fitted on."""

    mid = "mid"
    low = "low"


class Gallery(StrEnum):
    """Which identities are animated."""

    one = "one"
    all = "all"


class Ground(StrEnum):
    """What lies on the floor: soles in contact, the lowest vertex of the clip, or nothing that is sought."""

    contacts = "contacts"
    lowest = "lowest"
    none = "none"


class Gaps(StrEnum):
    """What becomes of frames that a file lacks."""

    interpolate = "interpolate"
    drop = "drop"


class IdentityMethod(StrEnum):
    """How the identity of a fit is found, if it is not known."""

    known = "known"
    backend = "backend"
    unpose = "unpose"


class IdentitySource(StrEnum):
    """Which identity is animated."""

    backend = "backend"
    motion = "motion"


class Kernels(StrEnum):
    """Which version of the hot path runs."""

    auto = "auto"
    torch = "torch"
    warp = "warp"


class LengthUnit(StrEnum):
    """Unit of a file's lengths."""

    m = "m"
    cm = "cm"
    mm = "mm"
    inch = "inch"
    ft = "ft"


class Lod(StrEnum):
    """Level of detail of the canonical mesh."""

    mid = "mid"
    low = "low"
    xlo = "xlo"


class ModelFile(StrEnum):
    """What ``soma export-model`` writes: a file for ONNX runtimes, or one for ``torch.export.load``."""

    onnx = "onnx"
    pt2 = "pt2"


class ModelPart(StrEnum):
    """What a model without this package computes: poses of one body, of any body, or joints alone."""

    pose = "pose"
    full = "full"
    joints = "joints"


class Product(StrEnum):
    """A file that a run can write; ``soma_core.motion.writers`` has the table of them."""

    npz = "npz"
    usd = "usd"
    glb = "glb"
    html = "html"
    png = "png"
    mp4 = "mp4"
    gif = "gif"
    bvh = "bvh"
    joints = "joints"
    csv = "csv"
    keypoints = "keypoints"
    vertices = "vertices"
    obj = "obj"
    ply = "ply"
    pc2 = "pc2"
    mdd = "mdd"
    usdpoints = "usdpoints"


class RotationLayout(StrEnum):
    """Order of quaternions; whether 6D rotations and matrices are stored row by row or column by column."""

    wxyz = "wxyz"
    xyzw = "xyzw"
    rows = "rows"
    columns = "columns"


class Smooth(StrEnum):
    """How much a motion is smoothed."""

    off = "off"
    light = "light"
    strong = "strong"


class SmplModel(StrEnum):
    """Models of the SMPL family."""

    smpl = "smpl"
    smplh = "smplh"
    smplx = "smplx"


class Topology(StrEnum):
    """Which mesh vertices belong to."""

    auto = "auto"
    canonical = "canonical"
    native = "native"


class Translation(StrEnum):
    """Where the body stands."""

    ground = "ground"
    motion = "motion"
    none = "none"


Upward = StrEnum("Upward", {"y": "y", "z": "z", "-y": "-y", "-z": "-z", "+y": "y", "+z": "z"})
"""Upward axis of a file's world; ``+y`` is another name of ``y``."""


class Axes(StrEnum):
    """Axes of a file's world by name: a camera's have y down, and z forward, away from it."""

    camera = "camera"


class RotationZero(StrEnum):
    """What the rotations of a file on this skeleton are relative to."""

    t_pose_relative = "t_pose_relative"
    absolute_local = "absolute_local"


class AngleUnit(StrEnum):
    """Unit of a file's rotation vectors."""

    rad = "rad"
    deg = "deg"


class BvhRest(StrEnum):
    """The pose at which the angles of a BVH are zero."""

    t_pose = "t_pose"
    bind = "bind"


class EulerOrder(StrEnum):
    """Order of the rotation channels of a BVH; the first is applied last."""

    XYZ = "XYZ"
    XZY = "XZY"
    YXZ = "YXZ"
    YZX = "YZX"
    ZXY = "ZXY"
    ZYX = "ZYX"


class Engine(StrEnum):
    """What spreads the files of a conversion: processes of this machine, or Ray's actors on any number."""

    local = "local"
    ray = "ray"


class DatasetOutput(StrEnum):
    """How the converted motions of a folder are kept: a file each, or rows of Parquet shards."""

    folder = "folder"
    parquet = "parquet"
