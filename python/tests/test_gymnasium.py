"""Tests of `ReveilleEnv`: Gymnasium's checker, and comparisons with the policies whose actions are repeated."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence

import reveille
from reveille.environment import ReveilleEnv

SMALL = {"devices": 12, "ttis": 60}


def play(env, seed, actions=None, steps=10**9):
    """Plays a run with random actions. Returns its observations and rewards, and its last info."""
    rng = np.random.default_rng(seed)
    obs, info = env.reset(seed=seed)
    steps_seen = [obs]
    while steps > 0:
        action = (rng.random(env.action_space.n) < 0.15).astype(np.int8)
        obs, reward, terminated, truncated, info = env.step(action)
        steps_seen.append((obs, reward))
        assert not terminated
        assert reward == pytest.approx(sum(info[part] for part in ("asleep", "missed", "information", "woken")))
        steps -= 1
        if truncated:
            break
    return steps_seen, info


@pytest.mark.parametrize("knowledge", ["oracle", "reported"])
@pytest.mark.filterwarnings("error")
def test_the_checker_of_gymnasium_accepts_the_environment(knowledge):
    check_env(gym.make("Reveille-v0", battery_knowledge=knowledge, **SMALL).unwrapped)


def test_make_creates_the_environment_and_masks_restrict_samples():
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


def test_a_seed_repeats_the_run_and_an_unseeded_reset_changes_it():
    first, second = ReveilleEnv(**SMALL), ReveilleEnv(**SMALL)
    (first_steps, first_info), (second_steps, second_info) = play(first, 5), play(second, 5)
    assert data_equivalence(first_steps, second_steps, exact=True)
    assert first_info["digest"] == second_info["digest"]
    (_, first_reset), (_, second_reset) = first.reset(), second.reset()
    assert first_reset["seed"] == second_reset["seed"] != 5
    assert play(first, 6)[1]["digest"] != first_info["digest"]


@pytest.mark.parametrize("policy", ["age-index", "dt", "q-learning"])
@pytest.mark.parametrize("knowledge", ["oracle", "reported"])
def test_repeated_actions_of_a_policy_give_its_digest(policy, knowledge):
    settings = {"devices": 30, "ttis": 500, "battery_knowledge": knowledge}
    run = reveille.run(policy=policy, seed=7, actions=True, **settings)
    env = ReveilleEnv(**settings)
    env.reset(seed=7)
    for action in run["actions"]:
        _, _, _, truncated, info = env.step(action)
    assert truncated and info["digest"] == run["digest"] == reveille.run(policy=policy, seed=7, **settings)["digest"]
    np.testing.assert_equal(info["metrics"]["info_p1"], run["metrics"]["info_p1"])


def test_a_changed_action_gives_another_digest():
    run = reveille.run(policy="age-index", seed=7, actions=True, devices=30, ttis=200)
    env = ReveilleEnv(devices=30, ttis=200)
    env.reset(seed=7)
    run["actions"][100, 3] ^= 1
    for action in run["actions"]:
        _, _, _, truncated, info = env.step(action)
        if truncated:
            break
    assert info.get("digest") != run["digest"]


def test_a_restored_snapshot_continues_the_same_run():
    env = ReveilleEnv(**SMALL)
    play(env, 4, steps=30)
    snapshot = env.snapshot()
    rng = np.random.default_rng(1)
    actions = rng.integers(0, 2, (200, 12)).astype(np.int8)

    def continue_run(env):
        steps = []
        for action in actions:
            obs, reward, _, truncated, info = env.step(action)
            steps.append((obs, reward))
            if truncated:
                return steps, info["digest"]
        raise AssertionError("the run does not end")

    original = continue_run(env)
    env.restore(snapshot)
    other = ReveilleEnv(**SMALL)
    other.restore(snapshot)
    restored, copied = continue_run(env), continue_run(other)
    assert original[1] == restored[1] == copied[1]
    assert data_equivalence(original[0], restored[0], exact=True)
    assert data_equivalence(original[0], copied[0], exact=True)
    with pytest.raises(ValueError, match="another number of devices"):
        ReveilleEnv(devices=13, ttis=60).restore(snapshot)


def test_wake_ups_outside_the_mask_are_dropped_without_cost():
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


def test_observations_are_in_their_space_and_not_overwritten():
    env = ReveilleEnv(devices=15, ttis=200, set={"harvest.kind": "diurnal"})
    steps, _ = play(env, 9)
    assert all(obs in env.observation_space for obs, *_ in steps[1:])
    copy = steps[1][0]["device"].copy()
    env.reset(seed=1)
    np.testing.assert_array_equal(copy, steps[1][0]["device"])


def test_options_set_fields_of_an_episode():
    env = ReveilleEnv(devices=15, ttis=100)
    _, default_info = play(env, 3)
    env.reset(seed=3, options={"set": {"harvest.lambda": 0.9, "ttis": 50}})
    for _ in range(1000):
        *_, truncated, info = env.step(np.zeros(15, dtype=np.int8))
        if truncated:
            break
    assert info["ttis_done"] == 50
    assert play(env, 3)[1]["digest"] == default_info["digest"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ReveilleEnv("papyrus"), "papyrus"),
        (lambda: ReveilleEnv(devices=0), "devices = 0"),
        (lambda: ReveilleEnv(battery_knowledge="all"), "battery_knowledge"),
        (lambda: ReveilleEnv(set={"harvest.lamda": 1}), "did you mean `harvest.lambda`"),
        (lambda: ReveilleEnv(set={"policy.knn.neighbours": 3, "nonsense": 1}), "nonsense"),
        (lambda: ReveilleEnv(render_mode="human"), "render_mode"),
        (lambda: ReveilleEnv(**SMALL).reset(options={"seet": 1}), "seet"),
        (lambda: ReveilleEnv(**SMALL).reset(options={"set": {"devices": 13}}), "12 devices"),
        (lambda: _step(np.zeros(11)), r"\(1, 12\)"),
        (lambda: reveille.run(policy="external"), "external"),
        (lambda: reveille.run(policy="genie", actions=True), "genie"),
        (lambda: reveille.run(set={"ttis": "long"}), "ttis"),
    ],
)
def test_errors_name_the_cause(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def _step(action):
    env = ReveilleEnv(**SMALL)
    env.reset(seed=1)
    env.step(action)


def test_a_step_before_a_reset_is_refused():
    with pytest.raises(gym.error.ResetNeeded):
        ReveilleEnv(**SMALL).step(np.zeros(12))
