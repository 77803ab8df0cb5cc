"""Your own model in seconds: a cart on a spring, whose stiffness, damping and mass are found from 2 000 logged rows."""

import jax
import mujoco

import madoc
from madoc.data.record import record
from madoc.parameters import Parameter, ParameterSpace
from madoc.policies.interaction import UniformPolicy
from madoc.tasks import Task

MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" stiffness="4" damping="0.5"/>
      <geom type="box" size=".1 .1 .1" mass="2"/>
    </body>
  </worldbody>
  <actuator><motor joint="slide" gear="5"/></actuator>
</mujoco>
"""
TRUTH = {"jnt_stiffness.slide": 6.0, "dof_damping.slide": 0.8, "body_mass.cart": 1.4}


def spring() -> Task:
    """The cart: its observation is its state, position (m) and velocity (m/s)."""
    space = ParameterSpace(
        (
            Parameter("jnt_stiffness", "slide", 1.0, 9.0),
            Parameter("dof_damping", "slide", 0.0, 2.0),
            Parameter("body_mass", "cart", 1.0, 3.0),
        )
    )
    return Task(
        name="spring",
        physics="modern",
        spec=lambda: mujoco.MjSpec.from_string(MODEL),
        frame_skip=5,
        observation_size=2,
        observe=lambda state: state,
        reward=lambda state, action, next_state: -abs(next_state[..., 0]),
        terminated=lambda next_state: abs(next_state[..., 0]) > 5.0,
        reset_noise=lambda key, count: jax.random.uniform(key, (count, 2), minval=-1.0, maxval=1.0),
        parameters=space,
        ranges={"normal": space},
        groups=3,
        max_episode_steps=100,
        reference_returns=(-100.0, 0.0),
        state_from_observation=lambda observation: observation,
    )


def main() -> None:
    """Record, calibrate, print."""
    simulator = madoc.simulation.make(spring())
    # Uniform random pushes; in your case these rows come from the machine.
    dataset = record(
        UniformPolicy(1), simulator, TRUTH, transitions=2000, key=jax.random.key(0), origin="random pushes"
    )
    problem = madoc.CalibrationProblem(dataset, simulator)
    print(madoc.calibrate(madoc.LeastSquares(), problem, key=jax.random.key(1), budget=100_000, truth=TRUTH))


if __name__ == "__main__":
    main()
