"""Tests of `record_trajectories`, `Trajectories` and `to_minari`: recorded episodes are compared with an environment
that repeats their actions.
"""

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import reveille
from reveille import trajectories
from reveille.environment import PARTS, ReveilleEnv

SMALL = {"devices": 14, "ttis": 150, "battery_knowledge": "reported"}


class RandomPolicy:
    """A policy with random actions that depend only on the seed."""

    def reset(self, seed):
        self.rng = np.random.default_rng(seed)

    def __call__(self, observation):
        assert set(observation) == {"device", "globals", "stage", "action_mask"}
        return self.rng.random(len(observation["action_mask"])) < 0.2


def repeat_episode(env, seed, actions):
    """Repeats the actions of an episode. Returns its observations, rewards, parts of rewards, and last info."""
    obs, info = env.reset(seed=seed)
    seen, rewards, parts = [obs], [], []
    for action in actions:
        obs, reward, _, truncated, info = env.step(action)
        seen.append(obs)
        rewards.append(reward)
        parts.append([info[name] for name in PARTS])
    assert truncated
    return seen, np.array(rewards), np.array(parts), info


@pytest.mark.parametrize("policy", ["age-index", "knn", RandomPolicy()])
def test_a_recorded_episode_equals_its_repetition(policy, tmp_path):
    path = tmp_path / "t.parquet"
    recorded_file = reveille.record_trajectories(path, policy, seeds=3, first_seed=5, mu1=3.0, **SMALL)
    assert len(recorded_file) == 3 and recorded_file.policy == (policy if isinstance(policy, str) else "RandomPolicy")
    assert [info.seed for info in recorded_file.episodes] == [5, 6, 7]
    read_file = reveille.Trajectories(path)
    env = read_file.environment()
    for episode in read_file:
        seen, rewards, parts, last = repeat_episode(env, episode.info.seed, episode.actions)
        assert last["digest"] == episode.info.digest and len(episode.actions) == episode.info.steps
        for key, values in episode.observations.items():
            np.testing.assert_array_equal(values, np.stack([obs[key] for obs in seen]))
            assert values.dtype == env.observation_space[key].dtype
        np.testing.assert_array_equal(episode.rewards, rewards)
        np.testing.assert_array_equal(np.stack([episode.parts[name] for name in PARTS], axis=1), parts)
        assert episode.info.total == pytest.approx(rewards.sum())
        assert episode.truncations[-1] and not episode.truncations[:-1].any() and not episode.terminations.any()
        assert episode.ttis[0] == 0 and episode.ttis[-1] == 150 and (np.diff(episode.ttis) >= 0).all()
        assert episode.info.metrics["events"] == last["metrics"]["events"]
    if policy == "age-index":
        run = reveille.run(policy=policy, seed=6, **SMALL)
        assert read_file.episodes[1].digest == read_file.episodes[1].policy_digest == run["digest"]
    if policy == "knn":
        assert read_file.episodes[1].digest != read_file.episodes[1].policy_digest
        assert read_file.episodes[1].policy_digest == reveille.run(policy=policy, seed=6, **SMALL)["digest"]


def test_a_file_has_the_documented_columns(tmp_path):
    path = tmp_path / "t.parquet"
    recorded_file = reveille.record_trajectories(path, "age-index", seeds=2, **SMALL)
    table = parquet.read_table(path)
    assert table.num_rows == sum(info.steps + 1 for info in recorded_file.episodes)
    n, f, g = 14, len(reveille.DEVICE_FEATURES), len(reveille.GLOBAL_FEATURES)
    types = {field.name: field.type for field in table.schema}
    assert types["device"] == pa.list_(pa.float32(), n * f) and types["globals"] == pa.list_(pa.float32(), g)
    assert types["action"] == pa.list_(pa.uint8()) and types["reward"] == pa.float64()
    last = table.filter(pa.compute.is_null(table["reward"]))
    assert last["episode"].to_pylist() == [0, 1] and last["tti"].to_pylist() == [150, 150]
    assert last["action"].null_count == 2
    row = table.slice(0, 1).to_pylist()[0]
    assert row["step"] == 0 and row["stage"] == 0 and len(row["action"]) == n and set(row["action"]) <= {0, 1}
    metadata = parquet.read_metadata(path).metadata
    assert b"reveille.version" in metadata and recorded_file.version in metadata[b"reveille.version"].decode()
    assert recorded_file.device_features == tuple(feature.name for feature in reveille.DEVICE_FEATURES)
    assert recorded_file.global_features == tuple(feature.name for feature in reveille.GLOBAL_FEATURES)


def test_a_file_contains_its_complete_scenario(tmp_path):
    settings = {**SMALL, "set": {"harvest.lambda": np.float64(0.3), "events.alpha": 0.1}}
    recorded_file = reveille.record_trajectories(tmp_path / "t.parquet", RandomPolicy(), **settings)
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(recorded_file.scenario, encoding="utf-8")
    episode = recorded_file[0]
    *_, last = repeat_episode(ReveilleEnv(str(scenario)), episode.info.seed, episode.actions)
    assert last["digest"] == episode.info.digest
    *_, last = repeat_episode(gym.make("Reveille-v0", **recorded_file.settings), episode.info.seed, episode.actions)
    assert last["digest"] == episode.info.digest


def test_row_groups_have_a_size_limit_and_do_not_change_the_data(tmp_path, monkeypatch):
    path = tmp_path / "t.parquet"
    one_group = reveille.record_trajectories(path, RandomPolicy(), seeds=2, **SMALL)
    monkeypatch.setattr(trajectories, "GROUP_ROWS", 40)
    several_groups = reveille.record_trajectories(tmp_path / "groups.parquet", RandomPolicy(), seeds=2, **SMALL)
    file = parquet.ParquetFile(several_groups.path)
    sizes = [file.metadata.row_group(index).num_rows for index in range(file.num_row_groups)]
    assert max(sizes) == 40 and len(sizes) >= 8
    for info in several_groups.episodes:
        first, count = info.groups
        assert sum(sizes[first : first + count]) == info.steps + 1
    assert parquet.read_table(path).equals(parquet.read_table(several_groups.path))
    for expected, episode in zip(one_group, several_groups, strict=True):
        np.testing.assert_array_equal(expected.actions, episode.actions)
        np.testing.assert_array_equal(expected.observations["device"], episode.observations["device"])


def test_failed_writes_keep_existing_files(tmp_path):
    path = tmp_path / "t.parquet"
    recorded_file = reveille.record_trajectories(path, RandomPolicy(), **SMALL)

    def failing_policy(observation):
        raise ArithmeticError("no action")

    with pytest.raises(ArithmeticError):
        reveille.record_trajectories(path, failing_policy, **SMALL)
    assert reveille.Trajectories(path).episodes == recorded_file.episodes
    assert [file.name for file in tmp_path.iterdir()] == ["t.parquet"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policy": "genie"}, "genie"),
        ({"policy": "kn"}, "kn"),
        ({"policy": "external"}, "external"),
        ({"seeds": 0}, "seeds 0"),
        ({"battery_knowledge": "all"}, "battery_knowledge"),
        ({"policy": lambda _: np.zeros(13)}, r"\(1, 14\)|14"),
    ],
)
def test_errors_name_the_cause(change, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        reveille.record_trajectories(tmp_path / "t.parquet", **{"policy": "random", **SMALL, **change})
    assert not list(tmp_path.iterdir())


def test_another_parquet_file_is_refused(tmp_path):
    path = tmp_path / "other.parquet"
    parquet.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(ValueError, match="not a trajectory file"):
        reveille.Trajectories(path)


def test_a_minari_dataset_has_the_episodes_and_spaces(tmp_path, monkeypatch):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    recorded_file = reveille.record_trajectories(tmp_path / "t.parquet", "age-index", seeds=3, **SMALL)
    created = reveille.to_minari(
        recorded_file,
        "reveille/age-index-v0",
        author="Author",
        author_email="author@example.org",
        code_permalink="none",
    )
    assert created.total_episodes == 3
    dataset = minari.load_dataset("reveille/age-index-v0")
    single = ReveilleEnv(**SMALL)
    assert dataset.observation_space == single.observation_space and dataset.action_space == single.action_space
    assert dataset.total_steps == sum(info.steps for info in recorded_file.episodes)
    env = dataset.recover_environment()
    metadata = dataset.storage.get_episode_metadata(range(3))
    for episode, recorded, known in zip(dataset.iterate_episodes(), recorded_file, metadata, strict=True):
        info = recorded.info
        assert known["digest"] == info.digest and known["seed"] == info.seed
        assert known["metrics"]["info_p1"] == info.metrics["info_p1"]
        assert len(episode) == info.steps
        for key, values in recorded.observations.items():
            np.testing.assert_array_equal(episode.observations[key], values)
        first = {key: values[0] for key, values in episode.observations.items()}
        assert first in dataset.observation_space and episode.actions[0] in dataset.action_space
        np.testing.assert_array_equal(episode.infos["tti"], recorded.ttis)
        seen, rewards, _, last = repeat_episode(env, info.seed, episode.actions)
        np.testing.assert_array_equal(episode.rewards, rewards)
        assert last["digest"] == info.digest
    with pytest.raises(ValueError, match="already exists"):
        reveille.to_minari(recorded_file.path, "reveille/age-index-v0")


def test_a_changed_scenario_file_is_refused(tmp_path):
    scenario = tmp_path / "own.toml"
    scenario.write_text('preset = "quick"\n[harvest]\nlambda = 0.3\n')
    recorded = reveille.record_trajectories(
        tmp_path / "t.parquet", "random", scenario=str(scenario), devices=8, ttis=40, seeds=1
    )
    assert recorded.environment().action_space.n == 8
    scenario.write_text('preset = "quick"\n[harvest]\nlambda = 0.1\n')
    with pytest.raises(ValueError, match="has changed since"):
        recorded.environment()
