"""What a motion on a body can be written as: one table, for ``soma convert`` and ``soma animate``.

A row's function is imported when it is used: options and help texts cost no torch.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from soma_core.errors import InputError
from soma_core.options import BvhChoice, Options, Picture, Product, Upward

if TYPE_CHECKING:
    from soma_core.io.motion import Motion
    from soma_core.motion.played import Played

__all__ = ["MESH_WRITERS", "WRITERS", "WriteOptions", "Writer", "listed_writers", "write_products"]


@dataclass(frozen=True, kw_only=True)
class Writer:
    """One row of the table.

    Attributes:
        file: what it is called in a folder of its own; without a suffix it is a folder of files.
        needs: of the motion: itself, its rotations on the body's bones, its joints, those before a camera, vertices, mesh and skeleton, or
            pictures.
        function: ``module:name`` of what writes it; takes the path, and what is needed.
        summary: for people.
        settings: fields of ``WriteOptions`` that it takes.
    """

    file: str
    needs: Literal["motion", "rotations", "joints", "view", "vertices", "body", "pictures"]
    function: str
    summary: str
    settings: tuple[str, ...] = field(default=())

    def write(self, path: Path, *what: Any) -> None:
        """Write what is needed to a path."""
        module, _, name = self.function.partition(":")
        getattr(importlib.import_module(module), name)(path, *what)


_IO, _UP = "soma_core.io", ("write_up",)

WRITERS: dict[Product, Writer] = {
    Product.npz: Writer(
        file="motion.npz", needs="motion", function=f"{__name__}:write_motion_npz",
        summary="the motion in this project's schema, which the SOMA tools read",
    ),
    Product.bvh: Writer(
        file="motion.bvh", needs="rotations", function=f"{__name__}:write_bvh_file",
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
        summary="UsdSkel: mesh, skeleton, skin and animation",
    ),
    Product.glb: Writer(
        file="body.glb", needs="body", function=f"{_IO}.gltf:write_gltf", summary="glTF: the same",
    ),
    Product.png: Writer(
        file="contact_sheet.png", needs="pictures", function=f"{__name__}:draw_contact_sheet",
        summary="frames of the clip",
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
        joints: names of the joints that are written, in this order; None: all.
        camera: JSON file of the camera that sees keypoints; see ``soma_core.io.camera``.
        write_up: upward axis of the world of joints and vertices; None: y.
        bvh: of that format.
    """

    joints: list[str] | None = None
    camera: str | None = None
    write_up: Upward | None = None
    bvh: BvhChoice = field(default_factory=BvhChoice)

    def given(self) -> dict[str, str]:
        """The settings that are not as usual, as text."""
        usual, found = WriteOptions.__dataclass_fields__, {}
        for name in usual:
            value = getattr(self, name)
            if isinstance(value, BvhChoice):
                changed = {key: str(each) for key, each in vars(value).items() if each != vars(BvhChoice())[key]}
                value = ", ".join(f"{key}={each}" for key, each in changed.items()) or None
            if value is not None:
                found[name] = str(value)
        return found

    def refuse_unused(self, products: Iterable[Product]) -> None:
        """Refuse settings that nothing among `products` takes, and products whose settings are missing.

        Raises:
            InputError: the first one, with the products that would take it.
        """
        products = list(products)
        for name, value in self.given().items():
            takers = [key for key, row in WRITERS.items() if name in row.settings]
            if set(takers) & set(products):
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


def write_products(
    played: Played,
    products: Iterable[Product],
    place: Callable[[Product], Path],
    *,
    options: WriteOptions | None = None,
    picture: Picture | None = None,
) -> dict[str, Path]:
    """Write a motion on its body as some products, each atomically and in bounded memory.

    Args:
        played: the motion on its body.
        products: which, of `WRITERS`.
        place: where each goes.
        options: how.
        picture: of the contact sheet.

    Returns:
        Name of each product and where it was written.

    Raises:
        InputError: a joint that is none, or a camera that is none.
    """
    options, wanted, written = options or WriteOptions(), set(products), {}
    turned = replace(played, up=f"+{options.write_up or 'y'}")
    made: dict[str, tuple[Any, ...]] = {}
    for product, writer in WRITERS.items():
        if product not in wanted:
            continue
        if writer.needs not in made:
            made[writer.needs] = _NEEDED[writer.needs](played, turned, options, picture or Picture())
        writer.write(place(product), *made[writer.needs])
        written[str(product)] = place(product)
    return written


def _view(played: Played, turned: Played, options: WriteOptions, picture: Picture) -> tuple[Any, ...]:  # noqa: ARG001
    """Joints and the camera that sees them; its world is +Y up."""
    from soma_core.io.camera import read_camera

    return played.joints(options.joints), read_camera(str(options.camera))


_NEEDED: Mapping[str, Callable[..., tuple[Any, ...]]] = {
    "motion": lambda played, *_: (played.motion,),
    "rotations": lambda played, _, options, __: (played, options.bvh),
    "joints": lambda _, turned, options, picture: (turned.joints(options.joints),),  # noqa: ARG005
    "view": _view,
    "vertices": lambda _, turned, *__: (turned.meshes(),),
    "body": lambda played, *_: (played.clip(_metadata(played)),),
    "pictures": lambda played, _, __, picture: (played, picture),
}
"""What each kind of writer takes after the path."""


def write_motion_npz(path: Path, motion: Motion) -> None:
    """Write a motion in this project's schema."""
    from soma_core.motion.files import write

    write(motion, path)


def write_bvh_file(path: Path, played: Played, choice: BvhChoice) -> None:
    """Write the motion on the body's own bones as BVH."""
    from soma_core.io.bvh import write_bvh

    bind = played.identity.bind_world[0].detach().cpu().double().numpy()
    write_bvh(
        played.motion, path, rig=played.layer.rig, bind_world=bind, joints=choice.joints,
        order=str(choice.order), rest=str(choice.rest), unit=str(choice.unit),
    )  # fmt: skip


def draw_contact_sheet(path: Path, played: Played, picture: Picture) -> None:
    """Draw frames of a motion, the middles of equal parts of it: both its ends are often the same pose."""
    import numpy as np

    from soma_core.view.picture import backend_colour, contact_sheet
    from soma_core.view.stage import Body

    count, total = picture.frames, played.motion.frame_count
    layer, bodies = played.layer, []
    for frame in np.unique((np.arange(count) + 0.5) * total / count).astype(int).tolist():
        vertices = played.posed(slice(frame, frame + 1))[0].cpu().numpy()
        bodies.append(
            Body(
                vertices=vertices, triangles=layer.mesh.triangles, colour=backend_colour(layer.backend),
                caption=f"{frame / played.motion.fps:.2f} s",
            )  # fmt: skip
        )
    contact_sheet(path, bodies, width=picture.width)


def _metadata(played: Played) -> dict[str, str]:
    """Texts that travel with the exported body."""
    layer, motion = played.layer, played.motion
    return {
        "backend": layer.backend,
        "licence": layer.spec.licence,
        "identity": json.dumps(motion.identity.get("params", {}), sort_keys=True, default=float),
        "rig_revision": layer.rig.revision,
        "motion": motion.source,
        "motion_licence": motion.licence,
    }
