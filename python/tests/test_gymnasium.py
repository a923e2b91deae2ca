"""The environment for Gymnasium."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence

import reveille
from reveille.environment import ReveilleEnv

SMALL = {"devices": 12, "ttis": 60}


def play(env, seed, actions=None, steps=10**9):
    """Plays a run with drawn actions; returns all of its outputs and its last info."""
    rng = np.random.default_rng(seed)
    obs, info = env.reset(seed=seed)
    seen = [obs]
    while steps > 0:
        action = (rng.random(env.action_space.n) < 0.15).astype(np.int8)
        obs, reward, terminated, truncated, info = env.step(action)
        seen.append((obs, reward))
        assert not terminated
        assert reward == pytest.approx(sum(info[part] for part in ("asleep", "missed", "information", "woken")))
        steps -= 1
        if truncated:
            break
    return seen, info


@pytest.mark.parametrize("knowledge", ["oracle", "reported"])
@pytest.mark.filterwarnings("error")
def test_gymnasiums_checker_accepts_it(knowledge):
    check_env(gym.make("Reveille-v0", battery_knowledge=knowledge, **SMALL).unwrapped)


def test_it_is_made_by_name_and_masks_sample():
    env = gym.make("Reveille-v0", scenario="paper", devices=50, ttis=300, battery_knowledge="reported")
    obs, _ = env.reset(seed=3)
    stages = set()
    while True:
        stages.add(int(obs["stage"]))
        action = env.action_space.sample(mask=obs["action_mask"])
        if obs["stage"] == 1:
            assert not action[obs["action_mask"] == 0].any()
        obs, _, _, truncated, info = env.step(action & (np.arange(50) % 5 == 0))
        if truncated:
            break
    assert stages == {0, 1} and info["ttis_done"] == 300 and info["complete"]
    assert len(info["digest"]) == 64 and info["metrics"]["events"] > 10


def test_a_seed_is_a_run_and_an_unseeded_reset_another():
    first, second = ReveilleEnv(**SMALL), ReveilleEnv(**SMALL)
    (a, end_a), (b, end_b) = play(first, 5), play(second, 5)
    assert data_equivalence(a, b, exact=True) and end_a["digest"] == end_b["digest"]
    (_, again), (_, other) = first.reset(), second.reset()
    assert again["seed"] == other["seed"] != 5
    assert play(first, 6)[1]["digest"] != end_a["digest"]


@pytest.mark.parametrize("policy", ["age-index", "dt", "q-learning"])
@pytest.mark.parametrize("knowledge", ["oracle", "reported"])
def test_the_actions_of_a_policy_give_its_digest(policy, knowledge):
    settings = {"devices": 30, "ttis": 500, "battery_knowledge": knowledge}
    own = reveille.run(policy=policy, seed=7, actions=True, **settings)
    env = ReveilleEnv(**settings)
    env.reset(seed=7)
    for action in own["actions"]:
        _, _, _, truncated, info = env.step(action)
    assert truncated and info["digest"] == own["digest"] == reveille.run(policy=policy, seed=7, **settings)["digest"]
    np.testing.assert_equal(info["metrics"]["info_p1"], own["metrics"]["info_p1"])


def test_one_other_action_gives_another_digest():
    own = reveille.run(policy="age-index", seed=7, actions=True, devices=30, ttis=200)
    env = ReveilleEnv(devices=30, ttis=200)
    env.reset(seed=7)
    own["actions"][100, 3] ^= 1
    for action in own["actions"]:
        _, _, _, truncated, info = env.step(action)
        if truncated:
            break
    assert info.get("digest") != own["digest"]


def test_snapshots_are_restored():
    env = ReveilleEnv(**SMALL)
    play(env, 4, steps=30)
    snapshot = env.snapshot()
    rng = np.random.default_rng(1)
    actions = rng.integers(0, 2, (200, 12)).astype(np.int8)

    def go_on(env):
        ends = []
        for action in actions:
            obs, reward, _, truncated, info = env.step(action)
            ends.append((obs, reward))
            if truncated:
                return ends, info["digest"]
        raise AssertionError("no end")

    first = go_on(env)
    env.restore(snapshot)
    other = ReveilleEnv(**SMALL)
    other.restore(snapshot)
    second, third = go_on(env), go_on(other)
    assert first[1] == second[1] == third[1]
    assert data_equivalence(first[0], second[0], exact=True) and data_equivalence(first[0], third[0], exact=True)
    with pytest.raises(ValueError, match="another number of devices"):
        ReveilleEnv(devices=13, ttis=60).restore(snapshot)


def test_illegal_wake_ups_are_dropped_and_cost_nothing():
    env = ReveilleEnv(devices=12, ttis=400)
    obs, _ = env.reset(seed=2)
    dropped = 0
    for _ in range(700):
        if obs["stage"] == 0:
            action = np.arange(12) % 3 == 0
        else:
            action = obs["action_mask"] == 0
            dropped += int(action.sum())
        obs, _, _, truncated, info = env.step(action.astype(np.int8))
        if obs["stage"] == 0:
            assert info["woken"] == 0
        if truncated:
            break
    assert dropped > 10 and info["metrics"]["wake_ups_per_event"] == 0


def test_observations_stay_in_their_space_and_arrays_are_the_callers():
    env = ReveilleEnv(devices=15, ttis=200, set={"harvest.kind": "diurnal"})
    seen, _ = play(env, 9)
    assert all(obs in env.observation_space for obs, *_ in seen[1:])
    before = seen[1][0]["device"].copy()
    env.reset(seed=1)
    np.testing.assert_array_equal(before, seen[1][0]["device"])


def test_options_set_fields_of_an_episode():
    env = ReveilleEnv(devices=15, ttis=100)
    _, plain = play(env, 3)
    env.reset(seed=3, options={"set": {"harvest.lambda": 0.9, "ttis": 50}})
    for _ in range(1000):
        *_, truncated, info = env.step(np.zeros(15, dtype=np.int8))
        if truncated:
            break
    assert info["ttis_done"] == 50
    assert play(env, 3)[1]["digest"] == plain["digest"]


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ReveilleEnv("papyrus"), "papyrus"),
        (lambda: ReveilleEnv(devices=0), "devices = 0"),
        (lambda: ReveilleEnv(battery_knowledge="all"), "battery_knowledge"),
        (lambda: ReveilleEnv(set={"harvest.lamda": 1}), "did you mean `lambda`"),
        (lambda: ReveilleEnv(set={"policy.knn.neighbours": 3, "nonsense": 1}), "nonsense"),
        (lambda: ReveilleEnv(render_mode="human"), "render_mode"),
        (lambda: ReveilleEnv(**SMALL).reset(options={"seet": 1}), "seet"),
        (lambda: ReveilleEnv(**SMALL).reset(options={"set": {"devices": 13}}), "12 devices"),
        (lambda: _stepped(np.zeros(11)), r"\(1, 12\)"),
        (lambda: reveille.run(policy="external"), "external"),
        (lambda: reveille.run(policy="genie", actions=True), "genie"),
        (lambda: reveille.run(set={"ttis": "long"}), "ttis"),
    ],
)
def test_errors_name_the_cause(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def _stepped(action):
    env = ReveilleEnv(**SMALL)
    env.reset(seed=1)
    env.step(action)


def test_a_step_before_a_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        ReveilleEnv(**SMALL).step(np.zeros(12))
