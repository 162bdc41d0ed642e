"""Training of a policy: rollouts, updates, pushes once it walks, an early end when it passes, a checkpoint."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from real2sim.artefacts import write_json
from real2sim.provenance import fingerprint, provenance, sha256
from real2sim.study.twin.checkpoint import (
    UnusableCheckpoint,
    check_shapes,
    read_checkpoint,
    write_checkpoint,
)
from real2sim.study.twin.env import ACTIONS, OBSERVATIONS, WalkEnv
from real2sim.study.twin.evaluate import (
    PUSH_DIRECTIONS,
    PUSH_PHASES,
    accepted,
    battery_of,
    free_walk,
    keeps_speeds,
    plain,
    pushed_walk,
    speeds_of,
    walkers_at_speeds,
    withstands,
)
from real2sim.study.twin.gait import Reference
from real2sim.study.twin.human import Body, body_of, with_substeps
from real2sim.study.twin.policy import Policy, load_reference, save_policy
from real2sim.study.twin.ppo import Learner, Normaliser, advantages, flat, layers_of

if TYPE_CHECKING:
    from real2sim.settings import TwinSettings

PACKAGES = ["mujoco", "numpy"]


class Trainer:
    """One training, which can be saved between iterations and goes on to the same bits.

    Parameters
    ----------
    who, reference
        Person and gait.
    settings
        Slice ``twin`` of the configuration.
    seed, threads
        Of everything random, and of the simulations; the result does not depend on the threads.
    """

    def __init__(self, who: Body, reference: Reference, settings: TwinSettings, *, seed: int, threads: int):
        self.who, self.reference, self.settings = who, reference, settings
        self.options = settings["training"]
        sims = self.options["simulations"]
        human = with_substeps(settings["human"], self.options["substeps"])
        self.env = WalkEnv(who, human, reference, self.options, nsim=sims, threads=threads, seed=seed)
        self.env.sustained = True
        self.env.hold(self.options["hold"])
        if reference.speeds is not None:
            self.env.vary(self.options["speeds"])
        self._threads = threads
        self.learner = Learner.new(
            OBSERVATIONS, ACTIONS, self.options["ppo"], np.random.default_rng([seed, 1])
        )
        self._mean_actor = [a.copy() for a in flat(self.learner.actor)]
        self.normaliser = Normaliser(np.zeros(OBSERVATIONS), np.ones(OBSERVATIONS))
        self.iteration = 0
        self.steps = 0
        self.passes = 0
        # bars met, steps and policy of the examination that went best
        self.best: tuple[int, int, Policy] | None = None
        self.episode = np.zeros(0)
        self.evaluations: list[dict[str, Any]] = []
        self.curve: list[dict[str, float]] = []
        self.env.reset(np.arange(sims))
        # lengths of the episodes that ended last [s]
        self._lengths = [0.0] * 200

    def policy(self) -> Policy:
        """Return the deterministic policy as it is now: the mean of the last updates' weights.

        Single updates walk back and forth about it: the floor force of one and the next differs by half a body weight.
        """
        return Policy(
            layers_of([a.copy() for a in self._mean_actor]),
            self.normaliser.mean.copy(),
            self.normaliser.variance.copy(),
            self.reference,
            self.who,
        )

    @property
    def mean_episode_s(self) -> float:
        """Return the mean length of the last 200 episodes [s]."""
        return float(np.mean(self._lengths[-200:]))

    def iterate(self) -> dict[str, float]:
        """Roll out all simulations and update once; return figures of it."""
        o, env, learner = self.options, self.env, self.learner
        horizon, n = o["horizon"], env.nsim
        obs = np.empty((horizon, n, OBSERVATIONS), np.float32)
        action = np.empty((horizon, n, ACTIONS), np.float32)
        log_p, value, reward, ended = (np.empty((horizon, n)) for _ in range(4))
        raw = env.observation()
        longest = round(o["episode_s"] / env.control_s)
        learning = self.iteration < o["normaliser_iterations"]
        force = 0.0
        for t in range(horizon):
            if learning:
                self.normaliser.update(raw)
            obs[t] = self.normaliser(raw)
            action[t], log_p[t] = learner.act(obs[t])
            value[t] = learner.value(obs[t])
            reward[t], fallen = env.step(action[t].astype(float))
            force += float(np.mean(np.maximum(env.floor_force_bw() - 1.3, 0)))
            timed_out = ~fallen & (env.age >= longest)
            raw = env.observation()
            if timed_out.any():
                later = learner.value(self.normaliser(raw[timed_out])).astype(float)
                reward[t, timed_out] += o["ppo"]["gamma"] / o["reward_scale"] * later
            over = fallen | timed_out
            ended[t] = over
            if over.any():
                ids = np.flatnonzero(over)
                self._lengths.extend((env.age[ids] * env.control_s).tolist())
                env.reset(ids)
                raw = env.observation()
        del self._lengths[:-200]
        last = learner.value(self.normaliser(raw)).astype(float)
        reward *= o["reward_scale"]
        gae = advantages(reward, value, last, ended, o["ppo"]["gamma"], o["ppo"]["lambda"])
        kl = learner.update(
            obs.reshape(-1, OBSERVATIONS),
            action.reshape(-1, ACTIONS),
            log_p.ravel().astype(np.float32),
            gae.ravel(),
            (gae + value).ravel(),
        )
        self._average_weights()
        self._ramp_pushes()
        self.iteration += 1
        self.steps += horizon * n
        row = {
            "steps": float(self.steps),
            "episode_s": self.mean_episode_s,
            "reward": float(reward.mean()) / o["reward_scale"],
            "push_n": float(env.push_force),
            "rate": float(learner.actor_adam.rate),
            "kl": kl,
            "std": float(np.exp(learner.log_std).mean()),
            "force": force / horizon,
        }
        self.curve.append(row)
        return row

    def _average_weights(self) -> None:
        """Move the averaged weights toward the actor's: a plain mean at first, then one that forgets."""
        share = 1 / min(self.iteration + 1, self.options["ppo"]["averaged_updates"])
        for mean, now in zip(self._mean_actor, flat(self.learner.actor), strict=True):
            mean += share * (now - mean)

    def _ramp_pushes(self) -> None:
        """Raise the pushes by a step once episodes are long enough, up to their largest."""
        push = self.options["push"]
        if self.mean_episode_s > push["gate_s"]:
            largest = push["force_n"] * push["margin"]
            self.env.push_force = min(self.env.push_force + push["ramp_n"], largest)

    def _env(self, nsim: int, seed: int) -> WalkEnv:
        return WalkEnv(
            self.who,
            self.settings["human"],
            self.reference,
            self.options,
            nsim=nsim,
            threads=self._threads,
            seed=seed,
        )

    def evaluate(self) -> dict[str, Any]:
        """Examine the policy as it is now; return figures and the bars that it meets.

        The free walk of the acceptance; where that is passed, also single pushes and a short walk under pushes, so
        that a training does not end with a policy that walks well and falls easily.
        """
        e, bars = self.settings["evaluation"], self.settings["acceptance"]
        policy = self.policy()
        walk = free_walk(self._env(e["walkers"], 0), policy, seconds=e["walk_s"], settle_s=e["settle_s"])
        met = accepted(walk, bars)
        verdict: dict[str, Any] = {"steps": self.steps, "walk": walk, "met": met}
        if self.reference.speeds is not None and e["shares"]:
            verdict["speeds"] = speeds_of(self._env(walkers_at_speeds(e), 0), policy, e)
            met["speeds"] = keeps_speeds(verdict["speeds"], bars)
        if all(met.values()):
            crowd = self._env(PUSH_DIRECTIONS * PUSH_PHASES, 1)
            verdict["battery"] = battery_of(crowd, policy, e)
            minutes = min(self.options["evaluate_push_minutes"], e["push_minutes"])
            verdict["pushes"] = pushed_walk(
                crowd, policy, force_n=e["push_n"][0], minutes=minutes, settle_s=e["settle_s"]
            )
            met["battery"] = verdict["battery"]["survived_share"] >= bars["battery_share"]
            met["pushes"] = withstands(verdict["pushes"], bars)
        return verdict | {"passed": all(met.values())}

    def keep(self, verdict: dict[str, Any]) -> None:
        """Remember the policy as it is now if none examined before it met more bars."""
        met = sum(verdict["met"].values())
        if self.best is None or met >= self.best[0]:
            self.best = (met, self.steps, self.policy())

    def chosen(self) -> tuple[int, Policy]:
        """Return steps and policy of the examination that met most bars, the latest of equals; as now without one."""
        return (self.steps, self.policy()) if self.best is None else self.best[1:]

    # -------------------- going on after an interruption

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that change from iteration to iteration, by name: the arrays themselves, not copies."""
        learner, env = self.learner, self.env
        lists = {
            "actor": flat(learner.actor),
            "mean_actor": self._mean_actor,
            "critic": flat(learner.critic),
            "actor_moments": [m for pair in learner.actor_adam.moments for m in pair],
            "critic_moments": [m for pair in learner.critic_adam.moments for m in pair],
        }
        named = {f"{name}_{i}": array for name, arrays in lists.items() for i, array in enumerate(arrays)}
        own = {
            "log_std": learner.log_std,
            "normaliser_mean": self.normaliser.mean,
            "normaliser_variance": self.normaliser.variance,
            "simulations": env.batch.state,
            "phase": env.phase,
            "age": env.age,
            "lane_y": env.lane_y,
            "share": env.share,
            "share_goal": env.share_goal,
            "last_action": env._last,
            "off_speed": env.off_speed,
            "push_left": env._push_left,
            "push_next": env._push_next,
            "impulse": env.impulse,
        }
        return named | own | ({} if env.stops is None else {"stops_robot": env.stops.robot})

    def _numbers(self) -> dict[str, Any]:
        """Return all else that changes from iteration to iteration, as JSON holds it."""
        adams = (self.learner.actor_adam, self.learner.critic_adam)
        return {
            "adam": [[adam.steps, adam.rate] for adam in adams],
            "normaliser_count": self.normaliser.count,
            "random": [rng.bit_generator.state for rng in (self.learner.rng, self.env.rng)],
            "push_force": self.env.push_force,
            "counters": [self.iteration, self.steps, self.passes],
            "lengths": list(self._lengths),
            "evaluations": self.evaluations,
            "curve": self.curve,
            "best": None if self.best is None else list(self.best[:2]),
        }

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint; ``key`` names what the training rests on."""
        best = {} if self.best is None else _policy_arrays(self.best[2])
        write_checkpoint(path, self._arrays() | best, {"key": key} | self._numbers())

    def load(
        self, path: Path, key: str, report: Callable[[str], None] = lambda text: print(text, file=sys.stderr)
    ) -> bool:
        """Continue from a checkpoint of the same ``key``; return False where there is none that can be used.

        A file that cannot be used is reported in one line and leaves the training as it is.
        """
        try:
            arrays, about = read_checkpoint(path)
            if about.get("key") != key:
                raise UnusableCheckpoint("of other settings, another person or another version")
            check_shapes(arrays, self._arrays())
            best = self._best_of(arrays, about)
            resumed = {name: about[name] for name in self._numbers()}
            (iteration, steps, passes), adams, (own, of_env) = (
                resumed[name] for name in ("counters", "adam", "random")
            )
            for state in (own, of_env):
                np.random.PCG64().state = state
        except FileNotFoundError:
            return False
        except (UnusableCheckpoint, KeyError, TypeError, ValueError) as error:
            reason = str(error) if isinstance(error, UnusableCheckpoint) else f"incomplete ({error!r})"
            report(f"{path} is not used: {reason}. The training starts from the beginning.")
            return False
        for name, array in self._arrays().items():
            array[...] = arrays[name]
        learner, env = self.learner, self.env
        learner.rng.bit_generator.state, env.rng.bit_generator.state = own, of_env
        for adam, (count, rate) in zip((learner.actor_adam, learner.critic_adam), adams, strict=True):
            adam.steps, adam.rate = count, rate
        self.normaliser.count, env.push_force = resumed["normaliser_count"], resumed["push_force"]
        self.iteration, self.steps, self.passes, self.best = iteration, steps, passes, best
        self._lengths, self.evaluations, self.curve = (
            resumed[name] for name in ("lengths", "evaluations", "curve")
        )
        return True

    def _best_of(
        self, arrays: dict[str, np.ndarray], about: dict[str, Any]
    ) -> tuple[int, int, Policy] | None:
        """Return bars met, steps and policy of the best examination that a checkpoint holds, None without one."""
        if about["best"] is None:
            return None
        check_shapes(arrays, _policy_arrays(self.policy()))
        met, steps = about["best"]
        count = len(self._mean_actor)
        actor = layers_of([arrays[f"best_actor_{i}"] for i in range(count)])
        own = arrays["best_mean"], arrays["best_variance"]
        return met, steps, Policy(actor, *own, self.reference, self.who)


def _policy_arrays(policy: Policy) -> dict[str, np.ndarray]:
    """Return what a policy has learnt, by the names of a checkpoint."""
    actor = {f"best_actor_{i}": array for i, array in enumerate(flat(policy.actor))}
    return actor | {"best_mean": policy.mean, "best_variance": policy.variance}


def train(
    trainer: Trainer,
    *,
    checkpoint: Path | None = None,
    key: str = "",
    progress: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
) -> str:
    """Train until the acceptance evaluation passes twice in a row, or the steps or the time are spent.

    Returns why it ended: ``passed twice``, ``steps``, or ``time``. Only the last depends on the machine.
    """
    o = trainer.options
    start, spent = time.monotonic(), time.process_time()
    if checkpoint is not None and trainer.load(checkpoint, key, progress):
        progress(f"going on from {trainer.steps} steps")
    reported = -np.inf
    while True:
        row = trainer.iterate()
        elapsed = time.monotonic() - start
        if elapsed - reported > o["report_s"]:
            reported = elapsed
            progress(
                f"{trainer.steps / 1e6:.2f} M steps of {o['steps'] / 1e6:.1f} M, {elapsed:.0f} s: episodes of "
                f"{row['episode_s']:.1f} s, reward {row['reward']:.3f}, pushes up to {row['push_n']:.0f} N, "
                f"force {row['force']:.3f}, std {row['std']:.3f}, rate {row['rate']:.1e}"
            )
            if checkpoint is not None:
                trainer.save(checkpoint, key)
        every = o["evaluate_every_steps"]
        crossed = trainer.steps // every != (trainer.steps - o["horizon"] * trainer.env.nsim) // every
        if (
            crossed
            and trainer.steps >= o["evaluate_from_steps"]
            and trainer.env.push_force >= o["push"]["force_n"]
        ):
            verdict = trainer.evaluate()
            trainer.evaluations.append(verdict)
            trainer.keep(verdict)
            trainer.passes = trainer.passes + 1 if verdict["passed"] else 0
            progress(f"{trainer.steps / 1e6:.2f} M steps: {summary(verdict)}")
            if trainer.passes >= o["passes"]:
                return "passed twice"
        if trainer.steps >= o["steps"]:
            return "steps"
        # the processor's time, which a busy machine does not cut short
        if time.process_time() - spent > o["processor_s"]:
            return "time"


def summary(verdict: dict[str, Any]) -> str:
    """Return one line about an evaluation."""
    walk = verdict["walk"]
    joints = "; ".join(
        f"{name.split('_')[0]} RoM {v['rom_error_deg']:+.1f} peak {v['peak_error_deg']:+.1f} "
        f"RMSE {v['rmse_deg']:.1f} r {v['r']:.3f}"
        for name, v in walk["joints"].items()
    )
    missed = ", ".join(name for name, ok in verdict["met"].items() if not ok) or "none"
    peak = walk["floor_force_peak_bw"]["mean_of_strides"]
    speed = walk["speed_error"]
    return (
        f"{walk['falls']} falls, speed {100 * (speed if speed is not None else np.nan):+.1f} %, {joints}, "
        f"floor {peak if peak is None else round(peak, 2)} BW, missed: {missed}"
    )


def training_key(who: Body, reference: Path, settings: TwinSettings, seed: int) -> str:
    """Return the key that a checkpoint must have for a training to continue from it.

    How policies are examined and what they have to meet decide which one is kept, and so belong to it.
    """
    about = [who.height_m, who.mass_kg, who.sex, sha256(reference)]
    about += [settings[name] for name in ("human", "training", "evaluation", "acceptance")]
    about += [seed, mujoco.__version__, fingerprint(__name__)]
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def twin_train(
    *,
    person: Path,
    reference: Path,
    seed: int,
    settings: TwinSettings,
    out: Path,
    record: Path,
    checkpoint: Path,
    threads: int = 1,
) -> None:
    """Train one policy of a person; goes on from a checkpoint of the same work, which is removed at the end.

    ``settings`` is the slice ``twin``; ``out`` the policy (.npz), ``record`` what it rests on and how it learnt.
    """
    who, phantom = body_of(person)
    trainer = Trainer(who, load_reference(reference), settings, seed=seed, threads=threads)
    start, used = time.monotonic(), time.process_time()
    ended = train(trainer, checkpoint=checkpoint, key=training_key(who, reference, settings, seed))
    print(
        f"{ended}: {trainer.steps} steps, {time.monotonic() - start:.0f} s wall, "
        f"{time.process_time() - used:.0f} s of processor",
        file=sys.stderr,
    )
    chosen_steps, policy = trainer.chosen()
    save_policy(out, policy)
    write_json(
        record,
        {
            "phantom": phantom,
            "seed": seed,
            "ended": ended,
            "reproducible": ended != "time",
            "steps": trainer.steps,
            "policy_steps": chosen_steps,
            "bytes": out.stat().st_size,
            "evaluations": plain(trainer.evaluations),
            "curve": [{k: round(v, 6) for k, v in row.items()} for row in trainer.curve[::10]],
            "provenance": provenance([person, reference], PACKAGES, fingerprint(__name__)),
        },
    )
    checkpoint.unlink(missing_ok=True)
