"""Export as a stage: a finished calibration as files for other tools, and what an export loses there.

Losses are errors over held-out runs with a parameter left out, rounded, or drawn by itself.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from madoc import simulation
from madoc.errors import MadocError
from madoc.export.draws import save_draws
from madoc.export.onnx_policy import save_onnx
from madoc.export.parameter_files import (
    Exported,
    bam_files,
    is_patch,
    save_bam,
    save_patch,
    save_randomization,
    save_sysid_parameters,
)
from madoc.export.recording import save_recordings, serve_recordings
from madoc.export.trainers import Robot, save_isaac_lab, save_mjlab
from madoc.numpy_policy import NumpyPolicy
from madoc.pipeline.calibrated import Calibrated, read_calibration
from madoc.pipeline.evaluation_stage import find_policies
from madoc.pipeline.orders import NO_PERMISSION, Permission
from madoc.pipeline.refusals import stage_key
from madoc.report.reading import read_arrays
from madoc.simulation import Simulator, configuration
from madoc.simulation.joints import needs_callbacks
from madoc.simulation.mjcf import DRIVES, numbers_of_draws, save_mjcf
from madoc.simulation.write import element_names, nominal_values
from madoc.verdict.evidence import replay_errors

DRAWS = 1000
"""Number of models drawn from the distribution of an estimate; their covariance is within 5 % of its own."""
COMPARED = 20
"""Number of draws whose errors are compared with those of as many drawn parameter by parameter."""


def export_run(
    run: Path,
    out: Path | None = None,
    *,
    onnx: bool = False,
    rerun: bool = False,
    permission: Permission = NO_PERMISSION,
) -> dict[str, Path]:
    """Leave a finished calibration as MJCF, patch, ranges, draws of models and parameters for `mujoco.sysid`.

    If asked, policies are written too, as ONNX, and held-out runs as recordings of Rerun. The folder `out` is `export`
    in the run folder by default.

    Returns:
        The path of each file by its description.

    Raises:
        MadocError: There is no finished calibration, no policy where `onnx` wants one, or a file cannot be written.
    """
    calibrated = read_calibration(run, permission=permission)
    policies = find_policies(run) if onnx else {}
    folder = (out or run / "export").expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MadocError(f"could not make the folder {folder}: {error.strerror or error}") from error
    simulator, result = simulation.make(calibrated.task), calibrated.result
    for parameter in simulator.parameters.parameters:
        if parameter.when is not None:
            raise MadocError(
                f"no model can be exported of which {parameter.name} differs between runs: calibrate the runs of one "
                f"{parameter.when[0]} by themselves for that, without by: in the spec"
            )
    provenance = provenance_of(calibrated)
    model = calibrated.task.compile()
    covariance, draws = calibrated.distribution().covariance, _draws(calibrated)
    own = [nominal_values(model, parameter) for parameter in simulator.parameters.parameters]
    lost = losses(_evidence(calibrated), simulator, result.mean, own, draws)
    exported = [
        Exported(parameter, result.parameters[parameter.name], values, left_out)
        for parameter, values, left_out in zip(simulator.parameters.parameters, own, lost.left_out, strict=True)
    ]
    files = {
        "model": folder / "model.xml",
        "patch": folder / "patch.yaml",
        "randomization ranges": folder / "randomization.yaml",
        "mujoco.sysid parameters": folder / "sysid_parameters.yaml",
        "draws of models": folder / "draws.npz",
        "how to use them": folder / "draws.py",
    }
    if needs_callbacks(simulator.task.model):  # trainers take a model by MuJoCo alone
        files["drives and friction"] = folder / DRIVES
    else:
        files["robot for mjlab"] = folder / "mjlab_robot.py"
        files["robot for Isaac Lab"] = folder / "isaac_lab_robot.py"
    drives = _drives(simulator, result.mean)
    of_drives = bam_files(folder, drives)
    files |= {f"drive {drive.name} for BAM": file for drive, file in zip(drives, of_drives, strict=True)}
    evidence = _evidence(calibrated) if rerun else {}
    targets = {name: folder / (f"policy-{name}.onnx" if len(policies) > 1 else "policy.onnx") for name in policies}
    if out is not None:
        _require_ours(folder, [*files.values(), *targets.values()])
    changes = save_mjcf(simulator, result.mean, files["model"])
    save_patch(files["patch"], exported, provenance, changes=changes, stepping=_stepping(simulator))
    together = None if result.covariance is None else covariance.tolist()
    save_randomization(files["randomization ranges"], exported, provenance, together, independent=lost.independent)
    save_sysid_parameters(files["mujoco.sysid parameters"], exported)
    fields = _leave_draws(folder, simulator, draws)
    if "robot for mjlab" in files:
        robot = replace(_robot(simulator, result.mean, fields), rounded=lost.rounded)
        save_mjlab(files["robot for mjlab"], robot, exported)
        save_isaac_lab(files["robot for Isaac Lab"], robot, exported)
    for drive, file in zip(drives, of_drives, strict=True):
        late = (_late(simulator, result.mean, field, of=drive.name) for field in ("action_delay", "action_lag"))
        save_bam(file, drive, *late)
    for name, file in policies.items():
        save_onnx(NumpyPolicy.load(file), targets[name])
        files[f"policy {name}"] = targets[name]
    if rerun:
        recordings = save_recordings(folder, evidence, simulator, result.mean)
        files |= {f"held-out run {name}": file for name, file in zip(evidence["names"], recordings, strict=True)}
    return files


def view_run(run: Path, *, port: int, permission: Permission = NO_PERMISSION) -> tuple[str, Sequence[object]]:
    """Serve the held-out runs of a calibration to a browser, on a port and the next: the address, and what to keep.

    Raises:
        MadocError: There is no finished calibration with a hold-out, Rerun is not installed, or a port is taken.
    """
    calibrated = read_calibration(run, permission=permission)
    simulator, evidence = simulation.make(calibrated.task), _evidence(calibrated)
    return serve_recordings(evidence, simulator, calibrated.result.mean, port=port)


def _evidence(calibrated: Calibrated) -> dict[str, np.ndarray]:
    """The held-out runs that a calibration has left; empty where it held nothing out."""
    return read_arrays(calibrated.folder / "evidence.npz", "signals", "names", "time", "measured") or {}


def _draws(calibrated: Calibrated) -> Float[np.ndarray, "draws parameters"]:
    """Values of the parameters out of the joint distribution of the estimate."""
    key = stage_key(calibrated.result.seed, "export")
    return np.asarray(calibrated.distribution().draw(key, DRAWS), np.float64)


def _leave_draws(folder: Path, simulator: Simulator, values: Float[np.ndarray, "draws parameters"]) -> list[str]:
    """Leave models of such values, and tell the arrays in which they differ."""
    around = [row.name for row in simulator.parameters.parameters if not row.kind.in_model]
    numbers = numbers_of_draws(simulator, values)
    save_draws(folder, simulator.parameters.names, around, values, numbers)
    return [name for name, (_, rows) in numbers.items() if rows.dtype.kind == "f"]


def _robot(simulator: Simulator, values: Float[np.ndarray, " parameters"], fields: Sequence[str]) -> Robot:
    """What configurations for training say of the robot at the estimate."""
    task, model = simulator.task, simulator.model(values)
    named = [channel.actuator for channel in task.actions] or element_names(model, "actuator")
    physics, lost = configuration.physics_options(model)
    lost += [
        f"{name} floats beside the robot, and an entity has one floating base: take it out of get_spec into its own"
        for name in configuration.floating_beside(model)
    ]
    return Robot(
        name=task.name,
        actuators=configuration.joint_actuators(model, list(dict.fromkeys(named))),
        start=configuration.start_position(model),
        base=configuration.base_pose(model),
        physics=physics,
        decimation=task.frame_skip,
        timestep=simulator.control_step / task.frame_skip,
        delay=_late(simulator, values, "action_delay"),
        fields=fields,
        lost=lost,
    )


def _drives(simulator: Simulator, values: Float[np.ndarray, " parameters"]) -> list[configuration.JointDrive]:
    """The d.c. drives at the estimate; what differs between runs is what it is in a log's first condition."""
    at_rest = {
        channel.actuator: channel.scale * (channel.low + 0.5 * (channel.rest + 1.0) * (channel.high - channel.low))
        for channel in simulator.task.actions
    }
    return configuration.joint_drives(simulator.model(values), at_rest)


def _late(simulator: Simulator, values: Float[np.ndarray, " parameters"], field: str, of: str | None = None) -> float:
    """A delay or a lag, s: that of all actions, and with `of` what the actions of an actuator have alone too."""
    names = {channel.name for channel in simulator.task.actions if channel.actuator == of}
    rows = zip(simulator.parameters.parameters, values.tolist(), strict=True)
    felt = (
        value for row, value in rows if row.field == field and (not row.elements or names.intersection(row.elements))
    )
    return sum(felt, 0.0)


def _require_ours(folder: Path, files: Iterable[Path]) -> None:
    """Raise MadocError where a file to be written is there already, unless an earlier export has left it."""
    taken = [file.name for file in files if file.exists()]
    if taken and not is_patch(folder / "patch.yaml"):
        raise MadocError(f"{folder} holds {', '.join(taken)} already, of no export of madoc; choose another --out")


def provenance_of(calibrated: Calibrated) -> dict[str, object]:
    """Where an estimate comes from, as its run folder says; None or empty where it does not."""
    result, verdict = calibrated.result, calibrated.result.verdict
    stored, whole = calibrated.spec.data, calibrated.folder.resolve()
    return {
        "run": whole.parent.name if whole.name == "calibration" else whole.name,
        "method": result.method,
        "seed": result.seed,
        "verdict": None if verdict is None else asdict(verdict),
        "data": stored and {"paths": list(stored.paths), "rows": stored.rows, "fingerprint": stored.fingerprint},
        "versions": dict(calibrated.spec.versions),
        "warnings": list(result.warnings),
    }


def _stepping(simulator: Simulator) -> dict[str, object]:
    """How the model must be stepped to move as in calibration."""
    task, steps = simulator.task, simulator.task.frame_skip
    channels = [
        {name: getattr(channel, name) for name in ("name", "actuator", "low", "high", "unit")}
        | {"control_per_unit": channel.scale}
        for channel in task.actions
    ]
    held = "held for a control step; the solver starts cold (qacc_warmstart = 0) at each"
    return {
        "control_step_s": simulator.control_step,
        "physics_steps_per_control_step": steps,
        "timestep_s": simulator.control_step / steps,
        "controls": f"values of the channels, {held}" if channels else f"actions in [-1, 1], {held}",
    } | ({"channels": channels} if channels else {})


@dataclass(frozen=True)
class Losses:
    """Clauses with the size of what is lost; each is empty where the run folder does not tell.

    Attributes:
        left_out: Of each parameter, where it stays what the robot's own model has: outside it, nothing.
        rounded: Where the delay is a whole number of physics steps.
        independent: Where parameters are drawn each by itself, beside whole rows of draws.
    """

    left_out: Sequence[str]
    rounded: str = ""
    independent: str = ""


def losses(
    evidence: Mapping[str, np.ndarray],
    simulator: Simulator,
    mean: Float[np.ndarray, " d"],
    own: Sequence[tuple[float, ...]],
    draws: Float[np.ndarray, "draws d"],
) -> Losses:
    """Simulate the held-out runs anew with what is lost, all from the starts of the estimate's simulation.

    `evidence` has the arrays of `verdict.evidence`, or none; `mean` is the estimate in physical units; `own` has the
    values of each parameter in the robot's own model, one for each element.
    """
    nothing = Losses([""] * len(mean))
    if "start" not in evidence:
        return nothing
    step = simulator.control_step / simulator.task.frame_skip
    delays = [row.field == "action_delay" and not row.elements for row in simulator.parameters.parameters]
    alone = np.where(np.eye(len(mean), dtype=bool), [np.mean(values) for values in own], mean)
    whole = np.where(delays, np.round(mean / step) * step, mean)
    some = draws[:COMPARED]
    apart = np.random.default_rng(0).permuted(some, axis=0)  # the same values of each parameter, in another order
    found = replay_errors(evidence, simulator, np.concatenate([mean[None], alone, whole[None], some, apart]))
    if found is None or not 0.0 < found[0] < np.inf:
        return nothing
    ratio = found / found[0]
    joint, single = (np.sqrt(np.mean(part**2)) for part in np.split(found[-2 * len(some) :], 2))
    same = [len(set(values)) == 1 for values in own]
    return Losses(
        [_clause("left out", each) if known else "" for each, known in zip(ratio[1:], same, strict=False)],
        rounded=_clause("so", ratio[1 + len(mean)]) if any(delays) else "",
        independent=f"{single / joint:.3g} times the error of whole rows over held-out runs" if joint < np.inf else "",
    )


def _clause(how: str, ratio: float) -> str:
    told = f"is {ratio:.3g} times as large" if ratio < np.inf else "has no bound, as simulations fail"
    return f"; {how}, the error over held-out runs {told}"
