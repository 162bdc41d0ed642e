"""Proximal policy optimisation in numpy (Schulman et al., arXiv 1707.06347): two small networks and their gradients.

Why our own: networks of two hidden layers of 128 units are faster in numpy than in torch at this batch size, and no
user has to install gigabytes (docs/decisions/0099-ppo-in-numpy.md). The gradients are tested against finite
differences.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from real2sim.settings import TwinTrainingPpoSettings

Layers = list[tuple[np.ndarray, np.ndarray]]
LOG_2PI = float(np.log(2 * np.pi))


def init_layers(
    sizes: list[int], last_gain: float, rng: np.random.Generator, dtype: type = np.float32
) -> Layers:
    """Orthogonal weights (gain sqrt 2, ``last_gain`` at the end) and zero biases for a tanh network."""
    layers: Layers = []
    for i, (n_in, n_out) in enumerate(pairwise(sizes)):
        a = rng.standard_normal((max(n_in, n_out), min(n_in, n_out)))
        q, r = np.linalg.qr(a)
        q = q * np.sign(np.diag(r))
        gain = last_gain if i == len(sizes) - 2 else np.sqrt(2)
        w = (q if n_in >= n_out else q.T) * gain
        layers.append((w.astype(dtype), np.zeros(n_out, dtype)))
    return layers


def forward(layers: Layers, x: np.ndarray) -> list[np.ndarray]:
    """Return activations (m, width) of every layer, input (m, n) first; tanh inside, linear at the end."""
    out = [x]
    for i, (w, b) in enumerate(layers):
        x = x @ w + b
        if i < len(layers) - 1:
            x = np.tanh(x)
        out.append(x)
    return out


def backward(layers: Layers, activations: list[np.ndarray], gradient: np.ndarray) -> Layers:
    """Return gradients by weights (i, o) and biases (o,) of each layer from that by the output (m, a)."""
    out: Layers = []
    for i in range(len(layers) - 1, -1, -1):
        out.append((activations[i].T @ gradient, gradient.sum(axis=0)))
        if i:
            gradient = (gradient @ layers[i][0].T) * (1 - activations[i] ** 2)
    return out[::-1]


@dataclass
class Adam:
    """Adam (Kingma & Ba 2015) over a list of arrays, in place."""

    parameters: list[np.ndarray]
    rate: float
    moments: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    steps: int = 0

    def __post_init__(self) -> None:
        if not self.moments:
            self.moments = [(np.zeros_like(p), np.zeros_like(p)) for p in self.parameters]

    def step(self, gradients: list[np.ndarray], largest_norm: float) -> None:
        """Take one descent step along gradients shaped like the parameters, of any shape; their norm is clipped."""
        self.steps += 1
        norm = float(np.sqrt(sum(float(np.sum(g.astype(np.float64) ** 2)) for g in gradients)))
        clip = min(1.0, largest_norm / (norm + 1e-8))
        correct = np.sqrt(1 - 0.999**self.steps) / (1 - 0.9**self.steps)
        for p, g, (m, v) in zip(self.parameters, gradients, self.moments, strict=True):
            g = g * clip
            m += 0.1 * (g - m)
            v += 0.001 * (g * g - v)
            p -= (self.rate * correct * m / (np.sqrt(v) + 1e-7)).astype(p.dtype)


def flat(layers: Layers) -> list[np.ndarray]:
    """Return the arrays of a network in one list: weights (i, o) and biases (o,) in turn."""
    return [a for layer in layers for a in layer]


def layers_of(arrays: list[np.ndarray]) -> Layers:
    """Return layers of weights (i, o) and biases (o,): the inverse of `flat`."""
    return list(zip(arrays[::2], arrays[1::2], strict=True))


def log_probability(action: np.ndarray, mean: np.ndarray, log_std: np.ndarray) -> np.ndarray:
    """Of actions (m, a) under independent normal distributions, (m,)."""
    z = (action - mean) * np.exp(-log_std)
    return np.asarray(-0.5 * np.sum(z * z, axis=1) - np.sum(log_std) - 0.5 * LOG_2PI * action.shape[1])


def policy_loss(
    layers: Layers,
    log_std: np.ndarray,
    obs: np.ndarray,
    action: np.ndarray,
    old_log_p: np.ndarray,
    advantage: np.ndarray,
    clip: float,
) -> tuple[float, Layers, np.ndarray]:
    """Return the clipped surrogate loss (to be minimised), its gradient by the layers and by ``log_std`` (a,).

    For observations (m, n), actions (m, a), their old log-probabilities (m,) and advantages (m,).
    """
    activations = forward(layers, obs)
    mean = activations[-1]
    inverse = np.exp(-log_std)
    z = (action - mean) * inverse
    log_p = -0.5 * np.sum(z * z, axis=1) - np.sum(log_std) - 0.5 * LOG_2PI * action.shape[1]
    ratio = np.exp(log_p - old_log_p)
    kept = ratio * advantage
    clipped = np.clip(ratio, 1 - clip, 1 + clip) * advantage
    n = len(obs)
    loss = -float(np.mean(np.minimum(kept, clipped)))
    d_log_p = np.where(kept <= clipped, -kept / n, 0.0).astype(mean.dtype)[:, None]
    gradient = backward(layers, activations, d_log_p * z * inverse)
    return loss, gradient, np.sum(d_log_p * (z * z - 1), axis=0)


def value_loss(layers: Layers, obs: np.ndarray, target: np.ndarray) -> tuple[float, Layers]:
    """Half the mean squared error of the value (m,), and its gradient by the layers."""
    activations = forward(layers, obs)
    error = activations[-1][:, 0] - target
    loss = 0.5 * float(np.mean(error**2))
    return loss, backward(layers, activations, (error / len(obs))[:, None].astype(obs.dtype))


def advantages(
    reward: np.ndarray,
    value: np.ndarray,
    last_value: np.ndarray,
    ended: np.ndarray,
    gamma: float,
    lam: float,
) -> np.ndarray:
    """Generalised advantage estimates (t, n); ``ended`` (t, n) cuts the episode after a step."""
    out = np.zeros_like(reward)
    carried = np.zeros(reward.shape[1])
    following = last_value
    for t in range(len(reward) - 1, -1, -1):
        on = 1.0 - ended[t]
        delta = reward[t] + gamma * following * on - value[t]
        carried = delta + gamma * lam * on * carried
        out[t] = carried
        following = value[t]
    return out


@dataclass
class Normaliser:
    """Running mean and variance of observations, frozen when told to."""

    mean: np.ndarray
    variance: np.ndarray
    count: float = 1e-4

    def update(self, x: np.ndarray) -> None:
        """Take in observations (m, n)."""
        m, v, n = x.mean(axis=0), x.var(axis=0), len(x)
        total = self.count + n
        delta = m - self.mean
        self.variance = (self.variance * self.count + v * n + delta**2 * self.count * n / total) / total
        self.mean = self.mean + delta * n / total
        self.count = total

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Normalised observations, float32, clipped at 8."""
        return np.asarray(np.clip((x - self.mean) / np.sqrt(self.variance + 1e-6), -8, 8).astype(np.float32))


@dataclass
class Learner:
    """Actor and critic with an optimiser each; the actor's rate follows the KL divergence of an update."""

    actor: Layers
    critic: Layers
    log_std: np.ndarray
    settings: TwinTrainingPpoSettings
    rng: np.random.Generator
    actor_adam: Adam = field(init=False)
    critic_adam: Adam = field(init=False)

    def __post_init__(self) -> None:
        s = self.settings
        self.actor_adam = Adam([*flat(self.actor), self.log_std], s["actor_rate"])
        self.critic_adam = Adam(flat(self.critic), s["critic_rate"])

    @classmethod
    def new(
        cls, observations: int, actions: int, settings: TwinTrainingPpoSettings, rng: np.random.Generator
    ) -> Learner:
        """Fresh networks; the actor starts at no correction."""
        hidden = list(settings["hidden"])
        return cls(
            init_layers([observations, *hidden, actions], 0.01, rng),
            init_layers([observations, *hidden, 1], 1.0, rng),
            np.full(actions, np.log(settings["std"]), np.float32),
            settings,
            rng,
        )

    def act(self, obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return actions (m, a) drawn for normalised observations (m, n), and their log-probability (m,)."""
        mean = forward(self.actor, obs)[-1]
        action = mean + np.exp(self.log_std) * self.rng.standard_normal(mean.shape).astype(np.float32)
        return action, log_probability(action, mean, self.log_std)

    def value(self, obs: np.ndarray) -> np.ndarray:
        """Value of normalised observations (m,)."""
        return forward(self.critic, obs)[-1][:, 0]

    def update(
        self,
        obs: np.ndarray,
        action: np.ndarray,
        log_p: np.ndarray,
        advantage: np.ndarray,
        target: np.ndarray,
    ) -> float:
        """Several epochs over a batch (m, ...); returns the KL divergence from the policy before."""
        s, n = self.settings, len(obs)
        advantage = ((advantage - advantage.mean()) / (advantage.std() + 1e-8)).astype(np.float32)
        target = target.astype(np.float32)
        old_mean, old_log_std = forward(self.actor, obs)[-1], self.log_std.copy()
        kl = 0.0
        for _ in range(s["epochs"]):
            order = self.rng.permutation(n)
            for part in np.array_split(order, s["minibatches"]):
                _, g, g_std = policy_loss(
                    self.actor, self.log_std, obs[part], action[part], log_p[part], advantage[part], s["clip"]
                )
                self.actor_adam.step([*flat(g), g_std], 1.0)
                np.clip(self.log_std, np.log(s["std_floor"]), 0.0, out=self.log_std)
                _, gv = value_loss(self.critic, obs[part], target[part])
                self.critic_adam.step(flat(gv), 0.5)
            kl = self._kl(obs, old_mean, old_log_std)
            rate = self.actor_adam.rate
            if kl > 2 * s["kl"]:
                rate /= 1.5
            elif kl < 0.5 * s["kl"]:
                rate *= 1.5
            lowest, highest = s["actor_rate_range"]
            self.actor_adam.rate = float(np.clip(rate, lowest, highest))
        return kl

    def _kl(self, obs: np.ndarray, old_mean: np.ndarray, old_log_std: np.ndarray) -> float:
        mean = forward(self.actor, obs)[-1]
        old, new = np.exp(2 * old_log_std), np.exp(2 * self.log_std)
        return float(
            np.mean(
                np.sum(self.log_std - old_log_std + (old + (old_mean - mean) ** 2) / (2 * new) - 0.5, axis=1)
            )
        )
