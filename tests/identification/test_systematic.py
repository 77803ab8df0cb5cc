import numpy as np
import pytest

from madoc.identification.systematic import explained, explained_each, folds_of

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
    said = explained(PAIRS, residuals)
    assert ((said - residuals) ** 2).sum() < 0.1 * (residuals**2).sum()
    assert np.abs(said - residuals).mean() < 0.3 * np.abs(residuals).mean()
    assert (explained_each(PAIRS, residuals, folds_of(np.arange(300))) > 0.9).all()


def test_noise_is_not_explained():
    assert ((explained(PAIRS, NOISE) - NOISE) ** 2).sum() > 0.95 * (NOISE**2).sum()
    assert (explained_each(PAIRS, NOISE, folds_of(np.arange(300))) < 0.05).all()


def test_half_noise_is_half_explained():
    line = PAIRS[:, :1] * np.sqrt(1.0)
    both = line + NOISE[:, :1]
    assert ((explained(PAIRS, both) - both) ** 2).sum() / (both**2).sum() == pytest.approx(0.5, abs=0.1)
    assert explained_each(PAIRS, both, folds_of(np.arange(300)))[0] == pytest.approx(0.5, abs=0.1)


def test_no_row_is_predicted_from_rows_of_its_own_group():
    """What groups of ten rows have in common is recognised within a group, and not across groups."""
    shared = np.repeat(np.random.default_rng(2).standard_normal((30, 1)), 10, axis=0)
    each = explained_each(
        np.repeat(np.arange(30.0)[:, None], 10, axis=0), shared, folds_of(np.repeat(np.arange(30), 10))
    )
    assert each[0] < 0.1
    assert folds_of(np.repeat(np.arange(9), 10)) == []


def test_nothing_and_too_little_are_not_explained():
    assert not explained(PAIRS, np.zeros((300, 2))).any()
    assert not explained(PAIRS[:5], NOISE[:5]).any()
