"""Models of a spec that cannot be read, compiled or stepped, refused in a sentence."""

import pytest

from madoc import robots
from madoc.errors import MadocError
from own_robots import CART, CART_SPEC, write_robot


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        (None, r"line 3: there is no model file .*cart.xml: it is missing; check the path"),
        ("", "line 3: model cart.xml cannot be read"),
        ("hello", "line 3: model cart.xml cannot be read: it is not XML"),
        ("<mujoco><wordbody/></mujoco>", "line 3: model cart.xml cannot be read: .*wordbody"),
        (
            '<mujoco><worldbody><body name="cart"><joint name="rail"/></body></worldbody></mujoco>',
            "line 3: model cart.xml does not compile: .*mass and inertia",
        ),
        (CART.replace("</mujoco>", '<include file="rest.xml"/></mujoco>'), "line 3: .*rest.xml"),
        (
            CART.replace("</mujoco>", '<equality><joint joint1="rial"/></equality></mujoco>'),
            "line 3: model cart.xml cannot be read: .*'rial'",
        ),
        (
            CART.replace("</mujoco>", '<sensor><gyro name="gyro" site="imu"/></sensor></mujoco>'),
            "line 3: model cart.xml cannot be read: .*'imu'",
        ),
        (
            CART.replace(
                "</mujoco>", '<actuator><intvelocity name="a" joint="rail" kp="1" actrange="-1 1"/></actuator></mujoco>'
            ),
            "line 9: the joint 'rail' has an actuator 'a' in the model",
        ),
    ],
)
def test_what_is_no_model(tmp_path, model, sentence):
    path = write_robot(tmp_path, CART_SPEC)
    (tmp_path / "cart.xml").unlink()
    if model is not None:
        (tmp_path / "cart.xml").write_text(model)
    with pytest.raises(MadocError, match=sentence) as refusal:
        robots.load(path)
    assert "\n" not in str(refusal.value)


def test_models_that_cannot_be_stepped_yet_are_refused(tmp_path):
    actuator = '<actuator><intvelocity name="a" joint="rail" kp="1" actrange="-1 1"/></actuator></mujoco>'
    path = write_robot(
        tmp_path,
        CART_SPEC.replace("joint: rail, means: force", "actuator: a"),
        cart=CART.replace("</mujoco>", actuator),
    )
    with pytest.raises(
        MadocError,
        match=r"line 3: cart: of the actuators a with an activation .* the state is not simulated",
    ):
        robots.load(path)
