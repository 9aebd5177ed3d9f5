"""The three models: sizes, joints, and what their files are called."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FAMILIES", "GENDERS", "SMPL", "SMPLH", "SMPLX", "Family"]

GENDERS = ("neutral", "male", "female")

_BODY = (
    ("pelvis", -1), ("left_hip", 0), ("right_hip", 0), ("spine1", 0), ("left_knee", 1), ("right_knee", 2),
    ("spine2", 3), ("left_ankle", 4), ("right_ankle", 5), ("spine3", 6), ("left_foot", 7), ("right_foot", 8),
    ("neck", 9), ("left_collar", 9), ("right_collar", 9), ("head", 12), ("left_shoulder", 13),
    ("right_shoulder", 14), ("left_elbow", 16), ("right_elbow", 17), ("left_wrist", 18), ("right_wrist", 19),
)  # fmt: skip
_FACE = (("jaw", 15), ("left_eye_smplhf", 15), ("right_eye_smplhf", 15))
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")


def _hands(first: int) -> tuple[tuple[str, int], ...]:
    """Fifteen joints of each hand, the left one's from index `first` on."""
    joints: list[tuple[str, int]] = []
    for side, wrist in (("left", 20), ("right", 21)):
        for finger in _FINGERS:
            for knuckle in range(3):
                parent = wrist if knuckle == 0 else first + len(joints) - 1
                joints.append((f"{side}_{finger}{knuckle + 1}", parent))
    return tuple(joints)


@dataclass(frozen=True, kw_only=True)
class Family:
    """One of the models.

    Attributes:
        name: name of the backend.
        title: how its makers write it.
        vertex_count, face_count: size of its mesh.
        joints: (name, index of the parent) of each joint, the pelvis first.
        folder: folder of its files; `wrap_folder` that of the wrap pair.
        pattern: regular expression of the names of its files, suffix apart, with a group for the gender.
        url: where registered users get it.
        expressions: how many shape directions of a file are expressions, by the width of the file.
    """

    name: str
    title: str
    vertex_count: int
    face_count: int
    joints: tuple[tuple[str, int], ...]
    folder: str
    wrap_folder: str
    pattern: str
    url: str
    expressions: dict[int, int] | None = None

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(name for name, _ in self.joints)

    @property
    def parents(self) -> tuple[int, ...]:
        """Index of the parent of each joint, -1 for the pelvis."""
        return tuple(parent for _, parent in self.joints)

    @property
    def joint_count(self) -> int:
        """Number of joints."""
        return len(self.joints)

    def split(self, width: int) -> tuple[int, int] | None:
        """How many of `width` shape directions are shapes and how many expressions; None: no such file."""
        if self.expressions is None:
            return (width, 0) if 1 <= width <= 300 else None
        count = self.expressions.get(width)
        return None if count is None else (width - count, count)


SMPL = Family(
    name="smpl",
    title="SMPL",
    vertex_count=6890,
    face_count=13776,
    joints=(*_BODY, ("left_hand", 20), ("right_hand", 21)),
    folder="SMPL",
    wrap_folder="SMPL",
    pattern=r"smpl_(neutral|male|female)|basicmodel_(neutral|m|f)_lbs_10_207_0_v1\.[01]\.0",
    url="https://smpl.is.tue.mpg.de",
)
SMPLH = Family(
    name="smplh",
    title="SMPL-H",
    vertex_count=6890,
    face_count=13776,
    joints=(*_BODY, *_hands(22)),
    folder="SMPLH",
    wrap_folder="SMPL",  # the same mesh
    pattern=r"smplh_(neutral|male|female)",
    url="https://mano.is.tue.mpg.de",
)
SMPLX = Family(
    name="smplx",
    title="SMPL-X",
    vertex_count=10475,
    face_count=20908,
    joints=(*_BODY, *_FACE, *_hands(25)),
    folder="SMPLX",
    wrap_folder="SMPLX",
    pattern=r"smplx_(neutral|male|female)(?:_2020)?",
    url="https://smpl-x.is.tue.mpg.de",
    expressions={400: 100, 20: 10},
)
FAMILIES = (SMPL, SMPLH, SMPLX)
