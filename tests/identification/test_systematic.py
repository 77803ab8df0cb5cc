import numpy as np
import pytest

from madoc.identification.systematic import (
    autocorrelation,
    disjoint_folds,
    explained,
    explained_at_end,
    persistence,
)

PAIRS = np.random.default_rng(0).standard_normal((300, 3))
NOISE = np.random.default_rng(1).standard_normal((300, 2))


@pytest.mark.parametrize(
    "residuals",
    [
        PAIRS @ np.array([[1.0, 0.5], [0.0, 2.0], [-1.0, 0.0]]),
        np.where(PAIRS[:, :1] > 0.5, [[3.0, -3.0]], 0.0),
        np.full((300, 2), 0.7),
    ],
    ids=["a line", "a contact", "a constant"],
)
def test_what_follows_from_state_and_action_is_explained(residuals):
    share, said = explained(PAIRS, residuals)
    assert share > 0.9
    assert np.abs(said - residuals).mean() < 0.3 * np.abs(residuals).mean()


def test_noise_is_not_explained():
    assert explained(PAIRS, NOISE)[0] < 0.05


def test_half_noise_is_half_explained():
    line = PAIRS[:, :1] * np.sqrt(1.0)
    assert explained(PAIRS, line + NOISE[:, :1])[0] == pytest.approx(0.5, abs=0.1)


def test_windows_are_predicted_from_those_that_do_not_overlap_them():
    learnt, predicted = disjoint_folds(np.arange(50), steps=5)[1]
    assert predicted.tolist() == [*range(10, 20)]
    assert learnt.tolist() == [*range(6), *range(24, 50)]
    assert disjoint_folds(np.arange(9), steps=2) == []


def test_forces_at_random_that_windows_share_are_not_explained_by_the_state():
    """Each window of 20 rows ends where 20 random pushes have added up; the state itself wanders slowly."""
    random = np.random.default_rng(1)
    pushes, state = (np.cumsum(random.standard_normal(shape), axis=0) for shape in ((120, 1), (120, 2)))
    residuals = np.zeros((100, 20, 1))
    residuals[:, -1] = (pushes[20:] - pushes[:100]) / 20.0
    assert explained(state[:100], residuals[:, -1])[0] > 0.3
    assert explained_at_end(state[:100], residuals, np.arange(100)) == 0.0


def test_what_the_state_explains_at_the_end_of_windows_is_explained():
    phase = np.arange(200) / 4.0
    residuals = np.zeros((200, 20, 1))
    residuals[:, -1, 0] = np.sin(phase)
    assert explained_at_end(np.cos(phase[:, None] + [0.0, 1.0]), residuals, np.arange(200)) > 0.9


def test_nothing_and_too_little_are_not_explained():
    assert explained(PAIRS, np.zeros((300, 2)))[0] == 0.0
    assert explained(PAIRS[:5], NOISE[:5])[0] == 0.0


def test_the_autocorrelation_by_hand():
    # (1·2 + 2·1) / √(5 · 5)
    assert autocorrelation(np.array([[1.0], [2.0]]), np.array([[2.0], [1.0]])) == pytest.approx(0.8)
    assert autocorrelation(np.zeros((3, 1)), np.ones((3, 1))) == 0.0


def test_sensor_noise_alternates():
    residuals = NOISE[:-1] - NOISE[1:]
    assert autocorrelation(residuals[:-1], residuals[1:]) == pytest.approx(-0.5, abs=0.08)


def test_what_lasts_is_told_from_noise_and_runs_are_not_joined():
    follows = np.arange(300) > 0
    wave = np.cos(2.0 * np.pi * np.arange(300) / 80.0)[:, None]
    # Six rows later, the mean of 4 to 8, a wave of 80 rows has a correlation of about cos(2π 6 / 80) = 0.89.
    assert persistence(wave, follows) == pytest.approx(0.89, abs=0.03)
    assert persistence(NOISE[:-1] - NOISE[1:], follows[1:]) == 0.0
    assert persistence(wave, np.zeros(300, bool)) == 0.0
