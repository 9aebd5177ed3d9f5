"""Reading wrap pairs: vertex order kept whatever the file holds; lost order refused."""

import re
from pathlib import Path

import numpy as np
import pytest

from soma_core.errors import AssetError, InputError
from soma_core.obj import read_obj
from soma_core.topology.wrap_pair import check_wrap
from tests.bodies import native_body, tiny_canonical, wrap_vertices, write_obj

MESH, _ = tiny_canonical()
POINTS = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5], [0, 0, 1]]
HEAD = "".join("v {} {} {}\n".format(*point) for point in POINTS)
TRIANGLES = [[0, 1, 2], [0, 2, 3], [0, 1, 5]]

SPELLINGS = {
    "triangles": "f 1 2 3\nf 1 3 4\nf 1 2 6\n",
    "a quad": "f 1 2 3 4\nf 1 2 6\n",
    "a texture seam": "vt 0 0\nvt 1 0\nf 1/1 2/2 3/1\nf 1/2 3/1 4/2\nf 1/1 2/1 6/1\n",
    "normals": "vn 0 0 1\nvn 0 1 0\nf 1//1 2//1 3//1\nf 1//2 3//2 4//2\nf 1//1 2//1 6//1\n",
    "objects": "o a\nf 1 2 3\no b\nf 1 3 4\nf 1 2 6\n",
    "groups": "g a\ns 1\nf 1 2 3\ng b\ns off\nf 1 3 4\nf 1 2 6\n",
    "materials": "mtllib gone.mtl\nusemtl b\nf 1 2 3\nusemtl a\nf 1 3 4\nusemtl b\nf 1 2 6\n",
    "indices from the end": "f -6 -5 -4\nf -6 -4 -3\nf -6 -5 -1\n",
    "comments and blanks": "# hello\n\n  f  1 2\t3 \nf 1 3 4\r\nf 1 2 6\n",
    "a continued line": "f 1 2 \\\n3\nf 1 3 4\nf 1 2 6\n",
}


def obj(folder: Path, text: str) -> Path:
    path = folder / "mesh.obj"
    path.write_text(text, newline="")
    return path


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_order_is_kept_and_nothing_is_merged_or_split(tmp_path, spelling):
    vertices, triangles = read_obj(obj(tmp_path, HEAD + SPELLINGS[spelling]))
    np.testing.assert_array_equal(vertices, POINTS)
    np.testing.assert_array_equal(triangles, TRIANGLES)
    assert (vertices.dtype, triangles.dtype) == (np.float64, np.int64)


def test_coincident_vertices_stay_apart(tmp_path):
    vertices, _ = read_obj(obj(tmp_path, HEAD + HEAD + SPELLINGS["triangles"]))
    np.testing.assert_array_equal(vertices, POINTS + POINTS)


def test_vertex_colours_are_left_out(tmp_path):
    vertices, _ = read_obj(obj(tmp_path, HEAD.replace("\n", " 0.5 0.5 0.5\n") + SPELLINGS["triangles"]))
    np.testing.assert_array_equal(vertices, POINTS)


def test_the_pair_of_the_small_body_reads_back(pair):
    vertices, triangles = native_body()
    for got, expected in zip(read_obj(pair.native), (vertices, triangles), strict=True):
        np.testing.assert_array_equal(got, expected)


LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9\n"
BROKEN = {
    LFS: "mesh.obj: is a git-LFS pointer, not the file itself. Run `git lfs install",
    "": "file is empty",
    HEAD: "holds no mesh. Export it again with vertices and faces",
    "f 1 2 3\n": "holds no mesh",
    HEAD + "f 1 2 9\n": "a face refers to vertex 9 of 6",
    HEAD + "f 1 2 -9\n": "a face refers to vertex -2 of 6",
    HEAD + "f 1 2\n": r"line 7 is f 1 2\.",
    HEAD + "f a b c\n": "line 7 is f a b c",
    "v 1 2\n": "line 1 is v 1 2",
    "v 1 2 x\n": "line 1 is v 1 2 x",
    HEAD + "v 0 nan 0\nf 1 2 3\n": "vertex 6 is not finite",
    HEAD + "v 0 0 inf\nf 1 2 3\n": "vertex 6 is not finite",
}


@pytest.mark.parametrize("text", BROKEN)
def test_broken_files_are_refused(tmp_path, text):
    with pytest.raises(AssetError, match=BROKEN[text]):
        read_obj(obj(tmp_path, text))


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(AssetError, match="gone.obj: file is missing"):
        read_obj(tmp_path / "gone.obj")
    with pytest.raises(AssetError, match="is a folder, not a file"):
        read_obj(tmp_path)


# --- the canonical order --------------------------------------------------------------------------------


def check(vertices, triangles):
    check_wrap(vertices, triangles, MESH, path=Path("some/wrap.obj"))


def test_the_canonical_mesh_and_any_shape_of_it_pass():
    check(MESH.vertices, MESH.triangles)
    check(wrap_vertices(), MESH.triangles)
    check(MESH.vertices * [1.4, 0.7, 1.0], MESH.triangles)


def test_either_diagonal_of_a_quad_passes():
    quads = MESH.face_vert_indices.reshape(-1, 4)
    check(wrap_vertices(), np.concatenate([quads[:, [0, 1, 3]], quads[:, [1, 2, 3]]]))
    check(wrap_vertices(), MESH.triangles[::-1, ::-1])


@pytest.mark.parametrize("change", [-1, 1])
def test_wrong_vertex_count(change):
    count = MESH.vertex_count + change
    vertices = np.resize(wrap_vertices(), (count, 3))
    text = rf"wrap some/wrap.obj: got {count} vertices, expected {MESH.vertex_count}, .*without merging"
    with pytest.raises(InputError, match=text):
        check(vertices, MESH.triangles)


def shuffled(seed=0):
    return np.random.default_rng(seed).permutation(MESH.vertex_count)


def test_vertices_and_faces_reordered_together():
    """An exporter that renumbers: a perfectly good mesh, and useless as a wrap."""
    order = shuffled()
    with pytest.raises(InputError, match=r"faces that do not exist in the canonical mesh.*Keep Vertex Order"):
        check(wrap_vertices()[order], np.argsort(order)[MESH.triangles])


def test_two_vertices_swapped_with_their_faces():
    order = np.arange(MESH.vertex_count)
    order[[10, 400]] = order[[400, 10]]
    with pytest.raises(InputError, match=r"got \d+ of \d+ faces that do not exist"):
        check(wrap_vertices()[order], np.argsort(order)[MESH.triangles])


def test_vertices_reordered_under_canonical_faces():
    with pytest.raises(
        InputError, match=r"neighbouring vertices .*% of the body's diagonal apart.*were reordered"
    ):
        check(wrap_vertices()[shuffled()], MESH.triangles)


def test_faces_in_another_order_are_no_problem():
    check(wrap_vertices(), MESH.triangles[np.random.default_rng(1).permutation(len(MESH.triangles))])


def test_faces_of_another_mesh():
    _, triangles = native_body()
    triangles = triangles % MESH.vertex_count
    with pytest.raises(InputError, match=re.escape(f"of {len(triangles)} faces")):
        check(wrap_vertices(), triangles)


def test_written_objs_are_exact(tmp_path):
    path = write_obj(tmp_path / "a.obj", wrap_vertices(), MESH.triangles)
    np.testing.assert_array_equal(read_obj(path)[0], wrap_vertices())


def test_an_obj_is_written_to_so_many_digits(tmp_path):
    path = write_obj(tmp_path / "a.obj", np.array([[1 / 3, -2.0, 1e-9]] * 3), np.array([[0, 1, 2]]), digits=3)
    assert path.read_text().splitlines() == ["v 0.333 -2.000 0.000"] * 3 + ["f 1 2 3"]
