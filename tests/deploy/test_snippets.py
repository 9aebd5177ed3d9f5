"""The snippets of docs/deploy.md give the body of the layer: in onnxruntime, and in a browser."""

import functools
import http.server
import json
import os
import queue
import re
import shutil
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from soma_core import SomaLayer
from soma_core.deploy.onnx_file import write_onnx
from soma_core.deploy.program import deploy
from tests.bodies import tiny_canonical, tiny_registry

PAGE = Path(__file__).parents[2] / "docs" / "deploy.md"
AGREES_MM = 1e-3
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ORT_WEB = os.environ.get("SOMA_ORT_WEB", "")  # the folder node_modules/onnxruntime-web

_PAGE = """<!doctype html><body><script type="importmap">
{{"imports": {{"onnxruntime-web/wasm": "/ort/ort.wasm.bundle.min.mjs"}}}}
</script><script type="module">
const tell = (found) => fetch("/found", {{method: "POST", body: JSON.stringify(found)}});
addEventListener("unhandledrejection", (event) => tell(String(event.reason)));
try {{
  const ort = await import("onnxruntime-web/wasm");
  ort.env.wasm.numThreads = 1;
  {code}
  await tell(Array.from(vertices.data));
}} catch (error) {{ await tell(String(error)); }}
</script></body>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    for name in ("onnxscript", "onnxruntime"):
        pytest.importorskip(name)
    made = tmp_path_factory.mktemp("model")
    registry = tiny_registry(tmp_path_factory.mktemp("pair"))
    layer = SomaLayer("tiny", dtype=torch.float32, canonical=tiny_canonical(), registry=registry)
    model = deploy(layer)
    write_onnx(made / "model.onnx", model)
    (made / "model.json").write_text(json.dumps(model.about))
    rotations = torch.zeros(1, len(layer.joint_names), 3)
    rotations[0, layer.joint_names.index("LeftArm"), 2] = -1
    with torch.no_grad():
        posed = layer.pose(layer.identity(), rotations, torch.tensor([0.0, 1.0, 0.0]))
    np.save(made / "wanted.npy", posed.vertices.numpy())
    return made


def code(language):
    return re.search(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]


def off_by(folder, found):
    wanted = np.load(folder / "wanted.npy")
    return 1e3 * np.linalg.norm(np.reshape(found, wanted.shape) - wanted, axis=-1).max()


def test_in_python(folder, monkeypatch):
    monkeypatch.chdir(folder)
    names = {}
    exec(compile(code("python"), "<snippet>", "exec"), names)
    assert off_by(folder, names["vertices"]) < AGREES_MM


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="needs Chromium")
@pytest.mark.skipif(not ORT_WEB, reason="needs onnxruntime-web: SOMA_ORT_WEB=node_modules/onnxruntime-web")
def test_in_a_browser(folder, tmp_path):
    shutil.copytree(Path(ORT_WEB) / "dist", folder / "ort", dirs_exist_ok=True,
                    ignore=lambda _, names: [name for name in names if ".wasm" not in name])  # fmt: skip
    lines = [line for line in code("js").splitlines() if not line.startswith("import")]
    (folder / "index.html").write_text(_PAGE.format(code="\n".join(lines)))
    told = queue.Queue()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_POST(self):
            told.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Handler, directory=folder)
    ) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/index.html"
        options = ["--headless", "--no-sandbox", "--no-first-run", f"--user-data-dir={tmp_path / 'profile'}"]
        browser = subprocess.Popen([BROWSER, *options, "--remote-debugging-port=0", address],
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip
        try:
            found = told.get(timeout=120)
        finally:
            browser.kill()
            browser.wait()
            server.shutdown()
    assert isinstance(found, list), found
    assert off_by(folder, found) < AGREES_MM
