# %% [markdown]
# # A base station that learns: PPO
#
# A policy is trained with a library that nobody here wrote, judged beside the program's own policies on seeds that it
# has not seen, and made a function that decides.
#
#     pip install './python[examples]'
#     python python/examples/ppo.py --save ppo.pt          # some minutes of one core
#     python python/examples/ppo.py --load ppo.pt          # judges only
#
# ## Why
#
# Who senses now decides who can pay for a report later. `random` and `knn` do not look at batteries, and run many of 20
# devices flat: about a third of the devices that they tell to sense cannot pay for it. What a look is worth depends on
# where others look and have looked, and on what is left in batteries. That is what PPO is to find out.

# %%
from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

import reveille


class Options(NamedTuple):
    """What is asked for; in a notebook these values are."""

    devices: int = 20
    steps: int = 250_000
    seed: int = 1
    judge: int = 30
    serve: bool = False
    ttis: int = 2000
    price: float = 0.2
    load: Path | None = None
    save: Path | None = None


#: Seeds of training are below this, those of judging are not: the environments draw seeds below 2³¹ - 1.
FIRST_SEED = 2**31


def count(least: int, most: int = 10**9) -> Callable[[str], int]:
    """Reads a whole number from ``least`` to ``most``."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{value}: must be from {least} to {most}")
        return value

    return read


def price(text: str) -> float:
    """Reads a price of energy."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: must be at least 0, and finite")
    return value


def options_of(arguments: Sequence[str]) -> Options:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description="Trains PPO as a base station, and judges it beside other policies.")
    default = Options()
    parser.add_argument(
        "--devices", type=count(2, 1000), default=default.devices, help="number of devices N [%(default)s]"
    )
    parser.add_argument(
        "--steps", type=count(1), default=default.steps, help="decisions of the base station to train on [%(default)s]"
    )
    parser.add_argument(
        "--seed", type=count(0, FIRST_SEED - 1000), default=default.seed, help="seed of the training [%(default)s]"
    )
    parser.add_argument(
        "--judge", type=count(2), default=default.judge, metavar="N_SEEDS", help="seeds to judge on [%(default)s]"
    )
    parser.add_argument("--ttis", type=count(10), default=default.ttis, help="TTIs of a judged run [%(default)s]")
    parser.add_argument(
        "--price", type=price, default=default.price, help="P1 that a unit of energy must bring [%(default)s]"
    )
    parser.add_argument("--load", type=Path, metavar="FILE", help="a trained network: nothing is trained")
    parser.add_argument("--save", type=Path, metavar="FILE", help="where to write the network")
    parser.add_argument(
        "--serve", action="store_true", help="do not judge, decide for a run: that of `reveille up -p external`"
    )
    options = Options(**vars(parser.parse_args(arguments)))
    # Said now, and not after ten minutes of training.
    if options.load and not options.load.is_file():
        parser.error(f"--load {options.load}: there is no such file")
    if options.save and not options.save.absolute().parent.is_dir():
        parser.error(f"--save {options.save}: there is no such folder")
    if options.save and options.save.is_dir():
        parser.error(f"--save {options.save}: is a folder")
    return options


if __name__ == "__main__":
    options = options_of([] if "ipykernel" in sys.modules else sys.argv[1:])
    torch.set_num_threads(1)

# %% [markdown]
# ## The environment
#
# `Reveille-v0` asks at stage 0 who senses and, after reports, at stage 1 whom to wake. Batteries are what devices last
# reported and what is expected to have come since, for all policies alike.
#
# Each device is an agent here, and all share one network: it sees the device's row, what is known of all, and sums over
# the devices around. So the network is small, fits any N, and learns from N decisions where the base station takes one.

# %%
SCENARIO = "paper"
#: Table II: units that a TTI in S1 and a report cost, and d_max as a share of the area's side.
E_IDLE, E_TX, REACH = 1.0, 10.0, 0.2
DEVICE = {feature.name: at for at, feature in enumerate(reveille.DEVICE_FEATURES)}
GLOBAL = {feature.name: at for at, feature in enumerate(reveille.GLOBAL_FEATURES)}
#: What is summed over the devices around.
SUMMED = ("battery", "can_report", "sensing", "since_sensing", "stale", "nearness", "may_wake")
AROUND = [DEVICE[name] for name in SUMMED]

Observation = dict[str, Any]
Decide = Callable[[Observation], NDArray[np.int8]]


def metres(information: NDArray[Any]) -> NDArray[Any]:
    """The distance at which a device has this information, p(d) = exp(-d), at most 8 m; a share of 4 m."""
    return np.minimum(-np.log(np.maximum(information, 1e-6)), 8.0) / 4.0


def apart(rows: NDArray[Any]) -> NDArray[Any]:
    """Distances between devices, shares of the area's side."""
    place = rows[:, :, [DEVICE["x"], DEVICE["y"]]]
    return np.sqrt(np.square(place[:, :, None] - place[:, None]).sum(3))


def may_act(seen: Observation) -> NDArray[np.bool_]:
    """Whose bit counts, (K, N). Of those that could be woken, those within d_max of a reporter."""
    is_near = metres(seen["device"][:, :, DEVICE["nearness"]]) <= 1.0
    return (seen["action_mask"] > 0) & ((seen["stage"] == 0)[:, None] | is_near)


def views(seen: Observation) -> NDArray[np.float32]:
    """What each device sees, (K, N, F), of the observations of K environments."""
    rows, may = seen["device"], may_act(seen)
    all_of = seen["globals"]
    common = np.concatenate([all_of, seen["stage"][:, None], metres(all_of[:, [GLOBAL["information"]]])], 1)
    near = np.exp(np.square(apart(rows) / 0.15) / -2) * (1 - np.eye(rows.shape[1]))
    weight = near.sum(2, keepdims=True)
    far = metres(rows[:, :, [DEVICE["nearness"]]])
    nearest = far.min(1, keepdims=True, where=may[:, :, None], initial=2.0)
    parts = [
        rows,
        np.broadcast_to(common[:, None], (*rows.shape[:2], common.shape[1])),
        may[:, :, None],
        far,
        far - nearest,  # of those that could be woken, is it the nearest to a reporter?
        weight / (1 + weight),
        near @ rows[:, :, AROUND] / (1 + weight),
    ]
    return np.concatenate(parts, 2).astype(np.float32)


# %% [markdown]
# ## The reward
#
# The environment's reward is the paper's. It pays for places that somebody was told to look at, also when that battery
# is empty and nobody looks. At the default weights, to tell all devices to sense in every TTI has a better reward than
# `knn` and `age-index` have, and misses 96 % of the events.
#
# The reward here is the objective, P1, less a price for energy, and counts only what a base station knows of. What a
# device has found counts for all that could have found it, by the share of their reach that they have in common:
# otherwise devices learn to be first, at everybody's cost.


# %%
def in_common(distance: NDArray[Any]) -> NDArray[Any]:
    """The share that two discs of radius d_max have in common."""
    half = np.minimum(distance / (2 * REACH), 1.0)
    return 2 / np.pi * (np.arccos(half) - half * np.sqrt(1 - half**2))


def shares(
    before: Observation, acted: NDArray[np.bool_], seen: Observation, information: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """What each device has a share in, N times its part of P1, and the units that it spends; both (K, N).

    ``information``: what wake-ups have added to Î, (K,).
    """
    n = acted.shape[1]
    plans, asks = (before["stage"] == 0)[:, None], (seen["stage"] == 1)[:, None]
    reports = seen["device"][:, :, DEVICE["information"]]
    best = reports.argmax(1)
    found = reports.max(1)[:, None] * in_common(apart(seen["device"])[np.arange(len(best)), best])
    # The device whose report was the best has added it; where no question shows reports, all that were woken have.
    is_best = acted & (np.arange(n) == best[:, None])
    added = information[:, None] * np.where(asks, is_best, acted / np.maximum(acted.sum(1, keepdims=True), 1))
    gained = np.where(plans, np.where(asks, found, 0.0), added) / seen["globals"][:, GLOBAL["alpha"], None]
    units = np.where(plans, E_IDLE * acted + E_TX * (asks & (reports > 0)), E_TX * acted)
    return n * gained, units


class Training(VecEnv):
    """``reveille.make_vec`` as stable-baselines3 wants it, with an agent for each device. An environment that ends
    begins anew in the same step."""

    def __init__(self, devices: int, price: float, envs: int = 16, ttis: int = 1000) -> None:
        self.inner = reveille.make_vec(
            SCENARIO,
            envs,
            threads=1,
            autoreset="disabled",
            devices=devices,
            ttis=ttis,
            battery_knowledge="reported",
            mu2=1.0,  # then info["information"] is what wake-ups add to Î
        )
        self.shape, self.price, self.render_mode = (envs, devices), price, None
        self.brought = self.plans = 1e-9
        self.seen, _ = self.inner.reset(seed=0)
        width = views(self.seen).shape[2]
        super().__init__(envs * devices, gym.spaces.Box(-2, 2, (width,), np.float32), gym.spaces.Discrete(2))

    def reset(self) -> NDArray[np.float32]:
        self.seen, _ = self.inner.reset(seed=self._seeds[0])
        self._reset_seeds()
        return self.views()

    def views(self) -> NDArray[np.float32]:
        return views(self.seen).reshape(self.num_envs, -1)

    def step_async(self, actions: NDArray[Any]) -> None:
        self.acted = actions.reshape(self.shape).astype(bool) & may_act(self.seen)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        before = self.seen
        self.seen, _, _, ended, told = self.inner.step(self.acted.astype(np.int8))
        gained, units = shares(before, self.acted, self.seen, told["information"])
        reward = self.less_mean(gained - self.price * units, before["stage"] == 0)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if ended.any():
            last = self.views()
            for at in np.flatnonzero(ended):
                for agent in range(at * self.shape[1], (at + 1) * self.shape[1]):
                    infos[agent] = {"terminal_observation": last[agent], "TimeLimit.truncated": True}
                infos[at * self.shape[1]]["metrics"] = told["metrics"][at]
            self.seen, _ = self.inner.reset(options={"reset_mask": ended})
        return self.views(), reward, np.repeat(ended, self.shape[1]), infos

    def less_mean(self, reward: NDArray[Any], plans: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Takes the mean of a TTI off. PPO discounts by decisions, so that to wake somebody, which brings another
        question in the same TTI, would put off all that is to come; what is 0 on average is not missed."""
        self.brought = 0.998 * self.brought + reward.mean()
        self.plans = 0.998 * self.plans + plans.mean()
        centred = reward - plans[:, None] * (self.brought / self.plans)
        return (0.2 * centred).reshape(-1).astype(np.float32)

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError(f"{method_name}: these environments have no methods of their own")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


# %% [markdown]
# ## Training


# %%
class Told(BaseCallback):
    """Tells now and then how the episodes are that end."""

    def __init__(self, devices: int, every: float = 30.0) -> None:
        super().__init__()
        self.devices, self.every, self.due = devices, every, 0.0
        self.began, self.cpu = time.monotonic(), time.process_time()
        self.runs: list[dict[str, float]] = []

    def tell(self) -> None:
        passed, cpu = time.monotonic() - self.began, time.process_time() - self.cpu
        line = f"{self.num_timesteps // self.devices:8} decisions, {passed:4.0f} s, {cpu:4.0f} s of CPU"
        if self.runs:
            p1 = statistics.fmean(run["info_p1"] for run in self.runs)
            energy = statistics.fmean(run["energy_per_device_tti"] for run in self.runs)
            line += f": P1 {p1:.4f}, energy {energy:.4f}"
        print(line, flush=True)
        self.due, self.runs = passed + self.every, []

    def _on_step(self) -> bool:
        self.runs += [info["metrics"] for info in self.locals["infos"] if "metrics" in info]
        if self.runs and time.monotonic() - self.began > self.due:
            self.tell()
        return True

    def _on_training_end(self) -> None:
        self.tell()


def network(width: int) -> nn.Sequential:
    """An untrained network: from what a device sees to the logits of its two bits."""
    return nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 2))


def train(options: Options) -> nn.Sequential:
    """Trains a network."""
    environments = Training(options.devices, options.price)
    model = PPO(
        "MlpPolicy",
        environments,
        learning_rate=lambda left: 1e-3 * max(left, 0.05),
        n_steps=64,
        batch_size=4096,
        n_epochs=4,
        gamma=0.98,
        gae_lambda=0.8,
        ent_coef=0.01,
        seed=options.seed,
        device="cpu",
    )
    with torch.no_grad():
        model.policy.action_net.bias.copy_(torch.tensor([0.5, -0.5]))  # to begin with, few sense
    model.learn(options.steps * options.devices, callback=Told(options.devices))
    return nn.Sequential(*model.policy.mlp_extractor.policy_net, model.policy.action_net)


def load(path: Path, options: Options) -> nn.Sequential:
    """Reads a network.

    :raises ValueError: it is none.
    """
    loaded = network(Training(options.devices, options.price, envs=1).observation_space.shape[0])
    try:
        loaded.load_state_dict(torch.load(path, weights_only=True))
    except Exception as error:  # torch tells of broken files by many types
        raise ValueError(f"{path} holds no network of this example: {str(error).splitlines()[0]}") from error
    return loaded


if __name__ == "__main__":
    try:
        net = load(options.load, options) if options.load else train(options)
    except ValueError as error:
        sys.exit(f"error: {error}")
    if options.save:
        torch.save(net.state_dict(), options.save)
        print(f"{options.save}: {options.save.stat().st_size / 1000:.0f} kB")

# %% [markdown]
# ## Deciding
#
# A decision is a function of an observation, NumPy in and NumPy out, and the same whenever it is asked. The chances add
# up to how many devices PPO would choose on average; so many are chosen, those with the highest chances.


# %%
def decider(net: nn.Sequential) -> Decide:
    """The decision that ``net`` takes on what is seen."""

    def decide(seen: Observation) -> NDArray[np.int8]:
        whole = {key: np.asarray(value)[None] for key, value in seen.items()}
        with torch.no_grad():
            logits = net(torch.from_numpy(views(whole)[0]))
        chances = torch.softmax(logits, 1)[:, 1].numpy() * may_act(whole)[0]
        action = np.zeros(len(chances), dtype=np.int8)
        action[np.argsort(-chances, kind="stable")[: int(chances.sum() + 0.5)]] = 1
        return action

    return decide


if __name__ == "__main__":
    decide = decider(net)

# %% [markdown]
# ## Judging
#
# The same scenario, length and seeds for all; PPO was trained on none of these seeds. P1 per energy can be won by doing
# little, so P1 stands beside it. `age-index`, `q-learning` and `dt` are the program's best. The first and the last have
# a price θ of energy too: to be fair, a second row has one that suits few devices better than the default does. One
# policy alone is told where events are, `genie`. Intervals are 95 %, Student's t over runs; differences are by seed.

# %%
#: The policies, each with the fields that are set for it.
JUDGED: dict[str, tuple[str, dict[str, Any]]] = {
    "random": ("random", {}),
    "knn": ("knn", {}),
    "age-index": ("age-index", {}),
    "age-index θ=4": ("age-index", {"policy.age-index.price": 4.0}),
    "q-learning": ("q-learning", {}),
    "dt": ("dt", {}),
    "dt θ=4": ("dt", {"policy.dt.price": 4.0}),
    "genie": ("genie", {}),
}
COLUMNS = {
    "P1": "info_p1",
    "energy": "energy_per_device_tti",
    "P1/energy": "per_energy",
    "missed %": "misdetection_pct",
    "wrong": "wrong_activations_per_event",
    "low energy %": "low_energy_pct",
}
Runs = dict[str, NDArray[np.float64]]


def half_width(values: NDArray[np.float64]) -> float:
    """Half of the 95 % interval of the mean."""
    freedom = len(values) - 1
    z = statistics.NormalDist().inv_cdf(0.975)
    beyond = (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
    beyond += (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * freedom**3)
    t = {1: 12.71, 2: 4.30}.get(freedom, z + beyond)
    return t * float(values.std(ddof=1)) / len(values) ** 0.5


def with_ratio(told: dict[str, Any]) -> Runs:
    """The columns, as arrays."""
    runs = {name: np.array(told[name], float) for name in COLUMNS.values() if name != "per_energy"}
    return runs | {"per_energy": runs["info_p1"] / runs["energy_per_device_tti"]}


def runs_of_ours(decide: Decide, options: Options) -> Runs:
    """A run for each seed, decided by ``decide``."""
    env = gym.make(
        "Reveille-v0",
        scenario=SCENARIO,
        devices=options.devices,
        ttis=options.ttis,
        battery_knowledge="reported",
        disable_env_checker=True,
    )
    rows = []
    for seed in range(FIRST_SEED, FIRST_SEED + options.judge):
        seen, info = env.reset(seed=seed)
        done = False
        while not done:
            seen, _, _, done, info = env.step(decide(seen))
        rows.append(info["metrics"])
    return with_ratio({name: [row[name] for row in rows] for name in rows[0]})


def runs_of(policy: str, fields: dict[str, Any], options: Options) -> Runs:
    """A run for each seed of a policy of the program."""
    table = reveille.sweep(
        SCENARIO,
        policies=[policy],
        devices=[options.devices],
        ttis=[options.ttis],
        set={"bs.battery_knowledge": "reported", **fields},
        seeds=options.judge,
        first_seed=FIRST_SEED,
        threads=1,
    )
    return with_ratio(table.to_pydict())


def judge(decide: Decide, options: Options) -> dict[str, Runs]:
    """Runs all, and prints them side by side."""
    print(f"N = {options.devices}, {options.judge} seeds of {options.ttis} TTIs, batteries as reported")
    print("policy".ljust(14), *(name.rjust(15) for name in COLUMNS))
    runs = {"ppo": runs_of_ours(decide, options)}
    for name in ("ppo", *JUDGED):
        if name in JUDGED:
            runs[name] = runs_of(*JUDGED[name], options)
        columns = (runs[name][key] for key in COLUMNS.values())
        cells = (f"{values.mean():.3f} ± {half_width(values):.3f}" for values in columns)
        print(name.ljust(14), *(cell.rjust(15) for cell in cells), flush=True)
    print("ppo less the other, by seed")
    for other in JUDGED:
        cells = []
        for title in ("P1", "energy", "P1/energy"):
            more = runs["ppo"][COLUMNS[title]] - runs[other][COLUMNS[title]]
            cells.append(f"{title} {more.mean():+.3f} ± {half_width(more):.3f}")
        print(other.ljust(14), "   ".join(cells))
    return runs


if __name__ == "__main__" and not options.serve:
    judge(decide, options)

# %% [markdown]
# ## In the program
#
# `reveille up --policy external` asks for decisions over zenoh, with what `decide` takes and gives:
#
#     reveille up -n 20 --policy external --set bs.battery_knowledge=reported \
#         --policy-command 'python python/examples/ppo.py --load ppo.pt --serve'


# %%
def serve(decide: Decide) -> int:
    """Decides for a run until it is over. Gives the number of decisions."""
    return reveille.PolicyClient(decide, name="ppo").serve()


if __name__ == "__main__" and options.serve:
    serve(decide)
