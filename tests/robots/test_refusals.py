"""Every mistake in a spec: one sentence with file, line, what was expected, what is there, the nearest names."""

import pytest

from madoc import robots
from madoc.errors import MadocError
from own_robots import ARM_SPEC, CART, CART_SPEC, write_robot

ACTION = "  - {name: shoulder_motor, actuator: shoulder, low: -1, high: 1}"


DAMPING = "  - {field: dof_damping, element: elbow, low: 0, high: 0.5}"


SIGNAL = "  - {name: elbow_angle, reads: position(elbow)}"


def line_of(text, spec=ARM_SPEC):
    return max(number for number, line in enumerate(spec.splitlines(), 1) if text in line)


CHANGES = [
    # What stands in the file.
    ("madoc: 1", "madoc: 2", "expected 1 in madoc, got 2"),
    ("madoc: 1\n", "", "expected madoc: here"),
    ("model: arm.xml\n", "", "expected model: here"),
    ("control_step", "control_stp", "unknown key 'control_stp'; nearest: control_step"),
    ("control_step: 0.02", "control_step: fast", "expected a number in control_step, got 'fast'"),
    ("control_step: 0.02", "control_step: -0.02", "expected greater .* 0.000001 in control_step, got -0.02"),
    ("control_step: 0.02", "control_step: .nan", "expected .* in control_step, got nan"),
    ("control_step: 0.02", "control_step: true", "expected a number in control_step, got True"),
    (
        "control_step: 0.02",
        "control_step: 0.025",
        "a whole multiple of the timestep 0.01 s, got 0.025 s; nearest: 0.02",
    ),
    (
        "control_step: 0.02",
        "control_step: 0.004",
        "a whole multiple of the timestep 0.01 s, got 0.004 s; nearest: 0.01",
    ),
    ("name: two_link_arm", "name: two link arm", "expected a name of letters, digits, _ . and -"),
    ("name: two_link_arm", "name: 12", "expected text in name, got 12; put it in quotes"),
    ("name: two_link_arm", "name: hopper", "'hopper' is a robot of Madoc's own; choose another name"),
    ("groups: 2", "groups: two", "expected a whole number in groups, got 'two'"),
    ("groups: 2", "groups: 0", "expected greater than or equal to 1 in groups, got 0"),
    ("groups: 2", "groups: 2\ngroups: 3", r"'groups' is given twice, first on line 19; keep one"),
    # Signals.
    (SIGNAL, "  - {name: elbow_angle}", "expected reads: in this part of signals"),
    (SIGNAL, "  - elbow_angle", "expected keys and values in signals, got 'elbow_angle'"),
    (SIGNAL, "  - {name: elbow_angle, read: position(elbow)}", "unknown key 'read'; nearest: reads"),
    (SIGNAL, "  - {name: shoulder_angle, reads: position(elbow)}", "the name 'shoulder_angle' is taken by line 6"),
    (SIGNAL, "  - {name: elbow_motor, reads: position(elbow)}", None),
    (SIGNAL, "  - {name: e, reads: position(elbo)}", "the model has no joint 'elbo'; nearest: elbow"),
    (SIGNAL, "  - {name: e, reads: position(elbow}", "which does not parse"),
    (SIGNAL, "  - {name: e, reads: position(elbow) +}", "which does not parse"),
    (SIGNAL, "  - {name: e, reads: elbow}", r"'elbow' alone reads nothing; write position\(elbow\)"),
    (SIGNAL, "  - {name: e, reads: 1 + 1}", "is 2 whatever the robot does; read a joint or a sensor"),
    (SIGNAL, "  - {name: e, reads: 3}", "expected text in signals.reads, got 3; put it in quotes"),
    (SIGNAL, "  - {name: e, reads: sensor(tip)}", "the model has no sensor 'tip'; it names no sensor"),
    (SIGNAL, '  - {name: e, reads: "position(elbow)[1]"}', r"position\(elbow\)\[1\] does not exist: it has 1 value,"),
    (SIGNAL, "  - {name: e, reads: position(elbow) * (1 / 0)}", "expected an expression with a value"),
    (SIGNAL, "  - {name: e, reads: position(elbow), unit: deg}", r"is in rad, not in deg; write reads: .* \* 180 / pi"),
    (SIGNAL, "  - {name: e, reads: -position(elbow), unit: Degrees}", r"is in rad, not in Degrees; .*unit: rad$"),
    (SIGNAL, "  - {name: e, reads: velocity(elbow), unit: rpm}", r"is in rad/s, not in rpm; write unit: rad/s$"),
    (SIGNAL, "  - {name: e, reads: position(elbow) - 1, unit: deg}", r"reads: \(position\(elbow\) - 1\) \* 180 / pi"),
    (SIGNAL, "  - {name: e, reads: position(elbow), unit: mm}", r"is in rad, not in mm; write unit: rad$"),
    (SIGNAL, "  - {name: e, reads: position(elbow), unit: rad (left shaft)}", None),
    # Actions.
    (
        ACTION,
        "  - {name: m, actuator: shoulde, low: -1, high: 1}",
        "the name of an actuator, got 'shoulde'; nearest: shoulder",
    ),
    (ACTION, "  - {name: m, actuator: shoulder, low: 1, high: -1}", "expected low below high, got 1 and -1"),
    (ACTION, "  - {name: m, actuator: shoulder, low: -1}", "expected both low: and high:, got one of them"),
    (
        ACTION,
        "  - {name: m, actuator: shoulder}",
        "expected low: and high:, as the actuator 'shoulder' has no ctrlrange",
    ),
    (ACTION, "  - {name: m, low: -1, high: 1}", "expected either joint: or actuator:, got both or neither"),
    (ACTION, "  - {name: m, actuator: elbow, low: -1, high: 1}", None),
    (
        ACTION,
        "  - {name: m, actuator: shoulder, kp: 3, low: -1, high: 1}",
        "kp: belongs to joint:, the actuator 'shoulder'",
    ),
    (ACTION, "  - {name: m, joint: shoulder, low: -1, high: 1}", "expected means: torque, force, position or velocity"),
    (
        ACTION,
        "  - {name: m, joint: shoulder, means: push, low: -1, high: 1}",
        "expected 'torque', 'force', .* got 'push'",
    ),
    (ACTION, "  - {name: m, joint: shoulder, means: torque}", "expected low: and high: beside joint:"),
    (ACTION, "  - {name: m, joint: shoulder, means: position, low: -1, high: 1}", "expected kp: of a position servo"),
    (
        ACTION,
        "  - {name: m, joint: shoulder, means: velocity, low: -1, high: 1}",
        "expected kd: above 0 of a velocity servo",
    ),
    (
        ACTION,
        "  - {name: m, joint: shoulder, means: torque, kp: 1, low: -1, high: 1}",
        "kp: means nothing beside means: torque",
    ),
    (
        ACTION,
        "  - {name: m, joint: shoulder, means: torque, low: -1, high: 1}",
        "the joint 'shoulder' has an actuator 'shoulder' in the model; drive that with actuator: shoulder",
    ),
    (
        ACTION,
        "  - {name: m, joint: shouldr, means: torque, low: -1, high: 1}",
        "the name of a joint, got 'shouldr'; nearest",
    ),
    # Parameters.
    (DAMPING, "  - {field: dof_dampng, element: elbow, low: 0, high: 1}", "got 'dof_dampng'; nearest: dof_damping"),
    (DAMPING, "  - {field: jnt_margin, element: elbow, low: 0, high: 1}", "model is given by model: jnt_margin"),
    (
        DAMPING,
        "  - {field: dof_damping, element: elbw, low: 0, high: 1}",
        "the name of a joint, got 'elbw'; nearest: elbow",
    ),
    (
        DAMPING,
        "  - {field: dof_damping, element: elbow, low: 1, high: 0}",
        r"must be finite with low < high, got \[1.0, 0.0\]",
    ),
    (DAMPING, "  - {field: dof_damping, element: elbow, low: 1, high: 1}", "must be finite with low < high"),
    (DAMPING, "  - {field: dof_damping, element: elbow, low: -1, high: 1}", "below its physical bound 0.0"),
    (
        DAMPING,
        "  - {field: dof_damping, element: elbow, low: 0, high: .inf}",
        "expected .* in parameters.high, got inf",
    ),
    (DAMPING, "  - {field: dof_damping, element: elbow, low: 0}", "expected high: in this part of parameters"),
    (DAMPING, "  - {field: dof_damping, low: 0, high: 1}", "'dof_damping' takes the name of a joint, got ''"),
    (DAMPING, "  - {field: gravity, element: elbow, low: -9, high: 1}", "'gravity' takes no element, got 'elbow'"),
    (
        DAMPING,
        "  - {field: dof_damping, elements: [], low: 0, high: 1}",
        "expected at least 1 item in parameters.elements",
    ),
    (DAMPING, "  - {field: dof_damping, elements: [elbow, elbow], low: 0, high: 1}", "names an element twice"),
    (
        DAMPING,
        "  - {field: dof_damping, element: a, elements: [b], low: 0, high: 1}",
        "expected one of element:, elements: and each:, got element and elements",
    ),
    (
        DAMPING,
        "  - {field: dof_damping, element: shoulder, low: 0, high: 1}",
        "dof_damping.shoulder is on line 17 already",
    ),
    (
        DAMPING,
        "  - {field: dof_damping, elements: [elbow, shoulder], low: 0, high: 1}",
        "dof_damping of 'shoulder' is calibrated by line 17 already",
    ),
    (
        DAMPING,
        "  - {field: gravity, name: g, low: -9, high: -8}",
        "gravity and gravity of line 14 are one thing; keep one",
    ),
    (
        DAMPING,
        "  - {field: body_mass_and_inertia, element: fore, low: 1, high: 2}",
        "and body_mass of line 16 are one thing",
    ),
    (
        DAMPING,
        "  - {field: body_mass_and_inertia, element: elbow, low: 1, high: 2}",
        "and body_mass of line 16 are one thing",
    ),
    (
        DAMPING,
        "  - {field: inertia, element: fore, low: -0.1, high: 0.1}",
        "inertia and body_mass of line 16 are one thing",
    ),
    (DAMPING, "  - {field: inertia_alpha, element: fore, low: -0.1, high: 0.1}", ""),
    (
        DAMPING,
        "  - {field: dof_damping, each: ['elb*', elbow], low: 0, high: 1}",
        "elbow is matched twice; leave one out",
    ),
    (DAMPING, "  - {field: body_com, element: world, low: 0, high: 1}", "expected the name of a body, got 'world'"),
    (
        DAMPING,
        "  - {field: signal_bias, element: elbow, low: -1, high: 1}",
        "a signal, got 'elbow'; nearest: elbow_angle",
    ),
    (DAMPING, "  - {field: action_delay, low: -1, high: 1}", "below its physical bound 0.0"),
    # Numbers of the model, and patterns.
    (DAMPING, "  - {low: 0, high: 1}", "expected either field: or model:, got both or neither"),
    (DAMPING, "  - {field: gravity, index: 1, low: 0, high: 1}", "index: belongs to model:, not to field:"),
    (DAMPING, "  - {field: gravity, unit: m, low: 0, high: 1}", "unit: belongs to model:, not to field:"),
    (DAMPING, "  - {model: solref, low: 0, high: 1}", "unknown parameter field 'solref'; .* begins with body_, geom_"),
    (
        DAMPING,
        "  - {model: jnt_solreff, index: 0, element: elbow, low: 0, high: 1}",
        "MuJoCo's model has no numbers 'jnt_solreff'; nearest: jnt_solref",
    ),
    (
        DAMPING,
        "  - {model: opt.vind, index: 0, low: 0, high: 1}",
        "MuJoCo's model has no numbers 'opt.vind'; nearest: wind",
    ),
    (DAMPING, "  - {model: opt.density, index: 0, low: 0, high: 1}", "expected no index: with opt.density, got 0"),
    (
        DAMPING,
        "  - {model: jnt_solref, element: elbow, low: 0, high: 1}",
        "expected index: from 0 to 1 with jnt_solref, got none",
    ),
    (
        DAMPING,
        "  - {model: jnt_solref, index: 2, element: elbow, low: 0, high: 1}",
        "expected index: from 0 to 1 with jnt_solref, got 2",
    ),
    (DAMPING, "  - {model: jnt_solref, index: -1, element: elbow, low: 0, high: 1}", "expected greater than or equal"),
    (DAMPING, "  - {model: jnt_type, element: elbow, low: 0, high: 1}", "MuJoCo's model has no numbers 'jnt_type'"),
    (
        DAMPING,
        "  - {model: jnt_margin, element: elbw, low: 0, high: 1}",
        "the name of a joint, got 'elbw'; nearest: elbow",
    ),
    (
        DAMPING,
        "  - {model: body_quat, index: 0, element: fore, low: 0, high: 1}",
        "body_quat cannot be calibrated: a quaternion has a length of 1",
    ),
    (DAMPING, "  - {model: opt.timestep, low: 0, high: 1}", "opt.timestep cannot be calibrated: the timestep is given"),
    (
        DAMPING,
        "  - {model: opt.gravity, index: 2, low: -11, high: -9}",
        r"opt.gravity\[2\] and gravity of line 14 are one number of the model; keep one",
    ),
    (
        DAMPING,
        "  - {model: body_mass, element: fore, low: 1, high: 2}",
        "the parameter body_mass.fore is on line 16 already",
    ),
    (
        DAMPING,
        "  - {field: dof_damping, elements: '*_joint', low: 0, high: 1}",
        "expected the name of a joint, or a pattern with . for several, got '._joint'; there are: shoulder, elbow",
    ),
    (
        DAMPING,
        "  - {field: dof_damping, each: [elbow, 'x*'], low: 0, high: 1}",
        r"expected the name of a joint, or a pattern with . for several, got 'x.'; there are",
    ),
    (DAMPING, "  - {field: dof_armature, each: 3, low: 0, high: 1}", "expected a list in parameters.each, got 3"),
    (DAMPING, "  - {field: gravity, each: '*', low: -11, high: -9}", "'gravity' takes no element, got '.'"),
    (DAMPING, "  - {field: dof_damping, each: '*', low: 0, high: 1}", "dof_damping.shoulder is on line 17 already"),
    # The rest.
    (
        "groups: 2",
        "log: {columns: {elbow: q2}}",
        "the name of a signal or an action, got 'elbow'; nearest: elbow_angle",
    ),
    (
        "groups: 2",
        "log: {columns: {elbow_angle: q1, shoulder_angle: q1}}",
        "shoulder_angle and elbow_angle are both read from the column 'q1'; name a column of its own for each",
    ),
    ("groups: 2", "log: {resample: nearest}", "expected 'hold' or 'linear' in log.resample, got 'nearest'"),
    ("groups: 2", "log: {tolerance: 2}", "expected less than 1 in log.tolerance, got 2"),
    ("groups: 2", "log: {tme: t}", "unknown key 'tme'; nearest: time"),
    ("groups: 2", "reward: elbow_angel", "unknown name 'elbow_angel'; nearest: elbow_angle"),
    ("groups: 2", "reward: sensor(elbow)", "unknown function 'sensor'"),
    ("groups: 2", "reward: position(elbo)", "the model has no joint 'elbo'; nearest: elbow"),
    ("groups: 2", "end: elbow_angle", "expected a condition, as height < 0.2, got .elbow_angle., which is a number"),
    ("groups: 2", "end: shoulder_motor > 0", "unknown name .shoulder_motor."),
    ("groups: 2", "goals: [{name: shoulder_motor, drawn: 1}]", "the name .shoulder_motor. is taken already"),
    ("groups: 2", "goals: [{name: x, drawn: y}]", "unknown name .y."),
    (
        "groups: 2",
        "reset: {position(elbow) + 1: 0}",
        r"expected position\(JOINT\) or velocity\(JOINT\) before the colon",
    ),
    ("groups: 2", "reset: {velocity(elbow): uniform(1)}", "uniform takes 2 values, got 1"),
]


@pytest.mark.parametrize(("before", "after", "sentence"), [row for row in CHANGES if row[2]])
def test_a_mistake_is_answered_on_its_line(tmp_path, before, after, sentence):
    assert before in ARM_SPEC
    spec = ARM_SPEC.replace(before, after, 1)
    with pytest.raises(MadocError, match=sentence) as refusal:
        robots.load(write_robot(tmp_path, spec))
    told = str(refusal.value)
    assert "\n" not in told
    missing = after in ("", "\n")
    line = 1 if missing else line_of(after.splitlines()[-1], spec)
    assert told.startswith(f"robot.yaml, line {line}: ")


def test_a_name_is_taken_across_signals_and_actions(tmp_path):
    spec = ARM_SPEC.replace(SIGNAL, "  - {name: elbow_motor, reads: position(elbow)}")
    with pytest.raises(MadocError, match="line 12: the name 'elbow_motor' is taken by line 7; choose another"):
        robots.load(write_robot(tmp_path, spec))
    spec = ARM_SPEC.replace(ACTION, "  - {name: m, actuator: elbow, low: -1, high: 1}")
    with pytest.raises(MadocError, match="line 12: the actuator 'elbow' is driven by line 11 already"):
        robots.load(write_robot(tmp_path, spec))


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ("means: force", "means: torque", "line 9: expected means: force of the slide 'rail'"),
        ("name: push,", "name: rail_push, unit: mm,", None),
        (
            "actions:\n",
            "actions:\n  - {name: twice, joint: rail, means: force, low: -1, high: 1}\n",
            "is driven by line 9",
        ),
        ("reads: position(rail)", "reads: position(rail), unit: mm", r"is in m, not in mm; write reads: .* \* 1000"),
    ],
)
def test_slides_are_no_hinges(tmp_path, before, after, sentence):
    path = write_robot(tmp_path, CART_SPEC.replace(before, after))
    if sentence is None:
        assert robots.load(path).task.actions[0].scale == 1e-3
        return
    with pytest.raises(MadocError, match=sentence):
        robots.load(path)


def test_a_value_in_two_units_is_not_shared(tmp_path):
    model = CART.replace(
        "</body>", '<body name="b"><joint name="turn" type="hinge"/><geom size=".1" mass="1"/></body></body>'
    )
    shared = "  - {field: dof_damping, elements: [rail, turn], low: 0, high: 1}\n"
    with pytest.raises(
        MadocError, match=r"line 12: one value cannot be in N·m·s/rad and in N·s/m; make it two parameters"
    ):
        robots.load(write_robot(tmp_path, CART_SPEC + shared, cart=model))


def test_a_unit_that_nobody_knows(tmp_path):
    changed = ARM_SPEC.replace(ACTION, ACTION.replace("high: 1}", "high: 1, unit: degrees}"))
    with pytest.raises(MadocError, match=r"line 11: expected a unit that is known, got 'degrees'; nearest: deg"):
        robots.load(write_robot(tmp_path, changed))
