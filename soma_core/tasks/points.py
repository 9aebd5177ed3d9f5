"""``soma points``: which point sets there are, one in full or in a picture, and whether a file is one."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

from soma_core.errors import AssetError
from soma_core.points.point_set import Point, PointSet, find_point_sets, load_point_set
from soma_core.tasks import EXIT_OK

__all__ = ["run_verb"]


def run_verb(arguments: Sequence[str], say: Callable[[str], None]) -> int:
    """Run ``soma points <arguments>``, pass the result to `say`, and return the exit code.

    Raises:
        SomaError: no such set, or a file that is none.
    """
    options = _parser().parse_args(arguments)
    say(options.verb(options))
    return EXIT_OK


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="soma points", description="Named points of a body.")
    parser.set_defaults(verb=_list)
    verbs = parser.add_subparsers(title="verbs", metavar="VERB")
    verbs.add_parser("list", help="every point set (the default)").set_defaults(verb=_list)
    show = verbs.add_parser("show", help="one set: its points in order, and where each lies")
    check = verbs.add_parser("check", help="whether a set lies on the mesh and rig at every level of detail")
    for each, verb in ((show, _show), (check, _check)):
        each.set_defaults(verb=verb)
        each.add_argument("name", metavar="NAME", help="a point set, or the path of a JSON file")
    show.add_argument("--json", action="store_true", help="as a JSON file of one's own begins")
    show.add_argument("--picture", type=Path, metavar="FILE.png", help="draw it on a body (.png, .webp)")
    show.add_argument("--backend", default="soma", help="whose body is drawn (default: %(default)s)")
    return parser


def _list(_options: argparse.Namespace) -> str:
    found = find_point_sets()
    width = max(map(len, found), default=0) + 2
    return "\n".join(f"{name:<{width}}{_row(path)}" for name, path in found.items())


def _row(path: Path) -> str:
    """How many points a set has, and what it is; of a damaged file, which costs no other set, why."""
    try:
        found = load_point_set(path)
    except AssetError as error:
        return f"{'-':>4}  {error}"
    return f"{len(found):>4}  {found.about}"


def _show(options: argparse.Namespace) -> str:
    points = load_point_set(options.name)
    if options.picture is not None:
        return str(_picture(points, options.picture, options.backend))
    if options.json:
        return _json(points)
    width = max(map(len, points.names)) + 2
    lines = [f"{points.name}: {points.about}", f"from: {points.source}", ""]
    lines += [
        f"{number:>4}  {name:<{width}}{_where(point)}"
        for number, (name, point) in enumerate(points.points.items())
    ]
    return "\n".join(lines)


def _where(point: Point) -> str:
    """A place in words."""
    parts = [f"{weight:g} {joint}" if weight != 1 else joint for joint, weight in point.joints.items()]
    parts += [
        f"{weight:g} vertex {v}" if weight != 1 else f"vertex {v}" for v, weight in point.vertices.items()
    ]
    away = f" + ({', '.join(f'{value:g}' for value in point.offset)}) m" if any(point.offset) else ""
    return " + ".join(parts) + away


def _json(points: PointSet) -> str:
    places = {}
    for name, point in points.points.items():
        place: dict[str, object] = {"joints": dict(point.joints)} if point.joints else {}
        if point.vertices:
            place["vertices"] = {str(vertex): weight for vertex, weight in point.vertices.items()}
        if any(point.offset):
            place["offset"] = list(point.offset)
        places[name] = place
    bones = [list(bone) for bone in points.bones]
    head = {"name": points.name, "about": points.about, "source": points.source}
    return json.dumps({**head, "points": places, "bones": bones}, indent=1)


def _check(options: argparse.Namespace) -> str:
    from soma_core.layer import SomaLayer

    points = load_point_set(options.name)
    for lod in ("mid", "low"):
        SomaLayer("soma", lod=lod).places(points)
    return f"{options.name}: {len(points)} points lie on the rig, and on the meshes mid and low"


def _picture(points: PointSet, path: Path, backend: str) -> Path:
    """Draw a set on a body with its arms half lowered."""
    import torch

    from soma_core.layer import SomaLayer
    from soma_core.view.picture import backend_colour
    from soma_core.view.point_picture import point_picture
    from soma_core.view.stage import Body

    layer = SomaLayer(backend)
    rotations = torch.zeros(1, len(layer.joint_names), 3)
    posed = layer.pose(layer.identity(), rotations)
    places = layer.points(posed, points)[0].numpy()
    body = Body(
        vertices=posed.vertices[0].numpy(), triangles=layer.mesh.triangles, colour=backend_colour(backend)
    )
    point_picture(path, body, points.names, places, points.bones)
    return path
