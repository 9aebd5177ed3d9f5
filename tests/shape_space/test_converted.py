"""Bodies of shards: each once, some held out, the same for any number of processes."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from soma_core.config.schema import TrainShapeConfig
from soma_core.correctives.processes import Processes
from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from soma_core.motion.clips import clip_schema, write_rows
from soma_core.rig import load_canonical
from soma_core.rig.neutral import load_shape_space
from soma_core.shape_space.converted import ConvertedBodies
from soma_core.shape_space.sampling import HELD_OUT, TRAINING
from soma_core.tasks import train_shape

pa = pytest.importorskip("pyarrow")

PEOPLE, CLIPS, HELD = 12, 3, 4
ROUNDING_CM = 1e-3  # float32 metres


def told(person: int, clip: int) -> dict[str, object]:
    """A row of a clip of a person; those of the first have a rest shape instead of parameters."""
    row = {"name": f"{clip}-{person}", "state": "converted", "identity_model_type": "soma", "licence": "CC0"}
    if person:
        return row | {"identity_params": json.dumps({"shape": [person / 6]})}
    rest = load_canonical("mid")[0].vertices.astype(np.float32)
    return row | {"identity_params": "{}", "identity_rest": [vertex.tolist() for vertex in rest]}


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Every person in several clips, in two files, and clips that have no body."""
    folder = tmp_path_factory.mktemp("out") / "shards"
    folder.mkdir()
    for number, parity in enumerate((0, 1)):
        rows = [told(person, clip) for clip in range(CLIPS) for person in range(parity, PEOPLE, 2)]
        rows.insert(1, {"name": "broken", "state": "failed"})
        write_rows(folder / f"{number:06d}.parquet", [pa.Table.from_pylist(rows, schema=clip_schema())])
    return str(folder.parent)


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", correctives=None)


def bodies(shards, layer, *, processes=None, **changes):
    asked: list[tuple[str, object]] = []

    def make(name, options):
        asked.append((name, options))
        return layer

    given = {"held_out": HELD, "most": 100, "batch_sizes": lambda count: [3] * (count // 3) + [count % 3]}
    found = ConvertedBodies(
        [shards], layer=make, seed=1, processes=processes or Processes(), **(given | changes)
    )
    return found, asked


def test_every_body_is_there_once_and_stands_on_the_floor(shards, layer):
    found, asked = bodies(shards, layer)
    assert found.count == PEOPLE - HELD
    assert found.origins == [{"backend": "soma", "licence": "CC0", "bodies": PEOPLE}]
    parts = [found.shapes(HELD_OUT, 0, HELD), *(found.shapes(TRAINING, batch, 3) for batch in range(3))]
    shapes = np.concatenate(parts)
    assert asked == [("soma", None)]
    assert shapes.shape == (PEOPLE, 18056, 3)
    np.testing.assert_allclose(shapes[..., 1].min(1), 0, atol=ROUNDING_CM)
    with torch.no_grad():
        wanted = [layer.identity({"shape": [person / 6]}).rest[0] for person in range(1, PEOPLE)]
        rest = torch.tensor(load_canonical("mid")[0].vertices).float()[None]
        wanted = 100 * torch.stack([layer.identity_from_rest(rest).rest[0], *wanted]).double().numpy()
    wanted[..., 1] -= wanted[..., 1].min(1, keepdims=True)
    gaps = np.abs(shapes[:, None, ::50] - wanted[None, :, ::50]).max((2, 3))
    assert sorted(gaps.argmin(1)) == list(range(PEOPLE))
    assert gaps.min(1).max() < ROUNDING_CM


def test_what_is_held_out_follows_from_the_seed_and_not_from_the_processes(shards, layer):
    alone, _ = bodies(shards, layer)
    gathered: dict[int, object] = {}
    here = threading.Barrier(2)

    class Both(Processes):
        def gathered(self, value):
            gathered[self.rank] = value
            here.wait()
            return [gathered[rank] for rank in range(2)]

    found: dict[int, ConvertedBodies] = {}

    def work(rank):
        found[rank], _ = bodies(shards, layer, processes=Both(rank=rank, count=2))

    threads = [threading.Thread(target=work, args=(rank,)) for rank in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for each in found.values():
        np.testing.assert_array_equal(each._training.rows, alone._training.rows)
        np.testing.assert_array_equal(each._held_out.rows, alone._held_out.rows)
    assert len(gathered[0]) < PEOPLE * CLIPS / 2 + 1  # each has read its own share


def test_fewer_bodies_than_are_held_out_are_named(shards, layer):
    with pytest.raises(InputError, match=r"held_out: got 12 of 12 bodies in .*, expected fewer"):
        bodies(shards, layer, held_out=PEOPLE)


def test_a_space_is_trained_on_shards(shards, layer, tmp_path, monkeypatch):
    monkeypatch.setattr(train_shape, "SomaLayer", lambda *_args, **_kinds: layer)
    monkeypatch.setenv("SOMA_CACHE_DIR", str(tmp_path / "cache"))
    small = {"shards": [shards], "components": 3, "batch": 4, "held_out": HELD, "mirror": False}
    train_shape.run(OmegaConf.merge(OmegaConf.structured(TrainShapeConfig), small), tmp_path)
    metadata = load_shape_space(tmp_path / "shape_space.npz").metadata
    assert (metadata["identities"], metadata["shapes"]) == (PEOPLE - HELD, PEOPLE - HELD)
    assert metadata["trained_on"] == [{"backend": "soma", "licence": "CC0", "bodies": PEOPLE}]
    assert metadata["explained_variance"] > 0.999  # people differ in one direction, all but one of them
