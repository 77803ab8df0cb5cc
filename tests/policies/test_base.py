import jax
import numpy as np
import pytest
from scipy import stats

from madoc.errors import MadocError
from madoc.parameters import Parameter, ParameterSpace
from madoc.policies import NormalParameters, UniformParameters

SPACE = ParameterSpace((Parameter("gravity", "", -20.0, 0.0), Parameter("dof_damping", "knee", 0.0, 2.0)))
KEY = jax.random.key(0)


def test_the_box_is_filled_evenly():
    drawn = SPACE.to_unit(UniformParameters(SPACE).draw(KEY, 2000))
    for column in drawn.T:
        assert stats.kstest(column, "uniform", (-1, 2)).pvalue > 0.01


def test_draws_have_the_mean_and_the_covariance():
    covariance = np.array([[1.0, 0.06], [0.06, 0.01]])
    drawn = NormalParameters(SPACE, np.array([-10.0, 1.0]), covariance).draw(KEY, 20_000)
    np.testing.assert_allclose(drawn.mean(0), [-10.0, 1.0], atol=0.03)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, rtol=0.05)


def test_draws_are_clipped_to_the_box():
    drawn = NormalParameters(SPACE, np.array([-0.5, 1.9]), np.diag([25.0, 1.0])).draw(KEY, 1000)
    assert (drawn >= SPACE.low).all()
    assert (drawn <= SPACE.high).all()
    assert (drawn == SPACE.high).any()


def test_no_spread_draws_the_mean():
    mean = np.array([-9.81, 0.7])
    drawn = NormalParameters(SPACE, mean, np.zeros((2, 2))).draw(KEY, 5)
    np.testing.assert_allclose(drawn, np.tile(mean, (5, 1)), rtol=1e-12)


def test_keys_decide():
    box = UniformParameters(SPACE)
    np.testing.assert_array_equal(box.draw(KEY, 3), box.draw(KEY, 3))
    assert not np.array_equal(box.draw(KEY, 3), box.draw(jax.random.key(1), 3))


@pytest.mark.parametrize(
    ("mean", "covariance", "sentence"),
    [
        (np.zeros(3), np.eye(2), "expected a mean of 2 values and a covariance of 2 x 2"),
        (np.zeros(2), np.array([[1.0, 2.0], [0.0, 1.0]]), "is it a covariance"),
        (np.zeros(2), -np.eye(2), "is it a covariance"),
    ],
)
def test_what_is_no_distribution_is_refused(mean, covariance, sentence):
    with pytest.raises(MadocError, match=sentence):
        NormalParameters(SPACE, mean, covariance)


def test_a_share_of_the_systems_is_drawn():
    mean = np.array([-9.81, 0.7])
    drawn = NormalParameters(SPACE, mean, np.diag([1.0, 0.01]), share=0.25).draw(KEY, 8)
    assert (drawn[:6] == mean).all()
    assert (drawn[6:] != mean).all()
    with pytest.raises(MadocError, match="a share of systems to draw between 0 and 1, got 2"):
        NormalParameters(SPACE, mean, np.eye(2), share=2.0)
