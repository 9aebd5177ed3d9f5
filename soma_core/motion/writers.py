"""What a motion on a body can be written as: one table, for ``soma convert`` and ``soma animate``.

A row's function is imported when it is used: options and help texts cost no torch.
"""

from __future__ import annotations

import importlib
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from soma_core.choices import Product, Upward
from soma_core.errors import InputError
from soma_core.options import BvhChoice, Options, VideoChoice

__all__ = ["MESH_WRITERS", "WRITERS", "WriteOptions", "Writer", "listed_writers"]


@dataclass(frozen=True, kw_only=True)
class Writer:
    """One row of the table.

    Attributes:
        file: what it is called in a folder of its own; without a suffix it is a folder of files.
        needs: of the motion: itself, its rotations on the body's bones, its joints, those before a camera,
            vertices, mesh and skeleton, pictures, or a video.
        function: ``module:name`` of what writes it; takes the path, and what is needed.
        summary: for people.
        settings: fields of ``WriteOptions`` that it takes.
    """

    file: str
    needs: Literal["motion", "rotations", "joints", "view", "vertices", "body", "pictures", "video"]
    function: str
    summary: str
    settings: tuple[str, ...] = field(default=())

    def write(self, path: Path, *what: Any) -> None:
        """Write what is needed to a path."""
        module, _, name = self.function.partition(":")
        getattr(importlib.import_module(module), name)(path, *what)


_IO, _UP, _SHAPES = "soma_core.io", ("write_up",), ("blend_shapes",)

WRITERS: dict[Product, Writer] = {
    Product.npz: Writer(
        file="motion.npz", needs="motion", function="soma_core.motion.products:write_motion_npz",
        summary="the motion in this project's schema, which the SOMA tools read",
    ),
    Product.bvh: Writer(
        file="motion.bvh", needs="rotations", function="soma_core.motion.products:write_bvh_file",
        summary="the skeleton of the body and its Euler angles", settings=("bvh",),
    ),
    Product.joints: Writer(
        file="joints.npz", needs="joints", function=f"{_IO}.joint_files:write_joints_npz",
        summary="names, world positions [m] and rotations (quaternions wxyz) of joints",
        settings=("joints", *_UP),
    ),
    Product.csv: Writer(
        file="joints.csv", needs="joints", function=f"{_IO}.joint_files:write_joints_csv",
        summary="the same as a table, one row a frame", settings=("joints", *_UP),
    ),
    Product.keypoints: Writer(
        file="keypoints.npz", needs="view", function=f"{_IO}.joint_files:write_keypoints",
        summary="joints as pixels of a camera, camera=FILE.json", settings=("joints", "camera"),
    ),
    Product.vertices: Writer(
        file="vertices.npz", needs="vertices", function=f"{_IO}.vertex_writers:write_vertex_npz",
        summary="vertices of every frame, which soma invert reads", settings=_UP,
    ),
    Product.obj: Writer(
        file="obj", needs="vertices", function=f"{_IO}.vertex_writers:write_obj_folder",
        summary="a folder with an OBJ a frame", settings=_UP,
    ),
    Product.ply: Writer(
        file="ply", needs="vertices", function=f"{_IO}.vertex_writers:write_ply_folder",
        summary="a folder with a PLY a frame", settings=_UP,
    ),
    Product.pc2: Writer(
        file="vertices.pc2", needs="vertices", function=f"{_IO}.vertex_writers:write_pc2",
        summary="a PC2 point cache, and the mesh that it moves as an OBJ", settings=_UP,
    ),
    Product.mdd: Writer(
        file="vertices.mdd", needs="vertices", function=f"{_IO}.vertex_writers:write_mdd",
        summary="an MDD point cache, and the mesh that it moves as an OBJ", settings=_UP,
    ),
    Product.usdpoints: Writer(
        file="vertices.usdc", needs="vertices", function=f"{_IO}.usd:write_usd_points",
        summary="a USD mesh with points at each time", settings=_UP,
    ),
    Product.usd: Writer(
        file="body.usdc", needs="body", function=f"{_IO}.usd:write_usd",
        summary="UsdSkel: mesh, skeleton, skin and animation", settings=_SHAPES,
    ),
    Product.glb: Writer(
        file="body.glb", needs="body", function=f"{_IO}.gltf:write_gltf", summary="glTF: the same",
        settings=_SHAPES,
    ),
    Product.html: Writer(
        file="body.html", needs="body", function="soma_core.view.page:write_page",
        summary="a page that plays the body in a browser, with no server and no network", settings=_SHAPES,
    ),
    Product.png: Writer(
        file="contact_sheet.png", needs="pictures", function="soma_core.motion.products:draw_contact_sheet",
        summary="frames of the clip",
    ),
    Product.mp4: Writer(
        file="body.mp4", needs="video", function="soma_core.motion.products:draw_video",
        summary="a video of the clip, of a single pose a turntable", settings=("video",),
    ),
    Product.gif: Writer(
        file="body.gif", needs="video", function="soma_core.motion.products:draw_video",
        summary="the same for pages that take no video", settings=("video",),
    ),
}  # fmt: skip
"""Every product, in the order in which they are written."""

MESH_WRITERS = tuple(product for product, writer in WRITERS.items() if writer.needs == "vertices")
"""Those that take any mesh, this project's or another model's."""


def listed_writers() -> str:
    """The table for a help text, a line each."""
    width = max(map(len, WRITERS)) + 2
    return "\n".join(
        f"  {product:<{width}}{writer.file}: {writer.summary}" for product, writer in WRITERS.items()
    )


@dataclass(kw_only=True)
class WriteOptions(Options):
    """How some of the products are written.

    Attributes:
        blend_shapes: whether skinned files hold the pose correctives; finding shapes for them takes seconds.
        joints: names of the joints that are written, in this order; None: all.
        camera: JSON file of the camera that sees keypoints; see ``soma_core.io.camera``. With `points` also
            that in whose picture these are.
        write_up: upward axis of the world of joints and vertices; None: y.
        bvh: of that format.
        video: of MP4 and GIF.
    """

    blend_shapes: bool = True
    joints: list[str] | None = None
    camera: str | None = None
    write_up: Upward | None = None
    bvh: BvhChoice = field(default_factory=BvhChoice)
    video: VideoChoice = field(default_factory=VideoChoice)

    def given(self) -> dict[str, str]:
        """The settings that are not as usual, as text."""
        usual, found = WriteOptions.__dataclass_fields__, {}
        for name in usual:
            value = getattr(self, name)
            if isinstance(value, bool):
                value = None if value else "false"
            if isinstance(value, Options):
                plain = vars(type(value)())
                changed = {key: str(each) for key, each in vars(value).items() if each != plain[key]}
                value = ", ".join(f"{key}={each}" for key, each in changed.items()) or None
            if value is not None:
                found[name] = str(value)
        return found

    def refuse_unused(self, products: Iterable[Product], used: Collection[str] = ()) -> None:
        """Refuse settings that nothing among `products` takes, and products whose settings are missing.

        Those `used` by something else are left alone.

        Raises:
            InputError: the first one, with the products that would take it.
        """
        products = list(products)
        for name, value in self.given().items():
            takers = [key for key, row in WRITERS.items() if name in row.settings]
            if set(takers) & set(products) or name in used:
                continue
            raise InputError(
                name, got=value, expected=f"none with write=[{','.join(products)}]",
                fix=f"Leave {name} out, or write one of {', '.join(takers)}.",
            )  # fmt: skip
        if Product.keypoints in products and self.camera is None:
            raise InputError(
                "camera", got="none", expected="the camera that sees the keypoints",
                fix="Pass camera=FILE.json with fx, fy, cx, cy and extrinsics.",
            )  # fmt: skip
