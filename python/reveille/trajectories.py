"""Trajectories: observations, actions and rewards by step, in Parquet files and as Minari datasets.

A file holds the rows of its episodes in order. An episode of T steps has T + 1 rows: one for each decision, and one for
the final observation. The action, the reward and the columns after it are null in the final row.

==================================  ===========================  ====================================================
column                              type                         meaning
==================================  ===========================  ====================================================
``episode``                         int32                        from 0
``step``                            int32                        from 0
``tti``                             int64                        the TTI of the decision, from 0
``stage``                           int8                         0: δ(k); 1: wake-ups
``device``                          N·F float32, fixed size      :data:`reveille.DEVICE_FEATURES`, device by device
``globals``                         G float32, fixed size        :data:`reveille.GLOBAL_FEATURES`
``action_mask``                     N int8, fixed size           2: either bit; 0: a 1 would be dropped
``action``                          list of N uint8              the bits
``reward``                          float64                      the sum of its parts
``asleep`` ``missed``               float64                      the parts of the reward
``information`` ``woken``
``terminated`` ``truncated``        bool                         whether the episode ended with this step
==================================  ===========================  ====================================================

Row groups end with their episodes, so that an episode can be read alone. The file's metadata under ``reveille.``
describes its contents: see :class:`Trajectories`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from . import _native
from .environment import PARTS, Observation, ReveilleEnv
from .runs import run
from .scenario import DEVICE_FEATURES, GLOBAL_FEATURES, Setting

if TYPE_CHECKING:
    import minari
    import pyarrow

#: The version of the columns, raised when the meaning of one changes.
SCHEMA = "1"
#: Maximum rows of a row group, and its approximate maximum in bytes.
GROUP_ROWS, GROUP_BYTES = 4096, 16 << 20
_PREFIX = "reveille."

#: A policy: the name of a built-in policy, or a function from observation to action.
Policy: TypeAlias = "str | Callable[[Observation], NDArray[np.int8]]"


@dataclass(frozen=True)
class EpisodeInfo:
    """Summary of an episode."""

    #: Its number in the file, from 0.
    episode: int
    #: The seed with which the environment was reset.
    seed: int
    #: The number of decisions, T.
    steps: int
    #: The sum of its rewards.
    total: float
    #: The digest of the run, 64 hexadecimal digits.
    digest: str
    #: The digest of the policy's own run, for a built-in policy. It differs from ``digest`` if the policy sends duty
    #: cycles, see :func:`reveille.run`.
    policy_digest: str | None
    #: The metrics of the run by name; an undefined metric is None.
    metrics: Mapping[str, float | None]
    #: Its row groups: the first and their number.
    groups: tuple[int, int]


@dataclass(frozen=True)
class Episode:
    """An episode of T steps."""

    info: EpisodeInfo
    #: ``device`` (T + 1, N, F) float32, ``globals`` (T + 1, G) float32, ``stage`` (T + 1,) int64, ``action_mask``
    #: (T + 1, N) int8: observations as in the environment, before each step and after the last.
    observations: dict[str, NDArray[Any]]
    #: (T, N) int8, 0 or 1.
    actions: NDArray[np.int8]
    #: (T,) float64.
    rewards: NDArray[np.float64]
    #: The parts of the rewards by name, (T,) float64 each.
    parts: dict[str, NDArray[np.float64]]
    #: The TTI of each decision, then the number of TTIs, (T + 1,) int64.
    ttis: NDArray[np.int64]
    #: (T,) bool; no episode is terminated.
    terminations: NDArray[np.bool_]
    #: (T,) bool; true in the last step.
    truncations: NDArray[np.bool_]


class Trajectories:
    """The episodes of a file, read one at a time: ``len(t)``, ``t[i]``, and ``for episode in t``."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Opens a file written by :func:`record_trajectories`.

        Needs PyArrow.

        :raises ValueError: the file holds no trajectories, or has another version of the columns.
        :raises OSError: the file cannot be read.
        """
        from pyarrow import parquet

        self.path = Path(path)
        self._file = parquet.ParquetFile(self.path)
        pairs = {key.decode(): value.decode() for key, value in (self._file.metadata.metadata or {}).items()}
        if pairs.get(f"{_PREFIX}steps") != SCHEMA:
            found = pairs.get(f"{_PREFIX}steps")
            what = "not a trajectory file" if found is None else f"columns of version {found}, not {SCHEMA}"
            raise ValueError(f"{self.path}: {what}; use a file that reveille.record_trajectories wrote")

        def told(key: str) -> Any:
            return json.loads(pairs[_PREFIX + key])

        #: The version of Reveille that wrote the file.
        self.version: str = pairs[f"{_PREFIX}version"]
        #: The policy that decided.
        self.policy: str = pairs[f"{_PREFIX}policy"]
        #: The arguments of the environment: ``gymnasium.make("Reveille-v0", **settings)`` makes the same one.
        self.settings: dict[str, Any] = told("settings")
        #: The whole scenario, all fields, as TOML. The seed comes from each episode.
        self.scenario: str = pairs[f"{_PREFIX}scenario"]
        #: The names of the columns of ``device``.
        self.device_features: tuple[str, ...] = tuple(told("device_features"))
        #: The names of the columns of ``globals``.
        self.global_features: tuple[str, ...] = tuple(told("global_features"))
        #: Summaries of the episodes.
        self.episodes: tuple[EpisodeInfo, ...] = tuple(
            EpisodeInfo(**{**one, "groups": tuple(one["groups"])}) for one in told("episodes")
        )

    def __len__(self) -> int:
        return len(self.episodes)

    def __iter__(self) -> Iterator[Episode]:
        return (self[at] for at in range(len(self)))

    def __getitem__(self, at: int) -> Episode:
        info = self.episodes[at]
        first, count = info.groups
        table = self._file.read_row_groups(range(first, first + count))

        def flat(name: str, rows: int) -> NDArray[Any]:
            return _values(table.column(name).slice(0, rows)).reshape(rows, -1)

        t, n = info.steps, flat("action_mask", 1).shape[1]
        seen = t + 1

        def plain(name: str, rows: int) -> NDArray[Any]:
            return table.column(name).slice(0, rows).to_numpy()

        return Episode(
            info=info,
            observations={
                "device": flat("device", seen).reshape(seen, n, len(self.device_features)),
                "globals": flat("globals", seen),
                "stage": plain("stage", seen).astype(np.int64),
                "action_mask": flat("action_mask", seen),
            },
            actions=flat("action", t).astype(np.int8),
            rewards=plain("reward", t),
            parts={name: plain(name, t) for name in PARTS},
            ttis=plain("tti", seen),
            terminations=plain("terminated", t),
            truncations=plain("truncated", t),
        )

    def environment(self) -> ReveilleEnv:
        """Makes the environment in which the episodes were recorded.

        :raises ValueError: its scenario is a file that is missing or has changed.
        """
        return self.checked(ReveilleEnv(**self.settings))

    def checked(self, env: ReveilleEnv) -> ReveilleEnv:
        """Returns ``env`` if it has the scenario of the episodes.

        :raises ValueError: the scenario is another one.
        """
        if env._batch.scenario != self.scenario:
            raise ValueError(
                f"scenario {self.settings['scenario']!r} has changed since {self.path} was recorded; "
                "write the text of Trajectories.scenario into a file and create the environment from it"
            )
        return env


def _values(column: pyarrow.ChunkedArray) -> NDArray[Any]:
    """Concatenates the lists of a column."""
    import pyarrow as pa

    chunks = [chunk.flatten() for chunk in column.chunks]
    return (pa.concat_arrays(chunks) if len(chunks) > 1 else chunks[0]).to_numpy(zero_copy_only=False)


class _Writer:
    """Writer that buffers at most one row group."""

    def __init__(self, path: Path, n: int, about: Mapping[str, str]) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        f, g = len(DEVICE_FEATURES), len(GLOBAL_FEATURES)
        columns: list[tuple[str, pa.DataType]] = [
            ("episode", pa.int32()),
            ("step", pa.int32()),
            ("tti", pa.int64()),
            ("stage", pa.int8()),
            ("device", pa.list_(pa.float32(), n * f)),
            ("globals", pa.list_(pa.float32(), g)),
            ("action_mask", pa.list_(pa.int8(), n)),
            ("action", pa.list_(pa.uint8())),
            ("reward", pa.float64()),
            *((name, pa.float64()) for name in PARTS),
            ("terminated", pa.bool_()),
            ("truncated", pa.bool_()),
        ]
        self._schema = pa.schema(columns)
        rows = max(1, min(GROUP_ROWS, GROUP_BYTES // (4 * (n * f + g) + 2 * n)))
        widths = {"device": n * f, "globals": g, "action_mask": n, "action": n}
        self._held = {
            name: np.zeros((rows, widths[name]) if name in widths else rows, _numpy_of(kind)) for name, kind in columns
        }
        self._rows, self._count, self._groups, self._is_last = rows, 0, 0, False
        self._about = dict(about)
        self._path, self._part = path, path.with_name(f"{path.name}.part")
        self._file = parquet.ParquetWriter(self._part, self._schema, compression="zstd")

    def see(self, episode: int, step: int, tti: int, observation: Observation) -> None:
        """Starts a row with its observation."""
        if self._count == self._rows:
            self._flush()
        told = {"episode": episode, "step": step, "tti": tti, **observation}
        for name, value in told.items():
            held = self._held[name][self._count]
            if isinstance(held, np.ndarray):
                held[:] = np.ravel(value)
            else:
                self._held[name][self._count] = value
        self._count += 1

    def act(self, action: NDArray[Any], reward: float, info: Mapping[str, Any], truncated: bool) -> None:
        """Completes the row with the action and its reward."""
        told = {"action": action, "reward": reward, "terminated": False, "truncated": truncated}
        told.update((name, info[name]) for name in PARTS)
        for name, value in told.items():
            self._held[name][self._count - 1] = value

    def end_episode(self) -> int:
        """Ends the episode after its final observation. Returns the number of row groups so far."""
        self._is_last = True
        self._flush()
        return self._groups

    def _flush(self) -> None:
        import pyarrow as pa

        count, is_last = self._count, self._is_last
        if count == 0:
            return
        nulls = np.zeros(count, dtype=bool)
        nulls[-1] = is_last
        columns = []
        for field in self._schema:
            values = self._held[field.name][:count]
            if field.name == "action":
                n = values.shape[1]
                acted = count - int(is_last)
                offsets = pa.array(np.minimum(np.arange(count + 1), acted) * n, pa.int32(), mask=np.append(nulls, False))
                columns.append(pa.ListArray.from_arrays(offsets, pa.array(values[:acted].ravel())))
            elif pa.types.is_fixed_size_list(field.type):
                columns.append(pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), type=field.type))
            else:
                is_of_step = field.name in ("reward", "terminated", "truncated", *PARTS)
                columns.append(pa.array(values, field.type, mask=nulls if is_of_step else None))
        self._file.write_batch(pa.record_batch(columns, schema=self._schema), row_group_size=count)
        self._count, self._is_last = 0, False
        self._groups += 1

    def close(self, episodes: Sequence[EpisodeInfo]) -> None:
        """Writes the metadata and moves the finished file to its path."""
        told = {**self._about, "episodes": json.dumps([asdict(one) for one in episodes], allow_nan=False)}
        self._file.add_key_value_metadata({_PREFIX + key: value for key, value in told.items()})
        self._file.close()
        os.replace(self._part, self._path)

    def drop(self) -> None:
        """Discards the partial file."""
        self._file.close()
        self._part.unlink(missing_ok=True)


def _numpy_of(kind: pyarrow.DataType) -> Any:
    import pyarrow as pa

    is_list = pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind)
    return (kind.value_type if is_list else kind).to_pandas_dtype()


def record_trajectories(
    path: str | os.PathLike[str],
    policy: Policy,
    *,
    seeds: int = 1,
    first_seed: int = 1,
    name: str | None = None,
    scenario: str = "paper",
    devices: int | None = None,
    ttis: int | None = None,
    battery_knowledge: str | None = None,
    mu1: float = 14.0,
    mu2: float = 1.0,
    set: Mapping[str, Setting] | None = None,  # noqa: A002
) -> Trajectories:
    """Records runs in the environment, one episode for each seed, in a Parquet file that replaces ``path``.

    Memory holds at most one row group, about 16 MiB, and for a built-in policy the actions of one run. Needs Gymnasium
    and PyArrow.

    :param policy: one of :func:`reveille.policies` except ``genie``, or a function from an observation to an action, N
        zeros and ones. If it has a method ``reset``, that is called with the seed before each episode.
    :param seeds: number of episodes, ≥ 1, with the seeds ``first_seed`` and following.
    :param name: name of the policy in the file; by default its own name.

    The other parameters are as in :class:`reveille.environment.ReveilleEnv`.

    :raises ValueError: the scenario or policy is refused; the message names the field and the allowed values.
    """
    if seeds < 1:
        raise ValueError(f"seeds {seeds}: must be at least 1")
    settings: dict[str, Any] = {
        "scenario": scenario,
        "devices": devices,
        "ttis": ttis,
        "battery_knowledge": battery_knowledge,
        "mu1": mu1,
        "mu2": mu2,
        "set": None if set is None else dict(set),
    }
    env = ReveilleEnv(**settings)
    if name is None:
        name = policy if isinstance(policy, str) else getattr(policy, "__name__", type(policy).__name__)
    about = {
        "steps": SCHEMA,
        "version": version("reveille-emulator"),
        "policy": name,
        "settings": json.dumps(settings, default=_plain),
        "scenario": env._batch.scenario,
        "device_features": json.dumps([feature.name for feature in DEVICE_FEATURES]),
        "global_features": json.dumps([feature.name for feature in GLOBAL_FEATURES]),
    }
    writer = _Writer(Path(path), env.action_space.n, about)
    try:
        episodes: list[EpisodeInfo] = []
        for seed in range(first_seed, first_seed + seeds):
            episodes.append(_episode(writer, env, policy, settings, len(episodes), seed))
        writer.close(episodes)
    except BaseException:
        writer.drop()
        raise
    return Trajectories(path)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # a NumPy value
        return value.tolist()
    raise TypeError(f"{value!r}: not a field value")


def _episode(
    writer: _Writer, env: ReveilleEnv, policy: Policy, settings: Mapping[str, Any], episode: int, seed: int
) -> EpisodeInfo:
    """Records one run from its first decision to its last."""
    policy_digest, digest = None, None
    if isinstance(policy, str):
        fields = {key: value for key, value in settings.items() if key not in ("mu1", "mu2")}
        told = run(policy=policy, seed=seed, actions=True, **fields)
        policy_digest, digest = told["digest"], told["stepped"]["digest"]
        rows = iter(told["actions"])
        decide: Callable[[Observation], NDArray[Any]] = lambda _: next(rows)  # noqa: E731
    else:
        decide = policy
        if hasattr(policy, "reset"):
            policy.reset(seed)
    begun = writer._groups
    observation, info = env.reset(seed=seed)
    step, total, truncated = 0, 0.0, False
    while not truncated:
        writer.see(episode, step, info["tti"], observation)
        action = np.asarray(decide(observation)).astype(bool)
        observation, reward, _, truncated, info = env.step(action)
        writer.act(action, reward, info, truncated)
        step, total = step + 1, total + reward
    writer.see(episode, step, info["tti"], observation)
    if digest not in (None, info["digest"]):
        raise RuntimeError(f"seed {seed}: the actions of {policy} and its run have different digests; this is a bug")
    metrics = {key: value if np.isfinite(value) else None for key, value in info["metrics"].items()}
    groups = (begun, writer.end_episode() - begun)
    return EpisodeInfo(episode, seed, step, total, info["digest"], policy_digest, metrics, groups)


def to_minari(
    trajectories: Trajectories | str | os.PathLike[str], dataset_id: str, **told: Any
) -> minari.MinariDataset:
    """Makes a Minari dataset, which ``minari.load_dataset(dataset_id)`` then finds.

    It has the spaces of ``Reveille-v0``, and ``recover_environment()`` returns the environment of the recording. An
    episode's infos are the parts of the rewards, (T,) each, and ``tti``, (T + 1,). Its seed, digest and metrics are in
    the episode metadata: ``dataset.storage.get_episode_metadata([i])``. Memory holds one episode at a time. Needs
    Minari with HDF5.

    :param trajectories: the recorded trajectories, or their file.
    :param dataset_id: ``"namespace/name-v0"``, as Minari requires.
    :param told: further metadata of a Minari dataset, such as ``author``, ``code_permalink`` or ``description``.
    :raises ValueError: Minari has a dataset of that name, or there are no episodes.
    """
    import gymnasium as gym
    import minari
    from minari.data_collector import EpisodeBuffer

    if not isinstance(trajectories, Trajectories):
        trajectories = Trajectories(trajectories)
    env = gym.make("Reveille-v0", **trajectories.settings)
    trajectories.checked(env.unwrapped)
    told.setdefault("algorithm_name", trajectories.policy)
    told.setdefault("eval_env", env.spec)
    told.setdefault("description", f"{trajectories.policy} in Reveille {trajectories.version}:\n\n{trajectories.scenario}")
    dataset = None
    for episode in trajectories:
        info = episode.info
        buffer = EpisodeBuffer(
            id=info.episode,
            seed=info.seed,
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=episode.terminations,
            truncations=episode.truncations,
            infos={**episode.parts, "tti": episode.ttis},
        )
        if dataset is None:
            dataset = minari.create_dataset_from_buffers(dataset_id, [buffer], env=env, **told)
        else:
            dataset.update_dataset_from_buffer([buffer])
        known = {f"metrics/{key}": value for key, value in info.metrics.items() if value is not None}
        dataset.storage.update_episode_metadata([{"digest": info.digest, **known}], [info.episode])
    if dataset is None:
        raise ValueError(f"{trajectories.path}: holds no episodes")
    return dataset
