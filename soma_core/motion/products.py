"""A motion on its body, written as what the table of writers has."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from soma_core.cache import atomic_text
from soma_core.choices import Product
from soma_core.io.bvh import write_bvh
from soma_core.io.camera import Camera, read_camera
from soma_core.io.motion import Motion
from soma_core.io.motion_files import read_motion
from soma_core.layer import SomaLayer
from soma_core.motion.animated import check_playable
from soma_core.motion.files import ResultFiles, fingerprint, write
from soma_core.motion.models import model_settings
from soma_core.motion.options import ConvertOptions
from soma_core.motion.played import MovingBodies, Played, placing_of
from soma_core.motion.writers import WRITERS, WriteOptions
from soma_core.options import BvhChoice, Picture, VideoChoice
from soma_core.skeleton.identity import Identity
from soma_core.view.picture import backend_colour, contact_sheet, with_eyes
from soma_core.view.stage import Body
from soma_core.view.video import write_video

__all__ = [
    "BodyProducts",
    "draw_contact_sheet",
    "draw_video",
    "write_body",
    "write_bvh_file",
    "write_motion_npz",
    "write_products",
]


_RATE, _GIF_RATE = 30.0, 20.0
"""Frames per second of videos, at most where nobody says more."""


class BodyProducts:
    """Writes one converted motion after another as the products that are asked for.

    Args:
        options: of the conversion.

    Raises:
        SomaError: the camera is none.
    """

    def __init__(self, options: ConvertOptions) -> None:
        self._options, self._placing = options, placing_of(options)
        self._own = MovingBodies(options, None, self._placing)
        self._chosen = MovingBodies(options, options.backend, self._placing)
        if options.camera is not None:
            read_camera(options.camera)  # before anything is fitted

    def __call__(
        self,
        path: Path,
        files: ResultFiles,
        report: dict[str, Any],
        before: Mapping[str, Any],
        *,
        fitted: bool,
    ) -> dict[str, Path]:
        """Write what is not there yet, and say in the report how.

        Args:
            path: what was converted.
            files: where the results are.
            report: of the conversion; it is written again.
            before: what the report said of products before.
            fitted: whether the motion was fitted to a body, which then moves.

        Returns:
            Each product and where it is.

        Raises:
            InputError: the motion keeps no body and none was chosen; a joint or a camera that is none.
        """
        options, motion = self._options, read_motion(files.motion)
        bodies = self._own if fitted else self._chosen
        layer, stored = bodies.layer_of(path, motion)
        camera = None if options.camera is None else fingerprint(Path(options.camera).expanduser())
        settings = {
            "content": fingerprint(path), **model_settings(layer), "backend": layer.backend,
            "params": stored.get("params"), "options": layer.options, **self._placing,
            "blend_shapes": options.blend_shapes, "joints": options.joints, "camera": camera,
            "write_up": options.write_up, "bvh": asdict(options.bvh), "video": asdict(options.video),
            "picture": asdict(options.picture),
        }  # fmt: skip
        settings = json.loads(json.dumps(settings, default=str))
        places = {product: files.product(product) for product in options.shown}
        same = before.get("settings") == settings
        missing = [product for product, place in places.items() if not (same and place.exists())]
        if missing:
            played = bodies.played(path, layer, stored, motion)
            write_products(played, missing, places.__getitem__, options=options, picture=options.picture)
        report["products"] = {
            "settings": settings,
            "files": {product: str(place.relative_to(files.folder)) for product, place in places.items()},
        }
        atomic_text(files.report, json.dumps(report, indent=2, default=float) + "\n")
        return {str(product): places[product] for product in WRITERS if product in places}


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
    options, wanted, written = WriteOptions.or_default(options), set(products), {}
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


def write_body(path: str | Path, layer: SomaLayer, identity: Identity, motion: Motion) -> None:
    """Write a body that moves as one file with mesh, skeleton, skin, correctives and animation, atomically.

    Args:
        path: ``.glb`` (glTF), ``.usdc``, ``.usda`` or ``.usd`` (UsdSkel), ``.html`` (a page that plays it).
        layer: the forward path.
        identity: one identity.
        motion: how it moves; metres, +Y up, taken as it stands.

    Raises:
        InputError: another suffix, or an identity that is a batch.
    """
    check_playable(layer, identity, motion)
    product = {".glb": Product.glb, ".html": Product.html}.get(Path(path).suffix, Product.usd)
    played = Played(layer=layer, identity=identity, motion=motion)
    WRITERS[product].write(Path(path), *_NEEDED["body"](played, played, WriteOptions(), None))


def _camera(options: WriteOptions) -> Camera:
    return read_camera(str(options.camera))


_NEEDED: Mapping[str, Callable[..., tuple[Any, ...]]] = {
    "motion": lambda played, *_: (played.motion,),
    "rotations": lambda played, _, options, __: (played, options.bvh),
    "joints": lambda _, turned, options, __: (turned.joints(options.joints),),
    "view": lambda played, _, options, __: (played.joints(options.joints), _camera(options)),
    "vertices": lambda _, turned, *__: (turned.meshes(),),
    "body": lambda played, _, options, __: (
        played.clip(_metadata(played), blend_shapes=options.blend_shapes),
    ),
    "pictures": lambda played, _, __, picture: (played, picture),
    "video": lambda played, _, options, __: (played, options.video),
}
"""What each kind of writer takes after the path; a camera sees the world as it is, +Y up."""


def write_motion_npz(path: Path, motion: Motion) -> None:
    """Write a motion in this project's schema."""
    write(motion, path)


def write_bvh_file(path: Path, played: Played, choice: BvhChoice) -> None:
    """Write the motion on the body's own bones as BVH."""
    bind = played.identity.bind_world[0].detach().cpu().double().numpy()
    write_bvh(
        played.motion, path, rig=played.layer.rig, bind_world=bind, joints=choice.joints,
        order=str(choice.order), rest=str(choice.rest), unit=str(choice.unit),
    )  # fmt: skip


def draw_contact_sheet(path: Path, played: Played, picture: Picture) -> None:
    """Draw frames of a motion, the middles of equal parts of it: both its ends are often the same pose."""
    count, total = picture.frames or Picture().frames, played.motion.frame_count
    frames = np.unique(((np.arange(count) + 0.5) * total / count).astype(int)).tolist()
    contact_sheet(path, [_drawn(played, frame) for frame in frames], width=picture.width)


def draw_video(path: Path, played: Played, choice: VideoChoice) -> None:
    """Draw a motion as a video, a single pose as a turntable."""
    motion = played.motion
    rate = choice.fps or min(motion.fps, _GIF_RATE if path.suffix == ".gif" else _RATE)
    count = max(round(motion.frame_count / motion.fps * rate), 1)
    frames = np.minimum((np.arange(count) * motion.fps / rate).astype(int), motion.frame_count - 1)
    if motion.frame_count == 1:
        rate = choice.fps or _GIF_RATE
        frames = np.zeros(max(round(choice.seconds * rate), 2), int)
    places = motion.translation[frames].astype(np.float64)
    write_video(path, lambda frame: _drawn(played, frame), frames, places, size=choice.size, fps=rate)


def _drawn(played: Played, frame: int) -> Body:
    """The body in a frame, as pictures have it."""
    layer, frames = played.layer, slice(frame, frame + 1)
    body = Body(
        vertices=played.posed(frames)[0].cpu().numpy(),
        triangles=layer.mesh.triangles,
        colour=backend_colour(layer.backend),
        caption=f"{frame / played.motion.fps:.2f} s",
    )
    return with_eyes(body, played.transforms(frames)[0].cpu().numpy(), layer.rig)


def _rounded(value: Any) -> Any:
    """Numbers to six digits, which is what float32 holds of them."""
    if isinstance(value, Mapping):
        return {name: _rounded(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(one) for one in value]
    return value if isinstance(value, str) else float(f"{float(value):.6g}")


def _metadata(played: Played) -> dict[str, str]:
    """Texts that travel with the exported body."""
    layer, motion = played.layer, played.motion
    return {
        "backend": layer.backend,
        "licence": layer.spec.licence,
        "identity": json.dumps(_rounded(motion.identity.get("params", {})), sort_keys=True),
        "rig_revision": layer.rig.revision,
        "motion": motion.source,
        "motion_licence": motion.licence,
    }
