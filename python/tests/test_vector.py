"""Tests of `ReveilleVectorEnv` and `make_vec`, which step many environments together: comparisons with single
environments, buffers, resets and threads.
"""

import threading

import gymnasium as gym
import numpy as np
import pytest

import reveille
from reveille.environment import ReveilleEnv
from reveille.vector import ReveilleVectorEnv

SMALL = {"devices": 12, "ttis": 40}


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("copy", [True, False])
def test_a_vector_equals_its_single_environments(threads, copy):
    count = 5
    vec = reveille.make_vec("paper", count, threads=threads, copy=copy, **SMALL)
    singles = [ReveilleEnv(**SMALL) for _ in range(count)]
    observations, _ = vec.reset(seed=10)
    single_observations = [env.reset(seed=10 + index)[0] for index, env in enumerate(singles)]
    ended = np.zeros(count, dtype=bool)
    rng = np.random.default_rng(0)
    digests = 0
    for _ in range(150):
        for key in observations:
            np.testing.assert_array_equal(observations[key], np.stack([obs[key] for obs in single_observations]))
        actions = (rng.random((count, 12)) < 0.2).astype(np.int8)
        observations, rewards, terminated, truncated, infos = vec.step(actions)
        assert not terminated.any()
        for index, env in enumerate(singles):
            if ended[index]:
                single_observations[index], _ = env.reset()
                assert rewards[index] == 0 and not truncated[index]
                ended[index] = False
            else:
                single_observations[index], reward, _, ended[index], info = env.step(actions[index])
                assert reward == rewards[index] and ended[index] == truncated[index]
                if ended[index]:
                    assert infos["_digest"][index] and infos["digest"][index] == info["digest"]
                    digests += 1
    assert digests >= 2 * count
    assert vec.metadata["autoreset_mode"] == gym.vector.AutoresetMode.NEXT_STEP


def test_observations_are_new_arrays_only_if_copied():
    vec = ReveilleVectorEnv(num_envs=2, copy=False, **SMALL)
    first, _ = vec.reset(seed=1)
    second, *_ = vec.step(np.ones((2, 12), dtype=np.int8))
    assert all(first[key] is second[key] for key in first)
    copied = ReveilleVectorEnv(num_envs=2, **SMALL)
    first, _ = copied.reset(seed=1)
    second, *_ = copied.step(np.ones((2, 12), dtype=np.int8))
    assert all(first[key] is not second[key] for key in first)
    assert second["device"].shape == (2, 12, len(reveille.DEVICE_FEATURES))
    assert second in copied.observation_space


def test_make_vec_of_gymnasium_creates_the_vector():
    vec = gym.make_vec("Reveille-v0", num_envs=3, vectorization_mode="vector_entry_point", **SMALL)
    vec.reset(seed=1)
    _, rewards, *_ = vec.step(vec.action_space.sample())
    assert rewards.shape == (3,)


def test_without_autoreset_ended_environments_stay_ended():
    vec = ReveilleVectorEnv(num_envs=2, autoreset="disabled", **SMALL)
    vec.reset(seed=1)
    no_sensing = np.zeros((2, 12), dtype=np.int8)
    while True:
        _, _, _, truncated, _ = vec.step(no_sensing)
        if truncated.all():
            break
    vec.reset(options={"reset_mask": np.array([True, False])})
    _, _, _, truncated, infos = vec.step(no_sensing)
    assert list(truncated) == [False, True] and list(infos["tti"]) == [1, 40]


def test_other_threads_run_during_a_step():
    vec = ReveilleVectorEnv(num_envs=16, devices=100, ttis=10**6, threads=1)
    vec.reset(seed=1)
    actions = np.ones((16, 100), dtype=np.int8)
    counter, stop = [0], threading.Event()

    def count():
        while not stop.is_set():
            counter[0] += 1

    thread = threading.Thread(target=count)
    thread.start()
    for _ in range(50):
        vec.step(actions)
    stop.set()
    thread.join()
    assert counter[0] > 1000


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ReveilleVectorEnv(num_envs=0), "num_envs"),
        (lambda: ReveilleVectorEnv(autoreset="same"), "autoreset"),
        (lambda: ReveilleVectorEnv(num_envs=2, **SMALL).reset(seed=[1]), "1 seeds for 2"),
        (lambda: ReveilleVectorEnv(num_envs=2, **SMALL).step(np.zeros((3, 12))), r"\(2, 12\)"),
        (lambda: ReveilleVectorEnv(num_envs=2, **SMALL).step(np.zeros(24)), r"\(2, 12\)"),
    ],
)
def test_errors_name_the_cause(call, message):
    with pytest.raises(ValueError, match=message):
        call()
