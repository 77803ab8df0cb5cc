"""Robots by name: found in a checkout of MuJoCo Menagerie, or fetched, and never without being asked."""

import sys
from types import ModuleType, SimpleNamespace

import pytest

from madoc.commands.main import main
from madoc.commands.spec import model_of
from madoc.errors import MadocError
from robots import ARM

FILES = (
    "unitree_go2/go2.xml",
    "unitree_go2/go2_mjx.xml",
    "unitree_go2/scene.xml",
    "franka/panda.xml",
    "franka/hand.xml",
)


@pytest.fixture
def menagerie(tmp_path, monkeypatch):
    """A checkout, which is also what robot_descriptions has fetched."""
    folder = tmp_path / "mujoco_menagerie"
    for name in (*FILES, "other/hand.xml"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(ARM)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    return folder


@pytest.fixture
def descriptions(monkeypatch, tmp_path):
    """The package robot_descriptions, as far as it is used."""
    known = dict.fromkeys(["iiwa_description", "atlas_mj_description", "go2_mj_description"])
    monkeypatch.setitem(sys.modules, "robot_descriptions", ModuleType("robot_descriptions"))
    monkeypatch.setitem(sys.modules, "robot_descriptions._descriptions", SimpleNamespace(DESCRIPTIONS=known))
    found = SimpleNamespace(URDF_PATH=str(tmp_path / "iiwa.urdf"))
    monkeypatch.setitem(sys.modules, "robot_descriptions.iiwa_description", found)


@pytest.mark.parametrize("name", ["go2", "unitree_go2"])
def test_a_robot_is_found_by_its_file_or_its_folder(menagerie, name):
    assert model_of(name) == model_of(name, menagerie=menagerie) == menagerie / "unitree_go2" / "go2.xml"


def test_a_path_stays_what_it_is(menagerie, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("go2.xml", "models/go2"):
        assert str(model_of(name)) == name
    (tmp_path / "go2").write_text(ARM)
    assert str(model_of("go2")) == "go2"


def test_a_name_that_is_none_or_several_is_told_with_what_is_near(menagerie, tmp_path):
    with pytest.raises(MadocError, match=r"hand may be .*franka/hand.xml, .*other/hand.xml; name the file"):
        model_of("hand")
    with pytest.raises(MadocError, match=r"franka may be .*hand.xml, .*panda.xml"):
        model_of("franka")
    with pytest.raises(
        MadocError, match=r"no robot of that name in .*; near it are panda, hand; name a model file, .*--download"
    ):
        model_of("pandas")
    with pytest.raises(MadocError, match=r"there is no folder .*nowhere; name a checkout"):
        model_of("go2", menagerie=tmp_path / "nowhere")


def test_what_is_not_here_is_fetched_where_that_is_asked_for(menagerie, tmp_path, descriptions):
    assert model_of("iiwa", download=True) == tmp_path / "iiwa.urdf"
    assert model_of("go2", download=True) == menagerie / "unitree_go2" / "go2.xml"  # which is here
    with pytest.raises(MadocError, match=r"could not fetch atlas .*is there a network"):
        model_of("atlas", download=True)
    with pytest.raises(MadocError, match="has no robot iiwas; near it are iiwa"):
        model_of("iiwas", download=True)


def test_without_the_package_its_extra_is_named(menagerie, monkeypatch):
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    monkeypatch.delitem(sys.modules, "robot_descriptions._descriptions", raising=False)
    with pytest.raises(
        MadocError, match=r"needs the package robot_descriptions; pip install .madoc-calibration.robots"
    ):
        model_of("iiwa", download=True)


def test_init_writes_the_spec_of_a_named_robot_here(menagerie, tmp_path, monkeypatch, capsys):
    here = tmp_path / "work"
    here.mkdir()
    monkeypatch.chdir(here)
    assert main(["init", "go2"]) == 0
    assert "spec: go2.yaml" in capsys.readouterr().out
    assert "model: ../mujoco_menagerie/unitree_go2/go2.xml" in (here / "go2.yaml").read_text()
    assert main(["spec", "go2.yaml"]) == 0
    assert main(["init", "gone", "--menagerie", str(menagerie)]) == 2
