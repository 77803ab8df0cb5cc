"""Run folders as the stages leave them, small, and with everything in them that a page can show."""

import json
from dataclasses import asdict

import numpy as np
from pydantic import TypeAdapter

from madoc.calibration.holdout import AgainstChance, Predicted, PredictionError, PredictionErrors
from madoc.identification.combinations import Combination
from madoc.identification.term_tests import Alternative, MissingTerm

PARAMETERS = {
    "gravity": (-9.9, 0.2, -30.0, 0.0, "m/s²", -9.81),
    "body_mass.torso": (3.4, 0.1, 3.0, 5.0, "kg", 3.53),
    "body_mass.leg": (2.7, 0.1, 2.0, 4.0, "kg", 2.71),
    "dof_damping.leg_joint": (1.2, 0.3, 0.0, 3.0, "N·m·s/rad", 1.0),
}
COMBINED = Combination("mass·length", {"mass": 1.0, "length": 1.0}, "product", 0.5, (0.49, 0.51), "kg·m")
SIGNALS = ("height", "speed")


def write_json(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, ensure_ascii=False))


def spec(**changes):
    """What the calibration was asked."""
    return {
        "command": "calibrate",
        "task": "hopper",
        "physics": "legacy",
        "parameters": {name: [row[2], row[3]] for name, row in PARAMETERS.items()},
        "method": "madoc",
        "data": {"paths": ["../data.npz"], "rows": 5000, "fingerprint": "8c66c3a4"},
        "seed": 0,
        "budget": 3000,
        "truth": {name: row[5] for name, row in PARAMETERS.items()},
        "versions": {"madoc": "0.1.0", "mujoco": "3.17.0"},
    } | changes


def result(**changes):
    """How it ended."""
    rows = {
        name: {"estimate": at, "std": std, "low": low, "high": high, "unit": unit, "interval": [at - std, at + std]}
        for name, (at, std, low, high, unit, _) in PARAMETERS.items()
    }
    deviation = np.array([row[1] for row in PARAMETERS.values()])
    correlation = np.eye(4)
    correlation[1, 2] = correlation[2, 1] = -0.9
    errors = tuple(PredictionError(steps, at, (at / 2, at * 2)) for steps, at in ((1, 0.01), (5, 0.1)))
    holdout = Predicted(
        split="1 of 5 episodes is held out",
        rows=1000,
        episodes=1,
        estimate=dict.fromkeys(PARAMETERS, 0.0),
        values={name: (at, std, unit) for name, (at, std, _, _, unit, _) in PARAMETERS.items()},
        interval_shares=dict.fromkeys(PARAMETERS, 0.1),
        against_chance=(AgainstChance("staying in place", 0.5, 0.002),),
        noise={},
        control_steps=0,
        missing_terms=(
            MissingTerm("Coulomb friction", "dof_frictionloss.hip", 0.2, 0.02, "N·m", 0.3, 10.0, {"gravity": -2.0}),
            MissingTerm("a spring", "jnt_stiffness.hip", 1.0, 0.4, "N·m/rad", 0.01, 2.5, {"gravity": 0.5}),
        ),
        alternatives=(Alternative(("a spring (jnt_stiffness.hip)",), {"gravity": 0.5}, {"gravity": 0.4}),),
        errors=PredictionErrors(errors, errors, errors, errors, 0.04, (0.03, 0.05), 0.04, 100),
    )
    return {
        "method": "madoc",
        "task": "hopper",
        "status": "finished",
        "sentence": "the budget of 3,000 control steps is spent",
        "control_steps": 3128,
        "seconds": 83.4,
        "seed": 0,
        "groups": [["gravity"], ["body_mass.torso", "body_mass.leg"], ["dof_damping.leg_joint"]],
        "parameters": rows,
        "warnings": ["the data carries <noise> & more"],
        "error": {"mean_absolute": 0.1, "mean_percent_of_range": 4.5, "per_parameter": {}},
        "covariance": (correlation * np.outer(deviation, deviation)).tolist(),
        "combinations": [asdict(COMBINED)],
        "verdict": {"word": "CALIBRATED", "sentence": "the hold-out is predicted", "parameters": []},
        "holdout": TypeAdapter(Predicted).dump_python(holdout, mode="json"),
    } | changes


def metrics():
    """Two epochs of cloning, then three of calibration."""
    lines = [
        {"control_steps": 0, "seconds": 1.0 + epoch, "stage": "cloning", "metrics": {"cloning_loss": 1.0 - epoch}}
        for epoch in range(2)
    ]
    for epoch in (1, 2, 3):
        values = {"accuracy_sa": 0.6, "accuracy_sas": 0.7, "reward": -0.5, "reward_size": 1.0, "mismatch": 0.1 / epoch}
        values |= {f"estimate/{name}": row[0] + 1 / epoch for name, row in PARAMETERS.items()}
        values |= {f"std/{name}": row[1] for name, row in PARAMETERS.items()}
        lines.append(
            {"control_steps": 1000 * epoch, "seconds": 2.0 + 10 * epoch, "stage": "calibrating", "metrics": values}
        )
    return "".join(json.dumps(line) + "\n" for line in lines)


def evidence():
    """Two runs of two signals, three times each, but for the last of the second."""
    measured = np.arange(12.0).reshape(2, 3, 2)
    measured[1, 2] = np.nan
    return {
        "signals": np.array(SIGNALS),
        "names": np.array(["first.csv", "<second>.csv"]),
        "fitted": np.array(0),
        "scale": np.array([2.0, 4.0]),
        "time": np.array([0.0, 0.01, 0.02]),
        "measured": measured,
        "before": measured + 1.0,
        "after": measured + 0.1,
        "residual_before": np.array([[1.0, -2.0], [-1.0, 2.0], [np.nan, np.nan]]),
        "residual_after": np.array([[0.1, 0.0], [0.1, 0.0], [0.1, 0.0]]),
    }


def film(*names):
    """A film of three pictures of 4 × 2 pixels, two in a row."""
    sheets = {f"sheet_{index}": np.frombuffer(b"WebP" + bytes([index]), np.uint8) for index in range(len(names))}
    return sheets | {
        "names": np.array(names),
        "time": np.array([0.0, 0.5, 1.0]),
        "size": np.array([4, 2]),
        "columns": np.array(2),
    }


def cost(above):
    """What an error of a parameter costs a policy."""
    return {"half_width": 0.1, "below": 1.0, "below_error": 0.5, "above": above, "above_error": 0.25}


def whole_folder(path):
    """A run of `madoc run` that has everything."""
    write_json(path / "spec.json", {"command": "run", "name": "hopper-medium"})
    folder = path / "calibration"
    write_json(folder / "spec.json", spec())
    write_json(folder / "result.json", result())
    (folder / "metrics.jsonl").write_text(metrics())
    np.savez(folder / "evidence.npz", **evidence())
    vectors = np.random.default_rng(0).normal(size=(4, 16))
    np.savez(folder / "embeddings.npz", names=np.array(list(PARAMETERS)), vectors=vectors)
    policy = {"return": 900.0, "return_std": 20.0, "normalized": 28.0, "length": 400.0}
    write_json(
        path / "evaluation.json",
        {
            "task": "hopper",
            "physics": "legacy",
            "episodes": 3,
            "seed": 0,
            "policies": {"calibrated": policy, "truth": policy},
            "over_draws": {"calibrated": {"at_estimate": 890.0, "mean": 850.0, "worst_tenth": 700.0, "draws": 50}},
            "error_costs": {"calibrated": {name: cost(2.0 * index) for index, name in enumerate(PARAMETERS)}},
        },
    )
    np.savez(folder / "motion.npz", **film("your model as given", "calibrated"))
    np.savez(path / "film.npz", **film("calibrated", "truth"))
    return path


def bare_folder(path, **changes):
    """A run that has ended, with nothing but its spec and its result."""
    kept = {
        name: value
        for name, value in result().items()
        if name not in ("verdict", "holdout", "covariance", "combinations", "error")
    }
    write_json(path / "spec.json", spec(truth=None))
    write_json(path / "result.json", kept | {"groups": [list(PARAMETERS)], "warnings": []} | changes)
    return path
