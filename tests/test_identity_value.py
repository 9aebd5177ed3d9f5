"""An identity as a value: indexed, moved, shown."""

import pytest
import torch

from soma_core import SomaLayer


@pytest.fixture(scope="module")
def layer():
    return SomaLayer("soma", lod="xlo", correctives=None)


def test_parts_are_the_identities_they_were_made_of(layer):
    shape = torch.randn(4, 128, generator=torch.Generator().manual_seed(0))
    whole = layer.identity({"shape": shape})
    for index, ids in ((1, [1]), (-1, [3]), (slice(1, 3), [1, 2]), ([3, 0], [3, 0]), (shape[:, 0] > 9, [])):
        part = whole[index]
        assert len(part) == part.batch_size == len(ids)
        for name in ("rest", "bind_world", "fitted_rest", "fitted_world"):
            torch.testing.assert_close(getattr(part, name), getattr(whole, name)[ids], atol=0, rtol=0)
        torch.testing.assert_close(part.params["shape"], shape[ids], atol=0, rtol=0)
    with pytest.raises(IndexError):
        whole[4]
    assert [len(one) for one in whole] == [1] * 4
    posed = layer.pose(whole[2], torch.zeros(3, 77, 3))
    assert posed.vertices.shape == (3, len(whole.rest[0]), 3)
    assert layer.faces.max() == len(whole.rest[0]) - 1


def test_it_is_converted_as_a_whole_and_shown_in_a_line(layer):
    identity = layer.identity().to(torch.float64)
    assert {identity.rest.dtype, identity.bind_world.dtype, identity.params["shape"].dtype} == {torch.float64}
    assert repr(identity) == "Identity(1 of 'soma', 612 vertices, float64, cpu)"
