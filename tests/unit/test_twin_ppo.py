"""Proximal policy optimisation: every gradient against finite differences, the estimates against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.study.twin.ppo import (
    Adam,
    Learner,
    Normaliser,
    advantages,
    flat,
    forward,
    init_layers,
    log_probability,
    policy_loss,
    value_loss,
)
from scipy.stats import norm

from tests.unit.walking_person import twin_settings

SIZES = [5, 7, 6, 3]


def _difference(function, array: np.ndarray, index: tuple, step: float = 1e-6) -> float:
    kept = array[index]
    array[index] = kept + step
    high = function()
    array[index] = kept - step
    low = function()
    array[index] = kept
    return (high - low) / (2 * step)


def _batch(rng: np.random.Generator, n: int = 40):
    obs, action = rng.standard_normal((n, 5)), rng.standard_normal((n, 3))
    return obs, action, rng.standard_normal(n)


@pytest.mark.parametrize("shift", [0.0, 0.4])
def test_policy_gradient_is_that_of_the_loss(shift):
    rng = np.random.default_rng(3)
    layers, log_std = init_layers(SIZES, 0.5, rng, np.float64), np.array([-0.3, 0.1, 0.2])
    obs, action, advantage = _batch(rng)
    mean = forward(layers, obs)[-1]
    # ratios on both sides of the clip, and none on its edge
    old = log_probability(action, mean, log_std) + shift * rng.standard_normal(len(obs))
    _, gradient, by_std = policy_loss(layers, log_std, obs, action, old, advantage, 0.2)

    def loss() -> float:
        return policy_loss(layers, log_std, obs, action, old, advantage, 0.2)[0]

    for array, g in zip(flat(layers), flat(gradient), strict=True):
        for index in list(np.ndindex(array.shape))[:: max(1, array.size // 8)]:
            assert _difference(loss, array, index) == pytest.approx(g[index], abs=1e-7, rel=1e-5)
    for i in range(3):
        assert _difference(loss, log_std, (i,)) == pytest.approx(by_std[i], abs=1e-7, rel=1e-5)


def test_value_gradient_is_that_of_the_loss():
    rng = np.random.default_rng(4)
    layers = init_layers([5, 7, 6, 1], 1.0, rng, np.float64)
    obs, _, target = _batch(rng)
    _, gradient = value_loss(layers, obs, target)
    for array, g in zip(flat(layers), flat(gradient), strict=True):
        for index in list(np.ndindex(array.shape))[:: max(1, array.size // 8)]:
            numeric = _difference(lambda: value_loss(layers, obs, target)[0], array, index)
            assert numeric == pytest.approx(g[index], abs=1e-8, rel=1e-5)


def test_log_probability_is_that_of_normal_distributions():
    rng = np.random.default_rng(5)
    action, mean, log_std = rng.standard_normal((9, 3)), rng.standard_normal((9, 3)), np.array([-1.0, 0, 0.5])
    expected = norm.logpdf(action, mean, np.exp(log_std)).sum(axis=1)
    np.testing.assert_allclose(log_probability(action, mean, log_std), expected)


def test_clipped_samples_have_no_gradient():
    rng = np.random.default_rng(6)
    layers, log_std = init_layers(SIZES, 0.5, rng, np.float64), np.zeros(3)
    obs, action, _ = _batch(rng)
    old = log_probability(action, forward(layers, obs)[-1], log_std) - 1.0  # ratio e, beyond the clip
    _, gradient, by_std = policy_loss(layers, log_std, obs, action, old, np.ones(len(obs)), 0.2)
    assert all(np.abs(g).max() == 0 for g in flat(gradient))
    assert np.abs(by_std).max() == 0


def test_advantages_are_discounted_sums_cut_at_ends():
    reward = np.array([[1.0], [2.0], [3.0]])
    value = np.array([[0.5], [0.25], [0.125]])
    last = np.array([4.0])
    whole = advantages(reward, value, last, np.zeros((3, 1)), 0.9, 1.0)[:, 0]
    returns = [1 + 0.9 * (2 + 0.9 * (3 + 0.9 * 4)), 2 + 0.9 * (3 + 0.9 * 4), 3 + 0.9 * 4]
    np.testing.assert_allclose(whole, np.array(returns) - value[:, 0])
    cut = advantages(reward, value, last, np.array([[0.0], [1.0], [0.0]]), 0.9, 1.0)[:, 0]
    np.testing.assert_allclose(cut, np.array([1 + 0.9 * 2, 2, 3 + 0.9 * 4]) - value[:, 0])
    short = advantages(reward, value, last, np.zeros((3, 1)), 0.9, 0.0)[:, 0]
    np.testing.assert_allclose(short, [1 + 0.9 * 0.25 - 0.5, 2 + 0.9 * 0.125 - 0.25, 3 + 0.9 * 4 - 0.125])


def test_adam_finds_a_minimum_and_clips():
    x = np.array([3.0, -2.0])
    adam = Adam([x], 0.1)
    for _ in range(400):
        adam.step([2 * x], 1e9)
    assert np.abs(x).max() < 1e-2
    y = np.zeros(1)
    Adam([y], 0.1).step([np.array([1e6])], 1.0)
    assert y[0] == pytest.approx(-0.1, rel=1e-3)


def test_normaliser_has_mean_and_variance_of_all_that_it_saw():
    rng = np.random.default_rng(7)
    rows = rng.normal(3.0, 2.0, (1000, 4))
    n = Normaliser(np.zeros(4), np.ones(4))
    for part in np.array_split(rows, 7):
        n.update(part)
    np.testing.assert_allclose(n.mean, rows.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(n.variance, rows.var(axis=0), rtol=1e-4)


def test_learner_solves_a_one_step_task():
    # the best action is a linear function of the observation
    settings = twin_settings()["training"]["ppo"] | {"hidden": [16, 16], "actor_rate": 1e-3}
    rng = np.random.default_rng(8)
    learner = Learner.new(3, 2, settings, rng)
    target = np.array([[0.5, -0.3], [0.2, 0.4], [-0.6, 0.1]])

    def reward(obs, action):
        return -np.sum((action - obs @ target) ** 2, axis=1)

    trial = rng.standard_normal((500, 3)).astype(np.float32)
    before = reward(trial, forward(learner.actor, trial)[-1]).mean()
    for _ in range(60):
        obs = rng.standard_normal((512, 3)).astype(np.float32)
        action, log_p = learner.act(obs)
        r = reward(obs, action)
        learner.update(obs, action, log_p, r - learner.value(obs), r)
    after = reward(trial, forward(learner.actor, trial)[-1]).mean()
    assert after > 0.1 * before
    low, high = settings["actor_rate_range"]
    assert low <= learner.actor_adam.rate <= high
