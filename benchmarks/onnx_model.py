"""Time a deployed model on one core: ``python benchmarks/onnx_model.py [--backend NAME] [--lod LOD]``.

Each file is compared with the layer first, and with the layer in float64: two float32 results are further
apart than each is from that. Milliseconds a frame are medians of processor time in onnxruntime; the layer, in
the same process, stands beside them, since machines are busy.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent))

from soma_core import SomaLayer
from soma_core.choices import ModelPart
from soma_core.deploy.onnx_file import open_session, run_session, write_onnx
from soma_core.deploy.program import deploy
from soma_core.tasks.export_model import compare, random_inputs


def _median_ms(call: Callable[[], object], repeats: int = 40) -> float:
    times = []
    for index in range(repeats + 5):
        begin = time.process_time()
        call()
        if index >= 5:
            times.append(time.process_time() - begin)
    return 1e3 * statistics.median(times)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--backend", default="soma")
    parser.add_argument("--lod", default="low")
    options = parser.parse_args()
    torch.set_num_threads(1)
    layer = SomaLayer(options.backend, lod=options.lod)
    exact = SomaLayer(options.backend, lod=options.lod, dtype=torch.float64)
    identity = layer.identity()
    print("| what | batch | mm from the layer | from float64 | onnxruntime, ms a frame | layer, ms a frame |")
    print("|---|---|---|---|---|---|")
    for part in ModelPart:
        model = deploy(layer, part)
        with tempfile.TemporaryDirectory() as folder:
            write_onnx(Path(folder) / "model.onnx", model)
            session = open_session(Path(folder) / "model.onnx")
        for batch in (1, 7, 64):
            inputs = random_inputs(model, layer, batch, np.random.default_rng(batch))
            found = run_session(session, inputs)
            distance = compare(found, inputs, layer, {})
            doubles = {name: value.double() for name, value in inputs.items()}
            true = compare(found, doubles, exact, {})
            rotations, translation, *_ = inputs.values()
            params = {name: value for name, value in inputs.items() if name in [*model.inputs][2:]}
            calls = {
                ModelPart.pose: lambda r=rotations, t=translation: layer.pose(identity, r, t),
                ModelPart.full: lambda p=params, r=rotations, t=translation: layer(p, r, t),
                ModelPart.joints: lambda r=rotations, t=translation: layer.joints(identity, r, t),
            }
            ours = _median_ms(lambda s=session, i=inputs: run_session(s, i)) / batch
            layers = _median_ms(calls[part]) / batch
            print(f"| {part} | {batch} | {distance:.2g} | {true:.2g} | {ours:.2f} | {layers:.2f} |")


if __name__ == "__main__":
    main()
