"""The patch, the ranges and the parameters of `mujoco.sysid`, read back."""

import pytest
from ruamel.yaml import YAML

from madoc.calibration import ParameterEstimate
from madoc.export import Exported, save_patch, save_randomization, save_sysid_parameters
from madoc.parameters import Parameter
from madoc.simulation.mjcf import Change

read_yaml = YAML(typ="safe").load
PROVENANCE = dict(
    run="h0",
    method="least-squares",
    seed=0,
    data={"rows": 10, "fingerprint": "0a"},
    versions={"mujoco": "3.17.0"},
    verdict={"word": "CALIBRATED", "sentence": "it is"},
    warnings=[],
)


def found():
    """A mass with an interval, a damping that two joints share, a delay."""
    return [
        Exported(Parameter("body_mass", "cart", 1, 3), ParameterEstimate(2.5, 0.1, 1, 3, "kg", [2.4, 3.2]), (2.0,)),
        Exported(
            Parameter("dof_damping", ("left", "right"), 0, 2, label="knees"),
            ParameterEstimate(0.5, 0.5, 0, 2, "N·m·s/rad"),
            (0.4, 0.6),
        ),
        Exported(Parameter("action_delay", "", 0, 0.04), ParameterEstimate(0.01, 0.0, 0, 0.04, "s"), (0.0,)),
    ]


def test_a_patch_says_what_changed_and_where_it_comes_from(tmp_path):
    changes = [Change("inertial of body cart", "mass", [2.0], [2.5])]
    save_patch(tmp_path / "p.yaml", found(), PROVENANCE, changes=changes, stepping={"control_step_s": 0.02})
    patch = read_yaml((tmp_path / "p.yaml").read_text())
    assert patch["provenance"]["data"] == {"rows": 10, "fingerprint": "0a"}
    assert patch["provenance"]["verdict"]["word"] == "CALIBRATED" and "warnings" not in patch["provenance"]
    assert patch["model_changes"] == [{"element": "inertial of body cart", "attribute": "mass", "old": 2.0, "new": 2.5}]
    mass, damping, delay = patch["parameters"]
    assert mass == {
        "parameter": "body_mass.cart",
        "field": "body_mass",
        "element": "cart",
        "old": 2.0,
        "new": 2.5,
        "unit": "kg",
        "std": 0.1,
        "interval_95": [2.4, 3.2],
        "searched": [1, 3],
    }
    assert (damping["parameter"], damping["element"], damping["old"]) == ("knees", ["left", "right"], [0.4, 0.6])
    assert "element" not in delay and delay["applied"] == "around the model, which has no place for it"


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("body_mass.cart", 2.4, 3.0), ("knees", 0.0, 0.5 + 1.959963984540054 * 0.5), ("action_delay", 0.01, 0.01)],
)
def test_ranges_are_the_intervals_within_what_was_searched(tmp_path, name, low, high):
    save_randomization(tmp_path / "r.yaml", found(), PROVENANCE, None)
    row = read_yaml((tmp_path / "r.yaml").read_text())["parameters"][name]
    assert (row["low"], row["high"]) == (low, high) and row["low"] <= row["mean"] <= row["high"]
    stds = {"body_mass.cart": 0.7 / 1.959963984540054, "knees": 0.5, "action_delay": 0.0}  # of the wider half
    assert row["std"] == pytest.approx(stds[name])


def test_a_covariance_goes_along_with_its_order(tmp_path):
    rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    save_randomization(tmp_path / "r.yaml", found(), PROVENANCE, rows)
    covariance = read_yaml((tmp_path / "r.yaml").read_text())["covariance"]
    assert covariance == {"order": ["body_mass.cart", "knees", "action_delay"], "rows": rows}


def test_parameters_for_sysid_have_its_six_fields(tmp_path):
    save_sysid_parameters(tmp_path / "s.yaml", found())
    rows = read_yaml((tmp_path / "s.yaml").read_text())
    assert rows["knees"] == {
        "name": "knees",
        "nominal": [0.5],
        "min_value": [0.0],
        "max_value": [2.0],
        "value": [0.5],
        "frozen": False,
    }


def test_mujocos_own_toolbox_reads_them(tmp_path):
    parameter = pytest.importorskip("mujoco.sysid._src.parameter", reason="mujoco[sysid] is not installed")
    save_sysid_parameters(tmp_path / "s.yaml", found())
    read = parameter.ParameterDict.load_from_disk(tmp_path / "s.yaml")
    assert read.as_vector().tolist() == [2.5, 0.5, 0.01]
    assert [ends.tolist() for ends in read.get_bounds()] == [[1.0, 0.0, 0.0], [3.0, 2.0, 0.04]]
