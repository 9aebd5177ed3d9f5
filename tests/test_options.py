"""Options: names of closed choices, what is refused when they are made, and how they travel."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, replace

import pytest

from soma_core.choices import FitLod, Lod
from soma_core.errors import AssetError, InputError
from soma_core.motion import BackendChoice, ConvertOptions, IdentityChoice, InvertOptions
from soma_core.options import AutogradChoice, ModelOptions, PriorChoice
from soma_core.plugin.errors import BrokenBackendError


def test_names_become_members_of_their_choice():
    assert ModelOptions(lod="xlo").lod is Lod.xlo
    assert InvertOptions(lod="low").lod is FitLod.low
    with pytest.raises(InputError, match="lod: got 'xlo', expected one of mid, low"):
        InvertOptions(lod="xlo")
    with pytest.raises(InputError, match="unit: got 'yard', expected one of m, cm, mm, inch, ft"):
        ConvertOptions(unit="yard")


def test_null_parameters_take_their_default():
    given = {"age": None, "weight": 0.3, "shape": [1, 2]}
    choice = BackendChoice(name="anny", params=given)
    assert choice.params == {"weight": 0.3, "shape": [1, 2]}
    assert "age" in given


def test_options_are_set_once_and_travel():
    options = ConvertOptions(lod="low", identity=IdentityChoice(method="unpose"))
    with pytest.raises(FrozenInstanceError, match="lod"):
        options.lod = "mid"
    for other in (copy.deepcopy(options), pickle.loads(pickle.dumps(options)), replace(options)):
        assert other == options
    assert replace(options, lod="mid").lod is FitLod.mid


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"chunk": 0}, "chunk: got 0, expected at least 1"),
        ({"to": "smplh", "most_betas": 1}, "most_betas: got 1, expected none with to=smplh"),
    ],
)
def test_what_would_change_nothing_is_refused(changes, said):
    with pytest.raises(InputError, match=said):
        ConvertOptions(**changes)


@pytest.mark.parametrize(
    ("options", "given", "said"),
    [
        (
            ConvertOptions,
            {"identity": "unknown"},
            r"identity: got 'unknown' \(str\), .* IdentityChoice",
        ),
        (InvertOptions, {"backend": "anny"}, r"backend: got 'anny' \(str\)"),
        (InvertOptions, {"chunk": 2.5}, r"chunk: got 2.5 \(float\), expected a value of type int"),
        (InvertOptions, {"chunk": True}, r"chunk: got True \(bool\)"),
        (ConvertOptions, {"fps": "abc"}, r"fps: got 'abc' \(str\)"),
        (AutogradChoice, {"rate": float("nan")}, "rate: got nan, expected a number"),
        (PriorChoice, {"limits": {"Head": float("nan")}}, "limits: got nan, expected a number"),
        (BackendChoice, {"name": "anny", "params": None}, r"params: got None \(NoneType\)"),
    ],
)
def test_values_of_another_type_are_refused(options, given, said):
    with pytest.raises(InputError, match=said):
        options(**given)


def test_errors_travel_between_processes():
    """With their text and what they name, those of backends too."""
    for error in (
        InputError("fps", got=-1, expected="more than 0", fix="Pass 30."),
        AssetError("a.npz", cause="file is missing", fix="Get it."),
        BrokenBackendError(who="anny", stage="import", cause="no module", fix="Install it."),
    ):
        for again in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
            assert (type(again), str(again), vars(again)) == (type(error), str(error), vars(error))


def test_what_is_quoted_in_an_error_is_cut() -> None:
    error = InputError("frames", got="9" * 5000, expected="a number", fix="Write it again.")
    assert len(str(error)) < 1000
    assert "(5000 letters)" in str(error)
    assert len(error.got) == 5000
    strange = InputError("joint", got="\x1b[2JHips\ud800", expected="a name", fix="Rename it.")
    assert str(strange) == r"joint: got \x1b[2JHips\ud800, expected a name. Rename it."
    assert len(str(AssetError("a.json", cause="schema is " + "9" * 5000, fix="Write it again."))) < 1000
