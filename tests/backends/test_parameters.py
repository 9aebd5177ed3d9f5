"""Identity parameters: what is accepted, how it is batched, and what is refused by name."""

import numpy as np
import pytest
import torch

from soma_core.backends.parameters import batch_parameters
from soma_core.errors import InputError
from soma_core.plugin.spec import BackendSpec, Parameter

SPEC = BackendSpec(
    name="sample",
    unit="m",
    up="+y",
    forward="+z",
    wrap=None,
    params=(
        Parameter(name="age", default=0.5, range=(0.0, 1.0)),
        Parameter(name="shape", shape=(4,)),
        Parameter(name="bones", shape=(2, 3), default=1.0),
        Parameter(name="nose/wide", group="local"),
    ),
)
CPU = torch.device("cpu")


def batched(params, dtype=torch.float32, device=CPU):
    return batch_parameters(SPEC, params, device=device, dtype=dtype)


def test_defaults_fill_ungrouped_parameters_only():
    result = batched(None)
    assert list(result) == ["age", "shape", "bones"]
    torch.testing.assert_close(result["age"], torch.tensor([0.5]))
    torch.testing.assert_close(result["bones"], torch.ones(1, 2, 3))


def test_grouped_parameter_appears_when_given():
    torch.testing.assert_close(batched({"nose/wide": 1})["nose/wide"], torch.tensor([1.0]))


@pytest.mark.parametrize(
    "value",
    [
        0.25,
        np.float32(0.25),
        np.array(0.25),
        np.array([0.25]),
        [0.25],
        torch.tensor(0.25),
        torch.tensor([0.25]),
    ],
)
def test_one_sample_in_any_container(value):
    torch.testing.assert_close(batched({"age": value})["age"], torch.tensor([0.25]))


def test_python_integers_are_numbers():
    torch.testing.assert_close(batched({"age": 1})["age"], torch.tensor([1.0]))
    torch.testing.assert_close(batched({"shape": [1, 2]})["shape"], torch.tensor([[1.0, 2.0, 0.0, 0.0]]))


def test_batch_of_one_is_broadcast():
    result = batched({"age": [0.1, 0.2, 0.3], "shape": [[1.0, 2.0]]})
    assert result["age"].shape == (3,)
    torch.testing.assert_close(result["shape"], torch.tensor([[1.0, 2.0, 0.0, 0.0]]).expand(3, 4))
    assert result["bones"].shape == (3, 2, 3)


def test_empty_batch_stays_empty():
    assert batched({"shape": torch.zeros(0, 4)})["age"].shape == (0,)


def test_short_vector_equals_the_padded_one():
    short = batched({"shape": [[1.0], [2.0]]})["shape"]
    torch.testing.assert_close(short, torch.tensor([[1.0, 0, 0, 0], [2.0, 0, 0, 0]]))
    torch.testing.assert_close(batched({"shape": []})["shape"], torch.zeros(1, 4))


def test_order_is_the_declared_one():
    assert list(batched({"nose/wide": 0.1, "shape": [1.0], "age": 0.2})) == [
        "age",
        "shape",
        "bones",
        "nose/wide",
    ]


def test_gradient_reaches_every_given_tensor():
    age = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    shape = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64, requires_grad=True)
    result = batched({"age": age, "shape": shape}, dtype=torch.float64)
    (result["age"].sum() + result["shape"].square().sum()).backward()
    torch.testing.assert_close(age.grad, torch.tensor(2.0, dtype=torch.float64))
    torch.testing.assert_close(shape.grad, 2 * shape.detach())


def test_large_finite_values_are_not_mistaken_for_infinity():
    assert batched({"shape": torch.full((2, 4), 3e38)})["shape"].shape == (2, 4)


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({"agee": 0.5}, r"params\['agee'\]: got unknown name 'agee'.*'sample'.*Did you mean 'age'\?"),
        ({"zzz": 0.5}, r"unknown name 'zzz'.*group 'local'.*soma backends show sample"),
        ({"age": [[0.1, 0.2]]}, r"params\['age'\]: got shape \(1, 2\), expected shape \(\) or \(batch,\)"),
        ({"shape": 0.5}, r"params\['shape'\]: got shape \(\), expected shape \(4,\) or \(batch, 4\)"),
        ({"shape": [0.0] * 5}, r"got shape \(1, 5\).*4 number"),
        ({"shape": torch.zeros(2, 5)}, r"got shape \(2, 5\)"),
        ({"bones": torch.zeros(2, 2)}, r"got shape \(1, 2, 2\), expected shape \(2, 3\) or \(batch, 2, 3\)"),
        (
            {"age": [0.1, 0.2], "shape": torch.zeros(3, 4)},
            r"params\['shape'\]: got batch size 3, expected batch size 2 as in params\['age'\]",
        ),
        ({"age": float("nan")}, r"params\['age'\]: got nan at index \(0,\)"),
        ({"shape": [0.0, float("inf")]}, r"params\['shape'\]: got inf at index \(0, 1\)"),
        ({"age": torch.tensor([1])}, r"params\['age'\]: got dtype torch.int64"),
        ({"age": torch.tensor([1j])}, r"got dtype torch.complex64"),
        ({"age": np.array([1])}, r"got dtype int64"),
        ({"age": True}, r"got dtype bool \(True\)"),
        ({"age": 1j}, r"got dtype complex128 \(1j\)"),
        ({"age": "old"}, r"got dtype <U3 \('old'\)"),
        ({"age": None}, r"got dtype object \(None\)"),
        ({"shape": [[1.0], [1.0, 2.0]]}, r"got a ragged list \[\[1.0\], \[1.0, 2.0\]\]"),
        (
            {"age": torch.tensor([0.5], dtype=torch.float64)},
            r"got dtype torch.float64, expected dtype torch.float32",
        ),
        ({"age": torch.zeros(1, device="meta")}, r"got device meta, expected device cpu"),
    ],
)
def test_refused_by_name(params, expected):
    with pytest.raises(InputError, match=f"(?s){expected}"):
        batched(params)
