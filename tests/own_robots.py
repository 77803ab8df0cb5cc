"""Robots as a user would describe them: spec files of the two small robots, and of a cart that floats freely."""

import madoc.robots
from robots import ARM, PENDULUM, SPRING

ARM_SPEC = """\
madoc: 1
name: two_link_arm
model: arm.xml
control_step: 0.02
signals:
  - {name: shoulder_angle, reads: position(shoulder), unit: rad}
  - {name: elbow_angle, reads: position(elbow)}
  - {name: shoulder_speed, reads: velocity(shoulder)}
  - {name: elbow_speed, reads: velocity(elbow)}
actions:
  - {name: shoulder_motor, actuator: shoulder, low: -1, high: 1}
  - {name: elbow_motor, actuator: elbow, low: -1, high: 1}
parameters:
  - {field: gravity, low: -15, high: -5}
  - {field: body_mass, element: upper, low: 0.5, high: 2}
  - {field: body_mass, element: fore, low: 0.2, high: 1}
  - {field: dof_damping, element: shoulder, low: 0, high: 1}
  - {field: dof_damping, element: elbow, low: 0, high: 0.5}
groups: 2
"""

SPRING_SPEC = """\
madoc: 1
name: spring
model: spring.xml
control_step: 0.02
signals:
  - {name: place, reads: position(slide)}
  - {name: speed, reads: velocity(slide)}
actions:
  - {name: push, actuator: push, low: -1, high: 1}
parameters:
  - {field: jnt_stiffness, element: slide, low: 1, high: 9}
  - {field: dof_damping, element: slide, low: 0, high: 2}
  - {field: body_mass, element: cart, low: 1, high: 3}
"""

CART = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="cart"><joint name="rail" type="slide" axis="1 0 0"/><geom type="box" size=".1 .1 .1" mass="1"/></body>
  </worldbody>
</mujoco>
"""
"""One kilogram that nothing holds: a double integrator."""

CART_SPEC = """\
madoc: 1
name: cart
model: cart.xml
control_step: 0.02
signals:
  - {name: place, reads: position(rail)}
  - {name: speed, reads: velocity(rail)}
actions:
  - {name: push, joint: rail, means: force, low: -10, high: 10}
parameters:
  - {field: body_mass, element: cart, low: 0.5, high: 2}
"""

PENDULUM_SPEC = """\
madoc: 1
name: pendulum
model: pendulum.xml
control_step: 0.02
signals:
  - {name: angle, reads: position(pivot), unit: rad}
actions:
  - {name: torque, actuator: pivot, low: -1, high: 1}
parameters:
  - {field: body_mass, element: rod, low: 0.5, high: 2}
  - {field: dof_damping, element: pivot, low: 0, high: 0.5}
  - {field: actuator_gain, element: pivot, low: 1, high: 3}
max_episode_steps: 200
"""
"""An encoder alone."""

BOUNCER = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="trunk" pos="0 0 .8">
      <joint name="height" type="slide" axis="0 0 1" damping="1"/>
      <geom type="sphere" size=".1" mass="2" contype="0" conaffinity="0"/>
      <body name="leg">
        <joint name="knee" type="slide" axis="0 0 1" damping="5" stiffness="300" range="-.3 .3"/>
        <geom type="sphere" size=".05" pos="0 0 -.5" mass=".5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="knee" gear="60"/></actuator>
</mujoco>
"""
"""A leg that pushes itself off the floor and lands on it, half of the time."""

BOUNCER_SPEC = """\
madoc: 1
name: bouncer
model: bouncer.xml
control_step: 0.01
signals:
  - {name: height, reads: position(height)}
  - {name: knee, reads: position(knee)}
  - {name: height_speed, reads: velocity(height)}
  - {name: knee_speed, reads: velocity(knee)}
actions:
  - {name: push, actuator: push, low: -1, high: 1}
parameters:
  - {field: body_mass, element: trunk, low: 1, high: 4}
  - {field: body_mass, element: leg, low: 0.2, high: 1}
  - {field: dof_damping, element: knee, low: 1, high: 15}
max_episode_steps: 200
"""

SERVO = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001"/>
  <worldbody>
    <body name="rod">
      <joint name="shaft" axis="0 1 0"/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-6 1e-6 1e-6"/>
      <geom size=".01" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
"""A point mass of 1 kg on a rod of 1 m that hangs, to be driven by a servo."""

SERVO_SPEC = """\
madoc: 1
name: servo
model: servo.xml
control_step: 0.01
signals:
  - {name: angle, reads: position(shaft)}
  - {name: rate, reads: velocity(shaft)}
actions:
  - name: goal
    joint: shaft
    means: position
    low: -1
    high: 1
    drive: {kind: dc, supply: 12, kt: 0.5, resistance: 2, gain: 0.2, enable: "on", supply_from: volts, gain_from: p}
conditions:
  - {name: p, values: [2, 5]}
parameters:
  - {field: drive_strength, element: goal, low: 0.5, high: 1.5}
"""
GEARED = SERVO.replace('axis="0 1 0"', 'axis="0 1 0" armature="0.02"').replace('pos="0 0 -1"', 'pos="0 0 -0.1"')
GEARED_SPEC = """\
madoc: 1
name: geared
model: geared.xml
control_step: 0.01
signals:
  - {name: angle, reads: position(shaft)}
actions:
  - name: goal
    joint: shaft
    means: position
    low: -1
    high: 1
    drive: {kind: dc, supply: 12, kt: 0.5, resistance: 2, gain: 5}
gears:
  - {joint: shaft, stiffness: 100, damping: 0.5, backlash: 0.02, encoder: motor}
parameters:
  - {field: gear_backlash, element: shaft, low: 0, high: 0.04}
  - {field: gear_stiffness, element: shaft, low: 50, high: 200}
  - {field: gear_damping, element: shaft, low: 0, high: 1}
"""
"""A motor of 0.02 kg·m² before a gear with play, and behind it 1 kg on a rod of 0.1 m, which hangs."""


MODELS = {"arm.xml": ARM, "spring.xml": SPRING, "cart.xml": CART, "pendulum.xml": PENDULUM}

SLED = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom type="sphere" size="0.02" mass="0.05" friction="0.5" priority="1"/></default>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 1" pos="0 0 0.3" priority="0"/>
    <body name="sled" pos="0 0 1"><freejoint name="base"/>
      <site name="imu" pos="0.05 0 0.02"/>
      <geom type="box" size="0.15 0.1 0.02" mass="1"/>
      <geom name="a" pos="0.12 0.08 -0.05"/><geom name="b" pos="0.12 -0.08 -0.05"/>
      <geom name="c" pos="-0.12 0.08 -0.05"/><geom name="d" pos="-0.12 -0.08 -0.05"/>
      <body name="rider"><joint name="rail" type="slide" axis="1 0.3 0" damping="1"/>
        <geom type="box" size="0.03 0.03 0.01" mass="0.6" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="rail" kp="200"/></actuator>
  <sensor><framequat name="attitude" objtype="site" objname="imu"/><gyro name="gyro" site="imu"/></sensor>
</mujoco>
"""
"""A sled on four round feet, 0.07 m high, that a rider shakes; its IMU shows its attitude, nothing its place."""

SLED_SPEC = """\
madoc: 1
name: sled
model: sled.xml
control_step: 0.02
signals:
  - {name: rider, reads: position(rail)}
  - {name: rider_speed, reads: velocity(rail)}
  - {name: w, reads: "sensor(attitude)[0]"}
  - {name: x, reads: "sensor(attitude)[1]"}
  - {name: y, reads: "sensor(attitude)[2]"}
  - {name: z, reads: "sensor(attitude)[3]"}
  - {name: roll, reads: "sensor(gyro)[0]"}
  - {name: pitch, reads: "sensor(gyro)[1]"}
  - {name: yaw, reads: "sensor(gyro)[2]"}
actions:
  - {name: target, actuator: drive, low: -0.1, high: 0.1}
parameters:
  - {field: geom_friction, elements: [a, b, c, d], name: friction, low: 0.1, high: 1}
  - {field: body_mass, element: rider, low: 0.2, high: 1}
"""
SLED_TRUTH = {"friction": 0.4, "body_mass.rider": 0.7}


def write_robot(folder, spec, file="robot.yaml", **models):
    """A spec file beside the models it may name; where it lies."""
    for name, text in (MODELS | {f"{name}.xml": text for name, text in models.items()}).items():
        (folder / name).write_text(text)
    path = folder / file
    path.write_text(spec)
    return path


URDF = """
<robot name="pendulum">
  <link name="base"/>
  <link name="rod">
    <inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
      <inertia ixx="0.2" iyy="0.2" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="5" velocity="9"/><dynamics damping="0.1" friction="0"/>
  </joint>
</robot>
"""


URDF_SPEC = """\
madoc: 1
name: pendulum
model: pendulum.xml
control_step: 0.02
signals:
  - {name: angle, reads: position(hinge) * 180 / pi, unit: deg}
  - {name: rate, reads: velocity(hinge)}
actions:
  - {name: torque, joint: hinge, means: torque, low: -5, high: 5}
parameters:
  - {field: body_mass, element: rod, low: 1, high: 3}
  - {field: body_com, element: rod, low: 0.2, high: 1}
  - {field: body_inertia, element: rod, low: 0.1, high: 0.4}
  - {field: dof_damping, element: hinge, low: 0, high: 0.5}
"""


def task_of(folder, spec, **models):
    """The task of a spec file beside the models it may name."""
    return madoc.robots.load(write_robot(folder, spec, **models)).task
