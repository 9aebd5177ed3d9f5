"""The page: its controls do what they say, an address is found or said, and a browser shows a body."""

import asyncio
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from soma_core.choices import Lod, Product
from soma_core.errors import InputError, SomaError
from soma_core.io import read_motion
from soma_core.io.joint_order import USER_JOINTS
from soma_core.motion.poses import named_pose
from soma_core.options import ViewOptions
from soma_core.plugin.registry import default_registry
from soma_core.viewer.page import Page
from soma_core.viewer.server import close, open_server
from soma_core.viewer.session import Session
from soma_core.viewer.sliders import entries_of

viser = pytest.importorskip("viser", reason="the page needs viser")

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

BYTES_A_VERTEX = 12
SHARE_OF_THE_REST = 1.5
"""Of what is sent while a body moves: positions of vertices, and a little for the floor, time and panel."""


@pytest.fixture(scope="module")
def layers():
    return {}


@pytest.fixture
def page(tmp_path, layers):
    session = Session(ViewOptions(lod=Lod.low))
    session._layers = layers
    session.add("soma")
    server = open_server("127.0.0.1", 0)
    page = Page(server, session, tmp_path)
    page.controls.heard = lambda event: True
    yield page
    close(server)


def settle(page, *, seconds=3.0, until=lambda: False):
    """Let the page do what is queued: callbacks of viser run in threads of its own."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not until():
        page.step(0.05)
    page._changed -= 1
    page.step(0)


def test_a_slider_moves_the_body_and_is_not_lost_when_it_is_found_again(page):
    figure = page.session.figures[0]
    settle(page, seconds=0)
    before = page.scene._nodes["/body0/skin4505"].vertices.copy()
    page.sliders.search("shape 12")
    handles = page.sliders.handles["shape", 12]
    assert len(handles) == 2  # the folded one, and the one that was found
    handles[1].value = 2.5
    settle(page, until=lambda: page.session.value(figure, "shape", 12) == 2.5)
    page.sliders.refresh()
    assert handles[0].value == 2.5
    assert np.abs(page.scene._nodes["/body0/skin4505"].vertices - before).max() > 1e-3
    page.sliders.search("")
    assert len(page.sliders.handles["shape", 12]) == 1


def test_long_groups_are_folded():
    headings = entries_of(default_registry().spec("anny"))
    assert max(map(len, headings.values())) > 200
    assert sum(map(len, headings.values())) == len(default_registry().spec("anny").params)


def test_controls_do_what_they_say(page):
    handles, session = page.handles, page.session
    handles["preset"].value = "squat"
    settle(page, until=lambda: session.motion.source == "squat")
    handles["joint"].value = "LeftForeArm"
    settle(page, until=lambda: page.switches.joint == "LeftForeArm")
    handles["turn_y"].value = -60.0
    settle(page, until=lambda: abs(session.rotation("LeftForeArm")[1] + 60) < 1)
    for name in ("skeleton", "names", "gizmo"):
        handles[name].value = True
    handles["correctives"].value = False
    settle(page, until=lambda: not session.correctives and page.switches.gizmo)
    nodes = page.scene._nodes
    assert all(nodes[name].visible for name in ("/body0/bones", "/body0/name0", "gizmo"))
    place = page.session.shape(session.figures[0]).joints[13] + page.scene._shift
    np.testing.assert_allclose(nodes["gizmo"].position, place, atol=1e-4)


def test_eyes_lie_in_their_sockets_and_turn_with_their_joints(page):
    settle(page, seconds=0)
    eye = page.scene._nodes[f"/body0/eye{USER_JOINTS.index('LeftEye')}"]
    skin = page.scene._nodes["/body0/skin4505"].vertices
    apart = np.linalg.norm(skin - eye.position, axis=1).min()
    assert 0.8 < apart / eye.scale < 1.1
    page.session.turn("LeftEye", np.array([0.0, 30.0, 0.0]))
    page._draw(moving=False)
    np.testing.assert_allclose(eye.wxyz, [np.cos(np.pi / 12), 0, np.sin(np.pi / 12), 0], atol=1e-4)


def test_what_goes_wrong_is_said_and_the_page_goes_on(page, caplog):
    page.handles["path"].value = "/no/such/motion.npz"
    page._todo.put(lambda: page.load(page.output / "missing.npz"))
    page._todo.put(lambda: 1 / 0)
    settle(page, seconds=0)
    assert "missing.npz: file is missing" in caplog.text
    assert "ZeroDivisionError" in caplog.text
    page.handles["settings"].value = "fsp=30"
    with pytest.raises(InputError, match="settings: got fsp=30"):
        page.load(page.output / "missing.npz")


def test_what_is_saved_is_what_is_shown(page):
    page.session.turn("LeftForeArm", np.array([0.0, -35.0, 0.0]))
    paths = [page._save(product, None) for product in (Product.npz, Product.npz, Product.glb)]
    assert [path.name for path in paths] == ["motion.npz", "motion_2.npz", "body.glb"]
    saved = read_motion(paths[0])
    np.testing.assert_allclose(saved.rotations, page.session.motion.rotations, atol=1e-6)
    assert saved.identity["backend"] == "soma"


def test_bodies_come_and_go(page):
    page.handles["backend"].value = "toy"
    page._add_or_remove("add", None)
    assert page.figure.backend == "toy"
    assert ("size", None) in page.sliders.handles
    settle(page, seconds=0)
    assert "/body1/skin4505" in page.scene._nodes
    page._add_or_remove("remove", None)
    page._add_or_remove("remove", None)  # the last one stays
    settle(page, seconds=0)
    assert [figure.backend for figure in page.session.figures] == ["soma"]
    assert "/body1/skin4505" not in page.scene._nodes


def test_a_moving_body_costs_its_vertices(page):
    websockets = pytest.importorskip("websockets")

    async def sent():
        address = f"ws://127.0.0.1:{page.server.get_port()}"
        total = 0
        async with websockets.connect(
            address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None
        ) as socket_:
            with contextlib.suppress(TimeoutError):
                while True:
                    await asyncio.wait_for(socket_.recv(), 0.7)
            for _ in range(frames):
                session.place += 1
                await asyncio.to_thread(page._draw, moving=True)
                page.server.flush()
                await asyncio.sleep(0.05)
            with contextlib.suppress(TimeoutError):
                while True:
                    total += len(await asyncio.wait_for(socket_.recv(), 0.7))
        return total

    from soma_core.motion import load_clip

    frames, session = 10, page.session
    session.show(load_clip())
    page._draw(moving=True)
    found = asyncio.run(sent()) / frames
    vertices = page.session.shape(session.figures[0], moving=True).vertices
    assert vertices.size * 4 == BYTES_A_VERTEX * len(vertices)
    assert BYTES_A_VERTEX * len(vertices) < found < SHARE_OF_THE_REST * BYTES_A_VERTEX * len(vertices)


def test_a_port_that_is_taken_gives_way_and_an_address_that_is_none_is_said(caplog):
    caplog.set_level("INFO")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        server = open_server("127.0.0.1", port)
        try:
            assert server.get_port() > port
            assert f"port {port} is taken" in caplog.text
        finally:
            close(server)
    with pytest.raises(InputError, match=r"host: got 192\.0\.2\.1, expected an address of this machine"):
        open_server("192.0.2.1", 8080)
    with pytest.raises(InputError, match=r"host: got no such host"):
        open_server("no such host", 8080)
    with pytest.raises(InputError, match=r"port: got 70000"):
        open_server("127.0.0.1", 70000)


def test_without_viser_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SomaError, match=r"pip install 'soma-body-core\[view\]'"):
        open_server("127.0.0.1", 0)


@pytest.mark.slow
def test_the_command_prints_its_address_and_ends_on_ctrl_c(tmp_path):
    program = "import sys; from soma_core.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [
        sys.executable, "-c", program, "view", "lod=low", "port=0", f"hydra.run.dir={tmp_path / 'run'}"
    ]  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}

    def interruptible() -> None:  # what runs in the background has Ctrl-C ignored, and its children too
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        preexec_fn=interruptible,
    ) as run:  # fmt: skip
        try:
            lines = iter(run.stderr.readline, "")
            address = next(line for line in lines if line.startswith("open http://127.0.0.1:"))
            run.send_signal(signal.SIGINT)
            out, _ = run.communicate(timeout=60)
        finally:
            run.kill()
    assert "Ctrl-C" in address
    assert run.returncode == 0
    assert out.splitlines() == [str(tmp_path / "run")]


def photograph(page, picture, profile, *, seconds):
    """What Chromium shows of the page once it has had so many seconds of its own time."""
    command = [
        BROWSER, "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
        "--disable-background-networking", "--disable-component-update", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", f"--virtual-time-budget={1000 * seconds}", "--window-size=1400,680",
        f"--user-data-dir={profile}", f"--screenshot={picture}",
        f"http://127.0.0.1:{page.server.get_port()}",
    ]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        end = time.monotonic() + 240
        while run.poll() is None and time.monotonic() < end:
            page.step(0.2)
        run.kill()


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_a_browser_shows_the_bodies_and_their_sliders(layers, tmp_path):
    """SOMA_VIEW_PICTURE=docs/images/view.webp keeps the picture."""
    image = pytest.importorskip("PIL.Image", reason="looks at the picture")
    session = Session(ViewOptions(lod=Lod.low))
    session._layers = layers
    session.add("soma")
    session.add("anny", params={"age": 0.2})
    session.show(named_pose("stride"))
    server = open_server("127.0.0.1", 0)
    page = Page(server, session, tmp_path)
    settle(page, seconds=0)
    picture = tmp_path / "page.png"
    for budget in (25, 60, 120):  # a busy machine draws late
        photograph(page, picture, tmp_path / f"profile{budget}", seconds=budget)
        pixels = np.asarray(image.open(picture).convert("RGB")).astype(int)
        red, green, blue = np.moveaxis(pixels, -1, 0)
        soma = ((green > red + 8) & (green > blue + 8))[:, 320:1040].mean()
        anny = ((red > blue + 25) & (green > blue + 12))[:, 320:1040].mean()
        if soma > 0.01 and anny > 0.005:
            break
    close(server)
    kept = os.environ.get("SOMA_VIEW_PICTURE")
    if kept:
        seen = image.open(picture).convert("RGB").crop((320, 0, 1400, 680))  # beside what viser says of WebGL
        seen.save(kept, quality=72, method=6)
    assert soma > 0.01, "no body of soma"
    assert anny > 0.005, "no body of anny"
    assert ((blue > red + 80) & (blue > 180))[:, 1060:].sum() > 200, "no sliders"
