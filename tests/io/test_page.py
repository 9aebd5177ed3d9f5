"""The page holds all that it needs, and a browser shows the body where the model has it."""

import base64
import gzip
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from soma_core.errors import InputError
from soma_core.io.gltf import gltf_bytes
from soma_core.view.page import write_page

VERTEX_TOLERANCE_MM = 0.1
"""Largest distance of a vertex in the page to the body; float32 needs about 0.001."""

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

SWITCHES = [
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--virtual-time-budget=20000", "--window-size=640,480",
]  # fmt: skip


@pytest.fixture(scope="module")
def page(clip, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "body.html"
    write_page(path, replace(clip, name="</script><b>&", metadata=clip.metadata | {"note": "</script>"}))
    return path


def shown(page, script):
    """What a script in the page leaves under ``document.body.dataset.found``, once the body stands."""
    told = (
        "<script>const wrong = []; addEventListener('error', (event) => wrong.push(event.message));"
        "console.error = console.warn = (...all) => wrong.push(all.join(' '));</script>"
    )
    last = "document.body.dataset.wrong = wrong.join('; ');"
    end = f"<script>soma.ready.then(() => {{ {script} {last} }})</script>"
    changed = page.with_name("driven.html")
    text = (
        page.read_text(encoding="utf-8")
        .replace("<body>", "<body>" + told)
        .replace("</body>", end + "</body>")
    )
    changed.write_text(text, encoding="utf-8")
    profile = f"--user-data-dir={page.parent / 'profile'}"
    run = subprocess.run(
        [BROWSER, *SWITCHES, profile, "--dump-dom", changed.as_uri()],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    found = re.search(r'data-found="([^"]*)" data-wrong="([^"]*)"', run.stdout)
    assert found, run.stdout[-500:] + run.stderr[-500:]
    assert found[2] == ""
    return json.loads(html.unescape(found[1]))


def test_everything_is_in_the_page(page, clip):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"""(src|href)\s*=\s*["']""", text.split("<script>")[0])
    assert not re.search(r"\b(import|fetch|XMLHttpRequest)\b", text.split("<script>")[-1])
    packed = re.search(r'<script id="body" type="text/plain">([^<]*)</script>', text)[1]
    glb = gzip.decompress(base64.b64decode(packed))
    assert glb == gltf_bytes(
        replace(clip, name="</script><b>&", metadata=clip.metadata | {"note": "</script>"})
    )
    assert "<title>&lt;/script&gt;&lt;b&gt;&amp;</title>" in text
    assert text.count("</script>") == text.count("<script")


def test_the_same_page_is_the_same_bytes(page, clip, tmp_path):
    for name in ("a.html", "b.html"):
        write_page(tmp_path / name, clip)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_a_browser_shows_the_body_where_it_is(page, clip, posed):
    script = (
        "const found = [];"
        "for (let f = 0; f < soma.frameCount; f++) { soma.setFrame(f); found.push(soma.vertices()); }"
        "document.body.dataset.found = JSON.stringify(found);"
    )
    found = np.array(shown(page, script)).reshape(clip.frame_count, -1, 3)
    assert found.shape == posed.shape
    assert np.linalg.norm(found - posed, axis=2).max() * 1000 < VERTEX_TOLERANCE_MM


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_the_player_plays_stops_and_shows_the_skeleton(page, clip):
    script = (
        "const { player } = soma, button = document.getElementById('play');"
        "const told = [player.playing]; button.click(); told.push(player.playing, button.textContent);"
        "soma.setFrame(soma.frameCount - 1); button.click(); told.push(player.playing, player.place);"
        "document.getElementById('skeleton').click(); told.push(player.view.skeleton.visible);"
        "told.push(document.querySelector('#about summary').textContent);"
        "told.push(document.querySelectorAll('#about dt').length);"
        "document.body.dataset.found = JSON.stringify(told);"
    )
    told = shown(page, script)
    assert told[:6] == [True, False, "Play", True, 0, True]
    assert told[6] == "</script><b>&"
    assert told[7] >= 3


def test_another_suffix_is_refused(clip, tmp_path):
    with pytest.raises(InputError, match=r"body\.htm5.*expected an \.html file"):
        write_page(tmp_path / "body.htm5", clip)
    assert not list(tmp_path.iterdir())
