"""Tests of the PettingZoo environment, which has an agent for each device: PettingZoo's checkers, and a comparison with
`ReveilleEnv`.
"""

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

import reveille
from reveille.environment import ReveilleEnv

SMALL = {"devices": 8, "ttis": 50}


@pytest.mark.filterwarnings("error")
def test_the_checker_of_pettingzoo_accepts_the_environment():
    parallel_api_test(reveille.parallel_env(**SMALL), num_cycles=200)


def test_the_seed_checker_of_pettingzoo_accepts_the_environment():
    parallel_seed_test(lambda: reveille.parallel_env(**SMALL), num_cycles=60)


def test_agents_see_the_run_of_the_single_environment():
    parallel, single = reveille.parallel_env(**SMALL), ReveilleEnv(**SMALL)
    observations, _ = parallel.reset(seed=4)
    obs, _ = single.reset(seed=4)
    rng = np.random.default_rng(2)
    while parallel.agents:
        for j, agent in enumerate(parallel.agents):
            np.testing.assert_array_equal(observations[agent]["device"], obs["device"][j])
            assert observations[agent] in parallel.observation_space(agent)
            assert parallel.observation_space(agent) is parallel.observation_space(agent)
            assert observations[agent]["action_mask"][1] == (obs["action_mask"][j] > 0)
        action = rng.integers(0, 2, 8).astype(np.int8)
        actions = dict(zip(parallel.agents, action.tolist(), strict=True))
        observations, rewards, _, truncations, infos = parallel.step(actions)
        obs, reward, _, truncated, info = single.step(action)
        assert set(rewards.values()) == {reward} and set(truncations.values()) == {truncated}
    assert infos["device_3"]["digest"] == info["digest"]


def test_a_depleted_device_stays_an_agent():
    settings = {"set": {"harvest.lambda": 0.0001}, "devices": 8, "ttis": 120, "battery_knowledge": "oracle"}
    env = reveille.parallel_env(**settings)
    env.reset(seed=1)
    empty_batteries = 0
    while env.agents:
        assert len(env.agents) == 8
        observations, *_ = env.step(dict.fromkeys(env.agents, 1))
        empty_batteries += sum(float(obs["device"][2]) == 0 for obs in observations.values())
    assert empty_batteries > 50
