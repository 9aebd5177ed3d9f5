"""The registry: states, isolation and the text of every error."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import pytest

from soma_core import __version__
from soma_core.errors import AssetError, InputError
from soma_core.plugin import registry as registry_module
from soma_core.plugin.errors import (
    BackendConflictError,
    BackendDisabledError,
    BackendWarning,
    BrokenBackendError,
    Stage,
    UnknownBackendError,
)
from soma_core.plugin.installation import newer_core
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import FileNeeded, WrapPair
from tests.plugin.fakes import SOUND, FakeEntryPoint, FakeGenerator, declares, good, hooks
from tests.plugin.installed import Distribution

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


NEWER_CORE = newer_core("soma-backend-bad")
UPGRADE = "Run: pip install --upgrade soma-backend-bad (SOMA_STRICT=1 shows the whole traceback)"


def _plugin(spec: object = SOUND, **more: Callable[..., object]) -> object:
    return hooks(**{"soma_backend": lambda: spec, "soma_generator": lambda: FakeGenerator(), **more})


class WordlessError(Exception):
    """An exception whose text cannot be made."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


def _raises(error: BaseException) -> Callable[[], object]:
    def call() -> object:
        raise error

    return call


BROKEN = {
    "missing module": (
        FakeEntryPoint("bad", load=_missing_module),
        f"import: ModuleNotFoundError: No module named 'native_model'. {UPGRADE}",
    ),
    "exit at import": (FakeEntryPoint("bad", load=_exit), f"import: SystemExit: 4. {UPGRADE}"),
    "several lines": (
        FakeEntryPoint("bad", load=_raises(RuntimeError("first\n  second."))),
        f"import: RuntimeError: first second. {UPGRADE}",
    ),
    "no text": (FakeEntryPoint("bad", load=_raises(AssertionError())), f"import: AssertionError. {UPGRADE}"),
    "no words": (
        FakeEntryPoint("bad", load=_raises(WordlessError())),
        f"import: WordlessError. {UPGRADE}",
    ),
    "generator exit": (
        FakeEntryPoint("bad", load=_raises(GeneratorExit("over"))),
        f"import: GeneratorExit: over. {UPGRADE}",
    ),
    "no hooks": (
        FakeEntryPoint("bad", hooks()),
        f"hooks: the plugin does not implement the hook soma_backend. {UPGRADE}",
    ),
    "misspelt hook": (
        FakeEntryPoint("bad", _plugin(soma_bakend=lambda: SOUND)),
        "hooks: unknown hook 'soma_bakend'. Did you mean \"soma_backend\"?",
    ),
    "wrong signature": (
        FakeEntryPoint("bad", _plugin(soma_generator=lambda devise: None)),
        "hooks: soma_generator takes an argument 'devise' that the hook does not have. "
        'Did you mean "device"?',
    ),
    "not a plugin": (
        FakeEntryPoint("bad", None),
        f"hooks: the plugin does not implement the hook soma_backend. {UPGRADE}",
    ),
    "exit in a hook": (
        FakeEntryPoint("bad", _plugin(soma_backend=_exit)),
        f"hooks: SystemExit: 4. {UPGRADE}",
    ),
    "missing data": (
        FakeEntryPoint("bad", _plugin(soma_backend=_raises(AssetError("a.npz", cause="gone", fix="Get it")))),
        "hooks: a.npz: gone. Get it",
    ),
    "wrong type": (
        FakeEntryPoint("bad", _plugin({"name": "bad"})),
        f"spec: soma_backend returned dict, expected BackendSpec. {UPGRADE}",
    ),
    "another name": (
        FakeEntryPoint("bad", declares("worse")),
        f"spec: the declaration is named 'worse', the entry point 'bad'; they must be equal. {UPGRADE}",
    ),
    "later api": (
        FakeEntryPoint("bad", declares("bad", api=99)),
        f"spec: written for plugin api 99; soma-body-core {__version__} speaks 1 to 2. " + NEWER_CORE,
    ),
    "dropped api": (
        FakeEntryPoint("bad", declares("bad", api=0)),
        f"spec: written for plugin api 0; soma-body-core {__version__} speaks 1 to 2. "
        "Run: pip install --upgrade soma-backend-bad",
    ),
}


@pytest.mark.parametrize(("point", "text"), BROKEN.values(), ids=BROKEN)
def test_a_broken_plugin_is_reported_in_full_and_hurts_nobody(point: FakeEntryPoint, text: str) -> None:
    registry = Registry([point, good()])
    for _ in range(2):
        with pytest.raises(BrokenBackendError) as caught:
            registry.spec("bad")
        assert str(caught.value) == f'backend "bad" (soma-backend-bad 1.0): {text}'
        assert text.startswith(f"{caught.value.stage}: {caught.value.cause}. {caught.value.fix}")
    assert point.loads == 1
    assert state(registry, "bad") == "broken"
    assert registry.names() == ("good",)
    assert registry.spec("good").name == "good"


def test_a_checkout_is_to_be_corrected_not_upgraded(site: Path, tmp_path: Path) -> None:
    checkout = tmp_path / "checkout"
    Distribution(name="bad").install_editable(site, checkout)
    strict = "(SOMA_STRICT=1 shows the whole traceback)"
    with pytest.raises(BrokenBackendError) as caught:
        Registry([FakeEntryPoint("bad", load=_exit)]).spec("bad")
    assert caught.value.fix == f"Correct the plugin in {checkout} {strict}"
    with pytest.raises(BrokenBackendError) as caught:
        Registry([FakeEntryPoint("bad", _plugin(None))]).spec("bad")
    assert caught.value.fix == f"Correct the plugin in {checkout} {strict}"


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
    with pytest.raises(BrokenBackendError, match="soma_generator returned str, no object with a rest method"):
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
        ("mhr_lod6", "mhr"),
        ("smpl", "smpl"),
        ("smplh", "smpl"),
        ("smplx", "smpl"),
        ("garment", "garment"),
        ("toy", "toy"),
    ],
)
def test_unknown_but_known_of_names_the_distribution(name: str, line: str) -> None:
    with pytest.raises(
        UnknownBackendError, match=rf'"{name}".*no index has it: pip install \./plugins/{line}$'
    ):
        Registry([good()]).spec(name)


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


def test_a_missing_user_file_is_no_defect_of_the_plugin(tmp_path) -> None:
    command = "soma backends convert good FILE"
    needed = FileNeeded(path=tmp_path / "model.npz", description="the model", command=command)
    registry = Registry([FakeEntryPoint("good", declares(files=(needed,)))])
    with pytest.raises(BrokenBackendError, match=f"the model is missing at .*Run: {command}$"):
        registry.generator("good", **BUILD)
    assert state(registry, "good") == "declared"
    assert "is missing at" in str(registry.entries()[0].error)


def test_converting_is_the_plugins(tmp_path) -> None:
    def convert(source, output):
        if source.suffix != ".raw":
            raise AssetError(source, cause="is no model", fix="Give one.")
        return [output or source.with_suffix(".npz")]

    plugin = hooks(soma_backend=lambda: SOUND, soma_generator=lambda: FakeGenerator(), soma_convert=convert)
    registry = Registry([FakeEntryPoint("good", plugin), good("other")])
    for name in ("a.raw", "a.txt"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"FILE: got .*typo\.raw, expected a file that is there"):
        registry.convert("good", tmp_path / "typo.raw")
    assert registry.convert("good", tmp_path / "a.raw") == (tmp_path / "a.npz",)
    assert registry.convert("good", tmp_path / "a.raw", tmp_path / "b.npz") == (tmp_path / "b.npz",)
    with pytest.raises(BrokenBackendError, match=r'"good".*files: .*a\.txt: is no model\. Give one'):
        registry.convert("good", tmp_path / "a.txt")
    with pytest.raises(
        BrokenBackendError, match=r"files: it reads its model as it is\. See: soma backends show"
    ):
        registry.convert("other", tmp_path / "a.raw")


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


def test_options_reach_the_generator_as_the_dataclass() -> None:
    registry = Registry([FakeEntryPoint("good", declares(options=Options, api=2))])
    built = registry.generator("good", **BUILD, options={"tolerance": 2}).built
    assert built["options"] == Options(tolerance=2.0, mode="fast")
    with pytest.raises(InputError, match=r'backend.options.tolerence: got 1, .*Did you mean "tolerance"'):
        registry.generator("good", **BUILD, options={"tolerence": 1})
    assert state(registry, "good") == "built"


def test_a_plugin_of_api_1_gets_its_options_as_a_dictionary_and_a_warning() -> None:
    registry = Registry([FakeEntryPoint("good", declares(options=Options, api=1))])
    with pytest.warns(BackendWarning, match="written for plugin api 1; .* speaks 1 to 2. Run: pip"):
        built = registry.generator("good", **BUILD, options={"tolerance": 2}).built
    assert built["options"] == {"tolerance": 2.0, "mode": "fast"}


def test_a_later_api_names_the_core_that_the_plugin_requires(site: Path) -> None:
    Distribution(name="good", requires=("soma-body-core>=4.2",)).install(site)
    with pytest.raises(BrokenBackendError) as caught:
        Registry([FakeEntryPoint("good", declares(api=99))]).spec("good")
    assert "'soma-body-core>=4.2'" in caught.value.fix
    assert "pip install --upgrade" not in caught.value.fix  # no index has it


@dataclass
class FileOptions:
    """The user names a file."""

    model: str = ""


def test_a_typo_of_the_user_in_a_path_is_not_the_plugins_fault(tmp_path: Path) -> None:
    def build(options: FileOptions) -> object:
        return Path(options.model).read_text()

    spec = replace(SOUND, options=FileOptions, api=2)
    plugin = hooks(soma_backend=lambda: spec, soma_generator=build)
    registry = Registry([FakeEntryPoint("good", plugin)])
    named = tmp_path / "modle.npz"
    with pytest.raises(InputError, match=r"backend.options.model: got .*modle.npz \(No such file"):
        registry.generator("good", **BUILD, options={"model": str(named)})
    assert state(registry, "good") == "declared"
    (tmp_path / "other").write_text("")
    with pytest.raises(BrokenBackendError, match="returned str, no object with a rest"):
        registry.generator("good", **BUILD, options={"model": str(tmp_path / "other")})


_PARAMETER = "from soma_core.plugin import Parameter; Parameter"
WRONG_FIXES = {
    "missing dependency": ("import native_model", "Run: pip install native_model"),
    "missing dependency, declared": ("import smplx", "Run: pip install 'smplx>=0.1'"),
    "another name on the index": ("import yamlx", "Run: pip install yamlx"),
    "its own module": ("import soma_backend_good.lost", "Run: pip install --upgrade soma-backend-good"),
    "a name of a later core": ("from soma_core.plugin import Later", "soma-body-core"),
    "a field of a later core": (
        "from soma_core.plugin import Parameter; Parameter(colour=1)",
        "soma-body-core",
    ),
    "a misspelt field": (
        "from soma_core.plugin import Parameter; Parameter(nmae='a')",
        'Did you mean "name"?',
    ),
}


@pytest.mark.parametrize(("body", "fix"), WRONG_FIXES.values(), ids=WRONG_FIXES)
def test_the_fix_is_what_mends_it(site: Path, body: str, fix: str) -> None:
    Distribution(name="good", body=body, requires=("smplx (>=0.1)", "numpy")).install(site)
    with pytest.raises(BrokenBackendError) as caught:
        Registry(allowed=["good"]).spec("good")
    assert caught.value.fix.startswith(fix) or (fix == "soma-body-core" and fix in caught.value.fix)


def test_the_cores_own_name_stays_the_cores(site: Path) -> None:
    Distribution(name="soma", distribution="squatter").install(site)
    registry = Registry(allowed=["soma"])
    assert registry.spec("soma").name == "soma"
    rows = {entry.distribution: entry for entry in registry.entries() if entry.name == "soma"}
    assert rows["soma-body-core"].state == "declared"
    assert rows["squatter"].state == "conflict"
    assert rows["squatter"].error.fix == "Run: pip uninstall squatter"


def test_a_registry_travels_to_another_process() -> None:
    points = (EntryPoint("toy", "soma_backend_toy", "soma_core.backends"),)
    for registry in (Registry(points, allowed=["toy"]), Registry(allowed=["toy"])):
        registry.spec("toy")
        again = pickle.loads(pickle.dumps(registry))
        assert again.names() == ("toy",)
        assert again.spec("toy").name == "toy"


def test_a_plugin_that_names_no_api_was_written_for_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    assert SOUND.api == 1
    monkeypatch.setattr(registry_module, "API_VERSION", 3)
    monkeypatch.setattr(registry_module, "OLDEST_API_VERSION", 2)
    with pytest.raises(BrokenBackendError, match=f"plugin api 1; soma-body-core {__version__} speaks 2 to 3"):
        Registry([good()]).spec("good")


def test_other_stages_are_isolated_and_recorded_as_well() -> None:
    registry = Registry([good(), good("other")])
    registry.generator("good", **BUILD)
    refused = InputError("wrap w.obj", got="3 vertices", expected="4", fix="Export again")
    with pytest.raises(BrokenBackendError) as caught, registry.isolated("good", "wrap"):
        raise refused
    assert str(caught.value) == (
        'backend "good" (soma-backend-good 1.0): wrap: wrap w.obj: got 3 vertices, expected 4. Export again'
    )
    assert caught.value.__cause__ is refused
    assert state(registry, "good") == "broken"
    assert "good" in registry.names()  # it declares: what failed may be mended and tried again
    registry.generator("good", **BUILD)
    assert state(registry, "good") == "built"


def test_a_body_that_cannot_be_made_points_to_the_parameters() -> None:
    registry = Registry([good()])
    with pytest.raises(BrokenBackendError) as caught, registry.isolated("good", "rest"):
        raise RuntimeError("singular")
    assert str(caught.value) == (
        'backend "good" (soma-backend-good 1.0): rest: RuntimeError: singular. Compare the parameters with: '
        "soma backends show good (SOMA_STRICT=1 shows the whole traceback)"
    )


@pytest.mark.parametrize("stage", ["build", "rest"])
def test_what_the_caller_asked_for_is_the_callers_to_mend(stage: Stage) -> None:
    registry = Registry([good()])
    with pytest.raises(InputError, match="shape: got 3"), registry.isolated("good", stage):
        raise InputError("shape", got=3, expected=4, fix="Use 4")
    assert state(registry, "good") == "found"


def test_an_error_of_the_backend_passes_an_outer_stage_unchanged() -> None:
    registry = Registry([FakeEntryPoint("bad", load=_exit)])
    with pytest.raises(BrokenBackendError) as caught, registry.isolated("bad", "rest"):
        registry.spec("bad")
    assert caught.value.stage == "import"


def test_strict_lets_every_stage_through_but_keeps_our_own_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOMA_STRICT", "1")
    with pytest.raises(ZeroDivisionError), Registry([good()]).isolated("good", "wrap"):
        _ = 1 / 0
    with pytest.raises(BrokenBackendError, match="soma_backend returned dict"):
        Registry([FakeEntryPoint("bad", _plugin({}))]).spec("bad")


def test_default_registry_finds_the_native_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "soma" in default_registry().names()
    assert default_registry() is default_registry()
    monkeypatch.setenv("SOMA_BACKENDS", "nothing")
    assert default_registry().names() == ()
