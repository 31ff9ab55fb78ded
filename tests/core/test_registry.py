"""The registry, with plugins that are really installed and with distributions made up on the spot."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from pgexcite.cli import main
from pgexcite.core import registry
from pgexcite.core.errors import RegistryError
from pgexcite.core.roles import Exciter

HERE = Path(__file__).parents[1]


def install(target, *names):
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*command, "--target", target, *(HERE / name for name in names)], check=True, capture_output=True)


@pytest.fixture(scope="session")
def installed(tmp_path_factory):
    target = tmp_path_factory.mktemp("site")
    install(target, "third_party_plugin", "broken_plugin")
    return target


@pytest.fixture
def plugins(installed, monkeypatch):
    """Both plugin distributions are there, as if installed beside pgexcite."""
    monkeypatch.syspath_prepend(installed)
    registry.refresh()
    yield
    monkeypatch.undo()
    registry.refresh()


@pytest.fixture
def distribution(tmp_path, monkeypatch):
    """A function that makes up a distribution with one entry point."""

    def make(name, group, entry, code=""):
        module = name.replace("-", "_")
        (tmp_path / f"{module}.py").write_text(code)
        info = tmp_path / f"{module}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{entry}\n")
        monkeypatch.syspath_prepend(tmp_path)
        registry.refresh()

    yield make
    monkeypatch.undo()
    registry.refresh()


def test_every_built_in_model_loads():
    broken = [item for item in registry.health() if item.error]
    assert not broken
    assert {item.role for item in registry.health()} <= set(registry.GROUPS)


def test_names_need_no_import():
    code = (
        "import sys; from pgexcite.core import registry; names = registry.names('machine'); "
        "assert 'salient_pole' in names; assert 'casadi' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("role", "name", "expected"),
    [
        ("exciter", "st1b", "did you mean 'st1a'? known: ac1a, constant_field, "),
        ("exciter", "ST1A", "did you mean 'st1a'"),
        ("exciter", "qqqqqq", "no exciter is named 'qqqqqq'; known: ac1a, constant_field"),
        ("exciters", "st1a", "there is no role 'exciters'; did you mean 'exciter'?"),
    ],
)
def test_unknown_names_get_the_nearest(role, name, expected):
    with pytest.raises(RegistryError, match="no ") as caught:
        registry.find(role, name)
    assert expected in str(caught.value)


@pytest.mark.usefixtures("plugins")
def test_third_party_plugin_is_found_like_a_built_in():
    cls = registry.find("exciter", "proportional")
    assert issubclass(cls, Exciter)
    owners = {item.name: item.distribution for item in registry.registrations("exciter")}
    assert owners["proportional"] == "pgexcite-proportional 1.0.0"


@pytest.mark.usefixtures("plugins")
def test_broken_plugin_is_named_with_its_cause_and_breaks_nothing_else():
    with pytest.raises(RegistryError) as caught:
        registry.find("exciter", "broken")
    text = str(caught.value)
    assert "pgexcite-broken 0.1.0" in text
    assert "RuntimeError: its licence has run out" in text
    states = {item.name: item.error for item in registry.health() if item.role == "exciter"}
    assert "its licence has run out" in states["broken"]
    assert states["proportional"] == states["st1a"] == ""


def test_duplicates_are_refused_naming_both(distribution):
    distribution("acme-exciters", "pgexcite.exciters", "st1a = acme_exciters:ST1A")
    with pytest.raises(RegistryError, match="more than once") as caught:
        registry.find("exciter", "st1a")
    assert "pgexcite 0" in str(caught.value)
    assert "acme-exciters 1.0" in str(caught.value)
    assert registry.find("exciter", "sexs")
    assert sum(bool(item.error) for item in registry.health()) == 2


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("class Model: pass", "not a subclass of pgexcite.core.component.Component"),
        ("def Model(): pass", "not a class"),
        (
            "from pgexcite.plugins.machines.classical import Classical as Model",
            "role 'machine'; register it in the group",
        ),
        ("", "AttributeError"),
        ("import a_module_that_is_not_there", "ModuleNotFoundError: No module named 'a_module_that_is_not_there'"),
        ("class Model(", "SyntaxError"),
    ],
)
def test_the_wrong_kind_of_object_is_refused(distribution, code, expected, request):
    name = f"wrong-{abs(hash(request.node.name))}"
    module = name.replace("-", "_")
    distribution(name, "pgexcite.exciters", f"odd = {module}:Model", code)
    with pytest.raises(RegistryError) as caught:
        registry.find("exciter", "odd")
    assert expected in str(caught.value)
    assert f"{name} 1.0" in str(caught.value)


CONFIG = """
include = "{smib}"
[simulation]
t_end = 1.5
[unit.G2.exciter]
model = "{model}"
[record]
sinks = ["config", "summary"]
[[event]]
type = "fault"
t = 0.5
bus = "HV"
R = 0.02
duration = 0.1
"""


def run(tmp_path, model):
    config = tmp_path / "scenario.toml"
    smib = HERE.parent / "configs" / "cases" / "kobbelv_smib.toml"
    config.write_text(CONFIG.format(smib=smib.as_posix(), model=model))
    return CliRunner().invoke(main, ["run", str(config), "--out", str(tmp_path / "out"), "--json"])


@pytest.mark.usefixtures("plugins")
def test_third_party_plugin_runs_from_a_config(tmp_path):
    result = run(tmp_path, "proportional")
    assert result.exit_code == 0, result.stderr
    figures = json.loads(result.stdout)
    assert figures["units"]["G2"]["e_fd_max"] == pytest.approx(5.0, abs=1e-9)  # its ceiling, during the fault
    assert 'model = "proportional"' in (tmp_path / "out" / "config.toml").read_text()


@pytest.mark.usefixtures("plugins")
def test_broken_plugin_in_a_config_is_a_config_error(tmp_path):
    result = run(tmp_path, "broken")
    assert result.exit_code == 3
    assert "unit.G2.exciter.model: the exciter 'broken' of pgexcite-broken 0.1.0 cannot be loaded" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()
