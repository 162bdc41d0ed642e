"""Does our PPO learn like a reference implementation? The same walker learnt by stable-baselines3, curves side by side.

    python -m venv sb3 && sb3/bin/pip install -r environment-lock.txt ".[crosscheck]"
    sb3/bin/python benchmarks/twin_sb3.py --steps 400000 --seeds 1 2 --out sb3.json

Both see the same environment (`twin.env.WalkEnv`: pushes, holds, resets, time limit), network, discount, clipping,
epochs, minibatches, advantages and observation scaling. Ours adapts the actor's rate to the divergence; theirs has one
rate, and stops an update at the same divergence. Bar: at equal steps the mean episode of ours, over the last fifth of
the training and all seeds, is at least 0.9 of theirs. Nothing of the workflow needs torch.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "workflow"), str(ROOT)]

import numpy as np
from real2sim.artefacts import write_json
from real2sim.configuration import read_yaml, validated
from real2sim.study.twin.env import ACTIONS, OBSERVATIONS, WalkEnv
from real2sim.study.twin.human import with_substeps
from real2sim.study.twin.train import Trainer

from benchmarks.twin import BODIES, reference_of

BAR = 0.9
POINTS = 20


def ours(who: Any, reference: Any, settings: dict, seed: int, steps: int) -> tuple[list[float], float]:
    """Mean episode [s] at equal shares of the steps, and processor seconds."""
    trainer = Trainer(who, reference, settings, seed=seed, threads=1)
    start, curve = time.process_time(), []
    while trainer.steps < steps:
        curve.append((trainer.iterate()["steps"], trainer.mean_episode_s))
    return resampled(curve, steps), time.process_time() - start


def resampled(curve: list[tuple[float, float]], steps: int) -> list[float]:
    """Values at POINTS equal shares of the steps."""
    x, y = np.array(curve).T
    return np.interp(np.linspace(steps / POINTS, steps, POINTS), x, y).tolist()


class _Alone:
    """What a VecEnv has to answer about environments of its own, of which there are none here."""

    num_envs: int

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list:
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list:
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def walkers_of(who: Any, reference: Any, settings: dict, seed: int) -> Any:
    """`WalkEnv` as a VecEnv of stable-baselines3, which is imported only here."""
    from gymnasium import spaces
    from stable_baselines3.common.vec_env import VecEnv

    o = settings["training"]
    n = o["simulations"]

    class Walkers(_Alone, VecEnv):
        """`WalkEnv` as SB3 wants it; pushes grow as in `Trainer.iterate`."""

        def __init__(self) -> None:
            self.env = WalkEnv(
                who,
                with_substeps(settings["human"], o["substeps"]),
                reference,
                o,
                nsim=n,
                threads=1,
                seed=seed,
            )
            self.env.sustained = True
            self.env.hold(o["hold"])
            self.lengths = [0.0] * 200
            self.longest = round(o["episode_s"] / self.env.control_s)
            box = spaces.Box(-np.inf, np.inf, (OBSERVATIONS,), np.float32)
            # theirs wants an end to the actions: so far out that none is cut
            super().__init__(n, box, spaces.Box(-10.0, 10.0, (ACTIONS,), np.float32))

        def reset(self) -> np.ndarray:
            self.env.reset(np.arange(n))
            return self.env.observation().astype(np.float32)

        def step_async(self, actions: np.ndarray) -> None:
            self.action = actions.astype(float)

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
            reward, fallen = self.env.step(self.action)
            timed_out = ~fallen & (self.env.age >= self.longest)
            over = fallen | timed_out
            raw = self.env.observation().astype(np.float32)
            infos: list[dict] = [{} for _ in range(n)]
            ids = np.flatnonzero(over)
            for i in ids:
                infos[i] = {"terminal_observation": raw[i].copy(), "TimeLimit.truncated": bool(timed_out[i])}
            if len(ids):
                self.lengths.extend((self.env.age[ids] * self.env.control_s).tolist())
                del self.lengths[:-200]
                self.env.reset(ids)
                raw = self.env.observation().astype(np.float32)
            return raw, reward * o["reward_scale"], over, infos

    return Walkers()


def theirs(who: Any, reference: Any, settings: dict, seed: int, steps: int) -> tuple[list[float], float]:
    """The same by stable-baselines3."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)
    o = settings["training"]
    ppo, push, n = o["ppo"], o["push"], o["simulations"]
    walkers = walkers_of(who, reference, settings, seed)
    curve: list[tuple[float, float]] = []

    class Curve(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            length = float(np.mean(walkers.lengths[-200:]))
            curve.append((float(self.num_timesteps), length))
            if length > push["gate_s"]:
                walkers.env.push_force = min(
                    walkers.env.push_force + push["ramp_n"], push["force_n"] * push["margin"]
                )

    model = PPO(
        "MlpPolicy",
        VecNormalize(walkers, norm_reward=False),
        learning_rate=ppo["actor_rate"],
        n_steps=o["horizon"],
        batch_size=o["horizon"] * n // ppo["minibatches"],
        n_epochs=ppo["epochs"],
        gamma=ppo["gamma"],
        gae_lambda=ppo["lambda"],
        clip_range=ppo["clip"],
        ent_coef=0.0,
        target_kl=ppo["kl"],
        seed=seed,
        device="cpu",
        policy_kwargs={
            "net_arch": {"pi": ppo["hidden"], "vf": ppo["hidden"]},
            "log_std_init": float(np.log(ppo["std"])),
            "activation_fn": torch.nn.Tanh,
        },
    )
    start = time.process_time()
    model.learn(steps, callback=Curve())
    return resampled(curve, steps), time.process_time() - start


def main() -> int:
    """Print both curves; exit code 1 where the bar is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=400_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    study = validated(read_yaml(ROOT / "config" / "config.yaml"), "config", "config/config.yaml")
    phantom = read_yaml(ROOT / "config" / "phantom.yaml")
    who = BODIES[1.75]
    reference = reference_of(who, study, phantom)
    runs = []
    for seed in a.seeds:
        for name, learn in (("ours", ours), ("stable-baselines3", theirs)):
            curve, seconds = learn(who, reference, study["twin"], seed, a.steps)
            runs.append({"learner": name, "seed": seed, "episode_s": curve, "cpu_s": seconds})
            print(f"seed {seed}, {name}: {seconds:.0f} s", file=sys.stderr, flush=True)
    print(f"{'steps':>8}" + "".join(f"{r['learner'][:6] + ' ' + str(r['seed']):>12}" for r in runs))
    for i in range(POINTS):
        print(f"{a.steps * (i + 1) // POINTS:8d}" + "".join(f"{r['episode_s'][i]:12.2f}" for r in runs))
    tail = POINTS // 5
    ends = {
        name: float(np.mean([r["episode_s"][-tail:] for r in runs if r["learner"] == name]))
        for name in ("ours", "stable-baselines3")
    }
    ratio = ends["ours"] / ends["stable-baselines3"]
    met = ratio >= BAR
    print(
        f"mean episode of the last fifth: {ends['ours']:.2f} s against {ends['stable-baselines3']:.2f} s, ratio "
        f"{ratio:.2f} (bar {BAR}: {'met' if met else 'missed'})"
    )
    if a.out:
        write_json(a.out, {"steps": a.steps, "runs": runs, "ratio": ratio, "bar": BAR, "met": met})
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
