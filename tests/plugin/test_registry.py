"""The registry: states, isolation and the text of every error."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from soma_core.errors import InputError
from soma_core.plugin import registry as registry_module
from soma_core.plugin.errors import (
    BackendConflictError,
    BackendDisabledError,
    BackendError,
    BackendWarning,
    BrokenBackendError,
    UnknownBackendError,
)
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import FileNeeded, WrapPair
from tests.plugin.fakes import SOUND, FakeEntryPoint, FakeGenerator, SoundPlugin, declares, good, hooks

BUILD = {"device": "cpu", "dtype": "float32"}


def _exit() -> object:
    raise SystemExit(4)


def _missing_module() -> object:
    raise ModuleNotFoundError("No module named 'native_model'")


def _fails(**_: object) -> object:
    raise RuntimeError("no licence key")


def state(registry: Registry, name: str) -> str:
    return next(entry.state for entry in registry.entries() if entry.name == name)


def test_listing_imports_no_plugin() -> None:
    points = [good("a"), good("b")]
    registry = Registry(points)
    assert registry.names() == ("a", "b")
    assert [(e.name, e.distribution, e.version, e.state, e.error) for e in registry.entries()] == [
        ("a", "soma-backend-a", "1.0", "found", None),
        ("b", "soma-backend-b", "1.0", "found", None),
    ]
    assert [point.loads for point in points] == [0, 0]


def test_states_follow_use_and_a_plugin_is_loaded_once() -> None:
    point = good()
    registry = Registry([point, good("other")])
    assert state(registry, "good") == "found"
    assert registry.spec("good") is registry.spec("good")
    assert state(registry, "good") == "declared"
    generator = registry.generator("good", **BUILD)
    assert isinstance(generator, FakeGenerator)
    assert generator.built == {
        "spec": registry.spec("good"),
        "device": "cpu",
        "dtype": "float32",
        "options": {},
    }
    assert state(registry, "good") == "built"
    assert state(registry, "other") == "found"
    assert point.loads == 1


@pytest.mark.parametrize(
    ("point", "stage", "cause"),
    [
        (
            FakeEntryPoint("bad", load=_missing_module),
            "import",
            "ModuleNotFoundError: No module named 'native_model'",
        ),
        (FakeEntryPoint("bad", load=_exit), "import", "SystemExit: 4"),
        (FakeEntryPoint("bad", hooks()), "hooks", "the plugin does not implement the hook soma_backend"),
        (
            FakeEntryPoint("bad", hooks(soma_backend=lambda: SOUND)),
            "hooks",
            "the plugin does not implement the hook soma_generator",
        ),
        (
            FakeEntryPoint("bad", hooks(soma_backend=_exit, soma_generator=lambda: None)),
            "hooks",
            "SystemExit: 4",
        ),
        (FakeEntryPoint("bad", SoundPlugin({"name": "bad"})), "spec", "soma_backend returned dict"),  # type: ignore[arg-type]
        (
            FakeEntryPoint("bad", declares("worse")),
            "spec",
            "the declaration is named 'worse', the entry point 'bad'",
        ),
    ],
)
def test_a_broken_plugin_is_reported_and_hurts_nobody(point: FakeEntryPoint, stage: str, cause: str) -> None:
    registry = Registry([point, good()])
    for _ in range(2):
        with pytest.raises(BrokenBackendError, match=re.escape(cause)) as caught:
            registry.spec("bad")
        assert caught.value.stage == stage
        assert caught.value.who == 'backend "bad" (soma-backend-bad 1.0)'
        assert "pip install --upgrade soma-backend-bad" in caught.value.fix
    assert point.loads == 1
    assert state(registry, "bad") == "broken"
    assert registry.names() == ("good",)
    assert registry.spec("good").name == "good"


def test_text_of_an_error_says_who_what_and_fix() -> None:
    registry = Registry([FakeEntryPoint("bad", load=_exit, version="2.1")])
    with pytest.raises(BackendError) as caught:
        registry.spec("bad")
    assert str(caught.value) == (
        'backend "bad" (soma-backend-bad 2.1): import: SystemExit: 4. '
        "Run: pip install --upgrade soma-backend-bad (SOMA_STRICT=1 shows the whole traceback)"
    )


def test_ctrl_c_is_not_swallowed() -> None:
    def interrupt() -> object:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Registry([FakeEntryPoint("slow", load=interrupt)]).spec("slow")


def test_strict_lets_the_original_through(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOMA_STRICT", "1")
    with pytest.raises(ModuleNotFoundError, match="native_model"):
        Registry([FakeEntryPoint("bad", load=_missing_module)]).spec("bad")


def test_a_failing_build_is_tried_again() -> None:
    outcomes = iter([RuntimeError("no licence key"), FakeGenerator()])

    def build() -> object:
        outcome = next(outcomes)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    registry = Registry([FakeEntryPoint("good", hooks(soma_backend=lambda: SOUND, soma_generator=build))])
    with pytest.raises(BrokenBackendError, match="build: RuntimeError: no licence key"):
        registry.generator("good", **BUILD)
    assert state(registry, "good") == "broken"
    assert registry.names() == ("good",)
    assert callable(registry.generator("good", **BUILD).rest)
    assert state(registry, "good") == "built"


def test_a_generator_needs_a_rest_method() -> None:
    plugin = hooks(soma_backend=lambda: SOUND, soma_generator=lambda: "mesh")
    with pytest.raises(BrokenBackendError, match="soma_generator returned str without a rest method"):
        Registry([FakeEntryPoint("good", plugin)]).generator("good", **BUILD)


def test_checks_of_a_plugin_are_optional_and_isolated() -> None:
    check = SimpleNamespace(id="acme.watertight", run=lambda context: None)

    def registry(**more: Callable[..., object]) -> Registry:
        plugin = hooks(soma_backend=lambda: SOUND, soma_generator=lambda: FakeGenerator(), **more)
        return Registry([FakeEntryPoint("good", plugin)])

    assert registry().checks("good") == ()
    assert registry(soma_checks=lambda: [check]).checks("good") == (check,)
    with pytest.raises(BrokenBackendError, match="hooks: soma_checks gave 'watertight', expected a"):
        registry(soma_checks=lambda: ["watertight"]).checks("good")
    with pytest.raises(BrokenBackendError, match="hooks: SystemExit: 4"):
        registry(soma_checks=_exit).checks("good")


def test_offers_say_who_without_importing_anything() -> None:
    points = [FakeEntryPoint("good", distribution="acme"), FakeEntryPoint("good", distribution="bodies")]
    registry = Registry(points)
    assert [(offer.distribution, offer.version, offer.package) for offer in registry.offers("good")] == [
        ("acme", "1.0", "soma_backend_good"),
        ("bodies", "1.0", "soma_backend_good"),
    ]
    assert [point.loads for point in points] == [0, 0]
    with pytest.raises(UnknownBackendError, match='"other"'):
        registry.offers("other")


def test_unknown_name_suggests_the_closest() -> None:
    with pytest.raises(
        UnknownBackendError, match='"goood".*installed are: good. Did you mean "good"'
    ) as caught:
        Registry([good()]).spec("goood")
    assert caught.value.stage == "lookup"


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("anny", "anny"),
        ("mhr", "mhr"),
        ("smpl", "smpl"),
        ("smplh", "smpl"),
        ("smplx", "smpl"),
        ("garment", "garment"),
    ],
)
def test_unknown_but_known_of_names_the_distribution(name: str, line: str) -> None:
    with pytest.raises(UnknownBackendError, match=f'"{name}".*Run: pip install soma-backend-{line}$'):
        Registry([good()]).spec(name)


def test_a_package_that_is_not_published_is_not_promised() -> None:
    with pytest.raises(UnknownBackendError, match=r"soma-backend-smpl is not published yet\)\. Run"):
        Registry([good()]).spec("smplx")
    with pytest.raises(UnknownBackendError, match=r"from a checkout: pip install \./plugins/anny\)\. Run"):
        Registry([good()]).spec("anny")


def test_unknown_and_nothing_close_points_to_the_list() -> None:
    with pytest.raises(UnknownBackendError, match='"zzz".*installed are: none. See: soma backends list'):
        Registry([]).spec("zzz")


def test_one_name_from_two_distributions_is_a_conflict() -> None:
    points = [
        FakeEntryPoint("good", distribution="acme"),
        FakeEntryPoint("good", distribution="bodies"),
        good("b"),
    ]
    registry = Registry(points)
    assert registry.names() == ("b",)
    assert [(e.distribution, e.state) for e in registry.entries() if e.name == "good"] == [
        ("acme", "conflict"),
        ("bodies", "conflict"),
    ]
    with pytest.raises(
        BackendConflictError, match=r'"good" \(acme 1.0 and bodies 1.0\).*pip uninstall bodies'
    ):
        registry.spec("good")
    assert [point.loads for point in points] == [0, 0, 0]
    assert registry.spec("b").name == "b"


def test_one_distribution_seen_twice_is_one() -> None:
    first = FakeEntryPoint("good", declares(), distribution="Soma_Backend.good", version="2.0")
    stale = FakeEntryPoint("good", declares(), distribution="soma-backend-good", version="1.0")
    registry = Registry([first, stale])
    assert [(e.distribution, e.version, e.state) for e in registry.entries()] == [
        ("Soma_Backend.good", "2.0", "found")
    ]
    registry.spec("good")
    assert (first.loads, stale.loads) == (1, 0)


def test_allow_list_blocks_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOMA_BACKENDS", "a, b")
    registry = Registry([good("a"), good("b"), good("c")])
    assert registry.names() == ("a", "b")
    assert state(registry, "c") == "blocked"
    with pytest.raises(
        BackendDisabledError, match='"c".*SOMA_BACKENDS allows only a, b. Add c to SOMA_BACKENDS'
    ):
        registry.spec("c")


def test_missing_user_file_says_where_and_from_where(tmp_path) -> None:
    needed = FileNeeded(path=tmp_path / "model.npz", description="the model", url="https://example.org/model")
    registry = Registry([FakeEntryPoint("good", declares(files=(needed,)))])
    with pytest.raises(
        BrokenBackendError, match=f"files: the model is missing at {needed.path}.*example.org/model"
    ):
        registry.generator("good", **BUILD)
    needed.path.touch()
    assert callable(registry.generator("good", **BUILD).rest)


def test_missing_wrap_file_is_named(tmp_path) -> None:
    pair = WrapPair(native=tmp_path / "native.obj", wrap=tmp_path / "wrap.obj")
    pair.native.touch()
    registry = Registry([FakeEntryPoint("good", declares(wrap=pair))])
    with pytest.raises(BrokenBackendError, match=f"wrap: the wrap pair names {pair.wrap}"):
        registry.generator("good", **BUILD)


@dataclass
class Options:
    """Options of a fake backend."""

    tolerance: float = 0.5
    mode: str = "fast"

    def __post_init__(self) -> None:
        if self.tolerance < 0:
            raise InputError("backend.options.tolerance", got=self.tolerance, expected=">= 0", fix="Use 0.5")


def test_options_are_checked_and_completed() -> None:
    registry = Registry([FakeEntryPoint("good", declares(options=Options))])
    built = registry.generator("good", **BUILD, options={"mode": "slow"}).built
    assert built["options"] == {"tolerance": 0.5, "mode": "slow"}
    with pytest.raises(InputError, match=r'backend.options.tolerence: got 1, .*Did you mean "tolerance"'):
        registry.generator("good", **BUILD, options={"tolerence": 1})
    with pytest.raises(InputError, match="tolerance: got -1"):
        registry.generator("good", **BUILD, options={"tolerance": -1})
    assert state(registry, "good") == "built"


def test_options_of_a_backend_without_any_are_refused() -> None:
    with pytest.raises(
        InputError,
        match="backend.options.speed: got 3, expected nothing: backend 'good' has no options. Leave",
    ):
        Registry([good()]).generator("good", **BUILD, options={"speed": 3})


def test_newer_api_names_the_core_to_install() -> None:
    with pytest.raises(
        BrokenBackendError, match="written for plugin api 99.*pip install --upgrade soma-body-core"
    ):
        Registry([FakeEntryPoint("good", declares(api=99))]).spec("good")


def test_too_old_api_names_the_plugin_to_update() -> None:
    with pytest.raises(BrokenBackendError, match="written for plugin api 0.*--upgrade soma-backend-good"):
        Registry([FakeEntryPoint("good", declares(api=0))]).spec("good")


def test_older_but_supported_api_warns_and_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry_module, "API_VERSION", 2)
    registry = Registry([FakeEntryPoint("good", declares(api=1))])
    with pytest.warns(BackendWarning, match="written for plugin api 1; soma-body-core .* speaks 1 to 2"):
        assert registry.spec("good").api == 1


def test_default_registry_finds_the_native_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "soma" in default_registry().names()
    assert default_registry() is default_registry()
    monkeypatch.setenv("SOMA_BACKENDS", "nothing")
    assert default_registry().names() == ()
