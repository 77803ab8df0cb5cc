"""Drives, friction, gears, conditions and actions of a spec: what they make of the model, and what is refused."""

import re

import jax
import mujoco
import numpy as np
import pytest

from madoc import robots, simulation
from madoc.calibration import CalibrationProblem, LeastSquares, calibrate
from madoc.commands.main import main
from madoc.data import logs
from madoc.errors import MadocError
from madoc.simulation.callbacks import FRICTION
from madoc.simulation.cpu import CpuSimulator
from madoc.verdict import assess
from own_robots import BOUNCER, BOUNCER_SPEC, CART_SPEC, GEARED, GEARED_SPEC, SERVO, SERVO_SPEC, task_of, write_robot
from robots import PENDULUM

FRICTION_LINE = "friction:\n  - {joint: shaft, model: M1, up_to: 0.2}\nparameters:"
M1 = SERVO_SPEC.replace("parameters:", FRICTION_LINE)
NAMED = SERVO_SPEC.replace("values: [2, 5]}", "values: [2, 5], file_name: p*_}")


def load(folder, spec):
    return robots.load(write_robot(folder, spec, servo=SERVO))


@pytest.mark.parametrize(
    ("model", "terms"),
    [
        ("M1", []),
        ("M2", ["stribeck", "stribeck_speed", "stribeck_exponent"]),
        ("M3", ["load"]),
        ("M4", ["stribeck", "load", "stribeck_load", "stribeck_speed", "stribeck_exponent"]),
    ],
)
def test_another_model_of_friction_is_one_word(tmp_path, model, terms):
    names = load(tmp_path, M1.replace("M1", model)).task.parameters.names
    base = ("drive_strength.goal", "dof_frictionloss.shaft", "dof_damping.shaft")
    assert names == (*base, *(f"friction_{term}.shaft" for term in terms))


def test_a_term_with_a_number_is_not_calibrated_and_one_with_a_line_has_its_range(tmp_path):
    spec = M1.replace("M1, up_to: 0.2", "M3, up_to: 0.2, viscous: 0.03, load: 0.1") + (
        "  - {field: dof_frictionloss, element: shaft, low: 0.01, high: 0.05}\n"
    )
    robot = load(tmp_path, spec)
    assert [(row.name, row.high) for row in robot.task.parameters.parameters[1:]] == [("dof_frictionloss.shaft", 0.05)]
    assert robot.task.model.dof_damping[0] == 0.03
    numbers = dict(zip(FRICTION, robot.task.model.jnt_user[0], strict=True))
    assert (numbers["load_motor"], numbers["load_external"], numbers["stribeck"]) == (0.1, 0.1, 0.0)


def test_terms_may_be_chosen_one_by_one(tmp_path):
    spec = M1.replace("model: M1", "terms: [viscous, load_motor]")
    assert load(tmp_path, spec).task.parameters.names[1:] == ("dof_damping.shaft", "friction_load_motor.shaft")


def line_of(text, spec):
    return next(number for number, line in enumerate(spec.splitlines(), 1) if text in line)


DRIVE = "drive: {kind: dc"
PARAMETER = "  - {field: drive_strength, element: goal, low: 0.5, high: 1.5}"


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("kind: dc", "kind: ac", "expected 'dc' in actions.drive.kind, got 'ac'"),
        (", gain: 0.2", "", "expected gain: of the drive, duty per error of position"),
        ("kt: 0.5", "ktt: 0.5", "unknown key 'ktt'; nearest: kt"),
        ("resistance: 2", "resistance: 0", "expected greater than 0 in actions.drive.resistance, got 0"),
        ("gain: 0.2", "gain: 0.2, duty_limit: 1.5", "expected less than or equal to 1 in actions.drive.duty_limit"),
        ("means: position", "means: torque", "expected means: position, velocity or duty beside drive:"),
        ("means: position", "means: duty", "gain: means nothing beside means: duty"),
        ("means: position", "means: position\n    kp: 3", "kp: means nothing beside drive:"),
        ("gain_from: p", "gain_from: q", "expected the name of a condition, got 'q'; there are: p"),
        ("supply_from: volts", 'supply_from: "on"', "the column 'on' is used for something else already"),
        ("supply_from: volts", "supply_from: angle", "the name 'angle' is taken"),
        ("supply_from: volts", "supply_average: 0.5", "supply_average: means nothing without supply_from:"),
        ("gain: 0.2", "gain: 0.2, saturation: -1", "expected greater than or equal to 0 in actions.drive.saturation"),
        ("values: [2, 5]", "values: [2, 2]", "values: of p has one twice"),
        ("values: [2, 5]", "values: [2, 5], file_name: p", "expected one \\* in file_name:, got 'p'"),
        (PARAMETER, PARAMETER.replace("goal", "volts"), "drive_strength: actuator 'volts' is no such drive"),
        (PARAMETER, PARAMETER.replace("drive_strength", "drive_current_limit"), "give it a current_limit:"),
    ],
)
def test_a_mistake_in_a_drive_is_one_sentence_with_its_line(tmp_path, old, new, sentence):
    spec = SERVO_SPEC.replace(old, new)
    assert spec != SERVO_SPEC
    with pytest.raises(MadocError, match=sentence) as refusal:
        load(tmp_path, spec)
    assert str(refusal.value).startswith("robot.yaml, line ")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("new", "sentence"),
    [
        ("{joint: shaft, up_to: 1}", "expected either model: or terms:, got both or neither"),
        ("{model: M4, up_to: 1}", "expected either joint: or joints:, got both or neither"),
        ("{joint: shaft, model: M7}", "expected 'M1', 'M2', 'M3', 'M4', 'M5' or 'M6' in friction.model, got 'M7'"),
        ("{joint: shaft, model: M4}", "expected up_to:, the largest friction in N·m, as coulomb is to be calibrated"),
        ("{joint: shft, model: M1, up_to: 1}", "expected the name of a joint, got 'shft'; nearest: shaft"),
        ("{joint: shaft, model: M1, up_to: 1, load: 0.1}", "load: is no term of M1, which are coulomb, viscous"),
        ("{joint: shaft, terms: [load, load_motor], up_to: 1}", "load is load_motor in one; keep one"),
        ("{joints: [shaft, shaft], model: M1, up_to: 1}", "the friction of 'shaft' is said already; say it once"),
    ],
)
def test_a_mistake_in_friction_is_one_sentence_with_its_line(tmp_path, new, sentence):
    spec = M1.replace("{joint: shaft, model: M1, up_to: 0.2}", new)
    with pytest.raises(MadocError, match=sentence) as refusal:
        load(tmp_path, spec)
    assert str(refusal.value).startswith(f"robot.yaml, line {line_of(new, spec)}: ")


GEAR = "{joint: shaft, stiffness: 100, damping: 0.5, backlash: 0.02, encoder: motor}"


def load_geared(folder, spec, model=GEARED):
    return robots.load(write_robot(folder, spec, geared=model))


@pytest.mark.parametrize(
    ("new", "sentence"),
    [
        ("{joint: shaft, stiffness: 100, damping: 0.5}", "expected encoder: in this part of gears"),
        (GEAR.replace("motor", "wheel"), "expected 'motor' or 'link' in gears.encoder, got 'wheel'"),
        (GEAR.replace("stiffness: 100", "stiffness: 0"), "expected greater than 0 in gears.stiffness, got 0"),
        (GEAR.replace("backlash: 0.02", "armature: 0"), "expected greater than 0 in gears.armature, got 0"),
        (GEAR.replace("backlash", "play"), "unknown key 'play'"),
        (GEAR.replace("joint: shaft", "joint: shft"), "expected the name of a joint, got 'shft'; nearest: shaft"),
        (f"{GEAR}\n  - {GEAR}", "the name 'shaft_gear' of what a gear inserts is taken; say a gear once"),
        (GEAR.replace("stiffness: 100", "stiffness: 1e5"), "too stiff or too damped for a timestep of 0.001 s; give"),
        (
            GEAR.replace("damping: 0.5", "damping: 50"),
            "timestep: of at most 0.00013 s, or a smaller stiffness or damping",
        ),
    ],
)
def test_a_mistake_in_a_gear_is_one_sentence_with_its_line(tmp_path, new, sentence):
    spec = GEARED_SPEC.replace(GEAR, new)
    assert spec != GEARED_SPEC
    with pytest.raises(MadocError, match=sentence) as refusal:
        load_geared(tmp_path, spec)
    line = line_of("joint: sh", spec[spec.index("gears:") :]) + spec[: spec.index("gears:")].count("\n")
    assert str(refusal.value).startswith(f"robot.yaml, line {line + (new.count('joint') - 1)}: ")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            'armature="0.02"',
            "",
            "expected armature:, the inertia of the motor, as the model says none of 'shaft'",
        ),
        ("<inertial", '<joint name="b" axis="1 0 0"/><inertial', "expected the last joint of its body, got 'shaft'"),
    ],
)
def test_a_joint_that_cannot_have_a_gear_is_refused(tmp_path, old, new, sentence):
    with pytest.raises(MadocError, match=sentence):
        load_geared(tmp_path, GEARED_SPEC, GEARED.replace(old, new))


def test_a_gear_may_say_the_inertia_of_its_motor(tmp_path):
    spec = GEARED_SPEC.replace("stiffness: 100", "armature: 0.05, stiffness: 100")
    assert load_geared(tmp_path, spec).task.model.dof_armature.tolist() == [0.05, 0.0]


def test_a_servo_of_mujoco_cannot_read_an_encoder_behind_a_gear(tmp_path):
    servo = "kp: 5, low: -1, high: 1}"
    start, end = GEARED_SPEC.index("  - name: goal"), GEARED_SPEC.index("gears:")
    spec = f"{GEARED_SPEC[:start]}  - {{name: goal, joint: shaft, means: position, {servo}\n{GEARED_SPEC[end:]}"
    load_geared(tmp_path, spec)
    with pytest.raises(MadocError, match="give the action of 'shaft' a drive:, which reads the encoder, or say"):
        load_geared(tmp_path, spec.replace("encoder: motor", "encoder: link"))


def test_what_a_gear_inserts_has_nothing_of_the_models_defaults_nor_of_its_keyframes(tmp_path):
    defaults = '<default><joint armature="0.3" damping="1" frictionloss="0.1" stiffness="2"/></default>'
    model = GEARED.replace("<worldbody>", f"{defaults}<worldbody>")
    model = model.replace("</worldbody>", '</worldbody><keyframe><key qpos="0.3"/></keyframe>')
    made = load_geared(tmp_path, GEARED_SPEC, model).task.model
    assert made.dof_damping[0] == 1.0
    for numbers in (made.dof_armature, made.dof_damping, made.dof_frictionloss, made.jnt_stiffness):
        assert numbers[1] == 0.0
    assert made.nkey == 0


def test_a_policy_cannot_choose_its_supply(tmp_path):
    with pytest.raises(MadocError, match="a policy cannot be learnt where drives take on, volts, p from the log"):
        load(tmp_path, SERVO_SPEC + 'reward: "-angle ** 2"\n')


CART_BY = CART_SPEC.replace("parameters:\n", "conditions:\n  - {name: load, values: [0, 3]}\nparameters:\n", 1).replace(
    "element: cart, low", "element: cart, by: load, low", 1
)


def test_a_parameter_by_a_condition_has_a_value_for_each_that_moves_only_its_runs(tmp_path):
    """F = m a: of 2 kg where the load is 0, of 4 kg where it is 3, of the model's own 1 kg where it is another."""
    task = robots.load(write_robot(tmp_path, CART_BY)).task
    assert [name for name in task.parameters.names if name.startswith("body_mass")] == [
        "body_mass.cart[load=0]",
        "body_mass.cart[load=3]",
    ]
    simulator = CpuSimulator(task.with_parameters(["body_mass.cart[load=0]", "body_mass.cart[load=3]"]), threads=1)
    system = simulator.bind(np.array([[2.0, 4.0], [3.0, 4.0]]))
    middle, half = task.action_ranges
    action = (np.array([[1.0, 0.0], [1.0, 3.0], [1.0, 1.0]]) - middle) / half
    for _ in range(2):
        after = system.step(np.zeros((2, 3, 2)), np.stack([action, action]))
        np.testing.assert_allclose(after[:, :, 1], 0.02 / np.array([[2.0, 4.0, 1.0], [3.0, 4.0, 1.0]]), rtol=1e-12)
        system = system.replaced(np.array([1]), np.array([[3.0, 4.0]]))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("by: load", "by: lode", "expected the name of a condition, got 'lode'; nearest: load"),
        ("field: body_mass, element: cart", "field: action_delay", "by: means nothing beside action_delay"),
    ],
)
def test_a_mistake_in_by_is_one_sentence(tmp_path, old, new, sentence):
    assert old in CART_BY
    with pytest.raises(MadocError, match=sentence):
        robots.load(write_robot(tmp_path, CART_BY.replace(old, new)))


def test_a_condition_that_nothing_uses_is_told(tmp_path):
    assert robots.load(write_robot(tmp_path, CART_BY)).notes == ()
    (note,) = robots.load(write_robot(tmp_path, CART_BY.replace("by: load, ", ""))).notes
    assert note == "the condition load has no effect: no by: and no gain_from: names it"


def written(folder, name, rate=1.0):
    rows = "".join(f"{0.01 * row:.2f},{0.01 * row * rate},{rate},{row % 2},1,12\n" for row in range(5))
    (folder / name).write_text("time,angle,rate,goal,on,volts\n" + rows)
    return folder / name


def test_a_condition_is_read_from_the_name_of_its_file(tmp_path):
    robot = load(tmp_path, NAMED)
    data = logs.read([written(tmp_path, "p2_a.csv"), written(tmp_path, "swing-p5_.csv", rate=2.0)], robot)
    low, high = robot.actions[3].low, robot.actions[3].high
    given = low + (np.asarray(data.transitions.action)[:, 3] + 1.0) / 2.0 * (high - low)
    np.testing.assert_allclose(given, [2.0] * 4 + [5.0] * 4, rtol=1e-12)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ((3, 3, 3, 3, 3), "expected p in run.csv to be one of 2, 5, got 3; add it to values: in the spec"),
        ((2, 2, 5, 5, 5), "expected one value of p throughout run.csv, got 2 and 5; split the run where it changes"),
    ],
)
def test_a_condition_in_a_column_has_one_of_its_values_throughout_a_run(tmp_path, values, sentence):
    rows = "".join(f"{0.01 * row:.2f},{0.01 * row},1,0,1,12,{value}\n" for row, value in enumerate(values))
    (tmp_path / "run.csv").write_text("time,angle,rate,goal,on,volts,p\n" + rows)
    with pytest.raises(MadocError, match=sentence):
        logs.read([tmp_path / "run.csv"], load(tmp_path, SERVO_SPEC))


def test_the_supply_is_the_mean_of_its_readings_around_a_row(tmp_path):
    """Half a width of 0.01 s holds the readings before and after; at the ends of a run there is one of them."""
    path = written(tmp_path, "p2_a.csv")
    rows = path.read_text().split("\n")
    swinging = [
        rows[0],
        *(row.removesuffix("12") + volts for row, volts in zip(rows[1:6], ("10", "16", "10", "16", "10"), strict=True)),
    ]
    path.write_text("\n".join(swinging))
    robot = load(tmp_path, NAMED.replace("supply_from: volts", "supply_from: volts, supply_average: 0.021"))
    column = [channel.name for channel in robot.actions].index("volts")
    low, high = robot.actions[column].low, robot.actions[column].high
    given = low + (np.asarray(logs.read([path], robot).transitions.action)[:, column] + 1.0) / 2.0 * (high - low)
    np.testing.assert_allclose(given, [13.0, 12.0, 14.0, 12.0], rtol=1e-12)


@pytest.mark.parametrize(("name", "got"), [("p3_a.csv", "got 3;"), ("other.csv", "got no number there;")])
def test_a_file_of_a_condition_that_the_spec_does_not_list_is_refused(tmp_path, name, got):
    with pytest.raises(MadocError, match=f"expected p in the file name {name}, as p\\*_, to be one of 2, 5, {got}"):
        logs.read(written(tmp_path, name), load(tmp_path, NAMED))


def test_a_servo_pulls_to_its_target(tmp_path):
    # kp (u - x) - kd v = 100 (0.1 - 0.04) - 2 * 0.5 = 5 N on 2 kg for one step of 0.01 s, twice.
    spec = CART_SPEC.replace(
        "means: force, low: -10, high: 10", "means: position, kp: 100, kd: 2, low: -200, high: 200, unit: mm"
    )
    spec = (
        spec.replace("control_step: 0.02", "control_step: 0.01")
        + "  - {field: actuator_gain, element: push, low: 50, high: 200}\n"
    )
    task = task_of(tmp_path, spec)
    simulator = CpuSimulator(task, threads=1)
    system = simulator.bind(np.array([[2.0, 100.0], [2.0, 50.0]]))
    end = system.step(np.full((2, 1, 2), [0.04, 0.5]), np.full((2, 1, 1), 0.5))
    # Half the gain, in its bias as well: 50 (0.1 - 0.04) - 1 = 2 N.
    np.testing.assert_allclose(end[:, 0, 1], [0.5 + 0.01 * 5 / 2, 0.5 + 0.01 * 2 / 2], rtol=1e-12)
    assert task.parameters.parameters[1].unit == "N/m"
    assert (task.actions[0].unit, task.actions[0].scale) == ("mm", 1e-3)
    model = simulator.model(np.array([2.0, 100.0]))
    assert model.actuator_ctrllimited.all()
    np.testing.assert_allclose(model.actuator_ctrlrange, [[-0.2, 0.2]])


def test_a_velocity_servo_and_its_limit(tmp_path):
    spec = CART_SPEC.replace("means: force, low: -10, high: 10", "means: velocity, kd: 4, limit: 3, low: -1, high: 1")
    spec = spec.replace("control_step: 0.02", "control_step: 0.01")
    system = CpuSimulator(task_of(tmp_path, spec), threads=1).bind(np.array([[1.0]]))
    # kd (u - v): 4 (0.5 - 0) = 2 N; 4 (1 - 0) = 4 N, of which 3 N are had.
    end = system.step(np.zeros((1, 2, 2)), np.array([[[0.5], [1.0]]]))
    np.testing.assert_allclose(end[0, :, 1], [0.02, 0.03], rtol=1e-12)


def test_actions_are_an_affine_map_and_rest_at_nothing(tmp_path):
    spec = CART_SPEC.replace("low: -10, high: 10", "low: 0, high: 4").replace(
        "control_step: 0.02", "control_step: 0.01"
    )
    task = task_of(tmp_path, spec + "  - {field: action_delay, low: 0, high: 0.01}\n")
    simulator = CpuSimulator(task, threads=1)
    assert simulator.initial_state.tolist() == [0.0, 0.0, -1.0]
    end = simulator.bind(np.array([[1.0, 0.0]])).step(np.zeros((1, 3, 3)), np.array([[[-1.0], [0.0], [1.0]]]))
    np.testing.assert_allclose(end[0, :, 1], [0.0, 0.02, 0.04], atol=1e-15)


def test_limits_that_the_model_gives_are_in_the_unit_of_the_action(tmp_path):
    model = BOUNCER.replace('joint="knee" gear="60"', 'joint="knee" ctrlrange="-0.02 0.03"')
    spec = BOUNCER_SPEC.replace("low: -1, high: 1}", "unit: mm}")
    (action,) = robots.load(write_robot(tmp_path, spec, bouncer=model)).task.actions
    assert (action.low, action.high, action.scale) == (pytest.approx(-20.0), pytest.approx(30.0), 1e-3)


FREE = """\
madoc: 1
name: free
model: pendulum.xml
control_step: 0.02
signals:
  - {name: angle, reads: position(pivot), unit: rad}
  - {name: speed, reads: velocity(pivot)}
actions: []
parameters:
  - {field: dof_damping, element: pivot, low: 0, high: 0.5}
"""


SWINGING = re.sub("<actuator>.*</actuator>", "", PENDULUM)


def test_a_machine_without_a_drive_is_calibrated_from_how_it_swings(tmp_path):
    robot, rng = robots.load(write_robot(tmp_path, FREE, pendulum=SWINGING)), np.random.default_rng(0)
    model, readings = robot.task.compile(), []
    model.dof_damping[0] = 0.06
    for start in (-2.0, -1.2, 0.8, 1.6):
        data = mujoco.MjData(model)
        data.qpos[0] = start
        for row in range(150):
            readings.append([0.02 * row, *(np.append(data.qpos, data.qvel) + 0.002 * rng.standard_normal(2))])
            mujoco.mj_step(model, data, 2)
    folder = tmp_path / "logs"
    folder.mkdir()
    for run, rows in enumerate(np.array(readings).reshape(4, 150, 3)):
        np.savetxt(folder / f"{run}.csv", rows, delimiter=",", header="time,angle,speed", comments="")
    assert main(["check", str(tmp_path / "robot.yaml"), "--data", str(folder), "--no-forecast"]) == 0
    dataset = logs.read(folder, robot)
    assert dataset.transitions.action.shape == (len(dataset), 0)
    train, held = dataset.split(0.25)
    problem = CalibrationProblem(train, simulation.make(robot.task, threads=1))
    assessed = assess(calibrate(LeastSquares(), problem, key=jax.random.key(0)), held)
    assert assessed.verdict.word == "CALIBRATED", assessed
    low, high = assessed.result.interval[0]
    assert low < 0.06 < high and high - low < 0.01


def test_a_reward_needs_an_action_and_an_actuator_has_to_be_driven(tmp_path):
    with pytest.raises(MadocError, match="line 8: a reward: is for a policy, which needs an action"):
        robots.load(write_robot(tmp_path, FREE + "reward: -angle ** 2\n", pendulum=SWINGING))
    with pytest.raises(MadocError, match="line 8: expected actions, as the model has the actuators pivot"):
        robots.load(write_robot(tmp_path, FREE))
