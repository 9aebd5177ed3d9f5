"""What is written of a converted motion beside it: its body, posed, as any of the products."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from soma_core.cache import atomic_text
from soma_core.io.motion_files import read_motion
from soma_core.motion.files import ResultFiles, fingerprint
from soma_core.motion.models import model_settings
from soma_core.motion.options import ConvertOptions
from soma_core.motion.played import MovingBodies
from soma_core.motion.writers import WRITERS, write_products

__all__ = ["BodyProducts"]


class BodyProducts:
    """Writes one converted motion after another as the products that are asked for.

    Args:
        options: of the conversion.
    """

    def __init__(self, options: ConvertOptions) -> None:
        self._options, translation = options, str(options.translation)
        self._own = MovingBodies(options, None, translation)
        self._chosen = MovingBodies(options, options.backend, translation)

    def __call__(
        self, path: Path, files: ResultFiles, report: dict[str, Any], before: Mapping[str, Any], *, fitted: bool
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
            "params": stored.get("params"), "options": layer.options, "translation": str(options.translation),
            "joints": options.joints, "camera": camera, "write_up": options.write_up, "bvh": asdict(options.bvh),
            "picture": asdict(options.picture),
        }  # fmt: skip
        settings = json.loads(json.dumps(settings, default=str))
        places = {product: files.product(product) for product in options.shown}
        same = before.get("settings") == settings
        missing = [product for product, place in places.items() if not (same and place.exists())]
        if missing:
            played = bodies.played(layer, stored, motion)
            write_products(
                played, missing, places.__getitem__, options=options, picture=options.picture
            )
        report["products"] = {
            "settings": settings,
            "files": {product: str(place.relative_to(files.folder)) for product, place in places.items()},
        }
        atomic_text(files.report, json.dumps(report, indent=2, default=float) + "\n")
        return {str(product): places[product] for product in WRITERS if product in places}
