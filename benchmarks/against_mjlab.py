"""An exported robot in mjlab: the states after a second of commands, against model.xml in MuJoCo alone.

    pip install mjlab  # in an environment of its own: it pins a MuJoCo
    python benchmarks/against_mjlab.py run/export

It prints the largest difference of positions and of velocities, first of the model that mjlab compiles, stepped by
MuJoCo in float64, then of mjlab's own simulation, which is MuJoCo Warp in float32; and how far models that the event
draws are from those of draws.npz.
"""

import argparse
import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import torch
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import Simulation, SimulationCfg

SECONDS = 1.0
WORLDS = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("export", type=Path)
    parser.add_argument("--warp", action="store_true", help="simulate in MuJoCo Warp too; it compiles for minutes")
    arguments = parser.parse_args()
    robot = imported(arguments.export / "mjlab_robot.py")
    scene = Scene(SceneCfg(num_envs=WORLDS, entities={"robot": robot.ROBOT}), device="cpu")
    compiled = scene.compile()
    robot.PHYSICS.apply(compiled)
    alone = mujoco.MjModel.from_xml_path(str(arguments.export / "model.xml"))
    names = [alone.actuator(index).name for index in range(alone.nu)]
    order = robot.rows_in_scene("actuator_gainprm", alone, compiled, "robot")
    commands = commands_of(alone, round(SECONDS / alone.opt.timestep))
    wanted = stepped(alone, commands)
    print(f"actuators: {', '.join(names)}")
    told("MuJoCo on mjlab's model", wanted, stepped(compiled, commands[:, np.argsort(order)]), alone)
    if arguments.warp:
        simulation = Simulation(WORLDS, SimulationCfg(mujoco=robot.PHYSICS), compiled, "cpu")
        simulation.expand_model_fields(robot.FIELDS)
        scene.initialize(simulation.mj_model, simulation.model, simulation.data)
        for row in commands:
            simulation.data.ctrl[:] = torch.as_tensor(row[np.argsort(order)], dtype=torch.float32)
            simulation.step()
        state = [getattr(simulation.data, name)[0].numpy().astype(float) for name in ("qpos", "qvel")]
        told("MuJoCo Warp, float32", wanted, np.concatenate(state), alone)
        environment = SimpleNamespace(sim=simulation, num_envs=WORLDS, device="cpu")
        robot.draw_models(environment, None)
        drawn(robot, simulation, alone, compiled, arguments.export / "draws.npz")


def imported(path: Path) -> "SimpleNamespace":
    """The generated file as a module."""
    spec = importlib.util.spec_from_file_location("mjlab_robot", path)
    if spec is None or spec.loader is None:
        sys.exit(f"cannot import {path}")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module  # type: ignore[return-value]


def commands_of(model: mujoco.MjModel, steps: int) -> np.ndarray:
    """Sines of several frequencies within the middle half of each actuator's range, shape (steps, actuators)."""
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-0.2, 0.2]).T
    time, phase = np.arange(steps) * model.opt.timestep, np.arange(model.nu)
    return (low + high) / 2 + (high - low) / 4 * np.sin(2 * np.pi * (1 + phase / 3) * time[:, None] + phase)


def stepped(model: mujoco.MjModel, commands: np.ndarray) -> np.ndarray:
    """The state (qpos, qvel) after all commands, from the reference pose."""
    data = mujoco.MjData(model)
    for row in commands:
        data.ctrl[:] = row
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel])


def told(what: str, wanted: np.ndarray, got: np.ndarray, model: mujoco.MjModel) -> None:
    apart, moved = np.abs(got - wanted), np.abs(wanted - np.concatenate([model.qpos0, np.zeros(model.nv)]))
    print(
        f"{what}: positions differ by {apart[: model.nq].max():.2g}, velocities by {apart[model.nq :].max():.2g}; "
        f"the robot moved by {moved[: model.nq].max():.2g}"
    )


def drawn(
    robot: SimpleNamespace, simulation: Simulation, alone: mujoco.MjModel, scene: mujoco.MjModel, table: Path
) -> None:
    """How far each world's numbers are from the nearest row of the table, over all fields together."""
    stored, apart = np.load(table), np.zeros((WORLDS, len(np.load(table)["values"])))
    for field in robot.FIELDS:
        row, *inside = np.unravel_index(stored[f"places/{field}"], getattr(alone, field).shape)
        here = robot.rows_in_scene(field, alone, scene, "robot")[row]
        known = here >= 0
        held = getattr(simulation.model, field).numpy()[(slice(None), here[known], *(each[known] for each in inside))]
        numbers = stored[f"numbers/{field}"][:, known]
        scale = np.abs(numbers).max(initial=1e-12)
        apart = np.maximum(apart, np.abs(held[:, None] - numbers[None]).max(-1, initial=0.0) / scale)
    print(f"drawn models: each within {apart.min(1).max():.2g} of a whole row of draws.npz; rows {apart.argmin(1)}")


if __name__ == "__main__":
    main()
