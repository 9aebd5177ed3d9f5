"""``soma wrap``: what it reads, what it writes and what it refuses; the registration itself is replaced."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from soma_core.cli import EXIT_FAILED, EXIT_OK, EXIT_USAGE, main
from soma_core.config.schema import WrapConfig
from soma_core.errors import AssetError, InputError
from soma_core.obj import read_obj
from soma_core.plugin.hookspecs import hookimpl
from soma_core.plugin.registry import Registry
from soma_core.plugin.spec import Parameter, WrapPair
from soma_core.registration.digits import digit_guide
from soma_core.registration.pair_files import WRAP_FILE
from soma_core.registration.quality import Quality, measure
from soma_core.registration.register import Registration, WrapOptions
from soma_core.registration.target import Frame, Skin
from soma_core.rig import load_canonical
from soma_core.rig.landmarks import canonical_landmarks
from soma_core.rig.mesh import CanonicalMesh
from soma_core.tasks import wrap
from soma_core.topology.correspondence import load_correspondence
from tests.plugin.fakes import FakeEntryPoint, declares

ROUNDING_MM = 1e-3  # seven decimals of a metre
FLIPPED_PERCENT = 0.1  # normals at sharp creases are no clear answer, not even for the mesh itself
CENTRE = (0.0, 0.0, 0.0)


def configured(**changes: object) -> DictConfig:
    return OmegaConf.merge(OmegaConf.structured(WrapConfig), {"picture": False} | changes)


@pytest.fixture(scope="module")
def mesh() -> CanonicalMesh:
    return load_canonical("mid")[0]


def on_itself(vertices: np.ndarray, triangles: np.ndarray) -> Registration:
    mesh, _ = load_canonical("mid")
    filled = np.zeros(mesh.vertex_count, bool)
    filled[mesh.face_interior] = True
    return Registration(
        wrap=mesh.vertices.copy(),
        frame=Frame(unit="m", up="+y", forward="+z", centre=CENTRE),
        skin=Skin(vertices=vertices, triangles=triangles),
        filled=filled,
        symmetric=True,
        fitted=mesh.vertices,
        notes=("unit m, up +y, facing +z",),
    )


@pytest.fixture(scope="module")
def quality(mesh: CanonicalMesh) -> Quality:
    """Of the canonical mesh on itself: measuring takes seconds."""
    return measure(on_itself(mesh.vertices, mesh.triangles.astype(np.int64)), mesh)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch, quality: Quality) -> list[WrapOptions]:
    """The registration finds the canonical mesh on itself; the options that it got."""
    got: list[WrapOptions] = []

    def found(vertices: np.ndarray, triangles: np.ndarray, *, options: WrapOptions) -> Registration:
        got.append(options)
        return on_itself(vertices, triangles)

    monkeypatch.setattr(wrap, "register", found)
    monkeypatch.setattr(wrap, "measure", lambda *_: quality)
    return got


@pytest.fixture
def body(tmp_path: Path, mesh: CanonicalMesh) -> Path:
    path = tmp_path / "body.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.triangles + 1).tolist()]
    path.write_text("# made by hand\n" + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_the_pair_is_ready_for_a_plugin(
    tmp_path: Path, body: Path, mesh: CanonicalMesh, seen: list[WrapOptions]
) -> None:
    folder = tmp_path / "pair"
    assert wrap.run(configured(native=str(body), out=str(folder)), tmp_path / "run") == folder
    assert (folder / "body.obj").read_bytes() == body.read_bytes()
    vertices, _ = read_obj(folder / WRAP_FILE)
    assert 1000 * np.abs(vertices - mesh.vertices).max() < ROUNDING_MM
    pair = WrapPair(native=folder / "body.obj", wrap=folder / WRAP_FILE)
    found = load_correspondence(pair, mesh)
    assert 1000 * found.distances.max() < ROUNDING_MM
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert report["surface_distance_mm"]["max"] < ROUNDING_MM
    assert report["flipped_percent"] < FLIPPED_PERCENT
    assert (report["unit"], report["up"], report["forward"]) == ("m", "+y", "+z")
    assert report["filled_vertices"] == len(mesh.face_interior)
    assert report["extremities"] == dict.fromkeys(("LeftHand", "RightHand", "LeftFoot", "RightFoot"), 5)
    assert len(report["digits"]) == 20
    assert report["faults"] == []


def test_the_wrap_carries_the_uvs(tmp_path: Path, body: Path, mesh: CanonicalMesh, seen) -> None:
    wrap.run(configured(native=str(body)), tmp_path)
    lines = (tmp_path / WRAP_FILE).read_text(encoding="utf-8").splitlines()
    assert sum(line.startswith("vt ") for line in lines) == len(mesh.uv)
    faces = [line for line in lines if line.startswith("f ")]
    assert len(faces) == len(mesh.face_vert_counts)
    first = [f"{v + 1}/{t + 1}" for v, t in zip(mesh.face_vert_indices[:4], mesh.uv_indices[:4], strict=True)]
    assert faces[0].split()[1:] == (first if len(mesh.uv) else [part.split("/")[0] for part in first])


def test_a_ply_is_read_in_its_order(tmp_path: Path, mesh: CanonicalMesh, seen) -> None:
    import trimesh

    path = tmp_path / "scan.ply"
    trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False).export(path)
    wrap.run(configured(native=str(path), out=str(tmp_path / "pair")), tmp_path)
    vertices, triangles = read_obj(tmp_path / "pair" / "scan.obj")
    assert 1000 * np.abs(vertices - mesh.vertices).max() < ROUNDING_MM
    np.testing.assert_array_equal(triangles, mesh.triangles)


def test_a_mesh_with_the_name_of_the_wrap_keeps_out_of_its_way(tmp_path: Path, body: Path, seen) -> None:
    native = body.rename(tmp_path / WRAP_FILE)
    wrap.run(configured(native=str(native), out=str(tmp_path / "pair")), tmp_path)
    assert (tmp_path / "pair" / f"native_{WRAP_FILE}").read_bytes() == native.read_bytes()


def test_what_the_user_knows_is_passed_on(tmp_path: Path, body: Path, seen: list[WrapOptions]) -> None:
    (tmp_path / "marks.json").write_text('{"12": 34, "LeftIndexTip": 56}', encoding="utf-8")
    (tmp_path / "mask.json").write_text("[5, 6]", encoding="utf-8")
    given = {"landmarks": str(tmp_path / "marks.json"), "mask": str(tmp_path / "mask.json")}
    known = {"unit": "cm", "up": "+z", "forward": "-y", "symmetric": False, "fill": ["eye_bags"]}
    wrap.run(configured(native=str(body), **given, **known), tmp_path)
    (options,) = seen
    assert options == WrapOptions(
        unit="cm",
        up="+z",
        forward="-y",
        symmetric=False,
        fill=("eye_bags",),
        landmarks={12: 34, canonical_landmarks()["LeftIndexTip"]: 56},
        masked=[5, 6],
    )


class _Neutral:
    """A model of the canonical mesh in centimetres."""

    def rest(self, params):
        scale = 1 + 0 * params["size"][:, None, None]
        return 100 * scale * torch.tensor(load_canonical("mid")[0].vertices)[None]


class _WithFaces(_Neutral):
    def triangles(self):
        return torch.tensor(load_canonical("mid")[0].triangles)


def _registry(tmp_path: Path, generator: object) -> Registry:
    """One backend, "good", whose wrap pair is missing."""
    pair = WrapPair(native=tmp_path / "nowhere" / "native.obj", wrap=tmp_path / "nowhere" / "wrap.obj")
    plugin = declares(wrap=pair, unit="cm", params=(Parameter(name="size"),))
    plugin.soma_generator = hookimpl(lambda: generator)
    return Registry([FakeEntryPoint("good", plugin)])


def test_a_backend_without_a_pair_is_wrapped_from_its_generator(
    tmp_path: Path, mesh: CanonicalMesh, seen: list[WrapOptions], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wrap, "default_registry", lambda: _registry(tmp_path, _WithFaces()))
    wrap.run(configured(backend={"name": "good"}, out=str(tmp_path / "pair")), tmp_path)
    vertices, triangles = read_obj(tmp_path / "pair" / "good_neutral.obj")
    assert 1000 * np.abs(vertices / 100 - mesh.vertices).max() < ROUNDING_MM
    np.testing.assert_array_equal(triangles, mesh.triangles)
    assert seen[0].unit == "cm"


def test_a_backend_without_faces_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seen) -> None:
    monkeypatch.setattr(wrap, "default_registry", lambda: _registry(tmp_path, _Neutral()))
    with pytest.raises(InputError, match=r"backend: got good, whose generator has no triangles\(\)"):
        wrap.run(configured(backend={"name": "good"}), tmp_path)


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({}, InputError, "native: got none, and no backend"),
        ({"native": "a.obj", "backend": {"name": "anny"}}, InputError, "native: got a mesh and a backend"),
        ({"native": "a.fbx"}, InputError, "native: got the suffix '.fbx'"),
        ({"native": "missing.obj"}, AssetError, "missing.obj"),
        (
            {"backend": {"name": "soma"}},
            InputError,
            "backend: got soma, expected a backend with a topology of its own",
        ),
        ({"up": "up"}, InputError, "up: got 'up', expected"),
        ({"mask": "missing.json"}, AssetError, "missing.json: file is missing"),
    ],
)
def test_what_cannot_be_used_is_refused(
    changes: dict, error: type[Exception], text: str, tmp_path: Path, body: Path, seen
) -> None:
    if not {"native", "backend"} & set(changes):
        changes = {**changes, **({"native": str(body)} if changes else {})}
    with pytest.raises(error, match=text):
        wrap.run(configured(**changes), tmp_path)


@pytest.mark.parametrize("content", ["[1.5]", "{}", '["a"]', "not json", "[[1]]"])
def test_a_mask_that_is_no_list_of_ids_is_refused(content: str, tmp_path: Path, body: Path, seen) -> None:
    (tmp_path / "mask.json").write_text(content, encoding="utf-8")
    with pytest.raises(
        AssetError, match=r"mask\.json: (does not hold|not valid JSON).*list of native vertex ids"
    ):
        wrap.run(configured(native=str(body), mask=str(tmp_path / "mask.json")), tmp_path)


def test_a_ply_without_faces_is_refused(tmp_path: Path, seen) -> None:
    path = tmp_path / "points.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 0\n",
        encoding="utf-8",
    )
    with pytest.raises(AssetError, match="points.ply: holds no faces"):
        wrap.run(configured(native=str(path)), tmp_path)


def test_a_finger_on_its_neighbour_is_exit_code_1(
    tmp_path: Path, mesh: CanonicalMesh, body: Path, seen, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """The mesh is given with its left ring finger where the pinky is, as a wrap that went wrong sees it."""
    ring, pinky = (digit_guide().along["LeftHand"][digit] > 0 for digit in (3, 4))
    right = wrap.register

    def wrong(*mesh_and_faces: np.ndarray, options: WrapOptions) -> Registration:
        found = right(*mesh_and_faces, options=options)
        moved = found.wrap.copy()
        moved[ring] += moved[pinky].mean(0) - moved[ring].mean(0)
        return replace(found, wrap=moved)

    monkeypatch.setattr(wrap, "register", wrong)
    monkeypatch.setattr(wrap, "measure", measure)
    monkeypatch.chdir(tmp_path)
    assert main(["wrap", f"native={body}", "out=pair", "picture=false"]) == EXIT_FAILED
    said = capsys.readouterr().err
    assert "pair: this wrap is not fit for use. LeftRing: " in said
    assert "landmarks=FILE" in said
    assert (tmp_path / "pair" / WRAP_FILE).is_file()


def test_the_last_line_is_where_the_pair_is(tmp_path: Path, body: Path, seen, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["wrap", f"native={body}", "out=pair", "picture=false"]) == EXIT_OK
    assert capsys.readouterr().out.splitlines()[-1] == "pair"


def test_an_unknown_landmark_is_refused(tmp_path: Path, body: Path, seen) -> None:
    (tmp_path / "marks.json").write_text('{"LeftIndexTop": 34}', encoding="utf-8")
    with pytest.raises(InputError, match="landmarks .*marks.json: got LeftIndexTop, expected .*LeftIndexTip"):
        wrap.run(configured(native=str(body), landmarks=str(tmp_path / "marks.json")), tmp_path)


def test_help_says_what_every_key_means(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["wrap", "--help"])
    said = capsys.readouterr().out.partition("What keys mean:")[2]
    for key in fields(WrapConfig):
        assert re.search(rf"^  {key.name} +\S", said, re.MULTILINE), key.name


def test_the_picture_is_drawn(tmp_path: Path, body: Path, seen) -> None:
    pytest.importorskip("pyvista")
    from PIL import Image

    wrap.run(configured(native=str(body), picture=True), tmp_path)
    with Image.open(tmp_path / "wrap.png") as picture:
        pixels = np.asarray(picture)
    assert pixels.shape[1] == 4 * 430
    for column in range(4):  # no cell is empty
        assert pixels[50:600, 430 * column : 430 * (column + 1)].std() > 5


def test_the_command_line_chooses_a_backend(
    tmp_path: Path, seen, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["wrap", "backend=soma"]) == EXIT_USAGE
    assert "backend: got soma, expected a backend with a topology of its own" in capsys.readouterr().err
