import numpy as np
import pytest

from soma_core.cache import atomic_arrays, atomic_text, atomic_write


def test_what_fails_half_way_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "kept.txt"
    atomic_text(path, "whole \u00e9\n")

    def fail(temporary):
        temporary.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        atomic_write(path, fail)
    assert path.read_text(encoding="utf-8") == "whole \u00e9\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("name", ["a.npz", "a.other"])
def test_arrays_come_back_whatever_the_file_is_called(tmp_path, name, compressed):
    arrays = {"x": np.arange(1000.0), "text": np.array("T-pose")}
    atomic_arrays(tmp_path / name, arrays, compressed=compressed)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    with np.load(tmp_path / name) as found:
        assert {key: found[key].tolist() for key in found.files} == {k: v.tolist() for k, v in arrays.items()}
