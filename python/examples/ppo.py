# %% [markdown]
# # A base station that learns: PPO
#
# This example trains a policy with a third-party library and compares it with the program's own policies on seeds
# unseen in training. It then turns the policy into a function that decides for a run.
#
#     pip install './python[examples]'
#     python python/examples/ppo.py --save ppo.pt          # some minutes of one core
#     python python/examples/ppo.py --load ppo.pt          # judges only
#
# ## Why
#
# A device that senses now may not have the energy for a report later. `random` and `knn` ignore batteries and drain
# many of 20 devices: about a third of the devices that they tell to sense cannot pay for it. The value of sensing
# depends on where other devices sense and have sensed, and on the energy left in batteries. PPO must learn this value.

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
    """Command-line options; a notebook uses the defaults."""

    devices: int = 20
    steps: int = 250_000
    seed: int = 1
    judge: int = 30
    serve: bool = False
    ttis: int = 2000
    price: float = 0.2
    load: Path | None = None
    save: Path | None = None


#: Training seeds are below this and evaluation seeds are not: the environments draw seeds below 2³¹ - 1.
FIRST_SEED = 2**31


def count(least: int, most: int = 10**9) -> Callable[[str], int]:
    """Returns a parser for a whole number from ``least`` to ``most``."""

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
    """Parses a price of energy."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: must be at least 0, and finite")
    return value


def options_of(arguments: Sequence[str]) -> Options:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description="Trains PPO as a base station, and compares it with other policies.")
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
        "--serve", action="store_true", help="decide for a run of `reveille up -p external` instead of judging"
    )
    options = Options(**vars(parser.parse_args(arguments)))
    # Checked before ten minutes of training, not after.
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
# `Reveille-v0` asks for the sensing devices at stage 0 and, after reports, for the devices to wake at stage 1.
# Batteries are the last reported levels plus the expected harvest since, for all policies alike.
#
# Each device is an agent, and all share one network. Its inputs are the device's row, global information, and sums over
# nearby devices. So the network is small, fits any N, and learns from N decisions for each base station decision.

# %%
SCENARIO = "paper"
#: Table II: cost of a TTI in S1 and of a report, in energy units, and d_max as a share of the area's side.
E_IDLE, E_TX, REACH = 1.0, 10.0, 0.2
DEVICE, GLOBAL = reveille.DEVICE_COLUMNS, reveille.GLOBAL_COLUMNS
#: The features summed over nearby devices.
SUMMED = ("battery", "can_report", "sensing", "since_sensing", "stale", "nearness", "may_wake")
AROUND = [DEVICE[name] for name in SUMMED]

Observation = dict[str, Any]
Decide = Callable[[Observation], NDArray[np.int8]]


def metres(information: NDArray[Any]) -> NDArray[Any]:
    """Returns the distance with this information, from p(d) = exp(-d), at most 8 m, in units of 4 m."""
    return np.minimum(-np.log(np.maximum(information, 1e-6)), 8.0) / 4.0


def apart(rows: NDArray[Any]) -> NDArray[Any]:
    """Returns the distances between devices, as shares of the area's side."""
    place = rows[:, :, [DEVICE["x"], DEVICE["y"]]]
    return np.sqrt(np.square(place[:, :, None] - place[:, None]).sum(3))


def may_act(seen: Observation) -> NDArray[np.bool_]:
    """Returns the mask of effective bits, (K, N); at stage 1 only wakeable devices within d_max of a reporter."""
    is_near = metres(seen["device"][:, :, DEVICE["nearness"]]) <= 1.0
    return (seen["action_mask"] > 0) & ((seen["stage"] == 0)[:, None] | is_near)


def views(seen: Observation) -> NDArray[np.float32]:
    """Returns the network input of each device, (K, N, F), from the observations of K environments."""
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
        far - nearest,  # is the device the nearest to a reporter among those that could be woken?
        weight / (1 + weight),
        near @ rows[:, :, AROUND] / (1 + weight),
    ]
    return np.concatenate(parts, 2).astype(np.float32)


# %% [markdown]
# ## The reward
#
# The environment's reward is the paper's. It pays for places where the plan lets a device sense, even if an empty battery
# prevents it. At the default weights, telling all devices to sense in every TTI earns a better reward than `knn` and
# `age-index` earn, and misses 96 % of the events.
#
# The reward here is the objective P1 minus a price for energy, and it uses only information of a base station. A
# detection is credited to every device that could have made it, by the overlap of their sensing discs. Without this,
# devices learn to be first, at the expense of all.


# %%
def in_common(distance: NDArray[Any]) -> NDArray[Any]:
    """Returns the share that two discs of radius d_max have in common."""
    half = np.minimum(distance / (2 * REACH), 1.0)
    return 2 / np.pi * (np.arccos(half) - half * np.sqrt(1 - half**2))


def shares(
    before: Observation, acted: NDArray[np.bool_], seen: Observation, information: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns N times each device's credited part of P1, and the energy units that it spends; both (K, N).

    ``information``: the gain of Î by wake-ups, (K,).
    """
    n = acted.shape[1]
    plans, asks = (before["stage"] == 0)[:, None], (seen["stage"] == 1)[:, None]
    reports = seen["device"][:, :, DEVICE["information"]]
    best = reports.argmax(1)
    found = reports.max(1)[:, None] * in_common(apart(seen["device"])[np.arange(len(best)), best])
    # The gain belongs to the device with the best report. Without reports in the request, all woken devices share it.
    is_best = acted & (np.arange(n) == best[:, None])
    added = information[:, None] * np.where(asks, is_best, acted / np.maximum(acted.sum(1, keepdims=True), 1))
    gained = np.where(plans, np.where(asks, found, 0.0), added) / seen["globals"][:, GLOBAL["alpha"], None]
    units = np.where(plans, E_IDLE * acted + E_TX * (asks & (reports > 0)), E_TX * acted)
    return n * gained, units


class Training(VecEnv):
    """``reveille.make_vec`` with the interface of stable-baselines3 and an agent for each device. An environment that
    ends starts its next episode in the same step."""

    def __init__(self, devices: int, price: float, envs: int = 16, ttis: int = 1000) -> None:
        self.inner = reveille.make_vec(
            SCENARIO,
            envs,
            threads=1,
            autoreset="disabled",
            devices=devices,
            ttis=ttis,
            battery_knowledge="reported",
            mu2=1.0,  # then info["information"] is the gain of Î by wake-ups
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
        """Subtracts the mean reward of a TTI. PPO discounts by decisions, and a wake-up adds a decision in the same
        TTI: it would delay all later rewards. With a mean of 0, the delay costs nothing on average."""
        self.brought = 0.998 * self.brought + reward.mean()
        self.plans = 0.998 * self.plans + plans.mean()
        centred = reward - plans[:, None] * (self.brought / self.plans)
        return (0.2 * centred).reshape(-1).astype(np.float32)

    def close(self) -> None:
        """Does nothing; the environments hold no resources."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError(f"{method_name}: these environments have no such method")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


# %% [markdown]
# ## Training


# %%
class Told(BaseCallback):
    """Prints statistics of ended episodes at intervals."""

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
    """Returns an untrained network, from the input of a device to the logits of its two bits."""
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
        model.policy.action_net.bias.copy_(torch.tensor([0.5, -0.5]))  # few devices sense at first
    model.learn(options.steps * options.devices, callback=Told(options.devices))
    return nn.Sequential(*model.policy.mlp_extractor.policy_net, model.policy.action_net)


def load(path: Path, options: Options) -> nn.Sequential:
    """Loads a network.

    :raises ValueError: the file holds no network of this example.
    """
    loaded = network(Training(options.devices, options.price, envs=1).observation_space.shape[0])
    try:
        loaded.load_state_dict(torch.load(path, weights_only=True))
    except Exception as error:  # torch raises many types of errors for broken files
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
# A decision is a deterministic function of an observation, NumPy in and NumPy out. The probabilities sum to PPO's mean
# number of chosen devices. The function chooses this number of devices, those with the highest probabilities.


# %%
def decider(net: nn.Sequential) -> Decide:
    """Returns the decision function of ``net``."""

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
# All policies run the same scenario, length and seeds, which were not used in training. Little action yields a high P1
# per energy, so the table shows P1 as well. `age-index`, `q-learning` and `dt` are the program's best policies.
# `age-index` and `dt` have a price θ of energy too; for fairness a second row has a price that suits small N better
# than the default. Only `genie` knows where events are. Intervals are 95 %, Student's t over runs; differences are by
# seed.

# %%
#: The policies, with their field settings.
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
    """Returns half of the 95 % interval of the mean."""
    freedom = len(values) - 1
    z = statistics.NormalDist().inv_cdf(0.975)
    beyond = (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
    beyond += (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * freedom**3)
    t = {1: 12.71, 2: 4.30}.get(freedom, z + beyond)
    return t * float(values.std(ddof=1)) / len(values) ** 0.5


def with_ratio(told: dict[str, Any]) -> Runs:
    """Returns the columns as arrays, with P1 per energy."""
    runs = {name: np.array(told[name], float) for name in COLUMNS.values() if name != "per_energy"}
    return runs | {"per_energy": runs["info_p1"] / runs["energy_per_device_tti"]}


def runs_of_ours(decide: Decide, options: Options) -> Runs:
    """Runs ``decide`` on each seed."""
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
    """Runs a built-in policy on each seed."""
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
    """Runs all policies and prints their results side by side."""
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
# `reveille up --policy external` requests decisions over zenoh, with the inputs and outputs of `decide`:
#
#     reveille up -n 20 --policy external --set bs.battery_knowledge=reported \
#         --policy-command 'python python/examples/ppo.py --load ppo.pt --serve'


# %%
def serve(decide: Decide) -> int:
    """Decides for a run until it is over. Returns the number of decisions."""
    return reveille.PolicyClient(decide, name="ppo").serve()


if __name__ == "__main__" and options.serve:
    serve(decide)
