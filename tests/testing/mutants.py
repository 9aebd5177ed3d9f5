"""Backends broken in exactly one way: the specimen with one edit each.

A mutant is the id of the check that must fail, what its sentence must say, and the edit.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from soma_core.testing.synthetic import synthetic_canonical
from tests.testing.packages import Edit, Package

__all__ = ["MUTANTS", "Mutant"]

_INIT, _GENERATOR, _CONFIG = "__init__.py", "_generator.py", "configs/backend/specimen.yaml"
_MOTION, _SHARES = "_motion.py", "(near / near.sum(1, keepdim=True))"
_RETURN = 'return self.template + torch.einsum("bk,knc->bnc", coefficients, self.fields)'
_BEGIN = "coefficients = self.coefficients(params)"
_BUILD = "    return Specimen("
_IN_PROBE = "os.path.basename(os.getcwd()) == 'empty'"
"""In the process that a check starts."""


@dataclass(frozen=True)
class Mutant:
    """One way to be broken."""

    check: str
    says: str
    edit: Edit


def _in(file: str, old: str, new: str) -> Edit:
    return lambda made: made.replace(file, old, new)


def _rest(result: str) -> Edit:
    """Let rest() return an expression in the vertices ``v``, ``params`` and ``self`` instead of ``v``."""
    return _in(_GENERATOR, _RETURN, f"{_RETURN.replace('return', 'v =')}\n        return {result}")


def _before_rest(line: str) -> Edit:
    return _in(_GENERATOR, _BEGIN, f"{line}\n        {_BEGIN}")


def _before_build(line: str) -> Edit:
    return _in(_INIT, _BUILD, f"    {line}\n{_BUILD}")


def _of_no_form(made: Package) -> None:
    """Nothing tells the form of a pose, and posed() returns no mesh."""
    for name in ("def skinning(", "def random_poses("):
        made.replace(_GENERATOR, name, name.replace("def ", "def other_"))
    made.replace(_GENERATOR, "pose_size, root_size", "other_size, root_size")
    _returns("posed", "42")(made)


def _returns(method: str, value: str) -> Edit:
    """Let a method return something else before it does anything."""
    head = re.compile(rf"(    def {method}\(self.*\):\n        \"\"\".*\"\"\"\n)")

    def edit(made: Package) -> None:
        path = made.folder / _GENERATOR
        text, count = head.subn(rf"\g<1>        return {value}\n", path.read_text())
        assert count == 1
        path.write_text(text)

    return edit


def _at_import(line: str) -> Edit:
    return _in(_INIT, "FOLDER =", f"{line}\nFOLDER =")


def _all(*edits: Edit) -> Edit:
    return lambda made: [edit(made) for edit in edits]


def _not_linear(made: Package) -> None:
    made.replace(_GENERATOR, "def linear_basis", "def _linear_basis")


# --- meshes -----------------------------------------------------------------------------------------------


def _joint(name: str) -> np.ndarray:
    rig = synthetic_canonical()[1]
    return rig.bind_world[rig.joint_names.index(name), :3, 3]


def _add_vertex(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate((vertices, vertices[:1])), triangles


def _sort_vertices(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a mesh library does that sorts vertices: faces still fit, but the order is lost."""
    order = np.lexsort(vertices.T)
    return vertices[order], np.argsort(order)[triangles]


def _swap_head_and_foot(vertices: np.ndarray, triangles: np.ndarray) -> None:
    ends = [int(vertices[:, 2].argmin()), int(vertices[:, 2].argmax())]
    vertices[ends] = vertices[ends[::-1]]


def _other_faces(vertices: np.ndarray, triangles: np.ndarray) -> None:
    triangles[:10, 2] = (triangles[:10, 2] + 500) % len(vertices)


def _pull_off(vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Pull the belly of the wrap 3 cm off the native surface."""
    belly = (np.abs(vertices[:, 0]) < 10) & (np.abs(vertices[:, 2] - 115) < 15)
    vertices[belly, 1] -= 3


def _pull_one_off(vertices: np.ndarray, triangles: np.ndarray) -> None:
    vertices[np.abs(vertices - [0, -13, 110]).sum(1).argmin(), 1] -= 9


def _short_arm(vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Draw the end of an arm of the wrap back into it: the skin there is bare."""
    end = vertices[:, 0].max()
    vertices[:, 0] = np.minimum(vertices[:, 0], end - 6)


def _brim(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put a hat with a brim of 20 cm on the native head; the wrap does not follow it."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = np.stack((np.cos(angle), np.sin(angle), 0 * angle), 1)
    top = [0, 0, vertices[:, 2].max() - 3]
    ids = len(vertices) + np.arange(60)
    after = np.roll(ids, 1)
    faces = np.concatenate((np.stack((ids, after, ids + 60), 1), np.stack((after, after + 60, ids + 60), 1)))
    return np.concatenate((vertices, 12 * circle + top, 32 * circle + top)), np.concatenate(
        (triangles, faces)
    )


def _mirror(points: np.ndarray) -> None:
    points[:, 0] *= -1


def _cave_in(points: np.ndarray) -> None:
    """Push the front of the belly out through the back."""
    front = (points[:, 2] > 0) & (np.abs(points[:, 1] - 1.1) < 0.12) & (np.abs(points[:, 0]) < 0.2)
    points[front, 2] -= 0.3


def _hip_forward(points: np.ndarray) -> None:
    """Move the left hip joint 50 cm in front of the body."""
    points[:, 2] += 0.5 * np.exp(-((points - _joint("LeftLeg")) ** 2).sum(1) / 0.2**2)


def _no_foot(points: np.ndarray) -> None:
    """Shrink the left foot to a point."""
    points[(points[:, 1] < 0.25) & (points[:, 0] > 0)] = _joint("LeftFoot")


def _ride_on_sliver(made: Package) -> None:
    """Cut a sliver off a native face, and let a wrap vertex ride 3 mm above it."""
    native, triangles = made.mesh("native.obj")
    wrap, wrap_faces = made.mesh("wrap.obj")
    belly = int(np.abs(native[triangles].mean(1) - [0, -13, 110]).sum(1).argmin())
    a, b, c = triangles[belly]
    middle = (native[a] + native[b]) / 2
    inward = np.cross(np.cross(native[b] - native[a], native[c] - native[a]), native[b] - native[a])
    inward /= np.linalg.norm(inward)
    normal = np.cross(native[b] - native[a], inward) / np.linalg.norm(native[b] - native[a])
    cut = len(native)
    others = np.delete(triangles, belly, axis=0)  # the sliver comes first: of equally near faces it is taken
    faces = [(a, b, cut), (b, c, cut), (c, a, cut), *others]
    made.write("native.obj", [*native, middle + 3e-5 * inward], faces)
    nearest = int(np.linalg.norm(wrap - middle, axis=1).argmin())
    wrap[nearest] = middle + 1e-5 * inward + 0.3 * normal
    made.write("wrap.obj", wrap, wrap_faces)


# --- the list ---------------------------------------------------------------------------------------------

MUTANTS = (
    Mutant(
        "declares",
        "got import: SystemExit: no key, expected that the",
        _at_import("raise SystemExit('no key')"),
    ),
    Mutant(
        "declares",
        "got hooks: .*not marked",
        _in(_INIT, "@hookimpl\ndef soma_generator", "def soma_generator"),
    ),
    Mutant("licence", "licence: got '', expected the licence", _in(_INIT, '"CC0-1.0"', '""')),
    Mutant("described", "parameter size: got ''", _in(_INIT, '"factor of the stature"', '""')),
    Mutant("described", r"description: got 'a body\\nof", _in(_INIT, '"a body of', r'"a body\nof')),
    Mutant(
        "parameter-defaults",
        "parameter size: got default 2 and range 0.8 to 1.2",
        _in(_INIT, "default=1.0", "default=2.0"),
    ),
    Mutant(
        "options", "options.strength: got nothing", _in(_INIT, "strength: float = 1.0", "strength: float")
    ),
    Mutant("fill-segments", "got eye_bag, expected names among", _in(_INIT, '"eye_bags"', '"eye_bag"')),
    Mutant("files-named", "model.txt: got no url", _in(_INIT, ', url="https://example.org/model"', "")),
    Mutant(
        "files-named",
        "FileNeeded README: got no absolute path",
        _in(_INIT, 'FOLDER / "model.txt"', 'Path("README")'),
    ),
    Mutant("own-checks", "soma_checks gave 'taller', expected", _in(_INIT, "[taller]", '["taller"]')),
    Mutant("import-light", "got an import of torch, expected", _at_import("import torch")),
    Mutant(
        "import-light",
        "got import: RuntimeError: no torch",
        _at_import("import sys\nif 'torch' not in sys.modules: raise RuntimeError('no torch')"),
    ),
    Mutant(
        "import-light",
        "got an end with exit code 3",
        _at_import("import sys, os\n'torch' in sys.modules or os._exit(3)"),
    ),
    Mutant("import-silent", "got the output 'hello'", _at_import("print('hello')")),
    Mutant(
        "import-silent",
        "got the output .*DeprecationWarning",
        _at_import("import warnings; warnings.warn('old', DeprecationWarning)"),
    ),
    Mutant("config-composes", "ships no configs/backend/specimen.yaml", lambda made: made.delete(_CONFIG)),
    Mutant(
        "config-composes",
        "got name: other, expected name: specimen",
        _in(_CONFIG, "name: specimen", "name: other"),
    ),
    Mutant("config-composes", "specimen.yaml: got .*typo", _in(_CONFIG, "options:", "typo: 1\noptions:")),
    Mutant(
        "config-composes",
        "point_sets/lab.json: got not valid JSON",
        lambda made: made.add("configs/point_sets/lab.json", "{"),
    ),
    Mutant("config-complete", "params: got no belly, expected", _in(_CONFIG, "  belly: null\n", "")),
    Mutant(
        "config-complete", "params: got undeclared bely", _in(_CONFIG, "  belly:", "  bely: null\n  belly:")
    ),
    Mutant(
        "config-complete",
        "options.strength: got 2.0, expected 1.0",
        _in(_CONFIG, "strength: 1.0", "strength: 2.0"),
    ),
    Mutant("wrap-reads", "wrap.obj: got file is missing", lambda made: made.delete("wrap.obj")),
    Mutant("wrap-reads", "got line 1 is v 1 2", lambda made: made.prepend("wrap.obj", "v 1 2\n")),
    Mutant(
        "wrap-count",
        r"wrap.obj: got (\d+) vertices, expected \d+, one",
        lambda made: made.remesh("wrap.obj", _add_vertex),
    ),
    Mutant(
        "wrap-order",
        "got neighbouring vertices .* apart",
        lambda made: made.remesh("wrap.obj", _sort_vertices),
    ),
    Mutant(
        "wrap-order",
        r"canonical vertex \d+.*: got neighbours \d+.\d% of",
        lambda made: made.remesh("wrap.obj", _swap_head_and_foot),
    ),
    Mutant(
        "wrap-faces",
        "got 10 of .* faces that do not exist",
        lambda made: made.remesh("wrap.obj", _other_faces),
    ),
    Mutant(
        "wrap-distance",
        r"canonical vertex \d+: got 30 mm to the native surface, and \d.\d% of",
        lambda made: made.remesh("wrap.obj", _pull_off),
    ),
    Mutant(
        "wrap-distance",
        r"canonical vertex \d+: got \d+ mm to the native surface, and 0.1% of",
        lambda made: made.remesh("wrap.obj", _pull_one_off),
    ),
    Mutant(
        "wrap-coverage",
        r"wrap .*wrap.obj, Left\w+: got \d+% of it on the native surface, and \d+% of that under it",
        lambda made: made.remesh("wrap.obj", _short_arm),
    ),
    Mutant("generator-builds", r"_generator.py:\d+: got ZeroDivisionError", _before_rest("1 / 0")),
    Mutant(
        "generator-builds", r"_generator.py:\d+: got SystemExit: bye", _before_rest("raise SystemExit('bye')")
    ),
    Mutant(
        "generator-builds", "got build: ImportError: no model", _before_build("raise ImportError('no model')")
    ),
    Mutant(
        "generator-builds",
        r"returned <class '\S*Specimen'>, no object with a rest method",
        _before_build("return Specimen"),
    ),
    Mutant("generator-shape", r"batch of 1: got \(\d+, 3\), expected a tensor", _rest("v.squeeze(0)")),
    Mutant(
        "generator-shape", r"batch of 1: got \(1, \d+, 3\), expected .* of the native OBJ", _rest("v[:, 1:]")
    ),
    Mutant("generator-shape", "batch of 1: got ndarray", _rest("v.detach().numpy()")),
    Mutant("generator-shape", "batch of 3: got", _rest("v[:1]")),
    Mutant("generator-dtype", "dtype=torch.float64, under .*: got torch.float32", _rest("v.float()")),
    Mutant(
        "generator-dtype",
        "dtype=torch.float32, under the default dtype torch.float64: got torch.float64",
        _rest("v + torch.zeros(3)"),
    ),
    Mutant("generator-device", "device=cpu: got meta", _rest("v.to('meta')")),
    Mutant("other-device", "got tensors of two devices", _rest("v + torch.zeros(3, dtype=v.dtype)")),
    Mutant(
        "other-device",
        "device=(meta|cuda.*): got cpu",
        _rest("v if v.device.type == 'cpu' else torch.zeros(v.shape, dtype=v.dtype)"),
    ),
    Mutant(
        "finite",
        r"rest\(\) at shape\[0\]=-3, native vertex 0: got \d+ vertices",
        _rest("v + 0 * (params['shape'][:, 0] + 3).log()[:, None, None]"),
    ),
    Mutant(
        "finite",
        r"rest\(\) at the default body, native vertex 7: got 1 vert",
        _rest("v.index_fill(1, torch.tensor([7], device=v.device), torch.nan)"),
    ),
    Mutant(
        "deterministic",
        r"rest\(\) called again, native vertex \d+: got a body",
        _all(_before_rest("self.calls = getattr(self, 'calls', 0) + 1"), _rest("v + 1e-5 * self.calls")),
    ),
    Mutant(
        "deterministic",
        r"rest\(\) called again after other parameters, native",
        _all(
            _before_rest("at = params['shape'].sum(); self.other = getattr(self, 'other', at)"),
            _rest("(v + 1e-3 * (at - self.other), setattr(self, 'other', at))[0]"),
        ),
    ),
    Mutant(
        "deterministic",
        r"rest\(\) of a new generator, native vertex",
        _rest("vars(self).setdefault(len(v), v)"),
    ),
    Mutant(
        "deterministic",
        r"the result of rest\(\), once rest\(\) was called again, native vertex",
        _rest("v if torch.is_grad_enabled() else vars(self).setdefault((v.shape, v.device), 1 * v).copy_(v)"),
    ),
    Mutant("batch-invariant", "random body 0 in a batch of 4", _rest("v + 1e-4 * (v - v.mean(0))")),
    Mutant(
        "inputs-unchanged",
        r"params\['shape'\] after rest\(\): got other values",
        _before_rest("params['shape'].mul_(0.99)"),
    ),
    Mutant(
        "inputs-unchanged",
        r"params\['size'\] after rest\(\): got nothing",
        _rest("v + 0 * params.pop('size')[:, None, None]"),
    ),
    Mutant("no-global-state", "got a change of torch's random state", _before_rest("torch.manual_seed(0)")),
    Mutant(
        "no-global-state",
        "got a change of torch's default dtype",
        _before_build("import torch; torch.set_default_dtype(torch.float64)"),
    ),
    Mutant(
        "no-global-state",
        "got a change of the environment variables",
        _before_build("import os; os.environ['SPECIMEN'] = '1'"),
    ),
    Mutant(
        "no-global-state",
        "got a change of torch's gradient mode",
        _before_build("import torch; torch.set_grad_enabled(False)"),
    ),
    Mutant(
        "no-global-state",
        "got a change of torch's gradient mode",
        _before_rest("torch.set_grad_enabled(False)"),
    ),
    Mutant(
        "no-global-state",
        "got a change of torch's default dtype",
        _in(_GENERATOR, "\n\nclass Specimen", "\ntorch.set_default_dtype(torch.float64)\n\nclass Specimen"),
    ),
    Mutant(
        "no-global-state",
        "got a change of the warning filters",
        _at_import("import warnings; warnings.filterwarnings('ignore', 'specimen')"),
    ),
    Mutant(
        "no-global-state",
        "got a change of the warning filters",
        _before_build("import warnings; warnings.simplefilter('error')"),
    ),
    Mutant(
        "no-own-gradient",
        r"rest\(\): got a tensor that requires a gradient",
        _in(_GENERATOR, "self.template = template.to(", "self.template = torch.nn.Parameter(template).to("),
    ),
    Mutant(
        "no-own-gradient",
        r"linear_basis\(\).basis: got a tensor that requires",
        _in(_GENERATOR, "basis=self.fields,", "basis=torch.nn.Parameter(self.fields),"),
    ),
    Mutant(
        "deterministic",
        r"rest\(\) called again, once its last result was written to, native vertex",
        _rest("vars(self).setdefault(params['shape'].numpy().tobytes(), v)"),
    ),
    Mutant(
        "another-process",
        r"the folder of soma_backend_specimen after building: got cache.bin written, expected nothing",
        _before_build("(FOLDER / 'cache.bin').write_text('1')"),
    ),
    Mutant(
        "another-process",
        "empty folder: got .*FileNotFoundError.*no.npz.*, expected the bodies",
        _all(
            _at_import("import os"),
            _before_build(f"open('no.npz' if {_IN_PROBE} else __file__).close()"),
        ),
    ),
    Mutant(
        "another-process",
        r"rest\(\) in a new process in an empty folder, native vertex \d+: got a body .* mm away",
        _all(_not_linear, _rest("v + 1e-5 * [*{*map(str, range(99))}].index('7')")),
    ),
    Mutant(
        "another-process",
        "empty folder: got an end with exit code 7, expected an end with exit code 0",
        _before_build(f"import atexit, os; {_IN_PROBE} and atexit.register(os._exit, 7)"),
    ),
    Mutant(
        "another-process",
        "empty folder: got a process that runs on: sleep, expected",
        _before_build(f"import os, subprocess; {_IN_PROBE} and subprocess.Popen(['sleep', '99'])"),
    ),
    Mutant(
        "another-process",
        "empty folder: got a thread that runs on: idle, expected",
        _before_build(
            f"import os, threading, time; {_IN_PROBE} and "
            "threading.Thread(target=time.sleep, args=(99,), name='idle').start()"
        ),
    ),
    Mutant(
        "another-process",
        r"memory of .*: got \d+\.\d MiB more after each call",
        _rest("(v, vars(self).setdefault('kept', []).append(1 * v))[0]"),
    ),
    Mutant(
        "gradient",
        "derivative by shape at the defaults: got nan, expected a finite number",
        _all(_not_linear, _rest("v + 1e-6 * (params['shape'] ** 2).sum(1).sqrt()[:, None, None]")),
    ),
    Mutant("linear-basis", "got int, expected a LinearBasis", _returns("linear_basis", "42")),
    Mutant("triangles", "got int, expected whole numbers", _returns("triangles", "42")),
    Mutant("triangles", "got torch.float32", _returns("triangles", "self.faces.float()")),
    Mutant("triangles", "got ids from 1 to", _returns("triangles", "self.faces + 1")),
    Mutant("triangles", "got faces that look inward", _returns("triangles", "self.faces.flip(1)")),
    Mutant("skinning", "skinning returned int, expected a SkinnedModel", _returns("skinning", "42")),
    Mutant("skinning", "weights of skinning are .* sums 1.1", _in(_GENERATOR, _SHARES, f"1.1 * {_SHARES}")),
    Mutant("skinning", "parents of skinning is", _in(_GENERATOR, "(-1, 0, 1)", "(-1, 2, 0)")),
    Mutant("skinning", "joint_names of skinning", _in(_GENERATOR, '"chest", "head"', '"head", "head"')),
    Mutant(
        "skinning", "joints of skinning is a tensor", _in(_GENERATOR, "joints=joints,", "joints=joints[0],")
    ),
    Mutant(
        "skinning", r"skinning\(\).rest, native vertex", _in(_GENERATOR, "rest=rest,", "rest=1.01 * rest,")
    ),
    Mutant(
        "skinning", "hips far outside the body", _in(_GENERATOR, "joints=joints,", "joints=joints + 400,")
    ),
    Mutant("posed", "got int, expected a tensor", _returns("posed", "42")),
    Mutant("posed", r"got int, expected \(2, n, 3\)", _of_no_form),
    Mutant("posed", r"posed\(\) with every joint turned", _in(_GENERATOR, "total + shift[:, None]", "total")),
    Mutant("posed", r"posed\(\) with every", _in(_GENERATOR, "_matrix(turns)", "_matrix(turns.deg2rad())")),
    Mutant("posed", "numbers that are not finite", _in(_GENERATOR, "total + shift", "total / 0 + shift")),
    Mutant(
        "random-poses", "other poses for the same", _in(_GENERATOR, ".manual_seed(seed)", "; random.seed()")
    ),
    Mutant("random-poses", "one pose for all seeds", _in(_GENERATOR, "manual_seed(seed)", "manual_seed(7)")),
    Mutant(
        "random-poses",
        "a change of torch's random state",
        _in(_GENERATOR, "random = torch.Generator().manual_seed(seed)", "random = torch.manual_seed(seed)"),
    ),
    Mutant("pose-vector", "heading: got another motion", _in(_GENERATOR, "= 6, 6, 5", "= 6, 6, 3")),
    Mutant("pose-vector", "got .6, 3, 5.", _in(_GENERATOR, "= 6, 6, 5", "= 6, 3, 5")),
    Mutant("pose-vector", r"own_arrays\(\)\['turn'\]: got \(3,\)", _in(_GENERATOR, "[:, 3:]}", "[0, 3:]}")),
    Mutant("expressions", "expressions returned int", _returns("expressions", "42")),
    Mutant("expressions", "names of expressions", _in(_GENERATOR, '("smile",)', '("smile", "smile")')),
    Mutant("expressions", "the basis of expressions is", _in(_GENERATOR, "self.smile[None]", "self.smile")),
    Mutant("motion-formats", "fps of .* from read", _in(_MOTION, 'float(arrays["fps"])', "30.0")),
    Mutant(
        "motion-formats",
        "rotations of .* from read",
        _in(_MOTION, '"rotations": arrays["specimen_turns"]', '"rotations": 57 * arrays["specimen_turns"]'),
    ),
    Mutant("motion-formats", "got dict from read", _in(_MOTION, "return ModelMotion(", "return dict(")),
    Mutant("own-checks", "soma_motions gave 'x'", _in(_INIT, "return [FORMAT]", 'return ["x"]')),
    Mutant("own-checks", "claims every .npz", _in(_MOTION, 'keys=("specimen_turns", "shift")', "keys=()")),
    Mutant("own-checks", "'amass' is one of the core's", _in(_MOTION, 'name="specimen"', 'name="amass"')),
    Mutant("own-checks", "suffixes of the motion format", _in(_MOTION, '(".npz",)', '("npz",)')),
    Mutant(
        "parameters",
        r"parameter shape\[3\]: got the default body over",
        _in(
            _GENERATOR,
            'torch.tanh(params["shape"]',
            'torch.tanh(size.new_tensor([1, 1, 1, 0]) * params["shape"]',
        ),
    ),
    Mutant(
        "group-defaults",
        "parameter belly: got a body .* mm away when belly=0 is given",
        _in(_GENERATOR, "torch.zeros_like(size))", "torch.zeros_like(size) + 0.5) - 0.5"),
    ),
    Mutant(
        "gradient",
        r"derivative by shape\[\d\]: got 0, expected",
        _in(_GENERATOR, 'params["shape"] / 3', 'params["shape"].detach() / 3'),
    ),
    Mutant(
        "gradient",
        "derivative by size: got .*, expected",
        _in(_GENERATOR, "size.log()", "(size.log() / 2 + size.log().detach() / 2)"),
    ),
    Mutant(
        "neutral-equals-obj",
        r"native vertex 7 of the default body: got .* mm from .*native.obj",
        _in(_GENERATOR, "        x, y, z =", "        template[7] += 0.5\n        x, y, z ="),
    ),
    Mutant(
        "linear-basis",
        r"linear_basis\(\), native vertex \d+ of random body \d: got",
        _in(_GENERATOR, "basis=self.fields", "basis=1.01 * self.fields"),
    ),
    Mutant(
        "linear-basis",
        r"derivative of linear_basis\(\) by shape: got 0, expected .*, that of rest",
        _in(
            _GENERATOR,
            "coefficients=self.coefficients",
            "coefficients=lambda params: self.coefficients(params).detach()",
        ),
    ),
    Mutant(
        "upright",
        r"turned by 90 degrees .* Declare up='\+z', forward='-y'",
        _all(_in(_INIT, 'up="+z"', 'up="+y"'), _in(_INIT, 'forward="-y"', 'forward="+z"')),
    ),
    Mutant("upright", "got the mirror image of the canonical body", lambda made: made.deform(_mirror)),
    Mutant(
        "stature",
        "the default body: got a stature of 1.. m with unit='m'",
        _in(_INIT, 'unit="cm"', 'unit="m"'),
    ),
    Mutant(
        "stature", r"random body \d: got a stature of", _in(_GENERATOR, "size.log()", "(30 * size.log())")
    ),
    Mutant(
        "wrap-coverage",
        r"native mesh .*native.obj, around \[.*\] m: got \d+.\d% of the body's diagonal from the wrap",
        lambda made: made.remesh("native.obj", _brim),
    ),
    Mutant(
        "transfer-neutral",
        r"canonical vertex \d+ of the transferred default body: got \d\.\d\d mm from the wrap",
        _all(
            _ride_on_sliver,
            _in(
                _GENERATOR,
                "        x, y, z =",
                "        template = template.round(decimals=2)\n        x, y, z =",
            ),
        ),
    ),
    Mutant(
        "transfer-random",
        r"random body \d, canonical vertex .*: got 2% of the edges over",
        _all(_rest("torch.where(params['shape'][:, :1, None] > 0.5, v.flip(1), v)"), _not_linear),
    ),
    Mutant("similarity-equivariant", r"canonical vertex \d+: got .* mm of difference", _ride_on_sliver),
    Mutant(
        "joints-inside",
        "the default body, joint Spine1: got a place outside",
        lambda made: made.deform(_cave_in),
    ),
    Mutant(
        "rotations-so3",
        r"the body at shape\[0\]=3, joint \w+: got a matrix inf away",
        _all(_rest("v * (1 + 1e200 * torch.relu(params['shape'][:, :1, None] - 2.99))"), _not_linear),
    ),
    Mutant(
        "zero-is-t-pose", "the default body, bone Hips to Spine1: got", lambda made: made.deform(_hip_forward)
    ),
    Mutant(  # both joints of a foot without extent are open: which one is worse is up to rounding
        "inversion-round-trip",
        "body.*, joint Left(Foot|ToeBase): got",
        lambda made: made.deform(_no_foot),
    ),
)
