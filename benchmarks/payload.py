"""An arm of seven joints that carries an unknown load off its axis: are its mass, its centre and the delay found?

    python benchmarks/payload.py --seeds 0 1 2
    python benchmarks/payload.py --table

The arm is driven by torques, which arrive 8 ms late, and follows sums of sines under a controller that knows nothing of
the load of 0.5 kg, nor of the dry friction of each joint, which is drawn. Runs are simulated by MuJoCo alone with a
step of 1 ms; 200 rows a second have positions, speeds and torques with the noise of good sensors. Mass, centre and
radius of gyration of the load, seven frictions and the delay are calibrated, with all defaults.
"""

import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import numpy as np
from adversary import solved
from kept import RESULTS, Study, commits, run_seeds

STUDY = Study(RESULTS / "payload.jsonl", ("seed",))
LINKS = ((0.15, 4.0), (0.2, 4.0), (0.15, 3.0), (0.2, 3.0), (0.12, 2.5), (0.1, 1.5), (0.08, 0.8))
"""Length, m, and mass, kg."""
AXES = ("0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 -1 0", "0 0 1")
LIMITS = np.array([80.0, 80.0, 80.0, 80.0, 12.0, 12.0, 12.0])
"""N·m."""
ARMATURE, DAMPING = (0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05), (0.5, 0.5, 0.5, 0.5, 0.2, 0.2, 0.2)
STIFF, BRAKE = np.array([300, 300, 200, 200, 80, 60, 30.0]), np.array([20, 20, 15, 15, 5, 4, 2.0])
"""Gains of the controller, N·m/rad and N·m·s/rad."""
NOISE = np.repeat([1e-4, 5e-3, 0.05], 7)
"""Of positions in rad, speeds in rad/s and torques in N·m."""
PHYSICS, ROW, DELAY = 0.001, 0.005, 0.008
"""s."""
MASS, GYRATION, MOST_FRICTION = 0.5, 0.03, 0.5
"""kg, m, N·m."""
RUNS, SECONDS, LIMIT = 4, 5.0, 900.0
NAMES = tuple(f"j{number}" for number in range(1, 8))
SPEC = """\
madoc: 1
name: arm
model: arm.xml
control_step: 0.005
signals:
{signals}
actions:
{actions}
parameters:
  - {{field: payload_mass, element: link7, low: 0, high: 1}}
  - {{field: payload_x, element: link7, low: -0.1, high: 0.1}}
  - {{field: payload_y, element: link7, low: -0.1, high: 0.1}}
  - {{field: payload_z, element: link7, low: 0, high: 0.2}}
  - {{field: payload_gyration, element: link7, low: 0, high: 0.1}}
  - {{field: dof_frictionloss, each: "j*", low: 0, high: 1}}
  - {{field: action_delay, low: 0, high: 0.02}}
"""


def solve(seed: int) -> dict[str, Any]:
    """Record, calibrate and compare."""
    random = np.random.default_rng(seed)
    centre = random.uniform((-0.08, -0.08, 0.05), (0.08, 0.08, 0.15))
    friction = random.uniform(0.0, MOST_FRICTION, 7)
    truth = {"payload_mass.link7": MASS, "payload_gyration.link7": GYRATION, "action_delay": DELAY}
    truth |= {f"payload_{axis}.link7": float(place) for axis, place in zip("xyz", centre, strict=True)}
    truth |= {f"dof_frictionloss.{name}": float(value) for name, value in zip(NAMES, friction, strict=True)}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "logs").mkdir()
        (folder / "arm.xml").write_text(mjcf())
        reads = {"": "position({})", "_speed": "velocity({})", "_torque": "sensor({}_torque)"}
        signals = [f'  - {{name: {n}{s}, reads: "{r.format(n)}"}}' for s, r in reads.items() for n in NAMES]
        actions = [f"  - {{name: {name}_command, actuator: {name}}}" for name in NAMES]
        (folder / "arm.yaml").write_text(SPEC.format(signals="\n".join(signals), actions="\n".join(actions)))
        header = ",".join(["time", *(f"{n}{s}" for s in reads for n in NAMES), *(f"{n}_command" for n in NAMES)])
        real, known = (mujoco.MjModel.from_xml_string(mjcf(*load)) for load in ((centre, friction), ()))
        for run in range(RUNS):
            np.savetxt(
                folder / "logs" / f"{run}.csv", recorded(real, known, random), "%.9g", ",", header=header, comments=""
            )
        return {"seed": seed} | solved(folder / "arm.yaml", folder / "logs", truth, limit=LIMIT)


def mjcf(centre: np.ndarray | None = None, friction: np.ndarray | None = None) -> str:
    """The arm; with a load at a place in the last link's frame, and with friction."""
    load, place = "", 0.0
    if centre is not None:
        inertia = " ".join(3 * [repr(MASS * GYRATION**2)])
        body = f'<body pos="{" ".join(map(repr, centre.tolist()))}"><inertial pos="0 0 0" mass="{MASS}"'
        load = f'{body} diaginertia="{inertia}"/></body>'
    links = ""
    for index, (length, mass) in enumerate(LINKS):
        loss = 0.0 if friction is None else float(friction[index])
        links += (
            f'<body name="link{index + 1}" pos="0 0 {place}"><joint name="{NAMES[index]}" axis="{AXES[index]}" '
            f'armature="{ARMATURE[index]}" damping="{DAMPING[index]}" frictionloss="{loss!r}"/><geom type="capsule" '
            f'size="0.05" fromto="0 0 0 0.02 0 {length}" mass="{mass}" contype="0" conaffinity="0"/>'
        )
        place = length
    motors = "".join(
        f'<motor name="{name}" joint="{name}" ctrlrange="{-limit} {limit}"/>'
        for name, limit in zip(NAMES, LIMITS, strict=True)
    )
    sensors = "".join(f'<actuatorfrc name="{name}_torque" actuator="{name}"/>' for name in NAMES)
    return (
        f'<mujoco><option timestep="{PHYSICS}" integrator="implicitfast"/><worldbody>{links}{load}{"</body>" * 7}'
        f"</worldbody><actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>"
    )


def recorded(real: mujoco.MjModel, known: mujoco.MjModel, random: np.random.Generator) -> np.ndarray:
    """A run of the real arm under a controller that has the known one: time, readings with noise, commands."""
    data, model = mujoco.MjData(real), mujoco.MjData(known)
    size, speed = random.uniform(0.2, 0.5, (7, 3)), 2 * np.pi * random.uniform(0.1, 0.8, (7, 3))
    phase, middle = random.uniform(0.0, 2 * np.pi, (7, 3)), random.uniform(-0.8, 0.8, 7)
    data.qpos[:] = middle + (size * np.sin(phase)).sum(1)
    data.qvel[:] = (size * speed * np.cos(phase)).sum(1)
    mujoco.mj_forward(real, data)
    rows, commands = [], list[tuple[float, np.ndarray]]()
    for now in ROW * np.arange(round(SECONDS / ROW)):
        turn = speed * now + phase
        wanted, pace = middle + (size * np.sin(turn)).sum(1), (size * speed * np.cos(turn)).sum(1)
        model.qpos[:], model.qvel[:], model.qacc[:] = data.qpos, data.qvel, -(size * speed**2 * np.sin(turn)).sum(1)
        mujoco.mj_inverse(known, model)
        asked = model.qfrc_inverse + STIFF * (wanted - data.qpos) + BRAKE * (pace - data.qvel)
        command = np.clip(asked, -LIMITS, LIMITS)
        commands = [*(commands or [(-1.0, command)])[-5:], (float(now), command)]
        read = np.concatenate([data.qpos, data.qvel, data.sensordata]) + NOISE * random.standard_normal(21)
        rows.append(np.concatenate([[now], read, command]))
        for step in range(round(ROW / PHYSICS)):
            arrived = now + step * PHYSICS - DELAY + 1e-9
            data.ctrl[:] = next(value for sent, value in reversed(commands) if sent <= arrived)
            mujoco.mj_step(real, data)
    return np.array(rows)


def table(rows: list[dict[str, Any]]) -> str:
    """Errors, and how many intervals hold the truth, as Markdown."""
    lines = ["| value | problems | error, median | largest | intervals that hold the truth |", "|---" * 5 + "|"]
    kinds = {
        "mass, % of 0.5 kg": (("payload_mass.link7",), 100.0 / MASS),
        "centre, mm, each axis": (tuple(f"payload_{axis}.link7" for axis in "xyz"), 1e3),
        "radius of gyration, mm": (("payload_gyration.link7",), 1e3),
        "dry friction, N·m, each joint": (tuple(f"dof_frictionloss.{name}" for name in NAMES), 1.0),
        "delay, ms": (("action_delay",), 1e3),
    }
    for label, (names, unit) in kinds.items():
        found = [one for row in rows for name in names if (one := row["parameters"][name])["interval"]]
        errors = [unit * abs(one["estimate"] - one["truth"][0]) for one in found] or [float("nan")]
        held = f"{sum(one['miss'] == 0.0 for one in found)} of {len(found)}"
        lines.append(f"| {label} | {len(rows)} | {median(errors):.2g} | {max(errors):.2g} | {held} |")
    words = [row["verdict"] for row in rows]
    counted = ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words)))
    seconds = median([row["seconds"] for row in rows] or [0.0])
    return "\n".join([*lines, "", f"Verdicts: {counted}; {seconds:.0f} s a problem; commits {commits(rows)}."])


if __name__ == "__main__":
    run_seeds(STUDY, solve, table, description=__doc__)
