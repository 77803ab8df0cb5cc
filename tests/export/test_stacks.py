"""Exports in the libraries they are for, where these are installed (`make test-exports`): the same motion as here."""

import importlib.util
import json
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv

from madoc import robots, simulation
from madoc.calibration import CalibrationResult, ParameterEstimate
from madoc.pipeline import export_run

pytestmark = pytest.mark.filterwarnings("ignore")  # theirs are theirs to heed

ARM = """
<mujoco><compiler autolimits="true"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="upper" pos="0.1 0 1"><joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.02" frictionloss="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1"/>
<body name="fore" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.025" mass="0.5"/></body></body></worldbody><actuator>
<position name="shoulder" joint="shoulder" kp="60" kv="3" ctrlrange="-1.5 1.5" forcerange="-20 20"/>
<position name="elbow" joint="elbow" kp="40" kv="2" ctrlrange="-2 2" forcerange="-12 12"/></actuator></mujoco>
"""
LEG = """
<body pos="{0} {1} -0.05"><joint name="{2}" axis="0 1 0" damping="0.2" armature="0.01" frictionloss="0.1"/>
<geom name="{2}" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.03" mass="0.4" friction="0.7"/></body>
"""
LEGS = ("fl", "fr", "hl", "hr")
DOG = (
    """
<mujoco><compiler autolimits="true"/><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="9 9 1"/>
<body name="trunk" pos="0 0 0.34"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="5"/>
"""
    + "".join(LEG.format(0.17 if leg[0] == "f" else -0.17, 0.1 if leg[1] == "l" else -0.1, leg) for leg in LEGS)
    + "</body></worldbody><actuator>"
    + "".join(f'<position name="{leg}" joint="{leg}" kp="40" kv="1" ctrlrange="-1 1"/>' for leg in LEGS)
    + "</actuator></mujoco>"
)
CRANE = """
<mujoco><compiler autolimits="true"/><option timestep="0.004"/><worldbody><body name="cart" pos="0 0.2 1">
<joint name="rail" type="slide" axis="1 0 0" damping="1" stiffness="4"/><geom type="box" size="0.1 0.1 0.05" mass="2"/>
<body name="winch"><joint name="drum" axis="0 1 0" damping="0.02" armature="0.01"/>
<geom type="cylinder" size="0.05 0.05" mass="0.3"/></body>
<body name="load"><joint name="swing" axis="0 1 0" damping="0.01"/>
<geom type="sphere" pos="0 0 -0.4" size="0.05" mass="0.5"/></body></body></worldbody>
<tendon><fixed name="rope"><joint joint="drum" coef="0.05"/><joint joint="swing" coef="0.02"/></fixed></tendon>
<actuator><motor name="push" joint="rail" gear="5" ctrlrange="-1 1"/>
<velocity name="turn" joint="drum" kv="0.2" ctrlrange="-8 8"/>
<motor name="pull" tendon="rope" ctrlrange="-2 2"/></actuator></mujoco>
"""
SPEC = """\
madoc: 1
name: {name}
model: {name}.xml
control_step: 0.02
signals: [{{name: first, reads: position({joint})}}]
actions:
{actions}
parameters:
{parameters}
"""
VALUES = {
    "arm": {"body_mass.fore": 0.62, "actuator_gain.shoulder": 75.0, "dof_armature.elbow": 0.017, "action_delay": 0.008},
    "dog": {"body_mass.trunk": 6.1, "geom_friction.floor": 0.55, "actuator_gain.fl": 52.0, "dof_damping.hr": 0.4},
    "crane": {"jnt_stiffness.rail": 6.0, "body_mass.load": 0.8, "dof_damping.drum": 0.04},
}
"""Of each robot, at the estimate that is exported."""
MODELS = {"arm": ARM, "dog": DOG, "crane": CRANE}
CONTROL_STEPS = 50
"""One second."""


@pytest.fixture(params=list(VALUES))
def exported(request, tmp_path):
    """The folder of a robot's export, its simulator, and what its result says."""
    name, values = request.param, VALUES[request.param]
    (tmp_path / f"{name}.xml").write_text(MODELS[name])
    model = mujoco.MjModel.from_xml_string(MODELS[name])
    driven = [model.actuator(index) for index in range(model.nu)]
    limits = [dict(zip(("low", "high"), each.ctrlrange.tolist(), strict=True)) for each in driven]
    actions = [{"name": each.name, "actuator": each.name, **limit} for each, limit in zip(driven, limits, strict=True)]
    fields = [key.partition(".")[::2] for key in values]
    rows = [
        {"field": field, "low": 0.5 * value, "high": 2.0 * value} | ({"element": element} if element else {})
        for (field, element), value in zip(fields, values.values(), strict=True)
    ]
    written = {"actions": actions, "parameters": rows}
    parts = {key: "\n".join(f"  - {json.dumps(each)}" for each in value) for key, value in written.items()}
    joint = next(model.joint(index).name for index in range(model.njnt) if model.jnt_type[index] >= 2)
    (tmp_path / f"{name}.yaml").write_text(SPEC.format(name=name, joint=joint, **parts))
    task = robots.load(tmp_path / f"{name}.yaml").task
    estimates = {
        each.name: ParameterEstimate(values[each.name], 0.01 * values[each.name], each.low, each.high, each.unit)
        for each in task.parameters.parameters
    }
    result = CalibrationResult("m", task.name, "finished", "", 0, 0.0, 0, [], estimates)
    (tmp_path / "result.json").write_text(json.dumps(result.to_json()))
    (tmp_path / "spec.json").write_text(json.dumps({"task": task.name, "robot": dict(task.source)}))
    export_run(tmp_path / "result.json", tmp_path / "out")
    return tmp_path / "out", simulation.make(task, threads=1), values


def commands(simulator):
    """Commands of a second in the actuators' units, shape (control steps, actuators): at rest first, then sines."""
    time = np.maximum(np.arange(CONTROL_STEPS) * simulator.control_step - 0.1, 0.0)
    high = np.array([channel.high for channel in simulator.task.actions])
    return 0.4 * high * np.sin(np.arange(5, 5 + len(high)) * time[:, None])


def simulated(simulator, values, given):
    """Positions and velocities after each control step, from the reference pose."""
    model, high = simulator.task.model, np.array([channel.high for channel in simulator.task.actions])
    states = simulator.bind(values).roll_out(simulator.initial_state[None, None], (given / high)[None, None])
    return states[0, 0, :, : model.nq + model.nv]


def each_step(given, steps, lag):
    """The command that acts in each physics step, so many of them late."""
    return ([np.zeros(given.shape[1])] * lag + [row for row in given for _ in range(steps)])[: len(given) * steps]


def imported(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_mjlab_moves_as_the_calibrated_simulator_and_draws_whole_models(exported):
    pytest.importorskip("mjlab", reason="mjlab is not installed")
    from mjlab.scene import Scene, SceneCfg
    from mjlab.sim import Simulation, SimulationCfg

    folder, simulator, values = exported
    given = commands(simulator)
    wanted = simulated(simulator, values, given)
    robot, worlds = imported(folder / "mjlab_robot.py"), 3
    scene = Scene(SceneCfg(num_envs=worlds, entities={"robot": robot.ROBOT}), device="cpu")
    compiled = scene.compile()
    robot.PHYSICS.apply(compiled)
    alone = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    place = robot.rows_in_scene("actuator_gainprm", alone, compiled, "robot")
    data, found = mujoco.MjData(compiled), []
    for row in each_step(given, robot.DECIMATION, robot.ACTUATORS[0].delay_max_lag):
        data.ctrl[place] = row
        mujoco.mj_step(compiled, data)
        found.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(found[robot.DECIMATION - 1 :: robot.DECIMATION], wanted, atol=1e-6)

    simulation_ = Simulation(worlds, SimulationCfg(mujoco=robot.PHYSICS), compiled, "cpu")
    simulation_.expand_model_fields(robot.FIELDS)
    scene.initialize(simulation_.mj_model, simulation_.model, simulation_.data)
    scene.reset()
    np.testing.assert_allclose(simulation_.data.qpos[1], alone.qpos0, atol=1e-6)
    entity, found = scene["robot"], []
    for row in given:
        for name, value in zip([alone.actuator(index).name for index in range(alone.nu)], row, strict=True):
            command(entity, robot, alone, name, float(value))
        for _ in range(robot.DECIMATION):
            scene.write_data_to_sim()
            simulation_.step()
            scene.update(dt=compiled.opt.timestep)
        state = [getattr(simulation_.data, field)[2].numpy().astype(float) for field in ("qpos", "qvel")]
        found.append(np.concatenate(state))
    apart = np.abs(np.array(found) - wanted)[:, : alone.nq].max(1)
    print(f"mjlab, float32: positions differ by {apart.max():.2g} at most, {apart[:10].max():.2g} over 0.2 s")
    # In float64, starts that are 1e-7 apart are 0.0044 apart after a second of the dog, which lands on its feet.
    assert apart[:10].max() < 1e-4 and apart.max() < (0.02 if simulator.task.name == "dog" else 1e-5)
    robot.draw_models(SimpleNamespace(sim=simulation_, num_envs=worlds, device="cpu"), None)
    rows = [row_of(simulation_.model, world, compiled, folder) for world in range(worlds)]
    assert len(set(rows)) > 1


def row_of(drawn, world, scene, folder):
    """The row of draws.npz that a world's model is, by the names of the elements, all of whose numbers agree."""
    draws, model = imported(folder / "draws.py"), mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    held, places = [], []
    for kind, count, field in (
        ("body", model.nbody, "body_mass"),
        ("geom", model.ngeom, "geom_friction"),
        ("joint", model.njnt, "jnt_stiffness"),
    ):
        names = {getattr(model, kind)(index).name: index for index in range(count)}
        here = [index for name, index in names.items() if name not in ("", "world")]
        there = [getattr(scene, kind)(f"robot/{name}").id for name in names if name not in ("", "world")]
        numbers = getattr(drawn, field).numpy()
        held.append(numbers[world % len(numbers)][there].ravel())  # what does not differ has one world
        places.append((field, here))
    apart = []
    for row in range(draws.count()):
        draws.put(model, row)
        own = np.concatenate([getattr(model, field)[here].ravel() for field, here in places])
        apart.append(np.abs(np.concatenate(held) - own).max())
    assert min(apart) < 1e-5
    return int(np.argmin(apart))


def command(entity, robot, model, name, value):
    """Set what mjlab wants an actuator to do, by the kind of its command and what it acts on."""
    import torch

    row = model.actuator(name)
    joint = int(row.trntype[0]) == mujoco.mjtTrn.mjTRN_JOINT
    target = (model.joint if joint else model.tendon)(int(row.trnid[0])).name
    (own,) = (each for each in robot.ACTUATORS if target in each.target_names_expr)
    means = getattr(own, "command_field", "position")
    names = entity.joint_names if joint else entity.tendon_names
    write = getattr(entity, f"set_{'joint' if joint else 'tendon'}_{means}_target")
    write(torch.full((entity.data.joint_pos.shape[0], 1), value), torch.tensor([names.index(target)]))


def test_a_gymnasium_environment_of_the_model_moves_as_the_calibrated_simulator(exported):
    folder, simulator, values = exported
    steps = round(simulator.control_step / simulator.task.model.opt.timestep)
    lag = round(values.get("action_delay", 0.0) / simulator.task.model.opt.timestep)
    space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    environment, found = MujocoEnv(str(folder / "model.xml"), 1, space), []
    environment.set_state(environment.init_qpos, environment.init_qvel)
    for row in each_step(commands(simulator), steps, lag):
        environment.do_simulation(row, 1)
        found.append(np.concatenate([environment.data.qpos, environment.data.qvel]))
    wanted = simulated(simulator, values, commands(simulator))
    np.testing.assert_allclose(found[steps - 1 :: steps], wanted, atol=1e-9)


def test_mjx_moves_as_the_calibrated_simulator_with_the_row_that_playground_draws(exported):
    mjx = pytest.importorskip("mujoco.mjx", reason="mujoco-mjx is not installed")
    pytest.importorskip("mujoco_playground", reason="playground is not installed")
    folder, simulator, values = exported
    if "geom_friction.floor" in values or "action_delay" in values:
        pytest.skip("contacts amplify single precision, and a delay is around the model")
    draws, steps = imported(folder / "draws.py"), round(simulator.control_step / simulator.task.model.opt.timestep)
    alone = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    with jax.numpy_rank_promotion("allow"):
        models, in_axes = draws.domain_randomize(mjx.put_model(alone), jax.random.split(jax.random.key(0), 2))

    def second(model):
        def control_step(data, row):
            data = jax.lax.fori_loop(0, steps, lambda _, each: mjx.step(model, each), data.replace(ctrl=row))
            return data, data.qpos

        return jax.lax.scan(control_step, mjx.make_data(model), jnp.asarray(commands(simulator), jnp.float32))[1]

    with jax.numpy_rank_promotion("allow"):
        moved = np.asarray(jax.jit(jax.vmap(second, in_axes=(in_axes,)))(models))
    mass = np.asarray(models.body_mass)[:, alone.body("load").id]
    for found, drawn in zip(moved, mass, strict=True):
        table = draws.read()
        column = [*table["names"]].index("body_mass.load")
        row = int(np.argmin(np.abs(table["values"][:, column] - drawn)))
        own = dict(zip(table["names"].tolist(), table["values"][row].tolist(), strict=True))
        wanted = simulated(simulator, own, commands(simulator))[:, : alone.nq]
        np.testing.assert_allclose(found, wanted, atol=1e-5)
