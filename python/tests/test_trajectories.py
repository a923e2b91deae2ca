"""Trajectories in Parquet files and in Minari datasets."""

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import reveille
from reveille import trajectories
from reveille.environment import PARTS, ReveilleEnv

SMALL = {"devices": 14, "ttis": 150, "battery_knowledge": "reported"}


class Drawn:
    """A policy that draws actions, the same for the same seed."""

    def reset(self, seed):
        self.rng = np.random.default_rng(seed)

    def __call__(self, observation):
        assert set(observation) == {"device", "globals", "stage", "action_mask"}
        return self.rng.random(len(observation["action_mask"])) < 0.2


def replayed(env, seed, actions):
    """Steps the actions of an episode again; returns all outputs and the last info."""
    obs, info = env.reset(seed=seed)
    seen, rewards, parts = [obs], [], []
    for action in actions:
        obs, reward, _, truncated, info = env.step(action)
        seen.append(obs)
        rewards.append(reward)
        parts.append([info[name] for name in PARTS])
    assert truncated
    return seen, np.array(rewards), np.array(parts), info


@pytest.mark.parametrize("policy", ["age-index", "knn", Drawn()])
def test_an_episode_read_back_and_stepped_again_is_the_recorded(policy, tmp_path):
    told = reveille.record_trajectories(tmp_path / "t.parquet", policy, seeds=3, first_seed=5, mu1=3.0, **SMALL)
    assert len(told) == 3 and told.policy == (policy if isinstance(policy, str) else "Drawn")
    assert [info.seed for info in told.episodes] == [5, 6, 7]
    again = reveille.Trajectories(tmp_path / "t.parquet")
    env = again.environment()
    for episode in again:
        seen, rewards, parts, last = replayed(env, episode.info.seed, episode.actions)
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
        own = reveille.run(policy=policy, seed=6, **SMALL)
        assert again.episodes[1].digest == again.episodes[1].policy_digest == own["digest"]
    if policy == "knn":
        assert again.episodes[1].digest != again.episodes[1].policy_digest
        assert again.episodes[1].policy_digest == reveille.run(policy=policy, seed=6, **SMALL)["digest"]


def test_a_file_is_read_without_the_package(tmp_path):
    path = tmp_path / "t.parquet"
    told = reveille.record_trajectories(path, "age-index", seeds=2, **SMALL)
    table = parquet.read_table(path)
    assert table.num_rows == sum(info.steps + 1 for info in told.episodes)
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
    assert b"reveille.version" in metadata and told.version in metadata[b"reveille.version"].decode()
    assert told.device_features == tuple(feature.name for feature in reveille.DEVICE_FEATURES)
    assert told.global_features == tuple(feature.name for feature in reveille.GLOBAL_FEATURES)


def test_the_scenario_of_a_file_is_whole(tmp_path):
    settings = {**SMALL, "set": {"harvest.lambda": np.float64(0.3), "events.alpha": 0.1}}
    told = reveille.record_trajectories(tmp_path / "t.parquet", Drawn(), **settings)
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(told.scenario, encoding="utf-8")
    episode = told[0]
    *_, last = replayed(ReveilleEnv(str(scenario)), episode.info.seed, episode.actions)
    assert last["digest"] == episode.info.digest
    *_, last = replayed(gym.make("Reveille-v0", **told.settings), episode.info.seed, episode.actions)
    assert last["digest"] == episode.info.digest


def test_no_more_than_a_row_group_is_held(tmp_path, monkeypatch):
    path = tmp_path / "t.parquet"
    whole = reveille.record_trajectories(path, Drawn(), seeds=2, **SMALL)
    monkeypatch.setattr(trajectories, "GROUP_ROWS", 40)
    parts = reveille.record_trajectories(tmp_path / "parts.parquet", Drawn(), seeds=2, **SMALL)
    file = parquet.ParquetFile(parts.path)
    sizes = [file.metadata.row_group(at).num_rows for at in range(file.num_row_groups)]
    assert max(sizes) == 40 and len(sizes) >= 8
    for info in parts.episodes:
        first, count = info.groups
        assert sum(sizes[first : first + count]) == info.steps + 1
    assert parquet.read_table(path).equals(parquet.read_table(parts.path))
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(a.actions, b.actions)
        np.testing.assert_array_equal(a.observations["device"], b.observations["device"])


def test_failed_writes_keep_existing_files(tmp_path):
    path = tmp_path / "t.parquet"
    told = reveille.record_trajectories(path, Drawn(), **SMALL)

    def fails(observation):
        raise ArithmeticError("no action")

    with pytest.raises(ArithmeticError):
        reveille.record_trajectories(path, fails, **SMALL)
    assert reveille.Trajectories(path).episodes == told.episodes
    assert [file.name for file in tmp_path.iterdir()] == ["t.parquet"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"policy": "genie"}, "genie"),
        ({"policy": "kn"}, "kn"),
        ({"policy": "external"}, "external"),
        ({"seeds": 0}, "seeds 0"),
        ({"battery_knowledge": "all"}, "battery_knowledge"),
        ({"policy": lambda _: np.zeros(13)}, r"\(1, 14\)|14"),
    ],
)
def test_errors_name_the_cause(change, says, tmp_path):
    with pytest.raises(ValueError, match=says):
        reveille.record_trajectories(tmp_path / "t.parquet", **{"policy": "random", **SMALL, **change})
    assert not list(tmp_path.iterdir())


def test_a_file_of_something_else_is_refused(tmp_path):
    path = tmp_path / "other.parquet"
    parquet.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(ValueError, match="not a trajectory file"):
        reveille.Trajectories(path)


def test_minari_gives_the_episodes_in_the_spaces_of_the_environment(tmp_path, monkeypatch):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    told = reveille.record_trajectories(tmp_path / "t.parquet", "age-index", seeds=3, **SMALL)
    made = reveille.to_minari(
        told, "reveille/age-index-v0", author="Author", author_email="author@example.org", code_permalink="none"
    )
    assert made.total_episodes == 3
    dataset = minari.load_dataset("reveille/age-index-v0")
    own = ReveilleEnv(**SMALL)
    assert dataset.observation_space == own.observation_space and dataset.action_space == own.action_space
    assert dataset.total_steps == sum(info.steps for info in told.episodes)
    env = dataset.recover_environment()
    metadata = dataset.storage.get_episode_metadata(range(3))
    for episode, recorded, known in zip(dataset.iterate_episodes(), told, metadata, strict=True):
        info = recorded.info
        assert known["digest"] == info.digest and known["seed"] == info.seed
        assert known["metrics"]["info_p1"] == info.metrics["info_p1"]
        assert len(episode) == info.steps
        for key, values in recorded.observations.items():
            np.testing.assert_array_equal(episode.observations[key], values)
        first = {key: values[0] for key, values in episode.observations.items()}
        assert first in dataset.observation_space and episode.actions[0] in dataset.action_space
        np.testing.assert_array_equal(episode.infos["tti"], recorded.ttis)
        seen, rewards, _, last = replayed(env, info.seed, episode.actions)
        np.testing.assert_array_equal(episode.rewards, rewards)
        assert last["digest"] == info.digest
    with pytest.raises(ValueError, match="already exists"):
        reveille.to_minari(told.path, "reveille/age-index-v0")


def test_a_scenario_file_that_has_changed_is_noticed(tmp_path):
    scenario = tmp_path / "own.toml"
    scenario.write_text('preset = "quick"\n[harvest]\nlambda = 0.3\n')
    recorded = reveille.record_trajectories(
        tmp_path / "t.parquet", "random", scenario=str(scenario), devices=8, ttis=40, seeds=1
    )
    assert recorded.environment().action_space.n == 8
    scenario.write_text('preset = "quick"\n[harvest]\nlambda = 0.1\n')
    with pytest.raises(ValueError, match="has changed since"):
        recorded.environment()
