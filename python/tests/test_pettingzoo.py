"""The PettingZoo environment, with an agent for each device."""

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

import reveille
from reveille.environment import ReveilleEnv

SMALL = {"devices": 8, "ttis": 50}


@pytest.mark.filterwarnings("error")
def test_pettingzoos_checker_accepts_it():
    parallel_api_test(reveille.parallel_env(**SMALL), num_cycles=200)


def test_seeds_by_pettingzoos_own_check():
    parallel_seed_test(lambda: reveille.parallel_env(**SMALL), num_cycles=60)


def test_it_is_the_same_run_and_spaces_are_the_same_objects():
    many, one = reveille.parallel_env(**SMALL), ReveilleEnv(**SMALL)
    seen, _ = many.reset(seed=4)
    obs, _ = one.reset(seed=4)
    rng = np.random.default_rng(2)
    while many.agents:
        for j, agent in enumerate(many.agents):
            np.testing.assert_array_equal(seen[agent]["device"], obs["device"][j])
            assert seen[agent] in many.observation_space(agent)
            assert many.observation_space(agent) is many.observation_space(agent)
            assert seen[agent]["action_mask"][1] == (obs["action_mask"][j] > 0)
        action = rng.integers(0, 2, 8).astype(np.int8)
        seen, rewards, _, truncations, infos = many.step(dict(zip(many.agents, action.tolist(), strict=True)))
        obs, reward, _, truncated, info = one.step(action)
        assert set(rewards.values()) == {reward} and set(truncations.values()) == {truncated}
    assert infos["device_3"]["digest"] == info["digest"]


def test_a_depleted_device_stays_an_agent():
    settings = {"set": {"harvest.lambda": 0.0001}, "devices": 8, "ttis": 120, "battery_knowledge": "oracle"}
    env = reveille.parallel_env(**settings)
    env.reset(seed=1)
    empty = 0
    while env.agents:
        assert len(env.agents) == 8
        seen, *_ = env.step(dict.fromkeys(env.agents, 1))
        empty += sum(float(obs["device"][2]) == 0 for obs in seen.values())
    assert empty > 50
