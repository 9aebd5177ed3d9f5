"""``soma evaluate``: measure a claim, write the table, and fail when a figure is outside its bound."""

from __future__ import annotations

import importlib
import json
import logging
from pathlib import Path

from omegaconf import DictConfig

from soma_core.cache import atomic_write
from soma_core.errors import InputError, SomaError
from soma_core.evaluation.report import Report

__all__ = ["EXPERIMENTS", "run"]

_log = logging.getLogger(__name__)

EXPERIMENTS = (
    "table1_topology", "table2_inversion", "table3_regions", "unknown_identity", "forward_path",
    "anny_reference", "sam3d_frames", "correctives", "twist_joints", "pose_angles",
    "ground_contact", "points", "conversion_matrix", "shape_space",
)  # fmt: skip
"""Modules of ``soma_core.evaluation`` with a function ``run(config) -> Report``."""


def run(config: DictConfig, output: Path) -> None:
    """Run `config.experiment.name`; write ``report.json``, ``report.md`` and any picture into `output`.

    Raises:
        InputError: no such experiment.
        SomaError: a figure is outside its bound; the reports are written first.
    """
    name = config.experiment.name
    if name not in EXPERIMENTS:
        raise InputError(
            "experiment.name",
            got=repr(name),
            expected="one of " + ", ".join(EXPERIMENTS),
            fix="Correct the name.",
        )
    report: Report = importlib.import_module(f"soma_core.evaluation.{name}").run(config)
    text = report.as_markdown()
    for line in text.splitlines():
        _log.info("%s", line)
    document = json.dumps(report.as_json(), indent=2) + "\n"
    atomic_write(output / "report.json", lambda path: path.write_text(document, encoding="utf-8") and None)
    atomic_write(output / "report.md", lambda path: path.write_text(text, encoding="utf-8") and None)
    _draw(output, report)
    if report.failed:
        worst = "; ".join(f"{f.name} is {f.value:.4g} {f.unit}, bound {f.bound:g}" for f in report.failed)
        raise SomaError(f"{name}: {worst}. See {output / 'report.md'}")


def _draw(folder: Path, report: Report) -> None:
    """Draw what a report shows, if anything; without pyvista there is no picture, and that is said."""
    if not report.bodies and not report.pictures:
        return
    from soma_core.view.error_picture import error_sheet
    from soma_core.view.stage import Body

    bodies = [
        Body(vertices=body.vertices, triangles=body.triangles, colour=(0.8, 0.8, 0.8), caption=body.caption)
        for body in report.bodies
    ]
    try:
        if bodies:
            error_sheet(folder / "errors.png", bodies, [body.errors_mm for body in report.bodies])
        for name, draw in report.pictures.items():
            draw(folder / name)
    except SomaError as error:
        _log.warning("no picture: %s", error)
